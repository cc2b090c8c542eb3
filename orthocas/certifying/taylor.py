"""Taylor models: polynomials of degree 3 with a bound of what they leave out, for many boxes at once (ours).

A model of f on a box of centre c and half-widths r holds coefficients p_k and a remainder R >= 0 with
|f(c + r t) - sum_k p_k t^k| <= R for all t in [-1, 1]^n. All operations keep this true in floating-point arithmetic,
see `orthocas.certifying.rounding`. Infinite or undefined remainders stand for "nothing is known".
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np

from orthocas.certifying.monomials import Variables, monomials, order_starts, places, product
from orthocas.certifying.rounding import TINY, UNIT, UP, sum_error
from orthocas.checks import Array

_PRODUCTS = 8  # that add up to a coefficient of a product: a_S b_rest over the subsets S of three variables


@dataclass(frozen=True, slots=True, eq=False)
class TaylorModel:
    """Models of functions on boxes: any shape of functions first, boxes last."""

    variables: Variables  #: the variables it depends on
    coefficients: Array  #: (monomials, ..., boxes), in the order of `monomials`
    remainder: Array  #: (..., boxes), >= 0

    @classmethod
    def constant(cls, values: Array, error: Array | float = 0.0) -> Self:
        """Numbers (..., boxes) known up to an error."""
        return cls((), values[None], np.broadcast_to(error, values.shape))

    @property
    def centre(self) -> Array:
        """The constant coefficients, (..., boxes)."""
        value: Array = self.coefficients[0]
        return value

    def sizes(self) -> Array:
        """Sums of the absolute coefficients of each degree, (4, ..., boxes)."""
        starts = order_starts(len(self.variables))[:4]
        size = np.abs(self.coefficients)
        if not self.variables:
            return np.concatenate([size, np.zeros((3, *size.shape[1:]))])
        sums: Array = np.add.reduceat(size, starts, axis=0)
        return sums

    def magnitude(self) -> Array:
        """A bound of the absolute values, (..., boxes)."""
        bound: Array = (np.abs(self.coefficients).sum(axis=0) + self.remainder) * UP
        return bound

    def __getitem__(self, part: object) -> "TaylorModel":
        index = part if isinstance(part, tuple) else (part,)
        return replace(self, coefficients=self.coefficients[(slice(None), *index)], remainder=self.remainder[index])

    def over(self, variables: Variables) -> "TaylorModel":
        """The same model with more variables."""
        if variables == self.variables:
            return self
        wide = np.zeros((order_starts(len(variables))[4], *self.coefficients.shape[1:]))
        wide[places(self.variables, variables)] = self.coefficients
        return TaylorModel(variables, wide, self.remainder)

    def on(self, shape: tuple[int, ...]) -> "TaylorModel":
        """The same model for functions and boxes of another shape, to which its own is broadcast."""
        wide = np.broadcast_to(self.coefficients, (len(self.coefficients), *shape))
        return TaylorModel(self.variables, wide, np.broadcast_to(self.remainder, shape))

    def __neg__(self) -> "TaylorModel":
        return replace(self, coefficients=-self.coefficients)

    def __add__(self, other: "TaylorModel") -> "TaylorModel":
        variables = tuple(sorted({*self.variables, *other.variables}))
        total = self.over(variables).coefficients + other.over(variables).coefficients
        rounding = UNIT * np.abs(total).sum(axis=0)
        return TaylorModel(variables, total, (self.remainder + other.remainder + rounding) * UP + TINY)

    def __sub__(self, other: "TaylorModel") -> "TaylorModel":
        return self + (-other)

    def times(self, factor: Array | float) -> "TaylorModel":
        """The product with exact numbers, (..., boxes)."""
        scaled = self.coefficients * factor
        rounding = UNIT * np.abs(scaled).sum(axis=0)
        return TaylorModel(self.variables, scaled, (np.abs(factor) * self.remainder + rounding) * UP + TINY)

    def __mul__(self, other: "TaylorModel") -> "TaylorModel":
        if not self.variables:
            return other._by_constant(self)
        if not other.variables:
            return self._by_constant(other)
        table = product(self.variables, other.variables)
        a, b = self.coefficients, other.coefficients
        out = np.zeros((table.size, *np.broadcast_shapes(a.shape[1:], b.shape[1:])))
        out[table.right] = a[0] * b
        out[table.left] += b[0] * a
        out[0] = a[0] * b[0]
        starts, end = order_starts(len(self.variables)), order_starts(len(other.variables))[3]
        for i, where in enumerate(table.by_linear, 1):
            out[where] += a[i] * b[1:end]
        for j, where in enumerate(table.quadratic_by, 1):
            out[where] += b[j] * a[starts[2] : starts[3]]
        return TaylorModel(table.variables, out, self._left_out(other))

    def _by_constant(self, factor: "TaylorModel") -> "TaylorModel":
        """The product with a model without variables."""
        exact = self.times(factor.centre)
        doubt = factor.remainder * (np.abs(self.coefficients).sum(axis=0) + self.remainder)
        return _more_uncertain(exact, doubt)

    def _left_out(self, other: "TaylorModel") -> Array:
        """The remainder of a product: degrees above 3, the remainders of the factors, and rounding."""
        a, b = self.sizes(), other.sizes()
        all_a, all_b = a.sum(axis=0), b.sum(axis=0)
        high = a[3] * (b[1] + b[2] + b[3]) + a[2] * (b[2] + b[3]) + a[1] * b[3]
        carried = self.remainder * (all_b + other.remainder) + other.remainder * all_a
        bound: Array = (high + carried + sum_error(_PRODUCTS) * (all_a * all_b)) * UP + TINY
        return bound

    def composed(self, series: "Series") -> "TaylorModel":
        """The model of f(self), for the series of f about the centre."""
        if not self.variables:
            first = np.abs(series.values[1:]) + series.errors[1:]
            e = self.remainder
            doubt = series.errors[0] + series.tail + e * (first[0] + e * (first[1] + e * first[2]))
            return TaylorModel.constant(series.values[0], doubt * UP)
        away = TaylorModel(self.variables, self.coefficients.copy(), self.remainder)
        away.coefficients[0] = 0
        values = [TaylorModel.constant(series.values[k], series.errors[k]) for k in range(4)]
        return _more_uncertain(((values[3] * away + values[2]) * away + values[1]) * away + values[0], series.tail)

    def deviation(self) -> Array:
        """A bound of the distance from the centre, (..., boxes)."""
        bound: Array = (np.abs(self.coefficients[1:]).sum(axis=0) + self.remainder) * UP
        return bound

    def gains(self) -> Array:
        """How much halving the interval of each variable takes from the bound of the values, (variables, ..., boxes).

        A coefficient shrinks by 2^-power; the remainder is shared out like the cubic terms, which it is most like.
        """
        taken, size = _taken(self.variables).T, np.abs(self.coefficients)
        cubic = order_starts(len(self.variables))[3]
        flat, shape = size.reshape(len(size), -1), (len(taken), *size.shape[1:])
        last = (taken[:, cubic:] @ flat[cubic:]).reshape(shape)
        known = (taken[:, :cubic] @ flat[:cubic]).reshape(shape) + last
        with np.errstate(invalid="ignore"):  # infinite remainders
            gains: Array = known + last / (last.sum(axis=0) + TINY) * self.remainder
        return gains


@cache
def _taken(variables: Variables) -> Array:
    """1 - 2^-power of each variable in each monomial, (monomials, variables)."""
    return np.array([[1 - 0.5 ** powers.count(v) for v in variables] for powers in monomials(variables)])


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """f(x + e) = sum_k values[k] e^k up to errors[k], and a rest of at most `tail` for the e in question."""

    values: Array  #: (4, ..., boxes)
    errors: Array  #: (4, ..., boxes)
    tail: Array  #: (..., boxes)


def stacked(models: list[TaylorModel]) -> TaylorModel:
    """Models of the same shape as one, with a new first axis."""
    variables = tuple(sorted({v for model in models for v in model.variables}))
    shape = np.broadcast_shapes(*(model.remainder.shape for model in models))
    parts = [model.on(shape).over(variables) for model in models]
    coefficients = np.stack([part.coefficients for part in parts], axis=1)
    return TaylorModel(variables, coefficients, np.stack([part.remainder for part in parts]))


def _more_uncertain(model: TaylorModel, error: Array) -> TaylorModel:
    return replace(model, remainder=(model.remainder + error) * UP)
