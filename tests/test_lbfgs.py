"""L-BFGS and its line search."""

import numpy as np
import pytest
import scipy.optimize

from orthocas import solvers
from orthocas.solvers.lbfgs import Trial, wolfe_step
from orthocas.solvers.protocol import Status


@pytest.mark.slow
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
