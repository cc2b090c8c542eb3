"""Boxes halved again and again: a tree that is stored as one byte per box."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from orthocas.checks import Array, frozen_array, require_shape
from orthocas.errors import InvalidValueError

OPEN, PROVED = 255, 254  #: codes of boxes that are not halved; others are the joint that is
MOST_BOXES = 20_000_000
_DEEPEST = 1000


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A box and its parts. Halves share the face between them exactly, so the parts cover the box.

    Raises:
        InvalidValueError: if the codes are no tree.
    """

    low: Array  #: corner of the box, (n,)
    high: Array  #: opposite corner, (n,)
    codes: Array  #: uint8, in preorder: the joint whose interval is halved (lower half first), PROVED or OPEN

    def __post_init__(self) -> None:
        low = frozen_array("low", self.low, (None,))
        high = frozen_array("high", self.high, low.shape)
        codes = np.array(self.codes)
        if codes.dtype != np.uint8 or codes.ndim != 1 or not 0 < codes.size <= MOST_BOXES:
            raise InvalidValueError("codes", f"{codes.dtype} of shape {codes.shape}", "bytes of a tree of boxes")
        if not (low < high).all():
            raise InvalidValueError("low", low.tolist(), "a corner below the opposite one")
        _require_tree(codes, len(low))
        codes.setflags(write=False)
        for name, value in (("low", low), ("high", high), ("codes", codes)):
            object.__setattr__(self, name, value)

    @classmethod
    def whole(cls, low: Array, high: Array) -> Self:
        """The box in one part, not proved."""
        return cls(low, high, np.array([OPEN], dtype=np.uint8))

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.low)

    @property
    def proved_count(self) -> int:
        """Number of parts that are proved."""
        return int((self.codes == PROVED).sum())

    @property
    def open_count(self) -> int:
        """Number of parts where nothing is proved."""
        return int((self.codes == OPEN).sum())

    @property
    def complete(self) -> bool:
        """Whether all parts are proved."""
        return not (self.codes == OPEN).any()

    @property
    def share(self) -> float:
        """Share of the volume that is proved: 1 only if all of it is."""
        if self.complete:
            return 1.0
        depths = self._depths()[self.codes == PROVED]
        return min(float((0.5**depths).sum()), 1 - 2**-53)

    def leaves(self, code: int) -> tuple[Array, Array]:
        """Corners (boxes, n) of the parts with a code."""
        low, high = [], []
        for found, a, b in self._walk():
            if found == code:
                low.append(a)
                high.append(b)
        return np.array(low).reshape(-1, self.n), np.array(high).reshape(-1, self.n)

    def _depths(self) -> Array:
        depths = np.zeros(self.codes.size)
        waiting = [0]
        for k, code in enumerate(self.codes.tolist()):
            depths[k] = waiting.pop()
            if code < PROVED:
                waiting += [depths[k] + 1] * 2
        return depths

    def _walk(self) -> Iterator[tuple[int, Array, Array]]:
        """Codes and corners of all parts, in preorder."""
        waiting = [(np.array(self.low), np.array(self.high))]
        for code in self.codes.tolist():
            low, high = waiting.pop()
            yield code, low, high
            if code < PROVED:
                middle = halfway(low[code], high[code])
                top, bottom = low.copy(), high.copy()
                top[code] = bottom[code] = middle
                waiting += [(top, high), (low, bottom)]


def halfway(low: float, high: float) -> float:
    """The number between two corners where a box is halved."""
    return (low + high) / 2


def _require_tree(codes: Array, n: int) -> None:
    require_shape("codes", codes.shape, (None,))
    inner = codes < PROVED
    if (codes[inner] >= n).any():
        raise InvalidValueError("codes", int(codes[inner].max()), f"numbers of joints below {n}, {PROVED} or {OPEN}")
    missing = 1 + np.cumsum(np.where(inner, 1, -1))
    if missing[-1] != 0 or (missing[:-1] <= 0).any():
        raise InvalidValueError("codes", f"{codes.size} bytes", "a tree of boxes")
    if missing.max() > _DEEPEST:
        raise InvalidValueError("codes", "a tree that is too deep", f"at most {_DEEPEST} open halves at once")
