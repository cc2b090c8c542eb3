"""Progress of long calls: what solvers report, and how it is shown in notebooks and terminals."""

import html
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TextIO

_PAUSE = 0.1  # [s] between pictures
_BAR = 24  # characters
_KERNELS = ("ZMQInteractiveShell", "Shell")  #: of Jupyter and Colab


@dataclass(frozen=True)
class Progress:
    """One progress report of a long computation."""

    stage: str
    fraction: float  #: completed fraction of the stage, 0 to 1
    detail: str
    value: float = float("nan")  #: current loss; NaN before there is one


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
    """A monitor that draws: `oc.fit(problem, monitor=oc.progress())`.

    In a Jupyter notebook it shows one bar for each stage below the cell, elsewhere one line for each stage on standard
    error. It needs no widgets. Use a new one for each call.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> fit = oc.fit(problems.get("planar_3r_xy"), oc.Linear(), monitor=oc.progress())
    """
    return NotebookBars() if in_notebook() else TerminalLines(sys.stderr)


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this process."""
    shell: Any = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ in _KERNELS


class NotebookBars:
    """Bars as HTML that are redrawn in place."""

    def __init__(self) -> None:
        self._display = import_module("IPython.display")
        self._stages: dict[str, Progress] = {}
        self._handle: Any = None
        self._drawn = 0.0

    def __call__(self, progress: Progress) -> None:
        """Draw, at most ten times a second."""
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


class TerminalLines:
    """One line for each stage, rewritten in place on terminals and left out elsewhere."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._stage, self._drawn = stream, "", 0.0
        self._seen = stream.isatty()

    def __call__(self, progress: Progress) -> None:
        """Write, at most ten times a second."""
        new = progress.stage != self._stage
        if not self._seen or (not new and progress.fraction < 1 and time.monotonic() < self._drawn + _PAUSE):
            return
        full = int(_BAR * min(max(progress.fraction, 0.0), 1.0))
        start = "\n" if new and self._stage else "\r"
        end = "\n" if progress.fraction >= 1 else ""
        bar = "=" * full + " " * (_BAR - full)
        self._stream.write(f"{start}{progress.stage:<28.28} [{bar}] {progress.detail:<40.40}{end}")
        self._stream.flush()
        self._stage, self._drawn = "" if end else progress.stage, time.monotonic()


def as_bars(stages: dict[str, Progress]) -> str:
    """A table with a bar for each stage; all but the last are complete."""
    rows = []
    for k, (name, progress) in enumerate(stages.items(), 1):
        share = 1.0 if k < len(stages) else min(max(progress.fraction, 0.0), 1.0)
        rows.append(
            f"<tr><td style='text-align:left'>{html.escape(name)}</td><td><progress value='{share:.3f}' max='1' "
            f"style='width:16em'></progress></td><td style='text-align:left'>{html.escape(progress.detail)}</td></tr>"
        )
    return f"<table>{''.join(rows)}</table>"
