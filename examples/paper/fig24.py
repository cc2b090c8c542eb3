"""[AS2023] Fig. 24: steps in x, xi1 and xi2 with PD+; linear coordinates at two bases, and fitted ones at the second.

Both bases have their tip at x = 0, as in the paper. At the second base, the leaves of x have ten times the curvature,
and linear coordinates contradict the task: the line in joint space where xi1 and xi2 have their target values stays
away from the leaf where x has its target value.
"""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .chosen_fit import USUAL, ChosenFit
from .closed_loop_picture import (
    COLOURS,
    curve_legend,
    draw_coordinates,
    draw_joints,
    draw_planes,
    name_panel,
    symbol,
)
from .drawing import Drawing
from .joint_space_path import SHEETS, draw_path
from .planar_loop import (
    ALL_OF_X,
    GENTLE,
    STRONG,
    Arm,
    Place,
    Run,
    follow,
    out_of_reach,
    task_angle_std,
)
from .style import LABEL, TICK, add_3d, new_figure

_TARGETS = (0.0, 0.25)  # targets of x [m]
_GRID = np.array([np.linspace(-0.04, 0.34, 13), np.linspace(-0.34, 0.04, 13)])  # xi1 and xi2 of the coordinate lines
_COLUMNS = {  # name: title, place, view of the camera
    "gentle_linear": ("linear, low curvature", GENTLE, (15, 60)),
    "strong_linear": ("linear, high curvature", STRONG, (20, 35)),
    "strong_fitted": ("fitted, high curvature", STRONG, (20, 45)),
}
_LEFT, _RIGHT = 0.115, 0.985


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw three columns of coordinates, planes, joints and curves in joint space; the numbers describe each column."""
    arm = Arm()
    charts = {
        "gentle_linear": arm.linear("x", GENTLE),
        "strong_linear": arm.linear("x", STRONG),
        "strong_fitted": arm.fitted("x", STRONG, quick, chosen),
    }
    figure = new_figure(10.0, layout=None)
    grid = figure.add_gridspec(
        3, 3, left=_LEFT, right=_RIGHT, top=0.96, bottom=0.46, height_ratios=(1, 1.7, 0.9), hspace=0.42, wspace=0.42
    )
    numbers: dict[str, float] = {}
    for column, (name, (title, place, view)) in enumerate(_COLUMNS.items()):
        run = follow(charts[name], arm.base(place), ALL_OF_X)
        _draw_column(figure, [grid[row, column] for row in range(3)], run, column, title)
        axes = add_3d(figure, 0.005 + 0.33 * column, 0.085, 0.335, 0.3)
        axes.text2D(0.1, 1.06, f"({'jkl'[column]}) joint space", fontsize=LABEL, transform=axes.transAxes)
        lines = _GRID if name == "strong_fitted" else None
        draw_path(axes, run, _TARGETS, view, 16 if quick else 40, lines)
        numbers |= run.numbers(f"{name}_")
        numbers[f"{name}_task_angle_std_deg"] = task_angle_std(charts[name], arm.box(place), quick)
        numbers[f"{name}_curvature_per_rad"] = largest_curvature(arm, place)
        if charts[name].coordinates.label == "linear":
            numbers[f"{name}_out_of_reach_m"] = out_of_reach(run)
    _legends(figure, run)
    return Drawing({"": figure}, numbers)


def largest_curvature(arm: Arm, place: Place) -> float:
    """Largest principal curvature of the leaf of x in joint space, at the base [1/rad]."""
    chart, q = arm.linear("x", place), arm.base(place)
    second = chart.function("second_derivative")
    unit = np.eye(3)
    hessian = np.array([[float(second(q, unit[i], unit[j])[0]) for j in range(3)] for i in range(3)])
    slope = chart.jacobian(q)[0]
    tangents = np.linalg.svd(slope[None])[2][1:]
    curvatures = np.linalg.eigvalsh(tangents @ hessian @ tangents.T) / np.linalg.norm(slope)
    return float(np.abs(curvatures).max())


def _draw_column(figure: Figure, cells: list[Any], run: Run, column: int, title: str) -> None:
    """Draw coordinates, planes and joints."""
    above = figure.add_subplot(cells[0])
    draw_coordinates(above, run)
    planes = draw_planes(figure, cells[1], run)
    below = figure.add_subplot(cells[2])
    draw_joints(below, run)
    below.set_xlabel("time [s]", fontsize=LABEL, labelpad=1)
    box = above.get_position()
    figure.text((box.x0 + box.x1) / 2, 0.982, title, fontsize=LABEL, fontweight="bold", ha="center")
    names = "coordinates [m], [1]", "coordinate planes", "joint motion [rad]"
    for axes, name, letters in zip((above, planes[1], below), names, ("abc", "def", "ghi"), strict=True):
        name_panel(axes, f"({letters[column]}) {name}")


def _legends(figure: Figure, run: Run) -> None:
    sheets = [Patch(color=colour, label=f"$x = {x:g}$ m") for x, colour in zip(_TARGETS, SHEETS, strict=True)]
    lines = [
        Line2D([], [], color=COLOURS[label], linewidth=1, label=rf"{symbol(run, label)} = const")
        for label in ("xi1", "xi2")
    ]
    figure.legend(
        handles=sheets + lines, loc="lower center", bbox_to_anchor=(0.5, 0.028), ncols=4, fontsize=TICK, frameon=False
    )
    curve_legend(figure, run)
