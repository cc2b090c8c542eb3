"""Files of tool paths: CSV with a header of the chart's labels and one waypoint a line. Format: docs/paths.md."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.errors import PathFileError
from orthocas.following.splines import MOST_WAYPOINTS

_LARGEST_FILE = 2**25  # bytes
_LARGEST = 1e6  # larger numbers are mistakes
_LONGEST = 60  # characters of a cell in an error


def read_path(path: str | Path, chart: Chart) -> tuple[Array, Array | None]:
    """Waypoints (N, m), and their coordinates (N, r) if the file has columns for them.

    Raises:
        PathFileError: names the file, the line, and what is wrong there.
    """
    rows = _rows(Path(path))
    try:
        order, has_xi = _columns([cell.strip() for cell in rows[0][1]], chart)
        table = np.array([_numbers(line, cells, rows[0][1]) for line, cells in rows[1:]])
    except ValueError as error:
        raise PathFileError(f"path file {path}: {error}") from None
    values = table[:, order]
    return values[:, : chart.m], values[:, chart.m :] if has_xi else None


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """The lines that are not empty, with their numbers; a header and at least two waypoints."""
    try:
        with path.open("rb") as stream:
            content = stream.read(_LARGEST_FILE + 1)
        if len(content) > _LARGEST_FILE:
            raise PathFileError(f"path file {path}: larger than {_LARGEST_FILE / 2**20:.0f} MiB")
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except OSError as error:
        raise PathFileError(f"path file {path}: cannot be read, {error.strerror}") from None
    except (ValueError, csv.Error) as error:  # also bytes that are no text
        raise PathFileError(f"path file {path}: no CSV text, {str(error)[:_LONGEST]}") from None
    if not 3 <= len(rows) <= MOST_WAYPOINTS + 1:
        came = f"it has {max(len(rows) - 1, 0)} waypoints after the header"
        raise PathFileError(f"path file {path}: {came}, expected 2 to {MOST_WAYPOINTS}")
    return rows


def _columns(names: Sequence[str], chart: Chart) -> tuple[list[int], bool]:
    """The columns in the order of the chart's labels, and whether there are those of the coordinates."""
    task, extra = chart.labels[: chart.m], chart.labels[chart.m :]
    has_xi = bool(set(extra) & set(names))
    wanted = (*task, *extra) if has_xi else task
    for name in names:
        if name not in chart.labels:
            known = f"{', '.join(task)}, and if the path has a schedule {', '.join(extra)}"
            raise ValueError(f"line 1: unknown column {name[:_LONGEST]!r}, expected {known}")
        if names.count(name) > 1:
            raise ValueError(f"line 1: column {name!r} comes twice")
    for name in wanted:
        if name not in names:
            raise ValueError(f"line 1: column {name!r} is missing, expected {', '.join(wanted)}")
    return [names.index(name) for name in wanted], has_xi


def _numbers(line: int, cells: Sequence[str], header: Sequence[str]) -> list[float]:
    if len(cells) != len(header):
        raise ValueError(f"line {line}: {len(cells)} numbers, expected {len(header)} as in the header")
    return [_number(line, cell, name) for cell, name in zip(cells, header, strict=True)]


def _number(line: int, cell: str, name: str) -> float:
    try:
        value = float("nan" if "_" in cell else cell)
    except ValueError:
        value = np.nan
    if not abs(value) <= _LARGEST:
        want = f"a number from {-_LARGEST:g} to {_LARGEST:g}"
        raise ValueError(f"line {line}: {name.strip()} is {cell[:_LONGEST]!r}, expected {want}")
    return value
