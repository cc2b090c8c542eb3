"""Which files orthocas wrote: only those are replaced without being told to.

A folder of pictures and tables has a list of what was written there, `.orthocas.json`, with checksums. Charts, runs and
generated C are known by what is in them. Symbolic links are never replaced, nor is what they point to.
"""

import hashlib
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path

from orthocas.errors import ArchiveError

LIST = ".orthocas.json"
_LONGEST_HEADER = 2**26  # bytes; of charts with thousands of terms on tape


def require_replaceable(path: Path, ours: bool, force: bool, error: type[ArchiveError] = ArchiveError) -> None:
    """Refuse to replace what somebody else wrote.

    Args:
        path: what is to be written.
        ours: whether a file there is known as one that orthocas wrote.
        force: replace it anyway.
        error: class of the error.

    Raises:
        ArchiveError: if the file is neither ours nor empty, or a symbolic link.
    """
    if path.is_symlink():
        raise error(f"cannot write {path}: it is a symbolic link, expected a file name that is free or a file")
    if path.is_file() and not (ours or force) and path.stat().st_size > 0:
        raise error(
            f"cannot write {path}: orthocas did not write the file that is there, or it was changed; "
            "expected another name, or force (--force) to replace it"
        )


def is_archive(path: Path, format_name: str) -> bool:
    """Whether a file is an archive of ours with a format, such as 'orthocas-chart', damaged or not."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("header.json") as header:
            return bool(json.loads(header.read(_LONGEST_HEADER))["format"] == format_name)
    except Exception:  # zipfile, its decompressors and json raise many kinds; a file that is not read is not ours
        return False


def is_numpy_archive(path: Path, names: Iterable[str]) -> bool:
    """Whether a file is an NPZ file with these arrays."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in names} <= set(archive.namelist())
    except Exception:  # as above
        return False


def is_listed(path: Path) -> bool:
    """Whether the list of its folder has a file, as it is now."""
    try:
        return path.is_file() and digest(path) in read_list(path.parent).get(path.name, [])
    except OSError:
        return False


def read_list(folder: Path) -> dict[str, list[str]]:
    """Names of files that were written to a folder, and the checksums that each may have."""
    try:
        found = json.loads((folder / LIST).read_text(encoding="utf-8"))["files"]
        return {str(name): [str(entry) for entry in entries] for name, entries in found.items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return {}


def list_text(folder: Path, drafts: Iterable[Path]) -> str:
    """The list of a folder once these drafts are there; what they replace stays known, should that never happen."""
    known = read_list(folder)
    for draft in drafts:
        now = folder / draft.name
        known[draft.name] = [digest(file) for file in (now, draft) if file.is_file()]
    return json.dumps({"format": "orthocas-list", "files": known}, indent=1) + "\n"


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
