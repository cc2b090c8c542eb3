"""Search of self-motion curves, r = 1, for many task values at once: the points on them whose xi is nearest."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.curve_tracer import RULES, CurveTracer, SearchKernel, Traces, has_library, solutions_of
from orthocas.charts.descent import BoxedPhi
from orthocas.charts.newton import Starts, largest
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.expressions import wrap_shortest

_AT_ONCE = 2048  # rows searched at once, to bound the memory for their curves


@dataclass(frozen=True, eq=False)
class Nearest:
    """The best point found so far for each of N targets."""

    q: Array  #: (N, n)
    distance: Array  #: |xi - xi(q)|, (N,); 0 for solutions, infinite for rows without a point in the domain
    between: NDArray[np.bool_]  #: whether q is a sample within an arc, neither a solution nor an end of it, (N,)

    @classmethod
    def empty(cls, starts: Array) -> "Nearest":
        """No points yet: infinite distances; q holds the starts (N, n)."""
        return cls(starts.copy(), np.full(len(starts), np.inf), np.zeros(len(starts), dtype=bool))

    def take(self, rows: Indices, q: Array, distance: Array, between: bool = False) -> None:
        """Keep the points q (M, n) that are nearer than the best so far of their rows (M,); a row may occur twice."""
        # nearest last, because the last assignment to a row stays
        farthest_first = np.argsort(-distance, kind="stable")
        better = farthest_first[distance[farthest_first] < self.distance[rows[farthest_first]]]
        self.q[rows[better]], self.distance[rows[better]] = q[better], distance[better]
        self.between[rows[better]] = between


@dataclass(frozen=True, eq=False)
class SelfMotionCurves:
    """Finds q in the domain with h(q) = x and the nearest xi, along all self-motion curves of x that it finds.

    For charts with r = 1. If x is regular, all q with h(q) = x form closed curves in the torus of the joints. The
    search

    1. moves stored positions near x to x by damped least squares, ignoring limits,
    2. traces the curve through each that does not lie on a curve traced before, ignoring limits,
    3. intersects the curves with the domain; each part inside is called an arc,
    4. looks for xi on the arcs.

    On an arc, the nearest xi is a root of xi(q) = xi_d, an end of the arc, or a point where xi turns back. So the
    result is the nearest xi on all curves found. Arcs shorter than `RULES.step / RULES.parts` may be missed.
    """

    boxed: BoxedPhi
    starts: Starts
    tracer: CurveTracer
    kernel: SearchKernel  #: the same search in C, if it can be compiled

    def search(self, targets: Array, own: Array, tolerance: float) -> Nearest:
        """Nearest points for targets phi (N, n); curves start at stored positions and at the caller's `own` (N, n)."""
        pieces = [slice(first, first + _AT_ONCE) for first in range(0, len(own), _AT_ONCE)]
        found = [self._search(targets[rows], own[rows], tolerance) for rows in pieces]
        parts = zip(*(vars(part).values() for part in (Nearest.empty(own[:0]), *found)), strict=True)
        return Nearest(*(np.concatenate(arrays) for arrays in parts))

    def find_all(self, target: Array, near: Array, tolerance: float) -> Array:
        """Solutions inside the domain for a target phi (n,), on all curves of x that are found, (k, n).

        A solution may occur several times. Curves start at stored positions and at `near` (S, n), positions near
        solutions.
        """
        targets, own, found = target[None], self.boxed.domain.home[None], [np.empty((0, len(target)))]
        starts = np.concatenate([near[:, None], *self.stages(targets, own)])
        with np.errstate(all="ignore"):
            for traces in self._trace_all(targets, starts):
                # xi - xi(q) at closely spaced points
                points = self._steps(traces, own).divided()[0]
                flat = points.reshape(-1, len(target))
                left = self._xi_left(np.broadcast_to(targets, flat.shape), flat).reshape(points.shape[:2])
                # a root may lie beside a point if |xi - xi(q)| there is no larger than its change to a neighbour
                change = np.abs(np.diff(left, axis=1))
                change = np.where(change > self._period / 2, np.inf, change)
                close = np.zeros(left.shape, dtype=bool)
                close[:, 1:] |= np.abs(left[:, 1:]) <= change
                close[:, :-1] |= np.abs(left[:, :-1]) <= change
                guess = points[close]
                found.append(self._solve(targets, np.zeros(len(guess), dtype=np.int64), guess, tolerance)[0])
        return np.concatenate(found)

    def list_points(self, target: Array, parts: int) -> Array:
        """Points (K, n) in the domain on all curves of x that are found, at most about `RULES.step / parts` apart.

        Curves start at stored positions near a target phi (n,). They are shifted by all full turns that fit into the
        joint ranges. Joints without a range stay within half a turn of the domain's home, or within one and a half
        turns if their turns change xi.
        """
        own, found = self.boxed.domain.home[None], [np.empty((0, len(target)))]
        starts = np.concatenate(self.stages(target[None], own))
        with np.errstate(all="ignore"):
            for traces in self._trace_all(target[None], starts):
                # leave out the end of each step, because the next step begins there
                q, t = (part[:, :-1].reshape(-1, len(target)) for part in self._steps(traces, own).divided(parts))
                x = np.broadcast_to(target[: self.boxed.m], (len(q), self.boxed.m))
                for _ in range(RULES.corrections):
                    move = self.tracer.correct(x, q, t)[0]
                    q = q + move
                # drop points whose last correction was long or NaN: they have not reached x
                q = q[np.abs(move).max(axis=1, initial=0.0) < RULES.last_correction]
                found.append(q[self.boxed.domain.contains(q)])
        return np.concatenate(found)

    def _trace_all(self, targets: Array, starts: Array) -> Iterator[Traces]:
        """Yield the curves of one target (1, n) to which starts (S, 1, n) lead, each once."""
        row = np.zeros(1, dtype=np.int64)
        if self.has_kernel:
            for q, t in self.kernel.trace(targets[0], starts[:, 0]):
                yield Traces(row, q[None], t[None], np.array([len(q)]))
            return
        q, known = self._reach(targets, starts)
        away = self.tracer.away(q)[0]
        while not known.all():
            # trace the next curve from a start that lies on no traced curve; the start nearest to the domain first
            start = np.argmin(np.where(known[0], np.inf, away))
            traces = self.tracer.trace(targets[:, : self.boxed.m], q[:, start], row)
            known[0, start] = True
            known |= self.tracer.on_curves(q, traces)
            yield traces

    def _search(self, targets: Array, own: Array, tolerance: float) -> Nearest:
        """`search` for so few rows that their curves fit into memory."""
        if self.has_kernel:
            first, more = self.stages(targets, own)
            starts = np.concatenate([first, more]).transpose(1, 0, 2)
            return Nearest(*self.kernel.search(targets, starts, len(first), tolerance))
        best, ends, traced = Nearest.empty(own), Ends.empty(own.shape[1]), list[Traces]()
        with np.errstate(all="ignore"):
            for starts in self.stages(targets, own):
                rows = np.flatnonzero(best.distance > 0)
                if rows.size:
                    ends = ends.joined(self._search_from(targets, rows, starts[:, rows], own, traced, tolerance, best))
            # bisect between inside and outside for the ends of arcs that may be nearer than the best point so far
            useful = np.flatnonzero(ends.least < best.distance[ends.row])
            rows, a, b = ends.row[useful], ends.inside[useful], ends.outside[useful]
            # Rounds are bounded: far along a joint without boundaries, floats are farther apart than `narrow`.
            for _ in range(RULES.narrowings):
                if np.abs(b - a).max(initial=0.0) <= RULES.narrow:
                    break
                along, middle = b - a, (a + b) / 2
                t = along / np.linalg.norm(along, axis=1, keepdims=True)
                middle = middle + self.tracer.correct(targets[rows, : self.boxed.m], middle, t)[0]
                middle = np.where(np.isfinite(middle), middle, b)
                within = self._contains(middle)
                a, b = np.where(within[:, None], middle, a), np.where(within[:, None], b, middle)
            if rows.size:
                best.take(rows, a, np.abs(self._xi_left(targets[rows], a)))
        return best

    def stages(self, targets: Array, own: Array) -> tuple[Array, Array]:
        """Starts in two stages, (S, N, n) each: the second one, more stored positions near x, is for unsolved rows.

        The first stage holds the caller's `own` (N, n) and stored positions near phi and near x.
        """
        near_phi = self.starts.nearest(targets, RULES.near_phi, targets.shape[1])
        near_x = self.starts.nearest(targets, RULES.near_x + RULES.more, self.boxed.m)
        return np.concatenate([own[None], near_phi, near_x[: RULES.near_x]]), near_x[RULES.near_x :]

    def _search_from(
        self,
        targets: Array,
        rows: Indices,
        starts: Array,
        own: Array,
        traced: list[Traces],
        tolerance: float,
        best: Nearest,
    ) -> "Ends":
        """Search some rows from starts (S, rows, n); update `best` and append the new curves to `traced`.

        Returns:
            Ends of arcs that may be nearer than the best points.
        """
        q, known = self._reach(targets[rows], starts)
        place, ends = np.full(len(targets), -1), Ends.empty(q.shape[2])
        place[rows] = np.arange(len(rows))
        # starts on curves of earlier stages need no search
        for traces in traced:
            here = np.flatnonzero(place[traces.row] >= 0)
            of = place[traces.row[here]]
            known[of] |= self.tracer.on_curves(q[of], traces.part(here))
        away = self.tracer.away(q)
        # in each round, trace curves from starts that lie on no curve so far
        for _ in range(q.shape[1]):
            left = np.flatnonzero(~known.all(axis=1) & (best.distance[rows] > 0))
            if not left.size:
                break
            # with many rows, one start of each row: the one nearest to the domain; with few rows, all starts
            if left.size > RULES.few:
                of, start = left, np.argmin(np.where(known[left], np.inf, away[left]), axis=1)
            else:
                at, start = np.nonzero(~known[left])
                of = left[at]
            traces = self.tracer.trace(targets[rows[of], : self.boxed.m], q[of, start], rows[of])
            known[of, start] = True
            # look for roots of xi on the long steps, then on closely spaced points of arcs that may hold one
            steps = self._steps(traces, own[traces.row])
            xi_left = self._take_crossed(targets, steps, tolerance, best)
            more = best.distance[steps.row] > 0
            arcs = self._arcs(targets, steps.part(more), xi_left[more])
            near = (arcs.inside[:, :-1] | arcs.inside[:, 1:] | arcs.passing) & (best.distance[arcs.row, None] > 0)
            arc, place = np.nonzero(near)
            crossed, share = self._crossed(np.stack([arcs.xi_left[arc, place], arcs.xi_left[arc, place + 1]], axis=1))
            arc, place, share = arc[crossed], place[crossed], share[:, None]
            guess = (1 - share) * arcs.q[arc, place] + share * arcs.q[arc, place + 1]
            self._take_solutions(targets, arcs.row[arc], guess, tolerance, best)
            ends = ends.joined(self._take_points(targets, arcs, best))
            # mark other starts that lie on the new curves
            on = np.flatnonzero((best.distance[traces.row] > 0) & ~known[of].all(axis=1))
            np.logical_or.at(known, of[on], self.tracer.on_curves(q[of[on]], traces.part(on)))
            traced.append(traces)
        return ends

    def _reach(self, targets: Array, starts: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Move starts (S, N, n) to the task values of targets (N, n); limits are ignored.

        Returns:
            Positions (N, S, n), and which of them did not reach their task value, (N, S).
        """
        S, N, n = starts.shape
        x = np.repeat(targets[:, : self.boxed.m], S, axis=0)
        q, arrived = self.tracer.reach(x, starts.transpose(1, 0, 2).reshape(-1, n))
        return q.reshape(N, S, n), ~arrived.reshape(N, S)

    def _steps(self, traces: Traces, own: Array) -> "Steps":
        """The steps of all curves that lie in or near the box of the domain, after shifts by full turns.

        `own` (K, n) are the positions near which joints without boundaries are placed.
        """
        curve, shift = self._sheets(traces, own)
        low, high = self.boxed.domain.bounds
        # steps with at least one end near the box
        moved = traces.q[curve] + shift[:, None]
        near = np.asarray(((moved >= low - RULES.step) & (moved <= high + RULES.step)).all(axis=2))
        at, place = np.nonzero((near[:, :-1] | near[:, 1:]) & (np.arange(1, near.shape[1]) < traces.count[curve, None]))
        of, turn = curve[at], shift[at]
        q = np.stack([traces.q[of, place] + turn, traces.q[of, place + 1] + turn], axis=1)
        t = np.stack([traces.tangent[of, place], traces.tangent[of, place + 1]], axis=1)
        # whether a step begins where the one before it ends
        follows = np.diff(at * near.shape[1] + place, prepend=-2) == 1
        return Steps(traces.row[of], q, t, follows)

    def _take_crossed(self, targets: Array, steps: "Steps", tolerance: float, best: Nearest) -> Array:
        """Solve phi(q) = phi on steps along which xi crosses its target; take the solutions inside into `best`.

        Returns:
            xi - xi(q) at both ends of the steps, (S, 2); NaN far from the box.
        """
        # A step that follows another one shares its first end with it, so xi is evaluated there once.
        left, low, high = np.full(steps.q.shape[:2], np.nan), *self.boxed.domain.bounds
        slack = RULES.step / RULES.parts
        near = np.asarray(((steps.q >= low - slack) & (steps.q <= high + slack)).all(axis=2))
        begins = near.copy()
        begins[1:, 0] &= ~(steps.follows[1:] & near[:-1, 1])
        rows = np.broadcast_to(steps.row[:, None], near.shape)
        left[begins] = self._xi_left(targets[rows[begins]], steps.q[begins])
        joined = near[:, 0] & ~begins[:, 0]
        left[joined, 0] = left[np.flatnonzero(joined) - 1, 1]
        step, share = self._crossed(left)
        self._take_solutions(targets, steps.row[step], steps.point(step, share), tolerance, best)
        return left

    def _crossed(self, left: Array) -> tuple[Indices, Array]:
        """Steps along which xi - xi(q), given at both ends (S, 2), crosses 0, and the fraction of the step there."""
        a, b = left.T
        crossed = np.flatnonzero((a * b <= 0) & ~(np.abs(b - a) > self._period / 2))
        a, b = a[crossed], b[crossed]
        return crossed, np.where(a == b, 0.0, a / np.where(a == b, 1.0, a - b))

    def _arcs(self, targets: Array, steps: "Steps", left: Array) -> "Arcs":
        """Closely spaced points on the steps that may hold a root, an end of an arc, or a point where xi turns back."""
        steps = steps.part(self._matters(steps, left))
        low, high = self.boxed.domain.bounds
        # divide the steps and correct the points back to the curve, twice if they may lie inside the domain
        q, along = steps.divided()
        slack = RULES.step / RULES.parts
        close = np.asarray(((q >= low - slack) & (q <= high + slack)).all(axis=2))
        x = targets[np.repeat(steps.row, close.sum(axis=1)), : self.boxed.m]
        points, t = q[close], along[close]
        points += self.tracer.correct(x, points, t)[0]
        within = ((points >= low - RULES.sagitta) & (points <= high + RULES.sagitta)).all(axis=1)
        points[within] += self.tracer.correct(x[within], points[within], t[within])[0]
        q[close] = points
        inside, xi_left = np.zeros(close.shape, dtype=bool), np.full(close.shape, np.nan)
        inside[close] = self._contains(points)
        xi_left[close] = self._xi_left(targets[np.repeat(steps.row, close.sum(axis=1))], points)
        # chords between two points outside that may cut through a corner of the box
        passing = close[:, :-1] & close[:, 1:] & ~inside[:, :-1] & ~inside[:, 1:]
        arc, place = np.nonzero(passing)
        first, last = self._shares_inside(q[arc, place], q[arc, place + 1], RULES.sagitta)
        passing[arc, place] = first < last
        return Arcs(steps.row, q, inside, passing, xi_left)

    def _matters(self, steps: "Steps", left: Array) -> NDArray[np.bool_]:
        """Which steps (S,) must be examined at closely spaced points.

        These are steps along which xi crosses its target, the domain is entered or left, or xi turns back, and their
        neighbours. On all other steps, either xi is monotonic and both ends lie in the domain, or the step lies outside
        the box. `left` is xi - xi(q) at the ends of the steps, (S, 2).
        """
        inside = np.zeros(steps.q.shape[:2], dtype=bool)
        inside[:, 1] = self._contains(steps.q[:, 1])
        # whether the ends of steps lie in the domain; consecutive steps share an end
        begins = np.flatnonzero(~steps.follows)
        inside[begins, 0] = self._contains(steps.q[begins, 0])
        joined = np.flatnonzero(steps.follows)
        inside[joined, 0] = inside[joined - 1, 1]
        both, none = np.asarray(inside.all(axis=1)), np.asarray(~inside.any(axis=1))
        # steps with one end inside and one outside, that cut a corner of the box, or that cross the target
        first, last = self._shares_inside(steps.q[:, 0], steps.q[:, 1], RULES.missed)
        changes = np.where(none, first < last, ~both)
        changes[self._crossed(left)[0]] = True
        ahead = wrap_shortest((left[:, 1] - left[:, 0])[:, None], self.boxed.phi_map.difference.turns[self.boxed.m :])[
            :, 0
        ]
        # where xi turns back between two steps
        bends = steps.follows.copy()
        bends[1:] &= ~(ahead[1:] * ahead[:-1] > 0) & both[1:] & both[:-1]
        # The first and last step of a curve count, too: without a neighbour, a turn of xi at its end goes unnoticed.
        after = np.append(steps.follows[1:], False)
        changes |= bends | (both & ~(steps.follows & after))
        # add neighbours, because a root or turning point may lie just beyond the shared end
        around = changes.copy()
        around[1:] |= changes[:-1] & steps.follows[1:]
        around[:-1] |= changes[1:] & after[:-1]
        return np.asarray(around & ~(none & ~changes))

    def _sheets(self, traces: Traces, own: Array) -> tuple[Indices, Array]:
        """Full turns that bring the K curves into the box of the domain.

        Joints without boundaries are brought within half a turn of `own` (K, n), or within one and a half turns if
        their turns change xi.

        Returns:
            Indices of curves (L,) and shifts (L, n) [rad]; a curve may occur with several shifts.
        """
        low, high = self.boxed.domain.bounds
        turn, room, bounded = 2 * np.pi, RULES.step, np.isfinite(low)
        # the box, widened by a step; for joints without boundaries an interval around `own`
        low = np.where(bounded, low - room, own - np.where(self.boxed.winding, 3 * np.pi, np.pi))[:, None]
        high = np.where(bounded, high + room, np.inf)
        # the lowest number of turns that brings each point above `low`, and where that number changes along the curve
        first = np.where(self.tracer.turning, np.ceil((low - traces.q) / turn), 0.0)
        at = traces.q + turn * first
        passed = np.ones(at.shape[:2], dtype=bool)
        passed[:, 1:] = (first[:, 1:] != first[:, :-1]).any(axis=2)
        # numbers of additional turns of each joint that still fit
        width = np.where(bounded, (high - low[0, 0]) // turn, np.where(self.boxed.winding, 2, 0))
        choices = [range(1 + int(k)) for k in np.where(self.tracer.turning, width, 0)]
        near = [
            [(at[:, :, j] >= low[:, :, j]) & (at[:, :, j] <= high[j] - turn * k) for k in choices[j]]
            for j in range(len(high))
        ]
        found = []
        # For each choice of additional turns: list the curve with it wherever the shifted curve enters the box.
        for extra in product(*choices):
            close = np.all([near[j][k] for j, k in enumerate(extra)], axis=0)
            changes = np.asarray(close & passed)
            changes[:, 1:] |= close[:, 1:] & ~close[:, :-1]
            curve, place = np.nonzero(changes)
            found.append(np.column_stack([curve, first[curve, place] + np.array(extra)]))
        sheets = np.unique(np.concatenate(found), axis=0)
        return sheets[:, 0].astype(np.int64), turn * sheets[:, 1:]

    def _take_solutions(self, targets: Array, rows: Indices, q: Array, tolerance: float, best: Nearest) -> None:
        """Take solutions inside the domain into `best` that Newton steps reach from points q (K, n) of rows (K,)."""
        q, solved = self._solve(targets, rows, q, tolerance)
        best.take(rows[solved], q, np.zeros(len(q)))

    def _solve(self, targets: Array, rows: Indices, q: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """Newton's method from points q (K, n) for the targets of rows (K,).

        Returns:
            The solutions inside the domain, (S, n), and which of the points led to them, (K,).
        """
        if not rows.size:
            return q, np.zeros(0, dtype=bool)
        phi_map = self.boxed.phi_map
        for _ in range(RULES.newton):
            J = phi_map.jacobian(q) / phi_map.sizes[:, None]
            left_over = phi_map.difference(targets[rows], phi_map.phi(q)) / phi_map.sizes
            q = q + solutions_of(J, left_over[:, :, None])[:, :, 0]
        # move points that miss the boundary by rounding onto it
        moved = np.clip(q, *self.boxed.domain.bounds)
        near = np.abs(moved - q) <= RULES.snap * self.boxed.domain.half_width
        q = np.where(near.all(axis=1, keepdims=True), moved, q)
        solved = np.asarray(np.isfinite(q).all(axis=1))
        solved[solved] = largest(phi_map.residual(targets[rows[solved]], q[solved])) <= tolerance
        solved[solved] = self.boxed.domain.contains(q[solved])
        return q[solved], solved

    def _take_points(self, targets: Array, arcs: "Arcs", best: Nearest) -> "Ends":
        """Take points of arcs that lie in the domain into `best`; return ends of arcs that may be nearer."""
        # points inside are candidates for the nearest xi
        inside = arcs.inside & (best.distance > 0)[arcs.row][:, None]
        arc, place = np.nonzero(inside)
        rows, here = arcs.row[arc], arcs.xi_left[arc, place]
        best.take(rows, arcs.q[arc, place], np.abs(here), between=True)
        found = []
        # an arc that ends between a point inside and its neighbour may be nearer at the end than at both
        for side in (-1, 1):
            beyond = np.clip(place + side, 0, inside.shape[1] - 1)
            there = arcs.xi_left[arc, beyond]
            least = np.where(here * there > 0, np.minimum(np.abs(here), np.abs(there)), 0.0)
            ends = ~inside[arc, beyond] & np.isfinite(there) & (least < best.distance[rows])
            points = arcs.q[arc[ends], place[ends]], arcs.q[arc[ends], beyond[ends]]
            found.append(Ends(rows[ends], *points, least[ends]))
        return found[0].joined(found[1]).joined(self._take_short(targets, arcs, best))

    def _take_short(self, targets: Array, arcs: "Arcs", best: Nearest) -> "Ends":
        """Find short arcs between neighbouring points outside, by halving chords that pass through the box.

        Takes points of these arcs into `best`, and returns their ends.
        """
        arc, place = np.nonzero(arcs.passing & (best.distance > 0)[arcs.row][:, None])
        a, b, rows, found = arcs.q[arc, place], arcs.q[arc, place + 1], arcs.row[arc], Ends.empty(arcs.q.shape[2])
        for level in range(RULES.halvings):
            first, last = self._shares_inside(a, b, RULES.sagitta / 4**level)
            passing = first < last
            a, b, rows = a[passing], b[passing], rows[passing]
            if not rows.size:
                break
            q = a + ((first + last) / 2)[passing, None] * (b - a)
            for _ in range(2):
                q = q + self.tracer.correct(targets[rows, : self.boxed.m], q, b - a)[0]
            good = self._contains(q)
            left = np.abs(self._xi_left(targets[rows[good]], q[good]))
            best.take(rows[good], q[good], left, between=True)
            for other in (a[good], b[good]):
                found = found.joined(Ends(rows[good], q[good], other, np.zeros(len(left))))
            # Halve again only if the middle is outside the box; a middle that violates a condition is given up.
            again = ~good & ~self._in_box(q)
            a, b, rows = (
                np.concatenate([a[again], q[again]]),
                np.concatenate([q[again], b[again]]),
                np.tile(rows[again], 2),
            )
        return found

    def _shares_inside(self, a: Array, b: Array, slack: float) -> tuple[Array, Array]:
        """Intersect chords from a to b (K, n) with the box, widened by `slack`.

        Returns:
            Fractions (K,) of the chord at which it enters and leaves the box; it misses the box unless the first is
            less than the second.
        """
        low, high = self.boxed.domain.bounds
        step = np.where(np.abs(b - a) > 1e-300, b - a, 1e-300)
        one, other = (low - slack - a) / step, (high + slack - a) / step
        first, last = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
        return np.maximum(first, 0.0), np.minimum(last, 1.0)

    def _contains(self, q: Array) -> NDArray[np.bool_]:
        """Whether points (N, n) lie in the domain, (N,); NaN counts as outside."""
        inside = self._in_box(q)
        inside[inside] = self.boxed.domain.contains(q[inside])
        return inside

    def _in_box(self, q: Array) -> NDArray[np.bool_]:
        """Whether points (N, n) lie in the box of the domain, (N,)."""
        low, high = self.boxed.domain.bounds
        return np.asarray(((q >= low) & (q <= high)).all(axis=1))

    def _xi_left(self, targets: Array, q: Array) -> Array:
        """xi - xi(q), (N,)."""
        return self.boxed.xi_gaps(targets, q)[:, 0]

    @cached_property
    def has_kernel(self) -> bool:
        """Whether the search runs in C; the first call for a chart compiles it."""
        return has_library(self.kernel)

    @cached_property
    def _period(self) -> float:
        """The period of xi; infinite where it has none."""
        turn = float(self.boxed.phi_map.difference.turns[self.boxed.m])
        return turn if turn > 0 else np.inf


@dataclass(frozen=True, eq=False)
class Steps:
    """S steps of curves in and near the box of the domain."""

    row: Indices  #: number of the target, (S,)
    q: Array  #: both ends, (S, 2, n)
    tangent: Array  #: unit tangents there, (S, 2, n)
    follows: NDArray[np.bool_]  #: whether a step begins where the one before it ends, (S,)

    def part(self, which: NDArray[np.bool_]) -> "Steps":
        """The steps that `which` (S,) selects."""
        row, q, tangent, follows = (array[which] for array in vars(self).values())
        follows[1:] &= np.diff(np.flatnonzero(which)) == 1
        follows[:1] = False
        return Steps(row, q, tangent, follows)

    def point(self, steps: Indices, share: Array) -> Array:
        """Points (K, n) of some steps (K,) at fractions `share` (K,) of the step, on cubic curves."""
        return _on_cubics(self.q[steps], self.tangent[steps], share[:, None])[:, 0]

    def divided(self, parts: int = RULES.parts) -> tuple[Array, Array]:
        """`parts` + 1 points on each step, on cubic curves, and approximate tangents there, (S, parts + 1, n) each."""
        s = np.broadcast_to(np.arange(parts + 1) / parts, (len(self.q), parts + 1))
        along = (1 - s[:, :, None]) * self.tangent[:, :1] + s[:, :, None] * self.tangent[:, 1:]
        return _on_cubics(self.q, self.tangent, s), along


@dataclass(frozen=True, eq=False)
class Arcs:
    """S steps of curves near the domain, each with G closely spaced points. Parts inside the domain are arcs."""

    row: Indices  #: number of the target, (S,)
    q: Array  #: (S, G, n)
    inside: NDArray[np.bool_]  #: which points lie in the domain, (S, G)
    passing: NDArray[np.bool_]  #: whether a chord between neighbours outside passes through the box, (S, G - 1)
    xi_left: Array  #: xi - xi(q), (S, G); NaN far from the domain


@dataclass(frozen=True, eq=False)
class Ends:
    """K ends of arcs, each bracketed by neighbouring points inside and outside the domain."""

    row: Indices  #: number of the target, (K,)
    inside: Array  #: the last point inside, (K, n)
    outside: Array  #: the point after that, (K, n)
    least: Array  #: estimate of the least |xi - xi(q)| between them, (K,)

    @classmethod
    def empty(cls, n: int) -> "Ends":
        """No ends, for n joints."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, n)), np.zeros((0, n)), np.zeros(0))

    def joined(self, other: "Ends") -> "Ends":
        """The ends of both."""
        parts = zip(vars(self).values(), vars(other).values(), strict=True)
        return Ends(*(np.concatenate(pair) for pair in parts))


def _on_cubics(q: Array, t: Array, share: Array) -> Array:
    """Points (K, G, n) at fractions `share` (K, G) of cubic curves with ends q and unit tangents t (K, 2, n)."""
    s, step = share[:, :, None], q[:, 1:] - q[:, :1]
    bend = (s - 2 * s**2 + s**3) * t[:, :1] + (s**3 - s**2) * t[:, 1:]
    return np.asarray(q[:, :1] + (3 * s**2 - 2 * s**3) * step + np.linalg.norm(step, axis=2, keepdims=True) * bend)
