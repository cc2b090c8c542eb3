"""CasADi functions on sets of samples, and work shared by threads."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from queue import SimpleQueue
from threading import Lock, local
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from threadpoolctl import ThreadpoolController

from orthocas.tools.cached import building
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred

_CHUNKS = (1, 8, 64)  #: chunk sizes; a set gets the smallest one that holds it, or the largest
_LARGE = 512  #: chunk size of sets at least this large, for which starting threads pays off


def _count_cores() -> int:
    """Number of cores this process may use; OMP_NUM_THREADS if it is set."""
    number = os.environ.get("OMP_NUM_THREADS", "")
    if number.isascii() and number.isdigit() and int(number) > 0:
        return int(number)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


THREADS = _count_cores()  #: number of threads for mapped functions in this process


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
    """A function of one sample, evaluated for N samples.

    It takes one array per input, (N, rows) for a column or (N, rows, columns) for a matrix, and returns one array per
    output in the same form. Inputs and outputs are dense.
    """

    function: ca.Function
    _mapped: dict[int, ca.Function] = field(default_factory=dict, repr=False)
    _mine: Any = field(default_factory=local, repr=False, compare=False)  #: buffers of each thread for few samples

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate N samples."""
        N = len(arguments[0])
        chunk = _LARGE if N >= _LARGE else next((size for size in _CHUNKS if size >= N), _CHUNKS[-1])
        if chunk not in self._mapped:
            how = ("thread", THREADS) if chunk == _LARGE and THREADS > 1 else ()
            with building:
                self._mapped[chunk] = self.function.map(chunk, *how)
        # Large sets use CasADi's threads. Small sets use buffers that each thread keeps.
        if chunk == _LARGE:
            return _Columns(self._mapped[chunk], chunk)(*arguments)
        if not hasattr(self._mine, "columns"):
            self._mine.columns = {}
        mine: dict[int, _Columns] = self._mine.columns
        if chunk not in mine:
            mine[chunk] = _Columns(self._mapped[chunk], chunk)
        return mine[chunk](*arguments)

    def __reduce__(self) -> tuple[type, tuple[ca.Function]]:
        return Batched, (self.function,)


class _Columns:
    """A function of `chunk` samples side by side as columns, with buffers for one thread; called like `Batched`."""

    def __init__(self, function: ca.Function, chunk: int) -> None:
        self._chunk = chunk
        # The type stubs require sizes that the methods do not take.
        buffer: Any
        buffer, self._run = function.buffer()
        self._buffer = buffer
        # CasADi stores matrices column by column.
        shapes = [function.size_in(i) for i in range(function.n_in())]
        self._inputs = [np.empty((chunk, columns // chunk, rows)) for rows, columns in shapes]
        shapes = [function.size_out(i) for i in range(function.n_out())]
        self._outputs = [np.empty((chunk, columns // chunk, rows)) for rows, columns in shapes]
        for i, array in enumerate(self._inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(self._outputs):
            buffer.set_res(i, array.data)

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate N samples."""
        N, chunk = len(arguments[0]), self._chunk
        # Arrange each column (rows,) or matrix (rows, columns) as CasADi stores it, (columns, rows).
        columns = [a[:, None, :] if a.ndim == 2 else a.transpose(0, 2, 1) for a in arguments]
        results = [np.empty((N, *out.shape[1:])) for out in self._outputs]
        for start in range(0, N, chunk):
            count = min(chunk, N - start)
            for array, argument in zip(self._inputs, columns, strict=True):
                array[:count] = argument[start : start + count]
                # Pad the last chunk with a valid sample.
                if count < chunk:
                    array[count:] = argument[start]
            with deferred():
                self._run()
            for result, out in zip(results, self._outputs, strict=True):
                result[start : start + count] = out[:count]
        # A single column becomes a vector.
        return [result[:, 0, :] if result.shape[1] == 1 else result.transpose(0, 2, 1) for result in results]


Piece = TypeVar("Piece")
Result = TypeVar("Result")
Tool = TypeVar("Tool")

_chosen: ContextVar[int | None] = ContextVar("threads", default=None)
_here = local()  #: `_here.works` is true in threads of a pool


def count_threads() -> int:
    """Number of threads that share work, set by `use_threads` (default `THREADS`); 1 inside such a thread."""
    return 1 if hasattr(_here, "works") else _chosen.get() or THREADS


@contextmanager
def use_threads(count: int | None) -> Iterator[None]:
    """Use `count` threads within this context; None changes nothing."""
    token = _chosen.set(count or _chosen.get())
    try:
        yield
    finally:
        _chosen.reset(token)


def run_in_threads(work: Callable[[Piece], Result], pieces: Sequence[Piece]) -> list[Result]:
    """Results of all pieces in order; `count_threads` threads share the pieces.

    After an exception or Ctrl-C, it returns only when no piece is being processed.
    """
    count = count_threads()
    if min(count, len(pieces)) < 2:
        return [work(piece) for piece in pieces]
    futures: list[Future[Result]] = []
    try:
        futures += (_build_pool(count).submit(work, piece) for piece in pieces)
        return [future.result() for future in futures]
    finally:
        wait([future for future in futures if not future.cancel()])


def run_in_threads_with(
    tools: Sequence[Tool], work: Callable[[Tool, Piece], Result], pieces: Sequence[Piece]
) -> list[Result]:
    """Like `run_in_threads`, but each running piece has a tool to itself; no more tools than threads are needed."""
    # A CasADi function must not run twice at the same time, so each thread borrows one.
    ready: SimpleQueue[Tool] = SimpleQueue()
    for tool in tools:
        ready.put(tool)

    def borrow_tool(piece: Piece) -> Result:
        tool = ready.get()
        try:
            return work(tool, piece)
        finally:
            ready.put(tool)

    return run_in_threads(borrow_tool, pieces)


@cache
def _build_pool(count: int) -> ThreadPoolExecutor:
    """A pool of idle threads, because starting threads for every call costs more than the work."""
    return ThreadPoolExecutor(count, initializer=setattr, initargs=(_here, "works", True))


# A child process inherits no threads, so it needs a new pool.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_build_pool.cache_clear)


class _BlasHold:
    """Limits BLAS to one thread while at least one caller requests it."""

    def __init__(self) -> None:
        self._lock, self._count = Lock(), 0
        self._libraries: ThreadpoolController | None = None
        #: number of modules at the last search for libraries, which takes 1 ms
        self._modules = 0
        self._limits: Any = None

    def begin(self) -> None:
        """Limit BLAS to one thread unless another caller already has."""
        with self._lock:
            if not self._count:
                # Modules that were imported since may have loaded libraries.
                if self._libraries is None or self._modules != len(sys.modules):
                    self._libraries, self._modules = ThreadpoolController(), len(sys.modules)
                self._limits = self._libraries.limit(limits=1, user_api="blas")
            self._count += 1

    def end(self) -> None:
        """Withdraw one request; after the last one, BLAS gets its threads back."""
        with self._lock:
            self._count -= 1
            if not self._count and self._limits is not None:
                self._limits.restore_original_limits()


_hold = _BlasHold()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread in the whole process; the limit ends with the last such context."""
    _hold.begin()
    try:
        yield
    finally:
        _hold.end()
