"""One contract for every solver, on problems with known answers."""

from itertools import pairwise

import numpy as np
import pytest
from objectives import ALL, SHORT, START, Bowl, Broken, Interrupted, NotFinite, SmoothValley, Valley

from orthocas import solvers
from orthocas.errors import InvalidValueError, SolveError, UnknownNameError
from orthocas.solvers.protocol import (
    ConstrainedObjective,
    EstimatedObjective,
    LeastSquaresObjective,
    SmoothObjective,
    Solver,
    SolveResult,
    Status,
)
from orthocas.tools.progress import Progress, Watch


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
        lambda: solvers.QuasiNewton(renewal=1.0),
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
