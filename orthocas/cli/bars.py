"""One progress bar per stage, drawn by rich on standard error."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from orthocas.minimising.watch import Monitor, Progress


@contextmanager
def stage_bars() -> Iterator[Monitor]:
    """A monitor that draws the bars."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[detail]}"))
    tasks: dict[str, TaskID] = {}
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:

        def show(progress: Progress) -> None:
            if progress.stage not in tasks:
                for task in tasks.values():
                    bars.update(task, completed=1.0)
                tasks[progress.stage] = bars.add_task(progress.stage, total=1.0, detail="")
            bars.update(tasks[progress.stage], completed=progress.fraction, detail=progress.detail)

        yield show
