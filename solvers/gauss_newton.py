"""Gauss-Newton with Levenberg-Marquardt damping, for losses with a normal matrix."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from orthocas.errors import InvalidValueError
from orthocas.solvers.protocol import RULES, BestPoint, LeastSquaresObjective, Objective, SolveResult, Status
from orthocas.tools.checks import Array, require_at_least, require_count
from orthocas.tools.progress import UNWATCHED, Watch


@dataclass(frozen=True)
class GaussNewton:
    """Levenberg-Marquardt: (H + mu diag H) step = -gradient; mu falls after a good step and rises after a bad one.

    The loss does not depend on the scale of each coordinate. Damping takes care of these flat directions.

    Args:
        max_iterations: largest number of accepted steps.
        tolerance: stop when two steps in a row reduce the loss by less than this fraction each.
    """

    max_iterations: int = 100
    tolerance: float = 1e-3
    name: str = "gauss_newton"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require_at_least("tolerance", self.tolerance, 0)

    def coarser(self) -> "GaussNewton":
        """The same solver with at most 10 iterations, which stops when two steps gain less than 0.5 % each."""
        return replace(self, max_iterations=min(10, self.max_iterations), tolerance=max(5e-3, self.tolerance))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0.

        Raises:
            InvalidValueError: if the objective has no normal equations because the parametrisation is not linear in
                theta.
        """
        if not isinstance(objective, LeastSquaresObjective):
            raise InvalidValueError(
                "solver", self.name, "lbfgs or adam for a parametrisation that is not linear in its parameters"
            )
        run = _Run(self, objective, theta0, watch)
        return run.best.run(run.iterate)


class _Run:
    """State of one minimisation."""

    def __init__(self, settings: GaussNewton, objective: LeastSquaresObjective, theta0: Array, watch: Watch) -> None:
        self.settings, self.objective = settings, objective
        self.best = BestPoint(objective, theta0, watch)
        self.damping = 1e-3
        # in the last step
        self._gained_little = False

    def iterate(self) -> Status:
        best = self.best
        while best.iterations < self.settings.max_iterations:
            before, gradient, H = self.objective.normal_equations(best.theta)
            best.evaluations += 1
            best.offer(best.theta, before)
            if not (np.isfinite(before) and np.isfinite(gradient).all() and np.isfinite(H).all()):
                return Status.FAILED
            damping = self.damping
            if not self._step(gradient, H):
                return Status.STALLED if np.any(gradient) else Status.CONVERGED
            # a step after rejections is short: a small gain is no convergence
            cautious = self.damping > damping
            little = not cautious and before - best.value <= self.settings.tolerance * before
            converged, self._gained_little = little and self._gained_little, little
            best.next_iteration(self.settings.max_iterations)
            if converged:
                return Status.CONVERGED
        return Status.ITERATION_LIMIT

    def _step(self, gradient: Array, H: Array) -> bool:
        """Try steps with growing damping until the loss falls, and return whether it fell."""
        diagonal = H.diagonal()
        # Levenberg and Marquardt: damping in proportion to the diagonal
        scale = np.maximum(diagonal, 1e-3 * diagonal.mean())
        for _ in range(RULES.most_rejections):
            damped = H.copy()
            damped[np.diag_indices_from(H)] += self.damping * scale
            try:
                candidate = self.best.theta - _solve(damped, gradient)
            except np.linalg.LinAlgError:
                self.damping *= 10
                continue
            # less damping after a success, more after a failure
            self.best.evaluations += 1
            if self.best.offer(candidate, self.objective.value(candidate)):
                self.damping = max(self.damping / 5, 1e-7)
                return True
            self.damping *= 4
        return False


def _solve(H: Array, gradient: Array) -> Array:
    """H^-1 gradient: by Cholesky, or by LU where rounding in single precision has left H indefinite."""
    try:
        return np.asarray(scipy.linalg.cho_solve(scipy.linalg.cho_factor(H), gradient), dtype=float)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.solve(H, gradient), dtype=float)
