"""phi and J as solvers of phi(q) = phi see them, with the scale of errors (ours)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array
from orthocas.coordinates.turns import shortest

ROUNDING = 1e-5  #: of phi: 1e-9 of it are 45 units in the last place
_SINGULAR = 1e-8  # ratio of singular values of J below which the inverse map fails


@dataclass(frozen=True)
class PhiMap:
    """phi at many points. Points are finite, values need not be."""

    phi: Callable[[Array], Array]  #: (N, n) -> (N, n)
    jacobian: Callable[[Array], Array]  #: (N, n) -> (N, n, n)
    sizes: Array  #: sizes of the components, (n,)
    turns: Array  #: periods of the components, (n,); 0 for those that have none

    def scale(self, targets: Array) -> Array:
        """Scale of errors (N, n): the sizes of the components, and more where rounding of phi exceeds them."""
        scale: Array = self.sizes + ROUNDING * np.abs(targets)
        return scale

    def residual(self, targets: Array, q: Array) -> Array:
        """(phi - phi(q)) / scale, (N, n), by the shorter way around for periodic components."""
        residual: Array = self.difference(targets, self.phi(q)) / self.scale(targets)
        return residual

    def difference(self, targets: Array, values: Array) -> Array:
        """Targets - values, (N, n), without whole turns of periodic components."""
        difference: Array = shortest(targets - values, self.turns)
        return difference

    def is_singular(self, q: Array) -> NDArray[np.bool_]:
        """Whether J is singular or undefined at points (N, n), (N,)."""
        J = self.jacobian(q) / self.sizes[:, None]
        known = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        J[~known] = 0.0
        values = np.linalg.svd(J, compute_uv=False)
        return np.asarray(~known | (values[:, -1] <= _SINGULAR * values[:, 0]))


def largest(residual: Array) -> Array:
    """The largest entries of residuals (N, n), (N,): infinite where phi is undefined."""
    error = np.abs(residual).max(axis=1)
    return np.where(np.isfinite(error), error, np.inf)
