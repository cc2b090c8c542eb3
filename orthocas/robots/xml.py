"""XML files that may be broken or malicious: bounded size and depth, strict reading of attributes."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from orthocas.errors import RobotError
from orthocas.tools.checks import Array

MOST_BYTES = 16 * 2**20  #: largest size of a file
MOST_ELEMENTS = 200_000  #: most elements of a file, including the files that it includes
MOST_DEPTH = 200  #: deepest nesting of elements
MOST_LINKS = 1000  #: most links (URDF) or bodies (MJCF) of a robot

_ARTICLE = {"URDF": "a", "MJCF": "an", "SRDF": "an"}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_LARGEST = 1e20  # no length, mass or angle is larger; volumes of such sizes do not overflow


def read_xml(path: str | Path, kind: str, tag: str | None = None) -> ElementTree.Element:
    """The root element of an XML file.

    Args:
        path: the file.
        kind: expected kind of file for messages, "URDF" or "MJCF".
        tag: expected name of the root element. None allows any name.

    Raises:
        RobotError: if the file is missing, is not XML, has another root element, declares a document type (entities
            could fill the memory), or is larger or deeper than any robot.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        root = _parse(data)
    except OSError as error:
        raise RobotError(f"cannot read {kind} file {path}: {error.strerror}") from None
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # LookupError: an unknown encoding
        raise RobotError(f"{path} is not {_ARTICLE[kind]} {kind} file: {error}") from None
    if tag is not None and root.tag != tag:
        raise RobotError(
            f"{path} is not {_ARTICLE[kind]} {kind} file: its root element is <{root.tag}>, expected <{tag}>"
        )
    return root


def _parse(data: bytes) -> ElementTree.Element:
    if len(data) > MOST_BYTES:
        raise ValueError(f"it has more than {MOST_BYTES} bytes")
    parser = ElementTree.XMLParser(target=_BoundedBuilder())
    parser.feed(data)
    root: ElementTree.Element = parser.close()
    return root


class _BoundedBuilder(ElementTree.TreeBuilder):
    """Builds the tree during parsing, and stops at anything that no robot file needs."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = self._elements = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError(f"it declares a document type ({name}), which orthocas does not allow")

    def start(self, tag: Any, attrs: Any, /) -> Any:
        self._depth += 1
        self._elements += 1
        if self._depth > MOST_DEPTH:
            raise ValueError(f"its elements nest more than {MOST_DEPTH} deep")
        if self._elements > MOST_ELEMENTS:
            raise ValueError(f"it has more than {MOST_ELEMENTS} elements")
        return super().start(tag, attrs)

    def end(self, tag: Any, /) -> Any:
        self._depth -= 1
        return super().end(tag)


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
