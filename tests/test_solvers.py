"""One contract for every solver, on problems with known answers."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from objectives import ALL, SHORT, START, Bowl, Broken, Interrupted, LastState, NotFinite, Plain, SmoothValley, Valley

from orthocas import solvers
from orthocas.errors import InvalidValueError, SolveError, UnknownNameError
from orthocas.solvers.protocol import (
    ConstrainedObjective,
    EstimatedObjective,
    LeastSquaresObjective,
    Objective,
    SmoothObjective,
    Solver,
    SolveResult,
    Status,
)
from orthocas.tools.progress import Progress, State, Watch


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


@pytest.mark.slow
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
