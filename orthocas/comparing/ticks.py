"""The column "control tick" of a comparison: measured once for a parametrisation, since parameters do not change it."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from orthocas.casadi_tools.interrupts import deferred
from orthocas.chart import Chart
from orthocas.codegen import control_tick
from orthocas.comparing.cells import Cell, CellResult
from orthocas.errors import OrthocasError
from orthocas.minimising.watch import Monitor, Progress


def with_control_ticks(results: Sequence[CellResult], cells: Sequence[Cell], monitor: Monitor) -> list[CellResult]:
    """The results with `control_tick_us`, one after the other so that they do not disturb each other.

    NaN where there is no chart file, no C compiler, or no such controller.
    """
    files = {
        cell.parametrisation.label: cell.chart_file for cell in cells if cell.chart_file and cell.chart_file.exists()
    }
    ticks = {}
    for done, (label, file) in enumerate(files.items()):
        monitor(Progress("timing control ticks", done / len(files), label))
        ticks[label] = _control_tick(file)
    return [
        result if result.failed else replace(result, control_tick_us=ticks.get(result.parametrisation, math.nan))
        for result in results
    ]


def _control_tick(file: Path) -> float:
    try:
        with deferred():  # CasADi may make a RuntimeError of Ctrl-C while it builds functions
            chart = Chart.load(file)
        return control_tick(chart)
    except (OrthocasError, OSError, RuntimeError, MemoryError):  # the fits are worth more than their ticks
        return math.nan
