"""What single solvers promise, and every pair of a solver and a parametrisation that makes sense."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from objectives import START, Bowl, SmoothValley, TwoFaced, Valley

import orthocas as oc
from orthocas import problems, solvers
from orthocas.bases import JointSpace
from orthocas.charts.quality import Report
from orthocas.errors import InvalidValueError, SolveError
from orthocas.fitting import basis_objective
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.starts import find_spectral_start
from orthocas.solvers.protocol import ConstrainedObjective, Objective, Solver, Status
from orthocas.tasks.samples import sample_problem


def test_ipopt_keeps_constraints() -> None:
    result = solvers.Ipopt(tolerance=1e-9).minimise(Bowl(-1.0), START).raise_if_failed()
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.theta, [0.0, -1.0], atol=1e-6)


def test_ipopt_says_when_constraints_cannot_be_met() -> None:
    assert isinstance(TwoFaced(), ConstrainedObjective)
    result = solvers.Ipopt().minimise(TwoFaced(), START)
    assert result.status is Status.INFEASIBLE
    with pytest.raises(SolveError, match="constraints cannot be met"):
        result.raise_if_failed()


def test_gradient_flow_follows_the_closed_form() -> None:
    """For L = sum lambda_i theta_i^2 / 2 the flow is theta_i exp(-lambda_i t): ratios tell the path."""

    rates, seen = np.array([1.0, 3.0]), []

    class Quadratic:
        def value(self, theta: np.ndarray) -> float:
            seen.append(theta)
            return float(rates @ theta**2 / 2)

        def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
            return float(rates @ theta**2 / 2), rates * theta

    solvers.GradientFlow(accuracy=1e-9).minimise(Quadratic(), np.array([1.0, 2.0]))
    path = np.array([theta for theta in seen if theta[0] > 1e-2])
    assert len(path) > 5
    np.testing.assert_allclose(path[:, 1], 2 * path[:, 0] ** 3, atol=1e-6)


def test_gradient_flow_takes_the_hessian_where_there_is_one_and_keeps_it_for_some_steps() -> None:
    asked: list[np.ndarray] = []

    class Bowls(SmoothValley):
        def hessian(self, theta: np.ndarray) -> np.ndarray:
            asked.append(theta)
            return super().hessian(theta)

        def normal_equations(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
            raise AssertionError("the Gauss-Newton matrix is not needed")

    flow = solvers.GradientFlow(tolerance=1e-9)
    result = flow.minimise(Bowls(), START)
    np.testing.assert_allclose(result.theta, 1.0, atol=1e-5)
    assert result.iterations < len(asked) < result.evaluations / 4


@pytest.mark.slow
def test_flow_of_a_basis_costs_a_few_times_what_lbfgs_does(planar_xy: oc.Problem) -> None:
    """In evaluations, of which the flow's come with few Hessians; processor times: benchmarks/gradient_flow.py."""
    ours, theirs = (
        oc.fit(planar_xy, oc.Polynomial(3), solver).stages for solver in (solvers.GradientFlow(), solvers.LBFGS())
    )
    assert ours[-1].result.status is Status.CONVERGED
    assert ours[-1].result.value < 1.003 * theirs[-1].result.value
    assert sum(s.result.evaluations for s in ours) < 5 * sum(s.result.evaluations for s in theirs)


def test_adam_takes_fresh_samples_and_judges_on_fixed_ones() -> None:
    asked: list[tuple[int, int, tuple[int, ...]]] = []

    class Sampled(Valley):
        def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Objective]:
            asked.append((size, count, seed))
            return iter([Valley()] * count)

    solvers.Adam(epochs=3, steps=5, batch=20).minimise(Sampled(), START)
    assert asked == [(20, 5, (0,)), (20, 5, (1,)), (20, 5, (2,))]


PAIRS = [
    (parametrisation, solver)
    for parametrisation in (oc.Polynomial(2), oc.Fourier(1), oc.MLP((6, 5)))
    for solver in (
        solvers.GaussNewton(),
        solvers.QuasiNewton(),
        solvers.LBFGS(max_iterations=60),
        solvers.Ipopt(max_iterations=60, tolerance=1e-4),
        solvers.Adam(epochs=7, steps=100, batch=50, learning_rate=2e-2),
        solvers.GradientFlow(max_iterations=18),
    )
    if not (isinstance(parametrisation, oc.MLP) and isinstance(solver, solvers.GaussNewton | solvers.QuasiNewton))
]


@pytest.fixture(scope="module")
def linear(planar_xy: oc.Problem) -> Report:
    """The quality of linear coordinates."""
    return oc.evaluate(oc.fit(planar_xy, oc.Linear()).chart, 2000)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parametrisation", "solver"), PAIRS, ids=lambda value: getattr(value, "label", getattr(value, "name", ""))
)
def test_every_pair_that_makes_sense_beats_linear_coordinates(
    planar_xy: oc.Problem, linear: Report, parametrisation: object, solver: Solver
) -> None:
    weights = oc.Weights(angles="paper")  # the figure below
    fit = oc.fit(planar_xy, parametrisation, solver, weights=weights, samples=300)
    report = oc.evaluate(fit.chart, 2000)
    assert fit.chart.notes["solver"] == solver.name
    assert report.task_angle.std < 0.95 * linear.task_angle.std
    assert np.isnan(report.mutual_angle.std)


@pytest.mark.parametrize("solver", [solvers.GaussNewton(), solvers.QuasiNewton()], ids=lambda s: s.name)
def test_solvers_with_a_matrix_refuse_objectives_without_one(planar_xy: oc.Problem, solver: Solver) -> None:
    with pytest.raises(InvalidValueError, match="expected lbfgs or adam"):
        oc.fit(planar_xy, oc.MLP((4,)), solver, samples=50)


@pytest.mark.slow
def test_blocks_of_the_estimate_are_those_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of many coefficients the estimate is the diagonal of the matrix of few, and leads to the same minimum."""
    iiwa = problems.get("iiwa")
    problem = oc.Problem(iiwa.robot, iiwa.task, "inertia", iiwa.domain)
    family = oc.Polynomial(2).family(JointSpace.of(problem), problem.r)
    samples = sample_problem(problem, 500, (3,))
    start = find_spectral_start(family, samples)
    objective = BasisObjective(family, samples, oc.Weights(folds=0), start, lambda *_: samples)
    (whole,) = objective.curvature_estimate(start)
    together = solvers.QuasiNewton(tolerance=1e-10, max_iterations=2000).minimise(objective, start)
    monkeypatch.setattr(basis_objective, "RULES", replace(basis_objective.RULES, coupled=0))
    blocks = objective.curvature_estimate(start)
    # from beside it, as the loss has several minima
    beside = together.theta * np.random.default_rng(0).uniform(0.95, 1.05, together.theta.size)
    apart = solvers.QuasiNewton(tolerance=1e-10, max_iterations=2000).minimise(objective, beside)
    assert objective.value(beside) > 1.02 * together.value
    assert len(blocks) == problem.r
    for j, block in enumerate(blocks):
        place = slice(j * family.width, (j + 1) * family.width)
        np.testing.assert_allclose(block, whole[place, place], rtol=1e-4, atol=1e-4 * np.abs(whole).max())
    assert apart.value == pytest.approx(together.value, rel=1e-3)


@pytest.mark.slow
def test_quasi_newton_meets_gauss_newton_with_few_matrices() -> None:
    """The same minimum of a real fit, from one matrix for many steps."""
    problem, counts = problems.get("iiwa"), []

    class Counted(BasisObjective):
        def curvature_estimate(self, theta: np.ndarray) -> list[np.ndarray]:
            counts.append(theta)
            return super().curvature_estimate(theta)

    family = oc.Polynomial(1).family(JointSpace.of(problem), problem.r)
    samples = sample_problem(problem, 500, (3,))
    start = find_spectral_start(family, samples)
    objective = Counted(family, samples, oc.Weights(regularity=0, folds=0), start, lambda *_: samples)
    quasi = solvers.QuasiNewton(tolerance=1e-12).minimise(objective, start)
    gauss = solvers.GaussNewton(tolerance=1e-12).minimise(objective, start)
    assert quasi.value == pytest.approx(gauss.value, rel=1e-9)
    assert len(counts) < quasi.iterations / 2
