"""Sine, cosine, roots and other functions of Taylor models."""

from collections.abc import Callable
from math import factorial

import numpy as np

from orthocas.certificates.taylor import UNIT, UP, Series, TaylorModel
from orthocas.tools.checks import Array

# pi / 2 and ln 2 in pieces: the first ones are so short that products with whole numbers up to 2^20 are exact
_HALF_PI = tuple(map(float.fromhex, ("0x1.921fb54000000p+0", "0x1.10b4611800000p-30", "0x1.313198a2e0370p-61")))
_LN2 = tuple(map(float.fromhex, ("0x1.62e42fefa0000p-1", "0x1.cf79abc9e3b39p-40")))
_WIDEST_ANGLE, _WIDEST_EXPONENT = 1e6, 700.0
_ERROR = 32 * UNIT  # reduction 3 u, Horner's rule below 8 u, the rest of the series below 1e-4 u
_ROUNDINGS = 16 * UNIT  # relative error of a few operations in a row
_TANH = 6.2 / 24  # |tanh''''| = 8 |t| (1 - t^2) |2 - 3 t^2| < 8 * 0.385 * 2 for t = tanh x in [-1, 1]
POWERS = ("pow", "constpow")  #: with a whole constant exponent

Enclosed = tuple[Array, Array]  #: values, and bounds of their absolute errors


def sine_and_cosine(x: Array) -> tuple[Enclosed, Enclosed]:
    """Sine and cosine of numbers up to 1e6 in size."""
    known = np.abs(x) <= _WIDEST_ANGLE
    x = np.where(known, x, 0.0)
    turns = np.rint(x * (2 / np.pi))
    r = ((x - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]  # |r| < 0.79
    square = r * r
    s = r * _horner(square, [(-1.0) ** k / factorial(2 * k + 1) for k in range(10)])
    c = _horner(square, [(-1.0) ** k / factorial(2 * k) for k in range(11)])
    quarter = turns % 4
    sine = np.choose(quarter.astype(int), [s, c, -s, -c])
    cosine = np.choose(quarter.astype(int), [c, -s, -c, s])
    error = np.where(known, _ERROR, np.inf)
    return (sine, error), (cosine, error)


def exponential(x: Array) -> Enclosed:
    """e^x of numbers up to 700 in size."""
    known = np.abs(x) <= _WIDEST_EXPONENT
    x = np.where(known, x, 0.0)
    whole = np.rint(x * (1 / np.log(2.0)))
    r = (x - whole * _LN2[0]) - whole * _LN2[1]  # |r| < 0.35
    value = np.ldexp(_horner(r, [1 / factorial(k) for k in range(16)]), whole.astype(int))
    return value, np.where(known, _ERROR * value, np.inf)


def hyperbolic_tangent(x: Array) -> Enclosed:
    """tanh x, from e^(-2 |x|)."""
    decay, error = exponential(np.maximum(-2 * np.abs(x), -_WIDEST_EXPONENT))  # beyond, tanh is 1 up to 1e-300
    return np.sign(x) * (1 - decay) / (1 + decay), 4 * error + 16 * UNIT + 0 * x


def _horner(x: Array, coefficients: list[float]) -> Array:
    """Sum of coefficients[k] x^k."""
    value = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


def sine(model: TaylorModel) -> TaylorModel:
    """The model of sin f."""
    s, c = sine_and_cosine(model.centre)
    return model.composed(_harmonic(s[0], c[0], s[1], model.deviation()))


def cosine(model: TaylorModel) -> TaylorModel:
    """The model of cos f."""
    s, c = sine_and_cosine(model.centre)
    return model.composed(_harmonic(c[0], -s[0], s[1], model.deviation()))


def reciprocal(model: TaylorModel) -> TaylorModel:
    """The model of 1 / f. Nothing is known where f may vanish."""
    x, e = model.centre, model.deviation()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        values = np.stack([1 / x, -1 / (x * x), 1 / (x * x * x), -1 / (x * x * x * x)])
        ratio = np.abs(e / x) * UP
        tail = np.where(ratio < 1, ratio**4 / (np.abs(x) * (1 - ratio)), np.inf)  # geometric series
        return model.composed(Series(values, _ROUNDINGS * np.abs(values), tail * UP))


def square_root(model: TaylorModel) -> TaylorModel:
    """The model of sqrt f. Nothing is known where f may be zero or negative."""
    x, e = model.centre, model.deviation()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        root = np.sqrt(x)
        values = np.stack([root, 1 / (2 * root), -1 / (8 * x * root), 1 / (16 * x * x * root)])
        tail = root * _decreasing(5 / 128, e / x)
        return model.composed(Series(values, _ROUNDINGS * np.abs(values), tail * UP))


def reciprocal_square_root(model: TaylorModel) -> TaylorModel:
    """The model of 1 / sqrt f. Nothing is known where f may be zero or negative."""
    x, e = model.centre, model.deviation()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        root = 1 / np.sqrt(x)
        values = np.stack([root, -root / (2 * x), 3 * root / (8 * x * x), -5 * root / (16 * x * x * x)])
        tail = root * _decreasing(35 / 128, e / x)
        return model.composed(Series(values, _ROUNDINGS * np.abs(values), tail * UP))


def _decreasing(first: float, ratio: Array) -> Array:
    """The rest of a power series from degree 4 on, if its coefficients decrease from `first` on in size."""
    rest: Array = np.where((ratio >= 0) & (ratio < 1 - 1e-9), first * ratio**4 / (1 - ratio * UP), np.inf)
    return rest


def exponent(model: TaylorModel) -> TaylorModel:
    """The model of e^f."""
    value, error = exponential(model.centre)
    e = model.deviation()
    highest, beyond = exponential(np.minimum(e * UP, 600.0))
    tail = np.where(e < 500, (np.abs(value) + error) * (highest + beyond) * e**4 / 24, np.inf)
    factors = [1.0, 1.0, 1 / 2, 1 / 6]
    values, errors = (np.stack([x * factor for factor in factors]) for x in (value, error + _ROUNDINGS * value))
    return model.composed(Series(values, errors, tail * UP))


def tanh(model: TaylorModel) -> TaylorModel:
    """The model of tanh f."""
    t, error = hyperbolic_tangent(model.centre)
    slope = 1 - t * t
    values = np.stack([t, slope, -t * slope, slope * (3 * t * t - 1) / 3])
    errors = np.stack([error, *[8 * error + _ROUNDINGS] * 3])  # the derivatives change by less than 8 with t
    return model.composed(Series(values, errors, _TANH * model.deviation() ** 4 * UP))


def square(model: TaylorModel) -> TaylorModel:
    """The model of f^2."""
    return model * model


def power(model: TaylorModel, exponent_: int) -> TaylorModel:
    """The model of f^k for a whole number k."""
    if exponent_ < 0:
        return reciprocal(power(model, -exponent_))
    result = TaylorModel.constant(np.ones_like(model.centre))
    for bit in bin(exponent_)[2:]:
        result = result * result
        result = result * model if bit == "1" else result
    return result


def _harmonic(value: Array, slope: Array, error: Array, away: Array) -> Series:
    """The series of sine and cosine, whose derivatives repeat: value, slope, -value, -slope."""
    values = np.stack([value, slope, -value / 2, -slope / 6])
    errors = np.stack([error, error, error, error]) + _ROUNDINGS
    return Series(values, errors, away**4 / 24 * UP)


UNARY: dict[str, Callable[[TaylorModel], TaylorModel]] = {
    "assign": lambda a: a,
    "neg": lambda a: -a,
    "twice": lambda a: a.times(2.0),
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
