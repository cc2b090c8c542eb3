"""Memory of arrays that is used again: to get fresh memory takes longer than an operation on it (ours)."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class ArrayMemory:
    """Arrays by name. One computation at a time uses them; the next one overwrites their values."""

    def __init__(self) -> None:
        self._arrays: dict[tuple[Any, ...], NDArray[Any]] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """The array of this name, shape and type; its first values are arbitrary."""
        key = (name, shape, np.dtype(dtype))
        if key not in self._arrays:
            self._arrays[key] = np.empty(shape, dtype)
        return self._arrays[key]


class Memories:
    """Memories that threads borrow."""

    def __init__(self) -> None:
        self._spare: list[ArrayMemory] = []

    @contextmanager
    def borrowed(self, count: int) -> Iterator[list[ArrayMemory]]:
        """So many memories that nobody else uses meanwhile."""
        found: list[ArrayMemory] = []
        for _ in range(count):
            try:
                found.append(self._spare.pop())
            except IndexError:
                found.append(ArrayMemory())
        try:
            yield found
        finally:
            self._spare.extend(reversed(found))
