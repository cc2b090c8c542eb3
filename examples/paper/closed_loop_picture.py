"""Panels of closed loops: coordinates and joints over time, and projections on coordinate planes.

The reference curve is wide and pale; the measured curve is thin and dark.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from orthocas.charts.chart import Chart
from orthocas.tools.checks import Array

from .drawing import Drawing
from .planar_loop import GENTLE, INTERLEAVED, Arm, Run, follow, task_angle_std
from .style import EXTRA, INK, LABEL, TASK, THIRD, TICK, new_figure

COLOURS = {"x": TASK, "y": "#8e44ad", "xi1": EXTRA, "xi2": THIRD}  #: of coordinates
JOINTS = (INK, "#c51b7d", "#8a8f98")  #: colours of joints
_WIDE, _THIN = 3.6, 1.0  # [pt]
_PALE = 0.35
_NAMES = {"x": "$x$", "y": "$y$", "xi1": r"$\xi_1$", "xi2": r"$\xi_2$"}


def symbol(run: Run, label: str) -> str:
    """The symbol of a coordinate in mathematical text; a single extra coordinate has no number."""
    return r"$\xi$" if label == "xi1" and run.chart.r == 1 else _NAMES[label]


def _with_unit(run: Run, label: str) -> str:
    return symbol(run, label) + (" [1]" if label.startswith("xi") else " [m]")


def moved(run: Run, label: str) -> tuple[Array, Array]:
    """Actual and desired values of a coordinate relative to the start, (N,) each."""
    k = run.chart.labels.index(label)
    start = run.reference.start[k]
    return run.trajectory.value[:, k] - start, run.trajectory.reference[:, k] - start


def draw_coordinates(axes: Any, run: Run) -> None:
    """Draw all coordinates over time, relative to their values at the start."""
    for label in run.chart.labels:
        actual, desired = moved(run, label)
        axes.plot(run.trajectory.times, desired, color=COLOURS[label], linewidth=_WIDE, alpha=_PALE)
        axes.plot(run.trajectory.times, actual, color=COLOURS[label], linewidth=_THIN)
    finish(axes, run)


def draw_joints(axes: Any, run: Run) -> None:
    """Draw joint angles over time, relative to their values at the start."""
    for joint, colour in enumerate(JOINTS):
        angle = run.trajectory.q[:, joint] - run.trajectory.q[0, joint]
        axes.plot(run.trajectory.times, angle, color=colour, linewidth=_THIN + 0.3)
    finish(axes, run)


def finish(axes: Any, run: Run) -> None:
    """Set ticks, grid and limits of a panel over time; shade in grey where the controller used its fallback."""
    times = run.trajectory.times
    axes.fill_between(times, 0, 1, where=run.trajectory.fell_back, transform=axes.get_xaxis_transform(), color="0.85")
    axes.set_xlim(0, times[-1])
    axes.set_xticks(np.arange(1, times[-1] + 0.1, 4))
    _style(axes)


def draw_plane(axes: Any, run: Run, across: str, up: str) -> None:
    """Draw the trajectory projected on the plane of two coordinates."""
    (actual_across, desired_across), (actual_up, desired_up) = moved(run, across), moved(run, up)
    axes.plot(desired_across, desired_up, color="0.4", linewidth=_WIDE, alpha=_PALE)
    axes.plot(actual_across, actual_up, color=INK, linewidth=_THIN)
    axes.set_xlabel(_with_unit(run, across), fontsize=LABEL, labelpad=1)
    axes.set_ylabel(_with_unit(run, up), fontsize=LABEL, labelpad=3)
    _style(axes)


def draw_planes(figure: Figure, cell: Any, run: Run) -> list[Any]:
    """Draw projections on all three planes of three coordinates with shared axes; one of the four cells stays empty."""
    first, second, third = run.chart.labels
    grid = cell.subgridspec(2, 2, wspace=0.0, hspace=0.0)
    lower_left = figure.add_subplot(grid[1, 0])
    upper_left = figure.add_subplot(grid[0, 0], sharex=lower_left)
    lower_right = figure.add_subplot(grid[1, 1], sharey=lower_left)
    draw_plane(lower_left, run, first, second)
    draw_plane(upper_left, run, first, third)
    draw_plane(lower_right, run, third, second)
    for axes in (lower_left, upper_left, lower_right):
        axes.locator_params(nbins=3)
    upper_left.tick_params(labelbottom=False)
    lower_right.tick_params(labelleft=False)
    upper_left.set_xlabel("")
    lower_right.set_ylabel("")
    return [lower_left, upper_left, lower_right]


def name_panel(axes: Any, text: str) -> None:
    """Put a title above a panel, on the left."""
    axes.set_title(text, fontsize=LABEL, loc="left", pad=4)


def curve_legend(figure: Figure, run: Run, joints: bool = True, extra: Sequence[Line2D] = ()) -> None:
    """Add one line at the bottom with the colours of coordinates and joints, and the meaning of pale and dark."""
    handles = [Line2D([], [], color=COLOURS[c], linewidth=2, label=symbol(run, c)) for c in run.chart.labels]
    if joints:
        handles += [Line2D([], [], color=c, linewidth=2, label=f"$q_{k}$") for k, c in enumerate(JOINTS, 1)]
    handles += [
        Line2D([], [], color="0.4", linewidth=_WIDE, alpha=_PALE, label="desired"),
        Line2D([], [], color="0.2", linewidth=_THIN, label="actual"),
        *extra,
    ]
    figure.legend(
        handles=handles,
        loc="outside lower center" if figure.get_layout_engine() else "lower center",
        ncols=len(handles),
        fontsize=TICK,
        frameon=False,
        columnspacing=1.2,
        handlelength=1.6,
    )


def _style(axes: Any) -> None:
    axes.tick_params(labelsize=TICK)
    axes.grid(alpha=0.3)


def interleaved(chart: Chart, quick: bool) -> Drawing:
    """Draw the picture of Figs. 22 and 23 for a chart around the base."""
    arm = Arm()
    run = follow(chart, arm.base(GENTLE), INTERLEAVED)
    return Drawing(
        {"": _picture(run)}, run.numbers() | {"task_angle_std_deg": task_angle_std(chart, arm.box(GENTLE), quick)}
    )


def _picture(run: Run) -> Figure:
    figure = new_figure(3.6)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1))
    above, below = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    draw_coordinates(above, run)
    draw_joints(below, run)
    plane = figure.add_subplot(grid[:, 1])
    draw_plane(plane, run, "x", "xi1")
    name_panel(above, "(a) coordinates [m], [1]")
    name_panel(plane, r"(b) plane of $x$ and $\xi_1$")
    name_panel(below, "(c) joint motion [rad]")
    below.set_xlabel("time [s]", fontsize=LABEL)
    curve_legend(figure, run)
    return figure
