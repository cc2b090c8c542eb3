"""[AS2023] Fig. 9: orthogonal foliations of the plane of two joints for dynamic consistency, A = M.

M^-1 J_x^T is tangent to the leaves of xi, and J_xi is orthogonal to them. M^-1 J_xi^T is tangent to the leaves of the
task, and J_x is orthogonal to them. All arrows have the same length, as if the rows were scaled.
"""

from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from orthocas.charts.chart import Chart
from orthocas.tasks.samples import evaluate_samples
from orthocas.tools.checks import Array

from .drawing import Drawing
from .planar_flow import (
    LEVEL,
    base_leaf,
    cosines_by_differences,
    flow_lines,
    grown_chart,
    planar_problem,
)
from .style import INK, LABEL, TASK, TICK, find_axis, new_figure

_LOW, _HIGH = np.array([1, -1]) * np.pi / 12, np.array([6, 4]) * np.pi / 12  # corners of the patch [rad]
_LEVELS = {-0.2: "-3", 0.2: "-2", 0.6: "-1", LEVEL: "0", 1.4: "1"}  # task value [m] -> name of the leaf
_VALUES = np.linspace(-1.2, 1.2, 19)  # xi on the leaves in the figure [rad]
_CROSSINGS = ((1.0, -0.5), (1.0, 0.0), (0.6, 0.4), (0.2, 0.1))  # (x, xi) of the arrows
_PAPER = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
_LENGTH = 0.16  # length of arrows [rad]
_ARROWS = {  # text -> colour, as in the paper
    r"$J_x$": "#0b2f6b",
    r"$M^{-1}J_x^\mathsf{T}$": INK,
    r"$J_\xi$": "#f28e2b",
    r"$M^{-1}J_\xi^\mathsf{T}$": "#c8102e",
}


def draw(quick: bool) -> Drawing:
    """Draw leaves and arrows; the numbers show the accuracy of right angles, and that gradients are not parallel."""
    chart = grown_chart(planar_problem("inertia"))
    figure = new_figure(4.3, layout=None)
    axes = figure.add_axes((0.1, 0.12, 0.54, 0.77))
    _draw_leaves(axes, chart, 20 if quick else 100)
    crossings = chart.inverse(_CROSSINGS, np.tile((_LOW + _HIGH) / 2, (len(_CROSSINGS), 1)))
    for vectors, colour in zip(_vectors(chart, crossings), _ARROWS.values(), strict=True):
        unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        for start, along in zip(crossings, _LENGTH * unit, strict=True):
            arrow = {"arrowstyle": "-|>,head_width=0.22,head_length=0.45", "color": colour, "linewidth": 1.7}
            axes.annotate("", start + along, start, arrowprops=arrow | {"shrinkA": 0, "shrinkB": 0}, zorder=5)
    axes.plot(*crossings.T, "o", color="white", markeredgecolor=INK, markersize=4, zorder=6)
    _add_legend(figure)
    for k, letter in enumerate("xy"):
        find_axis(axes, letter, k + 1, float(_LOW[k]), float(_HIGH[k]), parts=5)
    axes.set_aspect("equal")
    return Drawing({"": figure}, _numbers(chart, 400 if quick else 20_000))


def _draw_leaves(axes: Any, chart: Chart, steps: int) -> None:
    """Draw leaves of the task with their names, and leaves of xi, which are flow lines through the base leaf."""
    q = np.stack(np.meshgrid(*np.linspace(_LOW, _HIGH, 121).T), axis=-1)
    h = chart.x(q.reshape(-1, 2)).reshape(121, 121)
    widths = [2.4 if level == LEVEL else 1.4 for level in _LEVELS]
    axes.contour(q[..., 0], q[..., 1], h, levels=list(_LEVELS), colors=TASK, linewidths=widths, linestyles="-")
    for level, name in _LEVELS.items():
        k = int(np.argmin(np.abs(h[-1] - level)))  # where the leaf leaves the patch at the top
        text = f"$S_{{{name}}}$: {level:g} m"
        axes.annotate(text, q[-1, k], (-3, 3), textcoords="offset points", fontsize=TICK, color=TASK, rotation=35)
    axes.text(0.03, 0.03, "to the maximum of $x$,\nat $q = 0$", fontsize=TICK, transform=axes.transAxes, bbox=_PAPER)
    seeds = base_leaf(chart).points(_VALUES[:, None])
    for goal in (1.999, -1.5):
        for curve in flow_lines(chart.problem, seeds, np.full(len(seeds), goal), steps):
            axes.plot(*curve.T, color=INK, linewidth=1.0)


def _vectors(chart: Chart, points: Array) -> list[Array]:
    """J_x, M^-1 J_x^T, J_xi and M^-1 J_xi^T at points (N, 2), each (N, 2)."""
    J = chart.jacobian(points)
    raised = evaluate_samples(chart.problem, points).compute_metric_gradients(J)
    return [J[:, 0], raised[:, 0], J[:, 1], raised[:, 1]]


def _add_legend(figure: Any) -> None:
    arrows = [Line2D([], [], color=colour, linewidth=2.2, label=text) for text, colour in _ARROWS.items()]
    task = Line2D([], [], color=TASK, linewidth=1.4, label="leaves $S_i$ of the task, $x$")
    extra = Line2D([], [], color=INK, linewidth=1.0, label=r"leaves of $\xi$")
    figure.legend(
        handles=[task, extra, *arrows], loc="center left", bbox_to_anchor=(0.67, 0.5), fontsize=LABEL, frameon=False
    )


def _numbers(chart: Chart, samples: int) -> dict[str, float]:
    """Measurements at random points of the patch."""
    points = np.random.default_rng(0).uniform(_LOW, _HIGH, (samples, 2))
    vectors = _vectors(chart, points)
    J_x, _, J_xi, raised_xi = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in vectors)
    by_differences = np.abs(cosines_by_differences(chart, points))
    angles = np.degrees(np.arccos((J_xi * raised_xi).sum(axis=1)))
    return {
        "largest_cosine_J_x_and_raised_J_xi": float(np.abs((J_x * raised_xi).sum(axis=1)).max()),
        "median_cosine_from_differences_of_xi": float(np.median(by_differences)),
        "mean_angle_J_xi_and_raised_J_xi_deg": float(angles.mean()),
        "largest_angle_J_xi_and_raised_J_xi_deg": float(angles.max()),
        "least_angle_J_xi_and_raised_J_xi_deg": float(angles.min()),
        "mean_cosine_J_x_and_J_xi": float(np.abs((J_x * J_xi).sum(axis=1)).mean()),
    }
