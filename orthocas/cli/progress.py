"""Progress bars for long work: on standard error, and only when it is a terminal."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from orthocas.tools.progress import Monitor, Progress, silent


@contextmanager
def terminal_monitor() -> Iterator[Monitor]:
    """A monitor that draws one bar per stage. It is silent when standard error is not a terminal."""
    if not sys.stderr.isatty():
        yield silent
        return
    with _stage_bars() as show:
        yield show


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
