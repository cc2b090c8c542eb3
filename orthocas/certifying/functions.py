"""Elementary functions of Taylor models: their series about the centre, with a bound of the rest (ours)."""

from collections.abc import Callable

import numpy as np

from orthocas.certifying.elementary import exponential, hyperbolic_tangent, sine_and_cosine
from orthocas.certifying.rounding import UNIT, UP
from orthocas.certifying.taylor import Series, TaylorModel
from orthocas.checks import Array

_ROUNDINGS = 16 * UNIT  # relative error of a few operations in a row
_TANH = 6.2 / 24  # |tanh''''| = 8 |t| (1 - t^2) |2 - 3 t^2| < 8 * 0.385 * 2 for t = tanh x in [-1, 1]


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
POWERS = ("pow", "constpow")  #: with a whole constant exponent
