"""Output of commands: aligned text or a JSON object, remarks, and progress on standard error."""

import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

from orthocas.errors import InvalidValueError, one_line, printable
from orthocas.tools.display import percent
from orthocas.tools.json import clean, write_json
from orthocas.tools.progress import Monitor, Progress, TerminalBars

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart
    from orthocas.charts.quality import Report
    from orthocas.charts.self_motion import XiRange

PAUSE = 10.0  #: [s] between lines of progress if there is no terminal
# Ratio of gradient lengths above which one gain has too different effects across the domain.
_UNEVEN = 30.0


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object."""
    typer.echo(write_json(data))


def print_rows(rows: dict[str, str], then: str = "") -> None:
    """Print names and values in two columns; on a terminal also a command to try next."""
    # A terminal gets a table of its width. Files and pipes get one row per line, for programs.
    if sys.stdout.isatty():
        _draw(list((rows | {"next": then} if then else rows).items()))
        return
    width = max(len(name) for name in rows) + 2
    for name, value in rows.items():
        typer.echo(printable(f"{name:<{width}}{value}"))


def print_table(rows: Sequence[Sequence[str]], then: str = "") -> None:
    """Print rows in aligned columns; the first row is the head. The last cell of a short row may be long."""
    head = rows[0]
    if sys.stdout.isatty():
        _draw(rows[1:], head)
        if then:
            print_rows({"next": then})
        return
    # A long last cell, such as an explanation, must not widen its column for all rows.
    aligned = [row if len(row) == len(head) else row[:-1] for row in rows]
    widths = [max(len(row[k]) for row in aligned if k < len(row)) for k in range(len(head))]
    for row in rows:
        line = "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False))
        typer.echo(printable(line.rstrip()))


def _draw(rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> None:
    """Print rows to a terminal at its width, broken between words."""
    # Only terminals need this import.
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=bool(head), header_style="bold")
    for k in range(max(map(len, rows))):
        title = head[k] if head else ""
        # rich breaks words in narrow columns, so make each column as wide as its longest word.
        words = [word for row in rows for word in row[k].split()] if k else []
        longest = min(max(map(len, (*title.split(), *words)), default=0), 20)
        table.add_column(title, no_wrap=k == 0, overflow="fold", style="cyan" if k == 0 else "", min_width=longest)
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    Console().print(table)


def note(text: str) -> None:
    """Print a remark on standard error."""
    typer.echo(f"note: {one_line(text)}", err=True)


def format_report_rows(report: "Report", chart: "Chart") -> dict[str, str]:
    """The rows of a quality report, with the usual values of wide charts, or with advice for tight ones."""
    # The limits for tight charts do not apply to wide ones, whose leaks are naturally large.
    rows = report.facts()
    if "branch" in chart.notes:
        rows["wide"] = (
            f"of the branch {chart.notes['branch']}: leaks of tens of degrees are normal; judge it by conditioning, by "
            "'xi held', and by the regular share of its fit"
        )
        return rows
    if report.folded_samples:
        rows["folded"] += "; fit with --domain auto, which looks for a box without folds"
    if report.length_ratio > _UNEVEN:
        rows["lengths"] += "; for use in controllers, fit with --weights 1000,30,150,1,1000"
    return rows


def format_reach_rows(chart: "Chart") -> dict[str, str]:
    """The ranges of xi in one row, and the joint motion per unit of xi at the home, |dq/dxi|."""
    if (reach := _find_reach(chart)) is None:
        return {}
    named = [name.partition(": ")[2] for name in chart.parts.named_coordinates]
    texts = [
        f"{part.label} {part.low:.3g} to {part.high:.3g}{f' ({name})' if name else ''}"
        for part, name in zip(reach, named, strict=True)
    ]
    # Columns of the inverse Jacobian show the effect of xi, independent of the metric.
    moved = np.linalg.norm(np.linalg.inv(chart.jacobian(chart.problem.domain.home))[:, chart.m :], axis=0)
    unit = "rad or m" if any(chart.robot.tree.prismatic) else "rad"
    worth = ", ".join(f"{part.label} {length:.2g}" for part, length in zip(reach, moved, strict=True))
    return {"xi reach": ", ".join(texts), "xi unit": f"moves the joints by [{unit}] {worth}"}


def build_reach_data(chart: "Chart") -> dict[str, Any]:
    """The ranges of xi and what limits them, for JSON."""
    if (reach := _find_reach(chart)) is None:
        return {}
    return {
        "xi_range": {part.label: [clean(part.low), clean(part.high)] for part in reach},
        "xi_stops": {part.label: [str(part.low_stop), str(part.high_stop)] for part in reach},
    }


def _find_reach(chart: "Chart") -> "XiRange | None":
    """The ranges of xi at the centre; None for grown charts, which take seconds, and where the task is not finite."""
    # Imported here, because commands without charts print too.
    from orthocas.charts.coordinates import InvertibleMap

    if isinstance(chart.coordinates, InvertibleMap):
        return None
    try:
        return chart.xi_range(chart.problem.domain.home)
    except InvalidValueError:
        return None


@contextmanager
def terminal_monitor() -> Iterator[Monitor]:
    """A monitor that draws one bar per stage, or prints a line every ten seconds if there is no terminal."""
    bars = sys.stderr.isatty()
    with closing(TerminalBars(sys.stderr, transient=True)) if bars else lines_of_progress(PAUSE) as show:
        yield show


@contextmanager
def lines_of_progress(pause: float) -> Iterator[Monitor]:
    """A monitor that prints its last report every `pause` seconds, even during a step that takes longer."""
    # A separate thread prints, because one step of a fit may take longer than the pause.
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
