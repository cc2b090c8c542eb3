"""Files that appear whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from orthocas.errors import ArchiveError, InvalidValueError


@contextmanager
def published(folder: Path) -> Iterator[Path]:
    """A draft folder. Its files move to `folder` when the block ends, and are deleted if the block raises.

    Each file appears whole or not at all: its content is on disk before its name is. Files of the same name are
    replaced.
    """
    with tempfile.TemporaryDirectory(dir=folder, prefix=".orthocas-") as name:
        drafts = Path(name)
        yield drafts
        files = sorted(drafts.iterdir())
        for file in files:
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
        for file in files:
            os.replace(file, folder / file.name)


def require_writable(path: Path, error_type: type[ArchiveError] = ArchiveError) -> None:
    """Check that a file can be written, before a long computation starts.

    Raises:
        ArchiveError: if the folder is missing or read-only, or the path exists and is not a writable file.
    """
    try:
        if not path.parent.is_dir():
            raise error_type(f"cannot write {path}: folder {path.parent} does not exist")
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
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InvalidValueError(name, str(folder), f"a folder that can be written ({error.strerror})") from None
    return folder
