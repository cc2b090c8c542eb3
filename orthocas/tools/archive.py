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
    """Bounds of archives, so that no file can fill the memory."""

    axes: int = 32  #: largest number of axes of an array
    small: int = 2**23  #: bytes that any file may unpack to
    #: largest ratio of unpacked to packed size: real numbers hardly shrink, but zeros could fill the memory
    ratio: int = 100
    entries: int = 10_000
    last_character: int = 0x10FFFF  #: last code point of Unicode
    surrogates: int = 0xD800 >> 11  #: first bits of surrogate halves, which are not valid characters
    encrypted: int = 1  #: flag bit of an encrypted entry


RULES = ArchiveRules()
_START = b"\x93NUMPY\x01\x00"
_NPY_HEADER = re.compile(
    rb"\{'descr': '([<>|][biuf][1248]|[<>]U\d{1,8})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,18}, ?)*(?:\d{1,18})?)\), \} *\n"
)
#: errors that zipfile raises on damaged files
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
    """Write header and arrays to a file that appears complete or not at all.

    Raises:
        ArchiveError: if the folder is missing or not writable, the header holds NaN or infinity, or the path is a
            symbolic link or (without `force`) a file of another kind. The class of the error is `kind.error`.
    """
    target = Path(path)
    require_free(target, kind, force)
    # The header lists the checksums of all arrays, and has a checksum of its own.
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
        # Write a draft, and move it into place when it is complete.
        with (
            publish(target.parent) as drafts,
            zipfile.ZipFile(drafts / target.name, "w", zipfile.ZIP_DEFLATED) as draft,
        ):
            for name, content in entries.items():
                draft.writestr(zipfile.ZipInfo(name), content)
    except OSError as error:
        raise kind.error(f"cannot write {target}: {error.strerror}") from None


def require_free(path: Path, kind: Kind, force: bool) -> None:
    """Check, before long work, that a file can be written, and would replace only a file of its kind.

    Raises:
        ArchiveError: otherwise; the class of the error is `kind.error`.
    """
    require_writable(path, kind.error)
    require_replaceable(path, is_archive(path, kind.format), force, kind.error)


def read_archive(path: str | Path, kind: Kind) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Read header and arrays; entries that the header does not list are ignored.

    Raises:
        ArchiveError: if the file is missing, truncated, edited, of another format, or from a newer version. The class
            of the error is `kind.error`.
    """
    source = Path(path)
    with open_archive(source, kind.name, kind.error) as zipped:
        # Check format, version and checksum before anything is used.
        text = zipped.read(_HEADER)
        header = _check_header(source, kind, text)
        if (
            zipped.sizes.get(_DIGEST) != len(_compute_digest(b""))
            or zipped.read(_DIGEST) != _compute_digest(text).encode()
        ):
            raise kind.error(f"{source} has been edited: its header does not match its checksum")
        # Check the checksum of each entry too.
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
    """Check format and version before the content is used."""
    try:
        header = read_strict_json(text)
    except ValueError as error:
        raise kind.error(f"{source} is not an orthocas {kind.name} file: {error}") from None
    sums = header.get("sha256") if isinstance(header, dict) else None
    if not isinstance(sums, dict) or not {"format", "version"} <= header.keys():
        raise kind.error(f"{source} is not an orthocas {kind.name} file")
    # The file is ours: check its kind and version.
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
    """Reads entries of one zip file by name."""

    source: Path
    what: str  #: kind of file for errors, for example 'chart'
    error: type[ArchiveError]
    archive: zipfile.ZipFile
    sizes: dict[str, int]  #: size of each entry, as the file states it [bytes]
    most: int  #: largest total size to unpack [bytes]

    def read(self, name: str) -> bytes:
        """The bytes of an entry.

        Raises:
            ArchiveError: if the entry is damaged, packed by an unsupported method or too large. Its class is `error`.
        """
        self.require_room([name])
        entry = self.archive.getinfo(name)
        if entry.compress_type not in _PACKINGS or entry.flag_bits & RULES.encrypted:
            raise self.error(f"entry {name} of {self.source} is encrypted or packed otherwise than stored or deflated")
        try:
            with self.archive.open(entry) as stream:
                # Limit the bytes, because otherwise `read` would unpack everything.
                content = stream.read(entry.file_size + 1)
        except _DAMAGE:
            raise self.error(f"entry {name} of {self.source} is truncated or damaged") from None
        if len(content) != entry.file_size:
            raise self.error(f"entry {name} of {self.source} has {len(content)} bytes, expected {entry.file_size}")
        return content

    def require_room(self, names: list[str]) -> None:
        """Raise an error unless all these entries exist and unpack to an acceptable total size."""
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
        ArchiveError: if the file is missing, cannot be read, is not a zip file, or has an entry twice. Its class is
            `error`.
    """
    try:
        # Reading from devices and pipes may never end.
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
    """The array that `np.save` wrote: numbers, bools or text, but no objects.

    Raises:
        ValueError: for any other bytes.
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
        # Python reports invalid code points only when the text is used.
        codes = np.frombuffer(content, f"{kind.byteorder}u4", offset=body)
        if ((codes > RULES.last_character) | (codes >> 11 == RULES.surrogates)).any():
            raise ValueError("text with invalid characters")
    flat = np.frombuffer(content, kind, prod(shape), body)
    return flat.reshape(shape, order="F" if fields[2] == b"True" else "C").copy()
