"""Folders for drafts that go away: at the end of a block, or, after their process was killed, before the next one."""

import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from orthocas.casadi_tools.interrupts import deferred
from orthocas.errors import ArchiveError

_HOST = re.sub(r"[^A-Za-z0-9]", "", socket.gethostname())[:32] or "host"  # a process id means nothing elsewhere
_NAME = re.compile(r"\.?orthocas-(?P<host>[A-Za-z0-9]+)-(?P<process>\d+)-\w+")


@contextmanager
def draft_folder(parent: Path | None = None) -> Iterator[Path]:
    """A hidden folder in `parent`, or one where the system keeps temporary files, for the time of the block.

    Its name holds host and process id. Those that processes left which no longer run are removed first.
    """
    place = Path(tempfile.gettempdir()) if parent is None else parent
    sweep(place)
    prefix = f"{'' if parent is None else '.'}orthocas-{_HOST}-{os.getpid()}-"
    folder: str | None = None
    try:
        with deferred():  # Ctrl-C between the folder and its name would leave it
            folder = tempfile.mkdtemp(dir=place, prefix=prefix)
        yield Path(folder)
    finally:
        if folder is not None:
            with deferred():  # and here half of it
                shutil.rmtree(folder, ignore_errors=True)


def write_temporary(file: Path, content: bytes) -> None:
    """Write a file in a draft folder.

    Raises:
        ArchiveError: if it cannot be written, for example because the disk for temporary files is full.
    """
    try:
        file.write_bytes(content)
    except OSError as error:
        raise ArchiveError(f"cannot write the temporary file {file}: {error.strerror}") from None


def sweep(folder: Path) -> None:
    """Remove the drafts of processes of this machine that no longer run."""
    with suppress(OSError):  # a folder that cannot be listed or changed fails elsewhere, with a message
        for entry in list(os.scandir(folder)):
            if _is_left(entry.name) and entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)


def _is_left(name: str) -> bool:
    parts = _NAME.fullmatch(name)
    return parts is not None and parts["host"] == _HOST and not _runs(int(parts["process"]))


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it is another user's
        return True
    return True
