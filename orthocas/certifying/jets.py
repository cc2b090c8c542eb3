"""Derivatives of J at the middle of a box, and the average of J between two points around it (ours).

For q = c + d and p = c - d, phi(q) - phi(p) = 2 Jm d with the average Jm(c, d) of J(c + s d) over s in [-1, 1]. Terms
that are odd in d cancel in it: Jm = J(c) + J''(c)[d, d] / 6 + J''''(c)[d, d, d, d] / 120 + ... So Jm changes with the
square of the distance of the points only. If Jm is nonsingular for all c and d of a box, phi is one-to-one there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial, prod

import numpy as np
from numpy.typing import NDArray

from orthocas.certifying.monomials import DEGREE, Monomial, Variables, monomials
from orthocas.certifying.rounding import TINY, UP, above, sum_error
from orthocas.certifying.taylor import TaylorModel
from orthocas.checks import Array

ORDERS = (4, 6)  #: of the derivatives of J that are used, at most: more of them cost more and leave less out


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """Boxes of middles c + C t, and half differences d = D v, for t and v in [-1, 1]^n."""

    centre: Array  #: c, (n, boxes)
    middles: Array  #: C, (n, boxes)
    differences: Array  #: D, (n, boxes)
    order: int = ORDERS[0]  #: of the derivatives of J that are used at most, even

    def __getitem__(self, boxes: NDArray[np.intp]) -> "Around":
        """Some of the boxes."""
        return Around(self.centre[:, boxes], self.middles[:, boxes], self.differences[:, boxes], self.order)

    @property
    def reach(self) -> Array:
        """How far a point c + t + s d is from c at most, (n, boxes)."""
        reach: Array = (self.middles + self.differences) * UP
        return reach


@dataclass(frozen=True, slots=True, eq=False)
class Jets:
    """Some rows of J: their derivatives at the middle, and what these leave out of the average."""

    derivatives: tuple[Array, ...]  #: by order, each (rows, columns, multi-indices of the order, boxes)
    doubts: tuple[Array, ...]  #: bounds of their errors, of shapes that broadcast to theirs
    rest: Array  #: (rows, columns, boxes)

    @classmethod
    def joined(cls, parts: Sequence["Jets"]) -> "Jets":
        """The rows of all parts."""
        derivatives = tuple(np.concatenate(each) for each in zip(*(part.derivatives for part in parts), strict=True))
        full = [[np.broadcast_to(e, d.shape) for d, e in zip(p.derivatives, p.doubts, strict=True)] for p in parts]
        doubts = tuple(np.concatenate(each) for each in zip(*full, strict=True))
        return cls(derivatives, doubts, np.concatenate([part.rest for part in parts]))

    def average(self, around: Around, variables: Variables) -> tuple[TaylorModel, Array]:
        """The average of J as a model in the middle, and terms (rows, columns, terms, boxes) with signs of their own.

        The rest comes on top of both. Terms with the square of one joint's difference have one sign only: half of each
        goes to the centre.
        """
        weights = [power_weights(around, order) for order in range(around.order + 1)]
        model = [d * w[:, 0] for d, w in zip(self.derivatives[: DEGREE + 1], weights, strict=False)]
        squared = self.derivatives[2] * (weights[2][:, 2] / 3)
        alone = [place for place, m in enumerate(multi_indices(len(around.centre), 2)) if m[0] == m[1]]
        squared[:, :, alone] /= 2
        centre = model[0][:, :, 0] + squared[:, :, alone].sum(axis=2)
        mixed = self.derivatives[3] * (weights[3][:, 2] / 3)
        higher = [self.derivatives[k] * even_average(weights[k]) for k in range(DEGREE + 1, around.order + 1)]
        terms = np.concatenate([squared, mixed, *higher], axis=2)
        coefficients = np.concatenate([centre[:, :, None], *model[1:]], axis=2)
        doubt = sum((e * even_average(w)).sum(axis=2) for e, w in zip(self.doubts, weights, strict=True))
        size = np.abs(coefficients).sum(axis=2) + np.abs(terms).sum(axis=2)
        remainder = (doubt + sum_error(8 * around.order) * size) * above(terms.shape[2]) + TINY
        return TaylorModel(variables, np.ascontiguousarray(coefficients.transpose(2, 0, 1, 3)), remainder), terms


def power_weights(around: Around, order: int) -> Array:
    """(C + s D)^a / a! as polynomials in s, (multi-indices a, order + 1, boxes)."""
    n, boxes = around.centre.shape
    weights = np.ones((1, 1, boxes))
    for k in range(1, order + 1):
        before, last = _prefixes(n, k)
        grown = np.zeros((len(last), k + 1, boxes))
        grown[:, :-1] = weights[before] * around.middles[last][:, None]
        grown[:, 1:] += weights[before] * around.differences[last][:, None]
        weights = grown
    scaled: Array = weights / _factorials(n, order)[:, None, None]
    return scaled


def even_average(weights: Array) -> Array:
    """The average over s in [-1, 1] of polynomials (terms, powers, boxes)."""
    powers_ = np.arange(weights.shape[1])
    average: Array = np.einsum("tkb,k->tb", weights, np.where(powers_ % 2, 0.0, 1 / (powers_ + 1)))
    return average


def largest_average(weights: Array) -> Array:
    """The average over s in [-1, 1] of polynomials (terms, powers, boxes) in |s|."""
    average: Array = np.einsum("tkb,k->tb", weights, 1 / (np.arange(weights.shape[1]) + 1))
    return average


@cache
def multi_indices(n: int, order: int) -> tuple[Monomial, ...]:
    """The derivatives of one order, each as its variables in increasing order."""
    return tuple(m for m in monomials(tuple(range(n)), order) if len(m) == order)


@cache
def neighbours(n: int, order: int) -> NDArray[np.intp]:
    """Where the multi-index m + e_i of an order stands among those of that order, (n, multi-indices m)."""
    index = {m: k for k, m in enumerate(multi_indices(n, order))}
    return np.array([[index[tuple(sorted((*m, i)))] for m in multi_indices(n, order - 1)] for i in range(n)])


@cache
def _prefixes(n: int, order: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each multi-index, the place of what comes before its last variable, and that variable."""
    index = {m: k for k, m in enumerate(multi_indices(n, order - 1))}
    indices = multi_indices(n, order)
    return np.array([index[m[:-1]] for m in indices]), np.array([m[-1] for m in indices])


@cache
def _factorials(n: int, order: int) -> Array:
    return np.array([float(prod(factorial(m.count(i)) for i in {*m})) for m in multi_indices(n, order)])


def powers(widths: Array, order: int) -> Array:
    """r^a / a! for all multi-indices of an order, (multi-indices, boxes), for half-widths r (n, boxes)."""
    n = len(widths)
    found = np.ones((1, widths.shape[1]))
    for k in range(1, order + 1):
        before, last = _prefixes(n, k)
        found = found[before] * widths[last]
    scaled: Array = found / _factorials(n, order)[:, None]
    return scaled
