"""[AS2023] Fig. 30: steps in x, y and xi with fitted coordinates for the task (x, y), with and without feed-forward."""

from typing import Any

from matplotlib.figure import Figure

from .chosen_fit import USUAL, ChosenFit
from .closed_loop_picture import (
    curve_legend,
    draw_coordinates,
    draw_joints,
    draw_planes,
    name_panel,
)
from .drawing import Drawing
from .planar_loop import ALL_OF_XY, FOLDED, Arm, Run, follow, task_angle_std
from .style import LABEL, new_figure

_TITLES = {"feed_forward": "with feed-forward", "feedback": "feedback only"}


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw two columns of coordinates, planes and joints; the numbers describe each column."""
    arm = Arm()
    chart, start = arm.fitted("xy", FOLDED, quick, chosen), arm.base(FOLDED)
    runs = {name: follow(chart, start, ALL_OF_XY, name == "feed_forward") for name in _TITLES}
    numbers = {key: value for name, run in runs.items() for key, value in run.numbers(f"{name}_").items()}
    numbers["task_angle_std_deg"] = task_angle_std(chart, arm.box(FOLDED), quick)
    return Drawing({"": _picture(runs)}, numbers)


def _picture(runs: dict[str, Run]) -> Figure:
    figure = new_figure(6.4)
    grid = figure.add_gridspec(3, 2, height_ratios=(1, 1.9, 0.8))
    first: dict[int, Any] = {}  # the axes of the first column
    for column, (name, run) in enumerate(runs.items()):
        above, below = (figure.add_subplot(grid[row, column], sharey=first.get(row)) for row in (0, 2))
        draw_coordinates(above, run)
        planes = draw_planes(figure, grid[1, column], run)
        planes[0].sharex(first.setdefault(3, planes[0]))
        planes[0].sharey(first[3])
        planes[0].autoscale()
        first |= {0: above, 2: below}
        draw_joints(below, run)
        below.set_xlabel("time [s]", fontsize=LABEL)
        texts = f"{_TITLES[name]}: motion in $x$, $y$ [m], $\\xi$ [1]", "coordinate planes", "joint motion [rad]"
        for axes, text, letters in zip((above, planes[1], below), texts, ("ab", "cd", "ef"), strict=True):
            name_panel(axes, f"({letters[column]}) {text}")
    curve_legend(figure, runs["feedback"])
    return figure
