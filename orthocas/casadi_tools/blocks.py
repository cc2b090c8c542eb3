"""Functions of joint positions on large sets: threads share blocks of columns that stay in the cache (ours).

The blocks have a fixed size, so the numbers do not depend on the number of threads. Memory for intermediate values is
that of one block in each thread.
"""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.casadi_tools.batch import Batched
from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.columns import COLUMNS, ColumnFunction
from orthocas.casadi_tools.threads import in_threads_with, thread_count
from orthocas.checks import Array

MANY = 64  #: joint positions from which blocks pay off
_PIECE = 8 * COLUMNS  # joint positions that a thread takes at once

#: A function of contiguous columns (n, c) with its own scratch memory; it may return the same array at every call.
BlockFunction = Callable[..., Array]


def fill(results: NDArray[Any], points: Array, make: Callable[[], BlockFunction], *others: Array) -> None:
    """Write a function's values at points (N, n) to `results`, (N, ...), which may be part of a larger array.

    Args:
        results: the values; entries of one sample in row-major order.
        points: joint positions.
        make: makes the function (n, c) -> (entries, c), once for each thread.
        others: further arguments of the function, (N, k) each.
    """
    starts = range(0, len(points), _PIECE)
    functions = [make() for _ in range(min(thread_count(), len(starts)))]  # not in the threads, see ColumnFunction

    def one_piece(function: BlockFunction, start: int) -> None:
        for first in range(start, min(start + _PIECE, len(points)), COLUMNS):
            count = min(COLUMNS, len(points) - first)
            values = function(*(_columns(array[first : first + COLUMNS]) for array in (points, *others)))
            by_entry = values.reshape(*results.shape[1:], COLUMNS)[..., :count]
            results[first : first + COLUMNS] = np.moveaxis(by_entry, -1, 0)

    in_threads_with(functions, one_piece, starts)


def _columns(points: Array) -> Array:
    """Joint positions (k, n) as columns (n, c). The last block is padded with its first position."""
    columns = np.empty((points.shape[1], COLUMNS))
    columns[:, : len(points)] = points.T
    columns[:, len(points) :] = points[:1].T
    return columns


class BlockedFunction:
    """A dense SX function of q (n, 1), for sets of joint positions of any size; it is called like `Batched`.

    Args:
        function: the function, with one output: a column, or a matrix.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function, self._few = function, Batched(function)

    def __call__(self, points: Array) -> list[Array]:
        """Values (N, rows) or (N, rows, columns) at points (N, n)."""
        rows, columns = self._function.size_out(0)
        shape = (len(points), rows) if columns == 1 else (len(points), rows, columns)
        return [self.into(np.empty(shape), points)]

    def into(self, results: Array, points: Array) -> Array:
        """Write the values to `results`, which may be part of a larger array, and return it."""
        if len(points) < MANY or self._by_rows is None:
            results[...] = self._few(points)[0].reshape(results.shape)
        else:
            fill(results, points, self._on_one_block)
        return results

    def _on_one_block(self) -> BlockFunction:
        """The function for `fill`."""
        assert self._by_rows is not None
        run = self._by_rows.on_one_block()
        return lambda columns: run(columns)[0]

    @cached_property
    def _by_rows(self) -> ColumnFunction | None:
        """The function with its entries row by row; None if it has an operation that columns do not support."""
        q = ca.SX.sym("q", self._function.size_in(0)[0])
        entries = ca.vec(ca.densify(self._function(q)).T)
        columns = ColumnFunction(ca.Function(self._function.name(), [q], [entries]))
        return columns if columns.supported else None
