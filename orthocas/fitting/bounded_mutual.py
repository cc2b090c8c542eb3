"""The constrained form: minimise the task term at a bounded mutual term, a point on the Pareto front (ours)."""

import numpy as np

from orthocas.checks import Array
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.loss import Weights


class BoundedMutual:
    """Minimise the task term of (24) subject to a bound on the mutual term, and to a gauge condition.

    min  E[sum of task cosines^2] lambda1 / (2 m r)  (plus the regularity term, if there is one)
    s.t. E[mean of mutual cosines^2] <= bound^2  and  E|grad xi_j|^2 = 1 for every coordinate j.

    The scales of the coordinates change neither term. The gauge condition fixes them, so that the solution is an
    isolated point. Up to terms of third order, sqrt(E cos^2) is the root mean square deviation of mutual angles from
    a right angle [rad].

    Args:
        objective: the weighted loss on its samples. Its lambda2 is not used.
        bound: upper bound on the root mean square mutual cosine, > 0.

    Source:
        ours, docs/derivations.md#constrained-form.
    """

    def __init__(self, objective: BasisObjective, bound: float) -> None:
        weights, self._gram = objective.weights, objective.gram  # sampled once, and shared by the objectives below
        self._task = objective.reweighted(Weights(weights.task, 0.0, weights.regularity, angles=weights.angles))
        only_mutual = Weights(0.0, 2.0, 0.0, angles=weights.angles)  # 2 cancels the factor 1/2 of the loss
        self._mutual = objective.reweighted(only_mutual)
        self._r, self._K, self._bound = objective.r, objective.K, bound

    def value(self, theta: Array) -> float:
        """Task term (and regularity term)."""
        return self._task.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Task term (and regularity term) and its gradient, (size,)."""
        return self._task.value_and_gradient(theta)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of `constraints`, (1 + r,) each."""
        ones = np.ones(self._r)
        return np.concatenate([[-np.inf], ones]), np.concatenate([[1.0], ones])

    def constraints(self, theta: Array) -> tuple[Array, Array]:
        """Mutual term over its bound, then the gauge of every coordinate, (1 + r,), and their Jacobian."""
        value, gradient = self._mutual.value_and_gradient(theta)
        C = theta.reshape(self._r, self._K)
        raised = C @ self._gram
        gauge = np.zeros((self._r, self._r, self._K))
        gauge[np.arange(self._r), np.arange(self._r)] = 2 * raised
        values = np.concatenate([[value / self._bound**2], (raised * C).sum(axis=1)])
        return values, np.vstack([gradient / self._bound**2, gauge.reshape(self._r, -1)])

    def lagrangian_hessian(self, theta: Array, factor: float, multipliers: Array) -> Array:
        """Hessian of factor L + multipliers . constraints, (size, size)."""
        H: Array = factor * self._task.hessian(theta) + multipliers[0] / self._bound**2 * self._mutual.hessian(theta)
        for j, multiplier in enumerate(multipliers[1:]):
            block = slice(j * self._K, (j + 1) * self._K)
            H[block, block] += 2 * multiplier * self._gram
        return H

    def in_gauge(self, theta: Array) -> Array:
        """The same coordinates with E|grad xi_j|^2 = 1."""
        C = theta.reshape(self._r, self._K)
        scaled: Array = C / np.sqrt(((C @ self._gram) * C).sum(axis=1))[:, None]
        return scaled.ravel()
