"""Self-contained files: a zip of a JSON header and `.npy` arrays. Loading never runs code, and writing is atomic."""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthocas.errors import ArchiveError
from orthocas.files.atomic import published, require_writable
from orthocas.files.json import from_strict_json
from orthocas.files.npy import Stored, from_npy, to_npy
from orthocas.files.ours import is_archive, require_replaceable
from orthocas.files.zips import Unpacker, unpacking

_HEADER, _DIGEST = "header.json", "digest.txt"


@dataclass(frozen=True)
class Kind:
    """A kind of file, and the error that its readers and writers raise."""

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
        ArchiveError: if the folder is missing or not writable, the header holds NaN or infinity, or there is another
            kind of file (unless `force`) or a symbolic link. The error is `kind.error`.
    """
    target = Path(path)
    require_free(target, kind, force)
    entries = {f"{name}.npy": to_npy(array) for name, array in arrays.items()}
    full = {
        "format": kind.format,
        "version": kind.version,
        **header,
        "sha256": {k: _digest(v) for k, v in entries.items()},
    }
    try:
        text = json.dumps(full, indent=1, allow_nan=False).encode()
    except ValueError:
        raise kind.error(f"cannot write {target}: its header would hold NaN or infinity") from None
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
    """Read header and arrays back; entries that the header does not list are left alone.

    Raises:
        ArchiveError: if the file is missing, truncated, edited, of another format, or from a newer version. The error
            is `kind.error`.
    """
    source = Path(path)
    with unpacking(source, kind.name, kind.error) as zipped:
        text = zipped.read(_HEADER)
        header = _checked_header(source, kind, text)
        if zipped.sizes.get(_DIGEST) != len(_digest(b"")) or zipped.read(_DIGEST) != _digest(text).encode():
            raise kind.error(f"{source} has been edited: its header does not match its checksum")
        zipped.require_room(list(header["sha256"]))
        arrays = {name.removesuffix(".npy"): _array(zipped, name, digest) for name, digest in header["sha256"].items()}
    return header, arrays


def _array(zipped: Unpacker, name: str, digest: str) -> Stored:
    """An entry that matches its checksum, as an array."""
    content = zipped.read(name)
    if _digest(content) != digest:
        raise zipped.error(f"{zipped.source} has been edited: entry {name} does not match its checksum")
    try:
        return from_npy(content)
    except ValueError as error:
        raise zipped.error(f"{zipped.source} contains an array that cannot be read: {name}, {error}") from None


def _checked_header(source: Path, kind: Kind, text: bytes) -> dict[str, Any]:
    """Check format and version before anything else is believed."""
    try:
        header = from_strict_json(text)
    except ValueError as error:
        raise kind.error(f"{source} is not an orthocas {kind.name} file: {error}") from None
    sums = header.get("sha256") if isinstance(header, dict) else None
    if not isinstance(sums, dict) or not {"format", "version"} <= header.keys():
        raise kind.error(f"{source} is not an orthocas {kind.name} file")
    name, version = header["format"], header["version"]
    if name != kind.format:
        raise kind.error(f"{source} has format '{name}', expected '{kind.format}'")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise kind.error(f"{source} has format version {version}, expected 1 to {kind.version}")
    if version > kind.version:
        raise kind.error(f"{source} has format version {version}, this orthocas reads up to {kind.version}: upgrade")
    return dict(header)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
