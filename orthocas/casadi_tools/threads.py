"""Work shared by threads so that its results do not depend on their number (ours).

BLAS divides a product among threads, and rounds differently for every number of them. So BLAS is held to one thread,
and the work is cut into pieces of a fixed size, whose results come back in their order.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from queue import SimpleQueue
from threading import Lock, local
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from orthocas.casadi_tools.batch import THREADS

Piece = TypeVar("Piece")
Result = TypeVar("Result")
Tool = TypeVar("Tool")

_wanted: ContextVar[int | None] = ContextVar("threads", default=None)
_here = local()  # .works: whether this thread is one of a pool


def thread_count() -> int:
    """Number of threads that share work: what `using_threads` says, or `THREADS`; 1 within such a thread."""
    return 1 if hasattr(_here, "works") else _wanted.get() or THREADS


@contextmanager
def using_threads(count: int | None) -> Iterator[None]:
    """Let so many threads share the work of the block. None changes nothing."""
    token = _wanted.set(count or _wanted.get())
    try:
        yield
    finally:
        _wanted.reset(token)


def in_threads(work: Callable[[Piece], Result], pieces: Sequence[Piece]) -> list[Result]:
    """Results of all pieces in their order; `thread_count` threads share the pieces.

    After an exception, and after Ctrl-C, no piece is still at work.
    """
    count = thread_count()
    if min(count, len(pieces)) < 2:
        return [work(piece) for piece in pieces]
    futures: list[Future[Result]] = []
    try:
        futures += (_pool(count).submit(work, piece) for piece in pieces)
        return [future.result() for future in futures]
    finally:
        wait([future for future in futures if not future.cancel()])


def in_threads_with(
    tools: Sequence[Tool], work: Callable[[Tool, Piece], Result], pieces: Sequence[Piece]
) -> list[Result]:
    """The same with tools that only one piece can use at a time; one for each thread, or for each piece, is enough."""
    ready: SimpleQueue[Tool] = SimpleQueue()
    for tool in tools:
        ready.put(tool)

    def with_a_tool(piece: Piece) -> Result:
        tool = ready.get()
        try:
            return work(tool, piece)
        finally:
            ready.put(tool)

    return in_threads(with_a_tool, pieces)


@cache
def _pool(count: int) -> ThreadPoolExecutor:
    """Threads that sleep while there is nothing to do: to start them for every call costs more than the work."""
    return ThreadPoolExecutor(count, initializer=setattr, initargs=(_here, "works", True))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of the threads


class _BlasHold:
    """BLAS held to one thread while anyone wants it so."""

    def __init__(self) -> None:
        self._lock, self._count = Lock(), 0
        self._libraries: ThreadpoolController | None = None
        self._modules = 0  # when the libraries were searched, which takes 1 ms
        self._limits: Any = None

    def begin(self) -> None:
        """One more wants it."""
        with self._lock:
            if not self._count:
                if self._libraries is None or self._modules != len(sys.modules):  # which may have brought some
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
