"""L-BFGS by SciPy: where the loss is not finite, and what a Gauss-Newton matrix gains."""

import numpy as np
import pytest
from objectives import START, Valley

from orthocas import solvers
from orthocas.solvers.protocol import Status


class Well:
    """sum theta - 0.001 log theta, with its minimum at 0.001; not finite for theta <= 0, where long steps lead."""

    def __init__(self, outside: float) -> None:
        self.outside, self.beyond = outside, 0

    def value(self, theta: np.ndarray) -> float:
        return self.value_and_gradient(theta)[0]

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        if theta.min() <= 0:
            self.beyond += 1
            return self.outside, np.full_like(theta, np.nan)
        return float(np.sum(theta - 1e-3 * np.log(theta))), 1 - 1e-3 / theta

    def curvature_estimate(self, theta: np.ndarray) -> list[np.ndarray]:
        return [np.eye(theta.size)]


@pytest.mark.parametrize("outside", [np.nan, np.inf])
@pytest.mark.parametrize("start", [0.5, 0.9, 3.0])
@pytest.mark.parametrize("solver", [solvers.LBFGS(tolerance=1e-14), solvers.QuasiNewton(tolerance=1e-14)])
def test_steps_turn_back_where_the_loss_is_not_finite(solver: solvers.LBFGS, start: float, outside: float) -> None:
    well = Well(outside)
    result = solver.minimise(well, np.full(2, start))
    assert well.beyond > 0
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.theta, 1e-3, rtol=1e-3)


@pytest.mark.parametrize("solver", [solvers.LBFGS(), solvers.QuasiNewton()])
def test_a_start_without_a_gradient_fails(solver: solvers.LBFGS) -> None:
    class Kink(Valley):
        def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
            return super().value(theta), np.full_like(theta, np.nan)

    assert solver.minimise(Kink(), START).status is Status.FAILED


def test_the_first_step_of_quasi_newton_is_the_gauss_newton_step() -> None:
    """On |theta|^2 / 2 with scales from 10 to 100: -(H + 0.003 diag H)^-1 g, in closed form."""
    scales = np.array([10.0, 30.0, 100.0])

    class Bowl(Valley):
        def residuals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return scales * theta, np.diag(scales)

    start = np.array([2.0, -1.0, 0.5])
    result = solvers.QuasiNewton(max_iterations=1).minimise(Bowl(), start)
    np.testing.assert_allclose(result.theta, start * (1 - 1 / 1.003), rtol=1e-9)
    assert solvers.QuasiNewton(tolerance=1e-12).minimise(Bowl(), start).iterations < 8
    assert solvers.LBFGS(tolerance=1e-12).minimise(Bowl(), start).iterations > 8


def test_matrices_are_renewed_after_the_descent_that_is_asked_for() -> None:
    """With 0.99, the 0.8 of the default would keep a matrix for longer."""

    class Counting(Valley):
        matrices = 0

        def curvature_estimate(self, theta: np.ndarray) -> list[np.ndarray]:
            self.matrices += 1
            return super().curvature_estimate(theta)

    counts = []
    for renewal in (1e-9, 0.8, 0.99):
        valley = Counting()
        result = solvers.QuasiNewton(tolerance=1e-9, renewal=renewal).minimise(valley, START)
        np.testing.assert_allclose(result.theta, 1.0, atol=1e-4)
        counts.append(valley.matrices)
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]
