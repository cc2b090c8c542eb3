"""What commands print: aligned text for people or one JSON object, remarks, and progress on standard error."""

import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

import typer

from orthocas.errors import InvalidValueError, one_line, printable
from orthocas.tools.display import percent
from orthocas.tools.json import clean, write_json
from orthocas.tools.progress import Monitor, Progress, TerminalBars

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart
    from orthocas.charts.quality import Report
    from orthocas.charts.self_motion import XiRange

PAUSE = 10.0  #: [s] between lines of progress where there is no terminal
_UNEVEN = 30.0  # ratio of gradient lengths above which the same gain means too different things across the domain


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object."""
    typer.echo(write_json(data))


def print_rows(rows: Mapping[str, str]) -> None:
    """Print names and values in two columns."""
    width = max(len(name) for name in rows) + 2
    for name, value in rows.items():
        typer.echo(printable(f"{name:<{width}}{value}"))


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows in aligned columns; the last cell of a short row may be long."""
    head = rows[0]
    aligned = [row if len(row) == len(head) else row[:-1] for row in rows]
    widths = [max(len(row[k]) for row in aligned if k < len(row)) for k in range(len(head))]
    for row in rows:
        line = "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False))
        typer.echo(printable(line.rstrip()))


def note(text: str) -> None:
    """Print a remark on standard error."""
    typer.echo(f"note: {one_line(text)}", err=True)


def format_report_rows(report: "Report") -> dict[str, str]:
    """The rows of a quality report, with advice on command-line options."""
    rows = report.facts()
    if report.length_ratio > _UNEVEN:
        rows["lengths"] += "; for use in controllers, fit with --weights 1000,30,150,1,1000"
    return rows


def format_reach_rows(chart: "Chart") -> dict[str, str]:
    """The ranges of xi in one row."""
    if (reach := _find_reach(chart)) is None:
        return {}
    return {"xi reach": ", ".join(f"{part.label} {part.low:.3g} to {part.high:.3g}" for part in reach)}


def build_reach_data(chart: "Chart") -> dict[str, Any]:
    """The ranges of xi and what stops them there, for JSON."""
    if (reach := _find_reach(chart)) is None:
        return {}
    return {
        "xi_range": {part.label: [clean(part.low), clean(part.high)] for part in reach},
        "xi_stops": {part.label: [str(part.low_stop), str(part.high_stop)] for part in reach},
    }


def _find_reach(chart: "Chart") -> "XiRange | None":
    """The ranges of xi at the centre; None for grown charts, which take seconds, and where the task is not finite."""
    from orthocas.charts.coordinates import InvertibleMap  # only here: commands without charts print too

    if isinstance(chart.coordinates, InvertibleMap):
        return None
    try:
        return chart.xi_range(chart.problem.domain.centre)
    except InvalidValueError:
        return None


@contextmanager
def terminal_monitor() -> Iterator[Monitor]:
    """A monitor that draws one bar per stage; a line every ten seconds when standard error is not a terminal."""
    bars = sys.stderr.isatty()
    with closing(TerminalBars(sys.stderr, transient=True)) if bars else lines_of_progress(PAUSE) as show:
        yield show


@contextmanager
def lines_of_progress(pause: float) -> Iterator[Monitor]:
    """A monitor whose last report is printed every `pause` seconds, also while one step takes longer than that."""
    begin, reports, ended = time.monotonic(), [""], threading.Event()

    def show(progress: Progress) -> None:
        reports[0] = f", {progress.stage}, {percent(progress.fraction, 0)}: {progress.detail}"

    def speak() -> None:
        while not ended.wait(pause):
            note(f"{time.monotonic() - begin:.0f} s{reports[0]}")

    speaker = threading.Thread(target=speak, daemon=True)
    speaker.start()
    try:
        yield show
    finally:
        ended.set()
        speaker.join()
