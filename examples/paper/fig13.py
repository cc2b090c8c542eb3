"""[AS2023] Fig. 13: the grown coordinate xi(q) of the planar arm with two joints, for A = I and A = M.

xi is an angle. With a cyclic colour map, the cut of S0, where xi passes from pi to -pi, does not show and is drawn as a
line. Edges of colour are true jumps: lines that flow from the minimum of h into a saddle, where points on their two
sides separate. In the lower row (ours), each point is shifted by whole turns to where its flow line meets S0 around the
origin. The torus then becomes one region with all jumps on its boundary, which solves the puzzle of the paper.
"""

import time
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from orthocas.charts.chart import Chart
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

from .drawing import Drawing
from .planar_flow import (
    EXTREME,
    NAMES,
    base_leaf,
    cell_centres,
    cosines_by_differences,
    deviations,
    flow_lines,
    grown_chart,
    grown_coordinates,
    mark,
    mark_singular,
    planar_problem,
    plot_wrapped,
    singular_symbols,
)
from .self_motion import wrapped
from .singularities import Jump, SingularPoint, jumps, singular_points
from .style import INK, LABEL, TICK, TURN, find_axis, joint_plane, new_figure, pi_text

_COLOURS = "twilight"  # this map is light at +-pi
_HALO = [withStroke(linewidth=3.2, foreground="white")]
_SHOWN: dict[str, Any] = {
    "origin": "lower",
    "cmap": _COLOURS,
    "vmin": -np.pi,
    "vmax": np.pi,
    "interpolation": "nearest",
}
_LEAF: dict[str, Any] = {"color": INK, "linewidth": 1.8, "path_effects": _HALO, "label": "base leaf $S_0$"}
_CUT: dict[str, Any] = {"color": INK, "linewidth": 1.1, "linestyle": (0, (4, 2)), "label": r"cut, $\xi = \pm\pi$"}
_JUMP: dict[str, Any] = {"color": "#f2b701", "linewidth": 1.5, "label": "jumps"}


@dataclass(frozen=True, eq=False)
class _Field:
    """The coordinate on a grid of cells over the torus."""

    chart: Chart
    singular: tuple[SingularPoint, ...]
    xi: Array  #: (cells, cells), first index along q2
    turns: Array  #: whole turns from S0 around the origin to where each flow line ends, (cells, cells, 2)
    seconds: float


def draw(quick: bool) -> Drawing:
    """Draw both metrics on the torus and reassembled; the numbers are speed, jumps and accuracy of the coordinates."""
    cells = 60 if quick else 330
    fields = [_evaluated(metric, cells) for metric in NAMES]
    figure = new_figure(7.1, layout=None)
    for k, field in enumerate(fields):
        upper = figure.add_axes((0.1 + 0.42 * k, 0.64, 0.36, 0.32))
        _draw_torus(upper, field)
        lower = figure.add_axes((0.1 + 0.42 * k, 0.13, 0.36, 0.42))
        _draw_region(lower, field)
        if k > 0:
            upper.set_ylabel("")
            lower.set_ylabel("")
    bar = figure.colorbar(
        ScalarMappable(Normalize(-np.pi, np.pi), _COLOURS), cax=figure.add_axes((0.92, 0.27, 0.016, 0.55))
    )
    ticks = np.linspace(-np.pi, np.pi, 5).tolist()
    bar.set_ticks(ticks, labels=[pi_text(tick) for tick in ticks])
    bar.ax.tick_params(labelsize=TICK)
    bar.ax.set_title(r"$\xi$ [rad]", fontsize=LABEL)
    figure.legend(handles=_entries(), loc="lower center", ncols=3, fontsize=TICK, frameon=False, columnspacing=1.4)
    numbers: dict[str, float] = {}
    for field, metric in zip(fields, NAMES, strict=True):
        numbers |= {f"{metric}_{key}": value for key, value in _numbers(field, 1000 if quick else 10_000).items()}
    numbers["difference_on_base_leaf"] = _difference_on_leaf(*(field.chart for field in fields))
    return Drawing({"": figure}, numbers)


def _evaluated(metric: str, cells: int) -> _Field:
    problem = planar_problem(metric)
    chart = grown_chart(problem)
    points = cell_centres(cells)
    chart.xi(points[:1])  # builds functions
    start = time.perf_counter()
    pulled = grown_coordinates(chart).pull(points)  # one pull serves both xi and turns
    xi = np.where(pulled.reached, base_leaf(chart).values(pulled.points).xi[:, 0], np.nan)
    seconds = time.perf_counter() - start
    turns = np.round(pulled.points / TURN)
    shape = (cells, cells)
    return _Field(chart, singular_points(problem), xi.reshape(shape), turns.reshape(*shape, 2), seconds)


def _draw_torus(axes: Any, field: _Field) -> None:
    axes.imshow(field.xi, extent=2 * (-np.pi, np.pi), **_SHOWN)
    plot_wrapped(axes, [base_leaf(field.chart).curve], **_LEAF)
    plot_wrapped(axes, _cut_line(field.chart), **_CUT)
    for lines, _ in _jump_lines(field):
        plot_wrapped(axes, lines, **_JUMP)
    mark_singular(axes, field.singular)
    joint_plane(axes)
    axes.set_title(f"${NAMES[field.chart.problem.metric.name]}$, on the torus", fontsize=LABEL)


def _put_together(field: _Field) -> Array:
    """Cells shifted to where their flow lines end, on a grid of 3 x 3 copies of the torus; NaN elsewhere."""
    cells = len(field.xi)
    everywhere = np.full((3, cells, 3, cells), np.nan)
    rows, columns = np.mgrid[:cells, :cells]
    kept = np.isfinite(field.xi)
    copy = 1 - field.turns.astype(int)
    everywhere[copy[..., 1][kept], rows[kept], copy[..., 0][kept], columns[kept]] = field.xi[kept]
    return everywhere.reshape(3 * cells, 3 * cells)


def _draw_region(axes: Any, field: _Field) -> None:
    axes.imshow(_put_together(field), extent=2 * (-3 * np.pi, 3 * np.pi), **_SHOWN)
    axes.plot(*base_leaf(field.chart).curve.T, **_LEAF)
    for curve in _cut_line(field.chart):
        axes.plot(*curve.T, **_CUT)
    for lines, turns in _jump_lines(field):
        for line, turn in product(lines, turns):
            axes.plot(*(line - TURN * turn).T, **_JUMP)
            mark(axes, "minimum", (line - TURN * turn)[-1:])
        mark(axes, "saddle", lines[0][:1] - TURN * turns)
    mark(axes, "maximum", np.zeros((1, 2)))
    find_axis(axes, "x", 1, -1.5 * np.pi, 1.5 * np.pi, parts=6)
    find_axis(axes, "y", 2, -2.25 * np.pi, 2.25 * np.pi, parts=8, margin=np.pi / 4)
    axes.set_aspect("equal")
    axes.set_title("reassembled", fontsize=LABEL)


def _entries() -> list[Line2D]:
    return [*(Line2D([], [], **style) for style in (_LEAF, _CUT, _JUMP)), *singular_symbols()]


def _cut_line(chart: Chart) -> list[Array]:
    """The flow line, down and up, through the point of S0 where xi passes from pi to -pi."""
    goals = np.array([-EXTREME, EXTREME])
    return flow_lines(chart.problem, np.tile(base_leaf(chart).cut, (2, 1)), goals, 100)


def _jump_lines(field: _Field) -> list[tuple[list[Array], Array]]:
    """The two lines that flow into each saddle, starting there, and the turns (2, 2) to S0 from their two sides."""
    found = []
    for saddle in (s for s in field.singular if s.kind == "saddle"):
        falling, rising = 1e-3 * saddle.directions.T
        lines = flow_lines(field.chart.problem, saddle.point + np.stack([falling, -falling]), np.full(2, -EXTREME), 100)
        sides = grown_coordinates(field.chart).pull(saddle.point + np.stack([rising, -rising])).points
        found.append((lines, np.round(sides / TURN)))
    return found


def _numbers(field: _Field, samples: int) -> dict[str, float]:
    chart = field.chart
    points = sample_uniform(chart.problem.domain, samples, 0)
    by_differences = np.abs(cosines_by_differences(chart, points))
    return {
        "queries": float(field.xi.size),
        "seconds": field.seconds,
        "queries_per_second": field.xi.size / field.seconds,
        "share_with_a_value": float(np.isfinite(field.xi).mean()),
        "largest_cosine": float(
            np.sin(np.radians(deviations(chart.problem, points, chart.jacobian(points)[:, 1]))).max()
        ),
        "median_cosine_from_differences_of_xi": float(np.nanmedian(by_differences)),
        "broken_edges_on_torus": _broken_edges(field.xi),
        "broken_edges_put_together": _broken_edges(_put_together(field)),
        **{f"jump_at_saddle_{k + 1}": j.size for k, j in enumerate(_at_saddles(chart))},
    }


def _broken_edges(xi: Array) -> float:
    """Number of neighbouring cells whose values differ by more than a radian."""
    steps = [np.abs(wrapped(np.diff(xi, axis=axis))) for axis in (0, 1)]
    return float(sum(np.count_nonzero(step > 1) for step in steps))


def _at_saddles(chart: Chart) -> list[Jump]:
    return [jump for jump in jumps(chart) if jump.singular_point.kind == "saddle"]


def _difference_on_leaf(first: Chart, second: Chart) -> float:
    """Largest difference of the coordinates at points of S0 [rad]."""
    on_leaf = base_leaf(first).curve[::7]
    return float(np.abs(wrapped(first.xi(on_leaf) - second.xi(on_leaf))).max())
