"""[AS2023] Fig. 11: rows of the task Jacobian in Cartesian and in polar coordinates span the same plane."""

import numpy as np

from orthocas import problems
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .drawing import Drawing
from .fig08 import postures
from .scene import Scene
from .self_motion import trace
from .style import GREY, INK, LABEL, TASK, add_3d, joint_cube, line_legend, new_figure

_COLOURS = ("#c8102e", "#f28e2b", INK, "#4fa3d9")  # of x, y, r, phi, as in the paper
_NAMES = (r"\partial x/\partial q", r"\partial y/\partial q", r"\partial r/\partial q", r"\partial\varphi/\partial q")
_RADIUS, _ANGLE = 1.3, 0.75  # of the tip [m], [rad]
_STEP, _STEPS, _SHOWN = (
    0.05,
    24,
    36,
)  # along the curve [rad]; steps from q2 = q3 to the point; steps shown to both sides
_HALF = 5 * np.pi / 8  # half-width of the box around the point [rad]
_REACH = 1.65  # radius of the drawn plane [rad]
_VIEW = (20, -102)


def draw(quick: bool) -> Drawing:
    """Draw the four rows at a point of a self-motion curve; the numbers tell how well the polar rows lie in the plane.

    `quick` has no effect.
    """
    cartesian = problems.get("planar_3r_xy").task
    (closed,) = trace(cartesian, postures(_RADIUS, _ANGLE), _STEP)
    curve = np.roll(closed[:-1], _SHOWN - _STEPS, axis=0)[: 2 * _SHOWN + 1]
    q = curve[_SHOWN]
    tasks = (cartesian, Task.polar(cartesian.robot))
    rows = np.concatenate([task.batched_jacobian(q[None])[0][0] for task in tasks])
    centre = np.pi / 4 * np.round(q / (np.pi / 4))
    figure = new_figure(3.7, 4.3, layout=None)
    axes = add_3d(figure, 0.06, 0.08, 0.9, 0.92)
    joint_cube(axes, centre - _HALF, centre + _HALF, margin=np.pi / 8)
    axes.yaxis.labelpad = axes.zaxis.labelpad = 3
    _scene(q, rows, curve, centre).draw(axes, _VIEW, centre - _HALF, centre + _HALF)
    for row, name, colour in zip(rows, _NAMES, _COLOURS, strict=True):
        place = q + row + 0.5 * row / np.linalg.norm(row)
        axes.text(*place, f"${name}$", color=colour, fontsize=LABEL, ha="center", va="center")
    line_legend(figure, {"self-motion curve": TASK, "plane of all four rows": "#c9ccd1"})
    return Drawing({"": figure}, _numbers(rows, curve))


def _scene(q: Array, rows: Array, curve: Array, centre: Array) -> Scene:
    scene = Scene()
    scene.add_cube(centre - _HALF, centre + _HALF, 0.015)
    scene.add_tube(curve, 0.035, TASK)
    vertices, faces, boundary = _plane(q, rows[:2])
    scene.add_surface(vertices, faces, GREY, alpha=0.35)
    scene.add_tube(boundary, 0.012, GREY)
    for row, colour in zip(rows, _COLOURS, strict=True):
        scene.add_arrow(q, row, 0.04, colour)
    scene.add_ball(q, 0.08, TASK)
    return scene


def _plane(q: Array, rows: Array, cells: int = 24) -> tuple[Array, Array, Array]:
    """A disc around q in the plane of two rows: vertices, faces and boundary."""
    basis = np.linalg.qr(rows.T)[0].T
    angle = np.linspace(0, 2 * np.pi, 4 * cells + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ basis
    rings = q + np.linspace(0, _REACH, cells + 1)[:, None, None] * circle
    number = np.arange(rings.shape[0] * rings.shape[1]).reshape(rings.shape[:2])
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, d), (a, d, c))])
    return rings.reshape(-1, 3), faces, rings[-1]


def _numbers(rows: Array, curve: Array) -> dict[str, float]:
    normal = np.cross(rows[0], rows[1]) / np.linalg.norm(np.cross(rows[0], rows[1]))
    tangent = curve[_SHOWN + 1] - curve[_SHOWN - 1]
    sizes = np.linalg.svd(rows, compute_uv=False)
    return {
        "rank_of_all_four_rows": float(np.sum(sizes > 1e-12 * sizes[0])),
        "third_singular_value": float(sizes[2]),
        "distance_of_polar_rows_from_plane": float(np.abs(rows[2:] @ normal).max()),
        "sine_of_angle_between_curve_and_normal": float(
            np.linalg.norm(np.cross(tangent, normal)) / np.linalg.norm(tangent)
        ),
    }
