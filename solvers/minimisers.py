"""Minimisers in NumPy and SciPy: Gauss-Newton, L-BFGS, L-BFGS preconditioned by a Gauss-Newton matrix, and Adam."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat

import numpy as np
import scipy

from orthocas.errors import InvalidValueError, SolveError
from orthocas.solvers.protocol import (
    RULES,
    BestPoint,
    EstimatedObjective,
    LeastSquaresObjective,
    Objective,
    SampledObjective,
    SolveResult,
    Status,
)
from orthocas.tools.checks import Array, as_number, require_at_least, require_count, require_positive
from orthocas.tools.progress import UNWATCHED, Watch

_STATUS = {0: Status.CONVERGED, 1: Status.ITERATION_LIMIT}  # by the status of SciPy


@dataclass(frozen=True)
class GaussNewton:
    """Levenberg-Marquardt: steps (H + mu diag H) step = -gradient with the Gauss-Newton matrix H.

    The damping mu falls after a good step and rises after a bad one. It also regularises H, which is singular because
    the loss does not depend on the scale of each coordinate.

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

    def coarser(self) -> GaussNewton:
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
        best = BestPoint(objective, theta0, watch)
        return best.run(lambda: self._descend(best, objective))

    def _descend(self, best: BestPoint, objective: LeastSquaresObjective) -> Status:
        """Take damped steps until the loss falls no more; return how it ended."""
        damping, gained_little = 1e-3, False
        while best.iterations < self.max_iterations:
            before, gradient, H = objective.normal_equations(best.theta)
            best.evaluations += 1
            best.offer(best.theta, before)
            if not (np.isfinite(before) and np.isfinite(gradient).all() and np.isfinite(H).all()):
                return Status.FAILED
            next_damping = _step_down(best, gradient, H, damping)
            if next_damping is None:
                return Status.STALLED if np.any(gradient) else Status.CONVERGED
            # a small gain after rejected steps is no sign of convergence, because the step was short
            little = next_damping <= damping and before - best.value <= self.tolerance * before
            damping = next_damping
            converged, gained_little = little and gained_little, little
            best.next_iteration(self.max_iterations)
            if converged:
                return Status.CONVERGED
        return Status.ITERATION_LIMIT


def _step_down(best: BestPoint, gradient: Array, H: Array, damping: float) -> float | None:
    """Try steps with growing damping until the loss falls, and keep that point in `best`.

    Returns:
        The damping for the next step; None if no step lowers the loss.
    """
    # the damping is proportional to the diagonal of H (Marquardt)
    diagonal = H.diagonal()
    scale = np.maximum(diagonal, 1e-3 * diagonal.mean())
    for _ in range(RULES.most_rejections):
        damped = H.copy()
        damped[np.diag_indices_from(H)] += damping * scale
        try:
            try:
                step = scipy.linalg.cho_solve(scipy.linalg.cho_factor(damped), gradient)
            except np.linalg.LinAlgError:  # rounding in single precision may have made the matrix indefinite
                step = np.linalg.solve(damped, gradient)
        except np.linalg.LinAlgError:
            damping *= 10
            continue
        # a fifth of the damping after a success, four times as much after a failure
        candidate = best.theta - np.asarray(step, dtype=float)
        best.evaluations += 1
        if best.offer(candidate, best.objective.value(candidate)):
            return max(damping / 5, 1e-7)
        damping *= 4
    return None


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS ([NW2006] Alg. 7.5) with strong Wolfe steps: `scipy.optimize.minimize(method="L-BFGS-B")` without bounds.

    Args:
        max_iterations: largest number of iterations.
        tolerance: stop when an iteration reduces the loss by less than this fraction of it, or of 1 if that is more.
        memory: number of stored correction pairs.
    """

    max_iterations: int = 500
    tolerance: float = 1e-6
    memory: int = 20
    name: str = "lbfgs"

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require_count("memory", self.memory)
        require_at_least("tolerance", self.tolerance, 0)

    def coarser(self) -> LBFGS:
        """The same solver with a quarter of the iterations."""
        return replace(self, max_iterations=max(1, self.max_iterations // 4))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0."""
        best = BestPoint(objective, theta0, watch)
        return best.run(lambda: self._descend(best))

    def _descend(self, best: BestPoint) -> Status:
        """Minimise from the point in `best`; return how it ended."""
        value, gradient = best.value_and_gradient(best.theta)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            return Status.FAILED
        loss = _Finite(best, gradient)

        def count(_: Array) -> None:
            loss.next_iterate()
            best.next_iteration(self.max_iterations)

        return self._lbfgs(loss.value_and_gradient, best.theta, count, self.max_iterations, self.tolerance)

    def _lbfgs(
        self,
        value_and_gradient: Callable[[Array], tuple[float, Array]],
        start: Array,
        count: Callable[[Array], None],
        iterations: int,
        tolerance: float,
    ) -> Status:
        """Run SciPy's L-BFGS-B. `count` is called after each iteration, and may end the run by StopIteration."""
        options = {"maxiter": iterations, "maxfun": np.inf, "maxcor": self.memory, "ftol": tolerance, "gtol": 0.0}
        end = scipy.optimize.minimize(
            value_and_gradient, start, method="L-BFGS-B", jac=True, callback=count, options=options
        )
        return _STATUS.get(end.status, Status.STALLED)


@dataclass(frozen=True)
class QuasiNewton(LBFGS):
    """L-BFGS, preconditioned by a damped Gauss-Newton matrix H that is estimated from a part of the samples.

    The variables are z with theta = theta_k + L^-T z and L L^T = H(theta_k) + 0.003 diag H, so that the matrix is the
    identity in z. With many coefficients, only the diagonal blocks of H are used. For K coefficients and N samples, a
    matrix takes N K^2 operations, and a gradient N K. So one matrix and many gradients cost less than a few
    Gauss-Newton steps, and L-BFGS learns what the matrix misses. It restarts with a new matrix once the loss has fallen
    below `renewal` times its value at the last matrix.

    Args:
        max_iterations: largest number of iterations.
        tolerance: stop when two iterations in a row reduce the loss by less than this fraction each.
        memory: number of stored correction pairs.
        renewal: fraction of the loss at the last matrix below which a new matrix is computed.

    Source:
        ours; L-BFGS as in [NW2006] Alg. 7.5.
    """

    max_iterations: int = 200
    tolerance: float = 3e-4
    memory: int = 20
    renewal: float = 0.8
    name: str = "quasi_newton"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= as_number("renewal", self.renewal) < 1:
            raise InvalidValueError("renewal", self.renewal, "a number >= 0 and < 1")

    def coarser(self) -> QuasiNewton:
        """The same solver with at most 15 iterations, which stops when two steps gain less than 0.5 % each."""
        limit = min(15, self.max_iterations)
        return replace(self, max_iterations=limit, tolerance=max(5e-3, self.tolerance))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0.

        Raises:
            InvalidValueError: if the objective has no Gauss-Newton matrix because the parametrisation is not linear in
                theta.
            SolveError: if the matrix is not finite.
        """
        if not isinstance(objective, EstimatedObjective):
            raise InvalidValueError(
                "solver", self.name, "lbfgs or adam for a parametrisation that is not linear in its parameters"
            )
        return super().minimise(objective, theta0, watch)

    def _descend(self, best: BestPoint) -> Status:
        """Minimise with one matrix after the other; return how it ended."""
        while True:
            value, gradient = best.value_and_gradient(best.theta)
            if not (np.isfinite(value) and np.isfinite(gradient).all()):
                return Status.FAILED
            if not gradient.any():
                return Status.CONVERGED
            # compute a new matrix whenever the last one is out of date
            status = self._descend_with_matrix(best, gradient)
            if status is not None:
                return status

    def _descend_with_matrix(self, best: BestPoint, gradient: Array) -> Status | None:
        """Minimise in the variables z of the matrix at the best point.

        Returns:
            How it ended; None if the loss has fallen so far that a new matrix is worth its time.
        """
        assert isinstance(best.objective, EstimatedObjective)
        start, height, loss = best.theta, best.value, _Finite(best, gradient)
        factors = [_factor(block) for block in best.objective.curvature_estimate(start)]
        # SciPy's first step has length 1. Scale z so that this is the Gauss-Newton step.
        unit = np.linalg.norm(_solve(factors, gradient))
        factors = [factor / unit for factor in factors]
        value, gained_little, converged = height, False, False

        def value_and_gradient(z: Array) -> tuple[float, Array]:
            value, gradient = loss.value_and_gradient(start + _solve(factors, z, transposed=True))
            return value, _solve(factors, gradient)

        def count(_: Array) -> None:
            nonlocal value, gained_little, converged
            before, value = value, loss.next_iterate()
            little = before - value <= self.tolerance * before
            gained_little, converged = little, little and gained_little
            best.next_iteration(self.max_iterations)
            if converged or value < self.renewal * height:
                raise StopIteration

        left = self.max_iterations - best.iterations
        status = self._lbfgs(value_and_gradient, np.zeros_like(start), count, left, 0.0)
        if converged:
            return Status.CONVERGED
        if best.iterations == self.max_iterations:
            return Status.ITERATION_LIMIT
        return None if value < self.renewal * height else status


class _Finite:
    """The objective, with finite values everywhere, for SciPy.

    Where L is not finite, it is replaced by L_k + |g_k . (theta - theta_k)|, with the value L_k and the gradient g_k at
    the last iterate theta_k. SciPy's line search would give up at NaN and take infinity for convergence; from this rise
    it turns back.

    Args:
        best: evaluates the objective; holds theta_0 with its finite value.
        gradient: the gradient g_0 at theta_0.
    """

    def __init__(self, best: BestPoint, gradient: Array) -> None:
        self._best = best
        self._iterate = self._last = best.theta, best.value, gradient

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """L(theta) and its gradient (size,), always finite."""
        value, gradient = self._best.value_and_gradient(theta)
        if np.isfinite(value) and np.isfinite(gradient).all():
            self._last = np.array(theta), value, gradient
            return value, gradient
        start, lower, slope = self._iterate
        return lower + abs(float(slope @ (theta - start))), np.zeros_like(theta)

    def next_iterate(self) -> float:
        """Make the last finite point the next iterate theta_k; return its value."""
        self._iterate = self._last
        return self._last[1]


def _factor(H: Array) -> Array:
    """Cholesky factor L of a block H (K, K) with damping.

    The damping grows until the matrix is positive definite, which rounding in single precision may require.

    Raises:
        SolveError: if the matrix is not finite.
    """
    diagonal = H.diagonal()
    scale = np.maximum(diagonal, 1e-3 * diagonal.mean())
    damping = RULES.damping
    while True:
        # try again with more damping until the matrix is positive definite
        damped = H + np.diag(damping * scale)
        if not np.isfinite(damped).all():
            raise SolveError("the Gauss-Newton matrix of the loss is not finite: the parameters are too large")
        try:
            return np.asarray(np.linalg.cholesky(damped))
        except np.linalg.LinAlgError:
            damping *= 10


def _solve(factors: Sequence[Array], vector: Array, transposed: bool = False) -> Array:
    """L^-1 v, or L^-T v if `transposed`, for a vector v (size,) and the diagonal blocks `factors` of L."""
    ends = np.cumsum([len(factor) for factor in factors])
    parts = zip(factors, np.split(vector, ends[:-1]), strict=True)
    # no check for finite numbers here, because the loss reports them
    solve = partial(scipy.linalg.solve_triangular, trans=int(transposed), lower=True, check_finite=False)
    return np.concatenate([solve(factor, part) for factor, part in parts], dtype=float)


@dataclass(frozen=True)
class Adam:
    """Adam [KB2015]: steps along the mean gradient divided by the root of the mean squared gradient.

    Each step draws fresh samples; objectives without samples are used as a whole. After every epoch, the loss on the
    fixed samples is evaluated, and the best point so far is kept. The learning rate falls to zero along half a cosine,
    so that the last epochs are usually the best ones.

    Args:
        epochs: number of epochs; 200 in the paper.
        steps: steps per epoch; 50 in the paper.
        batch: fresh samples per step; 200 in the paper.
        learning_rate: learning rate of the first step (the paper does not state it).
    """

    epochs: int = 200
    steps: int = 50
    batch: int = 200
    learning_rate: float = 1e-3
    name: str = "adam"

    def __post_init__(self) -> None:
        for name in ("epochs", "steps", "batch"):
            require_count(name, getattr(self, name))
        require_positive("learning_rate", self.learning_rate)

    def coarser(self) -> Adam:
        """The same solver with a quarter of the epochs."""
        return replace(self, epochs=max(1, self.epochs // 4))

    def minimise(self, objective: Objective, theta0: Array, watch: Watch = UNWATCHED) -> SolveResult:
        """Minimise from theta0. A run of all planned epochs has the status ITERATION_LIMIT."""
        best = BestPoint(objective, theta0, watch)
        return best.run(lambda: self._descend(best))

    def _descend(self, best: BestPoint) -> Status:
        """Run the epochs; return how it ended."""
        objective, theta = best.objective, np.array(best.theta)
        mean, square = np.zeros_like(theta), np.zeros_like(theta)
        if not np.isfinite(best.evaluate(theta)):
            return Status.FAILED
        while best.iterations < self.epochs:
            # the objective of each step of an epoch: a batch of samples, or the whole
            parts: Iterable[Objective] = repeat(objective, self.steps)
            if isinstance(objective, SampledObjective):
                parts = objective.batches(self.batch, self.steps, (best.iterations,))
            for k, part in enumerate(parts, best.iterations * self.steps):
                gradient = part.value_and_gradient(theta)[1]
                best.evaluations += 1
                if not np.isfinite(gradient).all():
                    return Status.STALLED
                rate = self.learning_rate * 0.5 * (1 + np.cos(np.pi * k / (self.epochs * self.steps)))
                # update theta in parts that stay in the cache
                for start in range(0, len(gradient), RULES.part):
                    own = slice(start, start + RULES.part)
                    mean[own] += (1 - RULES.moment) * (gradient[own] - mean[own])
                    square[own] += (1 - RULES.square) * (gradient[own] ** 2 - square[own])
                    unbiased = np.sqrt(square[own] / (1 - RULES.square ** (k + 1))) + RULES.small
                    theta[own] -= rate / (1 - RULES.moment ** (k + 1)) * mean[own] / unbiased
            best.evaluate(theta)
            best.next_iteration(self.epochs)
        return Status.ITERATION_LIMIT
