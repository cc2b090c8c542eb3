"""Newton's method for phi(q) = phi on many rows at once, from starts that are close (ours)."""

from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import Batched
from orthocas.checks import Array

if TYPE_CHECKING:
    from orthocas.chart import Chart

EXACT = 1e-12  #: of phi, relative to `Chart.phi_sizes`
ROUGH = 1e-6  #: for positions on the way to others
_ACCEPTED = 1e-10  # where rounding stops Newton's method earlier
_ITERATIONS = 12


class Newton:
    """Solves for joint positions of a fitted chart."""

    def __init__(self, chart: "Chart") -> None:
        self.chart = chart
        q, v, w = (ca.MX.sym(name, chart.n) for name in ("q", "v", "w"))
        both = ca.Function("phi_and_jacobian", [q], [chart.function("phi")(q), chart.function("jacobian")(q)])
        self._both = Batched(chart.runnable(both))
        turning = ca.Function("turning", [q, v, w], [chart.function("second_derivative")(q, v, w)])
        self._turning = Batched(chart.runnable(turning))

    def phi_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """phi (N, n) and J (N, n, n) at joint positions (N, n)."""
        phi, J = self._both(q)
        return phi, J

    def turning(self, q: Array, v: Array, w: Array) -> Array:
        """Second derivatives d2phi(q)[v, w], (N, n)."""
        return self._turning(q, v, w)[0]

    def solve(self, starts: Array, goals: Array, tolerance: float = EXACT) -> Array:
        """Solutions q (N, n) of phi(q) = goal near starts (N, n); NaN where Newton's method fails."""
        q = starts.copy()
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                phi, J = self.phi_and_jacobian(q)
                error = goals - phi
                worst = np.abs(error / self.chart.phi_sizes).max(axis=1)
                if not (worst >= tolerance).any():
                    break
                q = q + _cut(solved(J, error))
        q[~(worst < max(tolerance, _ACCEPTED))] = np.nan
        return q


def solved(J: Array, right: Array) -> Array:
    """J^-1 right for stacks (N, n, n) and (N, n); least squares where J is singular, NaN where it is not finite."""
    try:
        return np.asarray(np.linalg.solve(J, right[..., None])[..., 0], dtype=float)
    except np.linalg.LinAlgError:
        known = np.isfinite(J).all(axis=(1, 2))
        found = np.full_like(right, np.nan)
        found[known] = (np.linalg.pinv(J[known]) @ right[known][..., None])[..., 0]
        return found


def _cut(change: Array) -> Array:
    """Steps (N, n) of at most half a radian."""
    length = np.linalg.norm(change, axis=1, keepdims=True)
    return np.asarray(change * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300)))
