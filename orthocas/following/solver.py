"""Joint positions of a fitted chart close to others, on many rows at once, and what follows from them (ours)."""

from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import Batched
from orthocas.checks import Array
from orthocas.inverting.newton import Newton
from orthocas.inverting.phi_map import largest

if TYPE_CHECKING:
    from orthocas.chart import Chart

_ACCEPTED = 1e-10  # of phi, relative to `Chart.phi_sizes`


class Solver:
    """Solves phi(q) = phi near given joint positions, and evaluates derivatives of phi."""

    def __init__(self, chart: "Chart") -> None:
        self.chart = chart
        self._newton = Newton(chart.phi_map)
        q, v, w = (ca.MX.sym(name, chart.n) for name in ("q", "v", "w"))
        turning = ca.Function("turning", [q, v, w], [chart.function("second_derivative")(q, v, w)])
        self._turning = Batched(chart.runnable(turning))

    def jacobian(self, q: Array) -> Array:
        """J (N, n, n) at joint positions (N, n)."""
        return self.chart.phi_map.jacobian(q)

    def turning(self, q: Array, v: Array, w: Array) -> Array:
        """Second derivatives d2phi(q)[v, w], (N, n)."""
        return self._turning(q, v, w)[0]

    def solve(self, starts: Array, goals: Array) -> Array:
        """Solutions q (N, n) of phi(q) = goal near starts (N, n); NaN where Newton's method fails."""
        found = self._newton(goals, starts)
        return np.where((largest(found.residual) < _ACCEPTED)[:, None], found.q, np.nan)


def solved(J: Array, right: Array) -> Array:
    """J^-1 right for stacks (N, n, n) and (N, n); least squares where J is singular, NaN where it is not finite."""
    try:
        return np.asarray(np.linalg.solve(J, right[..., None])[..., 0], dtype=float)
    except np.linalg.LinAlgError:
        known = np.isfinite(J).all(axis=(1, 2))
        found = np.full_like(right, np.nan)
        found[known] = (np.linalg.pinv(J[known]) @ right[known][..., None])[..., 0]
        return found
