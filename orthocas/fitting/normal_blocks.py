"""Products of the Gauss-Newton matrix in single precision: the same sums for any number of threads (ours)."""

from collections.abc import Sequence
from math import ceil

import numpy as np

from orthocas.casadi_tools.batch import THREADS
from orthocas.casadi_tools.threads import in_threads
from orthocas.checks import Array

_CHUNK = 512  # samples in a product: the rows stay in the cache


def normal_blocks(derivatives: Sequence[Array], gradients: Array, shared: Sequence[tuple[int, int, int, int]]) -> Array:
    """Sums over samples of X_j^T X_j, and of x_i^T x_j for residuals that two coordinates share, (r, r, K, K).

    X_j = D_j G are the derivatives of the residuals of coordinate j with respect to its coefficients. Products are
    taken over chunks of samples, and added in double precision in the order of the chunks.

    Args:
        derivatives: D_j of every coordinate, (N, rows, n).
        gradients: G, (N, n, K).
        shared: coordinates i, j and the places of their shared residual among the rows of X_i and of X_j. Only the
            block (i, j) is filled.
    """
    r, K = len(derivatives), gradients.shape[2]
    blocks = np.zeros((r, r, K, K))
    chunks = range(0, len(gradients), _CHUNK)
    together = ceil(THREADS / r)  # chunks, so that there is work for all threads
    for k in range(0, len(chunks), together):
        _add(blocks, chunks[k : k + together], derivatives, gradients, shared)
    return blocks


def _add(
    blocks: Array,
    starts: Sequence[int],
    derivatives: Sequence[Array],
    gradients: Array,
    shared: Sequence[tuple[int, int, int, int]],
) -> None:
    """Add the products of some chunks: every block by one thread, in the order of the chunks."""

    def rows(piece: tuple[int, int]) -> Array:
        start, j = piece
        part = slice(start, start + _CHUNK)
        product: Array = derivatives[j][part] @ gradients[part]  # (chunk, rows, K)
        return product

    def product(pair: tuple[int, int, int, int]) -> None:
        i, j, row, other = pair
        for start in starts:
            if i == j:
                flat = X[start, j].reshape(-1, X[start, j].shape[2])
                blocks[j, j] += flat.T @ flat
            else:
                blocks[i, j] += X[start, i][:, row].T @ X[start, j][:, other]

    r = len(derivatives)
    pieces = [(start, j) for start in starts for j in range(r)]
    X = dict(zip(pieces, in_threads(rows, pieces), strict=True))
    for _ in in_threads(product, [*((j, j, 0, 0) for j in range(r)), *shared]):
        pass
