"""det J of charts with one fitted coordinate (r = 1), as one polynomial on a box.

Expanded along the row of the coordinate, det J = sum_j dxi/dq_j z_j with the cofactors z_j of the task's rows. These
are sums of waves, and dxi/dq_j is a polynomial, so both have Taylor series in closed form: that of waves of frequency k
leaves out at most |k . h|^6 / 6! on a box of half-widths h, and that of a polynomial ends. No matrix is inverted, and
joints on which self-motions do not depend, such as the first and the last one of an arm, do not count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from orthocas.bases.products import ProductFamily
from orthocas.certificates.chart_rows import ProductRows
from orthocas.certificates.jets import Around, powers
from orthocas.certificates.judges import Verdicts, most_influential
from orthocas.certificates.task_rows import task_rows
from orthocas.certificates.taylor import (
    TINY,
    UNIT,
    UP,
    Monomial,
    Variables,
    above,
    monomials,
    sine_and_cosine,
    sum_error,
)
from orthocas.certificates.waves import Waves, cofactors, waves_of
from orthocas.charts.certificate import COFACTORS
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import CertifyError
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.checks import Array
from orthocas.tools.expressions import write_tape

DEGREE = 5  #: of the polynomials: more of it costs more and leaves less out
_ROUNDINGS = 64  # of numbers in a table, of powers, and of a few operations around a sum
_SPLITS = 2**DEGREE  # products of two coefficients that add up to one, for each pair of factors
_MOST_COLUMNS = 8

Expansion = tuple[Array, Array]  #: coefficients (..., monomials, boxes) in t from -1 to 1, and a bound of the rest
_AT_ONCE = 128  # boxes whose expansions fit into the cache of a processor
_MOST_FORMS = 1100  # coefficients of a Bernstein form: cubic terms of five variables, quadratic ones of six


@dataclass(frozen=True, eq=False)
class WaveSeries:
    """Taylor series of sums of waves."""

    frequencies: Array  #: (waves, variables); of k and -k only one
    sizes: Array  #: of the coefficients c_k, (sums, waves)
    table: Array  #: derivatives as sums of cosines, then sines, (sums * monomials, 2 * waves)
    errors: Array  #: (sums,)

    @classmethod
    def of(cls, sums: Sequence[Waves], joints: Variables) -> "WaveSeries":
        """Of sums that depend on these joints only."""
        every = np.concatenate([each.frequencies[:, joints] for each in sums])
        kept = sorted({max(k, tuple(-i for i in k)) for k in map(tuple, every.tolist())})
        place = {k: i for i, k in enumerate(kept)}
        c = np.zeros((len(sums), len(kept)), dtype=complex)
        for own, each in zip(c, sums, strict=True):
            for k, value in zip(map(tuple, each.frequencies[:, joints].tolist()), each.coefficients, strict=True):
                if k in place:
                    own[place[k]] += value
                else:  # the real part of c exp(-i k q) is that of its conjugate
                    own[place[tuple(-i for i in k)]] += np.conj(value)
        waves: Array = np.array(kept, dtype=float).reshape(len(kept), len(joints))
        slopes = [np.prod(1j * waves[:, list(m)], axis=1) for m in multi_indices_up_to(len(joints), DEGREE)]
        products = c[:, None] * np.array(slopes)
        table = np.concatenate([products.real, -products.imag], axis=2).reshape(-1, 2 * len(kept))
        sizes = np.abs(c) * UP
        rounding = _ROUNDINGS * UNIT * sizes.sum(axis=1)
        return cls(waves, sizes, table, (np.array([each.error for each in sums]) + rounding) * UP)

    def __call__(self, centre: Array, half: Array) -> Expansion:
        """Expansions of all sums, (sums, monomials, boxes), for boxes of given middles and half-widths (n, boxes)."""
        (sine, error), (cosine, _) = sine_and_cosine(self.frequencies @ centre)
        values = np.concatenate([cosine, sine])
        found = (self.table @ values).reshape(len(self.sizes), -1, centre.shape[1]) * power_table(half, DEGREE)
        turns = np.abs(self.frequencies) @ half * UP  # |k . h|
        phases = sum_error(len(centre)) * (np.abs(self.frequencies).max(axis=0, initial=0) @ np.abs(centre))
        relative = 2 * (sum_error(len(values) + _ROUNDINGS) + error.max(axis=0, initial=0) + phases) * UP
        known = sum(turns**d / factorial(d) for d in range(DEGREE + 1))
        rest = self.sizes @ (turns ** (DEGREE + 1) / factorial(DEGREE + 1) + relative * known)
        return found, rest * above(len(self.frequencies)) + self.errors[:, None] + TINY


@dataclass(frozen=True, eq=False)
class PolynomialSeries:
    """Taylor series of polynomials, which are exact."""

    centre: Array  #: where the derivatives are taken, (variables,)
    scale: Array  #: unit of the variables, (variables,)
    degree: int
    table: Array  #: derivatives by monomials a and b, (polynomials * monomials a, monomials b)
    sizes: Array  #: sums of the sizes of coefficients, (polynomials,)
    errors: Array  #: sums of the errors of coefficients, (polynomials,)

    @classmethod
    def of(cls, values: Array, doubts: Array, family: ProductFamily, variables: list[int]) -> "PolynomialSeries":
        """Of derivatives and their errors by `_slopes`, for the variables that they depend on."""
        degree, n = _degree(family), family.space.n
        places = {m: k for k, m in enumerate(multi_indices_up_to(n, degree))}
        kept = multi_indices_up_to(len(variables), degree)
        numbers = [places[tuple(sorted(variables[v] for v in m))] for m in kept]
        values, doubts = values[:, numbers], doubts[:, numbers]
        own = {m: k for k, m in enumerate(kept)}
        table = np.zeros((len(values), len(kept), len(kept)))
        for i, a in enumerate(kept):
            for j, b in enumerate(kept):
                if len(a) + len(b) <= degree:
                    table[:, i, j] = values[:, own[tuple(sorted(a + b))]]
        weights = power_table(np.ones((len(variables), 1)), degree)[:, 0]  # 1 / a!
        sizes, errors = (np.asarray(each @ weights * above(len(kept))) for each in (np.abs(values) + doubts, doubts))
        centre, scale = family.space.centre[variables], family.space.half_width[variables]
        return cls(centre, scale, degree, table.reshape(len(values) * len(kept), len(kept)), sizes, errors)

    def __call__(self, centre: Array, half: Array) -> Expansion:
        """Expansions of all polynomials, (polynomials, monomials, boxes)."""
        u, h = ((centre.T - self.centre) / self.scale).T, (half.T / self.scale).T
        terms = power_table(u, self.degree)
        found = (self.table @ terms).reshape(len(self.sizes), *terms.shape)
        reach = np.maximum(1.0, (np.abs(u) + h).max(axis=0, initial=0)) ** self.degree * UP
        rounding = sum_error(self.table.shape[1] + _ROUNDINGS) * self.sizes
        return found * power_table(h, self.degree), (self.errors + rounding)[:, None] * reach * UP + TINY


@dataclass(frozen=True, eq=False)
class Determinant:
    """det J, up to a positive factor: the scale of the coordinate, and that of task rows that are rotated."""

    joints: Variables  #: on which it depends
    cofactors: WaveSeries  #: of the columns where dxi/dq varies; then the sum of the others times their constants
    slopes: PolynomialSeries  #: dxi/dq of the columns where it varies

    @classmethod
    def of(cls, chart: Chart) -> "Determinant | None":
        """Of a chart with one fitted coordinate, a polynomial, and task rows of sines and cosines; None for others."""
        coordinates = chart.coordinates
        if not isinstance(coordinates, Coordinates) or len(coordinates.offset) != 1:
            return None
        active, family = list(coordinates.active), coordinates.family
        if not chart.m + 1 == len(active) <= _MOST_COLUMNS:
            return None
        if not isinstance(family, ProductFamily) or not _is_polynomial(family):
            return None
        try:
            z = cofactors([[row[j] for j in active] for row in _task_waves(chart)])
        except CertifyError:
            return None
        values, doubts = _slopes(family, coordinates.theta)
        varying = [j for j in range(len(z)) if (np.abs(values[j, 1:]) + doubts[j, 1:]).any()]
        constant = Waves.constant(0.0, chart.n)
        for j in {*range(len(z))} - {*varying}:
            constant = constant + z[j] * Waves.constant(float(values[j, 0]), chart.n, float(doubts[j, 0]))
        sums = [*(z[j] for j in varying), constant.trimmed()]
        turning = {i for each in sums for i in np.flatnonzero(each.frequencies.any(axis=0)).tolist()}
        every = multi_indices_up_to(len(active), _degree(family))
        bending = {active[i] for k, m in enumerate(every) if (np.abs(values[:, k]) + doubts[:, k]).any() for i in m}
        joints = tuple(sorted(turning | bending))
        own = PolynomialSeries.of(values[varying], doubts[varying], family, [active.index(j) for j in joints])
        return cls(joints, WaveSeries.of(sums, joints), own)

    def __call__(self, low: Array, high: Array) -> Expansion:
        """The expansion on boxes between corners (boxes, n)."""
        chosen = list(self.joints)
        middle = ((low + high) / 2)[:, chosen].T
        half = np.nextafter(np.maximum(high[:, chosen].T - middle, middle - low[:, chosen].T), np.inf) + TINY
        (A, rest_a), (B, rest_b) = self.slopes(middle, half), self.cofactors(middle, half)
        found, rest = _product(A, B[:-1], self.slopes.degree, len(chosen))
        total_a, total_b = (np.abs(part).sum(axis=1) for part in (A, B[:-1]))
        carried = rest_a * (total_b + rest_b[:-1]) + total_a * rest_b[:-1] + rest
        carried += sum_error(_SPLITS * len(A)) * total_a * total_b
        coefficients = found + B[-1]
        unknown = carried.sum(axis=0) + rest_b[-1] + UNIT * np.abs(coefficients).sum(axis=0)
        return coefficients, unknown * above(A.shape[1] + len(coefficients)) + TINY


def multi_indices_up_to(n: int, degree: int) -> tuple[Monomial, ...]:
    """The monomials in n variables up to a degree."""
    return monomials(tuple(range(n)), degree)


def power_table(x: Array, degree: int) -> Array:
    """x^a / a! for all monomials a up to a degree, (monomials, boxes), for x (n, boxes)."""
    return np.concatenate([powers(x, order) for order in range(degree + 1)])


def _is_polynomial(family: ProductFamily) -> bool:
    """Whether each derivative of a one-joint function is a sum of earlier ones."""
    return all(not np.triu(family.one_joint_derivatives(i)).any() for i in range(family.space.n))


def _degree(family: ProductFamily) -> int:
    """A bound of the degree of the first derivatives: each derivative leads to earlier functions."""
    return max(map(sum, family.terms)) - 1


def _slopes(family: ProductFamily, theta: Array) -> tuple[Array, Array]:
    """The derivatives of dxi/dq at the centre, and their errors, both (joints, monomials).

    They are taken in units of the half-widths: by u with q = centre + half_width u.
    """
    degree, space = _degree(family), family.space
    nothing = np.zeros((space.n, 1))
    rows = ProductRows.of(family, theta, degree + 2)
    jets = rows.jets(Around(space.centre[:, None], nothing, nothing, degree))
    every = multi_indices_up_to(space.n, degree)
    unit = np.array([np.prod(space.half_width[list(m)]) for m in every])
    values = np.concatenate([part[0, :, :, 0] for part in jets.derivatives], axis=1) * unit
    doubts = [np.broadcast_to(e, d.shape)[0, :, :, 0] for d, e in zip(jets.derivatives, jets.doubts, strict=True)]
    rounding = (degree + 2) * UNIT * np.abs(values)
    return values, (np.concatenate(doubts, axis=1) * unit + rounding) * UP


def _task_waves(chart: Chart) -> list[list[Waves]]:
    """The rows of the task Jacobian, or rows that are rotated by some C(q) with det C > 0, (m, n).

    Raises:
        CertifyError: if they are no sums of waves.
    """
    task, n = chart.problem.task, chart.n
    rows, allowance = task_rows(task, chart.problem.domain)
    if rows is task.jacobian_function:  # CasADi's derivatives have rounded constants, waves have their own
        return [[each.derivative(j) for j in range(n)] for each in waves_of(write_tape(task.function), n)]
    entries = [replace(each, error=each.error + allowance) for each in waves_of(write_tape(rows), n)]
    return [entries[i :: task.m] for i in range(task.m)]


@cache
def _products(n: int, degree: int) -> tuple[tuple[bool, int, slice, NDArray[np.intp]], ...]:
    """How to multiply polynomials a, up to a degree, and b: one coefficient of a factor by some of the other.

    Each entry is whether that one belongs to a, its place, those of the others, and where the products go.
    """
    every = multi_indices_up_to(n, max(DEGREE, degree))
    place = {m: k for k, m in enumerate(every)}
    starts = [len(multi_indices_up_to(n, d - 1)) if d else 0 for d in range(max(DEGREE, degree) + 2)]
    found = []
    for k, one in enumerate(every):
        own = len(one)
        for of_a, least, most in ((True, own, DEGREE - own), (False, own + 1, min(degree, DEGREE - own))):
            if least <= most and (not of_a or own <= degree):
                others = slice(starts[least], starts[most + 1])
                where = np.array([place[tuple(sorted(one + other))] for other in every[others]])
                found.append((of_a, k, others, where))
    return tuple(found)


def _product(A: Array, B: Array, degree: int, n: int) -> Expansion:
    """sum_i A_i B_i up to `DEGREE`, for factors (pairs, monomials, boxes), and what is left out, (pairs, boxes)."""
    out = np.zeros((B.shape[1], A.shape[2]))
    for of_a, k, others, where in _products(n, degree):
        one, many = (A[:, k], B[:, others]) if of_a else (B[:, k], A[:, others])
        out[where] += np.einsum("in,ikn->kn", one, many)
    size_a, size_b = _by_degree(A, n, degree), _by_degree(B, n, DEGREE)
    left_out = np.zeros(A[:, 0].shape)
    for i, a in enumerate(size_a):
        left_out += a * size_b[max(0, DEGREE + 1 - i) :].sum(axis=0)
    return out, left_out


def _by_degree(coefficients: Array, n: int, degree: int) -> Array:
    """Sums of the sizes of the coefficients of each degree, (degrees, pairs, boxes)."""
    starts = [len(multi_indices_up_to(n, d - 1)) if d else 0 for d in range(degree + 1)]
    return np.add.reduceat(np.abs(coefficients), starts, axis=1).swapaxes(0, 1)


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
