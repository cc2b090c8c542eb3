"""One contract for every solver, on problems with known answers."""

import numpy as np
import pytest

import orthocas as oc
from orthocas import solvers
from orthocas.errors import InvalidValueError, SolveError, UnknownNameError
from orthocas.objective import LeastSquaresObjective, Progress, Solver, SolveResult, Status

ALL = [solvers.GaussNewton(max_iterations=60, tolerance=1e-12), solvers.LBFGS(tolerance=1e-15)]


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


START = np.array([-1.2, 1.0])


@pytest.mark.parametrize("solver", ALL, ids=lambda s: s.name)
class TestContract:
    def test_finds_the_minimum_and_says_so(self, solver: Solver) -> None:
        result = solver.minimise(Valley(), START).raise_if_failed()
        np.testing.assert_allclose(result.theta, 1.0, atol=1e-5)
        assert result.value < 1e-10
        assert result.status in (Status.CONVERGED, Status.STALLED)
        assert result.iterations > 0
        assert result.evaluations >= result.iterations

    def test_running_out_of_iterations_is_a_status(self, solver: Solver) -> None:
        short = type(solver)(max_iterations=3, tolerance=0.0)
        result = short.minimise(Valley(), START)
        assert result.status is Status.ITERATION_LIMIT
        assert result.iterations == 3
        assert result.value < Valley().value(START)

    def test_interrupt_keeps_the_best_point(self, solver: Solver) -> None:
        result = solver.minimise(Interrupted(after=4), START)
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

    def test_progress_is_told(self, solver: Solver) -> None:
        seen: list[Progress] = []
        result = solver.minimise(Valley(), START, seen.append, "stage one")
        assert len(seen) == result.iterations
        assert {p.stage for p in seen} == {"stage one"}

    def test_same_start_same_result(self, solver: Solver) -> None:
        first, second = (solver.minimise(Valley(), START).theta for _ in range(2))
        np.testing.assert_array_equal(first, second)


def test_gauss_newton_refuses_objectives_without_normal_equations(planar_xy: oc.Problem) -> None:
    with pytest.raises(InvalidValueError, match="expected lbfgs"):
        oc.fit(planar_xy, oc.MLP((4,)), solvers.GaussNewton(), samples=50)


def test_least_squares_protocol_is_recognised() -> None:
    assert isinstance(Valley(), LeastSquaresObjective)


def test_solvers_by_name() -> None:
    assert solvers.get("lbfgs").name == "lbfgs"
    with pytest.raises(UnknownNameError, match="unknown solver 'sgd', known: gauss_newton, lbfgs"):
        solvers.get("sgd")


def test_usable_result_is_not_an_error() -> None:
    result = SolveResult(np.zeros(1), 0.0, Status.ITERATION_LIMIT, 1, 1, 0.0)
    assert result.raise_if_failed() is result
