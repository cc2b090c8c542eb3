"""Matrices of Taylor models: a change of basis, elimination, and lower bounds of ranges (ours).

A matrix J(q) is nonsingular on a box if elimination finds no pivot that can vanish there. Before that, J is taken to
the singular vectors of its centre: pivots come in order of their size, and the smallest, which is what a chart loses
first, comes last, when nothing is divided by it any more.
"""

import numpy as np
from numpy.typing import NDArray

from orthocas.certifying.functions import reciprocal
from orthocas.certifying.monomials import Variables, monomials
from orthocas.certifying.rounding import TINY, UP, sum_error
from orthocas.certifying.taylor import TaylorModel
from orthocas.checks import Array


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
