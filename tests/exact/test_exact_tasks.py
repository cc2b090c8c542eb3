"""Tasks with m >= 2 and exact coordinates: the brackets vanish, and formulas and grown coordinates are orthogonal."""

from collections.abc import Callable

import casadi as ca
import exact_tasks
import numpy as np
import pytest
from exact_tasks import Case, cases, grown_leak

import orthocas as oc
from orthocas import problems
from orthocas.problems.propellers import allocation

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_brackets_tell_exact_tasks_from_their_neighbours(case: Case) -> None:
    assert oc.involutivity(case.problem, 100).exact is case.exact
    assert case.problem.m >= 2


@pytest.mark.parametrize("case", [c for c in cases() if c.formula], ids=lambda case: case.name)
def test_formula_is_orthogonal_to_the_task(case: Case) -> None:
    """d xi A^-1 J_x^T = 0, with matrices in NumPy and gradients by differences."""
    assert case.formula is not None
    formula: Callable[[ca.SX], ca.SX] = case.formula
    q = ca.SX.sym("q", case.problem.n)
    xi, problem = ca.Function("xi", [q], [formula(q)]), case.problem
    at = problem.domain.centre + 0.1
    steps = 1e-5 * np.eye(problem.n)
    gradients = np.column_stack([(xi(at + s) - xi(at - s)).full() / 2e-5 for s in steps])
    J = problem.task.jacobian_function(at).full()
    A = problem.metric.function(at).full()
    products = gradients @ np.linalg.solve(A, J.T)
    assert np.abs(products).max() < 1e-8 * np.abs(gradients).max()
    assert np.linalg.matrix_rank(np.vstack([J, gradients]), tol=1e-6) == problem.n


@pytest.mark.parametrize("case", [c for c in cases() if c.exact], ids=lambda case: case.name)
def test_grown_coordinates_are_orthogonal_by_differences(case: Case) -> None:
    assert grown_leak(case.problem, 5) < 1e-4  # [deg]


def test_wrench_of_hovering_is_thrust_alone() -> None:
    """Six equal spin rates, in pairs of opposite sense, turn nothing."""
    problem = problems.get("hexarotor")
    assert problem.task.batched(np.ones((1, 6)))[0][0] == pytest.approx([1, 0, 0, 0], abs=1e-15)
    assert np.linalg.matrix_rank(allocation()) == 4
    assert not any(name.startswith("q") for name in problem.robot.joint_names)  # no arm


def test_cross_ratio_is_that_of_the_tangents() -> None:
    q = np.array([0.2, 1.0, -1.8, 2.6])
    t = np.tan(np.cumsum(q) / 2)
    ratio = (t[0] - t[1]) * (t[2] - t[3]) / ((t[0] - t[3]) * (t[2] - t[1]))
    assert float(exact_tasks.cross_ratio(ca.DM(q))) == pytest.approx(np.log(abs(ratio)))
