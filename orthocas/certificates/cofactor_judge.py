"""A judge for charts with one fitted coordinate: the sign of one polynomial on boxes, by Bernstein forms."""

from dataclasses import dataclass
from functools import cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from orthocas.certificates.determinant import DEGREE, Determinant, multi_indices_up_to
from orthocas.certificates.judges import Verdicts, most_influential
from orthocas.certificates.taylor import TINY, UP, Variables, sum_error
from orthocas.charts.certificate import COFACTORS
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.checks import Array

_AT_ONCE = 128  # boxes whose expansions fit into the cache of a processor
_MOST_FORMS = 1100  # coefficients of a Bernstein form: cubic terms of five variables, quadratic ones of six


@dataclass(frozen=True, eq=False)
class CofactorJudge:
    """Proves det J != 0 by its expansion along the row of the coordinate."""

    determinant: Determinant
    method = COFACTORS

    @property
    def joints(self) -> Variables:
        """The joints that det J depends on."""
        return self.determinant.joints

    def __call__(self, low: Array, high: Array) -> Verdicts:
        """Judge boxes between corners (boxes, n)."""
        with one_blas_thread(), np.errstate(invalid="ignore", over="ignore"):
            pieces = [slice(k, k + _AT_ONCE) for k in range(0, len(low), _AT_ONCE)]
            parts = [self._few(low[piece], high[piece]) for piece in pieces]
        regular, sign, gains = (np.concatenate(each) for each in zip(*parts, strict=True))
        return Verdicts(regular, regular, sign, np.zeros(len(low)), most_influential(gains, self.joints))

    def _few(self, low: Array, high: Array) -> tuple[NDArray[np.bool_], Array, Array]:
        coefficients, rest = self.determinant(low, high)
        sign = np.nan_to_num(np.sign(coefficients[0]))
        n = len(self.joints)
        return positive(coefficients * sign, rest, n), sign, gains(coefficients, rest, n)


def positive(coefficients: Array, rest: Array, n: int) -> NDArray[np.bool_]:
    """Whether polynomials (monomials, boxes) in n variables from -1 to 1 are above a rest everywhere, (boxes,)."""
    sizes = np.abs(coefficients).sum(axis=0)
    surely = coefficients[0] - (sizes - np.abs(coefficients[0])) - rest > sum_error(len(coefficients)) * sizes
    unclear = np.flatnonzero(~surely & (coefficients[0] > rest))
    if unclear.size:
        surely[unclear] = least_value(coefficients[:, unclear], n) > rest[unclear]
    return np.asarray(surely)


def least_value(coefficients: Array, n: int) -> Array:
    """A number below all values of polynomials (monomials, boxes) in n variables from -1 to 1, (boxes,).

    A polynomial is not below the least coefficient of its Bernstein form, which is taken of low degrees. Terms of
    higher ones count with their sizes.
    """
    degree = max(d for d in range(1, 4) if (d + 1) ** n <= _MOST_FORMS or d == 1)
    kept = len(multi_indices_up_to(n, degree))
    form = np.zeros(((degree + 1) ** n, coefficients.shape[1]))
    form[_places(n, degree)] = coefficients[:kept]
    for _ in range(n):  # the first axis becomes the last one of the variables
        form = _bernstein(degree) @ form.reshape(degree + 1, -1)
        form = form.reshape(degree + 1, -1, coefficients.shape[1]).swapaxes(0, 1).reshape(-1, coefficients.shape[1])
    sizes = np.abs(coefficients).sum(axis=0)
    higher = np.abs(coefficients[kept:]).sum(axis=0)
    rounding = sum_error(8 * n * (degree + 1) + len(coefficients)) * sizes
    least: Array = form.min(axis=0) - (higher + rounding) * UP - TINY
    return least


def gains(coefficients: Array, rest: Array, n: int) -> Array:
    """How much halving the interval of each variable takes from the bound of the values, (boxes, n).

    The rest is shared out like the terms of the highest degree, which it is most like.
    """
    sizes, taken = np.abs(coefficients), _taken(n)
    highest = len(multi_indices_up_to(n, DEGREE - 1))
    last = taken[:, highest:] @ sizes[highest:]
    found: Array = taken @ sizes + last / (last.sum(axis=0) + TINY) * rest
    return found.T


@cache
def _taken(n: int) -> Array:
    """1 - 2^-power of each variable in each monomial, (n, monomials)."""
    return np.array([[1 - 0.5 ** m.count(v) for m in multi_indices_up_to(n, DEGREE)] for v in range(n)])


@cache
def _places(n: int, degree: int) -> NDArray[np.intp]:
    """Where the monomials stand in a table of the powers of each variable."""
    kept = multi_indices_up_to(n, degree)
    return np.array([sum((degree + 1) ** (n - 1 - v) for v in m) for m in kept], dtype=np.intp)


@cache
def _bernstein(degree: int) -> Array:
    """Bernstein coefficients (degree + 1,) of t^0, t^1, ... on [-1, 1], a column each; of sizes up to 1."""
    table = np.zeros((degree + 1, degree + 1))
    for power in range(degree + 1):
        for k in range(degree + 1):  # t = 2 s - 1, and s^i has the coefficients C(k, i) / C(degree, i)
            whole = sum(
                comb(power, i) * 2**i * (-1) ** (power - i) * comb(k, i) * (_all(degree) // comb(degree, i))
                for i in range(power + 1)
            )
            table[k, power] = whole / _all(degree)
    return table


def _all(degree: int) -> int:
    """A multiple of all C(degree, i)."""
    product = 1
    for i in range(degree + 1):
        product *= comb(degree, i)
    return product
