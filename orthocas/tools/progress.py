"""Progress of long calls: reports of solvers, and bars in notebooks and terminals."""

from __future__ import annotations

import html
import sys
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TextIO

# [s] between updates in notebooks.
_PAUSE = 0.1
_KERNELS = ("ZMQInteractiveShell", "Shell")  #: kernels of Jupyter and Colab


@dataclass(frozen=True)
class Progress:
    """One progress report of a long computation."""

    stage: str
    fraction: float  #: completed fraction of the stage, 0 to 1
    detail: str
    value: float = float("nan")  #: current loss; NaN if there is none yet


Monitor = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """The default monitor. It shows nothing."""


@dataclass(frozen=True)
class Watch:
    """Observes a running minimiser."""

    monitor: Monitor = silent
    stage: str = ""  #: name of the stage, for the monitor

    def report(self, fraction: float, value: float) -> None:
        """Report progress to the monitor."""
        self.monitor(Progress(self.stage, fraction, f"loss {value:.5g}", value))


UNWATCHED = Watch()


def progress() -> Monitor:
    """A monitor that draws progress bars: `oc.fit(problem, monitor=oc.progress())`.

    In a Jupyter notebook it shows one bar per stage below the cell, in a terminal one line per stage on standard error,
    and elsewhere nothing. It needs no widgets. Use a new monitor for each call.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> fit = oc.fit(problems.get("planar_3r_xy"), oc.Linear(), monitor=oc.progress())
    """
    if in_notebook():
        return NotebookBars()
    return TerminalBars(sys.stderr) if sys.stderr.isatty() else silent


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this process."""
    shell: Any = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ in _KERNELS


class NotebookBars:
    """HTML progress bars that are redrawn in place."""

    def __init__(self) -> None:
        self._display = import_module("IPython.display")
        self._stages: dict[str, Progress] = {}
        self._handle: Any = None
        self._drawn = 0.0

    def __call__(self, progress: Progress) -> None:
        """Draw a report, at most ten times a second."""
        # Redraw at the start and the end of a stage, and otherwise at intervals.
        new = progress.stage not in self._stages
        self._stages[progress.stage] = progress
        if not new and progress.fraction < 1 and time.monotonic() < self._drawn + _PAUSE:
            return
        self._drawn = time.monotonic()
        picture = self._display.HTML(as_bars(self._stages))
        if self._handle is None:
            self._handle = self._display.display(picture, display_id=True)
        else:
            self._handle.update(picture)


class TerminalBars:
    """One bar of rich per stage. It ends with its stage, by `close`, or when this monitor is deleted.

    Args:
        stream: a terminal.
        transient: whether bars vanish at their end.
    """

    def __init__(self, stream: TextIO, transient: bool = False) -> None:
        self._stream, self._transient = stream, transient
        self._stage = ""
        self._bar: Any = None
        self._stop: Callable[[], object] | None = None

    def __call__(self, progress: Progress) -> None:
        """Show a report."""
        if self._stop is None or progress.stage != self._stage:
            # The previous stage is complete.
            if self._stop is not None:
                self._bar.update(self._bar.task_ids[0], completed=1.0)
            self.close()
            self._start(progress.stage)
        self._bar.update(self._bar.task_ids[0], completed=progress.fraction, detail=progress.detail)
        if progress.fraction >= 1:
            self.close()

    def close(self) -> None:
        """End the bar of the last stage."""
        if self._stop is not None:
            self._stop()
            self._stop = None

    def _start(self, stage: str) -> None:
        # rich takes longer to import than everything else, and few processes draw bars.
        from rich import progress as rich
        from rich.console import Console

        text, detail = (
            rich.TextColumn(field, markup=False) for field in ("{task.description}", "{task.fields[detail]}")
        )
        columns = (text, rich.BarColumn(), rich.TimeElapsedColumn(), detail)
        self._stage = stage
        self._bar = rich.Progress(*columns, console=Console(file=self._stream), transient=self._transient)
        self._bar.add_task(stage, total=1.0, detail="")
        self._stop = weakref.finalize(self, self._bar.stop)
        self._bar.start()


def as_bars(stages: dict[str, Progress]) -> str:
    """A table with a bar for each stage; all but the last are complete."""
    rows = []
    for k, (name, progress) in enumerate(stages.items(), 1):
        fraction = 1.0 if k < len(stages) else min(max(progress.fraction, 0.0), 1.0)
        rows.append(
            f"<tr><td style='text-align:left'>{html.escape(name)}</td><td><progress value='{fraction:.3f}' max='1' "
            f"style='width:16em'></progress></td><td style='text-align:left'>{html.escape(progress.detail)}</td></tr>"
        )
    return f"<table>{''.join(rows)}</table>"
