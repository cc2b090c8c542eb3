"""Self-contained files: one zip with a JSON header and `.npy` arrays. Loading never runs code; writing is atomic."""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocas.errors import ArchiveError
from orthocas.files.atomic import published, require_writable
from orthocas.files.ours import is_archive, require_replaceable

Stored = NDArray[Any]  #: an array in a file, of floats or integers

_HEADER, _DIGEST = "header.json", "digest.txt"
_PACKED = zipfile.ZIP_DEFLATED
_LARGEST_FILE = 2**32  # bytes a file may unpack to


@dataclass(frozen=True)
class Kind:
    """What a file holds, and the error that names it."""

    name: str  #: 'chart' or 'checkpoint'
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
        ArchiveError: the kind's own, if the folder is missing or cannot be written, or there is another kind of file
            (unless `force`) or a symbolic link.
    """
    target = Path(path)
    require_free(target, kind, force)
    entries = {f"{name}.npy": _npy_bytes(array) for name, array in arrays.items()}
    full = {
        "format": kind.format,
        "version": kind.version,
        **header,
        "sha256": {k: _digest(v) for k, v in entries.items()},
    }
    text = json.dumps(full, indent=1).encode()
    entries = {_HEADER: text, _DIGEST: _digest(text).encode(), **entries}
    try:
        with (
            published(target.parent) as drafts,
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
    """Read header and arrays back.

    Raises:
        ArchiveError: the kind's own, if the file is missing, truncated, foreign, edited, or from a newer version.
    """
    source = Path(path)
    try:
        with zipfile.ZipFile(source) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _LARGEST_FILE:
                raise kind.error(
                    f"{source} unpacks to more than {_LARGEST_FILE / 2**30:.0f} GiB, not a {kind.name} file"
                )
            entries = {name: archive.read(name) for name in archive.namelist()}
    except FileNotFoundError:
        raise kind.error(f"{kind.name} file {source} does not exist") from None
    except OSError as error:
        raise kind.error(f"cannot read {kind.name} file {source}: {error.strerror}") from None
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError):
        raise kind.error(f"{source} is truncated, damaged or not a {kind.name} file") from None
    header = _read_header(source, kind, entries)
    for name, digest in header["sha256"].items():
        if name not in entries or _digest(entries[name]) != digest:
            raise kind.error(f"{source} has been edited: entry {name} does not match its checksum")
    try:
        arrays = {
            name.removesuffix(".npy"): np.load(io.BytesIO(entries[name]), allow_pickle=False)
            for name in header["sha256"]
        }
    except (ValueError, EOFError, TokenError):
        raise kind.error(f"{source} holds an array that cannot be read") from None
    return header, arrays


def _read_header(source: Path, kind: Kind, entries: Mapping[str, bytes]) -> dict[str, Any]:
    """Check format, version and checksum before anything else is believed."""
    try:
        header = json.loads(entries[_HEADER])
        name, version, sums = header["format"], int(header["version"]), dict(header["sha256"])
    except (KeyError, ValueError, TypeError, OverflowError, RecursionError):
        raise kind.error(f"{source} is not an orthocas {kind.name} file") from None
    if name != kind.format:
        raise kind.error(f"{source} has format '{name}', expected '{kind.format}'")
    if version < 1:
        raise kind.error(f"{source} has format version {version}, expected 1 to {kind.version}")
    if version > kind.version:
        raise kind.error(f"{source} has format version {version}, this orthocas reads up to {kind.version}: upgrade")
    if entries.get(_DIGEST, b"").decode(errors="replace") != _digest(entries[_HEADER]):
        raise kind.error(f"{source} has been edited: its header does not match its checksum")
    return {**header, "sha256": sums}


def _npy_bytes(array: Stored) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
