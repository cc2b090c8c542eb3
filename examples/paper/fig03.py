"""[AS2023] Fig. 3: the forward kinematics maps the joint space of the planar arm with two joints to SE(2)."""

from typing import Any

import numpy as np

from orthocas import problems

from .arm_sketch import draw_arm, draw_base, joints_and_tip, link_lengths
from .drawing import Drawing
from .fig06 import embedded
from .pose_map import HIGH, LINES, LOW, add_image, add_joint_space, joints, pose, pose_jacobian
from .scene import Scene
from .style import INK, LABEL, TICK, add_3d, line_legend, new_figure, pi_text

_POSTURES = np.array([[0.5, 0.9], [-2.1, 2.3], [-0.9, 0.4]])  # examples [rad]
_COLOURS = ("#c8102e", "#1b9e77", "#7b2fbe")  # of the examples
_TORUS = 2.95  # reach of the torus of `embedded`


def draw(quick: bool) -> Drawing:
    """Draw torus, arms and image with the same postures; the numbers tell that the map is one-to-one and regular."""
    cells = 40 if quick else 120
    figure = new_figure(3.1, layout=None)
    _draw_joint_space(add_3d(figure, -0.02, 0.16, 0.37, 0.7), cells)
    _draw_arms(figure.add_axes((0.375, 0.36, 0.21, 0.44)))
    _draw_poses(add_3d(figure, 0.6, 0.13, 0.38, 0.8), cells)
    figure.text(0.17, 0.92, "(a) joint space, 2-torus", fontsize=LABEL, ha="center")
    figure.text(0.48, 0.92, "(b) forward kinematics", fontsize=LABEL, ha="center")
    figure.text(0.8, 0.92, "(c) task space $SE(2)$", fontsize=LABEL, ha="center")
    figure.text(0.48, 0.27, r"$q \;\mapsto\; x = h(q)$", fontsize=LABEL + 2, ha="center")
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.6, "mutation_scale": 14}
    figure.text(0.48, 0.16, r"$h_3(q) = \varphi = q_1 + q_2$", fontsize=LABEL, ha="center")
    figure.axes[1].annotate("", (0.61, 0.235), (0.35, 0.235), xycoords="figure fraction", arrowprops=arrow)
    line_legend(figure, LINES)
    return Drawing({"": figure}, _numbers(60 if quick else 200))


def _draw_joint_space(axes: Any, cells: int) -> None:
    scene = Scene()
    add_joint_space(scene, cells)
    for q, colour in zip(embedded(_POSTURES), _COLOURS, strict=True):
        scene.add_ball(q, 0.22, colour)
    scene.draw(axes, (50, -30), (-_TORUS, -_TORUS, -0.95), (_TORUS, _TORUS, 0.95), zoom=1.35)
    axes.set_axis_off()


def _draw_arms(axes: Any) -> None:
    lengths = link_lengths(problems.get("planar_2r").robot)
    draw_base(axes, 0.25)
    for q, colour in zip(_POSTURES, _COLOURS, strict=True):
        draw_arm(axes, lengths, q, colour, 0.55)
    axes.set(xlim=(-1.2, 2.0), ylim=(-1.5, 1.6), aspect="equal")
    axes.set_axis_off()


def _draw_poses(axes: Any, cells: int) -> None:
    scene = Scene()
    add_image(scene, cells)
    scene.add_cube(LOW, HIGH, 0.015)
    for x, colour in zip(pose(_POSTURES), _COLOURS, strict=True):
        scene.add_ball(x, 0.17, colour)
    scene.draw(axes, (22, -52), LOW, HIGH, 1.0)
    pose_box(axes)


def pose_box(axes: Any) -> None:
    """Set up axes of x, y and phi without panes."""
    for letter, name, unit in zip("xyz", ("$x$", "$y$", r"$\varphi$"), ("m", "m", "rad"), strict=True):
        axis = getattr(axes, f"{letter}axis")
        ticks = (-np.pi, 0.0, np.pi) if unit == "rad" else (-2.0, 0.0, 2.0)
        texts = [pi_text(t) for t in ticks] if unit == "rad" else [f"{t:g}" for t in ticks]
        getattr(axes, f"set_{letter}ticks")(ticks, texts, fontsize=TICK)
        getattr(axes, f"set_{letter}label")(f"{name} [{unit}]", fontsize=LABEL)
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_visible(False)
        axis.labelpad = -4
        axis.set_tick_params(pad=-1)
    axes.zaxis.set_rotate_label(False)
    axes.zaxis.label.set_rotation(90)
    axes.grid(False)


def _numbers(cells: int) -> dict[str, float]:
    """Rank of the Jacobian, the inverse map, and the tip as it is drawn, on a grid over the torus."""
    line = (np.arange(cells) + 0.5) * 2 * np.pi / cells - np.pi
    q = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    poses = pose(q)
    sizes = np.linalg.svd(pose_jacobian(q), compute_uv=False)
    lengths = link_lengths(problems.get("planar_2r").robot)
    drawn = np.array([joints_and_tip(lengths, posture)[-1] for posture in _POSTURES])
    return {
        "least_singular_value": float(sizes[:, -1].min()),
        "largest_singular_value": float(sizes[:, 0].max()),
        "error_of_inverse_rad": float(np.abs(joints(poses) - q).max()),
        "error_of_drawn_tips_m": float(np.abs(drawn - pose(_POSTURES)[:, :2]).max()),
    }
