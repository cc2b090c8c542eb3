"""Which positions of the tip are farther away than the arm is long (ours): exact, for all joint positions at once.

With o the place of the first joint, which no joint moves, |p(q) - o| <= L, where L adds up the distances from each
joint to the next and to the tip, and the longest strokes of prismatic joints. The same holds for some axes alone.
"""

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array
from orthocas.robots.tree import KinematicTree
from orthocas.tasks import Task

_ROUNDING = 1e-9  # of L: task values next to the limit may be rounded


def beyond_reach(task: Task, x: Array) -> NDArray[np.bool_]:
    """Which task values (N, m) no joint position within the limits has, because the arm is too short, (N,).

    Never for tasks without a position of the tip, nor for arms with an unlimited prismatic joint.
    """
    columns = [k for k, label in enumerate(task.labels) if label in ("x", "y", "z") and task.units[k] == "m"]
    if task.recipe["kind"] == "custom" or not columns:
        return np.zeros(len(x), dtype=bool)
    origin, length = _origin_and_length(task.robot.tree)
    away = x[:, columns] - origin[["xyz".index(task.labels[k]) for k in columns]]
    return np.asarray(np.linalg.norm(away, axis=1) > (1 + _ROUNDING) * length)


def _origin_and_length(tree: KinematicTree) -> tuple[Array, float]:
    """Place of the first joint that moves the tip, (3,), and the largest distance of the tip from it [m]."""
    chain = _chain(tree)
    offsets = [*tree.translations[chain], tree.tip_translation]
    strokes = np.maximum(np.abs(tree.lower[chain]), np.abs(tree.upper[chain]))[np.array(tree.prismatic)[chain]]
    return offsets[0], float(sum(np.linalg.norm(offset) for offset in offsets[1:]) + strokes.sum())


def _chain(tree: KinematicTree) -> list[int]:
    """Joints that move the tip, from the base on."""
    found, body = [], tree.tip_parent
    while body >= 0:
        found.append(body)
        body = tree.parents[body]
    return found[::-1]
