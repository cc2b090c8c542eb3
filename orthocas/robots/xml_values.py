"""Strict reading of XML attributes: vectors have the right length, numbers are plausible, keywords are known."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from orthocas.checks import Array
from orthocas.errors import RobotError

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_LARGEST = 1e20  # no length, mass or angle is larger; volumes of such sizes do not overflow


@dataclass(frozen=True, slots=True)
class Attributes:
    """The attributes of one element, with the file and element name for error messages."""

    file: str  #: file of the element
    element: str  #: name of the element in messages, such as <joint name='j1'>
    values: Mapping[str, str]

    def text(self, name: str, default: str | None = None) -> str:
        """An attribute as text.

        Raises:
            RobotError: if it is missing and has no default.
        """
        value = self.values.get(name, default)
        if value is None:
            raise self.error(f"has no attribute '{name}'")
        return value

    def keyword(self, name: str, known: Collection[str], default: str) -> str:
        """An attribute that is one of the known words.

        Raises:
            RobotError: if it is another word.
        """
        value = self.values.get(name, default)
        if value not in known:
            raise self._unfit(name, " or ".join(f"'{word}'" for word in known))
        return value

    def flag(self, name: str, default: bool = False) -> bool:
        """An attribute that is 'true' or 'false'.

        Raises:
            RobotError: if it is another word.
        """
        return self.keyword(name, ("true", "false"), "true" if default else "false") == "true"

    def number(self, name: str, default: float | None = None) -> float:
        """An attribute that is one number.

        Raises:
            RobotError: if it is something else, or missing without a default.
        """
        return float(self.numbers(name, 1, None if default is None else [default])[0])

    def numbers(self, name: str, count: int, default: Collection[float] | None = None) -> Array:
        """An attribute that is a vector of `count` numbers, (count,).

        Raises:
            RobotError: if it is something else, or missing without a default.
        """
        if default is not None and name not in self.values:
            return np.array(list(default), dtype=float)
        words = self.text(name).split()
        expected = "a number" if count == 1 else f"{count} numbers"
        if len(words) != count or not all(_NUMBER.fullmatch(word) for word in words):
            raise self._unfit(name, expected)
        values = np.array([float(word) for word in words])
        if not (abs(values) <= _LARGEST).all():
            raise self._unfit(name, f"{expected} up to {_LARGEST:g}")
        return values

    def direction(self, name: str, default: Collection[float] | None = None) -> Array:
        """An attribute that is a vector of three numbers, scaled to length 1.

        Raises:
            RobotError: if it is something else, or the zero vector.
        """
        vector = self.numbers(name, 3, default)
        length = float(np.linalg.norm(vector))
        if length < 1e-12:
            raise self._unfit(name, "a vector that is not zero")
        return np.asarray(vector / length)

    def error(self, complaint: str) -> RobotError:
        """The error to raise for this element. The message is 'file: element complaint'."""
        return RobotError(f"{self.file}: {self.element} {complaint}")

    def _unfit(self, name: str, expected: str) -> RobotError:
        return RobotError(f"{self.file}: {name} of {self.element} is '{self.text(name)[:80]}', expected {expected}")
