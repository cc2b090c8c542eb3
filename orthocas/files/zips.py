"""Zip files from anywhere: only the entries asked for are unpacked, and never much more than the file holds."""

import errno
import lzma
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from orthocas.errors import ArchiveError

_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError, RuntimeError, MemoryError),
    *(NotImplementedError, LookupError, TypeError, ValueError, OverflowError, AttributeError),
)  # what zipfile raises on damaged files
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1  # flag bit
_SMALL = 2**23  # bytes that any file may unpack to
_RATIO = 100  # numbers in use hardly shrink; whoever packs zeros could fill the memory
_MOST_ENTRIES = 10_000


@dataclass(frozen=True, eq=False)
class Unpacker:
    """Entries of one zip file by name."""

    source: Path
    what: str  #: for errors, for example 'chart'
    error: type[ArchiveError]
    archive: zipfile.ZipFile
    sizes: dict[str, int]  #: bytes of each entry, as the file states them
    most: int  #: bytes that may be unpacked at once

    def read(self, name: str) -> bytes:
        """The bytes of an entry.

        Raises:
            ArchiveError: the file's own, if the entry is damaged, packed in an unusual way or too large.
        """
        self.require_room([name])
        entry = self.archive.getinfo(name)
        if entry.compress_type not in _PACKINGS or entry.flag_bits & _ENCRYPTED:
            raise self.error(f"entry {name} of {self.source} is encrypted or packed otherwise than stored or deflated")
        try:
            with self.archive.open(entry) as stream:
                content = stream.read(entry.file_size + 1)  # read() without a number would unpack all there is
        except _DAMAGE:
            raise self.error(f"entry {name} of {self.source} is truncated or damaged") from None
        if len(content) != entry.file_size:
            raise self.error(f"entry {name} of {self.source} has {len(content)} bytes, expected {entry.file_size}")
        return content

    def require_room(self, names: list[str]) -> None:
        """Raise the file's error unless all these entries exist and together unpack to a sensible size."""
        for name in names:
            if name not in self.sizes:
                raise self.error(f"{self.source} is not a {self.what} file: it has no entry {name}")
        size = sum(self.sizes[name] for name in names)
        if size > self.most:
            raise self.error(
                f"{self.source} unpacks to {size / 2**20:.0f} MiB, expected at most {self.most / 2**20:.0f} MiB: "
                f"{_RATIO} times the size of the file, or {_SMALL / 2**20:.0f} MiB"
            )


@contextmanager
def unpacking(source: Path, what: str, error: type[ArchiveError]) -> Iterator[Unpacker]:
    """Open a zip file; `what` names it in errors, for example 'chart'.

    Raises:
        ArchiveError: the one given, if the file is missing, cannot be read, is no zip file, or has an entry twice.
    """
    try:
        if not source.is_dir() and not stat.S_ISREG(source.stat().st_mode):  # some never end, some never begin
            raise OSError(errno.EINVAL, "it is a device or a pipe")
        stream = source.open("rb")
    except FileNotFoundError:
        raise error(f"{what} file {source} does not exist") from None
    except (OSError, ValueError) as reason:
        text = reason.strerror if isinstance(reason, OSError) else reason
        raise error(f"cannot read {what} file {source}: {text}") from None
    with stream:
        try:
            archive = zipfile.ZipFile(stream)
            entries = archive.infolist()
        except _DAMAGE:
            raise error(f"{source} is truncated, damaged or not a {what} file") from None
        sizes = {entry.filename: entry.file_size for entry in entries}
        if len(sizes) < len(entries) or len(entries) > _MOST_ENTRIES:
            raise error(f"{source} has {len(entries)} entries, {len(sizes)} of them different: not a {what} file")
        most = max(_SMALL, _RATIO * os.fstat(stream.fileno()).st_size)
        yield Unpacker(source, what, error, archive, sizes, most)
