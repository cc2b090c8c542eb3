"""What commands share: how options are read, and output as aligned text for people or one JSON object."""

import inspect
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orthocas.errors import one_line, printable
from orthocas.tools.display import percent
from orthocas.tools.json import write_json
from orthocas.tools.progress import Monitor, Progress

if TYPE_CHECKING:
    from orthocas.charts.quality import Report


def parse_whole_number(text: str) -> int:
    """Parse the value of an option that takes a whole number."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"received {text!r}, expected a whole number") from None


def number(text: str) -> float:
    """Parse the value of an option that takes a number."""
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"received {text!r}, expected a number") from None


PAUSE = 10.0  #: [s] between lines of progress where there is no terminal
_UNEVEN = 30.0  # ratio of gradient lengths above which the same gain means too different things across the domain

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]

ChartPath = Annotated[Path, typer.Argument(metavar="CHART", help="A chart file.")]

Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of a Dask scheduler, for example tcp://host:8786.")
]

Force = Annotated[bool, typer.Option("--force", help="Replace files of the same names that orthocas did not write.")]


def spread(
    parameter: str, options: Mapping[str, Any], made: Callable[[dict[str, Any]], Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator of commands: options take the place of one parameter.

    Args:
        parameter: its name.
        options: annotations of the options, by name; they are optional.
        made: the parameter, from the values of the options.
    """

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command).parameters.values()
        added = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
            for name, annotation in options.items()
        ]
        parts = [added if part.name == parameter else [part.replace(kind=part.KEYWORD_ONLY)] for part in own]

        @wraps(command)
        def called(**given: Any) -> None:
            chosen = {name: given.pop(name) for name in options}
            command(**{parameter: made(chosen)}, **given)

        parameters = [part for some in parts for part in some]
        vars(called)["__signature__"] = inspect.Signature(parameters)
        called.__annotations__ = {part.name: part.annotation for part in parameters}
        return called

    return decorated


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


@contextmanager
def terminal_monitor() -> Iterator[Monitor]:
    """A monitor that draws one bar per stage; a line every ten seconds when standard error is not a terminal."""
    with _stage_bars() if sys.stderr.isatty() else lines_of_progress(PAUSE) as show:
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


@contextmanager
def _stage_bars() -> Iterator[Monitor]:
    """A monitor that draws one bar per stage by rich."""
    from rich.console import Console  # takes longer to import than the rest
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[detail]}"))
    tasks: dict[str, Any] = {}
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:

        def show(progress: Progress) -> None:
            if progress.stage not in tasks:
                for task in tasks.values():
                    bars.update(task, completed=1.0)
                tasks[progress.stage] = bars.add_task(progress.stage, total=1.0, detail="")
            bars.update(tasks[progress.stage], completed=progress.fraction, detail=progress.detail)

        yield show
