"""[AS2023] Fig. 22: interleaved steps in x and xi1 with linear coordinates where leaves are little curved, PD+.

Arm, base, gains and steps stand in `orthocas.reproduce.planar_loop`; Fig. 23 takes the same with fitted coordinates.
"""

from matplotlib.figure import Figure

from orthocas.chart import Chart
from orthocas.reproduce.closed_loop_picture import (
    curve_legend,
    draw_coordinates,
    draw_joints,
    draw_plane,
    name_panel,
)
from orthocas.reproduce.drawing import Drawing
from orthocas.reproduce.planar_loop import GENTLE, INTERLEAVED, Arm, Run, follow, task_angle_std
from orthocas.reproduce.style import LABEL, new_figure


def draw(quick: bool) -> Drawing:
    """Coordinates over time, their plane, and joints; numbers tell the coupling."""
    return interleaved(Arm().linear("x", GENTLE), quick)


def interleaved(chart: Chart, quick: bool) -> Drawing:
    """The picture of Figs. 22 and 23 for a chart around the base."""
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
