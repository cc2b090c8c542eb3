"""[AS2023] Fig. 4: the push-forward of the map of Fig. 3 takes tangent vectors of joint space to those of task space.

In coordinates it is the Jacobian (Sec. 2.1): a curve through q with velocity dq is mapped to a curve through x = h(q)
with velocity J dq. The pullback takes forces back, J^T f, with the same power.
"""

from typing import Any

import numpy as np

from orthocas.tools.checks import Array

from .drawing import Drawing
from .fig03 import pose_box
from .fig06 import embedded
from .pose_map import (
    HIGH,
    LOW,
    SURFACE,
    add_image,
    add_joint_space,
    pose,
    pose_jacobian,
    tangent_plane,
)
from .scene import Scene
from .style import EXTRA, INK, LABEL, TASK, add_3d, line_legend, new_figure

_AT = np.array([-0.75, 0.7])  # q [rad]
_VELOCITY = np.array([0.55, 0.9])  # dq [rad/s]
_PLANE, _VECTOR, _CURVE = "#f6d9bd", "#c8102e", "#222222"
_HALF = 0.75  # half a side of the tangent planes [rad]
_TORUS = 2.95
_TIMES = np.linspace(-1.3, 1.3, 80)  # of the curve through q [s]
_STEPS = (1e-2, 5e-3)  # of finite differences [s]


def draw(quick: bool) -> Drawing:
    """Draw a velocity, its curve and tangent planes in both spaces; the numbers compare J dq with differences."""
    cells = 40 if quick else 120
    figure = new_figure(3.5, layout=None)
    left = add_3d(figure, -0.01, 0.13, 0.47, 0.78)
    _draw_joint_space(left, cells)
    right = add_3d(figure, 0.54, 0.14, 0.44, 0.79)
    _draw_task_space(right, cells)
    figure.text(0.23, 0.925, r"(a) $T_q\mathcal{Q}$, tangent to joint space", fontsize=LABEL, ha="center")
    figure.text(0.76, 0.925, r"(b) its image in $T_x\mathcal{M}$, $x = h(q)$", fontsize=LABEL, ha="center")
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.6, "mutation_scale": 14}
    left.annotate("", (0.56, 0.5), (0.46, 0.5), xycoords="figure fraction", arrowprops=arrow)
    figure.text(0.51, 0.53, r"$\mathcal{H}_* = J$", fontsize=LABEL + 1, ha="center")
    names = {r"$q_1$ direction": TASK, r"$q_2$ direction": EXTRA, r"$\dot q$ and $J \dot q$": _VECTOR}
    line_legend(figure, {**names, "curve $q(t)$ and $h(q(t))$": _CURVE})
    return Drawing({"": figure}, _numbers())


def _curve() -> Array:
    return np.asarray(_AT + _TIMES[:, None] * _VELOCITY)


def _draw_joint_space(axes: Any, cells: int) -> None:
    scene = Scene()
    add_joint_space(scene, cells)
    frame = _embedding_jacobian(_AT).T
    outwards = np.cross(*frame) / np.linalg.norm(np.cross(*frame))
    _add_tangents(scene, embedded(_AT[None])[0] + 0.03 * outwards, frame, outwards)
    scene.add_tube(embedded(_curve()) + 0.07 * outwards, 0.045, _CURVE)
    scene.draw(axes, (46, -52), (-_TORUS, -_TORUS, -0.95), (_TORUS, _TORUS, 0.95), zoom=1.4)
    axes.set_axis_off()


def _draw_task_space(axes: Any, cells: int) -> None:
    scene = Scene()
    add_image(scene, cells)
    scene.add_cube(LOW, HIGH, 0.015)
    frame = pose_jacobian(_AT[None])[0].T
    normal = np.cross(*frame) / np.linalg.norm(np.cross(*frame))
    _add_tangents(scene, pose(_AT[None])[0] + 0.03 * normal, frame, normal)
    scene.add_tube(pose(_curve()) + 0.09 * normal, 0.045, _CURVE)
    scene.draw(axes, (24, -34), LOW, HIGH, 1.0)
    pose_box(axes)


def _add_tangents(scene: Scene, at: Array, frame: Array, outwards: Array) -> None:
    """Add the plane spanned by both columns of a Jacobian, (2, 3), the columns themselves and the velocity."""
    scene.add_surface(*tangent_plane(at, frame, _HALF), _PLANE, 0.6)
    lifted = at + 0.12 * outwards
    for direction, colour in zip(frame, (TASK, EXTRA), strict=True):
        scene.add_arrow(lifted, 0.8 * direction, 0.045, colour)
    scene.add_arrow(lifted, 0.8 * _VELOCITY @ frame, 0.055, _VECTOR)
    scene.add_ball(lifted, 0.1, SURFACE)


def _embedding_jacobian(q: Array, step: float = 1e-6) -> Array:
    """Derivative of the drawn torus, (3, 2), by central differences: it only places arrows."""
    shifts = step * np.eye(2)
    columns: Array = ((embedded(q + shifts) - embedded(q - shifts)) / (2 * step)).T
    return columns


def _numbers() -> dict[str, float]:
    """Central differences of the curve in task space against J dq, and the power of a force and of its pullback."""
    J = pose_jacobian(_AT[None])[0]
    pushed = J @ _VELOCITY
    errors = []
    for step in _STEPS:
        ends = pose(_AT + np.array([[step], [-step]]) * _VELOCITY)
        errors.append(float(np.linalg.norm((ends[0] - ends[1]) / (2 * step) - pushed)))
    force = np.array([1.0, -2.0, 0.5])
    return {
        "speed_in_task_space": float(np.linalg.norm(pushed)),
        "difference_error": errors[1],
        "order_of_difference_error": float(np.log2(errors[0] / errors[1])),
        "power_error_of_pullback": float(abs((J.T @ force) @ _VELOCITY - force @ pushed)),
    }
