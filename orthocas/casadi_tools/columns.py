"""SX functions of one sample, replayed on blocks of samples: every operation acts on a column of samples (ours).

CasADi's interpreter spends a few nanoseconds per operation, whatever its operands. Columns of 256 samples share that
cost, and elementary operations run at the speed of the cache.

A blocked array is (B, entries, c): B blocks of c samples. The entries of a matrix are listed column by column. The last
block is padded with copies of the first sample.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import THREADS
from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.tape import Tape, replay, to_tape
from orthocas.checks import Array
from orthocas.errors import OrthocasError

COLUMNS = 256  #: samples in a block


def blocked(stack: Array) -> Array:
    """Arrange samples (N, rows, columns) or (N, rows) in blocks (B, entries, c)."""
    flat = (stack.transpose(0, 2, 1) if stack.ndim == 3 else stack).reshape(len(stack), -1)
    blocks = -(-len(flat) // COLUMNS)
    filled = np.concatenate([flat, np.repeat(flat[:1], blocks * COLUMNS - len(flat), axis=0)])
    return np.ascontiguousarray(filled.reshape(blocks, COLUMNS, -1).transpose(0, 2, 1))


def shares(samples: int) -> Array:
    """Weights of a mean over N samples in blocks, (B, c): 1 / N for samples, 0 for the padding."""
    blocks = -(-samples // COLUMNS)
    return np.where(np.arange(blocks * COLUMNS) < samples, 1 / samples, 0.0).reshape(blocks, COLUMNS)


def by_sample(blocks: Array, samples: int, every: int = 1) -> Array:
    """Matrices (N, rows, columns) of the samples in blocks (B, columns, rows, c).

    Args:
        blocks: entries of matrices, column by column.
        samples: number N of samples, without the padding.
        every: take only every second, third, ... sample.
    """
    stack = blocks.transpose(0, 3, 2, 1).reshape(-1, blocks.shape[2], blocks.shape[1])
    return stack[:samples:every] if every == 1 else np.ascontiguousarray(stack[:samples:every])


class ColumnFunction:
    """A dense SX function of one sample, for blocked arrays.

    Args:
        function: a function with any number of matrix inputs and outputs.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function

    def __call__(self, *arguments: Array) -> list[Array]:
        """Outputs (B, entries, c) for contiguous inputs (B, entries, c). Threads share the blocks."""
        parts = max(1, min(THREADS, len(arguments[0])))
        # CasADi lets go of Python's lock while it evaluates. It must not build in a thread: its own lock against
        # Python's is a deadlock.
        runs = [self.on_one_block() for _ in range(parts)]
        split = zip(*(np.array_split(argument, parts) for argument in arguments), strict=True)
        if parts == 1:
            return _of_blocks(runs[0], *arguments)
        with ThreadPoolExecutor(parts) as pool:
            results = list(pool.map(lambda run, part: _of_blocks(run, *part), runs, split))
        return [np.concatenate(outputs) for outputs in zip(*results, strict=True)]

    def on_one_block(self, reused: bool = False) -> Callable[..., list[Array]]:
        """A function of contiguous inputs (entries, c) with its own scratch memory. It returns (entries, c).

        Args:
            reused: return the same arrays at every call. Large ones need time to allocate.
        """
        buffer: Any  # the stubs of set_arg and set_res ask for a size, the methods take none
        buffer, evaluate = self._on_block.buffer()
        shapes = [(self._function.numel_out(i), COLUMNS) for i in range(self._function.n_out())]
        own = [np.empty(shape) for shape in shapes] if reused else None

        def run(*arguments: Array) -> list[Array]:
            results = own or [np.empty(shape) for shape in shapes]
            for i, array in enumerate(arguments):
                buffer.set_arg(i, array.data)
            for i, array in enumerate(results):
                buffer.set_res(i, array.data)
            evaluate()
            return results

        return run

    @cached_property
    def _on_block(self) -> ca.Function:
        """The function of matrices whose rows are samples."""
        sizes = [self._function.numel_in(i) for i in range(self._function.n_in())]
        inputs = [ca.MX.sym(f"i{i}", COLUMNS, size) for i, size in enumerate(sizes)]
        entries = iter(replay(self.tape, [column for x in inputs for column in ca.horzsplit(x)]))
        outputs = [
            ca.horzcat(*(next(entries) for _ in range(self._function.numel_out(i))))
            for i in range(self._function.n_out())
        ]
        return ca.Function(f"{self._function.name()}_columns", inputs, outputs)

    @property
    def supported(self) -> bool:
        """Whether tapes know all operations of the function."""
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
        for rows, columns in shapes:
            parts.append(ca.reshape(column[start : start + rows * columns], rows, columns))
            start += rows * columns
        outputs = self._function.call(parts)
        stacked = ca.densify(ca.vertcat(*(ca.vec(ca.densify(out)) for out in outputs)))
        return to_tape(ca.Function("flat", [column], [ca.cse(stacked)]))


def _of_blocks(run: Callable[..., list[Array]], *arguments: Array) -> list[Array]:
    """Evaluate some blocks in one thread."""
    blocks = [run(*block) for block in zip(*arguments, strict=True)]
    return [np.stack(outputs) for outputs in zip(*blocks, strict=True)]
