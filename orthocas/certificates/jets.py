"""Jets: derivatives of rows of J at centres of boxes, with bounds of the truncation error of averages over segments.

For points c + d and c - d, Jm(c, d) is the average of J(c + s d) over s in [-1, 1], so phi(c + d) - phi(c - d) = 2 Jm
d. Its Taylor series about the centre of a box has the terms J^(a) (t + s d)^a / a!. Terms odd in d cancel.

Source:
    ours, docs/explanation/certificates.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial, prod

import numpy as np
from numpy.typing import NDArray

from orthocas.certificates.taylor import (
    DEGREE,
    TINY,
    UP,
    Monomial,
    TaylorModel,
    Variables,
    compute_margin,
    list_monomials,
    sum_error,
)
from orthocas.tools.checks import Array

#: highest orders of derivatives of J to try; a higher order costs more and has a smaller truncation error
ORDERS = (4, 6)


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """Boxes of centres c + C t and half differences d = D v, for t and v in [-1, 1]^n."""

    centre: Array  #: c, (n, boxes)
    middles: Array  #: C, (n, boxes)
    differences: Array  #: D, (n, boxes)
    order: int = ORDERS[0]  #: highest order of derivatives of J, even

    def __getitem__(self, boxes: NDArray[np.intp]) -> "Around":
        """Some of the boxes."""
        return Around(self.centre[:, boxes], self.middles[:, boxes], self.differences[:, boxes], self.order)

    @property
    def reach(self) -> Array:
        """Largest distance of a point c + t + s d from c, (n, boxes)."""
        return np.asarray((self.middles + self.differences) * UP)


@dataclass(frozen=True, slots=True, eq=False)
class Jets:
    """Derivatives of some rows of J at the centre, and the truncation error of the average."""

    derivatives: tuple[Array, ...]  #: by order, each (rows, columns, multi-indices of this order, boxes)
    doubts: tuple[Array, ...]  #: error bounds of the derivatives, in shapes that broadcast to theirs
    rest: Array  #: truncation error, (rows, columns, boxes)

    @classmethod
    def join(cls, parts: Sequence["Jets"]) -> "Jets":
        """The rows of all parts."""
        derivatives = tuple(np.concatenate(each) for each in zip(*(part.derivatives for part in parts), strict=True))
        full = [[np.broadcast_to(e, d.shape) for d, e in zip(p.derivatives, p.doubts, strict=True)] for p in parts]
        doubts = tuple(np.concatenate(each) for each in zip(*full, strict=True))
        return cls(derivatives, doubts, np.concatenate([part.rest for part in parts]))

    def average(self, around: Around, variables: Variables) -> tuple[TaylorModel, Array]:
        """The average of J as a model in the centre c, and further terms (rows, columns, terms, boxes) of any sign.

        The truncation error is added to both. A term with the square of one joint's difference has only one sign, so
        half of it is added to the centre.
        """
        # Even orders of d remain. The model takes degrees up to 3, and half of each square of one joint.
        weights = [build_power_weights(around, order) for order in range(around.order + 1)]
        model = [d * w[:, 0] for d, w in zip(self.derivatives[: DEGREE + 1], weights, strict=False)]
        squared = self.derivatives[2] * (weights[2][:, 2] / 3)
        alone = [place for place, m in enumerate(list_multi_indices(len(around.centre), 2)) if m[0] == m[1]]
        squared[:, :, alone] /= 2
        centre = model[0][:, :, 0] + squared[:, :, alone].sum(axis=2)
        mixed = self.derivatives[3] * (weights[3][:, 2] / 3)
        higher = [self.derivatives[k] * average_powers(weights[k]) for k in range(DEGREE + 1, around.order + 1)]
        terms = np.concatenate([squared, mixed, *higher], axis=2)
        coefficients = np.concatenate([centre[:, :, None], *model[1:]], axis=2)
        # The remainder covers errors of the derivatives, and rounding of the sums.
        doubt = sum((e * average_powers(w)).sum(axis=2) for e, w in zip(self.doubts, weights, strict=True))
        size = np.abs(coefficients).sum(axis=2) + np.abs(terms).sum(axis=2)
        remainder = (doubt + sum_error(8 * around.order) * size) * compute_margin(terms.shape[2]) + TINY
        return TaylorModel(variables, np.ascontiguousarray(coefficients.transpose(2, 0, 1, 3)), remainder), terms


def build_power_weights(around: Around, order: int) -> Array:
    """(C + s D)^a / a! as polynomials in s, (multi-indices a, order + 1, boxes)."""
    n, boxes = around.centre.shape
    weights = np.ones((1, 1, boxes))
    for k in range(1, order + 1):
        # Each multi-index is one of the previous order times one more factor C + s D.
        before, last = _find_prefixes(n, k)
        grown = np.zeros((len(last), k + 1, boxes))
        grown[:, :-1] = weights[before] * around.middles[last][:, None]
        grown[:, 1:] += weights[before] * around.differences[last][:, None]
        weights = grown
    return np.asarray(weights / _compute_factorials(n, order)[:, None, None])


def average_powers(weights: Array, of_size: bool = False) -> Array:
    """Averages over s in [-1, 1] of polynomials (terms, powers, boxes) in s, or in |s|, (terms, boxes)."""
    powers = np.arange(weights.shape[1])
    averages = np.where(powers % 2 * (not of_size), 0.0, 1 / (powers + 1))
    return np.asarray(np.einsum("tkb,k->tb", weights, averages))


@cache
def list_multi_indices(n: int, order: int) -> tuple[Monomial, ...]:
    """The multi-indices of one order, each as a list of its variables in increasing order."""
    return tuple(m for m in list_monomials(tuple(range(n)), order) if len(m) == order)


@cache
def find_neighbours(n: int, order: int) -> NDArray[np.intp]:
    """Positions of the multi-indices m + e_i in the list of their order, (n, multi-indices m)."""
    index = {m: k for k, m in enumerate(list_multi_indices(n, order))}
    return np.array([[index[tuple(sorted((*m, i)))] for m in list_multi_indices(n, order - 1)] for i in range(n)])


@cache
def _find_prefixes(n: int, order: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each multi-index: the index of the multi-index without its last variable, and that variable."""
    index = {m: k for k, m in enumerate(list_multi_indices(n, order - 1))}
    indices = list_multi_indices(n, order)
    return np.array([index[m[:-1]] for m in indices]), np.array([m[-1] for m in indices])


@cache
def _compute_factorials(n: int, order: int) -> Array:
    return np.array([float(prod(factorial(m.count(i)) for i in {*m})) for m in list_multi_indices(n, order)])


def compute_powers(widths: Array, order: int) -> Array:
    """r^a / a! for all multi-indices of an order, (multi-indices, boxes), for half-widths r (n, boxes)."""
    n = len(widths)
    powers = np.ones((1, widths.shape[1]))
    for k in range(1, order + 1):
        before, last = _find_prefixes(n, k)
        powers = powers[before] * widths[last]
    return np.asarray(powers / _compute_factorials(n, order)[:, None])
