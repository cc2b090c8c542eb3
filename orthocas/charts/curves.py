"""The self-motion curves of many task values at once, r = 1, and the points on them whose xi is nearest."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.charts.in_domain import KEPT, BoxedPhi
from orthocas.charts.newton import Starts, inverses
from orthocas.charts.phi import largest, shortest
from orthocas.tasks.domains import bounds_of
from orthocas.tasks.relative import Relative
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.columns import BlockedFunction


@dataclass(frozen=True, slots=True)
class CurveRules:
    """Numbers of the search along curves. Chosen on panda-wide and xarm7-wide (benchmarks/round_trips.py)."""

    near_phi: int = 4  #: stored positions near each phi, from which curves are sought
    near_x: int = 8  #: the same near each x
    more: int = 24  #: the same, for rows without a solution
    reach: int = 25  #: steps from a start to its x
    largest: float = 0.7  #: norm of one of those steps [rad] or [m]
    missed: float = 0.08  #: largest correction of a step along a curve [rad] or [m]
    step: float = 0.4  #: longest step along a curve [rad] or [m]
    shortest: float = 0.03  #: a curve that needs shorter ones ends, near a singular position
    most: int = 80  #: steps of a curve in one direction
    turned: float = 0.9  #: least cosine between the tangents at both ends of a step
    straight: float = 0.96  #: cosine from which the next step may be longer
    known: float = 0.05  #: distance [rad] or [m] from a curve up to which a start lies on it
    parts: int = 3  #: points with xi on each step
    sagitta: float = 6e-3  #: largest distance of those parts from their chords [rad] or [m]
    halvings: int = 5  #: of chords that pass the box between points outside
    narrow: float = 1e-10  #: [rad] or [m]: brackets of an end of the domain
    prismatic: float = 1.0  #: half-widths that a sliding joint may leave its range by


RULES = CurveRules()
_AT_ONCE = 2048  # rows whose curves are held in memory


@dataclass(frozen=True, eq=False)
class Traces:
    """Curves of K targets: points in order, at most `RULES.step` apart."""

    row: Indices  #: number of the target, (K,)
    q: Array  #: (K, P, n), unwrapped; the last point is repeated after the end
    tangent: Array  #: unit tangents there, (K, P, n)
    count: Indices  #: points of each curve, (K,)

    def part(self, curves: Indices) -> "Traces":
        """Some of the curves."""
        return Traces(*(array[curves] for array in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Nearest:
    """The best point of each of N rows."""

    q: Array  #: (N, n)
    distance: Array  #: |xi - xi(q)|, (N,); 0 for solutions, infinite for rows without a point in the domain
    between: NDArray[np.bool_]  #: rows whose q is neither a solution nor an end of an arc, (N,)

    @classmethod
    def empty(cls, starts: Array) -> "Nearest":
        """No points yet; q holds the starts (N, n)."""
        return cls(starts.copy(), np.full(len(starts), np.inf), np.zeros(len(starts), dtype=bool))

    def take(self, rows: Indices, q: Array, distance: Array, between: bool = False) -> None:
        """Take over points (M, n) that are nearer than those of their rows (M,), which may occur several times."""
        farthest_first = np.argsort(-distance, kind="stable")  # what is written last stays
        better = farthest_first[distance[farthest_first] < self.distance[rows[farthest_first]]]
        self.q[rows[better]], self.distance[rows[better]] = q[better], distance[better]
        self.between[rows[better]] = between


@dataclass(frozen=True, eq=False)
class SelfMotionCurves:
    """Finds q in the domain with h(q) = x and the nearest xi, along all self-motion curves of x that it finds.

    For charts with r = 1. All positions of a regular x form closed curves in the torus of the joints. The search

    1. leads stored positions near x to x by damped least squares, whatever the limits,
    2. traces the curve through each that does not lie on a known one, whatever the limits,
    3. cuts the curves by the domain, and looks for xi on the parts inside.

    On a part, the nearest xi is a root of xi(q) = xi_d, an end of the part, or a place where xi turns back. So the
    result is the nearest one on all curves that were found, up to parts shorter than `RULES.step / RULES.parts`.
    """

    boxed: BoxedPhi
    starts: Starts
    xi: Callable[[Array], Array]  #: coordinates (N, 1) of points (N, n)

    def search(self, targets: Array, own: Array, tolerance: float) -> Nearest:
        """The nearest points for targets (N, n) of phi, from stored starts and one of the caller's (N, n)."""
        pieces = [slice(first, first + _AT_ONCE) for first in range(0, len(own), _AT_ONCE)]
        found = [self._search(targets[rows], own[rows], tolerance) for rows in pieces]
        parts = zip(*(vars(part).values() for part in (Nearest.empty(own[:0]), *found)), strict=True)
        return Nearest(*(np.concatenate(arrays) for arrays in parts))

    def _search(self, targets: Array, own: Array, tolerance: float) -> Nearest:
        best, ends, traced = Nearest.empty(own), Ends.empty(own.shape[1]), list[Traces]()
        with np.errstate(all="ignore"):
            for stage in range(2):
                rows = np.flatnonzero(best.distance > 0)
                if rows.size:
                    starts = self._first_starts(targets[rows], own[rows]) if stage == 0 else self._more(targets[rows])
                    ends = ends.joined(self._search_from(targets, rows, starts, traced, tolerance, best))
            self._take_ends(targets, ends, best)
        return best

    def _search_from(
        self, targets: Array, rows: Indices, starts: Array, traced: list[Traces], tolerance: float, best: Nearest
    ) -> "Ends":
        """Search some rows from starts (S, rows, n), and add to the curves that are traced; returns ends of arcs."""
        q, known = self._reached(targets[rows], starts)
        place, ends = np.full(len(targets), -1), Ends.empty(q.shape[2])
        place[rows] = np.arange(len(rows))
        for traces in traced:
            here = np.flatnonzero(place[traces.row] >= 0)
            of = place[traces.row[here]]
            known[of] |= self._on_curves(q[of], traces.part(here))
        away = self._away(q)
        for _ in range(q.shape[1]):
            left = np.flatnonzero(~known.all(axis=1) & (best.distance[rows] > 0))
            if not left.size:
                break
            first = np.argmin(np.where(known[left], np.inf, away[left]), axis=1)
            traces = self._traced(targets[rows[left]], q[left, first], rows[left])
            arcs = self._arcs(targets, traces)
            self._take_roots(targets, arcs, tolerance, best)
            ends = ends.joined(self._take_points(targets, arcs, best))
            known[left] |= self._on_curves(q[left], traces)
            known[left, first] = True
            traced.append(traces)
        return ends

    def _first_starts(self, targets: Array, own: Array) -> Array:
        """The caller's starts, and stored positions near phi and near x, (S, N, n)."""
        near_phi = self.starts.nearest(targets, RULES.near_phi, targets.shape[1])
        return np.concatenate([own[None], near_phi, self.starts.nearest(targets, RULES.near_x, self.boxed.m)])

    def _more(self, targets: Array) -> Array:
        """Further stored positions near x, (S, N, n)."""
        return self.starts.nearest(targets, RULES.near_x + RULES.more, self.boxed.m)[RULES.near_x :]

    def _reached(self, targets: Array, starts: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Positions (N, S, n) with the task values of targets, and which starts (S, N, n) led to none, (N, S)."""
        S, N, n = starts.shape
        x = np.repeat(targets[:, : self.boxed.m], S, axis=0)
        q, error = self._led_to(x, starts.transpose(1, 0, 2).reshape(-1, n))
        return q.reshape(N, S, n), ~(error <= KEPT).reshape(N, S)

    def _led_to(self, x: Array, starts: Array) -> tuple[Array, Array]:
        """Where damped least squares lead from starts (M, n) to x (M, m), whatever the limits; and errors (M,)."""
        q, error, left = starts.copy(), np.full(len(starts), np.inf), np.arange(len(starts))
        for _ in range(RULES.reach):
            found = self._damped_step(q[left], x[left])[0]
            error[left] = found[:, -1]
            going = (error[left] > KEPT / 10) & np.isfinite(error[left])
            left = left[going]
            if not left.size:
                break
            q[left] += found[going, :-1]
        return q, error

    def _traced(self, targets: Array, q: Array, rows: Indices) -> Traces:
        """The curves through points q (K, n), from end to end."""
        x = targets[:, : self.boxed.m]
        J = self.boxed.phi_map.jacobian(q)[:, : self.boxed.m] / self.boxed.phi_map.sizes[: self.boxed.m, None]
        t = np.linalg.qr(J.transpose(0, 2, 1), mode="complete")[0][:, :, -1]
        ahead, tangents, count, closed = self._follow(x, q, t)
        back = np.flatnonzero(~closed)
        if not back.size:
            return Traces(rows, ahead, tangents, count)
        behind, behind_tangents, behind_count, _ = self._follow(x[back], q[back], -t[back])
        before = np.zeros(len(q), dtype=np.int64)
        before[back] = behind_count - 1
        total = count + before
        place = np.arange(total.max())
        after = np.clip(place - before[:, None], 0, (count - 1)[:, None])
        points, directions = (np.take_along_axis(part, after[:, :, None], axis=1) for part in (ahead, tangents))
        turned_round = np.maximum(before[back, None] - place, 0)
        early = (place < before[back, None])[:, :, None]
        turned_round = np.minimum(turned_round, behind.shape[1] - 1)[:, :, None]
        points[back] = np.where(early, np.take_along_axis(behind, turned_round, axis=1), points[back])
        opposite = -np.take_along_axis(behind_tangents, turned_round, axis=1)
        directions[back] = np.where(early, opposite, directions[back])
        return Traces(rows, points, directions, total)

    def _follow(self, x: Array, q0: Array, t0: Array) -> tuple[Array, Array, Indices, NDArray[np.bool_]]:
        """Follow curves from q0 (K, n) along t0 until they close, leave the ranges of sliding joints, or fail.

        Returns:
            Points and unit tangents (K, P, n), their number (K,), and which curves are closed, (K,).
        """
        K, n = q0.shape
        points, tangents = [q0], [t0]
        count, closed = np.ones(K, dtype=np.int64), np.zeros(K, dtype=bool)
        q, t, bend = q0.copy(), t0.copy(), np.zeros_like(q0)
        h, before, left = np.full(K, RULES.step / 2), np.zeros(K), np.arange(K)
        for _ in range(RULES.most):
            lengths = h[left, None]
            state = np.concatenate([q[left], t[left], bend[left], lengths, q0[left], t0[left]], axis=1)
            found = self._step(state, x[left])[0]
            new, onward, (missed, turned, gap, ahead) = found[:, :n], found[:, n : 2 * n], found[:, 2 * n :].T
            good = (missed < RULES.missed) & (turned > RULES.turned)
            moved = left[good]
            closed[moved] = ((gap < 1.6 * RULES.step) & (before[left] < 0) & (ahead >= 0))[good] & (count[moved] > 3)
            bend[moved] = (onward[good] - t[moved]) / lengths[good]
            q[moved], t[moved], before[moved] = new[good], onward[good], ahead[good]
            longer = turned[good] > RULES.straight
            h[moved] = np.where(longer, np.minimum(1.6 * h[moved], RULES.step), h[moved])
            h[left[~good]] /= 2
            count[moved] += 1
            points.append(q.copy())
            tangents.append(t.copy())
            left = left[~closed[left] & (h[left] > RULES.shortest) & self._slides_near(q[left])]
            if not left.size:
                break
        return *_compact(np.array(points), np.array(tangents), count), count, closed

    def _corrected(self, x: Array, q: Array, t: Array) -> tuple[Array, Array]:
        """Newton's steps to x across directions t (K, n), and tangents with t . tangent = 1, (K, n) each."""
        found = self._bordered_step(q, x, t)[0]
        return found[:, : q.shape[1]], found[:, q.shape[1] :]

    def _away(self, q: Array) -> Array:
        """Largest distances of joints (N, S, n) from their ranges, up to full turns, (N, S)."""
        low, high = bounds_of(self.boxed.domain)
        bounded = np.isfinite(low)
        centre, half = np.where(bounded, (low + high) / 2, 0.0), np.where(bounded, (high - low) / 2, np.inf)
        return np.asarray((np.abs(_wrapped(q - centre, self._turning)) - half).max(axis=2).clip(0.0))

    def _on_curves(self, q: Array, traces: Traces) -> NDArray[np.bool_]:
        """Which of the positions q (K, S, n) lie on the curves, up to full turns, (K, S)."""
        mine, points = self._on_circles(q), self._on_circles(traces.q)
        squares = (points**2).sum(axis=2)[:, None] - 2 * mine @ points.transpose(0, 2, 1)
        nearest = np.argmin(squares, axis=2)
        found = np.zeros(nearest.shape, dtype=bool)
        for place in (np.maximum(nearest - 1, 0), nearest):
            start = np.take_along_axis(traces.q, place[:, :, None], axis=1)
            after = np.minimum(place + 1, traces.q.shape[1] - 1)
            step = np.take_along_axis(traces.q, after[:, :, None], axis=1) - start
            away = _wrapped(q - start, self._turning)
            share = (away * step).sum(axis=2) / np.maximum((step**2).sum(axis=2), 1e-300)
            gap = away - np.clip(share, 0.0, 1.0)[:, :, None] * step
            found |= (gap**2).sum(axis=2) < RULES.known**2
        return found

    def _on_circles(self, q: Array) -> Array:
        """Cosines and sines of revolute joints, and positions of the others: near one another where q (..., n) is."""
        turning, sliding = q[..., self._turning], q[..., ~self._turning]
        return np.concatenate([np.cos(turning), np.sin(turning), sliding], axis=-1)

    def _slides_near(self, q: Array) -> NDArray[np.bool_]:
        """Whether sliding joints are in their ranges, or not far outside."""
        if self._turning.all():
            return np.ones(len(q), dtype=bool)
        low, high = bounds_of(self.boxed.domain)
        room = RULES.prismatic * self.boxed.domain.half_width
        return np.asarray((((q >= low - room) & (q <= high + room)) | self._turning).all(axis=1))

    def _arcs(self, targets: Array, traces: Traces) -> "Arcs":
        """Points on the steps of curves in and around the box of the domain."""
        curve, shift = self._sheets(traces)
        low, high = bounds_of(self.boxed.domain)
        moved = traces.q[curve] + shift[:, None]
        near = np.asarray(((moved >= low - RULES.step) & (moved <= high + RULES.step)).all(axis=2))
        at, place = np.nonzero((near[:, :-1] | near[:, 1:]) & (np.arange(1, near.shape[1]) < traces.count[curve, None]))
        q, along = _subdivided(traces, curve[at], place)
        q += shift[at][:, None]
        row = traces.row[curve[at]]
        slack = RULES.step / RULES.parts
        close = np.asarray(((q >= low - slack) & (q <= high + slack)).all(axis=2))
        x = targets[np.repeat(row, close.sum(axis=1)), : self.boxed.m]
        points, t = q[close], along[close]
        points += self._corrected(x, points, t)[0]
        within = ((points >= low - RULES.sagitta) & (points <= high + RULES.sagitta)).all(axis=1)
        points[within] += self._corrected(x[within], points[within], t[within])[0]
        q[close] = points
        inside, xi_left = np.zeros(close.shape, dtype=bool), np.full(close.shape, np.nan)
        inside[close] = self._contains(points)
        xi_left[close] = self._xi_left(targets[np.repeat(row, close.sum(axis=1))], points)
        passing = close[:, :-1] & close[:, 1:] & ~inside[:, :-1] & ~inside[:, 1:]
        arc, place = np.nonzero(passing)
        first, last = self._shares_inside(q[arc, place], q[arc, place + 1], RULES.sagitta)
        passing[arc, place] = first < last
        return Arcs(row, q, inside, passing, xi_left)

    def _sheets(self, traces: Traces) -> tuple[Indices, Array]:
        """Which curves (of K) pass the box of the domain after which full turns: curve (L,), and shifts (L, n)."""
        low, high = bounds_of(self.boxed.domain)
        turn, room, bounded = 2 * np.pi, RULES.step, np.isfinite(low)
        low = np.where(bounded, low - room, self.boxed.domain.centre - np.pi)
        high = np.where(bounded, high + room, np.inf)
        first = np.where(self._turning, np.ceil((low - traces.q) / turn), 0.0)
        at = traces.q + turn * first
        passed = np.ones(at.shape[:2], dtype=bool)
        passed[:, 1:] = (first[:, 1:] != first[:, :-1]).any(axis=2)
        choices = [range(1 + int(k)) for k in np.where(self._turning & bounded, (high - low) // turn, 0)]
        near = [
            [(at[:, :, j] >= low[j]) & (at[:, :, j] <= high[j] - turn * k) for k in choices[j]] for j in range(len(low))
        ]
        found = []
        for extra in product(*choices):
            close = np.logical_and.reduce([near[j][k] for j, k in enumerate(extra)])
            changes = close & passed
            changes[:, 1:] |= close[:, 1:] & ~close[:, :-1]
            curve, place = np.nonzero(changes)
            found.append(np.column_stack([curve, first[curve, place] + np.array(extra)]))
        sheets = np.unique(np.concatenate(found), axis=0)
        return sheets[:, 0].astype(np.int64), turn * sheets[:, 1:]

    def _take_roots(self, targets: Array, arcs: "Arcs", tolerance: float, best: Nearest) -> None:
        """Solutions of phi(q) = phi on arcs."""
        left = arcs.xi_left
        jump = np.abs(left[:, 1:] - left[:, :-1])
        crossed = (left[:, :-1] * left[:, 1:] <= 0) & (arcs.inside[:, :-1] | arcs.inside[:, 1:] | arcs.passing)
        crossed &= ~(jump > self._period / 2)
        arc, place = np.nonzero(crossed)
        if not arc.size:
            return
        a, b = left[arc, place], left[arc, place + 1]
        share = np.where(a == b, 0.0, a / np.where(a == b, 1.0, a - b))[:, None]
        q = (1 - share) * arcs.q[arc, place] + share * arcs.q[arc, place + 1]
        rows, phi_map = arcs.row[arc], self.boxed.phi_map
        for _ in range(4):
            J = phi_map.jacobian(q) / phi_map.sizes[:, None]
            q = (
                q
                + _solutions(J, phi_map.difference(targets[rows], phi_map.phi(q))[:, :, None] / phi_map.sizes[:, None])[
                    :, :, 0
                ]
            )
        q = self._snapped(q)
        q = np.where(np.isfinite(q), q, best.q[rows])
        solved = (largest(phi_map.residual(targets[rows], q)) <= tolerance) & self.boxed.domain.contains(q)
        best.take(rows[solved], q[solved], np.zeros(int(solved.sum())))

    def _take_points(self, targets: Array, arcs: "Arcs", best: Nearest) -> "Ends":
        """Points of arcs that lie in the domain; returns the ends that may be nearer."""
        inside = arcs.inside & (best.distance > 0)[arcs.row][:, None]
        arc, place = np.nonzero(inside)
        rows, here = arcs.row[arc], arcs.xi_left[arc, place]
        best.take(rows, arcs.q[arc, place], np.abs(here), between=True)
        found = []
        for side in (-1, 1):
            beyond = np.clip(place + side, 0, inside.shape[1] - 1)
            there = arcs.xi_left[arc, beyond]
            least = np.where(here * there > 0, np.minimum(np.abs(here), np.abs(there)), 0.0)
            ends = ~inside[arc, beyond] & np.isfinite(there) & (least < best.distance[rows])
            points = arcs.q[arc[ends], place[ends]], arcs.q[arc[ends], beyond[ends]]
            found.append(Ends(rows[ends], *points, least[ends]))
        return found[0].joined(found[1]).joined(self._take_short(targets, arcs, best))

    def _take_short(self, targets: Array, arcs: "Arcs", best: Nearest) -> "Ends":
        """The same of arcs that lie between neighbouring points outside: chords that pass the box are halved."""
        arc, place = np.nonzero(arcs.passing & (best.distance > 0)[arcs.row][:, None])
        a, b, rows, found = arcs.q[arc, place], arcs.q[arc, place + 1], arcs.row[arc], Ends.empty(arcs.q.shape[2])
        for level in range(RULES.halvings):
            first, last = self._shares_inside(a, b, RULES.sagitta / 4**level)
            passing = first < last
            a, b, rows, share = a[passing], b[passing], rows[passing], ((first + last) / 2)[passing, None]
            if not rows.size:
                break
            q = a + share * (b - a)
            for _ in range(2):
                q = q + self._corrected(targets[rows, : self.boxed.m], q, b - a)[0]
            good = self._contains(q)
            left = np.abs(self._xi_left(targets[rows[good]], q[good]))
            best.take(rows[good], q[good], left, between=True)
            for other in (a[good], b[good]):
                found = found.joined(Ends(rows[good], q[good], other, np.zeros(len(left))))
            again = ~good & ~self._in_box(q)  # conditions are not looked at so closely
            a, b, rows = np.concatenate([a[again], q[again]]), np.concatenate([q[again], b[again]]), np.tile(rows[again], 2)
        return found

    def _shares_inside(self, a: Array, b: Array, slack: float) -> tuple[Array, Array]:
        """Where the chords from a to b (K, n) are in the box, or so near: between shares low and high (K,) if <."""
        low, high = bounds_of(self.boxed.domain)
        step = np.where(np.abs(b - a) > 1e-300, b - a, 1e-300)
        one, other = (low - slack - a) / step, (high + slack - a) / step
        first, last = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
        return np.maximum(first, 0.0), np.minimum(last, 1.0)

    def _contains(self, q: Array) -> NDArray[np.bool_]:
        """Which points (N, n) lie in the domain; they need not be finite."""
        inside = self._in_box(q)
        inside[inside] = self.boxed.domain.contains(q[inside])
        return inside

    def _in_box(self, q: Array) -> NDArray[np.bool_]:
        """Which points (N, n) lie in the box of the domain."""
        low, high = bounds_of(self.boxed.domain)
        return np.asarray(((q >= low) & (q <= high)).all(axis=1))

    def _take_ends(self, targets: Array, ends: "Ends", best: Nearest) -> None:
        """The ends of arcs, of rows in which they may be nearest."""
        useful = np.flatnonzero(ends.least < best.distance[ends.row])
        rows = ends.row[useful]
        if rows.size:
            q = self._end(targets[rows], ends.inside[useful], ends.outside[useful])
            best.take(rows, q, np.abs(self._xi_left(targets[rows], q)))

    def _end(self, targets: Array, inside: Array, outside: Array) -> Array:
        """The last points of the domain between points of curves (M, n) inside and outside."""
        x = targets[:, : self.boxed.m]
        a, b = inside.copy(), outside.copy()
        while np.abs(b - a).max(initial=0.0) > RULES.narrow:
            along = b - a
            middle = (a + b) / 2
            t = along / np.linalg.norm(along, axis=1, keepdims=True)
            middle = middle + self._corrected(x, middle, t)[0]
            middle = np.where(np.isfinite(middle), middle, b)
            within = self._contains(middle)
            a, b = np.where(within[:, None], middle, a), np.where(within[:, None], b, middle)
        return a

    def _snapped(self, q: Array) -> Array:
        """Points that miss the boundary by rounding, on it."""
        moved = np.clip(q, *bounds_of(self.boxed.domain))
        near = np.abs(moved - q) <= 1e-9 * self.boxed.domain.half_width
        return np.where(near.all(axis=1, keepdims=True), moved, q)

    def _xi_left(self, targets: Array, q: Array) -> Array:
        """xi - xi(q), (N,)."""
        left = targets[:, self.boxed.m :] - self.xi(q)
        return np.asarray(shortest(left, self.boxed.phi_map.difference.turns[self.boxed.m :])[:, 0])

    @cached_property
    def _bordered_step(self) -> BlockedFunction:
        """As `_bordered`, at many points."""
        return BlockedFunction(self._bordered)

    @cached_property
    def _bordered(self) -> ca.Function:
        """q, x, t -> the solution dq of J dq = x - h(q), t . dq = 0, and that of J dq = 0, t . dq = 1, (2n, 1)."""
        q, x, e, J = self._symbols
        t = ca.SX.sym("t", q.shape[0])
        right = ca.vertcat(ca.horzcat(e, ca.SX.zeros(e.shape[0])), ca.SX([[0.0, 1.0]]))
        found = ca.solve(ca.vertcat(J, t.T), right)
        return dense_function("bordered_step", [q, x, t], [ca.cse(ca.vec(found))])

    @cached_property
    def _step(self) -> BlockedFunction:
        """A step along a curve: q, t, bend, h, q0, t0 in one column, and x -> new q and t, and four numbers.

        They are the length of the correction, the cosine between the tangents, and the distance of q from q0 up to full
        turns, also along t0.
        """
        q, x = self._symbols[:2]
        n = q.shape[0]
        state = ca.SX.sym("state", 5 * n + 1)
        at, t, bend, h, q0, t0 = ca.vertsplit(state, [0, n, 2 * n, 3 * n, 3 * n + 1, 4 * n + 1, 5 * n + 1])
        ahead = at + h * t + h**2 / 2 * bend
        change, onward = ca.horzsplit(ca.reshape(self._bordered(ahead, x, t), n, 2))
        new, onward = ahead + change, onward / ca.norm_2(onward)
        gap = new - q0
        gap -= 2 * np.pi * ca.DM(self._turning.astype(float)) * ca.floor(gap / (2 * np.pi) + 0.5)
        numbers = ca.vertcat(ca.norm_2(change), ca.dot(t, onward), ca.norm_2(gap), ca.dot(gap, t0))
        return BlockedFunction(dense_function("step", [state, x], [ca.cse(ca.vertcat(new, onward, numbers))]))

    @cached_property
    def _damped_step(self) -> BlockedFunction:
        """q, x -> a step of damped least squares to x, and the largest error, (n + 1, 1)."""
        q, x, e, J = self._symbols
        error, gram = ca.norm_inf(e), J @ J.T
        damping = ca.if_else(error > 0.1, 1e-2, ca.if_else(error > 1e-3, 1e-5, 1e-14)) * ca.trace(gram)
        step = J.T @ ca.solve(gram + damping * ca.SX.eye(e.shape[0]), e)
        step *= ca.fmin(1, RULES.largest / (ca.norm_2(step) + 1e-300))
        return BlockedFunction(dense_function("damped_step", [q, x], [ca.cse(ca.vertcat(step, error))]))

    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """q (n, 1), x (m, 1), errors (x - h(q)) / scale (m, 1), and rates J / scale (m, n)."""
        task, scale = self.boxed.task, ca.DM(self.boxed.phi_map.sizes[: self.boxed.m])
        relative = Relative(task)
        q, x = ca.SX.sym("q", task.robot.n), ca.SX.sym("x", task.m)
        return (
            q,
            x,
            relative.difference(x, task.function(q)) / scale,
            relative.rates(q) / ca.repmat(scale, 1, task.robot.n),
        )

    @cached_property
    def _turning(self) -> NDArray[np.bool_]:
        """Revolute joints, (n,)."""
        return ~np.array(self.boxed.task.robot.tree.prismatic)

    @cached_property
    def _period(self) -> float:
        """Of xi; infinite where it has none."""
        turn = float(self.boxed.phi_map.difference.turns[self.boxed.m])
        return turn if turn > 0 else np.inf


@dataclass(frozen=True, eq=False)
class Arcs:
    """S steps of curves around the domain, by G points each, close to one another."""

    row: Indices  #: number of the target, (S,)
    q: Array  #: (S, G, n)
    inside: NDArray[np.bool_]  #: which points lie in the domain, (S, G)
    passing: NDArray[np.bool_]  #: whether a chord between neighbours outside passes the box, (S, G - 1)
    xi_left: Array  #: xi - xi(q), (S, G); NaN far from the domain


@dataclass(frozen=True, eq=False)
class Ends:
    """Where arcs leave the domain: between neighbouring points of K curves."""

    row: Indices  #: number of the target, (K,)
    inside: Array  #: the last point inside, (K, n)
    outside: Array  #: the point after that, (K, n)
    least: Array  #: about the least |xi - xi(q)| between them, (K,)

    @classmethod
    def empty(cls, n: int) -> "Ends":
        """None."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, n)), np.zeros((0, n)), np.zeros(0))

    def joined(self, other: "Ends") -> "Ends":
        """Both."""
        parts = zip(vars(self).values(), vars(other).values(), strict=True)
        return Ends(*(np.concatenate(pair) for pair in parts))


def _compact(points: Array, tangents: Array, count: Indices) -> tuple[Array, Array]:
    """Points and tangents (P, K, n) of curves as (K, P, n), without those that repeat the one before."""
    moved = np.ones(points.shape[:2], dtype=bool)
    moved[1:] = (points[1:] != points[:-1]).any(axis=2)
    place = np.where(moved, np.cumsum(moved, axis=0) - 1, count.max())
    columns = np.broadcast_to(np.arange(points.shape[1]), moved.shape)
    packed = []
    for part in (points, tangents):
        out = np.repeat(part[-1][:, None], count.max() + 1, axis=1)
        out[columns, place] = part
        out[:, count.max()] = part[-1]
        packed.append(out[:, : count.max()])
    return packed[0], packed[1]


def _subdivided(traces: Traces, curve: Indices, place: Indices) -> tuple[Array, Array]:
    """Points on cubic curves from points of traces (S,) to the next ones, and directions, (S, parts + 1, n) each."""
    q, t = traces.q[curve, place][:, None], traces.tangent[curve, place][:, None]
    after, onward = traces.q[curve, place + 1][:, None], traces.tangent[curve, place + 1][:, None]
    s = (np.arange(RULES.parts + 1) / RULES.parts)[:, None]
    step = after - q
    bend = (s - 2 * s**2 + s**3) * t + (s**3 - s**2) * onward
    points = q + (3 * s**2 - 2 * s**3) * step + np.linalg.norm(step, axis=2, keepdims=True) * bend
    return points, (1 - s) * t + s * onward


def _wrapped(difference: Array, turning: NDArray[np.bool_]) -> Array:
    """Differences of joint positions (..., n) without full turns of revolute joints."""
    turns = 2 * np.pi * np.round(difference / (2 * np.pi))
    return np.where(turning, difference - turns, difference)


def _solutions(A: Array, right: Array) -> Array:
    """A^-1 right, (N, n, k); the least-squares solution where A is singular."""
    try:
        return np.linalg.solve(A, right)
    except np.linalg.LinAlgError:
        found: Array = inverses(A)[0] @ right
        return found
