"""CasADi functions on sets of samples, and work in threads."""

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

_CHUNKS = (1, 8, 64)  #: samples in one call: the smallest number that holds the set, or the largest
_LARGE = 512  #: samples in one call of sets of at least so many, where starting threads pays off


def _count_cores() -> int:
    """Number of cores this process may use, or OMP_NUM_THREADS if it is set, as in other libraries."""
    number = os.environ.get("OMP_NUM_THREADS", "")
    if number.isascii() and number.isdigit() and int(number) > 0:
        return int(number)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


THREADS = _count_cores()  #: threads that mapped functions of this process use


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
    _mine: Any = field(default_factory=local, repr=False, compare=False)  #: memory of each thread for few samples

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate N samples."""
        N = len(arguments[0])
        chunk = _LARGE if N >= _LARGE else next((size for size in _CHUNKS if size >= N), _CHUNKS[-1])
        if chunk not in self._mapped:
            how = ("thread", THREADS) if chunk == _LARGE and THREADS > 1 else ()
            with building:
                self._mapped[chunk] = self.function.map(chunk, *how)
        # Large sets run in threads of CasADi; small ones in buffers that each thread keeps.
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
    """A function of `chunk` samples side by side as columns, with the memory of one thread; called like `Batched`."""

    def __init__(self, function: ca.Function, chunk: int) -> None:
        self._chunk = chunk
        # The stubs ask for sizes that the methods do not take.
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
        # Each sample's column (rows,) or matrix (rows, columns) as CasADi stores it, (columns, rows).
        columns = [a[:, None, :] if a.ndim == 2 else a.transpose(0, 2, 1) for a in arguments]
        results = [np.empty((N, *out.shape[1:])) for out in self._outputs]
        for start in range(0, N, chunk):
            count = min(chunk, N - start)
            for array, argument in zip(self._inputs, columns, strict=True):
                array[:count] = argument[start : start + count]
                # The last chunk is padded with a valid sample.
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
_here = local()  #: .works: whether this thread is one of a pool


def count_threads() -> int:
    """Number of threads that share work: what `use_threads` says, or `THREADS`; 1 within such a thread."""
    return 1 if hasattr(_here, "works") else _chosen.get() or THREADS


@contextmanager
def use_threads(count: int | None) -> Iterator[None]:
    """Let so many threads share the work of the block. None changes nothing."""
    token = _chosen.set(count or _chosen.get())
    try:
        yield
    finally:
        _chosen.reset(token)


def run_in_threads(work: Callable[[Piece], Result], pieces: Sequence[Piece]) -> list[Result]:
    """Results of all pieces in their order; `count_threads` threads share the pieces.

    After an exception, and after Ctrl-C, no piece is still at work.
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
    """`run_in_threads` with tools that one piece at a time can use; one for each thread, or each piece, is enough."""
    # A CasADi function must not run twice at once: threads take one, and give it back.
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
    """Threads that sleep while there is nothing to do: to start them for every call costs more than the work."""
    return ThreadPoolExecutor(count, initializer=setattr, initargs=(_here, "works", True))


# A child process has none of the threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_build_pool.cache_clear)


class _BlasHold:
    """Holds BLAS to one thread while any caller asks for it."""

    def __init__(self) -> None:
        self._lock, self._count = Lock(), 0
        self._libraries: ThreadpoolController | None = None
        #: modules when the libraries were searched, which takes 1 ms
        self._modules = 0
        self._limits: Any = None

    def begin(self) -> None:
        """Limit BLAS to one thread, if no other caller has."""
        with self._lock:
            if not self._count:
                # New modules may have brought libraries.
                if self._libraries is None or self._modules != len(sys.modules):
                    self._libraries, self._modules = ThreadpoolController(), len(sys.modules)
                self._limits = self._libraries.limit(limits=1, user_api="blas")
            self._count += 1

    def end(self) -> None:
        """One less wants it; after the last one BLAS has its threads back."""
        with self._lock:
            self._count -= 1
            if not self._count and self._limits is not None:
                self._limits.restore_original_limits()


_hold = _BlasHold()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS to one thread, in the whole process; the end of the last block gives the others back."""
    _hold.begin()
    try:
        yield
    finally:
        _hold.end()
