"""Flow lines of the planar arm with two joints, and the common parts of its figures.

With links of 1 m, the task x = cos q1 + cos(q1 + q2) has its maximum 2 m at (0, 0), its minimum -2 m at (pi, 0), and
two saddles of height 0 at (0, pi) and (pi, pi).
"""

from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from orthocas import problems
from orthocas.charts.chart import Chart
from orthocas.charts.grow import grow
from orthocas.exact.flow import GrownCoordinates, TaskFlow
from orthocas.exact.leaves import CircleLeaf
from orthocas.tasks.domains import Torus
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import evaluate_samples
from orthocas.tools.checks import Array

from .self_motion import pieces_in_cube, wrapped
from .singularities import SingularPoint
from .style import INK, TURN

NAMES = {"euclidean": "A = I", "inertia": "A = M"}
LEVEL = 1.0  #: task value of the base leaf S0 [m]
EXTREME = 2.0 - 1e-8  #: task value at which flow lines end [m], 1e-4 rad from the maximum or the minimum
_ORIGIN = (np.pi / 3, 0.0)  # on S0, so that both metrics give S0 the same chart
MARKS = {"maximum": "^", "minimum": "v", "saddle": "X"}


def planar_problem(metric: str) -> Problem:
    """The arm of `orthocas.problems.planar_2r` on the whole torus, with A = I or A = M."""
    plain = problems.get("planar_2r")
    return Problem(plain.robot, plain.task, metric, Torus(2), f"planar_2r_{metric}")


def grown_chart(problem: Problem) -> Chart:
    """Coordinates grown from S0, charted by arc length from (pi/3, 0)."""
    return grow(problem, LEVEL, origin=_ORIGIN)


def grown_coordinates(chart: Chart) -> GrownCoordinates:
    """The coordinates of a chart that `grown_chart` made."""
    assert isinstance(chart.coordinates, GrownCoordinates)
    return chart.coordinates


def base_leaf(chart: Chart) -> CircleLeaf:
    """S0 of a chart that `grown_chart` made."""
    leaf = grown_coordinates(chart).leaf
    assert isinstance(leaf, CircleLeaf)
    return leaf


def flow_lines(problem: Problem, starts: Array, goals: Array, steps: int) -> list[Array]:
    """Curves of +-grad_A h from points to given task values.

    The task values of their points are dense near 2, 0 and -2 m, where the curves are fast.

    Args:
        problem: a problem that `planar_problem` made.
        starts: start points, (N, 2).
        goals: task values at the ends, (N,), within +-2 m.
        steps: number of steps per curve.

    Returns:
        One curve per start, (steps + 1, 2) without wrapping, or shorter if the curve runs into a singular point.
    """
    flow, first, last = TaskFlow(problem), _stage(problem.task.batched(starts)[0][:, 0]), _stage(goals)
    curves, running = [[q] for q in starts], np.arange(len(starts))
    for k in range(1, steps + 1):
        here = np.array([curves[i][-1] for i in running]).reshape(-1, 2)
        wanted = _height(first + (last - first) * k / steps)[running]
        moved = flow.pull(here, wanted[:, None])
        running = running[moved.reached]
        for i, q in zip(running, moved.points[moved.reached], strict=True):
            curves[i].append(q)
    return [np.array(curve) for curve in curves]


def _stage(height: Array) -> Array:
    """A scale of height: 0 at -2 m, 1 at 0, 2 at 2 m. Equal stages are small changes of height near these values."""
    upper = (height > 0).astype(float)
    stage: Array = upper + np.arccos(np.clip(2 * upper - 1 - height, -1, 1)) / np.pi
    return stage


def _height(stage: Array) -> Array:
    """The inverse of `_stage` [m]."""
    upper = (stage > 1).astype(float)
    height: Array = 2 * upper - 1 - np.cos(np.pi * (stage - upper))
    return height


def corners(cells: int) -> tuple[Array, Array]:
    """Angles (cells + 1,) of a grid over the torus, and its points row by row, ((cells + 1)^2, 2)."""
    q = np.linspace(-np.pi, np.pi, cells + 1)
    return q, np.stack(np.meshgrid(q, q), axis=-1).reshape(-1, 2)


def cell_centres(cells: int) -> Array:
    """Centres of the cells of a grid over the torus, row by row with q1 running fastest, (cells^2, 2)."""
    q = (np.arange(cells) + 0.5) * TURN / cells - np.pi
    return np.stack(np.meshgrid(q, q), axis=-1).reshape(-1, 2)


def deviations(problem: Problem, points: Array, J_xi: Array) -> Array:
    """Deviation from 90 degrees of the angle between grad_A h and dxi ([AS2023] eq. (24)) [deg], (N,).

    Args:
        problem: a problem with n = 2 and m = 1.
        points: nonsingular points, (N, 2).
        J_xi: gradients of xi, (N, 2).
    """
    gradients = evaluate_samples(problem, points).unit_task_gradients[:, 0]
    cosines = (gradients * J_xi).sum(axis=1) / np.linalg.norm(J_xi, axis=1)
    angles: Array = np.degrees(np.arcsin(np.clip(np.abs(cosines), 0, 1)))
    return angles


def cosines_by_differences(chart: Chart, points: Array, step: float = 1e-4) -> Array:
    """Cosine between grad_A h and dxi, by central differences of xi instead of J_xi, (N,); NaN where xi is NaN.

    This check does not use J_xi, which is orthogonal by construction because its tangent vectors start on the leaf of
    q.

    Args:
        chart: a chart with n = 2, grown from a circle.
        points: (N, 2).
        step: half the distance between the values [rad].
    """
    shifts = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    xi = chart.xi((points[:, None] + shifts).reshape(-1, 2)).reshape(-1, 2, 2)
    rises = wrapped(xi[..., 0] - xi[..., 1])
    gradients = evaluate_samples(chart.problem, points).unit_task_gradients[:, 0]
    cosines: Array = (gradients * rises).sum(axis=1) / np.linalg.norm(rises, axis=1)
    return cosines


def plot_wrapped(axes: Any, curves: list[Array], **style: Any) -> None:
    """Draw curves (P, 2) in the square |q_i| <= pi, cut at its edges."""
    for curve in curves:
        for piece in pieces_in_cube(curve):
            axes.plot(*piece.T, **style)


def mark(axes: Any, kind: str, points: Array, size: float = 7.0) -> None:
    """Mark singular points (N, 2) of a kind, "maximum", "minimum" or "saddle"."""
    style = {"color": "white", "markeredgecolor": INK, "markersize": size, "markeredgewidth": 0.9}
    axes.plot(*points.T, MARKS[kind], **style, clip_on=False, zorder=6)


def symbol(marker: str, colour: str, text: str) -> Line2D:
    """A legend entry for a marker."""
    edge = INK if colour == "white" else colour
    return Line2D([], [], linestyle="", marker=marker, color=colour, markeredgecolor=edge, markersize=6, label=text)


def singular_symbols() -> list[Line2D]:
    """Legend entries for singular points."""
    return [symbol(marker, "white", f"{kind} of $h$") for kind, marker in MARKS.items()]


def mark_singular(axes: Any, singular: tuple[SingularPoint, ...], size: float = 7.0) -> None:
    """Mark singular points in the square |q_i| <= pi, including its edges."""
    shifts = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]) * TURN
    for one in singular:
        copies = one.point + shifts
        mark(axes, one.kind, copies[np.abs(copies).max(axis=1) < np.pi + 1e-6], size)


def distance_to(points: Array, singular: tuple[SingularPoint, ...]) -> Array:
    """Distances of points (N, 2) from the nearest singular point on the torus [rad], (N,)."""
    apart = np.stack([np.linalg.norm(wrapped(points - s.point), axis=1) for s in singular])
    nearest: Array = apart.min(axis=0)
    return nearest
