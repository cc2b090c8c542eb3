"""The search of a whole domain for solutions of phi(q) = phi, by cells that may hold one."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.descent import BoxedPhi, descend
from orthocas.charts.newton import inverses
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices

MARGIN = 0.75  #: how far outside its range y may lie, relative to half of the range
CORE = 0.25  #: the same, for cells that most probably hold a solution if there is one
_HALVINGS = 10  # so many cells as 2 to the power of it
_PROBES, _SAMPLES, _SEED = 64, 32, 1  # points that measure how phi bends, and points in each cell
_NEAR = 1.25  # starts may leave their cell by so much, relative to its half-widths
_CELLS_AT_ONCE = (1, 3, 12)  # cells of a row that has no solution yet, searched at once; then all that are left
_AGAIN = 3  # further starts in each of the likeliest cells, at last
_ALL = 16  # further starts in each cell, for all solutions of one target
_MOST_FROM_CELLS, _PATIENCE_FROM_CELLS = 32, 3  # iterations; after so many, the error must have halved
_AT_ONCE = 1024  # rows whose starts are held in memory
_SAME = 1e-6  # of the half-widths: distance up to which two solutions count as one


class Places(NamedTuple):
    """What N targets would be in G cells."""

    overshoot: Array  #: how far y lies outside its range, relative to half of the range, (N, G)
    start: Array  #: where phi would be the target if it were linear in the cell, (N, G, n)


@dataclass(frozen=True)
class _Linear:
    """phi in each of G cells."""

    phi: Array  #: in the middle, (G, n)
    inverse: Array  #: J^-1 in the middle, (G, n, n); 0 where it is not finite
    y: Array  #: of samples of the cell, (G, samples, n)
    low: Array  #: least y of the cell, (G, n)
    high: Array  #: greatest y of the cell, (G, n)
    known: NDArray[np.bool_]  #: cells where all this is finite, (G,)


class Cells:
    """The cells of a domain, in half-widths from its centre. They are measured once for each chart, in 0.1 s."""

    def __init__(self, boxed: BoxedPhi) -> None:
        self._boxed = boxed

    def places(self, targets: Array) -> Places:
        """Where targets (N, n) of phi would be in each cell."""
        linear, middles = self._linear, self._middles
        y = np.einsum("gij,ngj->ngi", linear.inverse, self._difference(targets[:, None], linear.phi))
        half = (linear.high - linear.low) / 2
        outside = np.maximum(linear.low - y, y - linear.high) / np.where(half > 0, half, 1.0)
        overshoot = np.where(linear.known, outside.max(axis=2), 0.0)
        width = _NEAR * self._half_width
        return Places(overshoot, np.clip(middles + np.clip(y, -width, width), -1.0, 1.0))

    def samples(self, targets: Array, cells: Indices, count: int) -> Array:
        """The samples of given cells (N,) that are nearest to targets (N, n), (N, count, n)."""
        linear = self._linear
        y = np.einsum("kij,kj->ki", linear.inverse[cells], self._difference(targets, linear.phi[cells]))
        away = np.abs((linear.y[cells] - y[:, None]) / self._half_width).max(axis=2)
        nearest = self._unit[np.argsort(away, axis=1)[:, :count]]
        points: Array = self._middles[cells][:, None] + self._half_width * nearest
        return points

    def _difference(self, targets: Array, phi: Array) -> Array:
        difference: Array = self._boxed.phi_map.difference(targets, phi)
        return difference

    @cached_property
    def _halved(self) -> tuple[int, ...]:
        """How often each joint's range is halved, (n,): again and again where phi bends most."""
        n = len(self._boxed.low)
        halved = np.zeros(n, dtype=int)
        for _ in range(_HALVINGS):
            halved[int(np.argmax(self._bends(0.5**halved)))] += 1
        return tuple(int(times) for times in halved)

    def _bends(self, width: Array) -> Array:
        """Median |J^-1 (phi(u + t w e_j) - phi(u)) - t w e_j|, (n,), for cells with half-widths w, and random t, u."""
        boxed, n = self._boxed, len(width)
        rng, found = np.random.default_rng(_SEED), np.empty(n)
        for j in range(n):
            u, steps = rng.uniform(-1, 1, (_PROBES, n)), np.zeros((_PROBES, n))
            u[:, j] *= 1 - width[j]
            steps[:, j] = width[j] * rng.uniform(-1, 1, _PROBES)
            here, there = (boxed.phi_map.phi(boxed.points(at)) for at in (u, u + steps))
            inverse = _finite(inverses(self._jacobian(u))[0])
            y = np.einsum("kij,kj->ki", inverse, boxed.phi_map.difference(there, here))
            size = np.linalg.norm(y - steps, axis=1)
            found[j] = np.median(np.where(np.isfinite(size), size, 0.0))
        return found

    @cached_property
    def _middles(self) -> Array:
        """Middles of the cells, (G, n)."""
        along = [(2.0 * np.arange(2**times) + 1) / 2**times - 1 for times in self._halved]
        return np.asarray(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(along)))

    @cached_property
    def _half_width(self) -> Array:
        """Of each cell, (n,)."""
        return np.asarray(0.5 ** np.array(self._halved))

    @cached_property
    def _unit(self) -> Array:
        """Points of [-1, 1]^n, uniform, near faces, and corners, (samples, n)."""
        rng = np.random.default_rng(_SEED)
        unit = rng.uniform(-1, 1, (_SAMPLES, len(self._half_width)))
        return np.asarray(np.sign(unit) * np.abs(unit) ** rng.choice([1.0, 0.25, 0.0], (_SAMPLES, 1)))

    @cached_property
    def _linear(self) -> _Linear:
        boxed, middles = self._boxed, self._middles
        phi = boxed.phi_map.phi(boxed.points(middles))
        inverse = inverses(self._jacobian(middles))[0]
        points = (middles[:, None] + self._half_width * self._unit).reshape(-1, middles.shape[1])
        values = boxed.phi_map.phi(boxed.points(points)).reshape(len(middles), -1, middles.shape[1])
        with np.errstate(invalid="ignore"):
            y = np.einsum("gij,gkj->gki", inverse, boxed.phi_map.difference(values, phi[:, None]))
        known = np.isfinite(y).all(axis=(1, 2))
        phi, inverse, y = _finite(phi), _finite(inverse), _finite(y)
        return _Linear(phi, inverse, y, y.min(axis=1), y.max(axis=1), known)

    def _jacobian(self, u: Array) -> Array:
        """dphi/du, (N, n, n)."""
        return self._boxed.phi_map.jacobian(self._boxed.points(u)) * self._boxed.domain.half_width


def _finite(values: Array) -> Array:
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


@dataclass(frozen=True, eq=False)
class InDomain:
    """Searches all of the domain."""

    boxed: BoxedPhi
    cells: Cells

    def search(self, targets: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """The points of the domain with the least error that are found for targets (N, n).

        Returns:
            q (N, n), and which of them are solutions, (N,).
        """
        u, error = np.zeros_like(targets), np.full(len(targets), np.inf)
        for first in range(0, len(targets), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            u[rows], error[rows] = self._searched(targets[rows], tolerance)
        return self.boxed.points(u), np.asarray(error <= tolerance)

    def all_solutions(self, target: Array, tolerance: float) -> Array:
        """Different solutions for a target (n,), that nearest to the centre first, (k, n)."""
        places = self.cells.places(target[None])
        likely = np.flatnonzero(places.overshoot[0] <= MARGIN)
        more = self.cells.samples(np.broadcast_to(target, (len(likely), len(target))), likely, _ALL)
        starts = np.vstack([places.start[0, likely], more.reshape(-1, len(target))])
        u, error = self._solved(np.broadcast_to(target, starts.shape), starts, tolerance)
        u = u[error <= tolerance]
        different: list[Array] = []
        for row in u[np.argsort(np.linalg.norm(u, axis=1))]:
            if all(np.abs(row - other).max() > _SAME for other in different):
                different.append(row)
        return self.boxed.points(np.array(different).reshape(-1, len(target)))

    def _searched(self, targets: Array, tolerance: float) -> tuple[Array, Array]:
        """The best points u (N, n), and their errors (N,)."""
        places, best = self.cells.places(targets), _Best(np.zeros_like(targets), np.full(len(targets), np.inf))
        order, done = np.argsort(places.overshoot, axis=1), 0
        likely = np.maximum((places.overshoot <= MARGIN).sum(axis=1), 1)  # cells to search, in this order
        for count in (*_CELLS_AT_ONCE, order.shape[1]):
            rows = np.flatnonzero((best.error > tolerance) & (likely > done))
            rank = np.arange(done, min(done + count, order.shape[1]))
            row, place = np.nonzero(rank < likely[rows, None])
            row, cell = rows[row], order[rows[row], rank[place]]
            best.take(row, *self._solved(targets[row], places.start[row, cell], tolerance))
            done += count
        self._search_again(targets, places, best, tolerance)
        return best.u, best.error

    def _search_again(self, targets: Array, places: Places, best: "_Best", tolerance: float) -> None:
        """Search from other starts in the likeliest cells."""
        row, cell = np.nonzero((places.overshoot <= CORE) & (best.error > tolerance)[:, None])
        starts = self.cells.samples(targets[row], cell, _AGAIN).reshape(-1, targets.shape[1])
        row = np.repeat(row, _AGAIN)
        best.take(row, *self._solved(targets[row], starts, tolerance))

    def _solved(self, targets: Array, starts: Array, tolerance: float) -> tuple[Array, Array]:
        """Where searches end, (N, n), and the errors (N,): infinite for solutions that a condition forbids."""
        with np.errstate(all="ignore"):
            end = descend(
                self.boxed.phi_equations, targets, starts, most=_MOST_FROM_CELLS, patience=_PATIENCE_FROM_CELLS
            )
        u, error = end.u, end.error
        solved = np.flatnonzero(error <= tolerance)
        error[solved[~self.boxed.domain.contains(self.boxed.points(u[solved]))]] = np.inf
        return u, error


@dataclass(frozen=True, eq=False)
class _Best:
    """The best points so far."""

    u: Array  #: (N, n)
    error: Array  #: (N,)

    def take(self, rows: Indices, u: Array, error: Array) -> None:
        """Take over what searches (M,) found for some rows (M,), which may occur several times."""
        worst_first = np.argsort(-error, kind="stable")  # what is written last stays
        better = worst_first[error[worst_first] < self.error[rows[worst_first]]]
        self.u[rows[better]], self.error[rows[better]] = u[better], error[better]
