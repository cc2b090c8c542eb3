"""A trajectory of three joints as a curve in joint space, with the self-motion manifolds of its task targets."""

from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.exact.mesh import build_level_surface
from orthocas.tools.checks import Array

from .closed_loop_picture import COLOURS
from .planar_loop import Run
from .scene import Scene
from .style import INK, TICK, joint_cube

SHEETS = ("#5b97da", "#a9b8cc")  #: colours of self-motion manifolds, in the order of the targets
_MARGIN = 0.12  # of the box around the curve [rad]
_SLIMMEST = 0.5  # smallest edge of the box relative to its longest edge
_ALPHA = 0.3
_EVERY = 3  # grid points from one coordinate line to the next


def draw_path(
    axes: Any, run: Run, targets: ArrayLike, view: tuple[float, float], cells: int, grid: Array | None
) -> None:
    """Draw the curve, the manifolds h(q) = target in a box around it, and coordinate lines on them.

    Args:
        axes: 3-D axes.
        run: the run to draw.
        targets: task values of the manifolds.
        view: elevation and azimuth of the camera [deg].
        cells: number of cells for the manifolds along the longest edge of the box.
        grid: values of xi1 and xi2 on coordinate lines, (2, N); without it, no lines are drawn.
    """
    q, task = run.trajectory.q, run.chart.problem.task
    low, high = _box_around(q)
    joint_cube(axes, low, high)
    for letter, least, most in zip("xyz", low, high, strict=True):
        _set_ticks(getattr(axes, f"{letter}axis"), least, most)
        getattr(axes, f"{letter}axis").labelpad = 3
    size = float(np.max(high - low))
    scene = Scene()
    scene.add_cube(low, high, 0.004 * size)
    for target, colour in zip(np.atleast_1d(targets), SHEETS, strict=True):
        mesh = build_level_surface(
            lambda p: task.batched(p)[0][:, 0],
            lambda p: task.batched_jacobian(p)[0][:, 0],
            float(target),
            low,
            high,
            cells,
        )
        scene.add_surface(mesh.vertices, mesh.faces, colour, _ALPHA)
        if grid is not None:
            add_coordinate_lines(scene, coordinate_grid(run.chart, q[0], float(target), grid), 0.004 * size)
    scene.add_tube(_thinned(q, 0.004 * size), 0.013 * size, INK)
    scene.add_ball(q[0], 0.035 * size, INK)
    scene.draw(axes, view, low, high, 1.02)


def coordinate_grid(chart: Chart, start: Array, target: float, grid: Array) -> Array:
    """Joint positions with h(q) = target and all pairs of xi1 and xi2, each solved from its neighbour, (N, N, 3)."""
    nearest = [int(np.abs(values).argmin()) for values in grid]
    points = np.empty((len(grid[0]), len(grid[1]), 3))
    first, second = nearest
    points[first, second] = chart.inverse([target, grid[0][first], grid[1][second]], start, outside=True)
    for row, before in _outwards(first, len(grid[0])):
        points[row, second] = chart.inverse(
            [target, grid[0][row], grid[1][second]], points[before, second], outside=True
        )
    for column, before in _outwards(second, len(grid[1])):
        wanted = np.column_stack([np.full_like(grid[0], target), grid[0], np.full_like(grid[0], grid[1][column])])
        points[:, column] = chart.inverse(wanted, points[:, before], outside=True)
    return points


def add_coordinate_lines(scene: Scene, points: Array, radius: float) -> None:
    """Add lines of constant xi1 and of constant xi2 through a grid (N, N, 3)."""
    for line in points[::_EVERY]:
        scene.add_tube(line, radius, COLOURS["xi1"])
    for line in points.transpose(1, 0, 2)[::_EVERY]:
        scene.add_tube(line, radius, COLOURS["xi2"])


def _box_around(curve: Array) -> tuple[Array, Array]:
    """Lower and upper corners of the picture, with a margin and without very short edges."""
    low, high = curve.min(axis=0), curve.max(axis=0)
    half = (high - low) / 2 + _MARGIN
    half = np.maximum(half, _SLIMMEST * half.max())
    return (low + high) / 2 - half, (low + high) / 2 + half


def _thinned(curve: Array, step: float) -> Array:
    """Points of a curve at least a step apart, because a tube has no direction where the motion rests."""
    kept = [curve[0]]
    for point in curve[1:]:
        if np.linalg.norm(point - kept[-1]) > step:
            kept.append(point)
    return np.array(kept)


def _set_ticks(axis: Any, low: float, high: float) -> None:
    """Set one to three round ticks away from the ends, where the labels of other axes are."""
    ticks = np.asarray(MaxNLocator(2).tick_values(low, high))
    inside = ticks[np.abs(ticks - (low + high) / 2) < 0.42 * (high - low)]
    axis.set_ticks(inside, [f"{tick:g}" for tick in inside], fontsize=TICK)


def _outwards(middle: int, count: int) -> list[tuple[int, int]]:
    """Indices from the middle to both ends, each with its predecessor."""
    up = [(k, k - 1) for k in range(middle + 1, count)]
    return up + [(k, k + 1) for k in range(middle - 1, -1, -1)]
