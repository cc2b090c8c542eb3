"""Self-motions: all joint positions with the same task value that can be reached inside the domain (ours)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_number, frozen_array, require_count
from orthocas.coordinates.turns import require_no_turns
from orthocas.errors import InvalidValueError
from orthocas.reaching.curves import Branch, LevelCurve
from orthocas.reaching.intervals import Interval, XiRange, branch_along, start_inside, xi_along, xi_range
from orthocas.reaching.lattice import filled
from orthocas.showing import Shown

if TYPE_CHECKING:
    from orthocas.chart import Chart


@dataclass(frozen=True, eq=False, repr=False)
class SelfMotion(Shown):
    """Joint positions with one task value; see `Chart.self_motion`."""

    x: Array  #: (m,) the task value
    q: Array  #: (N, n) joint positions [rad] or [m]
    xi: Array  #: (N, r) their coordinates
    start: int  #: row of the joint position that was given
    extent: XiRange  #: how far each coordinate reaches, and what stops it there

    def __post_init__(self) -> None:
        for name in ("x", "q", "xi"):
            object.__setattr__(self, name, frozen_array(name, getattr(self, name), getattr(self, name).shape))

    def facts(self) -> dict[str, str]:
        """Number of points, and the extent of each coordinate."""
        return {"self-motion": f"{len(self.q)} points", **_extents(self.extent)}


@dataclass(frozen=True, eq=False, repr=False)
class SelfMotionCurve(SelfMotion):
    """The self-motion of a chart with r = 1: a curve. Points are in order, `extent` is that of their coordinates."""

    arc_length: Array  #: (N,) along the curve [rad] or [m], 0 at the given joint position, negative before it
    closed: bool  #: whether the last point is the first one, up to full turns of unbounded joints
    folds: int  #: how often the coordinate turns back along the curve

    def __post_init__(self) -> None:
        SelfMotion.__post_init__(self)
        object.__setattr__(self, "arc_length", frozen_array("arc_length", self.arc_length, (len(self.q),)))

    def facts(self) -> dict[str, str]:
        """Length, folds, and what stops the curve."""
        folds = f", the coordinate turns back {self.folds} times" if self.folds else ""
        kind = "closed curve" if self.closed else "curve"
        length = self.arc_length[-1] - self.arc_length[0]
        return {
            "self-motion": f"{kind} of length {length:.4g}, {len(self.q)} points{folds}",
            **_extents(self.extent),
        }


def self_motion(chart: "Chart", q: ArrayLike, step: float = 0.05, samples: int = 1000) -> SelfMotion:
    """The self-motion through a joint position; see `Chart.self_motion`."""
    start = start_inside(chart, q)
    longest = as_number("step", step)
    if not 1e-4 <= longest <= 0.5:
        raise InvalidValueError("step", step, "a length from 1e-4 to 0.5 [rad] or [m]")
    require_count("samples", samples, least=2, most=10_000)
    return _curve(chart, start, longest) if chart.r == 1 else _set(chart, start, samples)


def _curve(chart: "Chart", q: Array, step: float) -> SelfMotionCurve:
    """Both directions of the curve; the coordinate rises at q."""
    curve = LevelCurve(chart, np.arange(chart.m), step)
    gradient = chart.jacobian(q)[chart.m]
    up = curve.follow(q, gradient)
    down = Branch(q[None], np.zeros(1), up.stop) if up.endless else curve.follow(q, -gradient)
    points = np.concatenate([down.q[:0:-1], up.q])
    xi = xi_along(chart, points)
    rises = np.sign(np.diff(xi[:, 0]))
    low, high = (down, up) if xi[0, 0] <= xi[-1, 0] else (up, down)
    place = len(down.q) - 1
    ends = Interval(chart.labels[-1], float(xi[place, 0]), xi.min(), xi.max(), low.stop, high.stop)
    return SelfMotionCurve(
        chart.task(q),
        points,
        xi,
        place,
        XiRange((ends,)),
        np.concatenate([-down.arc_length[:0:-1], up.arc_length]),
        up.endless,
        int(np.count_nonzero(np.diff(rises[rises != 0]))),
    )


def _set(chart: "Chart", q: Array, samples: int) -> SelfMotion:
    """Points on a lattice in xi, and the extent from its outermost points on."""
    require_no_turns(chart.labels, chart.turns, "a set of self-motions")
    alone = xi_range(chart, q)
    points = filled(chart, q, alone, samples)
    xi = chart.xi(points)
    widest = tuple(_widest(chart, points, xi, alone[k], k) for k in range(chart.r))
    return SelfMotion(chart.task(q), points, xi, 0, XiRange(widest))


def _widest(chart: "Chart", points: Array, xi: Array, alone: Interval, k: int) -> Interval:
    """The extent of one coordinate: from the outermost points of a set along the coordinate to what stops it."""
    if not np.isfinite([alone.low, alone.high]).all():
        return alone
    down = branch_along(chart, points[np.argmin(xi[:, k])], k, -1.0)
    up = branch_along(chart, points[np.argmax(xi[:, k])], k, 1.0)
    low, high = (float(chart.xi(branch.q[-1])[k]) for branch in (down, up))
    return Interval(alone.label, alone.here, low, high, down.stop, up.stop)


def _extents(extent: XiRange) -> dict[str, str]:
    return {name: text for name, text in extent.facts().items() if name != "reach"}
