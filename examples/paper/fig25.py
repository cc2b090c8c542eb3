"""[AS2023] Fig. 25: the steps of Fig. 23 with feedback only, and the sources of unwanted task acceleration.

Impedance control (33) regulates: it receives the desired position, but no desired velocity or acceleration.
"""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from orthocas.simulation import Breakdown, task_acceleration_breakdown

from .chosen_fit import USUAL, ChosenFit
from .closed_loop_picture import (
    curve_legend,
    draw_coordinates,
    draw_joints,
    draw_plane,
    finish,
    name_panel,
)
from .drawing import Drawing
from .planar_loop import GENTLE, INTERLEAVED, Arm, Run, follow, task_angle_std
from .style import LABEL, TICK, new_figure

_PARTS = {  #: terms of the unwanted task acceleration: field of the breakdown, name, colour
    "curvature": ("curvature", "#0b84a5"),
    "coriolis": ("Coriolis and centrifugal", "#d8a200"),
    "error": ("error (38)", "#c8102e"),
}


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw coordinates, acceleration terms, plane and joints; numbers compare the terms, also for linear charts."""
    arm = Arm()
    chart = arm.fitted("x", GENTLE, quick, chosen)
    run = follow(chart, arm.base(GENTLE), INTERLEAVED, feed_forward=False)
    linear = follow(arm.linear("x", GENTLE), arm.base(GENTLE), INTERLEAVED, feed_forward=False)
    numbers = run.numbers() | {"task_angle_std_deg": task_angle_std(chart, arm.box(GENTLE), quick)}
    numbers |= parts(run) | {f"linear_{key}": value for key, value in parts(linear).items()}
    return Drawing({"": _picture(run)}, numbers)


def parts(run: Run) -> dict[str, float]:
    """Largest and root mean square value of each term [m/s^2]."""
    found = _breakdown(run)
    largest = {f"largest_{name}": float(np.abs(getattr(found, name)).max()) for name in _PARTS}
    return largest | {f"rms_{name}": float(np.sqrt(np.mean(getattr(found, name) ** 2))) for name in _PARTS}


def _breakdown(run: Run) -> Breakdown:
    return task_acceleration_breakdown(run.chart, run.trajectory)


def _picture(run: Run) -> Figure:
    figure = new_figure(4.9)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1))
    coordinates, accelerations, joints = (figure.add_subplot(grid[row, 0]) for row in range(3))
    plane = figure.add_subplot(grid[:, 1])
    draw_coordinates(coordinates, run)
    _draw_parts(accelerations, run)
    draw_plane(plane, run, "x", "xi1")
    draw_joints(joints, run)
    name_panel(coordinates, "(a) coordinates [m], [1]")
    name_panel(accelerations, r"(b) unwanted task acceleration [m/s$^2$]")
    name_panel(plane, r"(c) plane of $x$ and $\xi_1$")
    name_panel(joints, "(d) joint motion [rad]")
    joints.set_xlabel("time [s]", fontsize=LABEL)
    accelerations.legend(fontsize=TICK - 1, loc="lower left", frameon=False, borderpad=0, labelspacing=0.2)
    curve_legend(figure, run)
    return figure


def _draw_parts(axes: Any, run: Run) -> None:
    found = _breakdown(run)
    for field, (name, colour) in _PARTS.items():
        axes.plot(run.trajectory.times, getattr(found, field)[:, 0], color=colour, linewidth=1.2, label=name)
    finish(axes, run)
