"""Positions inside the domain with a given task value: with any xi, and for r > 1 with the nearest xi."""

from dataclasses import dataclass
from functools import reduce
from itertools import product

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.curve_tracer import CurveTracer, Traces, without_turns
from orthocas.charts.descent import RULES as DESCENT
from orthocas.charts.descent import BoxedPhi, descend
from orthocas.charts.newton import Starts, inverses, largest
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices


@dataclass(frozen=True, slots=True)
class SlideRules:
    """Numbers of `slide`. Joint changes are in half-widths, errors of x in component sizes.

    Chosen on pr2-left-wide, held on the other ready charts with r > 1 (benchmarks/round_trips.py).
    """

    most: int = 60  #: largest number of steps
    longest: float = 0.7  #: largest change of a joint in a step
    shortest: float = 1e-4  #: rows that need shorter steps end
    bent: float = 3e-3  #: error of x after a step up to which the step is accepted
    straight: float = 3e-4  #: error of x after a step up to which the next step may be longer
    corrected: float = 20.0  #: error of x, in units of `bent`, up to which a second step with the same J corrects it
    kept: float = 1e-10  #: error of x up to which q has the task value
    gains: float = 0.1  #: least decrease of |xi - xi(q)|^2 for acceptance, relative to the predicted decrease
    foreseen: float = 0.75  #: relative decrease above which the next step may be longer
    converged: float = 1e-10  #: predicted decrease, relative to |xi - xi(q)|^2, below which a point is a minimum
    rounded: float = 1e-22  #: squared distance in xi that is rounding
    least: float = 1e-14  #: decrease that is rounding, relative to 1 + |xi - xi(q)|^2
    still: float = 1e-13  #: change of joints that is rounding
    aligned: float = 0.95  #: least cosine between consecutive steps for the Barzilai-Borwein rule
    stretch: float = 10.0  #: largest factor by which that rule changes the length of a step
    penalty: float = 1e5  #: weight of squared violations of bounds, relative to the squared distance in xi
    rounds: int = 30  #: largest number of active sets that a projection tries
    room: float = 1e-9  #: margin to the conditions of the domain


SLIDE = SlideRules()


@dataclass(frozen=True, slots=True)
class InsideRules:
    """Numbers of `Inside`. Chosen on pr2-left-wide, held on other seeds and charts (benchmarks/round_trips.py).

    A slide is a run of `slide`: steps that keep x and approach xi.
    """

    starts: int = 8  #: `with_task`: stored positions near x from which rows restart
    near_phi: int = 2  #: slices: stored positions near each phi at which curves start
    near_x: int = 4  #: slices: stored positions near each x at which curves start
    places: tuple[float, ...] = (-1.0, -0.5, 0.0, 0.5, 1.0)  #: slices: values of the first held joint, in half-widths
    stride: int = 3  #: slices: every so many points of a curve inside the domain are used
    slack: float = 0.1  #: [rad] or [m] points of curves that far outside the box are moved to its face
    probes: int = 64  #: positions at which the influence of each joint on x is measured
    near: int = 2  #: stored positions near each phi at which short slides start
    short: int = 10  #: points on curves, per row, at which short slides start
    steps: int = 4  #: steps of short slides
    long: int = 4  #: long slides per row, from the best ends of short ones
    more: int = 8  #: steps of long slides
    settled: float = 1e-5  #: error of x up to which ends of long slides are compared by their distance in xi
    last: int = 1  #: slides per row that run until they converge, from the best ends of long ones
    again: int = 8  #: stored positions near phi, and as many near x, for rows without a point inside
    descent: int = 16  #: iterations of the descents to x from these
    most: int = 100  #: candidates per row, nearest to xi, from which starts of slides are chosen
    apart: float = 0.2  #: least distance between the chosen starts, in half-widths
    nearly: float = 1e-4  #: distance in xi below which a row counts as nearly solved, so that one start is enough
    rows: int = 1024  #: rows searched at once, to bound memory


RULES = InsideRules()


@dataclass(frozen=True, eq=False)
class Inside:
    """Finds points of the domain with a given task value."""

    boxed: BoxedPhi
    starts: Starts

    def with_task(self, targets: Array, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points of the box with the task values of targets (N, n), by descent from q (N, n) or stored positions.

        Returns:
            q (N, n), as near to the task values as the descents come, and whether they are met, (N,).
        """
        u, error = descend(self.boxed, targets, self.boxed.of_points(q), whole=False)
        left = np.flatnonzero(error > DESCENT.kept)
        if left.size:
            points = Points.of(self.starts.nearest(targets[left], RULES.starts, self.boxed.m), self.boxed, left)
            ends, errors = descend(self.boxed, targets[points.row], points.u, whole=False)
            # the best last, because the last assignment to a row stays
            farthest_first = np.argsort(-errors, kind="stable")
            better = farthest_first[errors[farthest_first] < error[points.row[farthest_first]]]
            u[points.row[better]], error[points.row[better]] = ends[better], errors[better]
        return self.boxed.points(u), np.asarray(error <= DESCENT.kept)

    def nearest(self, targets: Array, q: Array) -> tuple[Array, Array]:
        """Points of the domain with the task values of targets (N, n) and the nearest xi that is found.

        Slides, which keep x and approach xi, start at q (N, n), at stored positions and at points of slices.

        Returns:
            q (N, n), and |xi - xi(q)|, (N,), infinite where no point was found.
        """
        best, distance = q.copy(), np.full(len(q), np.inf)
        for first in range(0, len(q), RULES.rows):
            rows = slice(first, first + RULES.rows)
            best[rows], distance[rows] = self._nearest(targets[rows], q[rows])
        return best, distance

    def nearer(self, targets: Array, q: Array) -> Array:
        """Refine points q (N, n) of the domain: move along h(q) = x to a local minimum of |xi - xi(q)|, (N, n)."""
        end = slide(self.boxed, targets, self.boxed.of_points(q))
        good = np.isfinite(end.distance) & (end.error <= SLIDE.kept)
        return np.where(good[:, None], self.boxed.points(end.u), q)

    def _nearest(self, targets: Array, q: Array) -> tuple[Array, Array]:
        """`nearest` for few rows: short slides from many points, then long ones from the best of their ends."""
        N, n = q.shape
        near = np.concatenate([q[None], self.starts.nearest(targets, RULES.near, n)])
        ends = self._slid(targets, self._turned(targets, Points.of(near, self.boxed), q), RULES.steps)
        left, bare = np.flatnonzero(ends.best(N)[1] > RULES.nearly), np.zeros(0, dtype=np.int64)
        if left.size:
            # points of slices after the best full turns, ranked by how far the joints would have to move to reach xi
            points = self._slice(targets, q, left)
            points = self._turned(targets, points, q)
            J = self.boxed.phi_map.jacobian(self.boxed.points(points.u)) * self.boxed.domain.half_width
            with np.errstate(all="ignore"):
                reach = np.linalg.norm(inverses(J)[0][:, :, self.boxed.m :], axis=(1, 2))
            on_slices = Points(points.row, points.u, points.away * reach, np.zeros(len(points.row)))
            bare = np.setdiff1d(left, on_slices.row)
            starts = on_slices.apart(N, RULES.short).joined(self._again(targets, q, bare))
            ends = ends.joined(self._slid(targets, starts, RULES.steps))
        ends = self._to_end(targets, ends, N)
        lost = np.setdiff1d(np.flatnonzero(np.isinf(ends.best(N)[1])), bare)
        if lost.size:
            more = self._slid(targets, self._again(targets, q, lost), RULES.more)
            ends = ends.joined(self._to_end(targets, more, N))
        (place, distance), u = ends.best(N), self.boxed.of_points(q)
        found = np.isfinite(distance)
        u[found] = ends.u[place[found]]
        return self.boxed.points(u), distance

    def _to_end(self, targets: Array, ends: "Points", N: int) -> "Points":
        """Continue from the best ends: long slides, then converged ones; return the ends inside that have x."""
        ends = self._slid(targets, ends.apart(N, RULES.long), RULES.more)
        return ends.joined(self._slid(targets, ends.apart(N, RULES.last, RULES.settled), SLIDE.most)).kept()

    def _again(self, targets: Array, q: Array, left: Indices) -> "Points":
        """Starts for rows in which nothing was found: q, stored positions, and points with x to which these descend."""
        if not left.size:
            return Points.of(q[None, left], self.boxed)
        components = q.shape[1], self.boxed.m
        near = [self.starts.nearest(targets[left], RULES.again, count) for count in components]
        points = Points.of(np.concatenate([q[None, left], *near]), self.boxed, left)
        u, error = descend(self.boxed, targets[points.row], points.u, whole=False, most=RULES.descent)
        kept = (error <= DESCENT.kept) & self.boxed.domain.contains(self.boxed.points(u))
        return points.joined(Points(points.row[kept], u[kept], *np.zeros((2, kept.sum()))))

    def _slid(self, targets: Array, points: "Points", most: int) -> "Points":
        """The ends of slides of at most `most` steps from the given points."""
        end = slide(self.boxed, targets[points.row], points.u, most)
        return Points(points.row, end.u, end.distance, end.error)

    def _turned(self, targets: Array, points: "Points", q: Array) -> "Points":
        """Turn joints by full turns so that xi comes nearest to targets (N, n), within 1.5 turns of q (N, n)."""
        boxed = self.boxed
        # joints whose full turn adds the same to xi everywhere: all combinations of -1, 0, 1 turns (T, n), and what
        # they add, (T, r)
        winds, turn = boxed.winding & boxed.even, 2 * np.pi / boxed.domain.half_width
        turns = np.array(list(product(*((-1.0, 0.0, 1.0) if joint else (0.0,) for joint in winds))))
        shifts = turns @ np.where(winds[:, None], boxed.turned[0], 0.0)
        # first bring these joints within half a turn of q, then choose the best combination
        u = points.u - np.where(winds, turn * np.round((points.u - boxed.of_points(q)[points.row]) / turn), 0.0)
        away = np.linalg.norm(boxed.xi_gaps(targets[points.row], boxed.points(u))[:, None] - shifts, axis=2)
        return Points(points.row, u + turn * turns[np.argmin(away, axis=1)], away.min(axis=1), points.error)

    def _slice(self, targets: Array, own: Array, rows: Indices) -> "Points":
        """Points of the domain with x nearly as in some rows of targets (N, n), on slices.

        On a slice, r - 1 joints are held. Then the positions with a regular x form closed curves, as they do for r = 1.
        The held joints are those that move x least over their ranges. The first of them is held at five values across
        its range, the others at their values in stored positions near x. So the curves pass through most of the
        connected regions of positions with x.

        Joints that can turn by more than one turn are placed near `own` (N, n). Joints without boundaries whose turns
        change xi by different amounts are placed near the centre of the domain, and one turn to both sides of it.
        """
        domain, (low, high), turning = self.boxed.domain, self.boxed.domain.bounds, self._tracer.turning
        # joints without boundaries whose turns change xi unevenly: also try one turn to both sides
        uneven = turning & ~np.isfinite(low) & ~self.boxed.even
        several = ~uneven & ((domain.half_width > np.pi) | ~np.isfinite(low))
        turns = 2 * np.pi * np.array(list(product(*((-1, 0, 1) if more else (0,) for more in uneven))))
        found = [Points.of(own[:0, None], self.boxed)]
        with np.errstate(all="ignore"):
            for traces in self._curves(targets[rows]):
                # points of the curves, shifted by full turns near the row's position, then into the box
                curve, place = np.nonzero(np.arange(traces.q.shape[1]) < traces.count[:, None])
                row, q = rows[traces.row[curve] // len(RULES.places)], traces.q[curve, place]
                towards = np.where(several, own[row], domain.centre)
                q = towards + without_turns(q - towards, turning)
                back = (q < low - RULES.slack) * 1 - (q > high + RULES.slack) * 1
                q = turns[:, None] + q + np.where(turning, 2 * np.pi * back, 0.0)
                inside = np.asarray(((q >= low - RULES.slack) & (q <= high + RULES.slack)).all(axis=2))
                number = np.arange(inside.size).reshape(inside.shape)
                # keep every `stride`-th point inside, counted from where the curve enters the domain
                enters = inside & ~np.roll(inside, 1, axis=1)
                inside &= (number - np.maximum.accumulate(np.where(enters, number, 0), axis=1)) % RULES.stride == 0
                inside[inside] = domain.contains(np.clip(q[inside], low, high))
                found.append(Points.of(q[None, inside], self.boxed, np.broadcast_to(row, inside.shape)[inside]))
        return reduce(Points.joined, found)

    def _curves(self, targets: Array) -> list[Traces]:
        """Trace the curves of all slices. Slice k of the K slices of target j has the row number K j + k."""
        m, n, K = self.boxed.m, targets.shape[1], len(RULES.places)
        # starts: stored positions near each target, with the held joints moved onto each slice
        near = self.starts.nearest(targets, RULES.near_phi, n), self.starts.nearest(targets, RULES.near_x, m)
        start = np.repeat(np.concatenate(near).transpose(1, 0, 2), K, axis=0)
        held, domain = list(self._tracer.held), self.boxed.domain
        places = domain.centre[held[0]] + domain.half_width[held[0]] * np.array(RULES.places)
        start[:, :, held[0]] = np.tile(places, len(targets))[:, None]
        x = np.concatenate(
            [np.repeat(targets[:, :m], K, axis=0)[:, None].repeat(start.shape[1], axis=1), start[:, :, held]], axis=2
        )
        # move the starts to x, then trace curves until every start lies on one
        q, arrived = self._tracer.reach(x.reshape(-1, n - 1), start.reshape(-1, n))
        q, known, found = q.reshape(start.shape), ~arrived.reshape(start.shape[:2]), []
        away = self._tracer.away(q)
        while not known.all():
            left = np.flatnonzero(~known.all(axis=1))
            first = np.argmin(np.where(known[left], np.inf, away[left]), axis=1)
            found.append(self._tracer.trace(x[left, first], q[left, first], left))
            known[left, first] = True
            on = np.flatnonzero(~known[left].all(axis=1))
            known[left[on]] |= self._tracer.on_curves(q[left[on]], found[-1].part(on))
        return found

    @cached_property
    def _tracer(self) -> CurveTracer:
        """The curve tracer of slices; it holds the r - 1 joints that move x least over their ranges."""
        q = sample_uniform(self.boxed.domain, RULES.probes, 0)
        J = self.boxed.phi_map.jacobian(q)[:, : self.boxed.m] / self.boxed.phi_map.sizes[: self.boxed.m, None]
        reach = np.nanmean(np.linalg.norm(J, axis=1), axis=0) * self.boxed.domain.half_width
        return CurveTracer(self.boxed, tuple(int(j) for j in np.argsort(reach)[: q.shape[1] - self.boxed.m - 1]))


@dataclass(frozen=True, eq=False)
class Points:
    """P candidate points of the box, each for one row; a row may have many."""

    row: Indices  #: number of the row, (P,)
    u: Array  #: q in half-widths from the centre, (P, n)
    away: Array  #: |xi - xi(q)|, or another cost by which points are ranked, (P,); infinite outside the domain
    error: Array  #: largest error of x, (P,)

    @classmethod
    def of(cls, q: Array, boxed: BoxedPhi, rows: Indices | None = None) -> "Points":
        """Points from S positions for each of N rows, q (S, N, n). `rows` (N,) are the row numbers, default 0 to N - 1.

        `away` and `error` are not known yet: NaN.
        """
        row = np.tile(np.arange(q.shape[1]) if rows is None else rows, len(q))
        return cls(row, boxed.of_points(q.reshape(-1, q.shape[2])), *np.full((2, len(row)), np.nan))

    def part(self, which: NDArray[np.bool_] | Indices) -> "Points":
        """The selected points."""
        return Points(*(array[which] for array in vars(self).values()))

    def kept(self) -> "Points":
        """The points inside the domain that have x."""
        return self.part((self.error <= SLIDE.kept) & np.isfinite(self.away))

    def joined(self, other: "Points") -> "Points":
        """The points of both."""
        return Points(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))

    def best(self, N: int) -> tuple[Indices, Array]:
        """The best point of each of N rows among those with an error of x up to `SLIDE.bent`.

        Returns:
            Indices of the points, (N,), and their `away`, (N,); infinite for rows without such a point.
        """
        away = np.where(self.error <= SLIDE.bent, self.away, np.inf)
        order, distance = np.argsort(-away, kind="stable"), np.full(N, np.inf)
        place = np.zeros(N, dtype=np.int64)
        # nearest last, because the last assignment to a row stays
        place[self.row[order]], distance[self.row[order]] = order, away[order]
        return place, distance

    def apart(self, N: int, count: int, settled: float = SLIDE.bent) -> "Points":
        """Choose up to `count` of the best points of each of N rows, at least `RULES.apart` from one another.

        Points with errors of x up to `settled` come first; among them, those with the least `away`. A row that is
        nearly solved gets one point.
        """
        # sort the points of each row, and keep at most `RULES.most`
        order = np.lexsort((self.away, self.error > settled, self.row))
        order = order[np.isfinite(self.away[order])]
        if not order.size:
            return self.part(order)
        row = self.row[order]
        rank = np.arange(len(row)) - np.searchsorted(row, np.arange(N))[row]
        order, row, rank = (array[rank < RULES.most] for array in (order, row, rank))
        place = np.full((N, RULES.most), -1)
        place[row, rank] = order
        # take the best remaining point of each row, and drop the points near it
        u, left, chosen = self.u[place], place >= 0, [np.zeros(0, dtype=np.int64)]
        for _ in range(count):
            first = np.argmax(left, axis=1)
            rows = np.flatnonzero(left.any(axis=1))
            if not rows.size:
                break
            best = place[rows, first[rows]]
            chosen.append(best)
            left[rows] &= np.abs(u[rows] - self.u[best][:, None]).max(axis=2) >= RULES.apart
            # a nearly solved row needs no other point
            left[rows[(self.away[best] <= RULES.nearly) & (self.error[best] <= settled)]] = False
        return self.part(np.concatenate(chosen))


@dataclass(frozen=True, eq=False)
class Slide:
    """The points at which the slides of N rows ended."""

    u: Array  #: points of the box, (N, n)
    error: Array  #: largest error of x, (N,)
    distance: Array  #: |xi - xi(q)|, (N,); infinite outside the domain


def slide(boxed: BoxedPhi, targets: Array, start: Array, most: int = SLIDE.most) -> Slide:
    """Minimise |xi - xi(q)| subject to h(q) = x and q in the domain, from a start, for N targets at once.

    Let J^-1 = [P, B] with the columns P for x and B for xi. To first order, every step d = P (x - h(q)) + B z leads to
    x and changes xi by z. The step uses the z nearest to xi - xi(q) for which q + d lies in the domain, the projection
    of a point onto a polytope in r dimensions. A second step with the same J corrects the error of x. A step is
    accepted if the remaining error of x is small and the distance decreases about as predicted. Otherwise the next step
    is shorter.

    Args:
        boxed: phi and the domain.
        targets: values of phi, (N, n).
        start: points u of the box, (N, n); they need not have x.
        most: largest number of steps.

    Source:
        Sequential quadratic programming in coordinates where both equations are linear; ours.
    """
    with np.errstate(all="ignore"):
        run = _Run(boxed, targets, start)
        rows = np.flatnonzero(np.isfinite(run.gap).all(axis=1))
        # all rows at once; a row ends when its steps gain nothing
        for _ in range(most):
            if not rows.size:
                break
            rows = run.advance(rows)
        error, inside = largest(run.gap[:, : boxed.m]), boxed.domain.contains(boxed.points(run.u))
        return Slide(run.u, error, np.where(inside, np.linalg.norm(run.gap[:, boxed.m :], axis=1), np.inf))


class _Run:
    """The state of `slide` for all rows."""

    def __init__(self, boxed: BoxedPhi, targets: Array, start: Array) -> None:
        self._boxed, self._targets = boxed, targets
        self._sizes = np.concatenate([boxed.phi_map.sizes[: boxed.m], np.ones(start.shape[1] - boxed.m)])
        self.u = start.copy()
        self.gap = self._gaps(np.arange(len(start)), start)  #: phi - phi(q), x relative to sizes, (N, n)
        self._longest = np.full(len(start), SLIDE.longest)
        # the last z of each row, before and after it was stretched and cut
        self._before = np.zeros((len(start), 2, start.shape[1] - boxed.m))
        # active bounds of the last step: -1 low, 1 high, 0 inactive
        self._held = np.zeros(start.shape, dtype=np.int8)
        # whether a row has met a condition of the domain, so that its steps must respect it
        self._meets = np.zeros(len(start), dtype=bool)

    def advance(self, rows: Indices) -> Indices:
        """Try a step in the given rows; return the rows that are not finished."""
        boxed, m, gap, u = self._boxed, self._boxed.m, self.gap[rows], self.u[rows]
        J = boxed.phi_map.jacobian(boxed.points(u)) * boxed.domain.half_width / self._sizes[:, None]
        H = inverses(J)[0]
        # P moves x, and B moves xi along the self-motions
        P, B, left = H[:, :, :m], H[:, :, m:], gap[:, m:]
        longest, walls = self._longest[rows, None], self._walls(rows, u)
        back = _times(P, gap[:, :m])
        wanted = left * np.minimum(1.0, longest / _size(_times(B, left)))
        # the largest part of the desired change of xi that the boundaries allow, after the step back to x
        z, held = walls.project(B, back, wanted, self._held[rows])
        stretch, plain = self._stretches(rows, z), z
        # stretch steps that continue in the direction of the last one
        some = np.flatnonzero(stretch != 1)
        if some.size:
            z = z.copy()
            z[some] = walls.part(some).project(B[some], back[some], stretch[some, None] * z[some], held[some])[0]
        d = back + _times(B, z)
        # cut the step to the trust region, and correct the error of x once
        part = np.minimum(1.0, longest / _size(d))
        d, z = np.clip(part * d, boxed.low - u, boxed.high - u), part * z
        new, after = self._corrected(rows, u + d, P, B, walls.slopes, held)
        # accept if x stays near and |xi - xi(q)|^2 decreases about as the linear model predicts
        error, before = largest(after[:, :m]), largest(gap[:, :m])
        square = (left**2).sum(axis=1)
        promised = 2 * (left * z).sum(axis=1) - (z**2).sum(axis=1) / stretch
        gain, size = square - (after[:, m:] ** 2).sum(axis=1), np.abs(promised)
        good = (error < SLIDE.bent) | (error < 0.9 * before)
        good &= (
            (gain > promised - (1 - SLIDE.gains) * size - SLIDE.least * (1 + square))
            | (before > SLIDE.bent)
            | ((before > SLIDE.kept) & (error < before / 2))
        )
        # If the new point violates a condition of the domain, the row treats the condition as a bound from now on.
        inside = good.copy()
        inside[good] = boxed.domain.contains(boxed.points(new[good]))
        met = good & ~inside & ~self._meets[rows] & boxed.has_rooms
        self._meets[rows[met]] = True
        moved = rows[inside]
        self.u[moved], self.gap[moved] = new[inside], after[inside]
        self._held[rows] = held[:, : u.shape[1]]
        self._before[moved] = np.stack([plain, z], axis=1)[inside]
        # the trust region grows if the model was right
        foreseen = (error < SLIDE.straight) | (gain > promised - (1 - SLIDE.foreseen) * size)
        longer = np.where(foreseen, np.minimum(2 * longest[:, 0], SLIDE.longest), longest[:, 0])
        shorter = np.minimum(longest[:, 0], np.abs(d).max(axis=1)) / 3
        self._longest[rows] = np.where(inside, longer, np.where(met, longest[:, 0], shorter))
        # a row ends if its step predicts no further decrease, or moves no joint
        ended = (size <= SLIDE.converged * square + SLIDE.rounded) | (np.abs(d).max(axis=1) <= SLIDE.still)
        ended &= (before <= SLIDE.kept) & ~met
        return np.asarray(rows[~ended & (self._longest[rows] > SLIDE.shortest)])

    def _stretches(self, rows: Indices, z: Array) -> Array:
        """Factors (rows,) for the lengths of steps z (rows, r), by Barzilai and Borwein's rule.

        They account for curved boundaries. The factor is 1 unless the last step had nearly the same direction.
        """
        plain, taken = self._before[rows].swapaxes(0, 1)
        along, size = (taken * z).sum(axis=1), (taken**2).sum(axis=1)
        same = along > SLIDE.aligned * np.sqrt(size * (z**2).sum(axis=1))
        stretch = size / (taken * (plain - z)).sum(axis=1)
        good = same & (stretch > 0) & np.isfinite(stretch)
        return np.where(good, np.clip(stretch, 1 / SLIDE.stretch, SLIDE.stretch), 1.0)

    def _corrected(
        self, rows: Indices, new: Array, P: Array, B: Array, slopes: Array, held: NDArray[np.int8]
    ) -> tuple[Array, Array]:
        """Correct the error of x at new points (rows, n) by a second step with the same J that respects the boundaries.

        A correction counts only if it reduces the error of x. Conditions are curved, so they are evaluated again.

        Returns:
            The points u, and phi - phi(q) there, (rows, n) each.
        """
        m, boxed = self._boxed.m, self._boxed
        after = self._gaps(rows, new)
        error = largest(after[:, :m])
        # rows with a small error of x, and rows at a condition, take the second step
        some = np.flatnonzero(((error > SLIDE.kept) | self._meets[rows]) & (error < SLIDE.corrected * SLIDE.bent))
        if some.size:
            back, walls = _times(P[some], after[some, :m]), self._walls(rows[some], new[some], slopes[some])
            z, _ = walls.project(B[some], back, np.zeros((len(some), B.shape[2])), held[some])
            again = np.clip(new[some] + back + _times(B[some], z), boxed.low, boxed.high)
            gaps = self._gaps(rows[some], again)
            better = largest(gaps[:, :m]) < np.maximum(error[some], SLIDE.kept)
            new[some[better]], after[some[better]] = again[better], gaps[better]
        return new, after

    def _walls(self, rows: Indices, u: Array, slopes: Array | None = None) -> "Walls":
        """Bounds of steps from points u of some rows: the box and the linearised conditions of the domain.

        `slopes` are the gradients of the conditions; default: those at u.
        """
        boxed = self._boxed
        low, high = boxed.low - u, boxed.high - u
        # conditions bound only rows that have met one
        meets = np.flatnonzero(self._meets[rows])
        if not meets.size:
            return Walls(low, high, np.zeros((len(rows), 0, u.shape[1])))
        near = boxed.rooms(u[meets]) - SLIDE.room
        rooms = np.full((len(rows), near.shape[1]), np.inf)
        rooms[meets] = near
        if slopes is None:
            slopes = np.zeros((*rooms.shape, u.shape[1]))
            slopes[meets] = boxed.room_slopes(u[meets])
        return Walls(np.hstack([low, -rooms]), np.hstack([high, np.full_like(rooms, np.inf)]), slopes)

    def _gaps(self, rows: Indices, u: Array) -> Array:
        """phi - phi(q), (rows, n), with x relative to the component sizes."""
        gaps: Array = self._boxed.gaps(self._targets[rows], u) / self._sizes
        return gaps


@dataclass(frozen=True, eq=False)
class Walls:
    """Bounds of steps d of N rows: low <= (d, slopes d) <= high."""

    low: Array  #: (N, n + k)
    high: Array  #: (N, n + k)
    slopes: Array  #: of the conditions, (N, k, n)

    def part(self, rows: Indices) -> "Walls":
        """The bounds of some rows."""
        return Walls(self.low[rows], self.high[rows], self.slopes[rows])

    def project(self, B: Array, back: Array, wanted: Array, held: NDArray[np.int8]) -> tuple[Array, NDArray[np.int8]]:
        """The z (N, r) nearest to `wanted` for which d = back + B z respects the bounds, as far as any z does.

        `held` is a guess of the active bounds, for the first columns. The active bounds (N, n + k) are returned, too.
        """
        guess = np.zeros(self.low.shape, dtype=np.int8)
        shared = min(self.low.shape[1], held.shape[1])
        guess[:, :shared] = held[:, :shared]
        gone = np.concatenate([back, _times(self.slopes, back)], axis=1) if self.slopes.shape[1] else back
        whole = np.concatenate([B, self.slopes @ B], axis=1) if self.slopes.shape[1] else B
        return project(whole, self.low - gone, self.high - gone, wanted, guess)


def project(B: Array, low: Array, high: Array, wanted: Array, held: NDArray[np.int8]) -> tuple[Array, NDArray[np.int8]]:
    """The points z (N, r) of polytopes low <= B z <= high that are nearest to `wanted` (N, r).

    Violated bounds are penalised: each round solves with the bounds that the last z violated, until these no longer
    change. Two multiplier steps (augmented Lagrangian) then make z exact. If a polytope is empty, z violates its bounds
    as little as possible.

    Args:
        B: (N, k, r).
        low: (N, k).
        high: (N, k).
        wanted: (N, r).
        held: a guess of the active bounds: -1 low, 1 high, 0 inactive, (N, k).

    Returns:
        z, and the active bounds, (N, k).
    """
    z, held, left = wanted.copy(), held.copy(), np.arange(len(wanted))
    solve = np.flatnonzero(held.any(axis=1))
    for k in range(SLIDE.rounds):
        if solve.size:
            A, bounds, K = _penalised(B[solve], low[solve], high[solve], held[solve])
            pull = wanted[solve] + SLIDE.penalty * _times(A.transpose(0, 2, 1), bounds)
            z[solve] = np.linalg.solve(K, pull[:, :, None])[:, :, 0]
        values = _times(B[left], z[left])
        now = (values > high[left]) * 1 - (values < low[left]) * 1
        changes = now != held[left]
        # later change only the first bound in each round, so that the active set does not cycle
        if k >= SLIDE.rounds // 6:
            changes &= np.cumsum(changes, axis=1) == 1
        some = changes.any(axis=1)
        held[left[some]] = np.where(changes, now, held[left])[some]
        solve = left = left[some]
        if not left.size:
            break
    some = np.flatnonzero(held.any(axis=1))
    if some.size:
        A, bounds, K = _penalised(B[some], low[some], high[some], held[some])
        for _ in range(2):
            excess = SLIDE.penalty * _times(A.transpose(0, 2, 1), bounds - _times(A, z[some]))
            z[some] += np.linalg.solve(K, excess[:, :, None])[:, :, 0]
    return z, held


def _penalised(B: Array, low: Array, high: Array, held: NDArray[np.int8]) -> tuple[Array, Array, Array]:
    """Active rows A of B (N, k, r) and their bounds (N, k), both 0 for inactive ones, and I + penalty A^T A, (N, r, r).

    A small ridge keeps the last matrix positive definite in rounding.
    """
    A = B * (held != 0)[:, :, None]
    bounds = np.where(held > 0, high, np.where(held < 0, low, 0.0))
    K = SLIDE.penalty * (A.transpose(0, 2, 1) @ A)
    ridge = 1 + 1e-12 * np.trace(K, axis1=1, axis2=2)
    return A, bounds, K + ridge[:, None, None] * np.eye(B.shape[2])


def _times(matrices: Array, vectors: Array) -> Array:
    """Products (N, i) of matrices (N, i, j) and vectors (N, j)."""
    products: Array = (matrices @ vectors[:, :, None])[:, :, 0]
    return products


def _size(steps: Array) -> Array:
    """Largest change of a joint in steps (N, n), (N, 1); at least 1e-300."""
    return np.asarray(np.maximum(np.abs(steps).max(axis=1, keepdims=True), 1e-300))
