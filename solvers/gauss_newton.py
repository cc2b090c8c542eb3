"""Gauss-Newton with Levenberg-Marquardt damping, for losses with a normal matrix."""

import time
from dataclasses import dataclass, replace

import numpy as np

from orthocas.checks import Array, require_count
from orthocas.errors import InvalidValueError
from orthocas.objective import LeastSquaresObjective, Monitor, Objective, Progress, SolveResult, Status, silent

_MAX_REJECTIONS = 10


@dataclass(frozen=True)
class GaussNewton:
    """Levenberg-Marquardt: (H + mu diag H) step = -gradient, mu down after a good step, up after a bad one.

    The scale of each coordinate does not change the loss; damping takes care of these flat directions.

    Args:
        max_iterations: largest number of accepted steps.
        tolerance: stop when a step lowers the loss by less than this share.
    """

    max_iterations: int = 100
    tolerance: float = 1e-3
    name: str = "gauss_newton"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        if not self.tolerance >= 0:
            raise InvalidValueError("tolerance", self.tolerance, "a number >= 0")

    def coarser(self) -> "GaussNewton":
        """At most 10 iterations, and done when a step gains less than half a per cent."""
        return replace(self, max_iterations=min(10, self.max_iterations), tolerance=max(5e-3, self.tolerance))

    def minimise(self, objective: Objective, theta0: Array, monitor: Monitor = silent, stage: str = "") -> SolveResult:
        """Minimise from theta0.

        Raises:
            InvalidValueError: if the objective has no normal equations (a parametrisation not linear in theta).
        """
        if not isinstance(objective, LeastSquaresObjective):
            raise InvalidValueError(
                "solver", self.name, "lbfgs for a parametrisation that is not linear in its parameters"
            )
        run = _Run(self, objective, theta0)
        try:
            status = run.iterate(monitor, stage)
        except KeyboardInterrupt:
            if not np.isfinite(run.value):  # nothing found yet
                raise
            status = Status.INTERRUPTED
        return run.result(status)


class _Run:
    """State of one minimisation."""

    def __init__(self, settings: GaussNewton, objective: LeastSquaresObjective, theta0: Array) -> None:
        self.settings, self.objective = settings, objective
        self.theta, self.value = theta0, np.inf
        self.damping = 1e-3
        self.iterations = self.evaluations = 0
        self.start = time.perf_counter()

    def iterate(self, monitor: Monitor, stage: str) -> Status:
        while self.iterations < self.settings.max_iterations:
            self.value, gradient, H = self.objective.normal_equations(self.theta)
            self.evaluations += 1
            if not np.isfinite(self.value):
                return Status.FAILED
            before, damping = self.value, self.damping
            if not self._step(gradient, H):
                return Status.STALLED if np.any(gradient) else Status.CONVERGED
            self.iterations += 1
            monitor(Progress(stage, self.iterations / self.settings.max_iterations, f"loss {self.value:.5g}"))
            cautious = self.damping > damping  # a step after rejections is short: its small gain says little
            if not cautious and before - self.value <= self.settings.tolerance * before:
                return Status.CONVERGED
        return Status.ITERATION_LIMIT

    def _step(self, gradient: Array, H: Array) -> bool:
        """Try steps with growing damping until the loss falls; whether it did."""
        diagonal = H.diagonal()
        scale = np.maximum(diagonal, 1e-3 * diagonal.mean())
        for _ in range(_MAX_REJECTIONS):
            damped = H.copy()
            damped[np.diag_indices_from(H)] += self.damping * scale
            try:
                candidate = self.theta - np.linalg.solve(damped, gradient)
            except np.linalg.LinAlgError:
                self.damping *= 10
                continue
            value = self.objective.value(candidate)
            self.evaluations += 1
            if value < self.value:
                self.theta, self.value = candidate, value
                self.damping = max(self.damping / 5, 1e-7)
                return True
            self.damping *= 4
        return False

    def result(self, status: Status) -> SolveResult:
        seconds = time.perf_counter() - self.start
        return SolveResult(self.theta, self.value, status, self.iterations, self.evaluations, seconds)
