"""[AS2023] Fig. 26: steps in x and xi for the task (x, y), with linear and fitted coordinates, and with feedback only.

Large steps are more than three times as large as small ones, so that no posture meets all targets of the linear
coordinates. Decoupled PD+ knows the full inertia of the task, so x and y hardly couple with feed-forward. Without
feed-forward they couple more with each other than with xi, as the paper says.
"""

from typing import Any

from matplotlib.figure import Figure

from .chosen_fit import USUAL, ChosenFit
from .closed_loop_picture import (
    curve_legend,
    draw_coordinates,
    draw_joints,
    draw_plane,
    name_panel,
)
from .drawing import Drawing
from .planar_loop import FOLDED, LARGE, SMALL, Arm, Run, follow, out_of_reach, task_angle_std
from .style import LABEL, new_figure

_TITLES = {
    "linear_small": "linear,\nsmall steps",
    "linear_large": "linear,\nlarge steps",
    "fitted_large": "fitted,\nlarge steps",
    "fitted_feedback": "fitted, large,\nfeedback only",
}


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw four columns of coordinates, plane and joints; the numbers describe each column."""
    arm = Arm()
    start, box = arm.base(FOLDED), arm.box(FOLDED)
    linear, fitted = arm.linear("xy", FOLDED), arm.fitted("xy", FOLDED, quick, chosen)
    runs = {
        "linear_small": follow(linear, start, SMALL),
        "linear_large": follow(linear, start, LARGE),
        "fitted_large": follow(fitted, start, LARGE),
        "fitted_feedback": follow(fitted, start, LARGE, feed_forward=False),
    }
    numbers = {key: value for name, run in runs.items() for key, value in run.numbers(f"{name}_").items()}
    angles = {
        f"{name}_task_angle_std_deg": task_angle_std(chart, box, quick)
        for name, chart in (("linear", linear), ("fitted", fitted))
    }
    reach = {f"{name}_out_of_reach_m": out_of_reach(runs[name]) for name in ("linear_small", "linear_large")}
    return Drawing({"": _picture(runs)}, numbers | angles | reach)


def _picture(runs: dict[str, Run]) -> Figure:
    figure = new_figure(5.3)
    rows: Any = figure.subplots(3, len(runs), height_ratios=(1, 1.15, 0.9), sharey="row")
    for column, (name, run) in enumerate(runs.items()):
        above, plane, below = rows[:, column]
        draw_coordinates(above, run)
        draw_plane(plane, run, "x", "xi1")
        draw_joints(below, run)
        texts = (_TITLES[name], "", "")
        for axes, text, letters in zip((above, plane, below), texts, ("abcd", "efgh", "ijkl"), strict=True):
            name_panel(axes, f"({letters[column]}) {text}")
        below.set_xlabel("time [s]", fontsize=LABEL)
        plane.sharex(rows[1, 0])
        plane.autoscale()
        if column:
            plane.set_ylabel("")
    rows[0, 0].set_ylabel("motion in $x$, $y$ [m],\n$\\xi$ [1]", fontsize=LABEL)
    rows[2, 0].set_ylabel("joint motion\n[rad]", fontsize=LABEL)
    curve_legend(figure, runs["linear_small"])
    return figure
