"""Elementary functions at floating-point numbers, with proven bounds of their errors (ours).

Sine, cosine and exponential come from argument reduction and Taylor polynomials, so their error follows from the
arithmetic alone; see `orthocas.certifying.rounding`. Arguments outside the range of the proof get an infinite error.
"""

from math import factorial

import numpy as np

from orthocas.certifying.rounding import UNIT
from orthocas.checks import Array

Enclosed = tuple[Array, Array]  #: values, and bounds of their absolute errors

# pi / 2 and ln 2 in pieces: the first ones are so short that products with whole numbers up to 2^20 are exact
_HALF_PI = tuple(map(float.fromhex, ("0x1.921fb54000000p+0", "0x1.10b4611800000p-30", "0x1.313198a2e0370p-61")))
_LN2 = tuple(map(float.fromhex, ("0x1.62e42fefa0000p-1", "0x1.cf79abc9e3b39p-40")))
_WIDEST_ANGLE, _WIDEST_EXPONENT = 1e6, 700.0
_ERROR = 32 * UNIT  # reduction 3 u, Horner's rule below 8 u, the rest of the series below 1e-4 u


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
