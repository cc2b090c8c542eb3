"""Files that grow: a sealed header, then blocks that are appended as results come in. A process may die at any time.

    16 bytes   magic, with the version
     8 bytes   length of the header
    32 bytes   SHA-256 of the header
    header     JSON, filled with blanks to a multiple of 8 bytes
    blocks     4 bytes tag, 4 bytes CRC-32 of the payload's head, 8 bytes lengths of head, 8 bytes length of body

The head of a payload is read and checked when the file is opened, its body later and by parts. A file that ends within
a block was cut off, by a process that died or otherwise; a writer removes that rest and goes on.
"""

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthocas.errors import ArchiveError
from orthocas.files.atomic import published, require_writable
from orthocas.files.json import from_strict_json
from orthocas.files.ours import require_replaceable

try:
    import fcntl
except ImportError:  # Windows: nothing keeps a second process away there
    fcntl = None  # type: ignore[assignment]

_PREFIX = struct.Struct("<16sQ32s")
_BLOCK = struct.Struct("<4sIQQ")
_LONGEST_HEADER = 2**26  # bytes


@dataclass(frozen=True)
class BlockKind:
    """A kind of such files."""

    name: str  #: for errors, for example 'atlas'
    magic: bytes  #: 15 bytes; the version follows
    version: int
    error: type[ArchiveError]


@dataclass(frozen=True)
class Block:
    """Where a block is, with its head."""

    tag: bytes
    head: bytes
    body: int  #: offset of the body in the file
    length: int  #: of the body


@dataclass(frozen=True)
class Contents:
    """What opening a file finds."""

    header: dict[str, Any]
    digest: bytes  #: SHA-256 of the header
    blocks: tuple[Block, ...]
    end: int  #: where the last whole block ends
    size: int  #: of the file


def sealed(header: Mapping[str, Any], kind: BlockKind) -> bytes:
    """The beginning of a file, up to the first block."""
    text = text_of(header)
    magic = kind.magic + bytes([kind.version])
    return _PREFIX.pack(magic, len(text), hashlib.sha256(text).digest()) + text


def text_of(header: Mapping[str, Any]) -> bytes:
    """A header as it is written."""
    text = json.dumps(header, allow_nan=False, sort_keys=True).encode()
    return text + b" " * (-len(text) % 8)


def create(path: Path, header: Mapping[str, Any], kind: BlockKind, force: bool = False) -> None:
    """Write a file without blocks; it appears whole or not at all.

    Raises:
        ArchiveError: the kind's own, if it cannot be written, or something else is there.
    """
    require_writable(path, kind.error)
    require_replaceable(path, begins(path, kind), force, kind.error)
    try:
        with published(path.parent) as drafts:
            (drafts / path.name).write_bytes(sealed(header, kind))
    except OSError as error:
        raise kind.error(f"cannot write {path}: {error.strerror}") from None


def begins(path: Path, kind: BlockKind) -> bool:
    """Whether a file begins as one of this kind, damaged or not."""
    try:
        with path.open("rb") as stream:
            return stream.read(len(kind.magic)) == kind.magic
    except OSError:
        return False


def append(path: Path, tag: bytes, head: bytes, body: bytes, kind: BlockKind) -> None:
    """Add a block at the end, and wait until it is on the disk.

    Raises:
        ArchiveError: the kind's own, if that fails.
    """
    content = _BLOCK.pack(tag, zlib.crc32(head), len(head), len(body)) + head + body
    try:
        with path.open("r+b") as stream:
            stream.seek(0, os.SEEK_END)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise kind.error(f"cannot write {path}: {error.strerror}") from None


@contextmanager
def owned(path: Path, kind: BlockKind) -> Iterator[None]:
    """Be the only process that appends to a file. The system ends this with the process, however it dies.

    Raises:
        ArchiveError: the kind's own, if another process has it, or it cannot be opened.
    """
    try:
        stream = path.open("r+b")
    except OSError as error:
        raise kind.error(f"cannot write {path}: {error.strerror}") from None
    with stream:
        try:
            if fcntl is not None:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise kind.error(f"cannot write {path}: another process is adding to it") from None
        yield


def cut_rest(path: Path, contents: Contents, kind: BlockKind) -> None:
    """Remove what a process that died left of a block at the end."""
    try:
        if contents.end < contents.size:
            os.truncate(path, contents.end)
    except OSError as error:
        raise kind.error(f"cannot write {path}: {error.strerror}") from None


def scan(path: Path, kind: BlockKind) -> Contents:
    """Header and heads of all whole blocks.

    Raises:
        ArchiveError: the kind's own, if the file is missing, of another kind, from a newer version, or damaged before
            its end.
    """
    if not path.is_file():
        raise kind.error(f"{kind.name} file {path} does not exist" if not path.exists() else f"{path} is no file")
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            header, digest, start = _header(path, stream.read(_PREFIX.size), stream, kind)
            blocks, end = _blocks(path, stream, start, size, kind)
    except OSError as error:
        raise kind.error(f"cannot read {kind.name} file {path}: {error.strerror}") from None
    return Contents(header, digest, blocks, end, size)


def _header(path: Path, prefix: bytes, stream: Any, kind: BlockKind) -> tuple[dict[str, Any], bytes, int]:
    if len(prefix) < _PREFIX.size or not prefix.startswith(kind.magic):
        raise kind.error(f"{path} is truncated, damaged or not an orthocas {kind.name} file")
    magic, length, digest = _PREFIX.unpack(prefix)
    if magic[-1] > kind.version:
        raise kind.error(f"{path} has format version {magic[-1]}, this orthocas reads up to {kind.version}: upgrade")
    text = stream.read(length) if length <= _LONGEST_HEADER else b""
    if len(text) < length or hashlib.sha256(text).digest() != digest:
        raise kind.error(f"{path} is truncated or has been edited: its header does not match its checksum")
    try:
        header = from_strict_json(text)
    except ValueError as error:
        raise kind.error(f"{path} is not an orthocas {kind.name} file: {error}") from None
    if not isinstance(header, dict):
        raise kind.error(f"{path} is not an orthocas {kind.name} file")
    return header, digest, _PREFIX.size + length


def _blocks(path: Path, stream: Any, start: int, size: int, kind: BlockKind) -> tuple[tuple[Block, ...], int]:
    found, end = [], start
    while end + _BLOCK.size <= size:
        stream.seek(end)
        tag, check, head_length, body_length = _BLOCK.unpack(stream.read(_BLOCK.size))
        body = end + _BLOCK.size + head_length
        if body + body_length > size:
            break
        head = stream.read(head_length)
        if zlib.crc32(head) != check:
            raise kind.error(f"{path} is damaged: a block at byte {end} does not match its checksum")
        found.append(Block(tag, head, body, body_length))
        end = body + body_length
    return tuple(found), end
