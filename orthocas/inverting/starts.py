"""Starts for the inverse map: a rough inverse q(phi), and a table of points of the domain (ours)."""

from math import comb

import numpy as np

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array, Indices
from orthocas.domains import Domain, sample_uniform
from orthocas.errors import SingularTaskError
from orthocas.inverting.phi_map import PhiMap

_POINTS, _SEED = 4096, 0  # of the table
_DEGREES, _MOST_TERMS = (3, 2, 1), 500  # of the rough inverse: the first degree with so few terms
_OVERSHOOT = 1.2  # beyond the values of the table, polynomials are not trusted
_AT_ONCE = 1024  # targets that are compared with the table at once


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
        points, phi = self._table
        known, wanted = self._normalised(phi)[:, :components], self._normalised(targets)[:, :components]
        parts = [wanted[start : start + _AT_ONCE] for start in range(0, len(wanted), _AT_ONCE)]
        order = np.concatenate([_nearest(known, part, min(count, len(points))) for part in parts])
        nearest: Array = points[order.T]
        return nearest

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Points of the domain where phi is defined, and phi, (K, n) each."""
        return where_known(self._map, sample_uniform(self._domain, _POINTS, _SEED))

    @cached_property
    def _range(self) -> tuple[Array, Array]:
        """Middle and half of the range of phi over the domain, (n,) each."""
        low, high = self._table[1].min(axis=0), self._table[1].max(axis=0)
        return (low + high) / 2, np.where(high > low, (high - low) / 2, 1.0)

    @cached_property
    def _coefficients(self) -> Array:
        """Of the rough inverse, (terms, n)."""
        points, phi = self._table
        found = np.linalg.lstsq(_terms(self._normalised(phi), self._degree), points, rcond=None)[0]
        return np.asarray(found, dtype=float)

    @property
    def _degree(self) -> int:
        n = len(self._domain.centre)
        return next((degree for degree in _DEGREES if comb(n + degree, degree) <= _MOST_TERMS), 1)

    def _normalised(self, phi: Array) -> Array:
        """Values of phi (N, n) in the range [-1, 1], or a little beyond."""
        middle, half = self._range
        return np.clip((phi - middle) / half, -_OVERSHOOT, _OVERSHOOT)


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
    level = [(0, np.ones(len(u)))]  # index of the last factor, product
    terms = [level[0][1]]
    for _ in range(degree):
        level = [(j, product * columns[j]) for i, product in level for j in range(i, len(columns))]
        terms += [product for _, product in level]
    return np.array(terms).T


def _nearest(phi: Array, targets: Array, count: int) -> Indices:
    """Indices of the rows of phi (K, n) nearest to targets (N, n), nearest first, (N, count)."""
    squares = (phi**2).sum(axis=1) - 2 * targets @ phi.T  # without |target|^2, which is the same for all rows
    first = np.argpartition(squares, count - 1, axis=1)[:, :count]
    order = np.argsort(np.take_along_axis(squares, first, axis=1), axis=1)
    nearest: Indices = np.take_along_axis(first, order, axis=1)
    return nearest
