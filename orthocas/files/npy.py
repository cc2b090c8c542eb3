"""Arrays of numbers as the bytes of `.npy` files. Reading allocates what is there, not what a header promises."""

import io
import re
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

Stored = NDArray[Any]  #: an array in a file, of floats or integers

_MOST_AXES = 32
_LAST_CHARACTER = 0x10FFFF
_SURROGATES = 0xD800 >> 11  # halves of characters, which cannot be written
_START = b"\x93NUMPY\x01\x00"
_HEADER = re.compile(
    rb"\{'descr': '([<>|][biuf][1248]|[<>]U\d{1,8})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,18}, ?)*(?:\d{1,18})?)\), \} *\n"
)


def to_npy(array: Stored) -> bytes:
    """An array as `np.save` writes it."""
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def from_npy(content: bytes) -> Stored:
    """The array that `np.save` wrote: numbers, bools or text, no objects.

    Raises:
        ValueError: if the bytes are anything else.
    """
    begin = len(_START) + 2
    body = begin + int.from_bytes(content[len(_START) : begin], "little")
    found = _HEADER.fullmatch(content[begin:body])
    if not content.startswith(_START) or found is None:
        raise ValueError("no array of numbers")
    try:
        kind = np.dtype(found[1].decode())
    except TypeError:
        raise ValueError(f"unknown kind of numbers {found[1].decode()}") from None
    shape = tuple(int(part) for part in found[3].split(b",") if part.strip())
    if len(shape) > _MOST_AXES or prod(shape) * kind.itemsize != len(content) - body:
        raise ValueError(f"{len(content) - body} bytes for the shape {shape[:5]}")
    if kind.kind == "U":
        _require_characters(np.frombuffer(content, f"{kind.byteorder}u4", offset=body))
    flat = np.frombuffer(content, kind, prod(shape), body)
    return flat.reshape(shape, order="F" if found[2] == b"True" else "C").copy()


def _require_characters(codes: Stored) -> None:
    """Raise ValueError unless all are characters. Python fails on others only when the text is used."""
    if ((codes > _LAST_CHARACTER) | (codes >> 11 == _SURROGATES)).any():
        raise ValueError("text with invalid characters")
