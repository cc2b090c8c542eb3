"""Limited-memory BFGS (SciPy), for any parametrisation."""

import time
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from orthocas.checks import Array, require_count
from orthocas.errors import InvalidValueError
from orthocas.objective import Monitor, Objective, Progress, SolveResult, Status, silent


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS-B of SciPy without bounds.

    Args:
        max_iterations: largest number of iterations.
        tolerance: stop when an iteration lowers the loss by less than this share.
        memory: number of stored correction pairs.
    """

    max_iterations: int = 500
    tolerance: float = 1e-6
    memory: int = 20
    name: str = "lbfgs"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        if not self.tolerance >= 0:
            raise InvalidValueError("tolerance", self.tolerance, "a number >= 0")

    def coarser(self) -> "LBFGS":
        """A quarter of the iterations."""
        return replace(self, max_iterations=max(1, self.max_iterations // 4))

    def minimise(self, objective: Objective, theta0: Array, monitor: Monitor = silent, stage: str = "") -> SolveResult:
        """Minimise from theta0."""
        run = _Run(objective, theta0)

        def show(intermediate_result: scipy.optimize.OptimizeResult) -> None:
            run.iterations += 1
            monitor(Progress(stage, run.iterations / self.max_iterations, f"loss {run.value:.5g}"))

        options = {"maxiter": self.max_iterations, "maxfun": 2 * self.max_iterations, "ftol": self.tolerance}
        try:
            outcome = scipy.optimize.minimize(
                run.value_and_gradient,
                theta0,
                jac=True,
                method="L-BFGS-B",
                callback=show,
                options={**options, "maxcor": self.memory, "gtol": 0.0},
            )
            status = {0: Status.CONVERGED, 1: Status.ITERATION_LIMIT}.get(outcome.status, Status.STALLED)
        except KeyboardInterrupt:
            if not np.isfinite(run.value):  # nothing found yet
                raise
            status = Status.INTERRUPTED
        if not np.isfinite(run.value):
            status = Status.FAILED
        return SolveResult(
            run.theta, run.value, status, run.iterations, run.evaluations, time.perf_counter() - run.start
        )


class _Run:
    """Best point of one minimisation, kept through interrupts."""

    def __init__(self, objective: Objective, theta0: Array) -> None:
        self.objective = objective
        self.theta, self.value = np.array(theta0), np.inf
        self.iterations = self.evaluations = 0
        self.start = time.perf_counter()

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        value, gradient = self.objective.value_and_gradient(theta)
        self.evaluations += 1
        if value < self.value:
            self.theta, self.value = theta.copy(), value
        return value, gradient
