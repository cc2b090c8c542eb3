"""Checks of boxes: bounds of det J by elimination in Taylor arithmetic, and bounds of the conditioning by volumes.

J is multiplied by the singular vectors of its centre, so that it is nearly diagonal. Gaussian elimination without
exchanges then has pivots near the singular values. A box is proved if no pivot can be zero on it. The conditioning
follows from the volume that the gradients of the coordinates span across those of the task.

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

_ORTHOGONAL = 1 - 1e-6  #: factor on volumes for singular vectors orthogonal up to 1e-9, with up to 20 rows
UNKNOWN, NEVER = -1, -2
_AT_ONCE = 64  #: number of boxes whose models fit into the cache of a processor


@dataclass(frozen=True, slots=True, eq=False)
class BoxResults:
    """Results of a check, for each box."""

    proved: Array  #: (boxes,) bool
    regular: Array  #: (boxes,) bool: det J has the sign below on the whole box
    sign: Array  #: (boxes,) sign of det J at the centre of the box: +1, -1, or 0 if it is unclear
    conditioning: Array  #: (boxes,) lower bounds; 0 where no bound is known
    #: (boxes,) the joint to halve; `UNKNOWN` where bounds are infinite, so that the best joint is not known; `NEVER`
    #: where halving cannot lead to a proof
    widest: Array


class BoxCheck(Protocol):
    """A test of boxes. Checks can be pickled, so that processes and machines share the work."""

    @property
    def joints(self) -> Variables:
        """The joints on which the result depends. Halving other joints is useless."""

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""


class RegularCheck(BoxCheck, Protocol):
    """A check that proves a box by showing that det J has one sign on it."""

    @property
    def method(self) -> str:
        """Name of the method in certificates."""


@dataclass(frozen=True, eq=False, repr=False)
class EliminationCheck:
    """Proves det J != 0 and, if a bound above 0 is given, conditioning >= bound."""

    rows: ChartRows
    bound: float
    method = ELIMINATION

    @property
    def joints(self) -> Variables:
        """The joints that J depends on."""
        return self.rows.variables

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        # The products are small. With one thread, their rounding is the same on all machines. Bounds may be infinite on
        # some boxes.
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

    U and V are the computed floating-point matrices. They are checked to be orthogonal up to 1e-9, so they are
    nonsingular, and the computed sign of their determinants is right.
    """
    # The sign is 0 for vectors that are not orthogonal or not finite.
    Ut, V = find_singular_vectors(J)
    signs = np.nan_to_num(np.sign(np.linalg.det(Ut) * np.linalg.det(V))) * (is_orthogonal(Ut) & is_orthogonal(V))
    return multiply_between(Ut, J, V), signs


def find_singular_vectors(J: TaylorModel) -> tuple[Array, Array]:
    """U^T (boxes, m, m) and V (boxes, n, n) of the centre of J (m, n, boxes); NaN where the centre is not finite."""
    centres = np.moveaxis(J.centre, -1, 0)
    finite = np.asarray(np.isfinite(centres).all(axis=(1, 2)))[:, None, None]
    U, _, Vt = np.linalg.svd(np.where(finite, centres, 0.0))
    return np.where(finite, U.transpose(0, 2, 1), np.nan), Vt.transpose(0, 2, 1)


def is_orthogonal(matrices: Array) -> NDArray[np.bool_]:
    """Whether the products M^T M of matrices M (boxes, n, n) are the identity up to 1e-9."""
    difference = matrices.transpose(0, 2, 1) @ matrices - np.eye(matrices.shape[1])
    return np.asarray(np.abs(difference).max(axis=(1, 2)) < 1e-9)


def multiply_between(left: Array, J: TaylorModel, right: Array) -> TaylorModel:
    """left J right for matrices left (boxes, m, m) and right (boxes, n, n)."""
    # One product per side for all coefficients of a box.
    N, m, n, boxes = J.coefficients.shape
    inner = np.ascontiguousarray(J.coefficients.transpose(3, 1, 0, 2)).reshape(boxes, m * N, n) @ right
    outer = (left @ inner.reshape(boxes, m, N * n)).reshape(boxes, m, N, n)
    # Remainders and rounding errors are multiplied by absolute values.
    unknown = J.remainder + sum_error(m + n) * np.abs(J.coefficients).sum(axis=0)
    spread = np.abs(left) @ np.moveaxis(unknown, -1, 0) @ np.abs(right)
    coefficients = np.ascontiguousarray(outer.transpose(2, 1, 3, 0))
    return TaylorModel(J.variables, coefficients, np.moveaxis(spread, 0, -1) * UP + TINY)


def compute_pivots(J: TaylorModel) -> list[TaylorModel]:
    """The pivots of Gaussian elimination without exchanges, models (boxes,). Their product is det J."""
    # Replace the matrix by the Schur complement of each pivot.
    diagonal = [J[0, 0]]
    while len(J.remainder) > 1:
        ratios = J[1:, 0] * reciprocal(diagonal[-1][None])
        J = J[1:, 1:] - ratios[:, None] * J[0, 1:][None]
        diagonal.append(J[0, 0])
    return diagonal


def bound_from_below(model: TaylorModel) -> Array:
    """A lower bound of all values, (boxes,); NaN or -inf where no bound is known.

    The linear and square terms of each variable, g t + h t^2 for t in [-1, 1], are bounded exactly; mixed and cubic
    terms are bounded by their absolute values. Each coefficient takes part in at most 4 roundings.
    """
    index = {monomial: k for k, monomial in enumerate(list_monomials(model.variables))}
    squares = [index[v, v] for v in model.variables]
    linear = np.abs(model.coefficients[1 : 1 + len(squares)])
    square = model.coefficients[squares]
    # True if the vertex of the parabola lies in the interval.
    inside = (square > 0) & (linear < 2 * square)
    least = np.where(inside, -(linear**2) / (4 * np.where(inside, square, 1)), square - linear)
    least = np.minimum(least, 0)
    rest = np.abs(model.coefficients[1 + len(squares) :]).sum(axis=0) - np.abs(square).sum(axis=0)
    rounding = sum_error(4 * len(model.coefficients)) * np.abs(model.coefficients).sum(axis=0)
    return np.asarray(model.centre + least.sum(axis=0) - rest - model.remainder * UP - rounding)


def bound_conditioning(J: TaylorModel, m: int) -> Array:
    """A lower bound of the conditioning on each box, (boxes,); 0 if none is known. The m task rows come first."""
    n = len(J.remainder)
    if m == n:
        return np.ones(J.remainder.shape[-1])
    # The volume that the gradients of the coordinates span across those of the task.
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        # In the singular basis of the task rows, these rows are nearly diagonal.
        left, right = find_singular_vectors(J[:m])
        unit = np.broadcast_to(np.eye(1), (len(right), 1, 1))
        task = multiply_between(left, J[:m], right)
        gradients = stack([multiply_between(unit, J[j : j + 1], right)[0] for j in range(m, n)])
        # Normalise the gradients to length 1.
        squares = gradients * gradients
        squared_lengths = _sum_models([squares[:, k] for k in range(squares.remainder.shape[1])])
        gradients = gradients * reciprocal_square_root(squared_lengths)[:, None]
        # Project them on the kernel [X; I] of the task, whose basis has the volume det(I + X X^T)^(1/2).
        kernel = _solve_kernel(task, m)
        across = gradients[:, m:] + _sum_models([gradients[:, k, None] * kernel[None, k] for k in range(m)])
        turned, _ = rotate_to_singular_basis(across)
        products = kernel[:, None] * kernel[None]
        gram = _sum_models([products[:, :, k] for k in range(products.remainder.shape[2])])
        growth = compute_pivots(gram + TaylorModel.constant(np.eye(m)[:, :, None]))
        factors = [*compute_pivots(turned), *map(reciprocal_square_root, growth)]
        volume = bound_from_below(reduce(mul, factors)) * _ORTHOGONAL
    volume = np.clip(np.nan_to_num(volume, nan=0.0), 0.0, 1.0)
    # Least of n singular values with this product, whose squares sum to n. Each iteration improves the bound.
    least = np.zeros_like(volume)
    for _ in range(4):
        least = volume * ((n - 1) / (n - least * least)) ** ((n - 1) / 2) / UP
    return least


def _solve_kernel(task: TaylorModel, m: int) -> TaylorModel:
    """X (m, r, boxes) with [T_1, T_2] [X; I] = 0 for task rows [T_1, T_2], by elimination."""
    # Elimination keeps each pivot row and the inverse of its pivot. Back substitution starts at the last row.
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
    """Whether no pivot vanishes on the box, and all pivots at the centre are positive."""
    return np.asarray(np.all([bound_from_below(pivot) > 0 for pivot in pivots], axis=0))


def compute_influences(turned: TaylorModel) -> Array:
    """How much halving each variable narrows the matrix, relative to its singular values, (boxes, variables)."""
    # The diagonal approximates the singular values of the centre.
    diagonal = np.sqrt(np.abs(np.stack([turned.centre[k, k] for k in range(len(turned.remainder))])) + 1e-300)
    return np.asarray((turned.compute_gains() / (diagonal[:, None] * diagonal[None])).sum(axis=(1, 2)).T)


def find_most_influential(influences: Array, joints: Variables) -> Array:
    """The joint with the largest influence on each box, (boxes,); `UNKNOWN` where influences are not finite."""
    finite = np.isfinite(influences).all(axis=1)
    return np.where(finite, np.array(joints)[np.argmax(np.nan_to_num(influences), axis=1)], UNKNOWN)


def check_in_turn(check: Callable[[Array, Array], tuple[Any, ...]], low: Array, high: Array, at_once: int) -> Any:
    """Apply a check to boxes between corners (boxes, n), a few at a time, so that their terms fit into the cache."""
    pieces = [slice(k, k + at_once) for k in range(0, len(low), at_once)]
    # With one thread, rounding is the same on all machines. Bounds may be infinite on some boxes.
    with one_blas_thread(), np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        parts = [check(low[piece], high[piece]) for piece in pieces]
    return [np.concatenate(each) for each in zip(*parts, strict=True)]


def select_boxes(J: TaylorModel, boxes: slice | NDArray[np.bool_]) -> TaylorModel:
    """The models of some of the boxes."""
    return TaylorModel(J.variables, J.coefficients[..., boxes], J.remainder[..., boxes])
