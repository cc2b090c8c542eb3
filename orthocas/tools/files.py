"""Files that appear whole or not at all: drafts, replacement, the mark of files of ours; and tables of numbers."""

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
#: a process id means nothing on other hosts
_HOST = re.sub(r"[^A-Za-z0-9]", "", socket.gethostname())[:32] or "host"
_NAME = re.compile(r"\.?orthocas-(?P<host>[A-Za-z0-9]+)-(?P<process>\d+)-\w+")
_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)


@dataclass(frozen=True, slots=True)
class FileRules:
    """Bounds of what is read."""

    header: int = 2**26  #: bytes of the header of an archive; charts may have thousands of terms on tape
    table: int = 2**25  #: bytes of a table
    largest: float = 1e6  #: of the numbers of a table; larger ones are mistakes
    cell: int = 60  #: characters of a cell in an error


RULES = FileRules()


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
            return bool(json.loads(header.read(RULES.header))["format"] == format_name)
    # Zipfile, its decompressors and json raise many kinds; a file that is not read is not ours.
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
    """Whether the list of its folder has a file, as it is now."""
    try:
        return path.is_file() and compute_digest(path) in read_list(path.parent).get(path.name, [])
    except OSError:
        return False


def read_list(folder: Path) -> dict[str, list[str]]:
    """Names of files that were written to a folder, and the checksums that each may have."""
    try:
        listed = json.loads((folder / LIST).read_text(encoding="utf-8"))["files"]
        return {str(name): [str(entry) for entry in entries] for name, entries in listed.items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return {}


def write_list(folder: Path, drafts: Iterable[Path]) -> str:
    """The list of a folder once these drafts are there; what they replace stays known, should that never happen."""
    files = read_list(folder)
    for draft in drafts:
        now = folder / draft.name
        files[draft.name] = [compute_digest(file) for file in (now, draft) if file.is_file()]
    return json.dumps({"format": "orthocas-list", "files": files}, indent=1) + "\n"


def refuse_xml(path: Path, what: str, error: type[ArchiveError]) -> None:
    """Say that a file of another kind than expected is XML, if it is: robot files are mistaken for charts.

    Raises:
        ArchiveError: the one given, if the file begins as XML does.
    """
    with path.open("rb") as stream:
        begin = stream.read(200).removeprefix(b"\xef\xbb\xbf").lstrip()
    if begin.startswith((b"<?xml", b"<robot", b"<mujoco", b"<!--")):
        raise error(f"{path} is an XML file, such as of a robot (Robot.from_file), not {what}")


def compute_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def open_draft_folder(parent: Path | None = None) -> Iterator[Path]:
    """A hidden folder in `parent`, or one where the system keeps temporary files, for the time of the block.

    Its name holds host and process id. Those that processes left which no longer run are removed first.
    """
    place = Path(tempfile.gettempdir()) if parent is None else parent
    remove_drafts(place)
    prefix = f"{'' if parent is None else '.'}orthocas-{_HOST}-{os.getpid()}-"
    folder: str | None = None
    try:
        # Ctrl-C between the folder and its name would leave the folder, and during the removal half of it.
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
    """Remove the drafts of processes of this machine that no longer run."""
    # A folder that cannot be listed or changed fails elsewhere, with a message.
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            parts = _NAME.fullmatch(entry.name)
            if parts is None or parts["host"] != _HOST or not entry.is_dir(follow_symlinks=False):
                continue
            try:
                os.kill(int(parts["process"]), 0)
            except (ProcessLookupError, OverflowError):
                shutil.rmtree(entry.path, ignore_errors=True)
            # Other errors say that it runs for another user.
            except OSError:
                pass


@contextmanager
def publish(folder: Path, listed: bool = False, force: bool = False) -> Iterator[Path]:
    """A draft folder. Its files move to `folder` when the block ends, and are deleted if the block raises.

    Each file appears whole or not at all: its content is on disk before its name is. Files of the same name are
    replaced.

    Args:
        folder: where the files go.
        listed: keep a list there of what was written, and replace only files on it (`orthocas.tools.files`).
        force: replace others too.

    Raises:
        ArchiveError: if files are listed and one in the way is not, or the disk is full; or if a symbolic link is in
            the way.
    """
    with open_draft_folder(folder) as drafts, _name_full_disk(folder, drafts) if listed else nullcontext():
        yield drafts
        files = sorted(drafts.iterdir())
        for file in files:
            require_replaceable(folder / file.name, not listed or is_listed(folder / file.name), force)
        if listed:
            text = write_list(folder, files)
            # The list comes first: what it announces may be missing, but nothing that is there unknown.
            files.insert(0, drafts / LIST)
            files[0].write_text(text, encoding="utf-8")
        for file in files:
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
        for file in files:
            os.replace(file, folder / file.name)


@contextmanager
def _name_full_disk(folder: Path, drafts: Path) -> Iterator[None]:
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
    """Check before long work that these names are free, or belong to files that orthocas wrote.

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
        # drafts of processes that died
        remove_drafts(path.parent)
        if path.is_dir():
            raise error_type(f"cannot write {path}: it is a folder, expected a file name")
        if path.exists() and not (path.is_file() and os.access(path, os.W_OK)):
            raise error_type(f"cannot write {path}: it is not a writable file")
        # permissions do not tell everything, a file does
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise error_type(f"cannot write {str(path)[:200]}: {error.strerror}") from None


def make_folder(name: str, out: str | Path, mode: int = 0o777) -> Path:
    """Create the output folder if needed, with these rights less the umask; check that files can be written there.

    Raises:
        InvalidValueError: if they cannot. The message names the argument `name`.
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
    """`make_folder` for the time of a block; at its end, folders that it made and that stayed empty go away again."""
    folder = Path(out)
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        yield make_folder(name, folder)
    finally:
        for place in new:
            # A folder that is not empty stays.
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
    """The chosen columns of a table, in their order, (N, k). Cells of others may hold anything.

    Args:
        path: the file.
        what: what it is, for errors, such as "path file".
        rows: what its rows are, such as "waypoints".
        most: largest number of rows.
        columns: takes the names of the header, and returns the indices of the columns; raises ValueError for others.
        least: smallest number of rows.
        largest: of the numbers; larger ones are mistakes.

    Raises:
        PathFileError: names the file, the line, and what is wrong there.
    """
    # The number of rows first: a file of another kind should say so, not complain of its first cell.
    lines = _read_lines(Path(path), what)
    if not least <= len(lines) - 1 <= most:
        unnamed = lines and all(_is_number(cell) for cell in lines[0][1])
        header = "its first line, which should name the columns" if unnamed else "the header"
        came = f"it has {max(len(lines) - 1, 0)} {rows} after {header}"
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
    """Where the wanted names stand in a header, for `read_table`; every one has to be there once."""
    for name in columns:
        if name not in names:
            raise ValueError(f"line 1: column {name[: RULES.cell]!r} is missing, expected {', '.join(columns)}")
        if names.count(name) > 1:
            raise ValueError(f"line 1: column {name[: RULES.cell]!r} comes twice")
    return [names.index(name) for name in columns]


def _read_lines(path: Path, what: str) -> list[tuple[int, list[str]]]:
    """The lines that are not empty, with their numbers."""
    try:
        with path.open("rb") as stream:
            content = stream.read(RULES.table + 1)
        if len(content) > RULES.table:
            raise PathFileError(f"{what} {path}: larger than {RULES.table / 2**20:.0f} MiB")
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except OSError as error:
        raise PathFileError(f"{what} {path}: cannot be read, {error.strerror}") from None
    # ValueError also stands for bytes that are no text.
    except (ValueError, csv.Error) as error:
        raise PathFileError(f"{what} {path}: no CSV text, {str(error)[: RULES.cell]}") from None


def _parse_row(
    line: int, cells: Sequence[str], header: Sequence[str], chosen: Sequence[int], largest: float
) -> list[float]:
    """The numbers of the chosen columns of a line."""
    # Columns that nobody reads may hold anything, but none may be missing.
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
