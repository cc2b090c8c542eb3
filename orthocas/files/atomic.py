"""Files that appear whole or not at all, and replace nothing that orthocas did not write."""

import errno
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from orthocas.errors import ArchiveError, InvalidValueError
from orthocas.files.drafts import draft_folder, sweep
from orthocas.files.ours import LIST, is_listed, list_text, require_replaceable

_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)


@contextmanager
def published(folder: Path, listed: bool = False, force: bool = False) -> Iterator[Path]:
    """A draft folder. Its files move to `folder` when the block ends, and are deleted if the block raises.

    Each file appears whole or not at all: its content is on disk before its name is. Files of the same name are
    replaced.

    Args:
        folder: where the files go.
        listed: keep a list there of what was written, and replace only files on it (`orthocas.files.ours`).
        force: replace others too.

    Raises:
        ArchiveError: if files are listed and one in the way is not, or the disk is full; or if a symbolic link is in
            the way.
    """
    with draft_folder(folder) as drafts, _full_disk_named(folder, drafts) if listed else nullcontext():
        yield drafts
        files = sorted(drafts.iterdir())
        for file in files:
            require_replaceable(folder / file.name, not listed or is_listed(folder / file.name), force)
        if listed:
            text = list_text(folder, files)
            files.insert(0, drafts / LIST)  # first: what it announces may be missing, but nothing that is there unknown
            files[0].write_text(text, encoding="utf-8")
        for file in files:
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
        for file in files:
            os.replace(file, folder / file.name)


@contextmanager
def _full_disk_named(folder: Path, drafts: Path) -> Iterator[None]:
    """Say which file did not fit: libraries that draw and save leave its name out.

    Raises:
        ArchiveError: if the disk, or what the user may write, is full.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        begun = sorted(drafts.iterdir(), key=lambda file: file.stat().st_mtime_ns)
        target = folder / begun[-1].name if begun else folder
        raise ArchiveError(f"cannot write {target}: {error.strerror}") from None


def require_replaceable_files(folder: Path, names: Iterable[str], force: bool) -> None:
    """Check early, before long work, that no file with one of these names is there that orthocas did not write.

    Raises:
        ArchiveError: if there is one, or a symbolic link.
    """
    for name in names:
        require_replaceable(folder / name, is_listed(folder / name), force)


def require_writable(path: Path, error_type: type[ArchiveError] = ArchiveError) -> None:
    """Check that a file can be written, before a long computation starts.

    Raises:
        ArchiveError: if the folder is missing or read-only, or the path exists and is not a writable file.
    """
    try:
        if not path.parent.is_dir():
            raise error_type(f"cannot write {path}: folder {path.parent} does not exist")
        sweep(path.parent)
        if path.is_dir():
            raise error_type(f"cannot write {path}: it is a folder, expected a file name")
        if path.exists() and not (path.is_file() and os.access(path, os.W_OK)):
            raise error_type(f"cannot write {path}: it is not a writable file")
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise error_type(f"cannot write {str(path)[:200]}: {error.strerror}") from None


def made_folder(name: str, out: str | Path) -> Path:
    """Create the output folder if needed, and check that files can be written there.

    Raises:
        InvalidValueError: if they cannot. The message names the argument `name`.
    """
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InvalidValueError(name, str(folder), f"a folder that can be written ({error.strerror})") from None
    return folder


@contextmanager
def output_folder(name: str, out: str | Path) -> Iterator[Path]:
    """`made_folder` for the time of a block; at its end, folders that it made and that stayed empty go away again."""
    folder = Path(out)
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        yield made_folder(name, folder)
    finally:
        for place in new:
            with suppress(OSError):  # it is not empty, as it should be
                place.rmdir()
