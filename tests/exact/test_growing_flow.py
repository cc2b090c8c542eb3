"""Flows along task gradients: they end where an independent integrator does, and say so when they cannot."""

import casadi as ca
import numpy as np
import pytest
from programs import nightly
from scipy.integrate import solve_ivp
from sundials_flow import SundialsFlow

import orthocas as oc
from orthocas import problems
from orthocas.errors import GrowError
from orthocas.exact.flow import Arrival, BatchedFlow, TaskFlow

ARM = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
STIFFNESS = np.diag([3.0, 2.0, 1.0]) + 0.2
CELL = oc.Box([np.pi / 2, 0, 0], [np.pi / 2, np.pi, np.pi])


def planar(metric: object = "euclidean", axes: str = "x") -> oc.Problem:
    return oc.Problem(ARM, oc.Task.position(ARM, axes), metric, CELL)


def samples(problem: oc.Problem, count: int = 200, seed: int = 7) -> np.ndarray:
    unit = np.random.default_rng(seed).uniform(-1, 1, (count, problem.n))
    return problem.domain.centre + problem.domain.half_width * unit


def test_batched_flow_solves_a_closed_form() -> None:
    y, p = ca.SX.sym("y", 2), ca.SX.sym("p")
    field = ca.Function("field", [y, p], [ca.vertcat(-p * y[1], p * y[0])])  # turns by the angle p
    angles = np.linspace(0.1, 30, 300)[:, None]
    ends, arrived = BatchedFlow(field, np.ones(2)).find_end_points(np.tile([1.0, 0.0], (300, 1)), angles, 1e-11)
    assert arrived.all()
    np.testing.assert_allclose(ends, np.hstack([np.cos(angles), np.sin(angles)]), atol=1e-9)  # 10 to 60 steps


def test_batched_flow_stops_where_the_solution_ends() -> None:
    y, p = ca.SX.sym("y"), ca.SX.sym("p")
    flow = BatchedFlow(ca.Function("field", [y, p], [p * y**2]), np.ones(1))  # 1 / (1/y0 - p s): ends at s = 1 / p
    ends, arrived = flow.find_end_points(np.ones((3, 1)), np.array([[0.5], [2.0], [np.nan]]), 1e-9)
    np.testing.assert_array_equal(arrived, [True, False, False])
    np.testing.assert_allclose(ends[0], 2.0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("metric", [*nightly("euclidean"), "inertia", *nightly(STIFFNESS)], ids=["I", "M", "custom"])
def test_pull_ends_where_the_paper_s_gradient_flow_ends(metric: object) -> None:
    """Equation (23) by SciPy, run until h has converged to 1e-9, against the task-parametrised flow."""
    problem = planar(metric)
    points = samples(problem, 8)
    pulled = TaskFlow(problem).pull(points, np.array([0.3]), 1e-12)
    h, J = problem.task.function, problem.task.jacobian_function

    def rate(t: float, q: np.ndarray) -> np.ndarray:
        A = problem.metric.evaluate(q[None])[0]
        return (0.3 - float(h(q))) * np.linalg.solve(A, np.array(J(q))[0])

    for start, end in zip(points, pulled.points, strict=True):
        solved = solve_ivp(rate, (0, 400), start, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(end, solved, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["euclidean", "inertia", STIFFNESS], ids=["I", "M", "custom"])
def test_all_flows_agree(metric: object) -> None:
    problem = planar(metric)
    points = samples(problem)
    ours, sundials = TaskFlow(problem).pull(points, np.zeros(1)), SundialsFlow(problem)
    theirs, papers = sundials.pull(points, 0.0), sundials.gradient_flow(points, 0.0)
    assert ours.reached.all()
    assert theirs.reached.all()
    np.testing.assert_allclose(ours.points, theirs.points, atol=1e-6)
    assert np.median(np.abs(ours.points - theirs.points)) < 1e-8
    both = papers.reached  # the paper's rule may stop early near a saddle: it is then not on the leaf
    assert both.mean() > 0.95
    np.testing.assert_allclose(papers.points[both], ours.points[both], atol=1e-4)  # its rule stops about 1e-6 short


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["euclidean", "inertia", STIFFNESS], ids=["I", "M", "custom"])
def test_derivative_agrees_with_finite_differences(metric: object) -> None:
    problem = planar(metric)
    flow, points, step = TaskFlow(problem), samples(problem, 20), 1e-5
    _, derivative = flow.pull_with_derivative(points, np.zeros(1))
    for k, unit in enumerate(np.eye(3)):
        sides = [flow.pull(points + sign * step * unit, np.zeros(1), 1e-13).points for sign in (1, -1)]
        difference = (sides[0] - sides[1]) / (2 * step)
        np.testing.assert_allclose(derivative[:, :, k], difference, atol=1e-5 * max(1, np.abs(difference).max()))


def test_move_changes_two_task_values_by_what_was_asked() -> None:
    problem = problems.get("planar_3r_xy")
    points = samples(problem)
    dx = np.tile([0.05, -0.08], (len(points), 1))
    moved = TaskFlow(problem).move(points, dx)
    assert moved.reached.all()
    change = problem.task.batched(moved.points)[0] - problem.task.batched(points)[0]
    np.testing.assert_allclose(change, dx, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_seven_joints_flow(metric: str) -> None:
    arm = problems.get("iiwa")
    problem = oc.Problem(arm.robot, oc.Task.position(arm.robot, "z"), metric, oc.Box(arm.domain.centre, 0.3))
    points = samples(problem, 5)
    moved, derivative = TaskFlow(problem).pull_with_derivative(points, np.array([0.7]))
    assert moved.reached.all()
    np.testing.assert_allclose(problem.task.batched(moved.points)[0], 0.7, atol=1e-8)
    step = 1e-5 * np.random.default_rng(3).normal(size=points.shape)
    flow = TaskFlow(problem)
    sides = [flow.pull(points + sign * step, np.array([0.7]), 1e-13).points for sign in (1, -1)]
    np.testing.assert_allclose((derivative @ step[:, :, None])[:, :, 0], (sides[0] - sides[1]) / 2, atol=1e-9)


def test_singular_starts_get_a_status_and_stay_finite() -> None:
    problem = planar()
    points = np.array([[0, 0, 0], [0, np.pi, 0], [np.pi / 2, 0, 0]])
    wanted = [Arrival.SINGULAR, Arrival.SINGULAR, Arrival.REACHED]
    sundials = SundialsFlow(problem)
    for moved in (
        TaskFlow(problem).pull(points, np.zeros(1)),
        TaskFlow(problem).pull_with_derivative(points, np.zeros(1))[0],
        sundials.pull(points, 0.0),
        sundials.gradient_flow(points, 0.0),
    ):
        np.testing.assert_array_equal(moved.status, wanted)
        assert np.isfinite(moved.points).all()


def test_sundials_flow_is_for_one_task_component() -> None:
    with pytest.raises(GrowError, match="m = 1"):
        SundialsFlow(problems.get("planar_3r_xy"))


def test_unreachable_levels_end_as_singular() -> None:
    moved = TaskFlow(planar()).pull(samples(planar(), 50), np.array([3.5]))  # the arm is 3 m long
    assert (moved.status == Arrival.SINGULAR).all()
    assert np.isfinite(moved.points).all()
