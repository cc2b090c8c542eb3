"""The container of chart files: a zip of a JSON header, `.npy` arrays and checksums."""

import errno
import hashlib
import io
import json
import lzma
import os
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocas.errors import ArchiveError
from orthocas.tools.files import is_archive, publish, refuse_xml, require_replaceable, require_writable
from orthocas.tools.json import read_strict_json


@dataclass(frozen=True, slots=True)
class ArchiveRules:
    """Bounds of archives, so that no file fills the memory."""

    axes: int = 32  #: of an array
    small: int = 2**23  #: bytes that any file may unpack to
    ratio: int = 100  #: numbers in use hardly shrink; whoever packs zeros could fill the memory
    entries: int = 10_000
    last_character: int = 0x10FFFF  #: of Unicode
    surrogates: int = 0xD800 >> 11  #: first bits of halves of characters, which cannot be written
    encrypted: int = 1  #: flag bit of an entry


RULES = ArchiveRules()
_START = b"\x93NUMPY\x01\x00"
_NPY_HEADER = re.compile(
    rb"\{'descr': '([<>|][biuf][1248]|[<>]U\d{1,8})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,18}, ?)*(?:\d{1,18})?)\), \} *\n"
)
#: what zipfile raises on damaged files
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError, RuntimeError, MemoryError),
    *(NotImplementedError, LookupError, TypeError, ValueError, OverflowError, AttributeError),
)
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_HEADER, _DIGEST = "header.json", "digest.txt"

Stored = NDArray[Any]  #: an array in a file, of floats or integers


@dataclass(frozen=True)
class Kind:
    """A kind of file, and the error that its readers and writers raise."""

    name: str  #: such as 'chart'
    version: int  #: newest format version
    error: type[ArchiveError]

    @property
    def format(self) -> str:
        """Name of the format in the header."""
        return f"orthocas-{self.name}"


def write_archive(
    path: str | Path, kind: Kind, header: Mapping[str, Any], arrays: Mapping[str, Stored], force: bool = False
) -> None:
    """Write header and arrays to a file that appears whole or not at all.

    Raises:
        ArchiveError: if the folder is missing or not writable, the header holds NaN or infinity, or there is another
            kind of file (unless `force`) or a symbolic link. The error is `kind.error`.
    """
    target = Path(path)
    require_free(target, kind, force)
    # The header lists the checksum of every array, and has one of its own.
    entries = {f"{name}.npy": write_npy(array) for name, array in arrays.items()}
    full = {
        "format": kind.format,
        "version": kind.version,
        **header,
        "sha256": {k: _compute_digest(v) for k, v in entries.items()},
    }
    try:
        text = json.dumps(full, indent=1, allow_nan=False).encode()
    except ValueError:
        raise kind.error(f"cannot write {target}: its header would hold NaN or infinity") from None
    entries = {_HEADER: text, _DIGEST: _compute_digest(text).encode(), **entries}
    try:
        # The file is written beside its place, and moved there whole.
        with (
            publish(target.parent) as drafts,
            zipfile.ZipFile(drafts / target.name, "w", zipfile.ZIP_DEFLATED) as draft,
        ):
            for name, content in entries.items():
                draft.writestr(zipfile.ZipInfo(name), content)
    except OSError as error:
        raise kind.error(f"cannot write {target}: {error.strerror}") from None


def require_free(path: Path, kind: Kind, force: bool) -> None:
    """Check early, before long work, that a file can be written and replaces none but one of its kind.

    Raises:
        ArchiveError: the kind's own, if it cannot, or would.
    """
    require_writable(path, kind.error)
    require_replaceable(path, is_archive(path, kind.format), force, kind.error)


def read_archive(path: str | Path, kind: Kind) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Read header and arrays back; entries that the header does not list are left alone.

    Raises:
        ArchiveError: if the file is missing, truncated, edited, of another format, or from a newer version. The error
            is `kind.error`.
    """
    source = Path(path)
    with open_archive(source, kind.name, kind.error) as zipped:
        # Nothing is believed before format, version and checksum are right.
        text = zipped.read(_HEADER)
        header = _check_header(source, kind, text)
        if (
            zipped.sizes.get(_DIGEST) != len(_compute_digest(b""))
            or zipped.read(_DIGEST) != _compute_digest(text).encode()
        ):
            raise kind.error(f"{source} has been edited: its header does not match its checksum")
        # Each entry must match its checksum, too.
        zipped.require_room(list(header["sha256"]))
        arrays: dict[str, Stored] = {}
        for name, digest in header["sha256"].items():
            content = zipped.read(name)
            if _compute_digest(content) != digest:
                raise kind.error(f"{source} has been edited: entry {name} does not match its checksum")
            try:
                arrays[name.removesuffix(".npy")] = read_npy(content)
            except ValueError as error:
                raise kind.error(f"{source} contains an array that cannot be read: {name}, {error}") from None
    return header, arrays


def _check_header(source: Path, kind: Kind, text: bytes) -> dict[str, Any]:
    """Check format and version before anything else is believed."""
    try:
        header = read_strict_json(text)
    except ValueError as error:
        raise kind.error(f"{source} is not an orthocas {kind.name} file: {error}") from None
    sums = header.get("sha256") if isinstance(header, dict) else None
    if not isinstance(sums, dict) or not {"format", "version"} <= header.keys():
        raise kind.error(f"{source} is not an orthocas {kind.name} file")
    # One of our files: of which kind, and not from a later version.
    name, version = header["format"], header["version"]
    if name != kind.format:
        hint = "; arms open with oc.Arm.load and orthocas solve" if name == "orthocas-arm" else ""
        raise kind.error(f"{source} has format '{name}', expected '{kind.format}'{hint}")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise kind.error(f"{source} has format version {version}, expected 1 to {kind.version}")
    if version > kind.version:
        raise kind.error(f"{source} has format version {version}, this orthocas reads up to {kind.version}: upgrade")
    return dict(header)


def _compute_digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


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
        if entry.compress_type not in _PACKINGS or entry.flag_bits & RULES.encrypted:
            raise self.error(f"entry {name} of {self.source} is encrypted or packed otherwise than stored or deflated")
        try:
            with self.archive.open(entry) as stream:
                # Without a number, `read` would unpack all there is.
                content = stream.read(entry.file_size + 1)
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
                f"{RULES.ratio} times the size of the file, or {RULES.small / 2**20:.0f} MiB"
            )


@contextmanager
def open_archive(source: Path, what: str, error: type[ArchiveError]) -> Iterator[Unpacker]:
    """Open a zip file; `what` names it in errors, for example 'chart'.

    Raises:
        ArchiveError: the one given, if the file is missing, cannot be read, is no zip file, or has an entry twice.
    """
    try:
        # Devices and pipes may never end, or never begin.
        if not source.is_dir() and not stat.S_ISREG(source.stat().st_mode):
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
            refuse_xml(source, f"a {what} file", error)
            raise error(f"{source} is truncated, damaged or not a {what} file") from None
        sizes = {entry.filename: entry.file_size for entry in entries}
        if len(sizes) < len(entries) or len(entries) > RULES.entries:
            raise error(f"{source} has {len(entries)} entries, {len(sizes)} of them different: not a {what} file")
        most = max(RULES.small, RULES.ratio * os.fstat(stream.fileno()).st_size)
        yield Unpacker(source, what, error, archive, sizes, most)


def write_npy(array: Stored) -> bytes:
    """An array as `np.save` writes it."""
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def read_npy(content: bytes) -> Stored:
    """The array that `np.save` wrote: numbers, bools or text, no objects.

    Raises:
        ValueError: if the bytes are anything else.
    """
    begin = len(_START) + 2
    body = begin + int.from_bytes(content[len(_START) : begin], "little")
    fields = _NPY_HEADER.fullmatch(content[begin:body])
    if not content.startswith(_START) or fields is None:
        raise ValueError("no array of numbers")
    try:
        kind = np.dtype(fields[1].decode())
    except TypeError:
        raise ValueError(f"unknown kind of numbers {fields[1].decode()}") from None
    shape = tuple(int(part) for part in fields[3].split(b",") if part.strip())
    if len(shape) > RULES.axes or prod(shape) * kind.itemsize != len(content) - body:
        raise ValueError(f"{len(content) - body} bytes for the shape {shape[:5]}")
    if kind.kind == "U":
        # Python fails on numbers that are no characters only when the text is used.
        codes = np.frombuffer(content, f"{kind.byteorder}u4", offset=body)
        if ((codes > RULES.last_character) | (codes >> 11 == RULES.surrogates)).any():
            raise ValueError("text with invalid characters")
    flat = np.frombuffer(content, kind, prod(shape), body)
    return flat.reshape(shape, order="F" if fields[2] == b"True" else "C").copy()
