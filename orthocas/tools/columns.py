"""Large SX functions evaluated on columns of samples, in blocks that threads share."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.errors import OrthocasError
from orthocas.tools.batch import Batched, count_threads, run_in_threads_with
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.expressions import Tape, replay, write_tape

COLUMNS = 256  #: samples in a block
NARROW = 64  #: samples in a block of small sets
MANY = 9  #: number of joint positions from which blocks pay off; `Batched` takes 1, 8 or 64 at once
_PIECE = 8 * COLUMNS  #: number of joint positions per task of a thread

#: evaluates contiguous inputs (entries, c), and writes contiguous outputs (entries, c)
Run = Callable[[Sequence[Array], Sequence[Array]], None]


def arrange_blocks(stack: Array) -> Array:
    """Arrange samples (N, rows, columns) or (N, rows) in blocks (B, entries, c)."""
    flat = (stack.transpose(0, 2, 1) if stack.ndim == 3 else stack).reshape(len(stack), -1)
    blocks = -(-len(flat) // COLUMNS)
    missing = blocks * COLUMNS - len(flat)
    filled = np.concatenate([flat, np.repeat(flat[:1], missing, axis=0)]) if missing else flat
    return np.ascontiguousarray(filled.reshape(blocks, COLUMNS, -1).transpose(0, 2, 1))


def build_weights(samples: int) -> Array:
    """Weights of a mean over N samples in blocks, (B, c): 1 / N for samples, 0 for the padding."""
    blocks = -(-samples // COLUMNS)
    return np.where(np.arange(blocks * COLUMNS) < samples, 1 / samples, 0.0).reshape(blocks, COLUMNS)


def split_by_sample(blocks: Array, samples: int, every: int = 1) -> Array:
    """Matrices (N, rows, columns) of the samples in blocks (B, columns, rows, c).

    Args:
        blocks: entries of matrices, column by column.
        samples: number N of samples, without the padding.
        every: keep only every second, third, ... sample.
    """
    stack = blocks.transpose(0, 3, 2, 1).reshape(-1, blocks.shape[2], blocks.shape[1])
    return stack[:samples:every] if every == 1 else np.ascontiguousarray(stack[:samples:every])


class ColumnFunction:
    """A dense SX function of one sample, evaluated on blocked arrays.

    Args:
        function: a function with any number of matrix inputs and outputs.
        columns: number c of samples in a block.
    """

    def __init__(self, function: ca.Function, columns: int = COLUMNS) -> None:
        self._function, self._columns = function, columns

    def __call__(self, *arguments: Array) -> list[Array]:
        """Outputs (B, entries, c) for contiguous inputs (B, entries, c). Threads share the blocks."""
        blocks, count = len(arguments[0]), count_threads()
        results = [np.empty((blocks, *shape)) for shape in self._shapes]

        # Of n threads, each takes every n-th block, with its own memory.
        def evaluate(run: Run, part: range) -> None:
            for b in part:
                run([argument[b] for argument in arguments], [result[b] for result in results])

        with self.borrow(min(count, blocks)) as runs:
            run_in_threads_with(runs, evaluate, [range(k, blocks, count) for k in range(len(runs))])
        return results

    @contextmanager
    def borrow(self, count: int) -> Iterator[list[Run]]:
        """Lend `count` functions of blocks, with scratch memory that nobody else uses meanwhile.

        They are kept for later calls. CasADi releases Python's lock (GIL) while it evaluates. Functions must not be
        built in a thread of a pool, because CasADi's lock and the GIL would deadlock.
        """
        runs: list[Run] = []
        for _ in range(count):
            try:
                runs.append(self._spare.pop())
            except IndexError:
                runs.append(self._build_run())
        try:
            yield runs
        finally:
            self._spare.extend(runs)

    def build_block_function(self) -> Callable[..., list[Array]]:
        """A function of contiguous inputs (entries, c). It returns the same arrays (entries, c) at every call."""
        run, results = self._build_run(), [np.empty(shape) for shape in self._shapes]

        def evaluate(*arguments: Array) -> list[Array]:
            run(arguments, results)
            return results

        return evaluate

    def _build_run(self) -> Run:
        # The type stubs of set_arg and set_res require a size, which the methods do not take.
        buffer: Any
        buffer, evaluate = self._on_block.buffer()

        def run(arguments: Sequence[Array], results: Sequence[Array]) -> None:
            for i, array in enumerate(arguments):
                buffer.set_arg(i, array.data)
            for i, array in enumerate(results):
                buffer.set_res(i, array.data)
            evaluate()

        return run

    @cached_property
    def _spare(self) -> list[Run]:
        """Free functions."""
        return []

    @property
    def _shapes(self) -> list[tuple[int, int]]:
        """Shapes of the outputs on one block."""
        return [(self._function.numel_out(i), self._columns) for i in range(self._function.n_out())]

    @cached_property
    def _on_block(self) -> ca.Function:
        """The function of matrices whose rows are samples."""
        sizes = [self._function.numel_in(i) for i in range(self._function.n_in())]
        inputs = [ca.MX.sym(f"i{i}", self._columns, size) for i, size in enumerate(sizes)]
        entries = iter(replay(self.tape, [column for x in inputs for column in ca.horzsplit(x)]))
        outputs = [
            ca.horzcat(*(next(entries) for _ in range(self._function.numel_out(i))))
            for i in range(self._function.n_out())
        ]
        return ca.Function(f"{self._function.name()}_columns", inputs, outputs)

    @property
    def supported(self) -> bool:
        """Whether tapes support all operations of the function."""
        try:
            return bool(self.tape)
        except OrthocasError:
            return False

    @cached_property
    def tape(self) -> Tape:
        """The tape that maps all entries of the inputs, as one column, to all entries of the outputs, as one column."""
        shapes = [self._function.size_in(i) for i in range(self._function.n_in())]
        column = ca.SX.sym("x", sum(rows * columns for rows, columns in shapes))
        parts, start = [], 0
        # One column holds all inputs, with matrices column by column.
        for rows, columns in shapes:
            parts.append(ca.reshape(column[start : start + rows * columns], rows, columns))
            start += rows * columns
        outputs = self._function.call(parts)
        stacked = ca.densify(ca.vertcat(*(ca.vec(ca.densify(out)) for out in outputs)))
        return write_tape(ca.Function("flat", [column], [ca.cse(stacked)]))


#: a function of contiguous columns (n, c) with its own scratch memory; it may return the same array at every call
BlockFunction = Callable[..., Array]


def fill(results: NDArray[Any], points: Array, make: Callable[[], BlockFunction], *others: Array) -> None:
    """Write a function's values at points (N, n) to `results`, (N, ...), which may be part of a larger array.

    Args:
        results: output array; the entries of a sample are in row-major order.
        points: joint positions.
        make: builds a function (n, c) -> (entries, c); called once per thread.
        others: further arguments of the function, (N, k) each.
    """
    starts = range(0, len(points), _PIECE)
    # Build functions outside the threads, see `ColumnFunction.borrow`.
    functions = [make() for _ in range(min(count_threads(), len(starts)))]

    def fill_piece(function: BlockFunction, start: int) -> None:
        piece = slice(start, start + _PIECE)
        fill_blocks(results[piece], function, COLUMNS, points[piece], *(array[piece] for array in others))

    run_in_threads_with(functions, fill_piece, starts)


def fill_blocks(results: NDArray[Any], function: BlockFunction, columns: int, *arguments: Array) -> None:
    """Fill the results in this thread by calls of one function on blocks of `columns` columns."""
    for first in range(0, len(results), columns):
        count, blocks = min(columns, len(results) - first), [np.empty((array.shape[1], columns)) for array in arguments]
        for block, array in zip(blocks, arguments, strict=True):
            # Samples become columns. The last block is padded with its first sample.
            block[:, :count] = array[first : first + count].T
            block[:, count:] = array[first : first + 1].T
        values = function(*blocks)
        by_entry = values.reshape(*results.shape[1:], columns)[..., :count]
        # moveaxis is slower.
        results[first : first + columns] = by_entry.transpose(-1, *range(by_entry.ndim - 1))


class BlockedFunction:
    """A dense SX function of columns, the first of them q (n, 1), for sets of any size; called like `Batched`.

    Args:
        function: the function, with one output, which is a column or a matrix.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function, self._few = function, Batched(function)

    def __call__(self, points: Array, *others: Array) -> list[Array]:
        """Values (N, rows) or (N, rows, columns) at points (N, n), and at rows (N, k) of the other inputs."""
        rows, columns = self._function.size_out(0)
        shape = (len(points), rows) if columns == 1 else (len(points), rows, columns)
        return [self.into(np.empty(shape), points, *others)]

    def into(self, results: Array, points: Array, *others: Array) -> Array:
        """Write the values to `results`, which may be part of a larger array, and return it."""
        if len(points) < MANY or self._by_rows is None:
            # Single points, or operations that columns do not support.
            results[...] = self._few(points, *others)[0].reshape(results.shape)
        elif len(points) <= 2 * NARROW:
            try:
                # Few points: narrow blocks with reused memory.
                function = self._spare.pop()
            except IndexError:
                function = self._build_function(narrow=True)
            fill_blocks(results, function, NARROW, points, *others)
            self._spare.append(function)
        else:
            # Many points: wide blocks shared by threads.
            fill(results, points, self._build_function, *others)
        return results

    def _build_function(self, narrow: bool = False) -> BlockFunction:
        """The function on one block."""
        rows = ColumnFunction(self._entries, NARROW) if narrow else self._by_rows
        assert rows is not None
        run = rows.build_block_function()
        return lambda *columns: run(*columns)[0]

    @cached_property
    def _spare(self) -> list[BlockFunction]:
        """Free functions of narrow blocks."""
        return []

    @cached_property
    def _by_rows(self) -> ColumnFunction | None:
        """The function with its entries row by row; None if it has an operation that columns do not support."""
        columns = ColumnFunction(self._entries)
        return columns if columns.supported else None

    @cached_property
    def _entries(self) -> ca.Function:
        """The function with its entries row by row, as a column."""
        inputs = [ca.SX.sym(f"i{i}", self._function.numel_in(i)) for i in range(self._function.n_in())]
        return ca.Function(self._function.name(), inputs, [ca.vec(ca.densify(self._function(*inputs)).T)])
