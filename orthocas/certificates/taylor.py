"""Taylor models, which are polynomials with a remainder for truncation and rounding, and functions of them.

A model of f on a box has f(c + h t) = sum_a c_a t^a + e for t in [-1, 1]^n, |a| <= 3, with |e| <= the remainder. The
remainders of sums and products include those of the operands, all truncated terms, and all rounding.

Source:
    ours, docs/explanation/certificates.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations_with_replacement
from math import factorial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from orthocas.tools.checks import Array

UNIT = 2.0**-53  #: u: relative error of one operation
UP = 1.0 + 2.0**-40  #: factor on upper bounds that covers up to 4,000 roundings of non-negative numbers
TINY = 1e-290  #: exceeds the underflow of one operation on arrays of numbers up to 1e10
DEGREE = 3
#: number of products that a coefficient of a product sums: a_S b_rest over the subsets S of three variables
_PRODUCTS = 8
Variables = tuple[int, ...]  #: indices of variables, increasing
Monomial = tuple[int, ...]  #: variables in increasing order, repeated for powers
Places = slice | NDArray[np.intp]  #: indices of coefficients
#: pi / 2 and ln 2 in pieces; the first pieces are short, so that products with integers up to 2^20 are exact
_HALF_PI = tuple(map(float.fromhex, ("0x1.921fb54000000p+0", "0x1.10b4611800000p-30", "0x1.313198a2e0370p-61")))
_LN2 = tuple(map(float.fromhex, ("0x1.62e42fefa0000p-1", "0x1.cf79abc9e3b39p-40")))
_WIDEST_ANGLE, _WIDEST_EXPONENT = 1e6, 700.0
_ERROR = 32 * UNIT  #: error bound: reduction 3 u, Horner's rule below 8 u, truncation of the series below 1e-4 u
_ROUNDINGS = 16 * UNIT  #: relative error of a few consecutive operations
_TANH = 6.2 / 24  #: |tanh''''| = 8 |t| (1 - t^2) |2 - 3 t^2| < 8 * 0.385 * 2 for t = tanh x in [-1, 1]
POWERS = ("pow", "constpow")  #: powers with an integer constant exponent
Enclosed = tuple[Array, Array]  #: values, and bounds of their absolute errors


def sum_error(products: int) -> float:
    """Bound of the rounding error of a sum of products, relative to the sum of their absolute values.

    Args:
        products: number of products; 8 further roundings are included.
    """
    # k u / (1 - k u) < 1.01 k u for k below 10^13.
    return 1.01 * (products + 8) * UNIT


def compute_margin(products: int) -> float:
    """Factor that turns a computed sum of `products` products of non-negative numbers into an upper bound."""
    return UP * (1 + sum_error(products))


@cache
def list_monomials(variables: Variables, degree: int = DEGREE) -> tuple[Monomial, ...]:
    """All monomials up to the degree, in order of their degrees."""
    degrees = range(degree + 1)
    return tuple(m for d in degrees for m in combinations_with_replacement(variables, d))


@cache
def find_order_starts(count: int) -> tuple[int, ...]:
    """Index of the first monomial of each degree 0, 1, 2, 3 in `count` variables, and the number of all monomials."""
    linear, quadratic = 1 + count, (1 + count) * (2 + count) // 2
    return 0, 1, linear, quadratic, quadratic * (3 + count) // 3


@cache
def find_places(part: Variables, whole: Variables) -> Places:
    """Indices of the monomials of some of the variables among the monomials of all variables."""
    index = {monomial: k for k, monomial in enumerate(list_monomials(whole))}
    return _merge_places([index[monomial] for monomial in list_monomials(part)])


@dataclass(frozen=True, slots=True)
class Product:
    """Plan for multiplying two polynomials a and b, truncated after degree 3."""

    variables: Variables  #: variables of the product
    size: int  #: number of coefficients of the product
    left: Places  #: indices of a's monomials in the product
    right: Places  #: indices of b's monomials in the product
    by_linear: tuple[Places, ...]  #: indices of products of a's linear monomials with b's linear and quadratic ones
    quadratic_by: tuple[Places, ...]  #: indices of products of a's quadratic monomials with b's linear ones


@cache
def plan_product(left: Variables, right: Variables) -> Product:
    """The plan for polynomials in the given variables."""
    both = tuple(sorted({*left, *right}))
    index = {monomial: k for k, monomial in enumerate(list_monomials(both))}

    def find_products(one: Monomial, others: tuple[Monomial, ...]) -> Places:
        return _merge_places([index[tuple(sorted(one + other))] for other in others])

    # Linear terms of a multiply linear and quadratic terms of b; quadratic terms of a multiply only linear ones.
    a, b = list_monomials(left), list_monomials(right)
    starts = find_order_starts(len(left))
    inner = b[1 : find_order_starts(len(right))[3]]
    return Product(
        both,
        len(index),
        find_places(left, both),
        find_places(right, both),
        tuple(find_products((i,), inner) for i in left),
        tuple(find_products((j,), a[starts[2] : starts[3]]) for j in right),
    )


def _merge_places(indices: list[int]) -> Places:
    """A slice if the indices are consecutive, otherwise an array."""
    if indices and indices == list(range(indices[0], indices[-1] + 1)):
        return slice(indices[0], indices[-1] + 1)
    return np.array(indices, dtype=np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class TaylorModel:
    """Models of functions on boxes; the shape of the functions comes first, and the boxes last."""

    variables: Variables  #: variables of the models
    coefficients: Array  #: (monomials, ..., boxes), in the order of `list_monomials`
    remainder: Array  #: (..., boxes), >= 0

    @classmethod
    def constant(cls, values: Array, error: Array | float = 0.0) -> Self:
        """Models of numbers (..., boxes) that are known up to an error."""
        return cls((), values[None], np.broadcast_to(error, values.shape))

    @property
    def centre(self) -> Array:
        """The constant coefficients, (..., boxes)."""
        return np.asarray(self.coefficients[0])

    def sum_sizes(self) -> Array:
        """Sums of the absolute coefficients of each degree, (4, ..., boxes)."""
        starts = find_order_starts(len(self.variables))[:4]
        size = np.abs(self.coefficients)
        if not self.variables:
            return np.concatenate([size, np.zeros((3, *size.shape[1:]))])
        return np.asarray(np.add.reduceat(size, starts, axis=0))

    def bound_magnitude(self) -> Array:
        """Upper bound of the absolute values, (..., boxes)."""
        return np.asarray((np.abs(self.coefficients).sum(axis=0) + self.remainder) * UP)

    def __getitem__(self, part: object) -> "TaylorModel":
        index = part if isinstance(part, tuple) else (part,)
        return replace(self, coefficients=self.coefficients[(slice(None), *index)], remainder=self.remainder[index])

    def extend(self, variables: Variables) -> "TaylorModel":
        """The same model with more variables."""
        if variables == self.variables:
            return self
        wide = np.zeros((find_order_starts(len(variables))[4], *self.coefficients.shape[1:]))
        wide[find_places(self.variables, variables)] = self.coefficients
        return TaylorModel(variables, wide, self.remainder)

    def broadcast_to(self, shape: tuple[int, ...]) -> "TaylorModel":
        """The same models, broadcast to another shape of functions and boxes."""
        wide = np.broadcast_to(self.coefficients, (len(self.coefficients), *shape))
        return TaylorModel(self.variables, wide, np.broadcast_to(self.remainder, shape))

    def __neg__(self) -> "TaylorModel":
        return replace(self, coefficients=-self.coefficients)

    def __add__(self, other: "TaylorModel") -> "TaylorModel":
        variables = tuple(sorted({*self.variables, *other.variables}))
        total = self.extend(variables).coefficients + other.extend(variables).coefficients
        rounding = UNIT * np.abs(total).sum(axis=0)
        return TaylorModel(variables, total, (self.remainder + other.remainder + rounding) * UP + TINY)

    def __sub__(self, other: "TaylorModel") -> "TaylorModel":
        return self + (-other)

    def multiply_by(self, factor: Array | float) -> "TaylorModel":
        """The product with exact numbers, (..., boxes)."""
        scaled = self.coefficients * factor
        rounding = UNIT * np.abs(scaled).sum(axis=0)
        return TaylorModel(self.variables, scaled, (np.abs(factor) * self.remainder + rounding) * UP + TINY)

    def __mul__(self, other: "TaylorModel") -> "TaylorModel":
        if not self.variables:
            return other._multiply_constant(self)
        if not other.variables:
            return self._multiply_constant(other)
        # Constant times all, linear times linear and quadratic, quadratic times linear.
        table = plan_product(self.variables, other.variables)
        a, b = self.coefficients, other.coefficients
        out = np.zeros((table.size, *np.broadcast_shapes(a.shape[1:], b.shape[1:])))
        out[table.right] = a[0] * b
        out[table.left] += b[0] * a
        out[0] = a[0] * b[0]
        starts, end = find_order_starts(len(self.variables)), find_order_starts(len(other.variables))[3]
        for i, where in enumerate(table.by_linear, 1):
            out[where] += a[i] * b[1:end]
        for j, where in enumerate(table.quadratic_by, 1):
            out[where] += b[j] * a[starts[2] : starts[3]]
        # The remainder covers degrees above 3, the remainders of the factors, and rounding.
        a, b = self.sum_sizes(), other.sum_sizes()
        all_a, all_b = a.sum(axis=0), b.sum(axis=0)
        high = a[3] * (b[1] + b[2] + b[3]) + a[2] * (b[2] + b[3]) + a[1] * b[3]
        carried = self.remainder * (all_b + other.remainder) + other.remainder * all_a
        remainder = (high + carried + sum_error(_PRODUCTS) * (all_a * all_b)) * UP + TINY
        return TaylorModel(table.variables, out, np.asarray(remainder))

    def _multiply_constant(self, factor: "TaylorModel") -> "TaylorModel":
        """The product with a model without variables."""
        exact = self.multiply_by(factor.centre)
        doubt = factor.remainder * (np.abs(self.coefficients).sum(axis=0) + self.remainder)
        return _widen(exact, doubt)

    def compose(self, series: "Series") -> "TaylorModel":
        """The model of f(self), for the series of f about the centre."""
        # Without variables, the variation of f over the remainder is all error.
        if not self.variables:
            first = np.abs(series.values[1:]) + series.errors[1:]
            e = self.remainder
            doubt = series.errors[0] + series.tail + e * (first[0] + e * (first[1] + e * first[2]))
            return TaylorModel.constant(series.values[0], doubt * UP)
        # Horner's rule in the deviation from the centre.
        away = TaylorModel(self.variables, self.coefficients.copy(), self.remainder)
        away.coefficients[0] = 0
        values = [TaylorModel.constant(series.values[k], series.errors[k]) for k in range(4)]
        return _widen(((values[3] * away + values[2]) * away + values[1]) * away + values[0], series.tail)

    def bound_deviation(self) -> Array:
        """Upper bound of the distance from the centre, (..., boxes)."""
        return np.asarray((np.abs(self.coefficients[1:]).sum(axis=0) + self.remainder) * UP)

    def compute_gains(self) -> Array:
        """How much halving the interval of each variable improves the bound of the values, (variables, ..., boxes).

        A coefficient shrinks by 2^-power. The remainder is distributed like the cubic terms, which it resembles most.
        """
        taken, size = weigh_halving(self.variables, DEGREE), np.abs(self.coefficients)
        cubic = find_order_starts(len(self.variables))[3]
        flat, shape = size.reshape(len(size), -1), (len(taken), *size.shape[1:])
        last = (taken[:, cubic:] @ flat[cubic:]).reshape(shape)
        of_terms = (taken[:, :cubic] @ flat[:cubic]).reshape(shape) + last
        # Remainders may be infinite.
        with np.errstate(invalid="ignore"):
            gains: Array = of_terms + last / (last.sum(axis=0) + TINY) * self.remainder
        return gains


@cache
def weigh_halving(variables: Variables, degree: int) -> Array:
    """1 - 2^-power of each variable in each monomial up to a degree, (variables, monomials)."""
    monomials = list_monomials(variables, degree)
    taken = [[1 - 0.5 ** powers.count(v) for powers in monomials] for v in variables]
    return np.array(taken).reshape(len(variables), len(monomials))


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """f(x + e) = sum_k values[k] e^k, values exact up to errors[k], with a truncation error of at most `tail`."""

    values: Array  #: (4, ..., boxes)
    errors: Array  #: (4, ..., boxes)
    tail: Array  #: (..., boxes)


def stack(models: list[TaylorModel]) -> TaylorModel:
    """Models of the same shape as one, with a new first axis."""
    # Extend all models to the union of their variables, and to a common shape.
    variables = tuple(sorted({v for model in models for v in model.variables}))
    shape = np.broadcast_shapes(*(model.remainder.shape for model in models))
    parts = [model.broadcast_to(shape).extend(variables) for model in models]
    coefficients = np.stack([part.coefficients for part in parts], axis=1)
    return TaylorModel(variables, coefficients, np.stack([part.remainder for part in parts]))


def _widen(model: TaylorModel, error: Array) -> TaylorModel:
    return replace(model, remainder=(model.remainder + error) * UP)


def evaluate_sine_cosine(x: Array) -> tuple[Enclosed, Enclosed]:
    """Sine and cosine of numbers of absolute value up to 1e6."""
    valid = np.abs(x) <= _WIDEST_ANGLE
    x = np.where(valid, x, 0.0)
    # Subtract quarter turns, then evaluate both series.
    turns = np.rint(x * (2 / np.pi))
    # |r| < 0.79.
    r = ((x - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    square = r * r
    s = r * _evaluate_horner(square, [(-1.0) ** k / factorial(2 * k + 1) for k in range(10)])
    c = _evaluate_horner(square, [(-1.0) ** k / factorial(2 * k) for k in range(11)])
    # Each quarter turn swaps sine and cosine, and changes one sign.
    quarter = turns % 4
    sine = np.choose(quarter.astype(int), [s, c, -s, -c])
    cosine = np.choose(quarter.astype(int), [c, -s, -c, s])
    error = np.where(valid, _ERROR, np.inf)
    return (sine, error), (cosine, error)


def evaluate_exponential(x: Array) -> Enclosed:
    """e^x for |x| <= 700."""
    valid = np.abs(x) <= _WIDEST_EXPONENT
    x = np.where(valid, x, 0.0)
    whole = np.rint(x * (1 / np.log(2.0)))
    # |r| < 0.35.
    r = (x - whole * _LN2[0]) - whole * _LN2[1]
    value = np.ldexp(_evaluate_horner(r, [1 / factorial(k) for k in range(16)]), whole.astype(int))
    return value, np.where(valid, _ERROR * value, np.inf)


def evaluate_tanh(x: Array) -> Enclosed:
    """tanh x, from e^(-2 |x|)."""
    # Beyond the widest exponent, tanh is 1 up to 1e-300.
    decay, error = evaluate_exponential(np.maximum(-2 * np.abs(x), -_WIDEST_EXPONENT))
    return np.sign(x) * (1 - decay) / (1 + decay), 4 * error + 16 * UNIT + 0 * x


def _evaluate_horner(x: Array, coefficients: list[float]) -> Array:
    """Sum of coefficients[k] x^k."""
    # Start with the highest power.
    value = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


def sine(model: TaylorModel) -> TaylorModel:
    """The model of sin f."""
    s, c = evaluate_sine_cosine(model.centre)
    return model.compose(_expand_harmonic(s[0], c[0], s[1], model.bound_deviation()))


def cosine(model: TaylorModel) -> TaylorModel:
    """The model of cos f."""
    s, c = evaluate_sine_cosine(model.centre)
    return model.compose(_expand_harmonic(c[0], -s[0], s[1], model.bound_deviation()))


def reciprocal(model: TaylorModel) -> TaylorModel:
    """The model of 1 / f, with an infinite remainder where f may vanish."""
    x, e = model.centre, model.bound_deviation()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        values = np.stack([1 / x, -1 / (x * x), 1 / (x * x * x), -1 / (x * x * x * x)])
        ratio = np.abs(e / x) * UP
        # The tail of a geometric series.
        tail = np.where(ratio < 1, ratio**4 / (np.abs(x) * (1 - ratio)), np.inf)
        return model.compose(Series(values, _ROUNDINGS * np.abs(values), tail * UP))


def square_root(model: TaylorModel) -> TaylorModel:
    """The model of sqrt f, with an infinite remainder where f may be zero or negative."""
    x, e = model.centre, model.bound_deviation()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        root = np.sqrt(x)
        values = np.stack([root, 1 / (2 * root), -1 / (8 * x * root), 1 / (16 * x * x * root)])
        tail = root * _bound_decreasing(5 / 128, e / x)
        return model.compose(Series(values, _ROUNDINGS * np.abs(values), tail * UP))


def reciprocal_square_root(model: TaylorModel) -> TaylorModel:
    """The model of 1 / sqrt f, with an infinite remainder where f may be zero or negative."""
    x, e = model.centre, model.bound_deviation()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        root = 1 / np.sqrt(x)
        values = np.stack([root, -root / (2 * x), 3 * root / (8 * x * x), -5 * root / (16 * x * x * x)])
        tail = root * _bound_decreasing(35 / 128, e / x)
        return model.compose(Series(values, _ROUNDINGS * np.abs(values), tail * UP))


def _bound_decreasing(first: float, ratio: Array) -> Array:
    """Bound of the tail of a power series from degree 4 on, with coefficients that decrease in size from `first` on."""
    rest: Array = np.where((ratio >= 0) & (ratio < 1 - 1e-9), first * ratio**4 / (1 - ratio * UP), np.inf)
    return rest


def exponent(model: TaylorModel) -> TaylorModel:
    """The model of e^f."""
    value, error = evaluate_exponential(model.centre)
    e = model.bound_deviation()
    highest, beyond = evaluate_exponential(np.minimum(e * UP, 600.0))
    tail = np.where(e < 500, (np.abs(value) + error) * (highest + beyond) * e**4 / 24, np.inf)
    factors = [1.0, 1.0, 1 / 2, 1 / 6]
    values, errors = (np.stack([x * factor for factor in factors]) for x in (value, error + _ROUNDINGS * value))
    return model.compose(Series(values, errors, tail * UP))


def tanh(model: TaylorModel) -> TaylorModel:
    """The model of tanh f."""
    t, error = evaluate_tanh(model.centre)
    slope = 1 - t * t
    values = np.stack([t, slope, -t * slope, slope * (3 * t * t - 1) / 3])
    # The derivatives change by less than 8 with t.
    errors = np.stack([error, *[8 * error + _ROUNDINGS] * 3])
    return model.compose(Series(values, errors, _TANH * model.bound_deviation() ** 4 * UP))


def square(model: TaylorModel) -> TaylorModel:
    """The model of f^2."""
    return model * model


def power(model: TaylorModel, exponent_: int) -> TaylorModel:
    """The model of f^k for an integer k."""
    if exponent_ < 0:
        return reciprocal(power(model, -exponent_))
    # For each binary digit, square; for each digit 1, multiply by f.
    result = TaylorModel.constant(np.ones_like(model.centre))
    for bit in bin(exponent_)[2:]:
        result = result * result
        result = result * model if bit == "1" else result
    return result


def _expand_harmonic(value: Array, slope: Array, error: Array, away: Array) -> Series:
    """The series of sine and cosine, whose derivatives repeat: value, slope, -value, -slope."""
    values = np.stack([value, slope, -value / 2, -slope / 6])
    errors = np.stack([error, error, error, error]) + _ROUNDINGS
    return Series(values, errors, away**4 / 24 * UP)


UNARY: dict[str, Callable[[TaylorModel], TaylorModel]] = {
    "assign": lambda a: a,
    "neg": lambda a: -a,
    "twice": lambda a: a.multiply_by(2.0),
    "sq": square,
    "sqrt": square_root,
    "inv": reciprocal,
    "sin": sine,
    "cos": cosine,
    "tan": lambda a: sine(a) * reciprocal(cosine(a)),
    "exp": exponent,
    "tanh": tanh,
}
BINARY: dict[str, Callable[[TaylorModel, TaylorModel], TaylorModel]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a * reciprocal(b),
}
