"""The column "control tick" of a comparison. It is measured once per parametrisation: parameters do not change it."""

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
    """Add `control_tick_us` to the results. Ticks are measured one at a time, so that they do not disturb each other.

    It is NaN if there is no chart file, no C compiler, or the controller does not support the chart.
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
    except (OrthocasError, OSError, RuntimeError, MemoryError):  # never lose the fits because of a failed measurement
        return math.nan
