"""Small matrices of many samples, entry by entry: arrays (rows, columns, N) of contiguous samples (ours).

Every operation acts on all samples side by side. LAPACK, called for one small matrix after the other, takes ten times
as long.
"""

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array

_ROUNDING = 1e-15  # of eigenvalues of matrices whose entries are at most 1
_MOST_STEPS = 100  # a smallest eigenvalue that occurs twice takes 25


def by_entry(stack: Array) -> Array:
    """Matrices (N, rows, columns) as an array (rows, columns, N)."""
    return np.ascontiguousarray(np.moveaxis(stack, 0, -1))


def by_sample(entries: Array) -> Array:
    """Entries (..., N) as an array (N, ...)."""
    return np.ascontiguousarray(np.moveaxis(entries, -1, 0))


def products(a: Array, b: Array) -> Array:
    """Products of the rows of a (k, n, N) with those of b (l, n, N), (k, l, N)."""
    result: Array = a[:, None, 0] * b[None, :, 0]
    for i in range(1, a.shape[1]):
        result += a[:, None, i] * b[None, :, i]
    return result


def whitened(gram: Array, columns: Array, least: float) -> Array:
    """L^-1 c for columns c (m, r, N), where L L^T is the Gram matrix (m, m, N) with pivots of at least `least`."""
    m = len(gram)
    L, found = np.zeros_like(gram), columns.copy()
    for j in range(m):
        pivot = np.sqrt(np.maximum(gram[j, j] - (L[j, :j] ** 2).sum(axis=0), least))
        for i in range(j + 1, m):
            L[i, j] = (gram[i, j] - (L[i, :j] * L[j, :j]).sum(axis=0)) / pivot
        found[j] = (found[j] - (L[j, :j, None] * found[:j]).sum(axis=0)) / pivot
    return found


def smallest_eigenvalues(matrices: Array) -> Array:
    """The smallest eigenvalues of positive semi-definite matrices (n, n, N) with entries of at most 1, (N,)."""
    diagonal, beside = _tridiagonal(matrices)
    found = np.zeros(diagonal.shape[1])
    left = np.arange(len(found))
    squares = beside**2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # beyond the eigenvalue, by rounding
        for _ in range(_MOST_STEPS):
            if not left.size:
                break
            step, before = _laguerre(diagonal[:, left], squares[:, left], found[left])
            found[left[before]] += step[before]
            left = left[before & (step > _ROUNDING)]
    return found


def _tridiagonal(matrices: Array) -> tuple[Array, Array]:
    """Diagonal (n, N) and the entries beside it (n - 1, N) of similar tridiagonal matrices, by reflections."""
    A, n = matrices.copy(), len(matrices)
    beside = np.empty((n - 1, A.shape[2]))
    for k in range(n - 2):
        v, rest = A[k + 1 :, k].copy(), A[k + 1 :, k + 1 :]
        norm = np.sqrt((v * v).sum(axis=0))
        half = norm * (norm + np.abs(v[0]))  # half the squared length of the reflected direction v below
        beside[k] = -np.copysign(norm, v[0])
        v[0] -= beside[k]
        w = (rest * v).sum(axis=1) / np.where(half > 0, half, 1.0)
        w -= v * ((w * v).sum(axis=0) / np.where(half > 0, 2 * half, 1.0))
        update = v[:, None] * w
        rest -= update
        rest -= update.transpose(1, 0, 2)
    if n > 1:
        beside[n - 2] = A[n - 1, n - 2]
    return np.einsum("iic->ic", A), beside


def _laguerre(diagonal: Array, squares: Array, at: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Laguerre's step towards the smallest eigenvalue of tridiagonal matrices, and where it lies before it.

    The characteristic polynomial is the product of the pivots q_i of T - at I, so the sums of 1 / (lambda_i - at) and
    of its square follow from q_i and two derivatives. Steps from below never pass the smallest eigenvalue.
    """
    n = len(diagonal)
    q, slope, bend = diagonal[0] - at, np.full_like(at, -1.0), np.zeros_like(at)
    before, first, second = q > 0, 1 / q, 1 / (q * q)
    for i in range(1, n):
        ratio, share = squares[i - 1] / q, slope / q
        q, slope, bend = diagonal[i] - at - ratio, ratio * share - 1, ratio * (bend / q - 2 * share * share)
        before &= q > 0
        share = slope / q
        first -= share
        second += share * share - bend / q
    return n / (first + np.sqrt(np.maximum((n - 1) * (n * second - first * first), 0.0))), before
