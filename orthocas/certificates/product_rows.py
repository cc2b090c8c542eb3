"""Gradients of coordinates in a product basis, as Taylor models: the basis is closed under differentiation.

At the centre c of a box, d^a xi(c) = C_a (1, psi)(c) for every multi-index a, with tables C_a made once. The Taylor
polynomial of J_xi to degree 3 needs the tables up to order 4; those of order 5 bound its rest by Lagrange's formula.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.bases.products import ProductFamily
from orthocas.certificates.graph import TaylorGraph
from orthocas.certificates.jets import Around, Jets, largest_average, multi_indices, neighbours, power_weights, powers
from orthocas.certificates.taylor import DEGREE, TINY, UNIT, UP, Monomial, TaylorModel, Variables, above, sum_error
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array


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
    orders: tuple[Derivatives, ...]  #: from order 1 on

    @classmethod
    def of(cls, family: ProductFamily, theta: Array, highest: int = DEGREE + 2) -> "ProductRows":
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
        return cls(r, terms, graph, numbers, _orders(family, terms, C, highest))

    def __call__(self, boxes: list[TaylorModel], half_widths: Array, variables: Variables) -> TaylorModel:
        """J_xi, (r, n, boxes), for models of the joints on boxes of the given half-widths (n, boxes)."""
        points = [TaylorModel.constant(box.centre) for box in boxes]
        values, errors = self._basis(self.functions(points))
        parts, left_out = [], np.zeros((self.r, len(boxes), half_widths.shape[1]))
        for order in range(1, DEGREE + 2):
            found, doubt = self._derivatives(order, values, errors)
            weights = powers(half_widths, order - 1)
            coefficients = found * weights
            left_out += (doubt * weights + sum_error(DEGREE + 2) * np.abs(coefficients)).sum(axis=2)
            parts.append(coefficients)
        left_out += (self._largest(DEGREE + 2, boxes) * powers(half_widths, DEGREE + 1)).sum(axis=2)
        coefficients = np.concatenate(parts, axis=2).transpose(2, 0, 1, 3)
        return TaylorModel(variables, coefficients, left_out * above(len(coefficients)) + TINY)

    def dependences(self) -> set[int]:
        """The joints that J_xi depends on."""
        changing = self.orders[1]  # of J_xi
        indices = multi_indices(self.terms.shape[1], 2)
        sizes = np.asarray(changing.sizes.reshape(len(indices), self.r * len(changing.used)).any(axis=1))
        return {i for index, there in zip(indices, sizes.tolist(), strict=True) if there for i in index}

    def jets(self, around: Around) -> Jets:
        """The derivatives of J_xi at the middles of boxes. The next order, on the whole box, bounds the rest."""
        points = [TaylorModel.constant(np.ascontiguousarray(c)) for c in around.centre]
        values, errors = self._basis(self.functions(points))
        known = [self._derivatives(order, values, errors) for order in range(1, around.order + 2)]
        linear = np.stack([around.centre, around.reach, *np.zeros((2, *around.centre.shape))], axis=1)
        boxes = [TaylorModel((k,), each, np.zeros(each.shape[1:])) for k, each in enumerate(linear)]
        left_out = self._largest(around.order + 2, boxes) * largest_average(power_weights(around, around.order + 1))
        derivatives, doubts = zip(*known, strict=True)
        return Jets(derivatives, doubts, left_out.sum(axis=2) * above(left_out.shape[2]) + TINY)

    def _derivatives(self, order: int, values: Array, errors: Array) -> tuple[Array, Array]:
        """Those of J_xi at points, of one order less, and bounds of their errors."""
        one = self.orders[order - 1]
        found = one.table @ values[one.used]
        doubt = one.sizes @ (errors[one.used] + one.rounding * np.abs(values[one.used]))
        return self._spread(found, order), self._spread(doubt * above(len(one.used)), order)

    def _largest(self, order: int, boxes: list[TaylorModel]) -> Array:
        """Bounds of the derivatives of J_xi of one order less on boxes, (r, n, multi-indices, boxes)."""
        last = self.orders[order - 1]
        if last.used.any():
            highest = self._products([box.magnitude() for box in self.functions(boxes)], last.used)
        else:  # constants only
            highest = np.ones((len(last.used), boxes[0].remainder.shape[-1]))
        return self._spread(last.sizes @ highest * (1 + last.rounding) * above(len(last.used)), order)

    def _spread(self, found: Array, order: int) -> Array:
        """Derivatives by multi-index as those of J_xi: (r, n, multi-indices of one order less, boxes)."""
        n = self.terms.shape[1]
        values: Array = found.reshape(-1, self.r, found.shape[1])[neighbours(n, order)].transpose(2, 0, 1, 3)
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


def _orders(family: ProductFamily, terms: Array, C: Array, highest: int) -> tuple[Derivatives, ...]:
    n = family.space.n
    steps = [family.derivative_matrix(i) for i in range(n)]
    known: dict[Monomial, tuple[Any, Any]] = {(): (C, np.abs(C))}
    orders: list[Derivatives] = []
    for order in range(1, highest + 1):
        indices = multi_indices(n, order)
        if orders and not len(orders[-1].used):  # a polynomial of a lower degree
            nothing = np.zeros((len(indices) * len(C), 0))
            orders.append(Derivatives(orders[-1].used, nothing, nothing, 0.0))
            continue
        for index in indices:
            values, sizes = known[index[:-1]]
            step = steps[index[-1]]
            known[index] = (values @ step, sizes @ abs(step))
        table, sizes = (np.concatenate([known[index][k] for index in indices]) for k in (0, 1))
        used = np.flatnonzero(sizes.any(axis=0))
        rounding = 4 * UNIT * (len(terms) + 64 * order)
        orders.append(Derivatives(used, table[:, used], sizes[:, used] * UP, rounding))
    return tuple(orders)
