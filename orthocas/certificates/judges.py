"""Judges of boxes: det J by elimination of Taylor rows, and bounds of its volume."""

from dataclasses import dataclass
from functools import reduce
from operator import mul
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthocas.certificates.chart_rows import ChartRows
from orthocas.certificates.taylor import (
    TINY,
    UP,
    TaylorModel,
    Variables,
    monomials,
    reciprocal,
    reciprocal_square_root,
    stacked,
    sum_error,
)
from orthocas.charts.certificate import ELIMINATION
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.checks import Array

_ORTHOGONAL = 1 - 1e-6  # what singular vectors that are orthogonal up to 1e-9 change at most, for up to 20 rows
UNKNOWN, NEVER = -1, -2
_AT_ONCE = 64  # boxes whose models fit into the cache of a processor


def in_singular_basis(J: TaylorModel) -> tuple[TaylorModel, Array]:
    """U^T J V for the singular vectors of the centre of J (n, n, boxes), and the sign of det U det V, (boxes,).

    U and V are taken as they are in floating-point numbers. They are checked to be orthogonal up to 1e-9, so they are
    nonsingular, and the sign of their determinants is that of the computed ones.
    """
    Ut, V = singular_vectors(J)
    signs = np.nan_to_num(np.sign(np.linalg.det(Ut) * np.linalg.det(V))) * (is_orthogonal(Ut) & is_orthogonal(V))
    return between(Ut, J, V), signs


def singular_vectors(J: TaylorModel) -> tuple[Array, Array]:
    """U^T and V of the centre of J (m, n, boxes), as (boxes, m, m) and (boxes, n, n); NaN where it is not finite."""
    centres = np.moveaxis(J.centre, -1, 0)
    finite = np.asarray(np.isfinite(centres).all(axis=(1, 2)))[:, None, None]
    U, _, Vt = np.linalg.svd(np.where(finite, centres, 0.0))
    return np.where(finite, U.transpose(0, 2, 1), np.nan), Vt.transpose(0, 2, 1)


def is_orthogonal(matrices: Array) -> NDArray[np.bool_]:
    """Whether matrices (boxes, n, n) are orthogonal up to 1e-9 in their products."""
    difference = matrices.transpose(0, 2, 1) @ matrices - np.eye(matrices.shape[1])
    return np.asarray(np.abs(difference).max(axis=(1, 2)) < 1e-9)


def between(left: Array, J: TaylorModel, right: Array) -> TaylorModel:
    """left J right for matrices left (boxes, m, m) and right (boxes, n, n)."""
    N, m, n, boxes = J.coefficients.shape
    inner = np.ascontiguousarray(J.coefficients.transpose(3, 1, 0, 2)).reshape(boxes, m * N, n) @ right
    outer = (left @ inner.reshape(boxes, m, N * n)).reshape(boxes, m, N, n)
    unknown = J.remainder + sum_error(m + n) * np.abs(J.coefficients).sum(axis=0)
    spread = np.abs(left) @ np.moveaxis(unknown, -1, 0) @ np.abs(right)
    coefficients = np.ascontiguousarray(outer.transpose(2, 1, 3, 0))
    return TaylorModel(J.variables, coefficients, np.moveaxis(spread, 0, -1) * UP + TINY)


def pivots(J: TaylorModel) -> list[TaylorModel]:
    """The pivots of Gaussian elimination without exchanges, models (boxes,). Their product is det J."""
    found = [J[0, 0]]
    while len(J.remainder) > 1:
        ratios = J[1:, 0] * reciprocal(found[-1][None])
        J = J[1:, 1:] - ratios[:, None] * J[0, 1:][None]
        found.append(J[0, 0])
    return found


def lower_bound(model: TaylorModel) -> Array:
    """A number below all values, (boxes,); NaN or -inf where nothing is known.

    Each variable is bounded exactly in its linear and square term, g t + h t^2 for t in [-1, 1]; mixed terms and cubic
    ones by their absolute values. The few sums of the coefficients have at most 4 roundings for each of them.
    """
    squares = _square_places(model.variables)
    linear = np.abs(model.coefficients[1 : 1 + len(squares)])
    square = model.coefficients[squares]
    inside = (square > 0) & (linear < 2 * square)  # the vertex of the parabola lies in the interval
    least = np.where(inside, -(linear**2) / (4 * np.where(inside, square, 1)), square - linear)
    least = np.minimum(least, 0)
    rest = np.abs(model.coefficients[1 + len(squares) :]).sum(axis=0) - np.abs(square).sum(axis=0)
    rounding = sum_error(4 * len(model.coefficients)) * np.abs(model.coefficients).sum(axis=0)
    bound: Array = model.centre + least.sum(axis=0) - rest - model.remainder * UP - rounding
    return bound


def _square_places(variables: Variables) -> list[int]:
    index = {monomial: k for k, monomial in enumerate(monomials(variables))}
    return [index[v, v] for v in variables]


def conditioning_bound(J: TaylorModel, m: int) -> Array:
    """A number below the conditioning on each box, (boxes,); 0 where nothing is known. J has its m task rows first."""
    n = len(J.remainder)
    if m == n:
        return np.ones(J.remainder.shape[-1])
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        least = lower_bound(_volume(J, m)) * _ORTHOGONAL
    return _smallest_singular_value(np.clip(np.nan_to_num(least, nan=0.0), 0.0, 1.0), n)


def _volume(J: TaylorModel, m: int) -> TaylorModel:
    """D, (boxes,)."""
    left, right = singular_vectors(J[:m])
    unit = np.broadcast_to(np.eye(1), (len(right), 1, 1))
    task = between(left, J[:m], right)
    gradients = _normalised(stacked([between(unit, J[j : j + 1], right)[0] for j in range(m, len(J.remainder))]))
    kernel = _kernel(task, m)
    across = gradients[:, m:] + _sums([gradients[:, k, None] * kernel[None, k] for k in range(m)])
    turned, _ = in_singular_basis(across)
    return reduce(mul, [*pivots(turned), *map(reciprocal_square_root, _growth(kernel, m))])


def _kernel(task: TaylorModel, m: int) -> TaylorModel:
    """X with [T_1, T_2] [X; I] = 0 for task rows [T_1, T_2], by elimination, (m, r, boxes)."""
    rows, inverses = [], []
    for _ in range(m):
        inverses.append(reciprocal(task[0, 0]))
        rows.append(task[0, 1:])
        if len(task.remainder) > 1:
            task = task[1:, 1:] - (task[1:, 0] * inverses[-1][None])[:, None] * task[0, 1:][None]
    solution: list[TaylorModel] = []
    for row, inverse in zip(rows[::-1], inverses[::-1], strict=True):
        known = len(solution)
        total = _sums([row[known:], *(row[k, None] * solution[k] for k in range(known))])
        solution.insert(0, -(total * inverse[None]))
    return stacked(solution)


def _growth(kernel: TaylorModel, m: int) -> list[TaylorModel]:
    """The pivots of I + X X^T."""
    products = kernel[:, None] * kernel[None]
    gram = _sums([products[:, :, k] for k in range(products.remainder.shape[2])])
    return pivots(gram + TaylorModel.constant(np.eye(m)[:, :, None]))


def _normalised(rows: TaylorModel) -> TaylorModel:
    """The rows divided by their lengths."""
    squares = rows * rows
    squared_lengths = _sums([squares[:, k] for k in range(squares.remainder.shape[1])])
    return rows * reciprocal_square_root(squared_lengths)[:, None]


def _sums(parts: list[TaylorModel]) -> TaylorModel:
    return reduce(lambda a, b: a + b, parts)


def _smallest_singular_value(volume: Array, n: int) -> Array:
    """A number below the smallest of n singular values with that product, whose squares add up to n."""
    least = np.zeros_like(volume)
    for _ in range(4):  # each bound improves the next one
        least = volume * ((n - 1) / (n - least * least)) ** ((n - 1) / 2) / UP
    return least


@dataclass(frozen=True, slots=True, eq=False)
class Verdicts:
    """What was found on each box."""

    proved: Array  #: (boxes,) bool
    regular: Array  #: (boxes,) bool: det J has the sign below on the whole box
    sign: Array  #: (boxes,) of det J at the middle of the box: +1, -1, or 0 where it is unclear
    conditioning: Array  #: (boxes,) lower bounds; 0 where none is known
    #: (boxes,) the joint to halve; `UNKNOWN` where bounds are infinite, so none is known to help most; `NEVER` where
    #: halves will not be proved
    widest: Array


class Judge(Protocol):
    """A test of boxes. Judges can be pickled, so that processes and machines can share the work."""

    @property
    def joints(self) -> Variables:
        """The joints on which the verdict depends: halving others is of no use."""
        ...

    def __call__(self, low: Array, high: Array) -> Verdicts:
        """Judge boxes between corners (boxes, n)."""
        ...


class RegularJudge(Judge, Protocol):
    """A judge whose proof of boxes is that det J has one sign there."""

    @property
    def method(self) -> str:
        """Name of the method in certificates."""
        ...


@dataclass(frozen=True, eq=False)
class RegularityJudge:
    """Proves det J != 0, and, for a bound above 0, conditioning >= bound."""

    rows: ChartRows
    bound: float
    method = ELIMINATION

    @property
    def joints(self) -> Variables:
        """The joints that J depends on."""
        return self.rows.variables

    def __call__(self, low: Array, high: Array) -> Verdicts:
        """Judge boxes between corners (boxes, n)."""
        with one_blas_thread():  # small products, and the same rounding everywhere
            J = self.rows(low, high)
            return _joined([self._few(part) for part in _parts(J)], J.variables)

    def _few(self, J: TaylorModel) -> tuple[Array, ...]:
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # boxes where bounds are infinite
            turned, signs = in_singular_basis(J)
            regular = all_positive(pivots(turned)) & (signs != 0)
        conditioning = np.zeros(len(signs))
        if self.bound > 0 and regular.any():
            conditioning[regular] = conditioning_bound(chosen(J, regular), self.rows.m)
        proved = regular & (conditioning >= self.bound)
        return proved, regular, signs, conditioning, influences(turned)


def all_positive(found: list[TaylorModel]) -> NDArray[np.bool_]:
    """Whether all pivots have one sign on the box and the pivots of the middle are positive."""
    return np.asarray(np.all([lower_bound(pivot) > 0 for pivot in found], axis=0))


def influences(turned: TaylorModel) -> Array:
    """How much halving each variable narrows the matrix, relative to its singular values, (boxes, variables)."""
    middle = np.sqrt(np.abs(np.stack([turned.centre[k, k] for k in range(len(turned.remainder))])) + 1e-300)
    influences: Array = (turned.gains() / (middle[:, None] * middle[None])).sum(axis=(1, 2)).T
    return influences


def most_influential(influences: Array, joints: Variables) -> Array:
    """The joint of the largest influence on each box, (boxes,); `UNKNOWN` where they are not finite."""
    known = np.isfinite(influences).all(axis=1)
    return np.where(known, np.array(joints)[np.argmax(np.nan_to_num(influences), axis=1)], UNKNOWN)


def _parts(J: TaylorModel) -> list[TaylorModel]:
    return [chosen(J, slice(k, k + _AT_ONCE)) for k in range(0, J.remainder.shape[-1], _AT_ONCE)]


def chosen(J: TaylorModel, boxes: slice | NDArray[np.bool_]) -> TaylorModel:
    """The models of some of the boxes."""
    return TaylorModel(J.variables, J.coefficients[..., boxes], J.remainder[..., boxes])


def _joined(parts: list[tuple[Array, ...]], variables: Variables) -> Verdicts:
    proved, regular, sign, conditioning, influences = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Verdicts(proved, regular, sign, conditioning, most_influential(influences, variables))
