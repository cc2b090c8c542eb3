"""Curves in joint space along which all components of phi but one are constant (ours)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from orthocas.checks import Array, Indices
from orthocas.errors import SingularTaskError
from orthocas.reaching.stops import Stop, StopKind, Walls

if TYPE_CHECKING:
    from orthocas.chart import Chart

Signs = Callable[[Array, Array], float]  #: q and tangent -> a number that turns negative at a fold
_TOLERANCE = 1e-11  # largest error of the components that are held, relative to `Chart.phi_sizes`
_CORRECTIONS = 8
_SHARPEST = np.cos(0.35)  # of the angle between the tangents at both ends of a step
_SHORTEST = 1e-5  # share of the largest step below which there is no way on
_LONGEST = 1000.0  # length of a curve [rad] or [m] after which it counts as endless
_ROUNDING = 2e-12  # of the place of a border on a step


@dataclass(frozen=True, eq=False)
class Branch:
    """One direction of a curve, from its start to what stops it."""

    q: Array  #: (N, n) joint positions, the start first
    arc_length: Array  #: (N,) from the start [rad] or [m]
    stop: Stop

    @property
    def endless(self) -> bool:
        """Whether nothing stops it: the last point is the start, up to full turns, or the curve is very long."""
        return self.stop.kind is StopKind.ENDLESS


class LevelCurve:
    """The curve through q on which n - 1 components of phi are constant, within the domain of a chart.

    Its unit tangent t spans the null space of the held rows of J. Steps along t are corrected by Gauss-Newton steps of
    least norm. A step is halved until that converges and the tangent turns by less than 20 degrees.

    Args:
        chart: the chart. If only task components are held, its coordinates are not evaluated.
        held: indices of the held components, (n - 1,).
        step: length of the longest step [rad] or [m].
    """

    def __init__(self, chart: "Chart", held: Indices, step: float) -> None:
        self.walls, self._step = Walls(chart.problem), step
        functions: tuple[Callable[[Array], Array], ...] = (chart.phi, chart.jacobian)
        self._value, self._jacobian = functions if (held >= chart.m).any() else _of_task(chart)
        self._held, self._sizes = held, chart.phi_sizes[held]

    def follow(self, q: Array, direction: Array, signs: Signs | None = None) -> Branch:
        """Follow the curve from q (n,) until it leaves the domain, meets a fold, or returns to q.

        Args:
            q: the start, inside the domain.
            direction: (n,), not perpendicular to the curve.
            signs: tells folds; None: they do not end the curve.
        """
        t = self.tangent(q, direction)
        if t is None:
            return Branch(q[None], np.zeros(1), Stop(StopKind.SINGULAR))
        points, tangents, lengths, h = [q], [t], [0.0], self._step
        target, stop = self._levels(q), None
        while stop is None:
            found = self._stepped(points[-1], tangents[-1], h, target)
            if found is None:
                h /= 2
                stop = Stop(StopKind.SINGULAR) if h < _SHORTEST * self._step else None
                continue
            if self._margin(*found, signs) < 0:
                found, stop = self._end(points[-1], tangents[-1], h, target, signs)
            elif self._returns(points, found[0], tangents[0]):
                found = self._back_at_start(points[-1], tangents[-1], h, target, q, tangents[0])
                stop = Stop(StopKind.ENDLESS)
            lengths.append(lengths[-1] + _arc(points[-1], tangents[-1], *found))
            stop = Stop(StopKind.ENDLESS) if stop is None and lengths[-1] > _LONGEST else stop
            points.append(found[0])
            tangents.append(found[1])
            h = min(1.5 * h, self._step)
        return Branch(np.array(points), np.array(lengths), stop)

    def tangent(self, q: Array, along: Array) -> Array | None:
        """The unit tangent at q (n,) with a positive component along a direction; None where J is not finite."""
        J = self._rows(q)
        if J is None:
            return None
        t: Array = np.linalg.qr(J.T, mode="complete")[0][:, -1]
        return t if t @ along >= 0 else -t

    def _levels(self, q: Array) -> Array:
        return np.asarray(self._value(q)[self._held])

    def _rows(self, q: Array) -> Array | None:
        """The held rows of J, relative to the sizes of the components; None where they are not finite."""
        try:
            J = self._jacobian(q)[self._held] / self._sizes[:, None]
        except SingularTaskError:
            return None
        return J if np.isfinite(J).all() else None

    def _stepped(self, q: Array, t: Array, h: float, target: Array) -> tuple[Array, Array] | None:
        """The point a step ahead and the tangent there; None if the corrector fails or the curve turns too far."""
        new = q + h * t
        for _ in range(_CORRECTIONS):
            error = (self._levels(new) - target) / self._sizes
            J = self._rows(new)
            if J is None or not np.abs(error).max() < np.inf:
                return None
            change = np.linalg.lstsq(J, -error, rcond=None)[0]
            new = new + change
            if np.linalg.norm(new - q) > 2 * h + self._step / 10:
                return None
            if np.abs(error).max() < _TOLERANCE:
                onward = self.tangent(new, t)
                return None if onward is None or onward @ t < _SHARPEST else (new, onward)
        return None

    def _margin(self, q: Array, t: Array, signs: Signs | None) -> float:
        """Positive before the end of the curve, negative beyond it."""
        return float(min(self.walls.values(q).min(), np.inf if signs is None else signs(q, t)))

    def _end(
        self, q: Array, t: Array, h: float, target: Array, signs: Signs | None
    ) -> tuple[tuple[Array, Array], Stop]:
        """The last point within a step of length h that leaves the domain or passes a fold, and what it meets."""

        def margin(s: float) -> float:
            found = self._stepped(q, t, s, target)
            return -1.0 if found is None else self._margin(*found, signs)

        s = 0.0
        if self._margin(q, t, signs) > 0:
            s = max(0.0, scipy.optimize.brentq(margin, 0.0, h, xtol=_ROUNDING) - 2 * _ROUNDING)
        point, onward = self._stepped(q, t, s, target) or (q, t)
        values = self.walls.values(point)
        if signs is not None and signs(point, onward) < values.min():
            return (point, onward), Stop(StopKind.FOLD)
        return (point, onward), self.walls.stop(int(np.argmin(values)), point)

    def _returns(self, points: list[Array], new: Array, t_start: Array) -> bool:
        """Whether the last step has passed the start."""
        before, after = (self.walls.gap(q, points[0]) for q in (points[-1], new))
        near = np.linalg.norm(after) < 1.5 * self._step
        return bool(len(points) > 2 and near and before @ t_start < 0 <= after @ t_start)

    def _back_at_start(
        self, q: Array, t: Array, h: float, target: Array, start: Array, t_start: Array
    ) -> tuple[Array, Array]:
        """The point within a step of length h that is the start, up to full turns."""

        def ahead(s: float) -> float:
            point, _ = self._stepped(q, t, s, target) or (q, t)
            return float(self.walls.gap(point, start) @ t_start)

        return self._stepped(q, t, scipy.optimize.brentq(ahead, 0.0, h, xtol=_ROUNDING), target) or (q, t)


def _of_task(chart: "Chart") -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Task values and J_x at one joint position."""
    task = chart.problem.task
    return chart.task, lambda q: task.batched_jacobian(q[None])[0].reshape(chart.m, chart.n)


def _arc(q: Array, t: Array, new: Array, onward: Array) -> float:
    """Length of an arc from its chord and the angle a between its end tangents: chord (a / 2) / sin(a / 2)."""
    half = np.arccos(np.clip(t @ onward, -1.0, 1.0)) / 2
    return float(np.linalg.norm(new - q) / np.sinc(half / np.pi))
