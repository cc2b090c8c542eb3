"""What can move at a task value: ranges of the coordinates, curves, and self-motions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.charts.descent import RULES as DESCENT
from orthocas.charts.newton import Newton
from orthocas.charts.phi import counted_on, largest, require_no_turns
from orthocas.errors import InvalidValueError, degrees_hint
from orthocas.robots.collisions import Collisions
from orthocas.tasks.domains import StopKind, Wall
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array, Indices, as_number, as_point, freeze_array, require_count, require_kind
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import wrap_shortest

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart


@dataclass(frozen=True, slots=True)
class SelfMotionRules:
    """Numbers of ranges and self-motions."""

    at_limit: float = 1e-9  #: half-widths: boundaries closer to a joint limit are that limit
    tolerance: float = 1e-11  #: largest error of the components that are held, relative to `ChartParts.phi_sizes`
    corrections: int = 8  #: of a step
    sharpest: float = float(np.cos(0.35))  #: of the angle between the tangents at both ends of a step
    shortest: float = 1e-5  #: fraction of the largest step below which there is no way on
    longest: float = 1000.0  #: length of a curve [rad] or [m] after which it counts as endless
    rounding: float = 2e-12  #: of the place of a boundary on a step
    step: float = 0.1  #: [rad] or [m], of the widest step
    phi_tolerance: float = 1e-10  #: of phi, relative to `ChartParts.phi_sizes`
    farthest: float = 3.0  #: distance of a point from its neighbour, in lengths of the predicted step
    grazing: float = 1e-4  #: [rad] or [m]: shorter steps are not checked for contacts between their ends
    depth: float = 1e-4  #: [m] of contacts that may be passed between two steps
    most: int = 4  #: times as many points as wanted, at most


RULES = SelfMotionRules()


@dataclass(frozen=True)
class Stop:
    """What ends a motion, and where."""

    kind: StopKind
    joint: str = ""  #: name of the joint, for JOINT
    value: float = np.nan  #: position of that joint [rad] or [m], or what a condition of the domain bounds
    is_limit: bool = False  #: whether the boundary of the domain is the limit of the joint
    condition: str = ""  #: in one line, for conditions of the domain; the pair, for contacts

    def __str__(self) -> str:
        if self.kind is StopKind.JOINT:
            return f"joint '{self.joint}' at {self.value:.4g}{', its limit' if self.is_limit else ''}"
        if self.kind is StopKind.NEAR_SINGULAR:
            return f"the task near singular, with a relative singular value of {self.value:.3g}"
        if self.kind is StopKind.CONDITION:
            return f"the boundary of the domain ({self.condition})"
        if self.kind is StopKind.CONTACT:
            return f"a contact of {self.condition}"
        return {
            StopKind.FOLD: "a fold of the chart",
            StopKind.SINGULAR: "a singularity or the end of the chart",
            StopKind.ENDLESS: "nothing",
        }[self.kind]

    @property
    def brief(self) -> str:
        """The same in a few words."""
        if self.kind is StopKind.JOINT:
            return f"{self.joint} at {'its limit ' if self.is_limit else ''}{self.value:.4g}"
        return {
            StopKind.NEAR_SINGULAR: "the task near singular",
            StopKind.CONDITION: self.condition,
            StopKind.CONTACT: f"a contact of {self.condition}",
            StopKind.FOLD: "a fold",
            StopKind.SINGULAR: "a singularity",
            StopKind.ENDLESS: "no end",
        }[self.kind]


class Walls:
    """The boundaries of a problem's domain as functions that are positive inside.

    They are (q_i - low_i) and (high_i - q_i), divided by the half-width of the domain, for every joint; then what the
    domain itself names as its `walls`; then the distance to a contact, if there are solids to hit.
    """

    def __init__(self, problem: Problem, collisions: Collisions | None = None) -> None:
        domain = problem.domain
        self._domain, self._robot, self._collisions = domain, problem.robot, collisions
        self._low, self._high = domain.bounds
        self._curved = domain.walls
        if collisions is not None:
            require_kind("collisions", collisions, Collisions)
            collisions.require_for(problem.robot.tree)
            self._curved = (*domain.walls, Wall(StopKind.CONTACT, lambda q: float(collisions.distance(q).distance)))
        endless = np.isinf(self._low) & ~np.array(problem.robot.tree.prismatic)
        self.turning = endless  #: unbounded revolute joints, (n,): they are at the same place after a full turn

    def values(self, q: Array) -> Array:
        """All functions at one joint position (n,), positive inside; infinite for unbounded joints."""
        width = self._domain.half_width
        rooms = np.array([wall.room(q) for wall in self._curved])
        parts = [(q - self._low) / width, (self._high - q) / width, np.where(np.isfinite(rooms), rooms, -1.0)]
        return np.concatenate(parts)

    def stop(self, k: int, q: Array) -> Stop:
        """What the k-th function stands for, at q (n,)."""
        n = len(q)
        if k >= 2 * n:
            wall = self._curved[k - 2 * n]
            if wall.kind is StopKind.CONTACT and self._collisions is not None:
                first, second = self._collisions.distance(q).pair
                return Stop(wall.kind, condition=f"'{first}' and '{second}'")
            value = np.nan if wall.value is None else float(wall.value(q))
            return Stop(wall.kind, value=value, condition=wall.heading)
        i = k % n
        boundary, limit = (self._low, self._robot.lower) if k < n else (self._high, self._robot.upper)
        at_limit = bool(abs(boundary[i] - limit[i]) <= RULES.at_limit * self._domain.half_width[i])
        return Stop(StopKind.JOINT, self._robot.joint_names[i], float(boundary[i]), at_limit)

    def may_touch(self, q: Array, t: Array, new: Array, onward: Array) -> bool:
        """Whether a contact deeper than a tolerance may lie on an arc between joint positions (n,) with end tangents.

        An arc whose tangent turns by an angle a is no farther from its chord c than (c / 2) tan(a / 2).
        """
        chord = float(np.linalg.norm(new - q))
        if self._collisions is None or chord < RULES.grazing:
            return False
        bend = chord / 2 * float(np.tan(np.arccos(np.clip(t @ onward, 0.0, 1.0)) / 2))
        return self._collisions.find_contact(np.array([q, new]), -RULES.depth, bend) is not None

    def worst(self, q: Array) -> Stop:
        """The boundary that q (n,) has crossed farthest, or is nearest to."""
        return self.stop(int(np.argmin(self.values(q))), q)

    def gap(self, q: Array, start: Array) -> Array:
        """q - start (n,), up to full turns of unbounded revolute joints."""
        return np.asarray(wrap_shortest(q - start, 2 * np.pi * self.turning))


Signs = Callable[[Array, Array], float]  #: q and tangent -> a number that turns negative at a fold


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
        collisions: what the robot may hit; the curve ends at a contact.
    """

    def __init__(self, chart: Chart, held: Indices, step: float, collisions: Collisions | None = None) -> None:
        self.walls, self._step = Walls(chart.problem, collisions), step
        whole = bool((held >= chart.m).any())
        self._value, self._jacobian, self._difference = _of_phi(chart) if whole else _of_task(chart)
        self._held, self._sizes = held, chart.parts.phi_sizes[held]

    def follow(self, q: Array, direction: Array, signs: Signs | None = None) -> Branch:
        """Follow the curve from q (n,) until it leaves the domain, meets a fold, or returns to q.

        Args:
            q: the start, inside the domain.
            direction: (n,), not perpendicular to the curve.
            signs: sign of det J, to notice folds; None: they do not end the curve.
        """
        t = self.tangent(q, direction)
        if t is None:
            return Branch(q[None], np.zeros(1), Stop(StopKind.SINGULAR))
        points, tangents, lengths, h = [q], [t], [0.0], self._step
        target, stop = self._value(q), None
        while stop is None:
            found = self._stepped(points[-1], tangents[-1], h, target)
            if found is None:
                h /= 2
                stop = Stop(StopKind.SINGULAR) if h < RULES.shortest * self._step else None
                continue
            if self.walls.may_touch(points[-1], tangents[-1], *found):
                h /= 2
                continue
            if self._margin(*found, signs) < 0:
                found, stop = self._end(points[-1], tangents[-1], h, target, signs)
            elif self._returns(points, found[0], tangents[0]):
                found = self._back_at_start(points[-1], tangents[-1], h, target, q, tangents[0])
                stop = Stop(StopKind.ENDLESS)
            lengths.append(lengths[-1] + _arc(points[-1], tangents[-1], *found))
            stop = Stop(StopKind.ENDLESS) if stop is None and lengths[-1] > RULES.longest else stop
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

    def _rows(self, q: Array) -> Array | None:
        """The held rows of J, relative to the sizes of the components; None where they are not finite."""
        J = self._jacobian(q)[self._held] / self._sizes[:, None]
        return J if np.isfinite(J).all() else None

    def _stepped(self, q: Array, t: Array, h: float, target: Array) -> tuple[Array, Array] | None:
        """The point a step ahead and the tangent there; None if the corrector fails or the curve turns too far."""
        new = q + h * t
        for _ in range(RULES.corrections):
            error = -self._difference(target, self._value(new))[self._held] / self._sizes
            J = self._rows(new)
            if J is None or not np.abs(error).max() < np.inf:
                return None
            change = np.linalg.lstsq(J, -error, rcond=None)[0]
            new = new + change
            if np.linalg.norm(new - q) > 2 * h + self._step / 10:
                return None
            if np.abs(error).max() < RULES.tolerance:
                onward = self.tangent(new, t)
                return None if onward is None or onward @ t < RULES.sharpest else (new, onward)
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
            s = scipy.optimize.brentq(margin, 0.0, h, xtol=RULES.rounding)
        point, onward = self._stepped(q, t, max(0.0, s - 2 * RULES.rounding), target) or (q, t)
        # What ends the curve is told just beyond its end: a domain that only answers `contains` has no slope inside.
        beyond, further = self._stepped(q, t, min(h, s + 2 * RULES.rounding), target) or (point, onward)
        values = self.walls.values(beyond)
        if signs is not None and signs(beyond, further) < values.min():
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

        return self._stepped(q, t, scipy.optimize.brentq(ahead, 0.0, h, xtol=RULES.rounding), target) or (q, t)


Functions = tuple[Callable[[Array], Array], Callable[[Array], Array], Callable[[Array, Array], Array]]


def _of_phi(chart: Chart) -> Functions:
    """phi and its rates at one joint position, and differences of two values."""
    return chart.phi, lambda q: chart.parts.batched_rates(q[None])[0], chart.parts.phi_map.difference


def _of_task(chart: Chart) -> Functions:
    """The same of the task alone."""
    relative = chart.parts.relative
    return chart.task, lambda q: relative.batched_rates(q[None])[0].reshape(chart.m, chart.n), relative.difference


def _arc(q: Array, t: Array, new: Array, onward: Array) -> float:
    """Length of an arc from its chord and the angle a between its end tangents: chord (a / 2) / sin(a / 2)."""
    half = np.arccos(np.clip(t @ onward, -1.0, 1.0)) / 2
    return float(np.linalg.norm(new - q) / np.sinc(half / np.pi))


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
    turn_shifts: Mapping[str, Array] = field(default_factory=dict)  #: (r,) by joint, see `find_turn_shifts`

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
                f"from {interval.low_stop.brief} to {interval.high_stop.brief}"
                for interval in self.intervals
            },
            **{f"a turn of {joint}": f"adds {number_list(shift)}" for joint, shift in self.turn_shifts.items()},
        }


def xi_range(chart: Chart, q: ArrayLike, collisions: Collisions | None = None) -> XiRange:
    """How far each coordinate reaches alone; see `Chart.xi_range`."""
    start = start_inside(chart, q, collisions)
    return XiRange(tuple(_interval(chart, start, k, collisions) for k in range(chart.r)), find_turn_shifts(chart))


def find_turn_shifts(chart: Chart) -> dict[str, Array]:
    """What a full turn of a joint that turns without end adds to xi everywhere, (r,) by the joint's name.

    One posture then has many values of xi, these apart. Joints whose turns do not change xi are missing, and so are
    those whose turns change it by different amounts in different postures.
    """
    q, shifts = sample_uniform(chart.problem.domain, 8, 0), {}
    for k in chart.problem.turning:
        turned = chart.phi(q + 2 * np.pi * np.eye(chart.n)[k])
        shift = chart.parts.phi_map.difference(turned, chart.phi(q))[:, chart.m :]
        if np.abs(shift[0]).max() > DESCENT.same and np.ptp(shift, axis=0).max() < DESCENT.same:
            shifts[chart.problem.robot.joint_names[k]] = np.asarray(shift[0])
    return shifts


def too_far(chart: Chart, q: Array, wanted: Array) -> str:
    """The coordinate that is wanted (r,) farthest outside its range at q (n,), in words; empty if there is none."""
    if chart.parts.turns.any():
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


def start_inside(chart: Chart, q: ArrayLike, collisions: Collisions | None = None) -> Array:
    """One joint position (n,) inside the domain, where phi and J are finite and nothing touches.

    Raises:
        ShapeError, InvalidValueError: for anything else.
    """
    point = as_point("q", q, chart.n)
    given = point.round(4).tolist()
    if not chart.problem.domain.contains(point):
        stop = Walls(chart.problem).worst(point)
        hint = degrees_hint(*point[~np.array(chart.problem.robot.tree.prismatic)])
        raise InvalidValueError("q", given, f"a point of the domain, which ends at {stop}{hint}")
    if not (np.isfinite(chart.phi(point)).all() and np.isfinite(chart.parts.batched_rates(point[None])).all()):
        raise InvalidValueError("q", given, "a point at which the chart is finite")
    # Inside the domain only a contact can be beyond its wall.
    if collisions is not None and (walls := Walls(chart.problem, collisions)).values(point).min() <= 0:
        stop = walls.worst(point)
        if stop.kind is StopKind.CONTACT:
            raise InvalidValueError("q", given, f"a posture without {stop}")
    return point


def branch_along(chart: Chart, q: Array, k: int, sign: float, collisions: Collisions | None = None) -> Branch:
    """The curve from q (n,) on which x and all coordinates but the k-th stay, and that one rises (sign 1) or falls."""
    row = chart.m + k
    curve = LevelCurve(chart, np.delete(np.arange(chart.n), row), RULES.step, collisions)

    def rising(point: Array, t: Array) -> float:
        gradient = chart.coordinates.jacobian(point[None])[0, k]
        return float(sign * gradient @ t / (np.linalg.norm(gradient) or 1.0))

    return curve.follow(q, sign * chart.parts.batched_rates(q[None])[0, row], rising)


def xi_along(chart: Chart, points: Array) -> Array:
    """Coordinates (N, r) along a curve from its first point on, without the jumps of circle-valued ones."""
    return counted_on(chart.xi(points), chart.parts.turns[chart.m :])


def _interval(chart: Chart, q: Array, k: int, collisions: Collisions | None) -> Interval:
    down, up = (branch_along(chart, q, k, sign, collisions) for sign in (-1.0, 1.0))
    low, high = (float(xi_along(chart, branch.q)[-1, k]) for branch in (down, up))
    return Interval(
        chart.labels[chart.m + k],
        float(chart.xi(q)[k]),
        -np.inf if down.endless else low,
        np.inf if up.endless else high,
        down.stop,
        up.stop,
    )


@dataclass(frozen=True, eq=False)
class Fan:
    """The curve on which only one coordinate changes, from its lowest to its highest value."""

    label: str
    q: Array  #: (N, n) joint positions along the curve
    xi: Array  #: (N,) values of the coordinate
    arc_length: Array  #: (N,) [rad] or [m], 0 at the joint position that was given
    low_stop: Stop
    high_stop: Stop

    def places(self, count: int) -> Array:
        """Even distances along the curve, (count,), from one end to the other."""
        return np.linspace(self.arc_length[0], self.arc_length[-1], count)

    def spread(self, count: int) -> Array:
        """Joint positions at even distances along the curve, (count, n), by interpolation between its points."""
        return np.column_stack([np.interp(self.places(count), self.arc_length, column) for column in self.q.T])


def fan_along(chart: Chart, q: Array, k: int) -> Fan:
    """The fan of the k-th coordinate at a joint position (n,) inside the domain."""
    down, up = branch_along(chart, q, k, -1.0), branch_along(chart, q, k, 1.0)
    if down.endless:  # then one direction passes everything
        down = Branch(q[None], np.zeros(1), down.stop)
    points = np.concatenate([down.q[:0:-1], up.q])
    arc_length = np.concatenate([-down.arc_length[:0:-1], up.arc_length])
    xi = chart.xi(points)[:, k]
    turn = getattr(chart.coordinates, "turn", 0.0)
    xi = np.unwrap(xi, period=turn) if turn else xi
    return Fan(chart.labels[chart.m + k], points, xi, arc_length, down.stop, up.stop)


def filled(chart: Chart, q: Array, alone: XiRange, samples: int, collisions: Collisions | None = None) -> Array:
    """Joint positions (N, n) with the task value of q (n,), inside the domain and free, q first.

    Their coordinates lie on a lattice around xi(q). Its spacing divides the range of each coordinate alone so that
    about `samples` points result. The fill goes from point to neighbour, so that all points can be reached from q.
    """
    cells = max(2, round(samples ** (1 / chart.r)))
    spacing = _spans(alone) / cells
    known: dict[tuple[int, ...], Array] = {(0,) * chart.r: q}
    front, tried = list(known), set(known)
    start, sign = chart.phi(q), np.sign(np.linalg.det(chart.parts.batched_rates(q[None])[0]))
    while front and len(known) < RULES.most * samples:
        pairs = _neighbours(front, tried, cells)
        if not pairs:
            break
        places = np.array([place for _, place in pairs])
        targets = np.tile(start, (len(pairs), 1))
        targets[:, chart.m :] += places * spacing
        found, good = _solved(chart, np.array([known[origin] for origin, _ in pairs]), targets, float(sign))
        good = good if collisions is None else good[collisions.check_free(found[good])]
        front = [pairs[row][1] for row in good]
        known.update(zip(front, found[good], strict=True))
    return np.array(list(known.values()))


def _spans(alone: XiRange) -> Array:
    """The widths of the ranges; a full turn for endless coordinates."""
    span = alone.high - alone.low
    return np.where(np.isfinite(span) & (span > 0), span, 2 * np.pi)


def _neighbours(
    front: list[tuple[int, ...]], tried: set[tuple[int, ...]], cells: int
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Pairs of a point and a neighbour of it that was not tried before."""
    pairs = []
    for origin, axis, move in product(front, range(len(front[0])), (-1, 1)):
        place = (*origin[:axis], origin[axis] + move, *origin[axis + 1 :])
        if place not in tried and abs(place[axis]) <= 2 * cells:
            tried.add(place)
            pairs.append((origin, place))
    return pairs


def _solved(chart: Chart, starts: Array, targets: Array, sign: float) -> tuple[Array, Indices]:
    """Newton's method from all starts (N, n), and the rows where it found a point of the domain on the same sheet."""
    phi_map = chart.parts.phi_map
    found = Newton(phi_map)(targets, starts)
    step = np.linalg.solve(phi_map.jacobian(starts), phi_map.difference(targets, phi_map.phi(starts))[..., None])[
        ..., 0
    ]
    near = np.linalg.norm(found.q - starts, axis=1) <= RULES.farthest * np.linalg.norm(step, axis=1) + 1e-9
    rows = np.flatnonzero(
        (largest(found.residual) < RULES.phi_tolerance) & near & chart.problem.domain.contains(found.q)
    )
    same = np.sign(np.linalg.det(phi_map.jacobian(found.q[rows]))) == sign
    return found.q, np.asarray(rows[same], dtype=np.int64)


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
            object.__setattr__(self, name, freeze_array(name, getattr(self, name), getattr(self, name).shape))

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
        object.__setattr__(self, "arc_length", freeze_array("arc_length", self.arc_length, (len(self.q),)))

    def facts(self) -> dict[str, str]:
        """Length, folds, and what stops the curve."""
        folds = f", the coordinate turns back {self.folds} times" if self.folds else ""
        kind = "closed curve" if self.closed else "curve"
        length = self.arc_length[-1] - self.arc_length[0]
        return {
            "self-motion": f"{kind} of length {length:.4g}, {len(self.q)} points{folds}",
            **_extents(self.extent),
        }


def self_motion(
    chart: Chart, q: ArrayLike, step: float = 0.05, samples: int = 1000, collisions: Collisions | None = None
) -> SelfMotion:
    """The self-motion through a joint position; see `Chart.self_motion`."""
    start = start_inside(chart, q, collisions)
    longest = as_number("step", step)
    if not 1e-4 <= longest <= 0.5:
        raise InvalidValueError("step", step, "a length from 1e-4 to 0.5 [rad] or [m]")
    require_count("samples", samples, least=2, most=10_000)
    return _curve(chart, start, longest, collisions) if chart.r == 1 else _set(chart, start, samples, collisions)


def _curve(chart: Chart, q: Array, step: float, collisions: Collisions | None) -> SelfMotionCurve:
    """Both directions of the curve; the coordinate rises at q."""
    curve = LevelCurve(chart, np.arange(chart.m), step, collisions)
    gradient = chart.parts.batched_rates(q[None])[0, chart.m]
    up = curve.follow(q, gradient)
    down = Branch(q[None], np.zeros(1), up.stop) if up.endless else curve.follow(q, -gradient)
    points = np.concatenate([down.q[:0:-1], up.q])
    xi = xi_along(chart, points)
    rises = np.sign(np.diff(xi[:, 0]))
    low, high = (down, up) if xi[0, 0] <= xi[-1, 0] else (up, down)
    place = len(down.q) - 1
    ends = Interval(chart.labels[-1], float(xi[place, 0]), xi.min(), xi.max(), low.stop, high.stop)
    return SelfMotionCurve(
        chart.x(q),
        points,
        xi,
        place,
        XiRange((ends,)),
        np.concatenate([-down.arc_length[:0:-1], up.arc_length]),
        up.endless,
        int(np.count_nonzero(np.diff(rises[rises != 0]))),
    )


def _set(chart: Chart, q: Array, samples: int, collisions: Collisions | None) -> SelfMotion:
    """Points on a lattice in xi, and the extent from its outermost points on."""
    require_no_turns(chart.labels, chart.parts.turns, "a set of self-motions")
    alone = xi_range(chart, q, collisions)
    points = filled(chart, q, alone, samples, collisions)
    xi = chart.xi(points)
    widest = tuple(_widest(chart, points, xi, alone[k], k, collisions) for k in range(chart.r))
    return SelfMotion(chart.x(q), points, xi, 0, XiRange(widest))


def _widest(chart: Chart, points: Array, xi: Array, alone: Interval, k: int, collisions: Collisions | None) -> Interval:
    """The extent of one coordinate: from the outermost points of a set along the coordinate to what stops it."""
    if not np.isfinite([alone.low, alone.high]).all():
        return alone
    down = branch_along(chart, points[np.argmin(xi[:, k])], k, -1.0, collisions)
    up = branch_along(chart, points[np.argmax(xi[:, k])], k, 1.0, collisions)
    low, high = (float(chart.xi(branch.q[-1])[k]) for branch in (down, up))
    return Interval(alone.label, alone.here, low, high, down.stop, up.stop)


def _extents(extent: XiRange) -> dict[str, str]:
    return {name: text for name, text in extent.facts().items() if name != "reach"}
