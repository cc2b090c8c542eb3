"""What commands print: aligned text for people or one JSON object, remarks, and progress on standard error."""

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

PAUSE = 10.0  #: [s] between lines of progress where there is no terminal
_UNEVEN = 30.0  # ratio of gradient lengths above which the same gain means too different things across the domain


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object."""
    typer.echo(write_json(data))


def print_rows(rows: dict[str, str], then: str = "") -> None:
    """Print names and values in two columns; to people also what to do next, a command."""
    # People get a table as wide as their terminal; files and pipes one line a row, which programs can read.
    if sys.stdout.isatty():
        _draw(list((rows | {"next": then} if then else rows).items()))
        return
    width = max(len(name) for name in rows) + 2
    for name, value in rows.items():
        typer.echo(printable(f"{name:<{width}}{value}"))


def print_table(rows: Sequence[Sequence[str]], then: str = "") -> None:
    """Print rows in aligned columns, the first one as their head; the last cell of a short row may be long."""
    head = rows[0]
    if sys.stdout.isatty():
        _draw(rows[1:], head)
        if then:
            print_rows({"next": then})
        return
    # A long last cell, such as an explanation, does not widen its column for all rows.
    aligned = [row if len(row) == len(head) else row[:-1] for row in rows]
    widths = [max(len(row[k]) for row in aligned if k < len(row)) for k in range(len(head))]
    for row in rows:
        line = "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False))
        typer.echo(printable(line.rstrip()))


def _draw(rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> None:
    """Print rows to a terminal: as wide as it is, and broken between words."""
    from rich.console import Console  # only terminals need it
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=bool(head), header_style="bold")
    for k in range(max(map(len, rows))):
        title = head[k] if head else ""
        # Rich folds words where a column is narrower than they are: a column is as wide as its longest word.
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
    """The rows of a quality report, with what is normal for a wide chart, or advice on options for a tight one."""
    # The standards of tight charts say nothing of wide ones, whose leaks are large by nature.
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
    """The ranges of xi in one row, and how far the joints move for a unit of it at the home: |dq/dxi|."""
    if (reach := _find_reach(chart)) is None:
        return {}
    named = [name.partition(": ")[2] for name in chart.parts.named_coordinates]
    texts = [
        f"{part.label} {part.low:.3g} to {part.high:.3g}{f' ({name})' if name else ''}"
        for part, name in zip(reach, named, strict=True)
    ]
    # Columns of the inverse Jacobian: what xi is worth, whatever metric scales it.
    moved = np.linalg.norm(np.linalg.inv(chart.jacobian(chart.problem.domain.home))[:, chart.m :], axis=0)
    unit = "rad or m" if any(chart.robot.tree.prismatic) else "rad"
    worth = ", ".join(f"{part.label} {length:.2g}" for part, length in zip(reach, moved, strict=True))
    return {"xi reach": ", ".join(texts), "xi unit": f"moves the joints by [{unit}] {worth}"}


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
        return chart.xi_range(chart.problem.domain.home)
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
    # A thread of its own speaks, because one step of a fit may take longer than the pause.
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
