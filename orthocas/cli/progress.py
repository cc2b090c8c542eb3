"""Progress bars for long work: on standard error, and only when it is a terminal."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from orthocas.minimising.watch import Monitor, Progress, silent


@contextmanager
def terminal_monitor() -> Iterator[Monitor]:
    """A monitor that draws one bar per stage. It is silent when standard error is not a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield silent
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[detail]}"))
    tasks: dict[str, TaskID] = {}
    with Bars(*columns, console=console, transient=True) as bars:

        def show(progress: Progress) -> None:
            if progress.stage not in tasks:
                for task in tasks.values():
                    bars.update(task, completed=1.0)
                tasks[progress.stage] = bars.add_task(progress.stage, total=1.0, detail="")
            bars.update(tasks[progress.stage], completed=progress.fraction, detail=progress.detail)

        yield show
