"""Motions that keep the task value: ranges of the coordinates, curves along one coordinate, and self-motions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.charts.curve_tracer import ENDLESS, FOLD, SINGULAR, WALL, solutions_of
from orthocas.charts.newton import Newton, largest
from orthocas.charts.walls import Stop, Walls
from orthocas.errors import InvalidValueError, degrees_hint
from orthocas.robots.collisions import Collisions
from orthocas.tasks.domains import StopKind
from orthocas.tools.checks import Array, Indices, as_number, as_point, freeze_array, require_count
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import wrap_shortest

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart


@dataclass(frozen=True, slots=True)
class SelfMotionRules:
    """Numbers for following ranges and self-motions."""

    step: float = 0.4  #: longest step along a curve [rad] or [m]
    shortest: float = 1e-6  #: [rad] or [m] a curve that needs shorter steps ends
    missed: float = 0.08  #: largest correction of the longest step [rad] or [m]; in proportion for shorter steps
    sharpest: float = float(np.cos(0.35))  #: least cosine of the angle between the tangents at both ends of a step
    straight: float = 0.985  #: cosine of that angle above which the next step may be longer
    divided: float = 0.95  #: distance between points on a chord, relative to the required spacing along the curve
    at_once: int = 64  #: largest number of steps before they are divided and checked
    corrections: int = 8  #: largest number of Newton steps for a point
    settled: float = 1e-7  #: [rad] or [m] correction after which the next one is rounding
    same: float = 0.02  #: [rad] or [m] distance from the start at which the curve counts as closed
    longest: float = 1000.0  #: [rad] or [m] length after which a curve counts as endless
    rounding: float = 2e-12  #: [rad] or [m] tolerance of the place where a step crosses a boundary
    spacing: float = 0.1  #: [rad] or [m] largest distance between points on the curves of ranges
    phi_tolerance: float = 1e-10  #: largest error of phi, relative to `ChartParts.phi_sizes`
    farthest: float = 3.0  #: largest distance of a point from its neighbour, in lengths of the predicted step
    most: int = 4  #: largest number of points, as a multiple of the requested number


RULES = SelfMotionRules()


def xi_range(chart: Chart, q: ArrayLike, collisions: Collisions | None = None) -> XiRange:
    """Range of each coordinate with all else held; see `Chart.xi_range`."""
    start, intervals = start_inside(chart, q, collisions), []
    for k in range(chart.r):
        # follow the curve on which only this coordinate changes, in both directions
        down, up = (branch_along(chart, start, k, sign, collisions) for sign in (-1, 1))
        low, high = (float(counted_on(branch.xi, chart.parts.turns[chart.m :])[-1, k]) for branch in (down, up))
        ends = -np.inf if down.endless else low, np.inf if up.endless else high
        here = float(up.xi[0, k])
        intervals.append(Interval(chart.labels[chart.m + k], here, *ends, down.stop, up.stop))
    return XiRange(tuple(intervals), chart.parts.turn_shifts)


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


def start_inside(chart: Chart, q: ArrayLike, collisions: Collisions | None = None) -> Array:
    """Check a joint position (n,): inside the domain, with finite phi and J, and free of contacts; return it.

    Raises:
        ShapeError, InvalidValueError: if one of these does not hold.
    """
    point = as_point("q", q, chart.n)
    given = point.round(4).tolist()
    if not chart.problem.domain.contains(point):
        stop = Walls(chart.problem).worst(point)
        hint = degrees_hint(*point[~np.array(chart.problem.robot.tree.prismatic)])
        raise InvalidValueError("q", given, f"a point of the domain, which ends at {stop}{hint}")
    if not (np.isfinite(chart.phi(point)).all() and np.isfinite(chart.parts.batched_rates(point[None])).all()):
        raise InvalidValueError("q", given, "a point at which the chart is finite")
    # Inside the domain, a wall value <= 0 can only be that of a contact, or rounding at a boundary.
    if collisions is not None and (walls := Walls(chart.problem, collisions)).values(point).min() <= 0:
        stop = walls.worst(point)
        if stop.kind is StopKind.CONTACT:
            raise InvalidValueError("q", given, f"a posture without {stop}")
    return point


def _curve(chart: Chart, q: Array, step: float, collisions: Collisions | None) -> SelfMotionCurve:
    """The self-motion curve through q for r = 1, in both directions; xi rises along it at q."""
    down, up, place, points, arc_length = _follow_both(chart, q, 0, collisions, step, folds=False)
    # xi may turn back along the curve, so its least and largest values need not be at the ends
    xi = counted_on(np.concatenate([down.xi[:0:-1], up.xi]), chart.parts.turns[chart.m :])
    rises = np.sign(np.diff(xi[:, 0]))
    low, high = (down, up) if xi[0, 0] <= xi[-1, 0] else (up, down)
    least, most = (_find_extreme(chart, points, xi[:, 0], sign, up.endless, collisions) for sign in (-1, 1))
    ends = Interval(chart.labels[-1], float(xi[place, 0]), least, most, low.stop, high.stop)
    turns = int(np.count_nonzero(np.diff(rises[rises != 0])))
    return SelfMotionCurve(chart.x(q), points, xi, place, XiRange((ends,)), arc_length, up.endless, turns)


def _follow_both(
    chart: Chart, q: Array, k: int, collisions: Collisions | None, spacing: float, folds: bool
) -> tuple[Branch, Branch, int, Array, Array]:
    """Follow the curve of the k-th coordinate from q in both directions.

    Returns:
        The branches on which the coordinate falls and rises at q; then, of both joined: the row of q, the points
        (N, n), and their arc lengths (N,), which are 0 at q and negative before it.
    """
    up = branch_along(chart, q, k, 1, collisions, spacing, folds)
    # a closed curve is complete after one direction
    down = up.start if up.endless else branch_along(chart, q, k, -1, collisions, spacing, folds)
    points = np.concatenate([down.q[:0:-1], up.q])
    return down, up, len(down.q) - 1, points, np.concatenate([-down.arc_length[:0:-1], up.arc_length])


def _find_extreme(
    chart: Chart, points: Array, xi: Array, sign: int, closed: bool, collisions: Collisions | None
) -> float:
    """The largest xi (sign 1) or the least xi (sign -1) on a curve, including extremes between its points (N, n)."""
    values = sign * xi
    best = float(values.max())
    # An extreme may lie beside a point that is no lower than its neighbours. A closed curve repeats its first point.
    around = np.concatenate([values[-2:-1], values, values[1:2]] if closed else [[np.inf], values, [np.inf]])
    drops = np.minimum(values - around[:-2], values - around[2:]), np.maximum(values - around[:-2], values - around[2:])
    for k in np.flatnonzero(drops[0] >= 0).tolist():
        # A parabola through the three points rises above the middle one by at most an eighth of the larger drop.
        # Points that cannot exceed `best` even by the whole drop are skipped; from others, xi is followed to its turn.
        if values[k] + drops[1][k] >= best:
            ahead = counted_on(branch_along(chart, points[k], 0, sign, collisions).xi, chart.parts.turns[chart.m :])
            best = max(best, float(values[k] + sign * (ahead[-1, 0] - ahead[0, 0])))
    return sign * best


def _set(chart: Chart, q: Array, samples: int, collisions: Collisions | None) -> SelfMotion:
    """About `samples` points with the task value of q, for r > 1, on a lattice in xi that is filled from q outwards.

    The extent of each coordinate is measured from the outermost points of the lattice.
    """
    circles = [label for label, turn in zip(chart.labels, chart.parts.turns, strict=True) if turn > 0]
    if circles:
        came = f"one with circle-valued coordinates ({', '.join(circles)})"
        raise InvalidValueError("chart", came, "real-valued coordinates for self-motions with r > 1")
    # The lattice spacing is the range of each coordinate at q over the number of cells; 2 pi for endless coordinates.
    alone, cells = xi_range(chart, q, collisions), max(2, round(samples ** (1 / chart.r)))
    span = alone.high - alone.low
    spacing = np.where(np.isfinite(span) & (span > 0), span, 2 * np.pi) / cells
    known: dict[tuple[int, ...], Array] = {(0,) * chart.r: q}
    front, tried = list(known), set(known)
    start, phi_map = chart.phi(q), chart.parts.phi_map
    sign, newton = np.sign(np.linalg.det(phi_map.jacobian(q[None])[0])), Newton(phi_map)
    while front and len(known) < RULES.most * samples:
        # lattice neighbours of the points found in the last round that were not tried before
        pairs = []
        for origin, axis, move in product(front, range(chart.r), (-1, 1)):
            place = (*origin[:axis], origin[axis] + move, *origin[axis + 1 :])
            if place not in tried and abs(place[axis]) <= 2 * cells:
                tried.add(place)
                pairs.append((origin, place))
        if not pairs:
            break
        # solve for all of them by Newton's method, each from its neighbour
        targets, starts = np.tile(start, (len(pairs), 1)), np.array([known[origin] for origin, _ in pairs])
        targets[:, chart.m :] += np.array([place for _, place in pairs]) * spacing
        found, gap = newton(targets, starts), phi_map.difference(targets, phi_map.phi(starts))
        # A point that is far from its neighbour, or where det J has the other sign, lies on another branch: drop it.
        step = np.linalg.solve(phi_map.jacobian(starts), gap[..., None])[..., 0]
        near = np.linalg.norm(found.q - starts, axis=1) <= RULES.farthest * np.linalg.norm(step, axis=1) + 1e-9
        solved = (largest(found.residual) < RULES.phi_tolerance) & near & chart.problem.domain.contains(found.q)
        good = np.flatnonzero(solved)
        good = good[np.sign(np.linalg.det(phi_map.jacobian(found.q[good]))) == sign]
        good = good if collisions is None else good[collisions.check_free(found.q[good])]
        # the points found are the front of the next round
        front = [pairs[row][1] for row in good]
        known.update(zip(front, found.q[good], strict=True))
    points = np.array(list(known.values()))
    xi = chart.xi(points)
    # extent of each coordinate: follow it from the outermost points of the set to what stops it
    extent = list(alone)
    for k, own in enumerate(alone):
        if np.isfinite([own.low, own.high]).all():
            down = branch_along(chart, points[np.argmin(xi[:, k])], k, -1, collisions)
            up = branch_along(chart, points[np.argmax(xi[:, k])], k, 1, collisions)
            low, high = (float(branch.xi[-1, k]) for branch in (down, up))
            extent[k] = Interval(own.label, own.here, low, high, down.stop, up.stop)
    return SelfMotion(chart.x(q), points, xi, 0, XiRange(tuple(extent)))


def branch_along(
    chart: Chart,
    q: Array,
    k: int,
    direction: int,
    collisions: Collisions | None = None,
    spacing: float = RULES.spacing,
    folds: bool = True,
) -> Branch:
    """Follow the curve from q on which x and all coordinates but the k-th are constant.

    With r = 1, no collision model and a C compiler, the curve is followed in C, compiled at the first call for a chart.

    Args:
        chart: the chart.
        q: the start inside the domain, (n,).
        k: number of the coordinate that changes.
        direction: 1 if the coordinate rises from q, -1 if it falls.
        collisions: collision model; the curve ends at a contact.
        spacing: largest distance between points [rad] or [m].
        folds: whether the curve ends where the coordinate turns back.
    """
    kernel = chart.parts.motion_kernel if collisions is None else None
    way = None if kernel is None else kernel.follow(q, chart.phi(q)[: chart.m], direction, folds, spacing)
    if way is None:
        row = chart.m + k
        held, gradient = np.delete(np.arange(chart.n), row), direction * chart.parts.batched_rates(q[None])[0, row]

        def rise(points: Array, t: Array) -> Array:
            gradients = chart.coordinates.jacobian(points)[:, k]
            lengths = np.linalg.norm(gradients, axis=1)
            return np.asarray(direction * (gradients * t).sum(axis=1) / np.where(lengths > 0, lengths, 1.0))

        return LevelCurve(chart, held, spacing, collisions).follow(q, gradient, rise if folds else None)
    # The boundary that stops the curve is the one crossed at the point just beyond the end.
    points, xi, length, end, beyond = way
    if end == WALL:
        walls = Walls(chart.problem)
        stop = walls.stop(int(np.argmin(walls.values(beyond))), points[-1])
    else:
        stop = Stop({ENDLESS: StopKind.ENDLESS, SINGULAR: StopKind.SINGULAR, FOLD: StopKind.FOLD}[end])
    return Branch(points, length, stop, xi[:, None])


def counted_on(rows: Array, turns: Array) -> Array:
    """Unwrap periodic values along a curve, (N, k), by the shorter way from row to row.

    `turns` (k,) are the periods; 0 for values that are not periodic.
    """
    if not turns.any():
        return rows
    steps = wrap_shortest(np.diff(rows, axis=0), turns)
    return np.asarray(rows[0] + np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(steps, axis=0)]))


def too_far(chart: Chart, q: Array, wanted: Array) -> str:
    """Message about the coordinate whose target (r,) is farthest outside its range at q (n,).

    Empty if no target is outside, and for charts with periodic coordinates.
    """
    if chart.parts.turns.any():
        return ""
    # distance of each target from its range; name the farthest and what stops it
    reach = xi_range(chart, q)
    beyond = np.maximum(reach.low - wanted, wanted - reach.high)
    k = int(np.argmax(beyond))
    if beyond[k] <= 0:
        return ""
    interval = reach[k]
    stop = interval.low_stop if wanted[k] < interval.low else interval.high_stop
    told = f"at the last x it reaches [{interval.low:.4g}, {interval.high:.4g}], stopped by {stop}"
    return f"; {interval.label} = {wanted[k]:.4g} is asked for, {told}"


def fan_along(chart: Chart, q: Array, k: int) -> Fan:
    """The curve through q (n,) inside the domain on which only the k-th coordinate changes, as a `Fan`."""
    down, up, _, points, arc_length = _follow_both(chart, q, k, None, RULES.spacing, folds=True)
    xi = np.concatenate([down.xi[:0:-1], up.xi])[:, k]
    turn = getattr(chart.coordinates, "turn", 0.0)
    xi = np.unwrap(xi, period=turn) if turn else xi
    return Fan(chart.labels[chart.m + k], points, xi, arc_length, down.stop, up.stop)


@dataclass(frozen=True, eq=False)
class Branch:
    """A curve followed in one direction, from its start to what stops it."""

    q: Array  #: (N, n) joint positions, the start first
    arc_length: Array  #: (N,) from the start [rad] or [m]
    stop: Stop
    xi: Array  #: (N, r)

    @property
    def start(self) -> Branch:
        """The branch that consists of the start alone."""
        return Branch(self.q[:1], self.arc_length[:1], self.stop, self.xi[:1])

    @property
    def endless(self) -> bool:
        """Whether nothing stops the curve: it closes, up to full turns, or it is longer than `RULES.longest`."""
        return self.stop.kind is StopKind.ENDLESS


Signs = Callable[[Array, Array], Array]  #: q and tangents (N, n) -> numbers (N,), positive before a fold


class LevelCurve:
    """Follows curves within the domain of a chart on which n - 1 components of phi are constant.

    The unit tangent t spans the null space of the n - 1 held rows of J. A step of length h predicts

        q + h t + h^2 / 2 dt/ds    and corrects by dq, where    [J; t] dq = [e; 0],    [J; t] u = [0; 1].

    Here e is the error of the held components, and u / |u| is the new tangent. The step is halved if dq is long or the
    tangent turns far. Points between the ends of a step lie on a cubic, and are corrected by two more dq.

    Args:
        chart: the chart. If only task components are held, its coordinates are not evaluated.
        held: indices of the held components, (n - 1,).
        spacing: largest distance between points of the curve [rad] or [m].
        collisions: collision model; the curve ends at a contact.
    """

    def __init__(self, chart: Chart, held: Indices, spacing: float, collisions: Collisions | None = None) -> None:
        self.walls, self._spacing, self._chart, self._held = Walls(chart.problem, collisions), spacing, chart, held
        self._with_xi = bool((held >= chart.m).any())

    def follow(self, q: Array, direction: Array, signs: Signs | None = None) -> Branch:
        """Follow the curve from q (n,) until it leaves the domain, meets a fold, or returns to q.

        Args:
            q: the start, inside the domain.
            direction: (n,), not perpendicular to the curve; the curve starts to this side.
            signs: function whose sign changes at a fold; None: folds do not end the curve.
        """
        target = self._chart.phi(q)
        # the unit tangent at q, oriented along `direction`
        t = self._correct(target, q[None], direction[None])[1][0]
        if not np.isfinite(t).all():
            return Branch(q[None], np.zeros(1), Stop(StopKind.SINGULAR), self._chart.xi(q)[None])
        points, tangents, steps, stop = [q[None]], [t[None]], [(q, t)], None
        for new, onward, last in self._step_on(target, q, t):
            ended = last
            steps.append((new, onward))
            # Steps inside the box are collected, then divided into points and checked together, which is faster.
            if ended is None and len(steps) <= RULES.at_once and self.walls.box_has(new):
                continue
            ahead, turned = self._divide(target, *(np.array(part) for part in zip(*steps, strict=True)))
            # Grown charts may end between two steps: cut the points where values are no longer finite.
            if not (known := np.isfinite(ahead).all(axis=1) & np.isfinite(turned).all(axis=1)).all():
                ahead, turned, ended = *(part[: np.argmin(known)] for part in (ahead, turned)), Stop(StopKind.SINGULAR)
            ahead, turned, stop = self._find_end(target, ahead, turned, signs) or (ahead, turned, ended)
            points.append(ahead[1:])
            tangents.append(turned[1:])
            steps = [(new, onward)]
            if stop is not None:
                break
        assert stop is not None
        q, t = np.concatenate(points), np.concatenate(tangents)
        # arc length between points from the chord and the angle a between the tangents: chord (a / 2) / sin(a / 2)
        half = np.arccos(np.clip((t[:-1] * t[1:]).sum(axis=1), -1.0, 1.0)) / 2
        arcs = np.linalg.norm(np.diff(q, axis=0), axis=1) / np.sinc(half / np.pi)
        return Branch(q, np.concatenate([[0.0], np.cumsum(arcs)]), stop, self._chart.xi(q))

    def _step_on(self, target: Array, q: Array, t: Array) -> Iterator[tuple[Array, Array, Stop | None]]:
        """Yield long steps along the curve from q (n,) with tangent t, regardless of the domain.

        Yields:
            The point (n,), its unit tangent (n,), and None, or in the last step the Stop that ended the curve.
        """
        start, t_start, bend, h, length, count, stop = q, t, np.zeros(len(q)), RULES.step / 2, 0.0, 0, None
        while stop is None:
            # predict ahead and correct back to the curve; a step with a long correction or a sharp turn is halved
            ahead = q + h * t + h**2 / 2 * bend
            change, onward = (part[0] for part in self._correct(target, ahead[None], t[None]))
            missed, size = float(np.linalg.norm(change)), float(np.linalg.norm(ahead - q))
            good = missed < RULES.missed * min(1.0, size / RULES.step) and onward @ t > RULES.sharpest
            if good:
                # Converge fully: a remaining error would count as correction in the next step, however short that is.
                new, onward = self._settle(target, ahead + change, onward)
                good = np.isfinite(new).all()
            if not good:
                h /= 2
                if h < RULES.shortest:
                    yield q, t, Stop(StopKind.SINGULAR)
                    return
                continue
            # a step that passes the start, up to full turns, ends the curve there
            before, after = (self.walls.gap(point, start) for point in (q, new)) if count > 2 else (t_start, t_start)
            if before @ t_start < 0 <= after @ t_start and np.linalg.norm(after) <= 1.6 * RULES.step:
                passed = self._settle(target, new - (after @ t_start) * onward, onward)[0]
                if np.linalg.norm(self.walls.gap(passed, start)) < RULES.same:
                    new, onward, stop = start + (new - start - after), t_start, Stop(StopKind.ENDLESS)
            # curvature dt/ds and length of the next step
            length, count, turned = length + float(np.linalg.norm(new - q)), count + 1, float(onward @ t)
            bend = (onward - t) / h
            q, t, h = new, onward, min(1.6 * h, RULES.step) if turned > RULES.straight else h
            stop = Stop(StopKind.ENDLESS) if length > RULES.longest else stop
            yield q, t, stop

    def _correct(self, target: Array, q: Array, t: Array) -> tuple[Array, Array]:
        """Newton steps dq (N, n) from q (N, n) to the curve, perpendicular to t (N, n), and unit tangents along t."""
        if self._with_xi:
            # Grown charts refuse NaN, so points that have left the chart are not evaluated.
            if not (known := np.isfinite(q).all(axis=1)).all():
                both = np.full((2, *q.shape), np.nan)
                if known.any():
                    both[:, known] = self._correct(target, q[known], t[known])
                return both[0], both[1]
            phi_map, held = self._chart.parts.phi_map, self._held
            targets, n = np.broadcast_to(target, q.shape), q.shape[1]
            bordered, right = np.empty((len(q), n, n)), np.zeros((len(q), n, 2))
            bordered[:, :-1], bordered[:, -1] = (phi_map.jacobian(q) / phi_map.sizes[:, None])[:, held], t
            right[:, :-1, 0] = (phi_map.difference(targets, phi_map.phi(q)) / phi_map.sizes)[:, held]
            right[:, -1, 1] = 1.0
            change, onward = np.moveaxis(solutions_of(bordered, right), 2, 0)
        else:
            x = np.broadcast_to(target[: self._chart.m], (len(q), self._chart.m))
            change, onward = self._chart.parts.tracer.correct(x, q, t)
        return change, onward / np.maximum(np.linalg.norm(onward, axis=1, keepdims=True), 1e-300)

    def _divide(self, target: Array, q: Array, t: Array) -> tuple[Array, Array]:
        """Divide steps between points q (K, n) with tangents t (K, n); return all points and their tangents.

        Neighbouring points are at most about the spacing apart.
        """
        # u runs from 0 to 1 along each step, in as many parts as the spacing requires
        chords = np.linalg.norm(np.diff(q, axis=0), axis=1)
        parts = np.maximum(1, np.ceil(chords / (RULES.divided * self._spacing)).astype(int))
        step = np.repeat(np.arange(len(parts)), parts)
        u = (np.arange(len(step)) - np.repeat(np.cumsum(parts) - parts, parts))[:, None] / parts[step, None]
        h, bend = chords[step, None], 3 * u**2 - 2 * u**3
        points = (1 - bend) * q[step] + bend * q[step + 1]
        points += h * ((u - 2 * u**2 + u**3) * t[step] + (u**3 - u**2) * t[step + 1])
        along = (1 - u) * t[step] + u * t[step + 1]
        points, along = np.concatenate([points, q[-1:]]), np.concatenate([along, t[-1:]])
        # correct all points back to the curve
        for _ in range(2):
            change, along = self._correct(target, points, along)
            points = points + change
        return points, along

    def _find_end(self, target: Array, q: Array, t: Array, signs: Signs | None) -> tuple[Array, Array, Stop] | None:
        """Cut points q (K, n) with tangents t where the curve ends.

        Returns:
            The points and tangents up to the end, and what ends the curve; None if it goes on.
        """
        doubtful = ~self._chart.domain.contains(q[1:])
        if signs is not None:
            doubtful |= ~(signs(q[1:], t[1:]) >= 0)
        k = 0
        while k < len(q) - 1:
            # A step that may pass through a contact is halved, until its ends rule a contact out.
            if self.walls.may_touch(q[k], t[k], q[k + 1], t[k + 1]):
                ahead = q[k] + ((q[k + 1] - q[k]) @ t[k]) / 2 * t[k]
                middle, onward = self._settle(target, ahead, t[k])
                # If a half is not shorter than the step, the correction went astray: end the curve here.
                if not max(np.linalg.norm(middle - q[k]), np.linalg.norm(q[k + 1] - middle)) < np.linalg.norm(
                    q[k + 1] - q[k]
                ):
                    return q[: k + 1], t[: k + 1], Stop(StopKind.SINGULAR)
                q, t = np.insert(q, k + 1, middle, axis=0), np.insert(t, k + 1, onward, axis=0)
                doubtful = np.insert(doubtful, k, True)
                continue
            if (doubtful[k] or self.walls.solid) and self._margin(q[k + 1], t[k + 1], signs) < 0:
                point, onward, stop = self._end(target, q[k : k + 2], t[k], signs)
                return np.vstack([q[: k + 1], point]), np.vstack([t[: k + 1], onward]), stop
            k += 1
        return None

    def _margin(self, q: Array, t: Array, signs: Signs | None) -> float:
        """Least value of walls and fold at q (n,): positive before the end of the curve, else negative; -1 for NaN."""
        if not np.isfinite(q).all():
            return -1.0
        fold = np.inf if signs is None else float(signs(q[None], t[None])[0])
        margin = float(np.append(self.walls.values(q), fold).min())
        return -1.0 if np.isnan(margin) else margin

    def _end(self, target: Array, q: Array, t: Array, signs: Signs | None) -> tuple[Array, Array, Stop]:
        """Find the end of the curve between its points q (2, n): the last point inside the domain and before a fold.

        Points in between are parametrised by their distance s along the tangent t (n,) at the first one.

        Returns:
            The end (n,), its tangent (n,), and what ends the curve there.
        """
        h = float((q[1] - q[0]) @ t)

        def margin(s: float) -> float:
            return self._margin(*self._settle(target, q[0] + s * t, t), signs)

        # The end lies where the margin changes its sign, or at one of the two points.
        s = h if margin(h) >= 0 else 0.0
        if s == 0 and margin(0.0) > 0:
            s = scipy.optimize.brentq(margin, 0.0, h, xtol=RULES.rounding)
        point, onward = self._settle(target, q[0] + max(0.0, s - 2 * RULES.rounding) * t, t)
        # Evaluate what ends the curve just beyond the end, because a wall from `contains` alone is a step function.
        beyond, further = self._settle(target, q[0] + min(h, s + 2 * RULES.rounding) * t, t)
        if not np.isfinite(beyond).all():
            return point, onward, Stop(StopKind.SINGULAR)
        values = self.walls.values(beyond)
        if signs is not None and float(signs(beyond[None], further[None])[0]) < values.min():
            return point, onward, Stop(StopKind.FOLD)
        return point, onward, self.walls.stop(int(np.argmin(values)), point)

    def _settle(self, target: Array, q: Array, t: Array) -> tuple[Array, Array]:
        """Correct q (n,) perpendicular to t (n,) until it lies on the curve; return the point and its unit tangent."""
        for _ in range(RULES.corrections):
            change, onward = (part[0] for part in self._correct(target, q[None], t[None]))
            q = q + change
            if not np.abs(change).max() >= RULES.settled:
                break
        return q, onward


@dataclass(frozen=True, repr=False)
class Interval(Shown):
    """The values that one coordinate can reach, and what stops it at both ends."""

    label: str
    here: float  #: value at q
    low: float  #: -inf if nothing stops it
    high: float  #: inf if nothing stops it
    low_stop: Stop
    high_stop: Stop

    def facts(self) -> dict[str, str]:
        """The interval, and what stops the coordinate at both ends."""
        return {
            "range": f"{self.label} in [{self.low:.4g}, {self.high:.4g}], {self.here:.4g} now",
            "low": str(self.low_stop),
            "high": str(self.high_stop),
        }

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


@dataclass(frozen=True, repr=False)
class XiRange(Shown):
    """Range of each extra coordinate from a joint position, with x and the others held; see `Chart.xi_range`.

    `range["xi1"]` is the `Interval` of one coordinate. Iteration yields all of them.
    """

    intervals: tuple[Interval, ...]
    turn_shifts: Mapping[str, Array] = field(default_factory=dict)  #: by joint: what a full turn adds to xi, (r,)

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
        """The intervals, and what stops the coordinates at their ends."""
        return {
            "reach": f"of {listed(interval.label for interval in self.intervals)}, one at a time",
            **{
                interval.label: f"[{interval.low:.4g}, {interval.high:.4g}], "
                f"from {interval.low_stop.brief} to {interval.high_stop.brief}"
                for interval in self.intervals
            },
            **{f"a turn of {joint}": f"adds {number_list(shift)}" for joint, shift in self.turn_shifts.items()},
        }


@dataclass(frozen=True, eq=False)
class Fan:
    """The curve on which only one coordinate changes, from its lowest to its highest value."""

    label: str
    q: Array  #: (N, n) joint positions along the curve
    xi: Array  #: (N,) values of the coordinate
    arc_length: Array  #: (N,) [rad] or [m], 0 at the given joint position
    low_stop: Stop
    high_stop: Stop

    def places(self, count: int) -> Array:
        """`count` evenly spaced arc lengths from one end of the curve to the other, (count,) [rad] or [m]."""
        return np.linspace(self.arc_length[0], self.arc_length[-1], count)

    def spread(self, count: int) -> Array:
        """Joint positions at evenly spaced arc lengths, (count, n), interpolated between the points of the curve."""
        return np.column_stack([np.interp(self.places(count), self.arc_length, column) for column in self.q.T])


@dataclass(frozen=True, eq=False, repr=False)
class SelfMotion(Shown):
    """Joint positions with one task value; see `Chart.self_motion`."""

    x: Array  #: (m,) the task value
    q: Array  #: (N, n) joint positions [rad] or [m]
    xi: Array  #: (N, r) their coordinates
    start: int  #: row of the given joint position
    extent: XiRange  #: how far each coordinate reaches, and what stops it there

    def __post_init__(self) -> None:
        for name in ("x", "q", "xi"):
            object.__setattr__(self, name, freeze_array(name, getattr(self, name), getattr(self, name).shape))

    def facts(self) -> dict[str, str]:
        """Number of points, and the extent of each coordinate."""
        return {"self-motion": f"{len(self.q)} points", **_extents(self.extent)}


@dataclass(frozen=True, eq=False, repr=False)
class SelfMotionCurve(SelfMotion):
    """The self-motion of a chart with r = 1: a curve, with its points in order."""

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


def _extents(extent: XiRange) -> dict[str, str]:
    return {name: text for name, text in extent.facts().items() if name != "reach"}
