"""The Gauss-Newton matrix in single precision: the same sums for any number of threads (ours)."""

from collections.abc import Callable, Sequence
from functools import partial
from math import ceil

import numpy as np

from orthocas.casadi_tools.threads import in_threads, thread_count
from orthocas.checks import Array

_CHUNK = 512  # samples in a product: the rows stay in the cache

Shared = Sequence[tuple[int, int, int, int]]


def normal_matrix(derivatives: Sequence[Array], gradients: Sequence[Array], shared: Shared) -> Array:
    """Sums over samples of X_j^T X_j, and of x_i^T x_j for residuals that two coordinates share, (size, size).

    X_j = D_j G_j are the derivatives of the residuals of coordinate j with respect to its coefficients. Products are
    taken over chunks of samples, and added in double precision in the order of the chunks.

    Args:
        derivatives: D_j of every coordinate, (N, rows, n).
        gradients: G_j of every coordinate, (N, n, K_j).
        shared: coordinates i > j and the places of their shared residual among the rows of X_i and of X_j.
    """
    r, ends = len(derivatives), np.cumsum([G.shape[2] for G in gradients])
    places = [slice(end - G.shape[2], end) for G, end in zip(gradients, ends, strict=True)]
    H = np.zeros((ends[-1], ends[-1]))
    chunks = range(0, len(gradients[0]), _CHUNK)
    together = ceil(thread_count() / r)  # chunks, so that there is work for all threads
    for k in range(0, len(chunks), together):
        _add(H, places, chunks[k : k + together], derivatives, gradients, shared)
    for i, j, *_ in shared:
        H[places[j], places[i]] = H[places[i], places[j]].T
    return H


def _add(
    H: Array,
    places: Sequence[slice],
    starts: Sequence[int],
    derivatives: Sequence[Array],
    gradients: Sequence[Array],
    shared: Shared,
) -> None:
    """Add the products of some chunks: every block by one thread, in the order of the chunks."""

    def rows(piece: tuple[int, int]) -> Array:
        start, j = piece
        part = slice(start, start + _CHUNK)
        product: Array = derivatives[j][part] @ gradients[j][part]  # (chunk, rows, K_j)
        return product

    def square(j: int) -> None:
        for start in starts:
            flat = X[start, j].reshape(-1, X[start, j].shape[2])
            H[places[j], places[j]] += flat.T @ flat

    def mixed(pair: tuple[int, int]) -> None:
        i, j = pair
        for start in starts:
            for row, other in rows_of[i, j]:
                H[places[i], places[j]] += X[start, i][:, row].T @ X[start, j][:, other]

    r = len(derivatives)
    rows_of: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j, row, other in shared:
        rows_of.setdefault((i, j), []).append((row, other))
    pieces = [(start, j) for start in starts for j in range(r)]
    X = dict(zip(pieces, in_threads(rows, pieces), strict=True))
    work: list[Callable[[], None]] = [partial(square, j) for j in range(r)]
    work += [partial(mixed, pair) for pair in rows_of]
    in_threads(lambda block: block(), work)
