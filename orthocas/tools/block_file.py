"""Files that grow: a sealed header, then blocks that are appended as results come in. A process may die at any time.

    16 bytes   magic, with the version
     8 bytes   length of the header
    32 bytes   SHA-256 of the header
    header     JSON, filled with blanks to a multiple of 8 bytes
    blocks     4 bytes tag, 4 bytes CRC-32 of the payload's head, 8 bytes length of head, 8 bytes length of body,
               4 bytes CRC-32 of these 24 bytes (not in files of version 1), then head and body

The head of a payload is read and checked when the file is opened, its body later and by parts. A file that ends within
its last block was cut off, by a process that died or otherwise: a writer moves that rest to FILE.rest and goes on. A
block whose header is damaged says nothing of what follows it: such a file is refused, and nothing in it is changed.
"""

import hashlib
import json
import logging
import os
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO

from orthocas.errors import ArchiveError
from orthocas.tools.files import published, refuse_xml, require_replaceable, require_writable
from orthocas.tools.json import from_strict_json

try:
    import fcntl
except ImportError:  # Windows: nothing keeps a second process away there
    fcntl = None  # type: ignore[assignment]

_PREFIX = struct.Struct("<16sQ32s")
_BLOCK = struct.Struct("<4sIQQ")
_CHECK = struct.Struct("<I")  # of a block's header, from version 2 on
_CHECKED_SINCE = 2
_LONGEST_HEADER = 2**26  # bytes
_PIECE = 2**20  # bytes that are searched at once
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BlockKind:
    """A kind of such files."""

    name: str  #: for errors, for example 'atlas'
    magic: bytes  #: 15 bytes; the version follows
    version: int  #: of new files
    tags: tuple[bytes, ...]  #: of its blocks
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
    block = _BLOCK.pack(tag, zlib.crc32(head), len(head), len(body))
    try:
        with path.open("r+b") as stream:
            if stream.read(_PREFIX.size)[len(kind.magic)] >= _CHECKED_SINCE:  # old files keep their version
                block += _CHECK.pack(zlib.crc32(block))
            stream.seek(0, os.SEEK_END)
            stream.write(block + head + body)
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise kind.error(f"cannot write {path}: {error.strerror}") from None


@contextmanager
def owned(path: Path, kind: BlockKind) -> Iterator[None]:
    """Be the only process that appends to a file. The system ends this with the process, however it dies.

    Raises:
        ArchiveError: the kind's own, if another process uses the file, or it cannot be opened.
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


def set_rest_aside(path: Path, contents: Contents, kind: BlockKind) -> None:
    """Move what a process that died left of a block at the end to FILE.rest, or FILE.rest2, ..., and log it.

    Raises:
        ArchiveError: the kind's own, if that fails. Then the file is as it was.
    """
    if contents.end == contents.size:
        return
    names = (path.with_name(f"{path.name}.rest{k if k > 1 else ''}") for k in count(1))
    kept = next(name for name in names if not os.path.lexists(name))
    try:
        with path.open("r+b") as stream:
            stream.seek(contents.end)
            with published(path.parent) as drafts:
                (drafts / kept.name).write_bytes(stream.read())
            stream.truncate(contents.end)
            os.fsync(stream.fileno())
    except OSError as error:
        raise kind.error(f"cannot write {path}: {error.strerror}") from None
    _log.warning("%s ends within a block: %d bytes moved to %s", path, contents.size - contents.end, kept)


def scan(path: Path, kind: BlockKind) -> Contents:
    """Header and heads of all whole blocks.

    Raises:
        ArchiveError: the kind's own, if the file is missing, of another kind, from a newer version, or damaged in
            another way than that its last block was cut off.
    """
    if not path.is_file():
        raise kind.error(f"{kind.name} file {path} does not exist" if not path.exists() else f"{path} is no file")
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            header, digest, start, version = _header(path, stream.read(_PREFIX.size), stream, kind)
            blocks, end = _blocks(path, _Blocks(stream, size, version, kind), start)
    except OSError as error:
        raise kind.error(f"cannot read {kind.name} file {path}: {error.strerror}") from None
    return Contents(header, digest, blocks, end, size)


def _header(path: Path, prefix: bytes, stream: Any, kind: BlockKind) -> tuple[dict[str, Any], bytes, int, int]:
    if len(prefix) < _PREFIX.size or not prefix.startswith(kind.magic):
        refuse_xml(path, f"an orthocas {kind.name} file", kind.error)
        raise kind.error(f"{path} is truncated, damaged or not an orthocas {kind.name} file")
    magic, length, digest = _PREFIX.unpack(prefix)
    if magic[-1] < 1:
        raise kind.error(f"{path} has format version {magic[-1]}, expected 1 to {kind.version}")
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
    return header, digest, _PREFIX.size + length, magic[-1]


@dataclass(frozen=True)
class _Blocks:
    """Reads single blocks of an open file."""

    stream: BinaryIO
    size: int  #: of the file
    version: int
    kind: BlockKind

    @property
    def header_size(self) -> int:
        """Bytes of a block's header."""
        return _BLOCK.size + (_CHECK.size if self.version >= _CHECKED_SINCE else 0)

    def at(self, place: int) -> Block | None:
        """The block there; None unless its header can be believed, and it has a known tag and a sound head."""
        self.stream.seek(place)
        content = self.stream.read(self.header_size)
        header, check = content[: _BLOCK.size], content[_BLOCK.size :]
        if len(content) < self.header_size or check not in (b"", _CHECK.pack(zlib.crc32(header))):
            return None
        tag, head_check, head_length, length = _BLOCK.unpack(header)
        begin = place + self.header_size
        head = self.stream.read(min(head_length, self.size - begin))
        if tag not in self.kind.tags or (begin + head_length <= self.size and zlib.crc32(head) != head_check):
            return None
        return Block(tag, head, begin + head_length, length)

    def is_whole(self, block: Block | None) -> bool:
        """Whether there is a block that does not end after the file."""
        return block is not None and block.body + block.length <= self.size

    def follows(self, place: int) -> bool:
        """Whether a whole block begins anywhere after a place."""
        tags, longest = re.compile(b"|".join(map(re.escape, self.kind.tags))), max(map(len, self.kind.tags))
        for start in range(place + 1, self.size, _PIECE):
            self.stream.seek(start)
            piece = self.stream.read(_PIECE + longest - 1)
            if any(self.is_whole(self.at(start + tag.start())) for tag in tags.finditer(piece)):
                return True
        return False


def _blocks(path: Path, blocks: _Blocks, start: int) -> tuple[tuple[Block, ...], int]:
    """All whole blocks, and where the last one ends.

    Raises:
        ArchiveError: the kind's own, unless what comes after the last whole block is the beginning of one more.
    """
    found, end = [], start
    while end + blocks.header_size <= blocks.size:
        block = blocks.at(end)
        if block is None or (not blocks.is_whole(block) and blocks.follows(end)):
            raise blocks.kind.error(
                f"{path} is damaged: the block at byte {end} does not match its checksums; the {end} bytes before it "
                f"are whole, and a file of them alone can be used"
            )
        if not blocks.is_whole(block):
            break
        found.append(block)
        end = block.body + block.length
    return tuple(found), end
