"""Work shared by threads so that its results do not depend on their number (ours).

BLAS divides a product among threads, and rounds differently for every number of them. So BLAS is held to one thread,
and the work is cut into pieces of a fixed size, whose results come back in their order.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from orthocas.casadi_tools.batch import THREADS

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def in_threads(work: Callable[[Piece], Result], pieces: Sequence[Piece]) -> Iterator[Result]:
    """Results of all pieces in their order, as `map`; as many threads as `THREADS` says share the pieces."""
    threads = min(THREADS, len(pieces))
    if threads < 2:
        yield from map(work, pieces)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, pieces)


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
