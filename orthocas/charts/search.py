"""Searches of a whole domain from stored positions, and the rough inverse."""

from dataclasses import dataclass
from itertools import pairwise, product
from math import comb
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.charts.descent import BoxedPhi, descend
from orthocas.charts.phi import PhiMap
from orthocas.errors import SingularTaskError
from orthocas.tasks.domains import Domain
from orthocas.tasks.samples import sample_boundary_weighted
from orthocas.tools.cached import BuiltOnUse, cached_property
from orthocas.tools.checks import Array


@dataclass(frozen=True, slots=True)
class SearchRules:
    """Numbers of the searches. Chosen and held on the ready charts, other seeds (benchmarks/round_trips.py)."""

    points: int = 4096  #: of the table of stored positions
    seed: int = 0  #: of these
    degrees: tuple[int, ...] = (3, 2, 1)  #: of the rough inverse: the first one with so few terms
    most_terms: int = 500
    overshoot: float = 1.2  #: beyond the values of the table, polynomials are not trusted
    stored: tuple[int, ...] = (4, 16, 64)  #: positions from which a row is searched: at first, and without a solution
    all: int = 64  #: near phi, and as many near x, for all solutions of one target
    most: int = 32  #: iterations from one of these
    patience: int = 3  #: of these, within which the error must halve
    rows: int = 1024  #: whose starts are held in memory


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


@dataclass(frozen=True, eq=False)
class InDomain:
    """Searches all of the domain, r > 1: descents within its box from stored positions, those of nearest phi first."""

    boxed: BoxedPhi
    starts: Starts

    def search(self, targets: Array, tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """The points of the domain with the least error that are found for targets (N, n).

        Returns:
            q (N, n), and which of them are solutions, (N,).
        """
        best, error = np.empty_like(targets), np.full(len(targets), np.inf)
        for first in range(0, len(targets), RULES.rows):
            rows = np.arange(first, min(first + RULES.rows, len(targets)))
            stored = self.starts.nearest(targets[rows], RULES.stored[-1], targets.shape[1])
            best[rows] = stored[0]
            # few starts for all rows, then more for those without a solution
            for begin, end in pairwise((0, *RULES.stored)):
                left = np.flatnonzero(error[rows] > tolerance)
                of = np.tile(rows[left], end - begin)
                q, found = self._descend(targets[of], stored[begin:end, left].reshape(-1, targets.shape[1]), tolerance)
                # what is written last stays
                worst_first = np.argsort(-found, kind="stable")
                better = worst_first[found[worst_first] < error[of[worst_first]]]
                best[of[better]], error[of[better]] = q[better], found[better]
        return best, np.asarray(error <= tolerance)

    def find_all(self, target: Array, near: Array, tolerance: float) -> Array:
        """Solutions inside for a target (n,), some several times, (k, n); also from positions (S, n) near solutions."""
        n = len(target)
        stored = [self.starts.nearest(target[None], RULES.all, count)[:, 0] for count in (n, self.boxed.m)]
        # joints without boundaries whose turns change xi begin a turn away as well
        turns = list(product(*((-1, 0, 1) if winds else (0,) for winds in self.boxed.winding)))
        starts = (np.concatenate([near, *stored])[:, None] + 2 * np.pi * np.array(turns)).reshape(-1, n)
        q, error = self._descend(np.broadcast_to(target, starts.shape), starts, tolerance)
        return q[error <= tolerance]

    def _descend(self, targets: Array, starts: Array, tolerance: float) -> tuple[Array, Array]:
        """Where descents end, (N, n), and the errors (N,): infinite for solutions that a condition forbids."""
        with np.errstate(all="ignore"):
            u = self.boxed.of_points(starts)
            end = descend(self.boxed.phi_equations, targets, u, most=RULES.most, patience=RULES.patience)
        q, error = self.boxed.points(end.u), end.error
        solved = np.flatnonzero(error <= tolerance)
        error[solved[~self.boxed.domain.contains(q[solved])]] = np.inf
        return q, error
