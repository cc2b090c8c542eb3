"""Figs. 12 and 14 of [AS2023]: integral curves of +-grad_A h in the plane and on the 2-torus, and pulls onto S0."""

from collections import Counter
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from orthocas.charts.chart import Chart
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

from .drawing import Drawing
from .fig06 import above, embedded, torus_faces
from .painting import Isolines
from .planar_flow import (
    EXTREME,
    LEVEL,
    NAMES,
    base_leaf,
    cell_centres,
    corners,
    distance_to,
    flow_lines,
    grown_chart,
    grown_coordinates,
    mark_singular,
    planar_problem,
    plot_wrapped,
    singular_symbols,
    symbol,
)
from .scene import Scene
from .self_motion import wrapped
from .singularities import SingularPoint, singular_points
from .style import EXTRA, GREY, INK, LABEL, TASK, TICK, TURN, add_3d, joint_plane, new_figure

_LEVELS = np.linspace(-1.8, 1.8, 10)  #: task values of the drawn leaves [m]
_PULLED = np.array([[2.5, 0.6], [-1.2, -1.9], [-0.25, 0.45]])  #: start points of example pulls [rad]
_PULL, _END = "#c8102e", "#7b2fbe"
_EVERY = 3  # only one in so many curves is drawn; the numbers are of all
_BIG = 2.95  # reach of the torus of `embedded`


def draw_flow(metric: str, quick: bool) -> Drawing:
    """Draw plane and torus; the numbers tell where the curves end and how exactly pulled points lie on S0.

    Args:
        metric: "euclidean" or "inertia".
        quick: draw fewer curves and points.
    """
    problem = planar_problem(metric)
    chart, singular = grown_chart(problem), singular_points(problem)
    starts = cell_centres(6 if quick else 10)  # away from the lines of symmetry
    steps = 30 if quick else 120
    up, down = (flow_lines(problem, starts, np.full(len(starts), sign * EXTREME), steps) for sign in (1, -1))
    pulls = flow_lines(problem, _PULLED, np.full(len(_PULLED), LEVEL), steps)
    figure = new_figure(3.85, layout=None)
    left = figure.add_axes((0.105, 0.285, 0.4, 0.655))
    shown = up[::_EVERY] + down[::_EVERY]
    _draw_plane(left, chart, shown, starts[::_EVERY], pulls)
    mark_singular(left, singular)
    left.set_title(f"(a) in the plane, ${NAMES[metric]}$", fontsize=LABEL)
    right = add_3d(figure, 0.51, 0.22, 0.49, 0.76)
    _draw_torus(right, chart, shown, pulls, singular, 50 if quick else 160)
    right.text2D(0.5, 0.93, "(b) on the 2-torus", fontsize=LABEL, ha="center", transform=right.transAxes)
    _add_legend(figure)
    numbers = _curve_numbers(up, down, singular) | _pull_numbers(chart, pulls, 1000 if quick else 50_000)
    return Drawing({"": figure}, numbers)


def _draw_plane(axes: Any, chart: Chart, curves: list[Array], starts: Array, pulls: list[Array]) -> None:
    q, points = corners(160)
    h = chart.x(points).reshape(161, 161)
    axes.contour(q, q, h, levels=_LEVELS, colors=TASK, linewidths=0.8, linestyles="-")
    plot_wrapped(axes, curves, color=EXTRA, linewidth=0.7)
    axes.plot(*starts.T, "+", color=GREY, markersize=4.5, markeredgewidth=0.9, zorder=3)
    plot_wrapped(axes, [base_leaf(chart).curve], color=INK, linewidth=2.0, zorder=4)
    plot_wrapped(axes, pulls, color=_PULL, linewidth=2.0, zorder=4)
    for k, colour in ((0, INK), (-1, _END)):
        ends = wrapped(np.array([pull[k] for pull in pulls]))
        axes.plot(*ends.T, "x", color=colour, markersize=7, markeredgewidth=2.0, zorder=7)
    joint_plane(axes)


def _draw_torus(
    axes: Any, chart: Chart, curves: list[Array], pulls: list[Array], singular: tuple[SingularPoint, ...], cells: int
) -> None:
    around, along = np.arange(cells) * TURN / cells, np.arange(cells // 2) * 2 * TURN / cells
    q = np.stack(np.meshgrid(around, along, indexing="ij"), axis=-1).reshape(-1, 2)
    colours = np.tile([0.12, 0.37, 0.66, 1.0], (len(_LEVELS), 1))
    scene = Scene()
    lines = Isolines(chart.x(q)[:, 0], _LEVELS, colours, 0.035)
    scene.add_surface(embedded(q), torus_faces(cells, cells // 2), "#eef1f4", lines=lines)
    for curve in curves:
        scene.add_tube(above(_thinned(curve), 0.016), 0.016, EXTRA)
    scene.add_tube(above(base_leaf(chart).curve[::10], 0.04), 0.05, INK)
    for pull in pulls:
        scene.add_tube(above(_thinned(pull), 0.04), 0.05, _PULL)
        scene.add_ball(embedded(pull[:1])[0], 0.1, INK)
        scene.add_ball(embedded(pull[-1:])[0], 0.1, _END)
    for point in embedded(np.array([s.point for s in singular])):
        scene.add_ball(point, 0.12, "white")
    scene.draw(axes, (48, -14), (-_BIG, -_BIG, -0.95), (_BIG, _BIG, 0.95), zoom=1.3)
    axes.set_axis_off()


def _thinned(curve: Array, step: float = 0.02) -> Array:
    """A curve without points closer than a step to the previous one, because tubes need directions."""
    kept = [0]
    for k in range(1, len(curve)):
        if np.linalg.norm(curve[k] - curve[kept[-1]]) > step:
            kept.append(k)
    return curve[kept]


def _add_legend(figure: Any) -> None:
    handles = [
        Line2D([], [], color=TASK, label="leaves of the task"),
        Line2D([], [], color=EXTRA, label=r"curves of $\pm\nabla_A h$"),
        symbol("+", GREY, "their start points"),
        Line2D([], [], color=INK, linewidth=2, label="base leaf $S_0$, $x = 1$ m"),
        Line2D([], [], color=_PULL, linewidth=2, label="pull onto $S_0$"),
        symbol("x", INK, "start of pull"),
        symbol("x", _END, "end of pull"),
        *singular_symbols(),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=4, fontsize=TICK, frameon=False, columnspacing=1.4)


def _curve_numbers(up: list[Array], down: list[Array], singular: tuple[SingularPoint, ...]) -> dict[str, float]:
    """End points of curves; curves that start on the line into a saddle end there."""
    ends = np.array([curve[-1] for curve in up + down])
    kinds = [singular[int(np.argmin([distance_to(end[None], (s,))[0] for s in singular]))].kind for end in ends]
    counts = Counter(kinds)
    return {
        "curves": float(len(up)),
        "ends_at_maximum": float(counts["maximum"]),
        "ends_at_minimum": float(counts["minimum"]),
        "ends_at_saddles": float(counts["saddle"]),
        "distance_of_ends_from_singular_points": float(distance_to(ends, singular).max()),
    }


def _pull_numbers(chart: Chart, pulls: list[Array], samples: int) -> dict[str, float]:
    """Accuracy of the drawn pulls and of pulls from random points of the torus."""
    moved = grown_coordinates(chart).pull(sample_uniform(chart.problem.domain, samples, 0))
    drawn = np.array([pull[-1] for pull in pulls])
    return {
        "task_error_of_drawn_pulls": float(np.abs(chart.x(drawn) - LEVEL).max()),
        "task_error_of_pulls": float(np.abs(chart.x(moved.points[moved.reached]) - LEVEL).max()),
        "share_that_reaches_base_leaf": float(moved.reached.mean()),
        "length_of_base_leaf": float(base_leaf(chart).length[0]),
    }
