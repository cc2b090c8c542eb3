"""[AS2023] Fig. 17: a network on the whole torus of the planar arm with two joints: untrained, for A = I and for A = M.

No smooth function parametrises closed leaves with one number, so there are regions of bad fit. They lie along the lines
that flow into singular points, and along folds, where xi has its extrema on the leaves. Neighbouring isolines of xi
enclose equal parts of the torus, and the parts with xi > 0 and xi < 0 are equal.
"""

from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D

from orthocas.charts.chart import Chart
from orthocas.exact.flow import TaskFlow
from orthocas.exact.leaves import trace_circle_leaf
from orthocas.tools.checks import Array

from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing
from .planar_fit import fitted_from_grown, freely_fitted, untrained, with_other_seed
from .planar_flow import (
    NAMES,
    cell_centres,
    corners,
    deviations,
    grown_chart,
    mark_singular,
    planar_problem,
    singular_symbols,
)
from .singularities import singular_points
from .style import EXTRA, LABEL, TASK, TICK, joint_plane, new_figure

_LEAVES = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)  # task values of the leaves on which values of xi are counted [m]
_INSIDE = (0.3, 0.8)  # a point from which the flow reaches all leaves [rad]
_SHADES = "Greys"
_GOOD = 10.0  # deviation [deg]
_SEEDS = 3  # starts of each network; the one of least loss is drawn


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw isolines over the angle; for three starts, the numbers tell deviations and how often values occur on leaves.

    Those with `from_grown` belong to the minimum whose values occur twice on a leaf, as the paper describes.
    """
    cells, points = 60 if quick else 240, cell_centres(60 if quick else 240)
    starts = [with_other_seed(chosen, k) for k in range(1 if quick else _SEEDS)]
    fits = {metric: [freely_fitted(metric, quick, start) for start in starts] for metric in NAMES}
    charts = [untrained(quick, chosen), *(min(fits[metric], key=lambda c: _loss(c, points)) for metric in NAMES)]
    titles = ("untrained", *(f"${name}$" for name in NAMES.values()))
    figure = new_figure(3.05, layout=None)
    for k, (chart, title) in enumerate(zip(charts, titles, strict=True)):
        axes = figure.add_axes((0.075 + 0.28 * k, 0.265, 0.25, 0.66))
        _draw_plane(axes, chart, _deviations(chart, points).reshape(cells, cells), cells)
        axes.set_title(f"({'abc'[k]}) {title}", fontsize=LABEL)
        if k > 0:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
    bar = figure.colorbar(ScalarMappable(Normalize(0, 90), _SHADES), cax=figure.add_axes((0.912, 0.32, 0.012, 0.55)))
    bar.set_ticks(list(range(0, 91, 15)))
    bar.ax.tick_params(labelsize=TICK)
    bar.set_label(r"$|\angle(\mathrm{d}\xi, \nabla_A h) - 90°|$ [deg]", fontsize=TICK)
    figure.legend(handles=_entries(), loc="lower center", ncols=4, fontsize=TICK, frameon=False, columnspacing=1.4)
    numbers = {"untrained_median_deviation_deg": float(np.median(_deviations(charts[0], points)))}
    for metric in NAMES:
        for k, chart in enumerate(fits[metric], 1):
            numbers |= {f"{metric}_{key}_of_start_{k}": value for key, value in _numbers(chart, points).items()}
    special = fitted_from_grown(planar_problem("euclidean"), quick)
    numbers |= {f"euclidean_{key}_from_grown": value for key, value in _numbers(special, points).items()}
    return Drawing({"": figure}, numbers)


def _loss(chart: Chart, points: Array) -> float:
    """The mean squared cosine (25) at points of a grid."""
    return float(np.mean(np.sin(np.radians(_deviations(chart, points))) ** 2))


def _deviations(chart: Chart, points: Array) -> Array:
    return deviations(chart.problem, points, chart.jacobian(points)[:, 1])


def _draw_plane(axes: Any, chart: Chart, angles: Array, cells: int) -> None:
    axes.imshow(angles, extent=2 * (-np.pi, np.pi), origin="lower", cmap=_SHADES, vmin=0, vmax=90)
    q, points = corners(cells)
    h, xi = (values.reshape(cells + 1, cells + 1) for values in chart.phi(points).T)
    axes.contour(q, q, h, levels=np.linspace(-1.75, 1.75, 8), colors=TASK, linewidths=0.8, linestyles="-")
    xi = xi - np.median(xi)  # xi is defined up to a constant
    axes.contour(q, q, xi, levels=np.quantile(xi, np.linspace(0.025, 0.975, 20)), colors=EXTRA, linewidths=0.9)
    mark_singular(axes, singular_points(chart.problem), 5.5)
    joint_plane(axes, parts=2)


def _entries() -> list[Line2D]:
    return [
        Line2D([], [], color=EXTRA, label=r"$\xi > 0$"),
        Line2D([], [], color=EXTRA, linestyle="--", label=r"$\xi < 0$"),
        Line2D([], [], color=TASK, label="leaves of the task, $x$ constant"),
        *singular_symbols(),
    ]


def _numbers(chart: Chart, points: Array) -> dict[str, float]:
    counts, angles = _counts(chart), _deviations(chart, points)
    return {
        "mean_squared_cosine": _loss(chart, points),
        "median_deviation_deg": float(np.median(angles)),
        "deviation_95_percent_deg": float(np.quantile(angles, 0.95)),
        "share_above_10_deg": float(np.mean(angles > _GOOD)),
        "least_times_of_a_value_on_a_leaf": float(counts.min()),
        "largest_times_of_a_value_on_a_leaf": float(counts.max()),
        "share_of_values_twice_on_a_leaf": float(np.mean(counts == 2)),
        "share_of_values_four_times_on_a_leaf": float(np.mean(counts == 4)),
        "median_angle_to_grown_gradient_deg": float(np.median(_angles_to_grown(chart, points[angles < _GOOD]))),
    }


def _counts(chart: Chart) -> Array:
    """How often values occur on leaves, for several leaves and values."""
    return np.concatenate([_crossings(chart, level) for level in _LEAVES])


def _crossings(chart: Chart, level: float, values: int = 21) -> Array:
    """How often each of some values between the extrema of xi occurs on a closed leaf."""
    flow, x0 = TaskFlow(chart.problem), np.array([level])
    start = flow.pull(np.array([_INSIDE]), x0, 1e-12).points[0]
    xi = chart.xi(trace_circle_leaf(chart.problem, x0, start).curve)[:, 0]
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
