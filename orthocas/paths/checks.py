"""Whether joint positions along a path stay inside the domain and away from obstacles, and how far."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.charts.self_motion import Walls, xi_range
from orthocas.errors import InvalidValueError, PathError
from orthocas.paths.joint_curve import Lost
from orthocas.paths.joint_motion import Margins
from orthocas.paths.plan import Plan
from orthocas.robots.obstacles import LinkDistances
from orthocas.tasks.clear_box import row_scale
from orthocas.tasks.domains import bounds_of, contains, sample_uniform
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import BlockedFunction

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

_SAMPLES = 256  # of the domain, for the scale of the rows


@dataclass(frozen=True, eq=False)
class Limits:
    """What a motion has to keep."""

    chart: "Chart"
    velocity: Array  #: (n,) [rad/s] or [m/s]
    acceleration: Array  #: (n,) [rad/s^2] or [m/s^2]
    distances: LinkDistances
    clearance: float  #: smallest distance from obstacles to allow [m]

    @property
    def rows(self) -> ca.Function:
        """q (n, 1) -> the rows J (m, n) whose singular values measure the distance to singular positions."""
        clear, task = self.chart.problem.domain.singular_bound, self.chart.problem.task
        return task.frame_jacobian_function if clear is None else clear.jacobian_function

    @cached_property
    def scale(self) -> Array:
        """The scale of these rows, (m,); see `orthocas.ClearBox`."""
        domain = self.chart.problem.domain
        if domain.singular_bound is not None:
            return domain.singular_bound.scale
        J = self._rows_at(sample_uniform(domain, _SAMPLES, 0))
        return row_scale(J[np.isfinite(J).all(axis=(1, 2))], self.chart.problem.task.units)

    def scaled_rows(self, q: Array) -> Array:
        """D^-1 J at joint positions (P, n), (P, m, n)."""
        J: Array = self._rows_at(q) / self.scale[:, None]
        return J

    def _rows_at(self, q: Array) -> Array:
        J: Array = self._batched_rows(q)[0].reshape(-1, self.chart.m, self.chart.n)
        return J

    @cached_property
    def _batched_rows(self) -> BlockedFunction:
        return BlockedFunction(self.rows)

    def require_kept(self, plan: Plan, s: Array, q: Array) -> None:
        """Raise PathError at the first place (P,) whose joint position (P, n) is lost, outside, or at an obstacle."""
        known = np.flatnonzero(np.isfinite(q).all(axis=1))
        free = (self.distances(q[known]) >= self.clearance).all(axis=1)
        kept = known[contains(self.chart.problem.domain, q[known]) & free]
        if len(kept) < len(q):
            raise self._error(plan, s, q, int(np.setdiff1d(np.arange(len(q)), kept)[0]))

    def _error(self, plan: Plan, s: Array, q: Array, k: int) -> PathError:
        """What is wrong with the k-th joint position."""
        last = max(k - 1, 0)
        if not np.isfinite(q[k]).all():
            return self.lost(plan, Lost(s[:k], q[:k], float(s[k])))
        where = plan.explained(float(s[k]), self.chart.labels)
        if not contains(self.chart.problem.domain, q[k]):
            reason = f"it leaves the domain, stopped by {Walls(self.chart.problem).worst(q[k])}"
            return PathError(f"the path cannot be followed {where}: {reason}{self._reach(q[last])}")
        distance = self.distances(q[k])
        pair = self.distances.pairs[int(np.argmin(distance))]
        least = float(distance.min())
        gap = f"are {least:.3g} m apart" if least >= 0 else f"overlap by {-least:.3g} m"
        return PathError(
            f"the path cannot be followed {where}: {pair} {gap}, "
            f"expected a distance of at least clearance = {self.clearance:g} m"
        )

    def lost(self, plan: Plan, end: Lost) -> PathError:
        """The error for a path that ends before s = 1."""
        where = plan.explained(end.beyond, self.chart.labels)
        return PathError(
            f"the path cannot be reached {where}: no joint position near the one before it has this x and xi, "
            f"so x is out of reach or the chart is singular{self._reach(end.q[-1]) if len(end.q) else ''}"
        )

    def _reach(self, q: Array) -> str:
        """How far the coordinates reach at a joint position before the end, if it lies inside the domain."""
        try:
            reach = xi_range(self.chart, q)
        except InvalidValueError:
            return ""
        told = ", ".join(f"{part.label} in [{part.low:.4g}, {part.high:.4g}]" for part in reach)
        return f"; just before, the coordinates reach {told} one at a time"

    def margins(self, q: Array, dq: Array, ddq: Array) -> Margins:
        """What a motion leaves, at its time stamps."""
        low, high = bounds_of(self.chart.problem.domain)
        room = np.minimum(q - low, high - q) / self.chart.problem.domain.half_width
        worst = int(np.argmin(room.min(axis=0)))
        bounded = bool(np.isfinite(room).any())
        values = np.linalg.svd(self.scaled_rows(q), compute_uv=False)
        distances = self.distances(q)
        pair = int(np.argmin(distances.min(axis=0))) if distances.size else -1
        return Margins(
            float(room.min()),
            self.chart.problem.robot.joint_names[worst] if bounded else "",
            float((np.abs(dq) / self.velocity).max()),
            float((np.abs(ddq) / self.acceleration).max()),
            float(values[:, -1].min()),
            float(distances.min()) if distances.size else np.inf,
            self.distances.pairs[pair] if distances.size else "",
        )
