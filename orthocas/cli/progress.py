"""Progress bars for long work: on standard error, and only when it is a terminal."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

from orthocas.minimising.watch import Monitor, silent


@contextmanager
def terminal_monitor() -> Iterator[Monitor]:
    """A monitor that draws one bar per stage. It is silent when standard error is not a terminal."""
    if not sys.stderr.isatty():
        yield silent
        return
    with import_module("orthocas.cli.bars").stage_bars() as show:  # rich takes longer to import than the rest
        yield show
