"""Positions inside the domain that keep the task: with any xi, and, r > 1, with the nearest."""

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
    """Numbers of the steps. Joints count in half-widths, errors of x in sizes.

    Chosen on pr2-left-wide, held on the other ready charts with r > 1 (benchmarks/round_trips.py).
    """

    most: int = 60  #: steps
    longest: float = 0.7  #: change of a joint in a step
    shortest: float = 1e-4  #: rows that need shorter steps end
    bent: float = 3e-3  #: error of x after a step, up to which the step is taken
    straight: float = 3e-4  #: the same up to which the next step may be longer
    corrected: float = 20.0  #: times `bent`, up to which a second step with the same J corrects the error of x
    kept: float = 1e-10  #: error of x that counts as none
    gains: float = 0.1  #: least decrease of |xi - xi(q)|^2, relative to the promised one
    foreseen: float = 0.75  #: the same from which the next step may be longer
    converged: float = 1e-10  #: relative decrease that a minimum may still promise
    rounded: float = 1e-22  #: squared distance that is rounding
    least: float = 1e-14  #: decrease that is rounding, relative to 1 + |xi - xi(q)|^2
    still: float = 1e-13  #: change of joints that is rounding
    aligned: float = 0.95  #: cosine between steps from which their lengths tell how boundaries bend
    stretch: float = 10.0  #: most that steps get longer or shorter for that
    penalty: float = 1e5  #: of squared excess of bounds, relative to the squared distance in xi
    rounds: int = 30  #: guesses which bounds hold
    room: float = 1e-9  #: to the ends of the conditions of the domain


SLIDE = SlideRules()


@dataclass(frozen=True, slots=True)
class InsideRules:
    """Numbers of the search. Chosen on pr2-left-wide, held on other seeds and charts (benchmarks/round_trips.py)."""

    starts: int = 8  #: stored positions near x, where no q with x is known inside
    near_phi: int = 2  #: stored positions near each phi, from which curves are sought on each slice
    near_x: int = 4  #: the same near each x
    places: tuple[float, ...] = (-1.0, -0.5, 0.0, 0.5, 1.0)  #: of the first held joint on slices, in half-widths
    stride: int = 3  #: of the points inside on curves, those taken, from where a curve enters the domain
    slack: float = 0.1  #: [rad] or [m]: points of curves so far outside the box are moved to its face
    probes: int = 64  #: positions at which the speeds of joints are measured
    near: int = 2  #: stored positions near each phi from which slides start
    short: int = 10  #: points on curves from which slides start
    steps: int = 4  #: of these slides
    long: int = 4  #: longer slides from the best of these
    more: int = 8  #: steps of these slides
    settled: float = 1e-5  #: error of x up to which their ends are compared
    last: int = 1  #: slides to the end
    again: int = 8  #: stored positions near phi, and as many near x, for rows with nothing inside until then
    descent: int = 16  #: iterations to x from these
    most: int = 100  #: points nearest to xi, of which those are chosen
    apart: float = 0.2  #: their least distance from one another, in half-widths
    nearly: float = 1e-4  #: distance in xi after a short slide from which a long one most probably ends at a solution
    rows: int = 1024  #: whose points are held in memory


RULES = InsideRules()


@dataclass(frozen=True, eq=False)
class Inside:
    """Finds points of the domain that keep the task."""

    boxed: BoxedPhi
    starts: Starts

    def with_task(self, targets: Array, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points of the box with the task values of targets (N, n), or near them, from q (N, n) and other starts.

        Returns:
            q (N, n), and which of them have the task values, (N,).
        """
        u, error = descend(self.boxed, targets, self.boxed.of_points(q), whole=False)
        left = np.flatnonzero(error > DESCENT.kept)
        if left.size:
            points = Points.of(self.starts.nearest(targets[left], RULES.starts, self.boxed.m), self.boxed, left)
            ends, errors = descend(self.boxed, targets[points.row], points.u, whole=False)
            # what is written last stays
            farthest_first = np.argsort(-errors, kind="stable")
            better = farthest_first[errors[farthest_first] < error[points.row[farthest_first]]]
            u[points.row[better]], error[points.row[better]] = ends[better], errors[better]
        return self.boxed.points(u), np.asarray(error <= DESCENT.kept)

    def nearest(self, targets: Array, q: Array) -> tuple[Array, Array]:
        """Points of the domain with task values as in targets (N, n), and the nearest xi.

        They are the nearest of those that slides from q (N, n) and from points of slices find.

        Returns:
            q (N, n), and |xi - xi(q)|, (N,), infinite where none was found.
        """
        best, distance = q.copy(), np.full(len(q), np.inf)
        for first in range(0, len(q), RULES.rows):
            rows = slice(first, first + RULES.rows)
            best[rows], distance[rows] = self._nearest(targets[rows], q[rows])
        return best, distance

    def nearer(self, targets: Array, q: Array) -> Array:
        """Points of the domain as near to xi as those that steps from q (N, n), inside, lead to, (N, n)."""
        end = slide(self.boxed, targets, self.boxed.of_points(q))
        good = np.isfinite(end.distance) & (end.error <= SLIDE.kept)
        return np.where(good[:, None], self.boxed.points(end.u), q)

    def _nearest(self, targets: Array, q: Array) -> tuple[Array, Array]:
        """`nearest` for few rows: short slides from many points, long ones from the best of their ends."""
        N, n = q.shape
        near = np.concatenate([q[None], self.starts.nearest(targets, RULES.near, n)])
        ends = self._slid(targets, self._turned(targets, Points.of(near, self.boxed), q), RULES.steps)
        left, bare = np.flatnonzero(ends.best(N)[1] > RULES.nearly), np.zeros(0, dtype=np.int64)
        if left.size:
            # points after full turns, and about how far joints have to move from there to xi
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
        """Where long slides from the best of some ends, and slides to the end from the best of those, keep x."""
        ends = self._slid(targets, ends.apart(N, RULES.long), RULES.more)
        return ends.joined(self._slid(targets, ends.apart(N, RULES.last, RULES.settled), SLIDE.most)).kept()

    def _again(self, targets: Array, q: Array, left: Indices) -> "Points":
        """Stored positions for some rows, and points inside to which descents from these lead."""
        if not left.size:
            return Points.of(q[None, left], self.boxed)
        components = q.shape[1], self.boxed.m
        near = [self.starts.nearest(targets[left], RULES.again, count) for count in components]
        points = Points.of(np.concatenate([q[None, left], *near]), self.boxed, left)
        u, error = descend(self.boxed, targets[points.row], points.u, whole=False, most=RULES.descent)
        kept = (error <= DESCENT.kept) & self.boxed.domain.contains(self.boxed.points(u))
        return points.joined(Points(points.row[kept], u[kept], *np.zeros((2, kept.sum()))))

    def _slid(self, targets: Array, points: "Points", most: int) -> "Points":
        """Where slides from points end."""
        end = slide(self.boxed, targets[points.row], points.u, most)
        return Points(points.row, end.u, end.distance, end.error)

    def _turned(self, targets: Array, points: "Points", q: Array) -> "Points":
        """Points after the full turns near those of q (N, n) that bring xi nearest to targets (N, n)."""
        boxed = self.boxed
        # choices of turns (T, n) of joints whose turn adds the same to xi at all positions, and what they add, (T, r)
        winds, turn = boxed.winding & boxed.even, 2 * np.pi / boxed.domain.half_width
        turns = np.array(list(product(*((-1.0, 0.0, 1.0) if joint else (0.0,) for joint in winds))))
        shifts = turns @ np.where(winds[:, None], boxed.turned[0], 0.0)
        # u within half a turn of that of q, then turned by the best choice
        u = points.u - np.where(winds, turn * np.round((points.u - boxed.of_points(q)[points.row]) / turn), 0.0)
        away = np.linalg.norm(boxed.xi_gaps(targets[points.row], boxed.points(u))[:, None] - shifts, axis=2)
        return Points(points.row, u + turn * turns[np.argmin(away, axis=1)], away.min(axis=1), points.error)

    def _slice(self, targets: Array, own: Array, rows: Indices) -> "Points":
        """Points of the domain with x nearly as in some rows of targets (N, n), on curves.

        Where r - 1 joints are held, all positions of a regular x form closed curves, as they do for r = 1. The held
        joints are those that move x least over their ranges: the first of them at its boundaries and between, the
        others where stored positions near x have them. So the curves pass through most of the regions that positions
        with x form.

        Joints are turned towards given positions (N, n), where they can turn more than once; those without boundaries
        whose turns change xi unevenly towards the centre of the domain, and once more to both sides.
        """
        domain, (low, high), turning = self.boxed.domain, self.boxed.domain.bounds, self._tracer.turning
        # of endless joints whose turns change xi unevenly, the turns on both sides as well
        uneven = turning & ~np.isfinite(low) & ~self.boxed.even
        several = ~uneven & ((domain.half_width > np.pi) | ~np.isfinite(low))
        turns = 2 * np.pi * np.array(list(product(*((-1, 0, 1) if more else (0,) for more in uneven))))
        found = [Points.of(own[:0, None], self.boxed)]
        with np.errstate(all="ignore"):
            for traces in self._curves(targets[rows]):
                # points of the curves, moved by full turns next to where the row is, then into the box
                curve, place = np.nonzero(np.arange(traces.q.shape[1]) < traces.count[:, None])
                row, q = rows[traces.row[curve] // len(RULES.places)], traces.q[curve, place]
                towards = np.where(several, own[row], domain.centre)
                q = towards + without_turns(q - towards, turning)
                back = (q < low - RULES.slack) * 1 - (q > high + RULES.slack) * 1
                q = turns[:, None] + q + np.where(turning, 2 * np.pi * back, 0.0)
                inside = np.asarray(((q >= low - RULES.slack) & (q <= high + RULES.slack)).all(axis=2))
                number = np.arange(inside.size).reshape(inside.shape)
                # of points inside, every few from where a curve enters
                enters = inside & ~np.roll(inside, 1, axis=1)
                inside &= (number - np.maximum.accumulate(np.where(enters, number, 0), axis=1)) % RULES.stride == 0
                inside[inside] = domain.contains(np.clip(q[inside], low, high))
                found.append(Points.of(q[None, inside], self.boxed, np.broadcast_to(row, inside.shape)[inside]))
        return reduce(Points.joined, found)

    def _curves(self, targets: Array) -> list[Traces]:
        """Curves of all slices; number k of K of target j is row K j + k."""
        m, n, K = self.boxed.m, targets.shape[1], len(RULES.places)
        # stored positions near each target, put onto each slice
        near = self.starts.nearest(targets, RULES.near_phi, n), self.starts.nearest(targets, RULES.near_x, m)
        start = np.repeat(np.concatenate(near).transpose(1, 0, 2), K, axis=0)
        held, domain = list(self._tracer.held), self.boxed.domain
        places = domain.centre[held[0]] + domain.half_width[held[0]] * np.array(RULES.places)
        start[:, :, held[0]] = np.tile(places, len(targets))[:, None]
        x = np.concatenate(
            [np.repeat(targets[:, :m], K, axis=0)[:, None].repeat(start.shape[1], axis=1), start[:, :, held]], axis=2
        )
        # from there to x, and along the curves; starts on known curves are done
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
        """Traces the curves of slices."""
        q = sample_uniform(self.boxed.domain, RULES.probes, 0)
        J = self.boxed.phi_map.jacobian(q)[:, : self.boxed.m] / self.boxed.phi_map.sizes[: self.boxed.m, None]
        reach = np.nanmean(np.linalg.norm(J, axis=1), axis=0) * self.boxed.domain.half_width
        return CurveTracer(self.boxed, tuple(int(j) for j in np.argsort(reach)[: q.shape[1] - self.boxed.m - 1]))


@dataclass(frozen=True, eq=False)
class Points:
    """P points of the box, of any rows."""

    row: Indices  #: (P,)
    u: Array  #: (P, n)
    away: Array  #: |xi - xi(q)|, or what points are chosen by, (P,); infinite outside the domain
    error: Array  #: largest error of x, (P,)

    @classmethod
    def of(cls, q: Array, boxed: BoxedPhi, rows: Indices | None = None) -> "Points":
        """S positions of each of N rows, q (S, N, n), which may be some of more rows."""
        row = np.tile(np.arange(q.shape[1]) if rows is None else rows, len(q))
        return cls(row, boxed.of_points(q.reshape(-1, q.shape[2])), *np.full((2, len(row)), np.nan))

    def part(self, which: NDArray[np.bool_] | Indices) -> "Points":
        """Some of them."""
        return Points(*(array[which] for array in vars(self).values()))

    def kept(self) -> "Points":
        """Points inside that have x."""
        return self.part((self.error <= SLIDE.kept) & np.isfinite(self.away))

    def joined(self, other: "Points") -> "Points":
        """The points of both."""
        return Points(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))

    def best(self, N: int) -> tuple[Indices, Array]:
        """Which point with nearly x is the nearest of each of N rows, and how near it is, (N,); infinite for none."""
        away = np.where(self.error <= SLIDE.bent, self.away, np.inf)
        order, distance = np.argsort(-away, kind="stable"), np.full(N, np.inf)
        place = np.zeros(N, dtype=np.int64)
        # what is written last stays
        place[self.row[order]], distance[self.row[order]] = order, away[order]
        return place, distance

    def apart(self, N: int, count: int, settled: float = SLIDE.bent) -> "Points":
        """Up to so many of the best points of each of N rows that lie apart; one alone of rows nearly solved.

        Points with errors of x up to `settled` come first, then those with the least distance.
        """
        # the best of each row first, up to a number of them
        order = np.lexsort((self.away, self.error > settled, self.row))
        order = order[np.isfinite(self.away[order])]
        if not order.size:
            return self.part(order)
        row = self.row[order]
        rank = np.arange(len(row)) - np.searchsorted(row, np.arange(N))[row]
        order, row, rank = (array[rank < RULES.most] for array in (order, row, rank))
        place = np.full((N, RULES.most), -1)
        place[row, rank] = order
        # take the best that is left, and drop what lies near it
        u, left, chosen = self.u[place], place >= 0, [np.zeros(0, dtype=np.int64)]
        for _ in range(count):
            first = np.argmax(left, axis=1)
            rows = np.flatnonzero(left.any(axis=1))
            if not rows.size:
                break
            best = place[rows, first[rows]]
            chosen.append(best)
            left[rows] &= np.abs(u[rows] - self.u[best][:, None]).max(axis=2) >= RULES.apart
            # a row that is nearly solved needs no other point
            left[rows[(self.away[best] <= RULES.nearly) & (self.error[best] <= settled)]] = False
        return self.part(np.concatenate(chosen))


@dataclass(frozen=True, eq=False)
class Slide:
    """The points at which the searches of N rows ended."""

    u: Array  #: points of the box, (N, n)
    error: Array  #: largest error of x, (N,)
    distance: Array  #: |xi - xi(q)|, (N,); infinite outside the domain


def slide(boxed: BoxedPhi, targets: Array, start: Array, most: int = SLIDE.most) -> Slide:
    """Points u of the domain near a start with x as in targets, and |xi - xi(q)| as small as steps make it.

    With J^-1 = [P, B], P for x and B for xi, all d = P (x - h(q)) + B z lead to x to first order, and change xi by z.
    A step is that with the z nearest to xi - xi(q) for which q + d lies in the domain: the projection of a point on a
    polytope of r dimensions. A second step with the same J corrects the error of x; what remains must be small, and
    the distance has to decrease as promised. Otherwise steps get shorter.

    Args:
        boxed: phi and the domain.
        targets: values of phi, (N, n).
        start: points of the box, (N, n); they need not have x.
        most: steps.

    Source:
        Sequential quadratic programming in coordinates where both equations are linear; ours.
    """
    with np.errstate(all="ignore"):
        run = _Run(boxed, targets, start)
        rows = np.flatnonzero(np.isfinite(run.gap).all(axis=1))
        # all rows at once; each ends where its steps gain nothing
        for _ in range(most):
            if not rows.size:
                break
            rows = run.advance(rows)
        error, inside = largest(run.gap[:, : boxed.m]), boxed.domain.contains(boxed.points(run.u))
        return Slide(run.u, error, np.where(inside, np.linalg.norm(run.gap[:, boxed.m :], axis=1), np.inf))


class _Run:
    """The state of all rows."""

    def __init__(self, boxed: BoxedPhi, targets: Array, start: Array) -> None:
        self._boxed, self._targets = boxed, targets
        self._sizes = np.concatenate([boxed.phi_map.sizes[: boxed.m], np.ones(start.shape[1] - boxed.m)])
        self.u = start.copy()
        self.gap = self._gaps(np.arange(len(start)), start)  #: phi - phi(q), x relative to sizes, (N, n)
        self._longest = np.full(len(start), SLIDE.longest)
        # the last z, as projected and as taken
        self._before = np.zeros((len(start), 2, start.shape[1] - boxed.m))
        # which bounds the last steps held
        self._held = np.zeros(start.shape, dtype=np.int8)
        # rows that met the end of a condition
        self._meets = np.zeros(len(start), dtype=bool)

    def advance(self, rows: Indices) -> Indices:
        """Try a step in some rows; returns those that go on."""
        boxed, m, gap, u = self._boxed, self._boxed.m, self.gap[rows], self.u[rows]
        J = boxed.phi_map.jacobian(boxed.points(u)) * boxed.domain.half_width / self._sizes[:, None]
        H = inverses(J)[0]
        # P moves x, and B moves xi along the self-motions
        P, B, left = H[:, :, :m], H[:, :, m:], gap[:, m:]
        longest, walls = self._longest[rows, None], self._walls(rows, u)
        back = _times(P, gap[:, :m])
        wanted = left * np.minimum(1.0, longest / _size(_times(B, left)))
        # the step of xi that the boundaries allow, after the step back to x
        z, held = walls.project(B, back, wanted, self._held[rows])
        stretch, plain = self._stretches(rows, z), z
        # longer where several steps went the same way
        some = np.flatnonzero(stretch != 1)
        if some.size:
            z = z.copy()
            z[some] = walls.part(some).project(B[some], back[some], stretch[some, None] * z[some], held[some])[0]
        d = back + _times(B, z)
        # cut to the trust region, and corrected once
        part = np.minimum(1.0, longest / _size(d))
        d, z = np.clip(part * d, boxed.low - u, boxed.high - u), part * z
        new, after = self._corrected(rows, u + d, P, B, walls.slopes, held)
        # accept if x stays near and xi comes nearer, about as the linear model promised
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
        # points outside the domain: from now on, the row sees its condition as a wall
        inside = good.copy()
        inside[good] = boxed.domain.contains(boxed.points(new[good]))
        met = good & ~inside & ~self._meets[rows] & boxed.has_rooms
        self._meets[rows[met]] = True
        moved = rows[inside]
        self.u[moved], self.gap[moved] = new[inside], after[inside]
        self._held[rows] = held[:, : u.shape[1]]
        self._before[moved] = np.stack([plain, z], axis=1)[inside]
        # the trust region grows where the model was right
        foreseen = (error < SLIDE.straight) | (gain > promised - (1 - SLIDE.foreseen) * size)
        longer = np.where(foreseen, np.minimum(2 * longest[:, 0], SLIDE.longest), longest[:, 0])
        shorter = np.minimum(longest[:, 0], np.abs(d).max(axis=1)) / 3
        self._longest[rows] = np.where(inside, longer, np.where(met, longest[:, 0], shorter))
        # where nothing is promised any more
        ended = (size <= SLIDE.converged * square + SLIDE.rounded) | (np.abs(d).max(axis=1) <= SLIDE.still)
        ended &= (before <= SLIDE.kept) & ~met
        return np.asarray(rows[~ended & (self._longest[rows] > SLIDE.shortest)])

    def _stretches(self, rows: Indices, z: Array) -> Array:
        """How much longer steps z (rows, r) should be, or shorter, where boundaries bend: Barzilai and Borwein's rule.

        Only where the last step went the same way.
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
        """Points after a second step to x, and into the domain, and what is left of phi there, (rows, n) each.

        Only where x is nearer after it. Conditions bend, so they are evaluated again.
        """
        m, boxed = self._boxed.m, self._boxed
        after = self._gaps(rows, new)
        error = largest(after[:, :m])
        # rows that missed x by little, and those at a condition, take one more Newton step
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
        """The boundaries as seen from points u of some rows; the slopes of conditions may be those of other points."""
        boxed = self._boxed
        low, high = boxed.low - u, boxed.high - u
        # conditions count only in rows that met one
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
        """phi - phi(q), x relative to sizes, (rows, n)."""
        gaps: Array = self._boxed.gaps(self._targets[rows], u) / self._sizes
        return gaps


@dataclass(frozen=True, eq=False)
class Walls:
    """Bounds of steps d of N rows: low <= (d, slopes d) <= high."""

    low: Array  #: (N, n + k)
    high: Array  #: (N, n + k)
    slopes: Array  #: of the conditions, (N, k, n)

    def part(self, rows: Indices) -> "Walls":
        """Points of some rows."""
        return Walls(self.low[rows], self.high[rows], self.slopes[rows])

    def project(self, B: Array, back: Array, wanted: Array, held: NDArray[np.int8]) -> tuple[Array, NDArray[np.int8]]:
        """The z (N, r) nearest to wanted ones for which d = back + B z keeps the bounds, as far as any z does.

        From a guess which of the first bounds hold; returns those that do, (N, n + k).
        """
        guess = np.zeros(self.low.shape, dtype=np.int8)
        shared = min(self.low.shape[1], held.shape[1])
        guess[:, :shared] = held[:, :shared]
        gone = np.concatenate([back, _times(self.slopes, back)], axis=1) if self.slopes.shape[1] else back
        whole = np.concatenate([B, self.slopes @ B], axis=1) if self.slopes.shape[1] else B
        return project(whole, self.low - gone, self.high - gone, wanted, guess)


def project(B: Array, low: Array, high: Array, wanted: Array, held: NDArray[np.int8]) -> tuple[Array, NDArray[np.int8]]:
    """The points z (N, r) of polytopes low <= B z <= high that are nearest to wanted ones (N, r).

    Bounds that z breaks are penalised; which they are is guessed again and again until that does not change. Two
    steps of their multipliers then make z exact. Where a polytope is empty, z breaks its bounds as little as it can.

    Args:
        B: (N, k, r).
        low: (N, k).
        high: (N, k).
        wanted: (N, r).
        held: a guess which bounds hold, -1 low, 1 high, (N, k).

    Returns:
        z, and the bounds that hold, (N, k).
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
        # the first bound alone, so that they do not change back and forth
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
    """Rows of B (N, k, r) and bounds (N, k) that are held, 0 elsewhere, and 1 + penalty B^T B of these, (N, r, r)."""
    A = B * (held != 0)[:, :, None]
    bounds = np.where(held > 0, high, np.where(held < 0, low, 0.0))
    K = SLIDE.penalty * (A.transpose(0, 2, 1) @ A)
    ridge = 1 + 1e-12 * np.trace(K, axis1=1, axis2=2)
    return A, bounds, K + ridge[:, None, None] * np.eye(B.shape[2])


def _times(matrices: Array, vectors: Array) -> Array:
    """Products of matrices (N, i, j) and vectors (N, j), (N, i)."""
    products: Array = (matrices @ vectors[:, :, None])[:, :, 0]
    return products


def _size(steps: Array) -> Array:
    """Largest change of a joint, (N, 1)."""
    return np.asarray(np.maximum(np.abs(steps).max(axis=1, keepdims=True), 1e-300))
