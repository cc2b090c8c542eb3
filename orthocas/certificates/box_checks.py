"""Checks of boxes: det J by elimination of Taylor rows, and bounds of the conditioning by volumes.

J is taken to the singular vectors of its centre, so that it is nearly diagonal; then Gaussian elimination without
exchanges has pivots near the singular values. A box is proved if no pivot can vanish on it. The conditioning follows
from the volume that the gradients of the coordinates span across those of the task.

Source:
    ours, docs/explanation/certificates.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import mul
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from orthocas.certificates.rows import ChartRows
from orthocas.certificates.taylor import (
    TINY,
    UP,
    TaylorModel,
    Variables,
    list_monomials,
    reciprocal,
    reciprocal_square_root,
    stack,
    sum_error,
)
from orthocas.charts.certificate import ELIMINATION
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.checks import Array

_ORTHOGONAL = 1 - 1e-6  #: what singular vectors that are orthogonal up to 1e-9 change at most, for up to 20 rows
UNKNOWN, NEVER = -1, -2
_AT_ONCE = 64  #: boxes whose models fit into the cache of a processor


@dataclass(frozen=True, slots=True, eq=False)
class BoxResults:
    """What was found on each box."""

    proved: Array  #: (boxes,) bool
    regular: Array  #: (boxes,) bool: det J has the sign below on the whole box
    sign: Array  #: (boxes,) of det J at the centre of the box: +1, -1, or 0 where it is unclear
    conditioning: Array  #: (boxes,) lower bounds; 0 where none is known
    #: (boxes,) the joint to halve; `UNKNOWN` where bounds are infinite, so none is known to help most; `NEVER` where
    #: halves will not be proved
    widest: Array


class BoxCheck(Protocol):
    """A test of boxes. Checks can be pickled, so that processes and machines can share the work."""

    @property
    def joints(self) -> Variables:
        """The joints on which the result depends: halving others is of no use."""

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""


class RegularCheck(BoxCheck, Protocol):
    """A check whose proof of boxes is that det J has one sign there."""

    @property
    def method(self) -> str:
        """Name of the method in certificates."""


@dataclass(frozen=True, eq=False, repr=False)
class EliminationCheck:
    """Proves det J != 0, and, for a bound above 0, conditioning >= bound."""

    rows: ChartRows
    bound: float
    method = ELIMINATION

    @property
    def joints(self) -> Variables:
        """The joints that J depends on."""
        return self.rows.variables

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        # Products are small, and with one thread their rounding is the same everywhere. On some boxes, bounds are
        # infinite.
        parts = []
        with one_blas_thread(), np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            J = self.rows(low, high)
            for k in range(0, J.remainder.shape[-1], _AT_ONCE):
                few = select_boxes(J, slice(k, k + _AT_ONCE))
                turned, signs = rotate_to_singular_basis(few)
                regular = have_positive_pivots(compute_pivots(turned)) & (signs != 0)
                level = np.zeros(len(signs))
                if self.bound > 0 and regular.any():
                    level[regular] = bound_conditioning(select_boxes(few, regular), self.rows.m)
                parts.append((regular & (level >= self.bound), regular, signs, level, compute_influences(turned)))
        proved, regular, signs, conditioning, influences = (np.concatenate(each) for each in zip(*parts, strict=True))
        return BoxResults(proved, regular, signs, conditioning, find_most_influential(influences, J.variables))


def rotate_to_singular_basis(J: TaylorModel) -> tuple[TaylorModel, Array]:
    """U^T J V for the singular vectors of the centre of J (n, n, boxes), and the sign of det U det V, (boxes,).

    U and V are taken as they are in floating-point numbers. They are checked to be orthogonal up to 1e-9, so they are
    nonsingular, and the sign of their determinants is that of the computed ones.
    """
    # Vectors that are not orthogonal, or not finite, have no sign.
    Ut, V = find_singular_vectors(J)
    signs = np.nan_to_num(np.sign(np.linalg.det(Ut) * np.linalg.det(V))) * (is_orthogonal(Ut) & is_orthogonal(V))
    return multiply_between(Ut, J, V), signs


def find_singular_vectors(J: TaylorModel) -> tuple[Array, Array]:
    """U^T and V of the centre of J (m, n, boxes), as (boxes, m, m) and (boxes, n, n); NaN where it is not finite."""
    centres = np.moveaxis(J.centre, -1, 0)
    finite = np.asarray(np.isfinite(centres).all(axis=(1, 2)))[:, None, None]
    U, _, Vt = np.linalg.svd(np.where(finite, centres, 0.0))
    return np.where(finite, U.transpose(0, 2, 1), np.nan), Vt.transpose(0, 2, 1)


def is_orthogonal(matrices: Array) -> NDArray[np.bool_]:
    """Whether matrices (boxes, n, n) are orthogonal up to 1e-9 in their products."""
    difference = matrices.transpose(0, 2, 1) @ matrices - np.eye(matrices.shape[1])
    return np.asarray(np.abs(difference).max(axis=(1, 2)) < 1e-9)


def multiply_between(left: Array, J: TaylorModel, right: Array) -> TaylorModel:
    """left J right for matrices left (boxes, m, m) and right (boxes, n, n)."""
    # One product for all coefficients of a box, from each side.
    N, m, n, boxes = J.coefficients.shape
    inner = np.ascontiguousarray(J.coefficients.transpose(3, 1, 0, 2)).reshape(boxes, m * N, n) @ right
    outer = (left @ inner.reshape(boxes, m, N * n)).reshape(boxes, m, N, n)
    # Remainders and rounding pass through the absolute values.
    unknown = J.remainder + sum_error(m + n) * np.abs(J.coefficients).sum(axis=0)
    spread = np.abs(left) @ np.moveaxis(unknown, -1, 0) @ np.abs(right)
    coefficients = np.ascontiguousarray(outer.transpose(2, 1, 3, 0))
    return TaylorModel(J.variables, coefficients, np.moveaxis(spread, 0, -1) * UP + TINY)


def compute_pivots(J: TaylorModel) -> list[TaylorModel]:
    """The pivots of Gaussian elimination without exchanges, models (boxes,). Their product is det J."""
    # The Schur complement of each pivot takes the place of the matrix.
    diagonal = [J[0, 0]]
    while len(J.remainder) > 1:
        ratios = J[1:, 0] * reciprocal(diagonal[-1][None])
        J = J[1:, 1:] - ratios[:, None] * J[0, 1:][None]
        diagonal.append(J[0, 0])
    return diagonal


def bound_from_below(model: TaylorModel) -> Array:
    """A number below all values, (boxes,); NaN or -inf where nothing is known.

    Each variable is bounded exactly in its linear and square term, g t + h t^2 for t in [-1, 1]; mixed terms and cubic
    ones by their absolute values. The few sums of the coefficients have at most 4 roundings for each of them.
    """
    index = {monomial: k for k, monomial in enumerate(list_monomials(model.variables))}
    squares = [index[v, v] for v in model.variables]
    linear = np.abs(model.coefficients[1 : 1 + len(squares)])
    square = model.coefficients[squares]
    # Inside, the vertex of the parabola lies in the interval.
    inside = (square > 0) & (linear < 2 * square)
    least = np.where(inside, -(linear**2) / (4 * np.where(inside, square, 1)), square - linear)
    least = np.minimum(least, 0)
    rest = np.abs(model.coefficients[1 + len(squares) :]).sum(axis=0) - np.abs(square).sum(axis=0)
    rounding = sum_error(4 * len(model.coefficients)) * np.abs(model.coefficients).sum(axis=0)
    return np.asarray(model.centre + least.sum(axis=0) - rest - model.remainder * UP - rounding)


def bound_conditioning(J: TaylorModel, m: int) -> Array:
    """A number below the conditioning on each box, (boxes,); 0 where nothing is known. J has its m task rows first."""
    n = len(J.remainder)
    if m == n:
        return np.ones(J.remainder.shape[-1])
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        volume = bound_from_below(_build_volume(J, m)) * _ORTHOGONAL
    volume = np.clip(np.nan_to_num(volume, nan=0.0), 0.0, 1.0)
    # The smallest of n singular values with that product, whose squares add up to n: each bound improves the next one.
    least = np.zeros_like(volume)
    for _ in range(4):
        least = volume * ((n - 1) / (n - least * least)) ** ((n - 1) / 2) / UP
    return least


def _build_volume(J: TaylorModel, m: int) -> TaylorModel:
    """The volume of the gradients of the coordinates across those of the task, (boxes,)."""
    # In the singular vectors of the task rows, these are nearly diagonal.
    left, right = find_singular_vectors(J[:m])
    unit = np.broadcast_to(np.eye(1), (len(right), 1, 1))
    task = multiply_between(left, J[:m], right)
    gradients = stack([multiply_between(unit, J[j : j + 1], right)[0] for j in range(m, len(J.remainder))])
    # Gradients of length 1.
    squares = gradients * gradients
    squared_lengths = _sum_models([squares[:, k] for k in range(squares.remainder.shape[1])])
    gradients = gradients * reciprocal_square_root(squared_lengths)[:, None]
    # Their parts across the task, in the basis [X; I] of its kernel, whose growth is det(I + X X^T)^(1/2).
    kernel = _solve_kernel(task, m)
    across = gradients[:, m:] + _sum_models([gradients[:, k, None] * kernel[None, k] for k in range(m)])
    turned, _ = rotate_to_singular_basis(across)
    products = kernel[:, None] * kernel[None]
    gram = _sum_models([products[:, :, k] for k in range(products.remainder.shape[2])])
    growth = compute_pivots(gram + TaylorModel.constant(np.eye(m)[:, :, None]))
    return reduce(mul, [*compute_pivots(turned), *map(reciprocal_square_root, growth)])


def _solve_kernel(task: TaylorModel, m: int) -> TaylorModel:
    """X with [T_1, T_2] [X; I] = 0 for task rows [T_1, T_2], by elimination, (m, r, boxes)."""
    # Elimination keeps each pivot row and the inverse of its pivot, and substitution begins with the last one.
    rows, inverses = [], []
    for _ in range(m):
        inverses.append(reciprocal(task[0, 0]))
        rows.append(task[0, 1:])
        if len(task.remainder) > 1:
            task = task[1:, 1:] - (task[1:, 0] * inverses[-1][None])[:, None] * task[0, 1:][None]
    solution: list[TaylorModel] = []
    for row, inverse in zip(rows[::-1], inverses[::-1], strict=True):
        count = len(solution)
        total = _sum_models([row[count:], *(row[k, None] * solution[k] for k in range(count))])
        solution.insert(0, -(total * inverse[None]))
    return stack(solution)


def _sum_models(parts: list[TaylorModel]) -> TaylorModel:
    return reduce(lambda a, b: a + b, parts)


def have_positive_pivots(pivots: list[TaylorModel]) -> NDArray[np.bool_]:
    """Whether all pivots have one sign on the box and the pivots of the centre are positive."""
    return np.asarray(np.all([bound_from_below(pivot) > 0 for pivot in pivots], axis=0))


def compute_influences(turned: TaylorModel) -> Array:
    """How much halving each variable narrows the matrix, relative to its singular values, (boxes, variables)."""
    # The diagonal holds the singular values of the centre.
    diagonal = np.sqrt(np.abs(np.stack([turned.centre[k, k] for k in range(len(turned.remainder))])) + 1e-300)
    return np.asarray((turned.compute_gains() / (diagonal[:, None] * diagonal[None])).sum(axis=(1, 2)).T)


def find_most_influential(influences: Array, joints: Variables) -> Array:
    """The joint of the largest influence on each box, (boxes,); `UNKNOWN` where they are not finite."""
    finite = np.isfinite(influences).all(axis=1)
    return np.where(finite, np.array(joints)[np.argmax(np.nan_to_num(influences), axis=1)], UNKNOWN)


def check_in_turn(check: Callable[[Array, Array], tuple[Any, ...]], low: Array, high: Array, at_once: int) -> Any:
    """What a check returns for boxes between corners (boxes, n), for a few at once, whose terms fit into the cache."""
    pieces = [slice(k, k + at_once) for k in range(0, len(low), at_once)]
    # With one thread, rounding is the same everywhere; on some boxes, bounds are infinite.
    with one_blas_thread(), np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        parts = [check(low[piece], high[piece]) for piece in pieces]
    return [np.concatenate(each) for each in zip(*parts, strict=True)]


def select_boxes(J: TaylorModel, boxes: slice | NDArray[np.bool_]) -> TaylorModel:
    """The models of some of the boxes."""
    return TaylorModel(J.variables, J.coefficients[..., boxes], J.remainder[..., boxes])
