"""Steps along self-motions to the nearest xi, of many rows at once: x is kept, and the domain is not left."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.descent import BoxedPhi
from orthocas.charts.newton import inverses
from orthocas.charts.phi import largest
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


RULES = SlideRules()


@dataclass(frozen=True, eq=False)
class Slide:
    """Where N rows ended."""

    u: Array  #: points of the box, (N, n)
    error: Array  #: largest error of x, (N,)
    distance: Array  #: |xi - xi(q)|, (N,); infinite outside the domain


def slide(boxed: BoxedPhi, targets: Array, start: Array, most: int = RULES.most) -> Slide:
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
        self._longest = np.full(len(start), RULES.longest)
        self._before = np.zeros((len(start), 2, start.shape[1] - boxed.m))  # the last z, as projected and as taken
        self._held = np.zeros(start.shape, dtype=np.int8)  # which bounds the last steps held
        self._meets = np.zeros(len(start), dtype=bool)  # rows that met the end of a condition

    def advance(self, rows: Indices) -> Indices:
        """Try a step in some rows; returns those that go on."""
        boxed, m, gap, u = self._boxed, self._boxed.m, self.gap[rows], self.u[rows]
        J = boxed.phi_map.jacobian(boxed.points(u)) * boxed.domain.half_width / self._sizes[:, None]
        H = inverses(J)[0]
        P, B, left = H[:, :, :m], H[:, :, m:], gap[:, m:]
        longest, walls = self._longest[rows, None], self._walls(rows, u)
        back = _times(P, gap[:, :m])
        wanted = left * np.minimum(1.0, longest / _size(_times(B, left)))
        z, held = walls.project(B, back, wanted, self._held[rows])
        stretch, plain = self._stretches(rows, z), z
        some = np.flatnonzero(stretch != 1)
        if some.size:
            z = z.copy()
            z[some] = walls.part(some).project(B[some], back[some], stretch[some, None] * z[some], held[some])[0]
        d = back + _times(B, z)
        part = np.minimum(1.0, longest / _size(d))
        d, z = np.clip(part * d, boxed.low - u, boxed.high - u), part * z
        new, after = self._corrected(rows, u + d, P, B, walls.slopes, held)
        error, before = largest(after[:, :m]), largest(gap[:, :m])
        square = (left**2).sum(axis=1)
        promised = 2 * (left * z).sum(axis=1) - (z**2).sum(axis=1) / stretch
        gain, size = square - (after[:, m:] ** 2).sum(axis=1), np.abs(promised)
        good = (error < RULES.bent) | (error < 0.9 * before)
        good &= (
            (gain > promised - (1 - RULES.gains) * size - RULES.least * (1 + square))
            | (before > RULES.bent)
            | ((before > RULES.kept) & (error < before / 2))
        )
        inside = good.copy()
        inside[good] = boxed.domain.contains(boxed.points(new[good]))
        met = good & ~inside & ~self._meets[rows] & boxed.has_rooms
        self._meets[rows[met]] = True
        moved = rows[inside]
        self.u[moved], self.gap[moved] = new[inside], after[inside]
        self._held[rows] = held[:, : u.shape[1]]
        self._before[moved] = np.stack([plain, z], axis=1)[inside]
        foreseen = (error < RULES.straight) | (gain > promised - (1 - RULES.foreseen) * size)
        longer = np.where(foreseen, np.minimum(2 * longest[:, 0], RULES.longest), longest[:, 0])
        shorter = np.minimum(longest[:, 0], np.abs(d).max(axis=1)) / 3
        self._longest[rows] = np.where(inside, longer, np.where(met, longest[:, 0], shorter))
        ended = (size <= RULES.converged * square + RULES.rounded) | (np.abs(d).max(axis=1) <= RULES.still)
        ended &= (before <= RULES.kept) & ~met
        return np.asarray(rows[~ended & (self._longest[rows] > RULES.shortest)])

    def _stretches(self, rows: Indices, z: Array) -> Array:
        """How much longer steps z (rows, r) should be, or shorter, where boundaries bend: Barzilai and Borwein's rule.

        Only where the last step went the same way.
        """
        plain, taken = self._before[rows].swapaxes(0, 1)
        along, size = (taken * z).sum(axis=1), (taken**2).sum(axis=1)
        same = along > RULES.aligned * np.sqrt(size * (z**2).sum(axis=1))
        stretch = size / (taken * (plain - z)).sum(axis=1)
        good = same & (stretch > 0) & np.isfinite(stretch)
        return np.where(good, np.clip(stretch, 1 / RULES.stretch, RULES.stretch), 1.0)

    def _corrected(
        self, rows: Indices, new: Array, P: Array, B: Array, slopes: Array, held: NDArray[np.int8]
    ) -> tuple[Array, Array]:
        """Points after a second step to x, and into the domain, and what is left of phi there, (rows, n) each.

        Only where x is nearer after it. Conditions bend, so they are evaluated again.
        """
        m, boxed = self._boxed.m, self._boxed
        after = self._gaps(rows, new)
        error = largest(after[:, :m])
        some = np.flatnonzero(((error > RULES.kept) | self._meets[rows]) & (error < RULES.corrected * RULES.bent))
        if some.size:
            back, walls = _times(P[some], after[some, :m]), self._walls(rows[some], new[some], slopes[some])
            z, _ = walls.project(B[some], back, np.zeros((len(some), B.shape[2])), held[some])
            again = np.clip(new[some] + back + _times(B[some], z), boxed.low, boxed.high)
            gaps = self._gaps(rows[some], again)
            better = largest(gaps[:, :m]) < np.maximum(error[some], RULES.kept)
            new[some[better]], after[some[better]] = again[better], gaps[better]
        return new, after

    def _walls(self, rows: Indices, u: Array, slopes: Array | None = None) -> "Walls":
        """The boundaries as seen from points u of some rows; the slopes of conditions may be those of other points."""
        boxed = self._boxed
        low, high = boxed.low - u, boxed.high - u
        meets = np.flatnonzero(self._meets[rows])
        if not meets.size:
            return Walls(low, high, np.zeros((len(rows), 0, u.shape[1])))
        near = boxed.rooms(u[meets]) - RULES.room
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
        """Those of some rows."""
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
    for k in range(RULES.rounds):
        if solve.size:
            A, bounds, K = _penalised(B[solve], low[solve], high[solve], held[solve])
            pull = wanted[solve] + RULES.penalty * _times(A.transpose(0, 2, 1), bounds)
            z[solve] = np.linalg.solve(K, pull[:, :, None])[:, :, 0]
        values = _times(B[left], z[left])
        now = (values > high[left]) * 1 - (values < low[left]) * 1
        changes = now != held[left]
        if k >= RULES.rounds // 6:  # the first bound alone, so that they do not change back and forth
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
            excess = RULES.penalty * _times(A.transpose(0, 2, 1), bounds - _times(A, z[some]))
            z[some] += np.linalg.solve(K, excess[:, :, None])[:, :, 0]
    return z, held


def _penalised(B: Array, low: Array, high: Array, held: NDArray[np.int8]) -> tuple[Array, Array, Array]:
    """Rows of B (N, k, r) and bounds (N, k) that are held, 0 elsewhere, and 1 + penalty B^T B of these, (N, r, r)."""
    A = B * (held != 0)[:, :, None]
    bounds = np.where(held > 0, high, np.where(held < 0, low, 0.0))
    K = RULES.penalty * (A.transpose(0, 2, 1) @ A)
    ridge = 1 + 1e-12 * np.trace(K, axis1=1, axis2=2)
    return A, bounds, K + ridge[:, None, None] * np.eye(B.shape[2])


def _times(matrices: Array, vectors: Array) -> Array:
    """Products of matrices (N, i, j) and vectors (N, j), (N, i)."""
    products: Array = (matrices @ vectors[:, :, None])[:, :, 0]
    return products


def _size(steps: Array) -> Array:
    """Largest change of a joint, (N, 1)."""
    return np.asarray(np.maximum(np.abs(steps).max(axis=1, keepdims=True), 1e-300))
