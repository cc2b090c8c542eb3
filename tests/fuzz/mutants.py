"""Structure-aware mutation of our container files: taken apart, changed, and sealed again so that checksums match."""

import hashlib
import io
import json
import struct
import warnings
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
Entries = dict[str, bytes]

TEXTS = (
    *(
        "",
        " ",
        "x" * 3000,
        "a\nb",
        "\x1b[31mred",
        "\u202eevil",
        "\ud800",
        "\udcff\udc00",
        "\x00",
        "é",
        "関節",
        "\ufeff",
    ),
    *(
        "position:xy",
        "inertia",
        "euclidean",
        "custom",
        "constant",
        "Polynomial",
        "linear",
        "disk",
        "torus",
        "prismatic",
    ),
    *("../../etc/passwd", "__import__('os')", "header.json", "theta.npy", "nan", "1e999", "interrupted", "failed"),
)
NUMBERS: tuple[Any, ...] = (
    *(0, 1, -1, 2, 3, 7, 255, 10**6, 10**9, 10**18, 2**63, -(2**63), 10**400, True, False, None),
    *(0.0, -0.0, 0.5, 1e-320, 1e30, -1e30, 1e200, 1e308, -1e308, float("nan"), float("inf"), -float("inf")),
)
OTHERS: tuple[Any, ...] = ([], {}, [[]], [None], [1, "a"], {"a": 1}, {"kind": []}, [[1, 2], [3]], [0] * 300, [[[[1]]]])
KINDS = ("<f8", ">f8", "<f4", "<f2", "<i8", "<i4", "|i1", "|u1", "<u8", "|b1", "<c16", "<U3", "|S4", "<M8[s]", "|V8")
PLACES = (0.0, 1.0, -1.0, 0.5, 1e-9, 1e6, 1e31, 1e300, -1e308, 1e-310, np.nan, np.inf, -np.inf)


def pick(rng: Rng, choices: Any) -> Any:
    """One of several things of any class."""
    return choices[int(rng.integers(len(choices)))]


@cache
def entries_of(path: Path) -> Entries:
    """All entries of a zip file."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def npy(array: Any) -> bytes:
    """As NumPy writes it, also with objects."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def packed(entries: Entries, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip file."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return buffer.getvalue()


def sealed(header: Any, arrays: Entries) -> Entries:
    """Entries with checksums that match, as far as the header is an object."""
    if isinstance(header, dict) and isinstance(header.get("sha256"), dict):
        header = {**header, "sha256": {name: digest(content) for name, content in arrays.items()}}
    text = json.dumps(header).encode()
    return {"header.json": text, "digest.txt": digest(text).encode(), **arrays}


def digest(content: bytes) -> str:
    """Checksum of an entry."""
    return hashlib.sha256(content).hexdigest()


def places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to all values inside plain data; of long lists to a few of them."""
    found = [path]
    if isinstance(data, dict):
        for key, value in data.items():
            if key != "sha256":
                found += places(value, (*path, key))
    elif isinstance(data, list):
        for k in sorted({0, 1, 2, len(data) // 2, len(data) - 1} & set(range(len(data)))):
            found += places(data[k], (*path, k))
    return found


def changed_data(rng: Rng, data: Any) -> Any:
    """The data with one value replaced, removed, doubled or renamed."""
    way = pick(rng, places(data)[1:] or [()])
    return _changed(rng, data, way) if way else pick(rng, OTHERS)


def _changed(rng: Rng, data: Any, way: tuple[Any, ...]) -> Any:
    key, rest = way[0], way[1:]
    copy = dict(data) if isinstance(data, dict) else list(data)
    if rest:
        copy[key] = _changed(rng, data[key], rest)
        return copy
    act = rng.integers(8)
    if act == 0:
        del copy[key]
    elif act == 1 and isinstance(copy, list):
        copy.insert(key, copy[int(rng.integers(len(copy)))])
    elif act == 1:
        copy[pick(rng, TEXTS)] = copy[key]
    elif act == 2 and isinstance(copy[key], list):
        copy[key] = copy[key] * int(pick(rng, (2, 10, 1000))) if rng.integers(2) else copy[key][::-1]
    else:
        copy[key] = changed_value(rng, copy[key])
    return copy


def changed_value(rng: Rng, value: Any) -> Any:
    """Another value, often of the same kind."""
    act = rng.integers(5)
    if act == 0:
        return pick(rng, TEXTS)
    if act == 1:
        return pick(rng, OTHERS)
    if act == 2 and isinstance(value, int | float):
        return value + int(pick(rng, (-1, 1, 2, 100)))
    if act == 3 and isinstance(value, str):
        return value[: len(value) // 2] if rng.integers(2) else value + pick(rng, TEXTS)
    return pick(rng, NUMBERS)


def changed_array(rng: Rng, content: bytes) -> bytes:
    """The bytes of an array with other numbers, another shape or kind, or damage."""
    try:
        array = np.load(io.BytesIO(content))
    except Exception:  # changed before; NumPy raises many kinds
        return content[:-1]
    if array.dtype.kind not in "biufc":
        return flipped(rng, content)
    acts: tuple[Callable[[], bytes], ...] = (
        lambda: npy(_with_entries(rng, array, 1)),
        lambda: npy(_with_entries(rng, array, max(1, array.size))),
        lambda: npy(-array if array.dtype.kind == "f" else array),
        lambda: npy(array.ravel()[:-1].copy()),
        lambda: npy(np.concatenate([array.ravel(), array.ravel()])),
        lambda: npy(array.reshape(pick(rng, ((-1,), (1, -1), (-1, 1), (1, 1, -1))))),
        lambda: npy(np.zeros(pick(rng, ((), (0,), (0, 3), (1,), (3, 0, 3), (10**6,), (1, 1, 1, 1))))),
        lambda: npy(np.zeros(array.shape, dtype=pick(rng, KINDS))),
        lambda: npy(np.asfortranarray(array)),
        lambda: npy(np.array([{"a": 1}, None], dtype=object)),
        lambda: npy(np.zeros(array.shape, dtype=[("a", "<f8"), ("b", "<i4")])),
        lambda: npy(np.array(pick(rng, TEXTS[:5]))),
        lambda: flipped(rng, content),
        lambda: content[: int(rng.integers(len(content) + 1))],
        lambda: content + b"\0" * int(pick(rng, (1, 8, 4096))),
        lambda: _promised(rng, content),
        lambda: npy(array * pick(rng, (1e-3, 1 + 1e-6, 2.0, 1e6, 1e20)) if array.dtype.kind == "f" else array),
    )
    with np.errstate(all="ignore"):
        return acts[int(rng.integers(len(acts)))]()


def _with_entries(rng: Rng, array: Any, count: int) -> Any:
    flat = np.array(array, dtype=float).ravel()
    if flat.size:
        flat[rng.integers(flat.size, size=count)] = pick(rng, PLACES)
    return flat.reshape(array.shape)


def _promised(rng: Rng, content: bytes) -> bytes:
    """An array whose header promises another shape, or holds an expression."""
    size = struct.unpack("<H", content[8:10])[0]
    header = content[10 : 10 + size].decode("latin1")
    shape = pick(
        rng, ("(99999999999,)", "(-1,)", "(3, 99999999)", "(1e3,)", "(" * 300, "(True,)", f"({'1, ' * 70})", "(2**40,)")
    )
    start = header.index("'shape': ")
    text = (header[:start] + f"'shape': {shape}, }}").ljust(size - 1) + "\n"
    return content[:8] + struct.pack("<H", len(text)) + text.encode("latin1") + content[10 + size :]


def flipped(rng: Rng, content: bytes) -> bytes:
    """Some bytes changed."""
    broken = bytearray(content or b"?")
    for place in rng.integers(len(broken), size=int(pick(rng, (1, 1, 2, 8, 64)))):
        broken[place] = int(rng.integers(256))
    return bytes(broken)


def with_tricks(rng: Rng, entries: Entries) -> bytes:
    """A zip file with tricks of its own: entries twice, bombs, lies about sizes, odd methods, damage."""
    content = packed(entries)
    acts: tuple[Callable[[], bytes], ...] = (
        lambda: packed(entries, zipfile.ZIP_STORED),
        lambda: packed(entries, zipfile.ZIP_BZIP2),
        lambda: packed(entries, zipfile.ZIP_LZMA),
        lambda: _with_double(rng, entries),
        lambda: packed({**entries, pick(rng, ("bomb", "extra.npy", "a/../b", "é", "x" * 60000)): b"\0" * 2**24}),
        lambda: _patched(rng, content, b"PK\x01\x02", 24, struct.pack("<I", 0xF0000000)),
        lambda: _patched(rng, content, b"PK\x01\x02", 24, struct.pack("<I", int(rng.integers(2**20)))),
        lambda: _patched(rng, content, b"PK\x01\x02", 20, struct.pack("<I", int(rng.integers(2**32)))),
        lambda: _patched(rng, content, b"PK\x01\x02", 42, struct.pack("<I", int(rng.integers(2**32)))),
        lambda: _patched(
            rng, content, b"PK\x01\x02", 10, struct.pack("<H", int(pick(rng, (0, 8, 9, 12, 14, 93, 98, 999))))
        ),
        lambda: _patched(
            rng, content, b"PK\x01\x02", 8, struct.pack("<H", int(pick(rng, (1, 8, 0x20, 0x40, 0x800, 0xFFFF))))
        ),
        lambda: _patched(
            rng, content, b"PK\x03\x04", 6, struct.pack("<H", int(pick(rng, (1, 8, 0x41, 0x800, 0xFFFF))))
        ),
        lambda: _patched(rng, content, b"PK\x05\x06", 8, struct.pack("<HH", *rng.integers(2**16, size=2).tolist())),
        lambda: _patched(rng, content, b"PK\x05\x06", 12, struct.pack("<II", *rng.integers(2**32, size=2).tolist())),
        lambda: _patched(rng, content, b"PK\x01\x02", 28, struct.pack("<HHH", *rng.integers(2**16, size=3).tolist())),
        lambda: b"junk" * int(rng.integers(1, 5000)) + content,
        lambda: content + flipped(rng, content),
        lambda: content[: int(rng.integers(len(content)))],
        lambda: flipped(rng, content),
        lambda: pick(rng, (b"", b"PK", b"PK\x05\x06" + b"\0" * 18, b"not a zip", b"\x93NUMPY", b"{}", bytes(5000))),
    )
    return acts[int(rng.integers(len(acts)))]()


def _with_double(rng: Rng, entries: Entries) -> bytes:
    """One entry twice, with other contents."""
    buffer = io.BytesIO(packed(entries))
    name = pick(rng, list(entries))
    with zipfile.ZipFile(buffer, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that is the point
        archive.writestr(name, flipped(rng, entries[name]))
    return buffer.getvalue()


def _patched(rng: Rng, content: bytes, mark: bytes, offset: int, value: bytes) -> bytes:
    """Another value in a zip structure of one of the entries."""
    starts = [k for k in range(len(content)) if content.startswith(mark, k)]
    at = pick(rng, starts) + offset
    return content[:at] + value + content[at + len(value) :]


def bombed(entries: Entries, name: str, size: int) -> bytes:
    """The file with an entry of so many zeros, deflated piece by piece."""
    buffer = io.BytesIO(packed({key: value for key, value in entries.items() if key != name}))
    with (
        zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open(name, "w", force_zip64=True) as out,
    ):
        for _ in range(size // 2**20):
            out.write(bytes(2**20))
    return buffer.getvalue()
