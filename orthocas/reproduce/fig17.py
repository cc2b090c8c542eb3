"""[AS2023] Fig. 17: coordinates of the planar arm with two joints, fitted on the whole torus, for A = I and A = M.

No smooth function parametrises closed leaves with one number, so there are regions of bad fit. They lie along the lines
that flow into singular points, and along folds, where xi has its extrema on the leaves. Neighbouring isolines of xi
enclose equal parts of the torus, and the parts with xi > 0 and xi < 0 are equal.
"""

from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.growing.circle_leaf import circle_leaf
from orthocas.growing.flow import TaskFlow
from orthocas.reproduce.drawing import Drawing
from orthocas.reproduce.planar_fit import fitted_from_grown, freely_fitted
from orthocas.reproduce.planar_flow import (
    NAMES,
    cell_centres,
    corners,
    deviations,
    grown_chart,
    mark_singular,
    planar_problem,
    singular_symbols,
)
from orthocas.reproduce.style import EXTRA, LABEL, TASK, TICK, joint_plane, new_figure
from orthocas.singularities import singular_points

_LEAVES = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)  # task values of the leaves on which values of xi are counted [m]
_INSIDE = (0.3, 0.8)  # a point from which the flow reaches all leaves [rad]
_SHADES = "Greys"
_FITS = {"euclidean": fitted_from_grown, "inertia": freely_fitted}
_GOOD = 10.0  # deviation [deg]


def draw(quick: bool) -> Drawing:
    """Draw isolines over the angle; the numbers tell the deviations and how often a value occurs on a leaf."""
    cells = 60 if quick else 240
    figure = new_figure(3.7, layout=None)
    numbers: dict[str, float] = {}
    for k, metric in enumerate(NAMES):
        chart = _FITS[metric](planar_problem(metric), quick)
        points = cell_centres(cells)
        angles = deviations(chart.problem, points, chart.jacobian(points)[:, 1])
        axes = figure.add_axes((0.1 + 0.405 * k, 0.25, 0.37, 0.67))
        _draw_plane(axes, chart, angles.reshape(cells, cells), cells)
        axes.set_title(f"({'ab'[k]}) ${NAMES[metric]}$", fontsize=LABEL)
        if k > 0:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
        numbers |= {f"{metric}_{key}": value for key, value in _numbers(chart, points, angles).items()}
    bar = figure.colorbar(ScalarMappable(Normalize(0, 90), _SHADES), cax=figure.add_axes((0.905, 0.28, 0.014, 0.61)))
    bar.set_ticks(list(range(0, 91, 15)))
    bar.ax.tick_params(labelsize=TICK)
    bar.set_label(r"$|\angle(\mathrm{d}\xi, \nabla_A h) - 90°|$ [deg]", fontsize=LABEL)
    free = freely_fitted(planar_problem("euclidean"), quick)
    angles = deviations(free.problem, points, free.jacobian(points)[:, 1])
    numbers["euclidean_free_start_median_deviation_deg"] = float(np.median(angles))
    numbers["euclidean_free_start_share_of_values_twice"] = float(np.mean(_counts(free) == 2))
    figure.legend(handles=_entries(), loc="lower center", ncols=4, fontsize=TICK, frameon=False, columnspacing=1.4)
    return Drawing({"": figure}, numbers)


def _draw_plane(axes: Any, chart: Chart, angles: Array, cells: int) -> None:
    axes.imshow(angles, extent=2 * (-np.pi, np.pi), origin="lower", cmap=_SHADES, vmin=0, vmax=90)
    q, points = corners(cells)
    h, xi = (values.reshape(cells + 1, cells + 1) for values in chart.phi(points).T)
    axes.contour(q, q, h, levels=np.linspace(-1.75, 1.75, 8), colors=TASK, linewidths=0.8, linestyles="-")
    xi = xi - np.median(xi)  # xi is defined up to a constant
    axes.contour(q, q, xi, levels=np.quantile(xi, np.linspace(0.025, 0.975, 20)), colors=EXTRA, linewidths=0.9)
    mark_singular(axes, singular_points(chart.problem))
    joint_plane(axes)


def _entries() -> list[Line2D]:
    return [
        Line2D([], [], color=EXTRA, label=r"$\xi > 0$"),
        Line2D([], [], color=EXTRA, linestyle="--", label=r"$\xi < 0$"),
        Line2D([], [], color=TASK, label="leaves of the task, $x$ constant"),
        *singular_symbols(),
    ]


def _numbers(chart: Chart, points: Array, angles: Array) -> dict[str, float]:
    counts = _counts(chart)
    good = points[angles < _GOOD]
    return {
        "median_deviation_deg": float(np.median(angles)),
        "deviation_95_percent_deg": float(np.quantile(angles, 0.95)),
        "share_above_10_deg": float(np.mean(angles > _GOOD)),
        "least_times_of_a_value_on_a_leaf": float(counts.min()),
        "largest_times_of_a_value_on_a_leaf": float(counts.max()),
        "share_of_values_twice_on_a_leaf": float(np.mean(counts == 2)),
        "median_angle_to_grown_gradient_deg": float(np.median(_angles_to_grown(chart, good))),
    }


def _counts(chart: Chart) -> Array:
    """How often values occur on leaves, for several leaves and values."""
    return np.concatenate([_crossings(chart, level) for level in _LEAVES])


def _crossings(chart: Chart, level: float, values: int = 21) -> Array:
    """How often each of some values between the extrema of xi occurs on a closed leaf."""
    flow, x0 = TaskFlow(chart.problem), np.array([level])
    start = flow.pull(np.array([_INSIDE]), x0, 1e-12).points[0]
    xi = chart.xi(circle_leaf(chart.problem, x0, start).curve)[:, 0]
    wanted = np.linspace(xi.min(), xi.max(), values + 2)[1:-1]
    crossings: Array = np.count_nonzero(np.diff(xi > wanted[:, None], axis=1), axis=1)
    return crossings


def _angles_to_grown(chart: Chart, points: Array, most: int = 5000) -> Array:
    """Angles between the gradient lines of fitted and grown coordinates [deg]."""
    some = points[:: len(points) // most + 1]
    fitted, grown = (c.jacobian(some)[:, 1] for c in (chart, grown_chart(chart.problem)))
    sines = (fitted[:, 0] * grown[:, 1] - fitted[:, 1] * grown[:, 0]) / (
        np.linalg.norm(fitted, axis=1) * np.linalg.norm(grown, axis=1)
    )
    angles: Array = np.degrees(np.arcsin(np.clip(np.abs(sines[np.isfinite(sines)]), 0, 1)))
    return angles
