"""[AS2023] Fig. 6: leaves of the task x of the planar arm with two joints, in the plane and on the 2-torus."""

from typing import Any

import casadi as ca
import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patheffects import withStroke

from orthocas import problems
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array

from .drawing import Drawing
from .painting import Isolines
from .scene import Scene
from .style import EXTRA, INK, LABEL, TICK, TURN, add_3d, joint_plane, new_figure

LEVELS = np.linspace(-2, 2, 20)  #: task values [m]
_LABELLED = (1, 3, 5, 7)  # indices of the labelled levels, counted from either end
_BIG, _SMALL = 2.0, 0.95  # radii of the torus in the picture
_SHADES = mpl.colormaps["viridis"].resampled(256)
_NORM = Normalize(-2.0, 2.0)
_VIEW = (50, -14)
_ANGLES_AT = np.array([-1.3, 0.15])  # where the arrows of both angles begin on the torus [rad]
_ANGLES_END = _ANGLES_AT + np.array([[0.75, 0.0], [0.0, 1.1]])
_NAME_AT = np.array([[0.22, 0.0], [0.0, 0.55]])  # of their names, from the ends of the arrows


def draw(quick: bool) -> Drawing:
    """Draw both panels; the numbers are the count of singular points and the accuracy of lines and points."""
    task = problems.get("planar_2r").task
    singular, gradient, indices = singular_points(task)
    figure = new_figure(2.9, layout=None)
    left = figure.add_axes((0.09, 0.15, 0.36, 0.77))
    right = add_3d(figure, 0.47, 0.1, 0.4, 0.87)
    lines = _draw_plane(left, task, singular, 80 if quick else 320)
    on_torus = np.unique(np.round(embedded(singular), 6), axis=0)
    _draw_torus(right, task, on_torus, 60 if quick else 200)
    bar = figure.colorbar(ScalarMappable(_NORM, _SHADES), cax=figure.add_axes((0.885, 0.19, 0.014, 0.69)))
    bar.set_label("$h(q) = x$ [m]", fontsize=LABEL)
    bar.ax.tick_params(labelsize=TICK)
    points, levels = lines
    numbers = {
        "singular_points_in_plane": float(len(singular)),
        "singular_points_on_torus": float(len(on_torus)),
        "sum_of_indices_on_torus": float(indices),
        "distance_from_multiples_of_pi": float(np.abs(singular - np.pi * np.round(singular / np.pi)).max()),
        "gradient_at_singular_points": gradient,
        "levels": float(len(LEVELS)),
        "second_level": float(LEVELS[1]),
        "line_error": float(np.abs(task.batched(points)[0][:, 0] - levels).max()),
    }
    return Drawing({"": figure}, numbers)


def singular_points(task: Task) -> tuple[Array, float, int]:
    """Zeros of grad h on the square |q_i| <= pi, by Newton's method from a grid of starts.

    Returns:
        The points (N, 2), the largest |grad h| there, and the sum of the signs of det of the Hessian over the torus,
        which is the Euler characteristic of the torus, 0.
    """
    q = ca.SX.sym("q", 2)
    hessian, gradient = ca.hessian(task.function(q), q)
    evaluate = Batched(dense_function("slopes", [q], [gradient, hessian]))
    grid = np.linspace(-3.3, 3.3, 14)
    points = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    for _ in range(30):
        slope, curvature = evaluate(points)
        step = (np.linalg.pinv(curvature) @ slope[..., None])[..., 0]
        points = points - step / np.maximum(1.0, 2 * np.linalg.norm(step, axis=1, keepdims=True))
    found = points[(np.abs(evaluate(points)[0]).max(axis=1) < 1e-12) & (np.abs(points).max(axis=1) < np.pi + 1e-9)]
    found = found[np.unique(np.round(found, 6), axis=0, return_index=True)[1]]
    slope, curvature = evaluate(found)
    once = np.all(found > -np.pi + 1e-6, axis=1)  # opposite edges are identical
    return found, float(np.abs(slope).max()), int(np.sign(np.linalg.det(curvature[once])).sum())


def embedded(q: Array) -> Array:
    """The torus in space, q1 around its axis and q2 around its tube: (N, 2) -> (N, 3)."""
    radius = _BIG + _SMALL * np.cos(q[:, 1])
    return np.stack([radius * np.cos(q[:, 0]), radius * np.sin(q[:, 0]), _SMALL * np.sin(q[:, 1])], axis=1)


def above(q: Array, height: float) -> Array:
    """Points above the embedded torus, (N, 3), so that tubes around them do not sink into it."""
    outwards = np.stack([np.cos(q[:, 0]) * np.cos(q[:, 1]), np.sin(q[:, 0]) * np.cos(q[:, 1]), np.sin(q[:, 1])], axis=1)
    points: Array = embedded(q) + height * outwards
    return points


def _draw_plane(axes: Any, task: Task, singular: Array, cells: int) -> tuple[Array, Array]:
    """Draw level sets in the plane; return the points of the lines (N, 2) and their levels (N,)."""
    q = np.linspace(-np.pi, np.pi, cells + 1)
    points = np.stack(np.meshgrid(q, q), axis=-1).reshape(-1, 2)
    h = task.batched(points)[0].reshape(cells + 1, cells + 1)
    lines = axes.contour(q, q, h, levels=LEVELS, cmap=_SHADES, norm=_NORM, linewidths=1.1)
    axes.clabel(lines, fmt="%.3f", fontsize=6.5, inline_spacing=1, manual=_label_places(task), colors=INK)
    axes.plot(*singular.T, "x", color=EXTRA, markersize=6, markeredgewidth=1.8, clip_on=False, zorder=5)
    joint_plane(axes)
    axes.set_title("(a) in the plane", fontsize=LABEL)
    segments = [(segment, level) for level, all_ in zip(lines.levels, lines.allsegs, strict=True) for segment in all_]
    return np.concatenate([s for s, _ in segments]), np.concatenate([np.full(len(s), level) for s, level in segments])


def _label_places(task: Task) -> list[tuple[float, float]]:
    """Places of the labels: rays from maximum and minimum, near the long axes of the ovals, cross the levels there."""
    along = np.linspace(0, 3, 300)[:, None] * [0.6, -1.0]
    places = []
    for start, sign in (((0.0, 0.0), 1), ((-np.pi, 0.0), -1)):
        path = np.add(start, along)
        h = sign * task.batched(path)[0][:, 0]
        steps = [int(np.argmin(np.abs(h + LEVELS[k]))) for k in _LABELLED]
        places += [(float(path[step, 0]), float(path[step, 1])) for step in steps]
    return places


def _draw_torus(axes: Any, task: Task, singular: Array, cells: int) -> None:
    """Draw the same lines on the torus, and the singular points as balls."""
    around, along = np.arange(cells) * TURN / cells, np.arange(cells // 2) * 2 * TURN / cells
    q = np.stack(np.meshgrid(around, along, indexing="ij"), axis=-1).reshape(-1, 2)
    lines = Isolines(task.batched(q)[0][:, 0], LEVELS, _SHADES(_NORM(LEVELS)), 0.045)
    scene = Scene()
    scene.add_surface(embedded(q), torus_faces(cells, cells // 2), "#e9edf2", lines=lines)
    for point in singular:
        scene.add_ball(point, 0.11, EXTRA)
    for joint, end in enumerate(_ANGLES_END):
        curve = above(np.linspace(_ANGLES_AT, end, 30), 0.06)
        scene.add_tube(curve, 0.035, INK)
        scene.add_arrow(curve[-1], 0.3 * _unit(curve[-1] - curve[-2]), 0.035, INK)
        name = axes.text(
            *above(np.array([end]) + _NAME_AT[joint], 0.1)[0], f"$q_{joint + 1}$", fontsize=LABEL, zorder=9
        )
        name.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
    outwards = singular * np.sign(np.linalg.norm(singular, axis=1, keepdims=True) - _BIG)
    hidden = singular[outwards @ _towards(_VIEW) < 0]
    axes.plot(
        *hidden.T, "o", markersize=7, markerfacecolor="none", markeredgecolor=EXTRA, markeredgewidth=1.2, zorder=9
    )
    reach = _BIG + _SMALL
    scene.draw(axes, _VIEW, (-reach, -reach, -_SMALL), (reach, reach, _SMALL), zoom=1.38)
    axes.set_axis_off()
    axes.text2D(0.5, 0.955, "(b) on the 2-torus", fontsize=LABEL, ha="center", transform=axes.transAxes)
    axes.text2D(
        0.5,
        -0.06,
        "singular points; rings: behind the torus",
        fontsize=TICK,
        color=EXTRA,
        ha="center",
        transform=axes.transAxes,
    )


def _towards(view: tuple[float, float]) -> Array:
    """The direction of the camera, (3,)."""
    elevation, azimuth = np.radians(view)
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _unit(vector: Array) -> Array:
    unit: Array = vector / np.linalg.norm(vector)
    return unit


def torus_faces(rows: int, columns: int) -> Array:
    """Triangles of a grid with opposite sides identified, (2 rows columns, 3)."""
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b = number, np.roll(number, -1, axis=0)
    c, d = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    return np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, d), (a, d, c))])
