"""One contract for every solver, on problems with known answers, and for every pair with a parametrisation."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pytest
import scipy.optimize

import orthocas as oc
from orthocas import problems, solvers
from orthocas.errors import CheckpointError, InvalidValueError, SolveError, UnknownNameError
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.spectral_start import spectral_start
from orthocas.minimising.objective import (
    ConstrainedObjective,
    EstimatedObjective,
    LeastSquaresObjective,
    Objective,
    SmoothObjective,
)
from orthocas.minimising.solver import Solver, SolveResult, Status
from orthocas.minimising.watch import Progress, State, Watch
from orthocas.parametrisations import JointSpace
from orthocas.samples import sample_problem
from orthocas.solvers.line_search import Trial, wolfe_step

ALL = [
    solvers.GaussNewton(max_iterations=60, tolerance=1e-12),
    solvers.QuasiNewton(tolerance=1e-12),
    solvers.LBFGS(tolerance=1e-15),
    solvers.Ipopt(tolerance=1e-10),
    solvers.Adam(learning_rate=0.05),
    solvers.GradientFlow(tolerance=1e-9),
]
SHORT = [
    solvers.GaussNewton(max_iterations=3, tolerance=0.0),
    solvers.QuasiNewton(max_iterations=3, tolerance=0.0),
    solvers.LBFGS(max_iterations=3, tolerance=0.0),
    solvers.Ipopt(max_iterations=3),
    solvers.Adam(epochs=3, steps=10, learning_rate=0.05),
    solvers.GradientFlow(max_iterations=3, tolerance=0.0),
]
START = np.array([-1.2, 1.0])


class Valley:
    """Rosenbrock's function as least squares: minimum 0 at (1, 1)."""

    def residuals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = theta
        return np.array([1 - a, 10 * (b - a * a)]), np.array([[-1.0, 0.0], [-20 * a, 10.0]])

    def value(self, theta: np.ndarray) -> float:
        rho = self.residuals(theta)[0]
        return float(rho @ rho / 2)

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        rho, D = self.residuals(theta)
        return float(rho @ rho / 2), D.T @ rho

    def normal_equations(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        rho, D = self.residuals(theta)
        return float(rho @ rho / 2), D.T @ rho, D.T @ D

    def curvature_estimate(self, theta: np.ndarray) -> np.ndarray:
        D = self.residuals(theta)[1]
        return D.T @ D


class SmoothValley(Valley):
    """With its Hessian."""

    def hessian(self, theta: np.ndarray) -> np.ndarray:
        a, b = theta
        return np.array([[1 - 200 * (b - a * a) + 400 * a * a, -200 * a], [-200 * a, 100.0]])


class Plain:
    """An objective of which only values and gradients are known."""

    def __init__(self, objective: Objective) -> None:
        self.value, self.value_and_gradient = objective.value, objective.value_and_gradient


class Interrupted(Valley):
    """Ctrl-C arrives after some evaluations."""

    def __init__(self, after: int) -> None:
        self.left = after

    def value(self, theta: np.ndarray) -> float:
        self.count()
        return super().value(theta)

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        self.count()
        return super().value_and_gradient(theta)

    def normal_equations(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        self.count()
        return super().normal_equations(theta)

    def count(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


class NotFinite(Valley):
    def residuals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(2, np.nan), np.full((2, 2), np.nan)


class Broken(Valley):
    """Fails with an error of its own."""

    def residuals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise ZeroDivisionError("broken on purpose")


class LastState:
    """A keeper that holds the newest state, or goes on from one."""

    def __init__(self, state: State | None = None) -> None:
        self.state = state

    def restored(self) -> State | None:
        return self.state

    def keep(self, state: Callable[[], State]) -> None:
        self.state = state()


@pytest.mark.parametrize("solver", ALL, ids=lambda s: s.name)
class TestContract:
    def test_is_a_solver(self, solver: Solver) -> None:
        assert isinstance(solver, Solver)
        assert isinstance(solver.coarser(), type(solver))

    def test_finds_the_minimum_and_says_so(self, solver: Solver) -> None:
        result = solver.minimise(SmoothValley(), START).raise_if_failed()
        np.testing.assert_allclose(result.theta, 1.0, atol=1e-5)
        assert result.value < 1e-10
        planned = Status.ITERATION_LIMIT if solver.name == "adam" else Status.CONVERGED  # Adam follows its schedule
        assert result.status in (planned, Status.STALLED)
        assert result.iterations > 0
        assert result.evaluations >= result.iterations

    def test_interrupt_keeps_the_best_point(self, solver: Solver) -> None:
        after = {"gradient_flow": 30, "adam": 120}.get(solver.name, 12)
        result = solver.minimise(Interrupted(after), START)
        assert result.status is Status.INTERRUPTED
        assert result.value < Valley().value(START)
        np.testing.assert_allclose(Valley().value(result.theta), result.value)

    def test_interrupt_before_the_first_value_is_passed_on(self, solver: Solver) -> None:
        with pytest.raises(KeyboardInterrupt):
            solver.minimise(Interrupted(after=0), START)

    def test_not_finite_loss_fails(self, solver: Solver) -> None:
        result = solver.minimise(NotFinite(), START)
        assert result.status is Status.FAILED
        with pytest.raises(SolveError, match="failed"):
            result.raise_if_failed()

    def test_error_of_the_objective_is_passed_on(self, solver: Solver) -> None:
        with pytest.raises(ZeroDivisionError, match="on purpose"):
            solver.minimise(Broken(), START)

    def test_progress_is_told(self, solver: Solver) -> None:
        seen: list[Progress] = []
        result = solver.minimise(Valley(), START, Watch(seen.append, "stage one"))
        assert len(seen) == result.iterations
        assert {p.stage for p in seen} == {"stage one"}
        assert seen[-1].value == result.value
        assert all(later.value <= earlier.value for earlier, later in pairwise(seen))

    def test_same_start_same_result(self, solver: Solver) -> None:
        first, second = (solver.minimise(Valley(), START).theta for _ in range(2))
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("solver", SHORT, ids=lambda s: s.name)
class TestShortRuns:
    def test_running_out_of_iterations_is_a_status(self, solver: Solver) -> None:
        result = solver.minimise(Valley(), START)
        assert result.status is Status.ITERATION_LIMIT
        assert result.iterations == 3
        assert result.value < Valley().value(START)

    def test_restored_run_goes_on_where_it_was(self, solver: Solver) -> None:
        keeper = LastState()
        first = solver.minimise(Valley(), START, Watch(keeper=keeper))
        longer = next(s for s in ALL if s.name == solver.name)
        result = longer.minimise(Valley(), START, Watch(keeper=LastState(keeper.state)))
        assert result.iterations > first.iterations
        assert result.evaluations > first.evaluations
        assert result.seconds > first.seconds
        np.testing.assert_allclose(result.theta, 1.0, atol=1e-3)

    def test_restored_run_that_was_done_ends_at_once(self, solver: Solver) -> None:
        keeper = LastState()
        first = solver.minimise(Valley(), START, Watch(keeper=keeper))
        again = solver.minimise(Valley(), np.zeros(2), Watch(keeper=LastState(keeper.state)))
        assert again.iterations == first.iterations
        np.testing.assert_array_equal(again.theta, first.theta)


KILLED = [
    solvers.GaussNewton(tolerance=0.0),
    solvers.GaussNewton(),
    solvers.QuasiNewton(),
    solvers.Adam(epochs=6, steps=10),
    solvers.GradientFlow(),
    solvers.GradientFlow(max_iterations=7),
    solvers.LBFGS(),
    solvers.LBFGS(tolerance=1e-15, memory=3),
]


@pytest.mark.parametrize(
    ("solver", "objective"),
    [(solver, Valley()) for solver in KILLED] + [(solver, Plain(Valley())) for solver in KILLED[3:]],
    ids=lambda value: getattr(value, "name", type(value).__name__),
)
def test_killed_run_loses_nothing(solver: Solver, objective: Objective) -> None:
    """A run restored from its state after any iteration, the last one included, ends at the same point, bit by bit."""
    states: list[State] = []

    class Recorder(LastState):
        def keep(self, state: Callable[[], State]) -> None:
            states.append(state())  # not copied: solvers must not change what they handed over

    whole = solver.minimise(objective, START, Watch(keeper=Recorder()))
    assert len(states) == whole.iterations > 3
    for state in states:
        resumed = solver.minimise(objective, START, Watch(keeper=LastState(state)))
        np.testing.assert_array_equal(resumed.theta, whole.theta)
        assert (resumed.iterations, resumed.evaluations) == (whole.iterations, whole.evaluations)
        assert (resumed.value, resumed.status) == (whole.value, whole.status)


@pytest.mark.parametrize("pair", [np.ones((2, 3)), np.array([[1.0, 0.0], [-1.0, 0.0]]), np.full((2, 2), np.nan)])
def test_lbfgs_refuses_pairs_of_another_objective(pair: np.ndarray) -> None:
    keeper = LastState()
    solvers.LBFGS(max_iterations=3).minimise(Valley(), START, Watch(keeper=keeper))
    assert keeper.state is not None
    with pytest.raises(CheckpointError, match="pair_1 has shape"):
        solvers.LBFGS().minimise(Valley(), START, Watch(keeper=LastState({**keeper.state, "pair_1": pair})))


def test_lbfgs_needs_no_more_evaluations_than_scipy() -> None:
    """Rosenbrock's function of 20 variables from ten starts: the same minimum for at most a tenth more work."""

    class Rosenbrock:
        def value(self, theta: np.ndarray) -> float:
            return float(scipy.optimize.rosen(theta))

        def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
            return self.value(theta), scipy.optimize.rosen_der(theta)

    starts = np.random.default_rng(3).uniform(-2, 2, (10, 20))
    options = {"maxiter": 1000, "maxfun": 2000, "ftol": 1e-12, "gtol": 0.0, "maxcor": 20}
    ours = theirs = 0
    for start in starts:
        result = solvers.LBFGS(max_iterations=1000, tolerance=1e-12).minimise(Rosenbrock(), start)
        peer = scipy.optimize.minimize(
            Rosenbrock().value_and_gradient, start, jac=True, method="L-BFGS-B", options=options
        )
        assert result.status is Status.CONVERGED
        assert result.value < 1e-8 or np.isclose(result.value, peer.fun, rtol=1e-6)  # there is a second minimum
        ours, theirs = ours + result.evaluations, theirs + peer.nfev
    assert ours < 1.1 * theirs


@pytest.mark.parametrize("first", [1e-3, 0.1, 1.0, 50.0])
def test_steps_keep_the_wolfe_conditions(first: float) -> None:
    """Waves on a slope that turns up: many minima, steps far too short and far too long."""

    def wave(step: float) -> tuple[float, float]:
        return (
            float(np.cos(3 * step) / 2 - step + 0.05 * step**2),
            float(-1.5 * np.sin(3 * step) - 1 + 0.1 * step),
        )

    tried: list[float] = []

    def along(step: float) -> tuple[float, float]:
        tried.append(step)
        return wave(step)

    start = Trial(0.0, *wave(0.0))
    assert wolfe_step(along, start, first)
    value, slope = wave(tried[-1])
    assert value <= start.value + 1e-3 * tried[-1] * start.slope
    assert abs(slope) <= 0.9 * abs(start.slope)


def test_no_step_is_found_where_the_slope_lies() -> None:
    trials: list[float] = []

    def rising(step: float) -> tuple[float, float]:
        trials.append(step)
        return step, 1.0

    assert not wolfe_step(rising, Trial(0.0, 0.0, -1.0), 1.0)
    assert len(trials) == 20
    assert not wolfe_step(lambda step: (np.inf, np.nan), Trial(0.0, 0.0, -1.0), 1.0)


class Bowl:
    """min |theta|^2 / 2 with theta_1 + theta_2 <= bound and theta_1 - theta_2 = 1."""

    def __init__(self, bound: float, gap: float = 1.0) -> None:
        self.bounds = np.array([-np.inf, gap]), np.array([bound, 1.0])

    def value(self, theta: np.ndarray) -> float:
        return float(theta @ theta / 2)

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        return self.value(theta), theta

    def constraints(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A = np.array([[1.0, 1.0], [1.0, -1.0]])
        return A @ theta, A

    def lagrangian_hessian(self, theta: np.ndarray, factor: float, multipliers: np.ndarray) -> np.ndarray:
        return factor * np.eye(2)


class TwoFaced(Bowl):
    """theta_1 + theta_2 <= -1 and >= 1 at once."""

    def __init__(self) -> None:
        self.bounds = np.array([-np.inf, 1.0]), np.array([-1.0, np.inf])

    def constraints(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A = np.ones((2, 2))
        return A @ theta, A


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
        solvers.Adam(epochs=10, steps=100, batch=50, learning_rate=2e-2),
        solvers.GradientFlow(max_iterations=18),
    )
    if not (isinstance(parametrisation, oc.MLP) and isinstance(solver, solvers.GaussNewton | solvers.QuasiNewton))
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parametrisation", "solver"), PAIRS, ids=lambda value: getattr(value, "label", getattr(value, "name", ""))
)
def test_every_pair_that_makes_sense_beats_linear_coordinates(
    planar_xy: oc.Problem, parametrisation: object, solver: Solver
) -> None:
    linear = oc.evaluate(oc.fit(planar_xy, oc.Linear()).chart, 2000)
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


def test_quasi_newton_meets_gauss_newton_with_few_matrices() -> None:
    """The same minimum of a real fit, from one matrix for many steps."""
    problem, counts = problems.get("iiwa"), []

    class Counted(BasisObjective):
        def curvature_estimate(self, theta: np.ndarray) -> np.ndarray:
            counts.append(theta)
            return super().curvature_estimate(theta)

    family = oc.Polynomial(1).family(JointSpace.of(problem), problem.r)
    samples = sample_problem(problem, 500, (3,))
    start = spectral_start(family, samples)
    objective = Counted(family, samples, oc.Weights(regularity=0, folds=0), start, lambda *_: samples)
    quasi = solvers.QuasiNewton(tolerance=1e-12).minimise(objective, start)
    gauss = solvers.GaussNewton(tolerance=1e-12).minimise(objective, start)
    assert quasi.value == pytest.approx(gauss.value, rel=1e-9)
    assert len(counts) < quasi.iterations / 2


def test_protocols_are_recognised() -> None:
    assert isinstance(Valley(), LeastSquaresObjective)
    assert isinstance(Valley(), EstimatedObjective)
    assert not isinstance(Valley(), SmoothObjective)
    assert isinstance(SmoothValley(), SmoothObjective)
    assert isinstance(Bowl(0.0), ConstrainedObjective)


def test_bad_settings_of_solvers_are_refused() -> None:
    for build in (
        lambda: solvers.LBFGS(max_iterations=0),
        lambda: solvers.GaussNewton(tolerance=-1.0),
        lambda: solvers.Ipopt(tolerance=float("nan")),
        lambda: solvers.Adam(epochs=0),
        lambda: solvers.Adam(learning_rate=0.0),
        lambda: solvers.GradientFlow(accuracy=0.0),
    ):
        with pytest.raises(InvalidValueError):
            build()


def test_solvers_by_name() -> None:
    for name in ("gauss_newton", "quasi_newton", "lbfgs", "ipopt", "adam", "gradient_flow"):
        assert solvers.get(name).name == name
    with pytest.raises(UnknownNameError, match="unknown solver 'sgd', known: gauss_newton, quasi_newton, lbfgs, ipopt"):
        solvers.get("sgd")


def test_usable_result_is_not_an_error() -> None:
    result = SolveResult(np.zeros(1), 0.0, Status.ITERATION_LIMIT, 1, 1, 0.0)
    assert result.raise_if_failed() is result
