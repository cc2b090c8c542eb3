"""Gradients of coordinates in a product basis, as Taylor models: the basis is closed under differentiation (ours).

At the centre c of a box, d^a xi(c) = C_a (1, psi)(c) for every multi-index a, with tables C_a made once. The Taylor
polynomial of J_xi to degree 3 needs the tables up to order 4; those of order 5 bound its rest by Lagrange's formula.
"""

from dataclasses import dataclass
from functools import cache
from math import factorial, prod
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.batch import dense_function
from orthocas.certifying.graph import TaylorGraph
from orthocas.certifying.monomials import DEGREE, Monomial, Variables, monomials
from orthocas.certifying.rounding import TINY, UNIT, UP, above, sum_error
from orthocas.certifying.taylor import TaylorModel
from orthocas.checks import Array
from orthocas.parametrisations.product_basis import ProductFamily


@dataclass(frozen=True, eq=False)
class Derivatives:
    """The derivatives of one order of all coordinates, as sums of a few basis functions."""

    used: NDArray[np.intp]  #: numbers of the basis functions
    table: Array  #: (multi-indices * r, used)
    sizes: Array  #: bounds of what the entries are sums of, same shape
    rounding: float  #: relative error of entries and of sums with them


@dataclass(frozen=True, eq=False)
class ProductRows:
    """J_xi of a product family on boxes."""

    r: int
    terms: Array  #: (1 + K, n): the one-joint function of each joint
    functions: TaylorGraph  #: q -> the one-joint functions that are not constant
    numbers: Array  #: (n, functions of one joint): where each is among them
    orders: tuple[Derivatives, ...]  #: orders 1 to 5

    @classmethod
    def of(cls, family: ProductFamily, theta: Array) -> "ProductRows":
        """The tables of a family with its parameters."""
        n, r = family.space.n, family.outputs
        terms = np.array([(0,) * n, *family.terms])
        alone = np.flatnonzero(np.count_nonzero(terms, axis=1) == 1)
        q = ca.SX.sym("q", n)
        values = family.basis(q)[[int(k) - 1 for k in alone]]
        numbers = np.zeros((n, terms.max() + 1), dtype=int)
        for place, k in enumerate(alone):
            joint = int(np.flatnonzero(terms[k])[0])
            numbers[joint, terms[k, joint]] = place
        graph = TaylorGraph.of(dense_function("functions", [q], [values]), "the coordinates")
        C = np.hstack([np.zeros((r, 1)), theta.reshape(r, -1)])
        return cls(r, terms, graph, numbers, _orders(family, terms, C))

    def __call__(self, boxes: list[TaylorModel], half_widths: Array, variables: Variables) -> TaylorModel:
        """J_xi, (r, n, boxes), for models of the joints on boxes of the given half-widths (n, boxes)."""
        points = [TaylorModel.constant(box.centre) for box in boxes]
        values, errors = self._basis(self.functions(points))
        parts, left_out = [], np.zeros((self.r, len(boxes), half_widths.shape[1]))
        for order, derivatives in enumerate(self.orders[:-1], 1):
            used = derivatives.used
            found = derivatives.table @ values[used]
            doubt = derivatives.sizes @ (errors[used] + derivatives.rounding * np.abs(values[used]))
            doubt *= above(len(used))
            weights = _weights(half_widths, order - 1)
            coefficients = self._spread(found, order) * weights
            rounding = sum_error(DEGREE + 2) * np.abs(coefficients)
            left_out += (self._spread(doubt, order) * weights + rounding).sum(axis=2)
            parts.append(coefficients)
        left_out += self._rest(boxes, half_widths)
        coefficients = np.concatenate(parts, axis=2).transpose(2, 0, 1, 3)
        return TaylorModel(variables, coefficients, left_out * above(len(coefficients)) + TINY)

    def dependences(self) -> set[int]:
        """The joints that J_xi depends on."""
        changing = self.orders[1]  # of J_xi
        indices = _multi_indices(self.terms.shape[1], 2)
        sizes = np.asarray(changing.sizes.reshape(len(indices), self.r * len(changing.used)).any(axis=1))
        return {i for index, there in zip(indices, sizes.tolist(), strict=True) if there for i in index}

    def _rest(self, boxes: list[TaylorModel], half_widths: Array) -> Array:
        """Lagrange's bound of the terms of J_xi above degree 3, (r, n, boxes)."""
        last = self.orders[-1]
        if last.used.any():
            highest = self._products([box.magnitude() for box in self.functions(boxes)], last.used)
        else:  # constants only
            highest = np.ones((len(last.used), half_widths.shape[1]))
        bounds = self._spread(last.sizes @ highest * (1 + last.rounding), DEGREE + 2)
        rest: Array = (bounds * _weights(half_widths, DEGREE + 1)).sum(axis=2) * above(bounds.shape[2])
        return rest

    def _spread(self, found: Array, order: int) -> Array:
        """Derivatives by multi-index as those of J_xi: (r, n, multi-indices of one order less, boxes)."""
        n = self.terms.shape[1]
        values: Array = found.reshape(-1, self.r, found.shape[1])[_neighbours(n, order)].transpose(2, 0, 1, 3)
        return values

    def _basis(self, functions: list[TaylorModel]) -> tuple[Array, Array]:
        """Basis functions at points, (1 + K, boxes), and bounds of their errors."""
        every = np.arange(len(self.terms))
        values = self._products([model.centre for model in functions], every)
        size = self._products([np.abs(model.centre) for model in functions], every)
        high = self._products([np.abs(model.centre) + model.remainder for model in functions], every)
        return values, np.maximum(high - size, 0) + sum_error(3 * self.terms.shape[1]) * high + TINY

    def _products(self, functions: list[Array], which: NDArray[np.intp]) -> Array:
        """Products of one-joint functions, (terms, boxes)."""
        table = np.stack(functions)
        out = np.ones((len(which), table.shape[1]))
        for joint in range(self.terms.shape[1]):
            chosen = self.terms[which, joint]
            there = np.flatnonzero(chosen)
            out[there] *= table[self.numbers[joint, chosen[there]]]
        return out


def _orders(family: ProductFamily, terms: Array, C: Array) -> tuple[Derivatives, ...]:
    n = family.space.n
    steps = [family.derivative_matrix(i) for i in range(n)]
    known: dict[Monomial, tuple[Any, Any]] = {(): (C, np.abs(C))}
    orders = []
    for order in range(1, DEGREE + 3):
        indices = _multi_indices(n, order)
        for index in indices:
            values, sizes = known[index[:-1]]
            step = steps[index[-1]]
            known[index] = (values @ step, sizes @ abs(step))
        table, sizes = (np.concatenate([known[index][k] for index in indices]) for k in (0, 1))
        used = np.flatnonzero(sizes.any(axis=0))
        rounding = 4 * UNIT * (len(terms) + 64 * order)
        orders.append(Derivatives(used, table[:, used], sizes[:, used] * UP, rounding))
    return tuple(orders)


@cache
def _multi_indices(n: int, order: int) -> list[Monomial]:
    return [m for m in monomials(tuple(range(n)), order) if len(m) == order]


@cache
def _neighbours(n: int, order: int) -> Array:
    """Where the multi-index m + e_i of an order stands among those of that order, (n, multi-indices m)."""
    index = {m: k for k, m in enumerate(_multi_indices(n, order))}
    lower = _multi_indices(n, order - 1) if order > 1 else [()]
    return np.array([[index[tuple(sorted((*m, i)))] for m in lower] for i in range(n)])


def _weights(half_widths: Array, degree: int) -> Array:
    """r^m / m! for the monomials m of one degree, (monomials, boxes)."""
    n = len(half_widths)
    indices = _multi_indices(n, degree) if degree else [()]
    sizes = [half_widths[list(m)].prod(axis=0) / prod(factorial(m.count(i)) for i in {*m}) for m in indices]
    return np.stack(sizes)
