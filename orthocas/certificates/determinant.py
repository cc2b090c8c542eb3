"""det J of charts with one fitted coordinate (r = 1), as one polynomial on a box.

Expanded along the row of the coordinate, det J = sum_j dxi/dq_j z_j with the cofactors z_j of the task's rows. The z_j
are sums of waves, and dxi/dq_j is a polynomial, so both have Taylor series in closed form. On a box of half-widths h,
the truncation error is at most |k . h|^6 / 6! for a wave of frequency k, and zero for a polynomial of low degree. No
matrix is inverted. Joints on which self-motions do not depend, such as the first and the last joint of an arm, drop
out.

Rows of arms are sums of products of sines and cosines of single joints. Each expands to a short sum of waves c_k exp(i
k . q) with integer k, and so do its derivatives and the minors of a matrix of such rows. The numbers c_k are known up
to rounding only, so each sum carries an error bound.

Source:
    ours, docs/explanation/certificates.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, reduce
from itertools import combinations
from math import comb, factorial, prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocas.bases.products import ProductFamily
from orthocas.certificates.box_checks import BoxResults, check_in_turn, find_most_influential
from orthocas.certificates.jets import Around, compute_powers
from orthocas.certificates.rows import ProductRows, transform_task_rows
from orthocas.certificates.taylor import (
    TINY,
    UNIT,
    UP,
    Monomial,
    Variables,
    compute_margin,
    evaluate_sine_cosine,
    list_monomials,
    sum_error,
    weigh_halving,
)
from orthocas.charts.certificate import COFACTORS
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import CertifyError
from orthocas.tools.checks import Array
from orthocas.tools.expressions import Tape, evaluate_tape, write_tape


@dataclass(frozen=True, slots=True)
class DeterminantRules:
    """Limits of the work, and bounds on rounding."""

    terms: int = 1_000_000  #: largest number of terms of a product of waves before equal frequencies are merged
    highest: int = 100  #: largest frequency of a joint
    joints: int = 8  #: largest number of joints, so that the frequencies of a wave fit into one 64-bit integer
    complex: int = 8  #: roundings of a complex product, with a margin
    small: float = 1e-16  #: waves smaller than this times the sum of all sizes go into the error ...
    small_of_error: float = 1e-6  #: ... and so do waves smaller than this times the error
    roundings: int = 64  #: roundings of numbers in tables, of powers, and of a few operations around a sum
    columns: int = 8  #: largest number of columns of the determinant
    at_once: int = 128  #: number of boxes whose expansions fit into the cache of a processor
    #: largest number of coefficients of a Bernstein form: cubic in five variables, or quadratic in six
    forms: int = 1100


RULES = DeterminantRules()
SERIES_DEGREE = 5  #: degree of the polynomials; a higher degree costs more and has a smaller truncation error
_SPLITS = 2**SERIES_DEGREE  #: most products that sum to one coefficient, for each pair of factors

#: coefficients (..., monomials, boxes) in t from -1 to 1, and a bound of the truncation error
Expansion = tuple[Array, Array]


@dataclass(frozen=True, eq=False, repr=False)
class CofactorCheck:
    """Proves det J != 0 by its expansion along the row of the coordinate."""

    determinant: "Determinant"
    method = COFACTORS

    @property
    def joints(self) -> Variables:
        """The joints that det J depends on."""
        return self.determinant.joints

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        regular, sign, gains = check_in_turn(self._check_few, low, high, RULES.at_once)
        return BoxResults(regular, regular, sign, np.zeros(len(low)), find_most_influential(gains, self.joints))

    def _check_few(self, low: Array, high: Array) -> tuple[NDArray[np.bool_], Array, Array]:
        # The box is proved if det J keeps the sign of its centre.
        coefficients, rest = self.determinant(low, high)
        sign = np.nan_to_num(np.sign(coefficients[0]))
        n = len(self.joints)
        return is_positive(coefficients * sign, rest, n), sign, compute_gains(coefficients, rest, n)


@dataclass(frozen=True, eq=False, repr=False)
class Determinant:
    """det J up to a positive factor, because the coordinate is scaled and task rows may be rotated."""

    joints: Variables  #: the joints that det J depends on
    #: cofactors of the columns where dxi/dq varies, then the sum of all others times their constants
    cofactors: "WaveSeries"
    slopes: "PolynomialSeries"  #: dxi/dq of the columns where it varies

    @classmethod
    def build(cls, chart: Chart) -> "Determinant | None":
        """Build for a chart with one fitted polynomial and task rows of sines and cosines; None for other charts."""
        coordinates = chart.coordinates
        if not isinstance(coordinates, Coordinates) or len(coordinates.offset) != 1:
            return None
        active, family = list(coordinates.active), coordinates.family
        if not chart.m + 1 == len(active) <= RULES.columns:
            return None
        # A family is polynomial if each derivative of a one-joint function is a sum of earlier functions.
        if not isinstance(family, ProductFamily):
            return None
        if any(np.triu(family.one_joint_derivatives(i)).any() for i in range(family.space.n)):
            return None
        try:
            z = compute_cofactors([[row[j] for j in active] for row in _expand_task_rows(chart)])
        except CertifyError:
            return None
        # Keep columns separate where dxi/dq varies, and sum the others, multiplied by their constants.
        values, doubts = _differentiate_coordinate(family, coordinates.theta)
        varying = [j for j in range(len(z)) if (np.abs(values[j, 1:]) + doubts[j, 1:]).any()]
        constant = Waves.constant(0.0, chart.n)
        for j in {*range(len(z))} - {*varying}:
            constant = constant + z[j] * Waves.constant(float(values[j, 0]), chart.n, float(doubts[j, 0]))
        # Collect the joints of all waves and of all monomials.
        sums = [*(z[j] for j in varying), constant.trim()]
        turning = {i for each in sums for i in np.flatnonzero(each.frequencies.any(axis=0)).tolist()}
        every = list_indices(len(active), _bound_degree(family))
        bending = {active[i] for k, m in enumerate(every) if (np.abs(values[:, k]) + doubts[:, k]).any() for i in m}
        joints = tuple(sorted(turning | bending))
        own = PolynomialSeries.build(values[varying], doubts[varying], family, [active.index(j) for j in joints])
        return cls(joints, WaveSeries.build(sums, joints), own)

    def __call__(self, low: Array, high: Array) -> Expansion:
        """The expansion on boxes between corners (boxes, n)."""
        # Expand both factors about the centres of the boxes, and multiply them.
        chosen = list(self.joints)
        centre = ((low + high) / 2)[:, chosen].T
        half = np.nextafter(np.maximum(high[:, chosen].T - centre, centre - low[:, chosen].T), np.inf) + TINY
        (A, rest_a), (B, rest_b) = self.slopes(centre, half), self.cofactors(centre, half)
        B, last = B[:-1], B[-1]
        # Sum the products of the pairs of factors up to the degree, monomial by monomial.
        products, n, degree = np.zeros((B.shape[1], A.shape[2])), len(chosen), self.slopes.degree
        for of_a, k, others, where in _plan_products(n, degree):
            one, many = (A[:, k], B[:, others]) if of_a else (B[:, k], A[:, others])
            products[where] += np.einsum("in,ikn->kn", one, many)
        # Bound the products of higher degree.
        size_a, size_b = _sum_by_degree(A, n, degree), _sum_by_degree(B, n, SERIES_DEGREE)
        rest = np.zeros(A[:, 0].shape)
        for i, a in enumerate(size_a):
            rest += a * size_b[max(0, SERIES_DEGREE + 1 - i) :].sum(axis=0)
        # The truncation error of each factor is multiplied by the size of the other.
        total_a, total_b = (np.abs(part).sum(axis=1) for part in (A, B))
        carried = rest_a * (total_b + rest_b[:-1]) + total_a * rest_b[:-1] + rest
        carried += sum_error(_SPLITS * len(A)) * total_a * total_b
        coefficients = products + last
        unknown = carried.sum(axis=0) + rest_b[-1] + UNIT * np.abs(coefficients).sum(axis=0)
        return coefficients, unknown * compute_margin(A.shape[1] + len(coefficients)) + TINY


@dataclass(frozen=True, eq=False, repr=False)
class WaveSeries:
    """Taylor series of sums of waves."""

    frequencies: Array  #: (waves, variables); of k and -k only one is kept
    sizes: Array  #: |c_k|, (sums, waves)
    table: Array  #: derivatives as sums of cosines, then sines, (sums * monomials, 2 * waves)
    errors: Array  #: (sums,)

    @classmethod
    def build(cls, sums: "Sequence[Waves]", joints: Variables) -> "WaveSeries":
        """Build for sums that depend on these joints only."""
        # Collect the frequencies of all sums, with one of k and -k each.
        every = np.concatenate([each.frequencies[:, joints] for each in sums])
        kept = sorted({max(k, tuple(-i for i in k)) for k in map(tuple, every.tolist())})
        place = {k: i for i, k in enumerate(kept)}
        c = np.zeros((len(sums), len(kept)), dtype=complex)
        for own, each in zip(c, sums, strict=True):
            for k, value in zip(map(tuple, each.frequencies[:, joints].tolist()), each.coefficients, strict=True):
                # c exp(-i k q) has the same real part as its conjugate.
                if k in place:
                    own[place[k]] += value
                else:
                    own[place[tuple(-i for i in k)]] += np.conj(value)
        # Tabulate the derivatives of each wave as sums of cosines and sines.
        waves: Array = np.array(kept, dtype=float).reshape(len(kept), len(joints))
        slopes = [np.prod(1j * waves[:, list(m)], axis=1) for m in list_indices(len(joints), SERIES_DEGREE)]
        products = c[:, None] * np.array(slopes)
        table = np.concatenate([products.real, -products.imag], axis=2).reshape(-1, 2 * len(kept))
        # Add a bound of the rounding errors.
        sizes = np.abs(c) * UP
        rounding = RULES.roundings * UNIT * sizes.sum(axis=1)
        return cls(waves, sizes, table, (np.array([each.error for each in sums]) + rounding) * UP)

    def __call__(self, centre: Array, half: Array) -> Expansion:
        """Expand all sums, (sums, monomials, boxes), for boxes of given centres and half-widths (n, boxes)."""
        (sine, error), (cosine, _) = evaluate_sine_cosine(self.frequencies @ centre)
        values = np.concatenate([cosine, sine])
        coefficients = (self.table @ values).reshape(len(self.sizes), -1, centre.shape[1])
        coefficients = coefficients * build_power_table(half, SERIES_DEGREE)
        # Upper bound of |k . h|.
        turns = np.abs(self.frequencies) @ half * UP
        phases = sum_error(len(centre)) * (np.abs(self.frequencies).max(axis=0, initial=0) @ np.abs(centre))
        relative = 2 * (sum_error(len(values) + RULES.roundings) + error.max(axis=0, initial=0) + phases) * UP
        truncated = sum(turns**d / factorial(d) for d in range(SERIES_DEGREE + 1))
        rest = self.sizes @ (turns ** (SERIES_DEGREE + 1) / factorial(SERIES_DEGREE + 1) + relative * truncated)
        return coefficients, rest * compute_margin(len(self.frequencies)) + self.errors[:, None] + TINY


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialSeries:
    """Taylor series of polynomials. They have no truncation error."""

    centre: Array  #: where the derivatives are taken, (variables,)
    scale: Array  #: unit of the variables, (variables,)
    degree: int
    table: Array  #: derivatives by monomials a and b, (polynomials * monomials a, monomials b)
    sizes: Array  #: sums of absolute coefficients, (polynomials,)
    errors: Array  #: sums of coefficient errors, (polynomials,)

    @classmethod
    def build(cls, values: Array, doubts: Array, family: ProductFamily, variables: list[int]) -> "PolynomialSeries":
        """Build from derivatives and errors of `_differentiate_coordinate`, for the variables that they depend on."""
        # Keep the derivatives by these variables only.
        degree, n = _bound_degree(family), family.space.n
        places = {m: k for k, m in enumerate(list_indices(n, degree))}
        kept = list_indices(len(variables), degree)
        numbers = [places[tuple(sorted(variables[v] for v in m))] for m in kept]
        values, doubts = values[:, numbers], doubts[:, numbers]
        own = {m: k for k, m in enumerate(kept)}
        # Derivative of each polynomial by a and b; it is zero above the degree of the polynomial.
        table = np.zeros((len(values), len(kept), len(kept)))
        for i, a in enumerate(kept):
            for j, b in enumerate(kept):
                if len(a) + len(b) <= degree:
                    table[:, i, j] = values[:, own[tuple(sorted(a + b))]]
        # The weights are 1 / a!.
        weights, margin = build_power_table(np.ones((len(variables), 1)), degree)[:, 0], compute_margin(len(kept))
        sizes, errors = (np.asarray(each @ weights * margin) for each in (np.abs(values) + doubts, doubts))
        centre, scale = family.space.centre[variables], family.space.half_width[variables]
        return cls(centre, scale, degree, table.reshape(len(values) * len(kept), len(kept)), sizes, errors)

    def __call__(self, centre: Array, half: Array) -> Expansion:
        """Expand all polynomials, (polynomials, monomials, boxes)."""
        u, h = ((centre.T - self.centre) / self.scale).T, (half.T / self.scale).T
        terms = build_power_table(u, self.degree)
        coefficients = (self.table @ terms).reshape(len(self.sizes), *terms.shape)
        reach = np.maximum(1.0, (np.abs(u) + h).max(axis=0, initial=0)) ** self.degree * UP
        rounding = sum_error(self.table.shape[1] + RULES.roundings) * self.sizes
        return coefficients * build_power_table(h, self.degree), (self.errors + rounding)[:, None] * reach * UP + TINY


def list_indices(n: int, degree: int) -> tuple[Monomial, ...]:
    """The monomials in n variables up to a degree."""
    return list_monomials(tuple(range(n)), degree)


def build_power_table(x: Array, degree: int) -> Array:
    """x^a / a! for all monomials a up to a degree, (monomials, boxes), for x (n, boxes)."""
    return np.concatenate([compute_powers(x, order) for order in range(degree + 1)])


def _bound_degree(family: ProductFamily) -> int:
    """Upper bound of the degree of the first derivatives, since each derivative consists of earlier functions."""
    return max(map(sum, family.terms)) - 1


def _differentiate_coordinate(family: ProductFamily, theta: Array) -> tuple[Array, Array]:
    """The derivatives of dxi/dq at the centre, and their error bounds, both (joints, monomials).

    They are derivatives by u, with q = centre + half_width u.
    """
    degree, space = _bound_degree(family), family.space
    nothing = np.zeros((space.n, 1))
    # Jets at the centre, on a box of zero width.
    rows = ProductRows.build(family, theta, degree + 2)
    jets = rows.build_jets(Around(space.centre[:, None], nothing, nothing, degree))
    every = list_indices(space.n, degree)
    unit = np.array([np.prod(space.half_width[list(m)]) for m in every])
    values = np.concatenate([part[0, :, :, 0] for part in jets.derivatives], axis=1) * unit
    doubts = [np.broadcast_to(e, d.shape)[0, :, :, 0] for d, e in zip(jets.derivatives, jets.doubts, strict=True)]
    rounding = (degree + 2) * UNIT * np.abs(values)
    return values, (np.concatenate(doubts, axis=1) * unit + rounding) * UP


def _expand_task_rows(chart: Chart) -> "list[list[Waves]]":
    """The rows of the task Jacobian as waves, (m, n), or the rows multiplied by some C(q) with det C > 0.

    Raises:
        CertifyError: if the rows are not sums of waves.
    """
    task, n = chart.problem.task, chart.n
    rows, allowance = transform_task_rows(task, chart.problem.domain)
    # Differentiate the waves, because CasADi's derivatives contain rounded constants.
    if rows is task.jacobian_function:
        return [[each.differentiate(j) for j in range(n)] for each in expand_waves(write_tape(task.function), n)]
    entries = [replace(each, error=each.error + allowance) for each in expand_waves(write_tape(rows), n)]
    return [entries[i :: task.m] for i in range(task.m)]


@cache
def _plan_products(n: int, degree: int) -> tuple[tuple[bool, int, slice, NDArray[np.intp]], ...]:
    """Plan the product of two polynomials, a up to a degree, and b.

    Each entry multiplies one coefficient of a factor by several of the other. It lists whether the single coefficient
    belongs to a, its index, the indices of the other coefficients, and the indices of the products.
    """
    # In each pair of degrees, the single coefficient belongs to the factor of lower degree, and to a if both are equal.
    every = list_indices(n, max(SERIES_DEGREE, degree))
    place = {m: k for k, m in enumerate(every)}
    starts = [len(list_indices(n, d - 1)) if d else 0 for d in range(max(SERIES_DEGREE, degree) + 2)]
    plan = []
    # Take each pair once if its degrees add up to at most the kept degree.
    for k, one in enumerate(every):
        own = len(one)
        for of_a, least, most in ((True, own, SERIES_DEGREE - own), (False, own + 1, min(degree, SERIES_DEGREE - own))):
            if least <= most and (not of_a or own <= degree):
                others = slice(starts[least], starts[most + 1])
                where = np.array([place[tuple(sorted(one + other))] for other in every[others]])
                plan.append((of_a, k, others, where))
    return tuple(plan)


def _sum_by_degree(coefficients: Array, n: int, degree: int) -> Array:
    """Sums of absolute coefficients by degree, (degrees, pairs, boxes)."""
    starts = [len(list_indices(n, d - 1)) if d else 0 for d in range(degree + 1)]
    return np.add.reduceat(np.abs(coefficients), starts, axis=1).swapaxes(0, 1)


def is_positive(coefficients: Array, rest: Array, n: int) -> NDArray[np.bool_]:
    """Whether polynomials (monomials, boxes) in n variables from -1 to 1 exceed an error everywhere, (boxes,)."""
    sizes = np.abs(coefficients).sum(axis=0)
    surely = coefficients[0] - (sizes - np.abs(coefficients[0])) - rest > sum_error(len(coefficients)) * sizes
    unclear = np.flatnonzero(~surely & (coefficients[0] > rest))
    if unclear.size:
        surely[unclear] = bound_polynomial(coefficients[:, unclear], n) > rest[unclear]
    return np.asarray(surely)


def bound_polynomial(coefficients: Array, n: int) -> Array:
    """Lower bound of polynomials (monomials, boxes) in n variables from -1 to 1, (boxes,).

    A polynomial is at least the least coefficient of its Bernstein form. Only low-degree terms are converted to this
    form; higher terms are bounded by their absolute values.
    """
    degree = max(d for d in range(1, 4) if (d + 1) ** n <= RULES.forms or d == 1)
    kept = len(list_indices(n, degree))
    form = np.zeros(((degree + 1) ** n, coefficients.shape[1]))
    form[_find_places(n, degree)] = coefficients[:kept]
    # Each round transforms the first axis and moves it behind the other variables.
    for _ in range(n):
        form = _build_bernstein(degree) @ form.reshape(degree + 1, -1)
        form = form.reshape(degree + 1, -1, coefficients.shape[1]).swapaxes(0, 1).reshape(-1, coefficients.shape[1])
    sizes = np.abs(coefficients).sum(axis=0)
    higher = np.abs(coefficients[kept:]).sum(axis=0)
    rounding = sum_error(8 * n * (degree + 1) + len(coefficients)) * sizes
    return np.asarray(form.min(axis=0) - (higher + rounding) * UP - TINY)


def compute_gains(coefficients: Array, rest: Array, n: int) -> Array:
    """How much halving the interval of each variable improves the bound of the values, (boxes, n).

    The truncation error is distributed like the terms of the highest degree, which it resembles most.
    """
    sizes, taken = np.abs(coefficients), weigh_halving(tuple(range(n)), SERIES_DEGREE)
    highest = len(list_indices(n, SERIES_DEGREE - 1))
    last = taken[:, highest:] @ sizes[highest:]
    gains: Array = taken @ sizes + last / (last.sum(axis=0) + TINY) * rest
    return gains.T


@cache
def _find_places(n: int, degree: int) -> NDArray[np.intp]:
    """Indices of the monomials in a table of the powers of each variable."""
    kept = list_indices(n, degree)
    return np.array([sum((degree + 1) ** (n - 1 - v) for v in m) for m in kept], dtype=np.intp)


@cache
def _build_bernstein(degree: int) -> Array:
    """Bernstein coefficients of t^0, t^1, ... on [-1, 1], one column each; square, with entries up to 1."""
    table = np.zeros((degree + 1, degree + 1))
    # With t = 2 s - 1, s^i has the coefficients C(k, i) / C(degree, i). A common multiple keeps all sums integer.
    multiple = prod(comb(degree, i) for i in range(degree + 1))
    for exponent in range(degree + 1):
        for k in range(degree + 1):
            whole = sum(
                comb(exponent, i) * 2**i * (-1) ** (exponent - i) * comb(k, i) * (multiple // comb(degree, i))
                for i in range(exponent + 1)
            )
            table[k, exponent] = whole / multiple
    return table


@dataclass(frozen=True, eq=False)
class Waves:
    """A real function q (n,) -> sum_k c_k exp(i k . q), with a bound of its error at any real q."""

    frequencies: NDArray[np.int64]  #: k, (terms, n), each only once
    coefficients: NDArray[np.complex128]  #: c_k, (terms,)
    error: float

    @classmethod
    def constant(cls, value: float, n: int, error: float = 0.0) -> "Waves":
        """A number."""
        return cls(np.zeros((1, n), dtype=np.int64), np.array([complex(value)]), error)

    @classmethod
    def sine(cls, joint: int, n: int) -> "Waves":
        """The sine of a joint's position."""
        return cls(_pair_frequencies(joint, n), np.array([-0.5j, 0.5j]), 0.0)

    @classmethod
    def cosine(cls, joint: int, n: int) -> "Waves":
        """The cosine of a joint's position."""
        return cls(_pair_frequencies(joint, n), np.array([0.5 + 0j, 0.5 + 0j]), 0.0)

    @property
    def size(self) -> float:
        """An upper bound of the absolute values, without the error."""
        return float(np.abs(self.coefficients).sum()) * compute_margin(len(self.coefficients))

    def __neg__(self) -> "Waves":
        return replace(self, coefficients=-self.coefficients)

    def __add__(self, other: "Waves") -> "Waves":
        return _merge_waves(
            np.concatenate([self.frequencies, other.frequencies]),
            np.concatenate([self.coefficients, other.coefficients]),
            self.error + other.error,
        )

    def __sub__(self, other: "Waves") -> "Waves":
        return self + (-other)

    def __mul__(self, other: "Waves") -> "Waves":
        if len(self.coefficients) * len(other.coefficients) > RULES.terms:
            raise CertifyError("the task Jacobian expands into too many waves, expected a task with fewer joints")
        frequencies = (self.frequencies[:, None] + other.frequencies[None]).reshape(-1, self.frequencies.shape[1])
        coefficients = (self.coefficients[:, None] * other.coefficients[None]).ravel()
        carried = self.error * (other.size + other.error) + self.size * other.error
        rounding = sum_error(RULES.complex) * self.size * other.size
        return _merge_waves(frequencies, coefficients, (carried + rounding) * UP)

    def differentiate(self, joint: int) -> "Waves":
        """Derivative by one joint. The error may contain rounding of these coefficients only."""
        k = self.frequencies[:, joint]
        highest = int(np.abs(k).max(initial=0))
        error = (highest * self.error + RULES.complex * UNIT * highest * self.size) * UP
        return replace(self, coefficients=1j * k * self.coefficients, error=error)

    def trim(self) -> "Waves":
        """The sum without negligible waves, whose size is added to the error."""
        sizes = np.abs(self.coefficients)
        kept = sizes > max(RULES.small * float(sizes.sum()), RULES.small_of_error * self.error)
        left_out = float(sizes[~kept].sum()) * compute_margin(len(sizes))
        return Waves(self.frequencies[kept], self.coefficients[kept], (self.error + left_out) * UP)

    def __call__(self, q: Array) -> Array:
        """Values at points (N, n), with rounding errors, (N,)."""
        return np.asarray((np.exp(1j * (q @ self.frequencies.T)) @ self.coefficients).real)


def _pair_frequencies(joint: int, n: int) -> NDArray[np.int64]:
    unit = np.eye(n, dtype=np.int64)[joint]
    return np.stack([unit, -unit])


def _merge_waves(frequencies: NDArray[np.int64], coefficients: NDArray[np.complex128], error: float) -> Waves:
    """Merge waves of equal frequency into one sum."""
    if frequencies.shape[1] > RULES.joints or np.abs(frequencies).max(initial=0) > RULES.highest:
        raise CertifyError("the task Jacobian has too many joints, or frequencies that are too high")
    keys = (frequencies + RULES.highest) @ (2 * RULES.highest + 1) ** np.arange(frequencies.shape[1], dtype=np.int64)
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    total = np.zeros(len(first), dtype=complex)
    np.add.at(total, place.ravel(), coefficients)
    rounding = sum_error(len(coefficients)) * float(np.abs(coefficients).sum())
    return Waves(frequencies[first], total, (error + rounding) * UP + TINY)


def expand_waves(tape: Tape, n: int) -> list[Waves]:
    """Expand an expression of q (n, 1) into waves, entry by entry, column-major.

    Raises:
        CertifyError: if it is not a sum of products of numbers and of sines and cosines of single joints.
    """

    def leaf(name: str, of: Any) -> Waves | int:
        return Waves.constant(float(of), n) if name == "const" else int(of)

    def step(name: str, of: Sequence[Waves | int]) -> Waves | int:
        # A leaf is a number or a joint; only sine and cosine accept a joint.
        if name in ("sin", "cos"):
            if isinstance(joint := of[0], Waves):
                raise CertifyError("the task uses a sine or cosine of more than a single joint position")
            return Waves.sine(joint, n) if name == "sin" else Waves.cosine(joint, n)
        if name not in _STEPS:
            raise CertifyError(f"the task uses the operation {name}, which cannot be expanded into waves")
        return _STEPS[name](*map(_require_waves, of))

    return [_require_waves(value) for value in evaluate_tape(tape, leaf, step)]


def _require_waves(value: Waves | int) -> Waves:
    if isinstance(value, Waves):
        return value
    raise CertifyError("the task uses the position of a joint other than by sine and cosine")


_STEPS: dict[str, Callable[..., Waves]] = {
    "assign": lambda a: a,
    "neg": lambda a: -a,
    "twice": lambda a: a + a,
    "sq": lambda a: a * a,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
}


def compute_cofactors(rows: Sequence[Sequence[Waves]]) -> list[Waves]:
    """Cofactors z of rows (m, m + 1), with det [rows; g] = sum_j g_j z_j for every g."""
    columns = range(len(rows) + 1)
    minors: dict[tuple[int, ...], Waves] = {(j,): rows[0][j].trim() for j in columns}
    for k, row in enumerate(rows[1:], 1):
        entries = [entry.trim() for entry in row]
        # Expand each minor along its last row.
        before, minors = minors, {}
        for chosen in combinations(columns, k + 1):
            parts = (
                _apply_sign(entries[j] * before[chosen[:place] + chosen[place + 1 :]], k + place)
                for place, j in enumerate(chosen)
            )
            minors[chosen] = reduce(Waves.__add__, parts).trim()
    return [_apply_sign(minors[tuple(i for i in columns if i != j)], len(rows) + j) for j in columns]


def _apply_sign(value: Waves, places: int) -> Waves:
    return -value if places % 2 else value
