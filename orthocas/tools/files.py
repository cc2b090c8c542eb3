"""Files that appear complete or not at all, protection of users' files, and tables of numbers."""

import csv
import errno
import hashlib
import io
import json
import os
import re
import shutil
import socket
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocas.errors import ArchiveError, InvalidValueError, PathFileError
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred

LIST = ".orthocas.json"
#: name of this host, because a process id is meaningless on other hosts
_HOST = re.sub(r"[^A-Za-z0-9]", "", socket.gethostname())[:32] or "host"
_NAME = re.compile(r"\.?orthocas-(?P<host>[A-Za-z0-9]+)-(?P<process>\d+)-\w+")
_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)


@dataclass(frozen=True, slots=True)
class FileRules:
    """Limits for reading files."""

    header: int = 2**26  #: largest header of an archive [bytes]; charts may have thousands of terms on tape
    table: int = 2**25  #: largest table [bytes]
    largest: float = 1e6  #: largest number in a table; larger ones are mistakes
    cell: int = 60  #: most characters of a cell in an error message


RULES = FileRules()


def require_replaceable(path: Path, ours: bool, force: bool, error: type[ArchiveError] = ArchiveError) -> None:
    """Refuse to replace a file that orthocas did not write.

    Args:
        path: path of the new file.
        ours: whether an existing file is known to come from orthocas.
        force: replace any file.
        error: class of the error.

    Raises:
        ArchiveError: if the existing file is neither ours nor empty, or is a symbolic link.
    """
    if path.is_symlink():
        raise error(f"cannot write {path}: it is a symbolic link, expected a new name or a regular file")
    if path.is_file() and not (ours or force) and path.stat().st_size > 0:
        raise error(
            f"cannot write {path}: orthocas did not write the file that is there, or it was changed; "
            "expected another name, or force (--force) to replace it"
        )


def is_archive(path: Path, format_name: str) -> bool:
    """Whether a file is one of our archives with a format, such as 'orthocas-chart'; it may be damaged."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("header.json") as header:
            return bool(json.loads(header.read(RULES.header))["format"] == format_name)
    # zipfile, its decompressors and json raise many kinds of errors. A file that cannot be read is not ours.
    except Exception:
        return False


def is_numpy_archive(path: Path, names: Iterable[str]) -> bool:
    """Whether a file is an NPZ file with these arrays."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in names} <= set(archive.namelist())
    except Exception:
        return False


def is_listed(path: Path) -> bool:
    """Whether the list of its folder has a file with its present checksum."""
    try:
        return path.is_file() and compute_digest(path) in read_list(path.parent).get(path.name, [])
    except OSError:
        return False


def read_list(folder: Path) -> dict[str, list[str]]:
    """The list of files written to a folder, with their possible checksums."""
    try:
        listed = json.loads((folder / LIST).read_text(encoding="utf-8"))["files"]
        return {str(name): [str(entry) for entry in entries] for name, entries in listed.items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return {}


def write_list(folder: Path, drafts: Iterable[Path]) -> str:
    """The new list of a folder for these drafts; it keeps old checksums in case the drafts never arrive."""
    files = read_list(folder)
    for draft in drafts:
        now = folder / draft.name
        files[draft.name] = [compute_digest(file) for file in (now, draft) if file.is_file()]
    return json.dumps({"format": "orthocas-list", "files": files}, indent=1) + "\n"


def refuse_xml(path: Path, what: str, error: type[ArchiveError]) -> None:
    """Raise an error if a file of another expected kind is XML, because robot files are often mistaken for charts.

    Raises:
        ArchiveError: if the file begins like XML. Its class is `error`.
    """
    with path.open("rb") as stream:
        begin = stream.read(200).removeprefix(b"\xef\xbb\xbf").lstrip()
    if begin.startswith((b"<?xml", b"<robot", b"<mujoco", b"<!--")):
        raise error(f"{path} is an XML file, perhaps of a robot (Robot.from_file), expected {what}")


def compute_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def open_draft_folder(parent: Path | None = None) -> Iterator[Path]:
    """A hidden folder in `parent` or in the system's temporary folder, which exists during this context.

    Its name contains host and process id. Folders of processes that have ended are removed first.
    """
    place = Path(tempfile.gettempdir()) if parent is None else parent
    remove_drafts(place)
    prefix = f"{'' if parent is None else '.'}orthocas-{_HOST}-{os.getpid()}-"
    folder: str | None = None
    try:
        # Ctrl-C must not interrupt between creation and bookkeeping, or during the removal.
        with deferred():
            folder = tempfile.mkdtemp(dir=place, prefix=prefix)
        yield Path(folder)
    finally:
        if folder is not None:
            with deferred():
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


def remove_drafts(folder: Path) -> None:
    """Remove the drafts of processes on this machine that have ended."""
    # A folder that cannot be listed or changed causes an error elsewhere.
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            parts = _NAME.fullmatch(entry.name)
            if parts is None or parts["host"] != _HOST or not entry.is_dir(follow_symlinks=False):
                continue
            try:
                os.kill(int(parts["process"]), 0)
            except (ProcessLookupError, OverflowError):
                shutil.rmtree(entry.path, ignore_errors=True)
            # Other errors mean that the process runs under another user.
            except OSError:
                pass


@contextmanager
def publish(folder: Path, listed: bool = False, force: bool = False) -> Iterator[Path]:
    """A draft folder, whose files move to `folder` at the end of the context; after an exception they are deleted.

    Each file appears complete or not at all, because its content is on disk before it gets its name. It replaces a file
    of the same name.

    Args:
        folder: destination of the files.
        listed: keep a list of written files there, and replace only files on this list (`orthocas.tools.files`).
        force: replace other files too.

    Raises:
        ArchiveError: if `listed` is set and an existing file is not on the list, if the disk is full, or if a symbolic
            link has the name of a file.
    """
    with open_draft_folder(folder) as drafts, _name_full_disk(folder, drafts) if listed else nullcontext():
        yield drafts
        files = sorted(drafts.iterdir())
        for file in files:
            require_replaceable(folder / file.name, not listed or is_listed(folder / file.name), force)
        if listed:
            text = write_list(folder, files)
            # Write the list first. Listed files may then be missing, but no file is ever unlisted.
            files.insert(0, drafts / LIST)
            files[0].write_text(text, encoding="utf-8")
        for file in files:
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
        for file in files:
            os.replace(file, folder / file.name)


@contextmanager
def _name_full_disk(folder: Path, drafts: Path) -> Iterator[None]:
    """Name the file that did not fit on the disk, because libraries that draw and save do not.

    Raises:
        ArchiveError: if the disk or the user's quota is full.
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
    """Check, before long work, that these names are free or belong to files that orthocas wrote.

    Raises:
        ArchiveError: if a name belongs to another file or to a symbolic link.
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
        # Remove drafts of ended processes.
        remove_drafts(path.parent)
        if path.is_dir():
            raise error_type(f"cannot write {path}: it is a folder, expected a file name")
        if path.exists() and not (path.is_file() and os.access(path, os.W_OK)):
            raise error_type(f"cannot write {path}: it is not a writable file")
        # Permissions do not tell everything, so try to create a file.
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise error_type(f"cannot write {str(path)[:200]}: {error.strerror}") from None


def make_folder(name: str, out: str | Path, mode: int = 0o777) -> Path:
    """Create the output folder if needed, with mode `mode` less the umask, and check that it is writable.

    Raises:
        InvalidValueError: if this fails. The message names the argument `name`.
    """
    folder = Path(out)
    try:
        folder.mkdir(mode, parents=True, exist_ok=True)
        remove_drafts(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InvalidValueError(name, str(folder), f"a folder that can be written ({error.strerror})") from None
    return folder


@contextmanager
def open_output_folder(name: str, out: str | Path) -> Iterator[Path]:
    """`make_folder` as a context; at its end, folders that it created are removed if they are empty."""
    folder = Path(out)
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        yield make_folder(name, folder)
    finally:
        for place in new:
            # A folder with files stays.
            with suppress(OSError):
                place.rmdir()


def read_table(
    path: str | Path,
    what: str,
    rows: str,
    most: int,
    columns: Callable[[Sequence[str]], Sequence[int]],
    least: int = 2,
    largest: float = RULES.largest,
) -> Array:
    """Read the chosen columns of a table, in the given order, (N, k). Other columns may hold anything.

    Args:
        path: the file.
        what: kind of file for errors, such as "path file".
        rows: meaning of the rows, such as "waypoints".
        most: largest number of rows.
        columns: maps the names in the header to the indices of the columns; raises ValueError for other headers.
        least: smallest number of rows.
        largest: largest number; larger ones are mistakes.

    Raises:
        PathFileError: names the file, the line and the error.
    """
    # Check the number of rows first, so that a file of another kind gives a clear error.
    lines = _read_lines(Path(path), what)
    if not least <= len(lines) - 1 <= most:
        unnamed = lines and all(_is_number(cell) for cell in lines[0][1])
        first = "its first line, which should name the columns" if unnamed else "the header"
        came = f"it has {max(len(lines) - 1, 0)} {rows} after {first}"
        raise PathFileError(f"{what} {path}: {came}, expected {least} to {most}")
    header = [cell.strip() for cell in lines[0][1]]
    try:
        chosen = list(columns(header))
        return np.array([_parse_row(line, cells, header, chosen, largest) for line, cells in lines[1:]])
    except ValueError as error:
        raise PathFileError(f"{what} {path}: {error}") from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def find_columns(names: Sequence[str], columns: Sequence[str]) -> list[int]:
    """Indices of the given names in a header, for `read_table`. Each name must occur exactly once."""
    for name in columns:
        if name not in names:
            raise ValueError(f"line 1: column {name[: RULES.cell]!r} is missing, expected {', '.join(columns)}")
        if names.count(name) > 1:
            raise ValueError(f"line 1: column {name[: RULES.cell]!r} comes twice")
    return [names.index(name) for name in columns]


def _read_lines(path: Path, what: str) -> list[tuple[int, list[str]]]:
    """Non-empty lines with their numbers."""
    try:
        with path.open("rb") as stream:
            content = stream.read(RULES.table + 1)
        if len(content) > RULES.table:
            raise PathFileError(f"{what} {path}: larger than {RULES.table / 2**20:.0f} MiB")
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except OSError as error:
        raise PathFileError(f"{what} {path}: cannot be read, {error.strerror}") from None
    # ValueError: bytes that are not text.
    except (ValueError, csv.Error) as error:
        raise PathFileError(f"{what} {path}: not CSV text, {str(error)[: RULES.cell]}") from None


def _parse_row(
    line: int, cells: Sequence[str], header: Sequence[str], chosen: Sequence[int], largest: float
) -> list[float]:
    """The numbers of the chosen columns of a line."""
    # Unused columns may hold anything, but must be present.
    if len(cells) != len(header):
        raise ValueError(f"line {line}: {len(cells)} numbers, expected {len(header)} as in the header")
    values = []
    for cell, name in ((cells[k], header[k]) for k in chosen):
        try:
            value = float("nan" if "_" in cell else cell)
        except ValueError:
            value = np.nan
        if not abs(value) <= largest:
            want = f"a number from {-largest:g} to {largest:g}"
            raise ValueError(f"line {line}: {name} is {cell[: RULES.cell]!r}, expected {want}")
        values.append(value)
    return values
