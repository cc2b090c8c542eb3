"""How far each extra coordinate reaches while the task value and the other coordinates are held (ours)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_point
from orthocas.coordinates.turns import counted_on
from orthocas.domains import contains
from orthocas.errors import InvalidValueError
from orthocas.reaching.curves import Branch, LevelCurve
from orthocas.reaching.stops import Stop, Walls
from orthocas.showing import Shown, listed

if TYPE_CHECKING:
    from orthocas.chart import Chart

_STEP = 0.1  # [rad] or [m], of the widest step


@dataclass(frozen=True, repr=False)
class Interval(Shown):
    """The values of one coordinate that can be reached, and what stops it at both ends."""

    label: str
    here: float  #: value at q
    low: float  #: -inf if nothing stops it
    high: float  #: inf if nothing stops it
    low_stop: Stop
    high_stop: Stop

    def facts(self) -> dict[str, str]:
        """The interval, and what stops it."""
        return {
            "range": f"{self.label} in [{self.low:.4g}, {self.high:.4g}], {self.here:.4g} now",
            "low": str(self.low_stop),
            "high": str(self.high_stop),
        }

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


@dataclass(frozen=True, repr=False)
class XiRange(Shown):
    """How far every extra coordinate reaches alone from a joint position, others and x held; see `Chart.xi_range`.

    `range["xi1"]` is the `Interval` of one coordinate, and iteration gives all of them.
    """

    intervals: tuple[Interval, ...]

    def __getitem__(self, label: str | int) -> Interval:
        names = {interval.label: interval for interval in self.intervals}
        if isinstance(label, str) and label in names:
            return names[label]
        if isinstance(label, int) and -len(self.intervals) <= label < len(self.intervals):
            return self.intervals[label]
        raise InvalidValueError("label", repr(label)[:80], f"one of {', '.join(names)}")

    def __iter__(self) -> Iterator[Interval]:
        return iter(self.intervals)

    def __len__(self) -> int:
        return len(self.intervals)

    @property
    def low(self) -> Array:
        """Lowest values, (r,)."""
        return np.array([interval.low for interval in self.intervals])

    @property
    def high(self) -> Array:
        """Highest values, (r,)."""
        return np.array([interval.high for interval in self.intervals])

    def facts(self) -> dict[str, str]:
        """The intervals, and what stops them."""
        return {
            "reach": f"of {listed(interval.label for interval in self.intervals)}, one at a time",
            **{
                interval.label: f"[{interval.low:.4g}, {interval.high:.4g}], "
                f"stopped by {interval.low_stop} and by {interval.high_stop}"
                for interval in self.intervals
            },
        }


def xi_range(chart: "Chart", q: ArrayLike) -> XiRange:
    """How far each coordinate reaches alone; see `Chart.xi_range`."""
    start = start_inside(chart, q)
    return XiRange(tuple(_interval(chart, start, k) for k in range(chart.r)))


def too_far(chart: "Chart", q: Array, wanted: Array) -> str:
    """The coordinate that is wanted (r,) farthest outside its range at q (n,), in words; empty if there is none."""
    if chart.turns.any():
        return ""
    reach = xi_range(chart, q)
    beyond = np.maximum(reach.low - wanted, wanted - reach.high)
    k = int(np.argmax(beyond))
    if beyond[k] <= 0:
        return ""
    interval = reach[k]
    stop = interval.low_stop if wanted[k] < interval.low else interval.high_stop
    told = f"at the last x it reaches [{interval.low:.4g}, {interval.high:.4g}], stopped by {stop}"
    return f"; {interval.label} = {wanted[k]:.4g} is asked for, {told}"


def start_inside(chart: "Chart", q: ArrayLike) -> Array:
    """One joint position (n,) inside the domain, where phi and J are finite.

    Raises:
        ShapeError, InvalidValueError: for anything else.
    """
    point = as_point("q", q, chart.n)
    given = point.round(4).tolist()
    if not contains(chart.problem.domain, point):
        stop = Walls(chart.problem).worst(point)
        raise InvalidValueError("q", given, f"a point of the domain, which ends at {stop}")
    if not (np.isfinite(chart.phi(point)).all() and np.isfinite(chart.jacobian(point)).all()):
        raise InvalidValueError("q", given, "a point at which the chart is finite")
    return point


def branch_along(chart: "Chart", q: Array, k: int, sign: float) -> Branch:
    """The curve from q (n,) on which x and all coordinates but the k-th stay, and that one rises (sign 1) or falls."""
    row = chart.m + k
    curve = LevelCurve(chart, np.delete(np.arange(chart.n), row), _STEP)

    def rising(point: Array, t: Array) -> float:
        gradient = chart.coordinates.jacobian(point[None])[0, k]
        return float(sign * gradient @ t / (np.linalg.norm(gradient) or 1.0))

    return curve.follow(q, sign * chart.jacobian(q)[row], rising)


def xi_along(chart: "Chart", points: Array) -> Array:
    """Coordinates (N, r) along a curve from its first point on, without the jumps of circle-valued ones."""
    return counted_on(chart.xi(points), chart.turns[chart.m :])


def _interval(chart: "Chart", q: Array, k: int) -> Interval:
    down, up = branch_along(chart, q, k, -1.0), branch_along(chart, q, k, 1.0)
    low, high = (float(xi_along(chart, branch.q)[-1, k]) for branch in (down, up))
    return Interval(
        chart.labels[chart.m + k],
        float(chart.xi(q)[k]),
        -np.inf if down.endless else low,
        np.inf if up.endless else high,
        down.stop,
        up.stop,
    )
