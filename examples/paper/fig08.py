"""[AS2023] Fig. 8: self-motion curves of the planar arm with three joints, task (x, y), in the cube of joint angles.

The two classes differ as follows (ours). With links of 1 m, |tip|^2 = 3 + 2 cos q2 + 2 cos q3 + 2 cos(q2 + q3) does not
depend on q1. It has its maximum at q2 = q3 = 0, saddles of height 1 m^2, and zeros at q2 = q3 = +-2 pi/3. A tip farther
away than 1 m therefore has one curve, around the line q2 = q3 = 0, along which q1 swings back and forth. A nearer tip
has two curves, one around each line of zeros, along which q1 makes a whole turn.
"""

import numpy as np
from numpy.typing import NDArray

from orthocas import problems
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .drawing import Drawing
from .scene import Scene
from .self_motion import pieces_in_cube, trace, wrapped
from .style import EXTRA, GREY, INK, LABEL, TASK, TURN, add_3d, joint_cube, line_legend, new_figure

Flags = NDArray[np.bool_]  #: one per curve
_FAR, _NEAR = (1.25, 1.8, 2.4, 2.8), (0.4, 0.8)  # distances of the tip from the base [m]
_AT_A_FACE = np.pi - 1e-6  # [rad]; a piece of a curve that ends there goes on at the opposite face
_ANGLES = TURN * np.arange(3) / 3  # directions of the tip [rad]


def draw(quick: bool) -> Drawing:
    """Draw two views; the numbers show the accuracy of the curves and their division into classes."""
    task = problems.get("planar_3r_xy").task
    starts = np.concatenate([postures(radius, angle) for radius in (*_NEAR, *_FAR) for angle in _ANGLES])
    curves = trace(task, starts, 0.12 if quick else 0.05)
    around = np.array([encircles(curve) for curve in curves])
    scene = _scene(curves, around)
    figure = new_figure(3.3, layout=None)
    for k, (name, view) in enumerate((("(a) view 1", (24, -58)), ("(b) view 2, along $q_1$", (13, -8)))):
        axes = add_3d(figure, 0.01 + 0.49 * k, 0.1, 0.47, 0.87)
        joint_cube(axes)
        scene.draw(axes, view, -np.pi, np.pi, zoom=0.98)
        axes.text2D(0.5, 0.99, name, fontsize=LABEL, ha="center", transform=axes.transAxes)
    names = {"tip beyond 1 m": TASK, "tip within 1 m": EXTRA, "the line $q_2 = q_3 = 0$": INK}
    line_legend(figure, names | {"goes on at the opposite face": GREY})
    return Drawing({"": figure}, _numbers(task, curves, around))


def postures(radius: float, angle: float) -> Array:
    """One joint position on each self-motion curve of a tip at a radius in (0, 3) [m] and an angle [rad], (1 or 2, 3).

    With q2 = q3 = s, the tip lies at distance 1 + 2 cos s from the base, in direction q1 + s.
    """
    s = np.arccos((radius - 1) / 2)
    both = np.array([[angle - s, s, s], [angle + s, -s, -s]])
    return both if radius < 1 else both[:1]


def encircles(curve: Array) -> bool:
    """Whether a closed curve (P, 3) goes around the line q2 = q3 = 0, seen along q1."""
    turned = np.unwrap(np.arctan2(curve[:, 2], curve[:, 1]))
    return bool(np.all(np.abs(curve[-1] - curve[0]) < 1) and round(abs(turned[-1] - turned[0]) / TURN) == 1)


def _scene(curves: list[Array], around: Flags) -> Scene:
    scene = Scene()
    scene.add_cube(-np.pi, np.pi, 0.02)
    scene.add_tube(np.linspace([-np.pi, 0, 0], [np.pi, 0, 0], 60), 0.035, INK)
    for curve, encircling in zip(curves, around, strict=True):
        for piece in pieces_in_cube(curve):
            scene.add_tube(piece, 0.05, TASK if encircling else EXTRA)
            for end in piece[[0, -1]]:
                if np.abs(end).max() > _AT_A_FACE:
                    scene.add_ball(end, 0.11, GREY)
    return scene


def _numbers(task: Task, curves: list[Array], around: Flags) -> dict[str, float]:
    tips = [task.batched(curve)[0] for curve in curves]
    radii = np.array([np.linalg.norm(tip[0]) for tip in tips])
    turns = np.array([abs(np.round((curve[-1] - curve[0]) / TURN)) for curve in curves])
    return {
        "curves": float(len(curves)),
        "around_the_line": float(around.sum()),
        "not_around_the_line": float((~around).sum()),
        "nearest_tip_of_those_around": float(radii[around].min()),
        "farthest_tip_of_the_others": float(radii[~around].max()),
        "turns_of_q1_of_those_around": float(turns[around].max()),
        "turns_of_q1_of_the_others": float(turns[~around, 0].min()),
        "task_error": float(max(np.abs(tip - tip[0]).max() for tip in tips)),
        "closure_error": float(max(np.abs(wrapped(curve[-1] - curve[0])).max() for curve in curves)),
    }
