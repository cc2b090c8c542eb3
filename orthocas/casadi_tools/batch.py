"""Evaluate CasADi functions on whole sample sets, without copies through DM.

A NumPy sample set is (N, n), a stack of matrices is (N, rows, columns).
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.cached import building
from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array

_CHUNKS = (1, 8, 64)  # samples in one call: the smallest number that holds the set, or the largest
_LARGE = 512  # samples in one call of sets of at least so many, where starting threads pays off


def _threads() -> int:
    """Number of cores this process may use, or OMP_NUM_THREADS if it is set, as in other libraries."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    if wanted.isascii() and wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


THREADS = _threads()  #: threads that mapped functions of this process use


def dense_function(
    name: str, inputs: Sequence[Any], outputs: Sequence[Any], input_names: Sequence[str] = ()
) -> ca.Function:
    """A CasADi function, SX or MX, whose outputs have no structural zeros, as `Batched` needs.

    The first output is called `out`. A single input is called `q` unless `input_names` is given.
    """
    names = list(input_names) or (["q"] if len(inputs) == 1 else [f"i{k}" for k in range(len(inputs))])
    results = ["out", *(f"out{k}" for k in range(1, len(outputs)))]
    return ca.Function(name, inputs, [ca.densify(out) for out in outputs], names, results)


@dataclass(frozen=True)
class Batched:
    """A function of one sample that is called with N samples.

    It takes one array per input, (N, rows) for a column or (N, rows, columns) for a matrix, and returns one array per
    output in the same form. Inputs and outputs are dense.
    """

    function: ca.Function
    _mapped: dict[int, ca.Function] = field(default_factory=dict, repr=False)

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate N samples."""
        N = len(arguments[0])
        chunk = _LARGE if N >= _LARGE else next((size for size in _CHUNKS if size >= N), _CHUNKS[-1])
        if chunk not in self._mapped:
            how = ("thread", THREADS) if chunk == _LARGE and THREADS > 1 else ()
            with building:
                self._mapped[chunk] = self.function.map(chunk, *how)
        return evaluate_columns(self._mapped[chunk], chunk, *arguments)


def evaluate_columns(function: ca.Function, chunk: int, *arguments: Array) -> list[Array]:
    """Like `Batched`, for a function that takes `chunk` samples side by side as columns."""
    N = len(arguments[0])
    arguments = tuple(_column_major(a) for a in arguments)
    buffer: Any
    buffer, run = function.buffer()  # Any: the stubs of set_arg and set_res ask for a size, the methods take none
    inputs = [np.empty((chunk, *a.shape[1:])) for a in arguments]
    shapes = [function.size_out(i) for i in range(function.n_out())]
    outputs = [np.empty((chunk, columns // chunk, rows)) for rows, columns in shapes]
    for i, array in enumerate(inputs):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(outputs):
        buffer.set_res(i, array.data)
    results = [np.empty((N, *out.shape[1:])) for out in outputs]
    for start in range(0, N, chunk):
        count = min(chunk, N - start)
        for array, argument in zip(inputs, arguments, strict=True):
            array[:count] = argument[start : start + count]
            array[count:] = argument[start]  # pad the last chunk with a valid sample
        with deferred():
            run()
        for result, out in zip(results, outputs, strict=True):
            result[start : start + count] = out[:count]
    return [_row_major(result) for result in results]


def _column_major(array: Array) -> Array:
    """Transpose each sample's matrix (rows, columns): CasADi stores matrices column by column."""
    return array if array.ndim == 2 else array.transpose(0, 2, 1)


def _row_major(result: Array) -> Array:
    """Undo the transposition. A single column becomes a vector."""
    return result[:, 0, :] if result.shape[1] == 1 else result.transpose(0, 2, 1)
