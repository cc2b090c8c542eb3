"""XML files that may be broken or malicious: size and depth are bounded, document types are refused."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from orthocas.errors import RobotError

MOST_BYTES = 16 * 2**20  #: largest size of a file
MOST_ELEMENTS = 200_000  #: most elements of a file, including the files that it includes
MOST_DEPTH = 200  #: deepest nesting of elements
MOST_LINKS = 1000  #: most links (URDF) or bodies (MJCF) of a robot

_ARTICLE = {"URDF": "a", "MJCF": "an", "SRDF": "an"}


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
