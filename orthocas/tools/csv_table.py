"""Tables of numbers in CSV files: a header of names, and one row of finite numbers a line."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from orthocas.errors import PathFileError
from orthocas.tools.checks import Array

_LARGEST_FILE = 2**25  # bytes
_LARGEST = 1e6  # larger numbers are mistakes
LONGEST = 60  #: characters of a cell in an error


def read_table(
    path: str | Path,
    what: str,
    rows: str,
    most: int,
    columns: Callable[[Sequence[str]], Sequence[int]],
    least: int = 2,
) -> Array:
    """The chosen columns of a table, in their order, (N, k). Cells of others may hold anything.

    Args:
        path: the file.
        what: what it is, for errors, such as "path file".
        rows: what its rows are, such as "waypoints".
        most: largest number of rows.
        columns: takes the names of the header, and returns the indices of the columns; raises ValueError for others.
        least: smallest number of rows.

    Raises:
        PathFileError: names the file, the line, and what is wrong there.
    """
    lines = _lines(Path(path), what)
    if not least <= len(lines) - 1 <= most:
        came = f"it has {max(len(lines) - 1, 0)} {rows} after the header"
        raise PathFileError(f"{what} {path}: {came}, expected {least} to {most}")
    header = [cell.strip() for cell in lines[0][1]]
    try:
        chosen = list(columns(header))
        return np.array([_numbers(line, cells, header, chosen) for line, cells in lines[1:]])
    except ValueError as error:
        raise PathFileError(f"{what} {path}: {error}") from None


def column_places(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Where the wanted names stand in a header, for `read_table`; every one has to be there once."""
    for name in wanted:
        if name not in names:
            raise ValueError(f"line 1: column {name[:LONGEST]!r} is missing, expected {', '.join(wanted)}")
        if names.count(name) > 1:
            raise ValueError(f"line 1: column {name[:LONGEST]!r} comes twice")
    return [names.index(name) for name in wanted]


def _lines(path: Path, what: str) -> list[tuple[int, list[str]]]:
    """The lines that are not empty, with their numbers."""
    try:
        with path.open("rb") as stream:
            content = stream.read(_LARGEST_FILE + 1)
        if len(content) > _LARGEST_FILE:
            raise PathFileError(f"{what} {path}: larger than {_LARGEST_FILE / 2**20:.0f} MiB")
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except OSError as error:
        raise PathFileError(f"{what} {path}: cannot be read, {error.strerror}") from None
    except (ValueError, csv.Error) as error:  # also bytes that are no text
        raise PathFileError(f"{what} {path}: no CSV text, {str(error)[:LONGEST]}") from None


def _numbers(line: int, cells: Sequence[str], header: Sequence[str], chosen: Sequence[int]) -> list[float]:
    if len(cells) != len(header):
        raise ValueError(f"line {line}: {len(cells)} numbers, expected {len(header)} as in the header")
    return [_number(line, cells[k], header[k]) for k in chosen]


def _number(line: int, cell: str, name: str) -> float:
    try:
        value = float("nan" if "_" in cell else cell)
    except ValueError:
        value = np.nan
    if not abs(value) <= _LARGEST:
        want = f"a number from {-_LARGEST:g} to {_LARGEST:g}"
        raise ValueError(f"line {line}: {name} is {cell[:LONGEST]!r}, expected {want}")
    return value
