"""Small matrices as CasADi expressions: columns of samples evaluate them side by side (ours).

LAPACK, called for one small matrix after the other, takes ten times as long. None of these expressions branches.
"""

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array

_ROUNDING = 1e-15  # of eigenvalues of matrices whose entries are at most 1


def whitened(gram: ca.SX, columns: ca.SX, least: float) -> ca.SX:
    """L^-1 c for columns c (m, r), where L L^T is the Gram matrix (m, m) with pivots of at least `least`."""
    m = gram.size1()
    L, found = ca.SX.zeros(m, m), ca.SX(columns)
    for j in range(m):
        pivot = ca.sqrt(ca.fmax(gram[j, j] - ca.sumsqr(L[j, :j]), least))
        for i in range(j + 1, m):
            L[i, j] = (gram[i, j] - ca.dot(L[i, :j], L[j, :j])) / pivot
        found[j, :] = (found[j, :] - L[j, :j] @ found[:j, :]) / pivot
    return found


def determinant_sign(matrix: ca.SX) -> ca.SX:
    """Sign of the determinant of a square matrix, by reflections of its rows; 0 if a pivot is exactly 0."""
    A, n = ca.SX(matrix), matrix.size1()
    sign = ca.SX(1)
    for k in range(n - 1):
        v, _, half = _reflection(A[k, k:].T)
        sign *= ca.if_else(A[k, k] >= 0, 1.0, -1.0) * (half > 0)  # of the pivot, and of the reflection
        shares = A[k + 1 :, k:] @ v / _or_one(half)
        A[k + 1 :, k + 1 :] -= shares @ v[1:].T
    return sign * ca.sign(A[n - 1, n - 1])


def tridiagonal(matrix: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Diagonal (n, 1) and squares of the entries beside it (n - 1, 1) of a similar tridiagonal matrix."""
    A, n = ca.SX(matrix), matrix.size1()
    squares = []
    for k in range(n - 2):
        v, norm, half = _reflection(A[k + 1 :, k])
        squares.append(norm * norm)
        w = A[k + 1 :, k + 1 :] @ v / _or_one(half)
        w -= v * (ca.dot(w, v) / (2 * _or_one(half)))
        update = v @ w.T
        A[k + 1 :, k + 1 :] = ca.tril2symm(ca.tril(A[k + 1 :, k + 1 :] - update - update.T))
    if n > 1:
        squares.append(A[n - 1, n - 2] ** 2)
    return ca.diag(A), ca.vertcat(*squares)


def _reflection(column: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Direction v that reflects the column to the first axis, the column's norm, and half the squared norm of v."""
    norm = ca.norm_2(column)
    half = norm * (norm + ca.fabs(column[0]))
    return ca.vertcat(column[0] + ca.if_else(column[0] >= 0, norm, -norm), column[1:]), norm, half


def _or_one(x: ca.SX) -> ca.SX:
    """The number x > 0, or 1."""
    return ca.if_else(x > 0, x, 1.0)


def laguerre(diagonal: ca.SX, squares: ca.SX, at: ca.SX, steps: int) -> tuple[ca.SX, ca.SX]:
    """Steps towards the smallest eigenvalue of a tridiagonal matrix, from below: where they end, and the last step.

    Steps from below never pass the eigenvalue, but by rounding. No step follows then.
    """
    step = ca.SX(0)
    for _ in range(steps):
        found, before = _laguerre_step(diagonal, squares, at)
        step = ca.if_else(before, found, 0.0)
        at = at + step
    return at, step


def unfinished(last_steps: Array) -> NDArray[np.bool_]:
    """Where the last step of `laguerre` was more than rounding."""
    return np.asarray(last_steps > _ROUNDING)


def _laguerre_step(diagonal: ca.SX, squares: ca.SX, at: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Laguerre's step towards the smallest eigenvalue, and whether it is ahead.

    The characteristic polynomial is the product of the pivots q_i of T - at I, so the sums of 1 / (lambda_i - at) and
    of its square follow from q_i and two derivatives.
    """
    n = diagonal.size1()
    q, slope, bend = diagonal[0] - at, ca.SX(-1), ca.SX(0)
    inverse, least = 1 / q, q
    first, second = inverse, inverse * inverse
    for i in range(1, n):
        ratio, share = squares[i - 1] * inverse, slope * inverse
        bend = ratio * (bend * inverse - 2 * share * share)
        q, slope = diagonal[i] - at - ratio, ratio * share - 1
        inverse, least = 1 / q, ca.fmin(least, q)
        share = slope * inverse
        first -= share
        second += share * share - bend * inverse
    step = n / (first + ca.sqrt(ca.fmax((n - 1) * (n * second - first * first), 0.0)))
    return step, least > 0
