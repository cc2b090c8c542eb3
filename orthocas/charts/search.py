"""Searches of a whole domain: from stored positions, and in cells that may hold a solution."""

from dataclasses import dataclass
from math import comb
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.charts.descent import BoxedPhi, descend
from orthocas.charts.newton import inverses
from orthocas.charts.phi import PhiMap
from orthocas.errors import SingularTaskError
from orthocas.tasks.domains import Domain
from orthocas.tasks.samples import sample_boundary_weighted
from orthocas.tools.cached import BuiltOnUse, cached_property
from orthocas.tools.checks import Array, Indices


@dataclass(frozen=True, slots=True)
class SearchRules:
    """Numbers of the searches. Chosen and held on the ready charts, other seeds (benchmarks/round_trips.py)."""

    points: int = 4096  #: of the table of stored positions
    seed: int = 0  #: of these
    degrees: tuple[int, ...] = (3, 2, 1)  #: of the rough inverse: the first one with so few terms
    most_terms: int = 500
    overshoot: float = 1.2  #: beyond the values of the table, polynomials are not trusted
    halvings: int = 10  #: so many cells as 2 to the power of it
    probes: int = 64  #: points that measure how phi bends
    samples: int = 32  #: points in each cell
    cell_seed: int = 1  #: of both
    margin: float = 0.75  #: how far outside its range y may lie, relative to half of the range
    core: float = 0.25  #: the same, for cells that most probably hold a solution if there is one
    near: float = 1.25  #: starts may leave their cell by so much, relative to its half-widths
    cells: tuple[int, ...] = (1, 3, 12)  #: of a row that has no solution yet, searched at once; then all that are left
    again: int = 3  #: further starts in each of the likeliest cells, at last
    all: int = 16  #: further starts in each cell, for all solutions of one target
    most: int = 32  #: iterations from a cell
    patience: int = 3  #: of these, within which the error must halve
    cell_rows: int = 1024  #: whose starts in cells are held in memory
    same: float = 1e-6  #: half-widths up to which two solutions count as one


RULES = SearchRules()


class Starts:
    """Joint positions from which Newton's method may reach phi(q) = phi.

    The rough inverse is a polynomial q(phi), fitted to 4,096 points of the domain by least squares. Both coordinates
    and task are smooth, so it is much closer than the centre of the domain. It takes 0.1 s once for each chart.
    """

    def __init__(self, phi_map: PhiMap, domain: Domain) -> None:
        self._map, self._domain = phi_map, domain

    def guess(self, targets: Array) -> Array:
        """The rough inverse at targets (N, n), moved into the box of the domain, (N, n)."""
        centre, half_width = self._domain.centre, self._domain.half_width
        q = _terms(self._normalised(targets), self._degree) @ self._coefficients
        guess: Array = np.clip(q, centre - half_width, centre + half_width)
        return guess

    def nearest(self, targets: Array, count: int, components: int) -> Array:
        """The points of the table whose phi is nearest to targets (N, n), nearest first, (count or fewer, N, n).

        Args:
            targets: values of phi.
            count: points for each target.
            components: how many components of phi count, the first ones.
        """
        points = self._table[0]
        order = self._trees[components].query(self._places(targets, components), range(1, min(count, len(points)) + 1))[
            1
        ]
        nearest: Array = points[order.T]
        return nearest

    @cached_property
    def _trees(self) -> BuiltOnUse[int, Any]:
        """Search trees of places of the table, by the number of components that count."""
        return BuiltOnUse(lambda components: scipy.spatial.cKDTree(self._places(self._table[1], components)))

    def _places(self, phi: Array, components: int) -> Array:
        """Numbers (N, k) that are near one another where the first components of phi (N, n) are."""
        normalised, relative = self._normalised(phi)[:, :components], self._map.difference.task
        if relative is None or not relative.turned:
            return normalised
        first, last = relative.first, relative.task.m
        orientations = relative.embed(phi[:, :last]) / self._range[1][first:last].mean()
        return np.concatenate([normalised[:, :first], orientations, normalised[:, last:]], axis=1)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Points of the domain where phi is defined, and phi, (K, n) each."""
        return where_known(self._map, sample_boundary_weighted(self._domain, RULES.points, RULES.seed))

    @cached_property
    def _range(self) -> tuple[Array, Array]:
        """Middle and half of the range of phi over the domain, (n,) each."""
        low, high = self._table[1].min(axis=0), self._table[1].max(axis=0)
        return (low + high) / 2, np.where(high > low, (high - low) / 2, 1.0)

    @cached_property
    def _coefficients(self) -> Array:
        """Coefficients of the rough inverse, (terms, n)."""
        points, phi = self._table
        found = np.linalg.lstsq(_terms(self._normalised(phi), self._degree), points, rcond=None)[0]
        return np.asarray(found, dtype=float)

    @property
    def _degree(self) -> int:
        n = len(self._domain.centre)
        return next((degree for degree in RULES.degrees if comb(n + degree, degree) <= RULES.most_terms), 1)

    def _normalised(self, phi: Array) -> Array:
        """Values of phi (N, n) in the range [-1, 1], or a little beyond."""
        middle, half = self._range
        return np.clip((phi - middle) / half, -RULES.overshoot, RULES.overshoot)


def where_known(phi_map: PhiMap, points: Array) -> tuple[Array, Array]:
    """The points (N, n) at which phi is finite, and phi there, (K, n) each.

    Raises:
        SingularTaskError: if there are none.
    """
    phi = phi_map.phi(points)
    known = np.isfinite(phi).all(axis=1)
    if not known.any():
        raise SingularTaskError(f"phi is not finite at any of {len(points)} samples of the domain")
    return points[known], phi[known]


def _terms(u: Array, degree: int) -> Array:
    """All monomials of the columns of u (N, n) up to a degree, (N, terms)."""
    columns = np.ascontiguousarray(u.T)
    # index of the last factor, product
    level = [(0, np.ones(len(u)))]
    terms = [level[0][1]]
    for _ in range(degree):
        level = [(j, product * columns[j]) for i, product in level for j in range(i, len(columns))]
        terms += [product for _, product in level]
    return np.array(terms).T


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
        width = RULES.near * self._half_width
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
        for _ in range(RULES.halvings):
            halved[int(np.argmax(self._bends(0.5**halved)))] += 1
        return tuple(int(times) for times in halved)

    def _bends(self, width: Array) -> Array:
        """Median |J^-1 (phi(u + t w e_j) - phi(u)) - t w e_j|, (n,), for cells with half-widths w, and random t, u."""
        boxed, n = self._boxed, len(width)
        rng, found = np.random.default_rng(RULES.cell_seed), np.empty(n)
        for j in range(n):
            u, steps = rng.uniform(-1, 1, (RULES.probes, n)), np.zeros((RULES.probes, n))
            # pairs of points that differ in joint j alone, both inside
            u[:, j] *= 1 - width[j]
            steps[:, j] = width[j] * rng.uniform(-1, 1, RULES.probes)
            here, there = (boxed.phi_map.phi(boxed.points(at)) for at in (u, u + steps))
            inverse = _finite(inverses(self._jacobian(u))[0])
            # how far a linear map from the first misses the second
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
        """Half-widths of each cell, (n,)."""
        return np.asarray(0.5 ** np.array(self._halved))

    @cached_property
    def _unit(self) -> Array:
        """Points of [-1, 1]^n, uniform, near faces, and corners, (samples, n)."""
        rng = np.random.default_rng(RULES.cell_seed)
        unit = rng.uniform(-1, 1, (RULES.samples, len(self._half_width)))
        return np.asarray(np.sign(unit) * np.abs(unit) ** rng.choice([1.0, 0.25, 0.0], (RULES.samples, 1)))

    @cached_property
    def _linear(self) -> _Linear:
        boxed, middles = self._boxed, self._middles
        phi = boxed.phi_map.phi(boxed.points(middles))
        inverse = inverses(self._jacobian(middles))[0]
        # phi at the corners of each cell, seen through J^-1 of its middle
        points = (middles[:, None] + self._half_width * self._unit).reshape(-1, middles.shape[1])
        values = boxed.phi_map.phi(boxed.points(points)).reshape(len(middles), -1, middles.shape[1])
        with np.errstate(invalid="ignore"):
            y = np.einsum("gij,gkj->gki", inverse, boxed.phi_map.difference(values, phi[:, None]))
        # cells without values everywhere have no bounds
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
        for first in range(0, len(targets), RULES.cell_rows):
            rows = slice(first, first + RULES.cell_rows)
            u[rows], error[rows] = self._searched(targets[rows], tolerance)
        return self.boxed.points(u), np.asarray(error <= tolerance)

    def all_solutions(self, target: Array, tolerance: float) -> Array:
        """The different solutions for a target (n,), the nearest to the centre first, (k, n)."""
        places = self.cells.places(target[None])
        # starts: the place in each cell that may hold a solution, and samples around it
        likely = np.flatnonzero(places.overshoot[0] <= RULES.margin)
        more = self.cells.samples(np.broadcast_to(target, (len(likely), len(target))), likely, RULES.all)
        starts = np.vstack([places.start[0, likely], more.reshape(-1, len(target))])
        u, error = self._solved(np.broadcast_to(target, starts.shape), starts, tolerance)
        u = u[error <= tolerance]
        different: list[Array] = []
        # solutions that differ, the nearest to the centre first
        for row in u[np.argsort(np.linalg.norm(u, axis=1))]:
            if all(np.abs(row - other).max() > RULES.same for other in different):
                different.append(row)
        return self.boxed.points(np.array(different).reshape(-1, len(target)))

    def _searched(self, targets: Array, tolerance: float) -> tuple[Array, Array]:
        """The best points u (N, n), and their errors (N,)."""
        places, best = self.cells.places(targets), _Best(np.zeros_like(targets), np.full(len(targets), np.inf))
        order, done = np.argsort(places.overshoot, axis=1), 0
        # cells to search, in this order
        likely = np.maximum((places.overshoot <= RULES.margin).sum(axis=1), 1)
        for count in (*RULES.cells, order.shape[1]):
            rows = np.flatnonzero((best.error > tolerance) & (likely > done))
            rank = np.arange(done, min(done + count, order.shape[1]))
            row, place = np.nonzero(rank < likely[rows, None])
            row, cell = rows[row], order[rows[row], rank[place]]
            best.take(row, *self._solved(targets[row], places.start[row, cell], tolerance))
            done += count
        self._search_again(targets, places, best, tolerance)
        return best.u, best.error

    def _search_again(self, targets: Array, places: Places, best: "_Best", tolerance: float) -> None:
        """Search again for rows without a solution, from other starts in the likeliest cells."""
        row, cell = np.nonzero((places.overshoot <= RULES.core) & (best.error > tolerance)[:, None])
        starts = self.cells.samples(targets[row], cell, RULES.again).reshape(-1, targets.shape[1])
        row = np.repeat(row, RULES.again)
        best.take(row, *self._solved(targets[row], starts, tolerance))

    def _solved(self, targets: Array, starts: Array, tolerance: float) -> tuple[Array, Array]:
        """Where searches end, (N, n), and the errors (N,): infinite for solutions that a condition forbids."""
        with np.errstate(all="ignore"):
            end = descend(self.boxed.phi_equations, targets, starts, most=RULES.most, patience=RULES.patience)
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
        # what is written last stays
        worst_first = np.argsort(-error, kind="stable")
        better = worst_first[error[worst_first] < self.error[rows[worst_first]]]
        self.u[rows[better]], self.error[rows[better]] = u[better], error[better]
