"""Figures of charts: histograms of their quality, and the arm along each coordinate."""

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from orthocas.charts.self_motion import fan_along
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import require_count
from orthocas.tools.picture import Picture, equal_axes

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart
    from orthocas.charts.quality import AngleStatistics, Report

_MOST_POSTURES = 1000
_PANELS = 2  #: largest number of panels side by side
_TASK, _EXTRA, _LEAK = "#1f5fa8", "#d95f02", "#5a9e6f"


def quality_figure(report: "Report") -> Figure:
    """Plot histograms of task and mutual angles [deg], as in [AS2023] Figs. 20 and 27, and of leaks (ours)."""
    _require("report", report, "task_angle", "a Report")
    figure = Picture(figsize=(12.0, 3.4), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    _draw_angles(left, report.task_angle, _TASK, r"task angle $\angle(\mathrm{d}\xi_j, \nabla_A h_i)$")
    _draw_angles(middle, report.mutual_angle, _EXTRA, r"mutual angle $\angle(\mathrm{d}\xi_i, \mathrm{d}\xi_j)$")
    # leaks from 0, in bins of half a degree
    counts = report.leak.histogram[:900].reshape(-1, 5).sum(axis=1)
    right.stairs(counts / max(counts.sum(), 1) / 0.5, 0.5 * np.arange(len(counts) + 1) - 0.05, fill=True, color=_LEAK)
    right.set_xlim(0, max(6.0, 3 * report.leak.rms))
    right.set_xlabel(r"leak, in the metric [deg]")
    right.set_title(f"rms {report.leak.rms:.2f}°, largest {report.leak.max:.1f}°", fontsize=10)
    right.grid(alpha=0.3)
    left.set_ylabel("share of angles per degree")
    figure.suptitle(f"{report.samples:,} held-out samples, conditioning mean {report.conditioning.mean:.2f}")
    return figure


def self_motion_figure(chart: "Chart", postures: int = 9) -> Figure:
    """Plot self-motions of the arm: each panel moves one coordinate over its range, with the task and the others held.

    Args:
        chart: the chart; the curves pass through the home of its domain.
        postures: number of postures per panel.
    """
    _require("chart", chart, "xi_range", "a Chart")
    require_count("postures", postures, most=_MOST_POSTURES)
    columns = min(chart.r, _PANELS)
    rows = -(-chart.r // columns)
    figure = Picture(figsize=(4.5 * columns, 3.9 * rows), layout=ConstrainedLayoutEngine(h_pad=0.15, w_pad=0.1))
    # all panels have the same axes
    fans = [fan_along(chart, chart.problem.domain.home, j) for j in range(chart.r)]
    sweeps = [fan.q[np.abs(fan.arc_length[:, None] - fan.places(postures)).argmin(axis=0)] for fan in fans]
    everything = chart.problem.robot.joint_points(np.concatenate(sweeps)).reshape(-1, 3)
    colours = mpl.colormaps["viridis"](np.linspace(0.1, 0.9, postures))
    for j, sweep in enumerate(sweeps):
        panel = figure.add_subplot(rows, columns, j + 1, projection="3d")
        for points, colour in zip(chart.problem.robot.joint_points(sweep), colours, strict=True):
            panel.plot(*points.T, "-o", color=colour, markersize=3, linewidth=1.8)
        # the title states how far the task moves between the postures drawn, as a power of ten
        moved = np.abs(chart.x(sweep) - chart.x(chart.problem.domain.home)).max()
        low, high = chart.xi(sweep[[0, -1]])[:, j]
        title = rf"$\xi_{{{j + 1}}}$ from {low:.3g} to {high:.3g}, dark to light"
        power = int(np.ceil(np.log10(max(moved, 1e-16))))
        panel.set_title(f"{title}\ntask moves < 1e{power:d} m", fontsize=10)
        equal_axes(panel, everything)
    return figure


def _draw_angles(axes: Axes, angles: "AngleStatistics", colour: str, label: str) -> None:
    """Draw a histogram of angles around 90 degrees."""
    # groups of five bins, so that 90 degrees lies in the middle of its group
    first = 3
    counts = angles.histogram[first:-3].reshape(-1, 5).sum(axis=1)
    edges = (first - 0.5) / 10 + 0.5 * np.arange(len(counts) + 1)
    axes.stairs(counts / max(counts.sum(), 1) / 0.5, edges, fill=True, color=colour, alpha=0.85)
    # show five standard deviations on both sides, and at least six degrees
    width = max(6.0, 5 * (0.0 if np.isnan(angles.std) else angles.std))
    axes.set_xlim(90 - width, 90 + width)
    axes.set_xlabel(f"{label} [deg]")
    axes.set_title(f"mean {angles.mean:.2f}°, std {angles.std:.2f}°", fontsize=10)
    axes.grid(alpha=0.3)


def _require(name: str, value: object, part: str, wanted: str) -> None:
    """Raise InvalidValueError unless a value has an attribute `part`.

    A check of its class would need an import of the module that imports this one.
    """
    if not hasattr(value, part):
        raise InvalidValueError(name, f"a {type(value).__name__}", wanted)
