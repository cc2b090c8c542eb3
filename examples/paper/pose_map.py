"""The map of Figs. 3 and 4: joint positions of the planar arm with two joints to poses of its tip in SE(2).

A pose is (x, y, phi) with phi = q1 + q2. The map of the 2-torus is one-to-one and its Jacobian has rank two everywhere,
so its image is a torus again, embedded in SE(2). In the picture it is a tube around a helix: at each phi, the tip lies
on a circle of 1 m.
"""

import numpy as np
from matplotlib.colors import to_rgba

from orthocas import problems
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .charted_surface import add_with_lines
from .fig06 import embedded
from .painting import Isolines, Numbers
from .scene import Scene
from .solids import Mesh
from .style import EXTRA, TASK

SURFACE = "#e9edf2"
LINES = {"$q_1$ = const": TASK, "$q_2$ = const": EXTRA}  #: isolines and their colours
LOW, HIGH = np.array([-2.2, -2.2, -np.pi]), np.array([2.2, 2.2, np.pi])  #: visible part of SE(2) [m], [m], [rad]
_LEVELS = np.arange(-8, 9) * np.pi / 4  # of the isolines [rad]


def pose(q: Array) -> Array:
    """(x, y, phi) of the tip, (N, 3), for joint positions (N, 2), with phi in [-pi, pi)."""
    place: Array = position_task().batched(q)[0]
    return np.column_stack([place, (q.sum(axis=1) + np.pi) % (2 * np.pi) - np.pi])


def pose_jacobian(q: Array) -> Array:
    """The derivative of `pose`, (N, 3, 2)."""
    rows = position_task().batched_jacobian(q)[0].reshape(-1, 2, 2)
    return np.concatenate([rows, np.ones((len(q), 1, 2))], axis=1)


def joints(poses: Array) -> Array:
    """The inverse of `pose` for links of 1 m: link 1 ends one link behind the tip, (N, 2) in [-pi, pi)."""
    x, y, phi = poses.T
    first = np.arctan2(y - np.sin(phi), x - np.cos(phi))
    return np.column_stack([first, (phi - first + np.pi) % (2 * np.pi) - np.pi])


def position_task() -> Task:
    """(x, y) of the tip."""
    return Task.position(problems.get("planar_2r").robot, "xy")


def add_joint_space(scene: Scene, cells: int) -> None:
    """Add the 2-torus with its isolines."""
    q, faces = _grid(cells)
    _add(scene, embedded(q), faces, q, 0.05)


def add_image(scene: Scene, cells: int) -> None:
    """Add the image in SE(2) with the isolines of the joints."""
    grid, faces = _grid(cells)  # of q1 and phi, so that the surface is cut where phi jumps
    q = np.column_stack([grid[:, 0], grid[:, 1] - grid[:, 0]])
    corners = np.column_stack([position_task().batched(q)[0], grid[:, 1]])
    _add(scene, corners, faces, q, 0.055)


def tangent_plane(corner: Array, along: Array, half: float, cells: int = 8) -> Mesh:
    """A parallelogram around a point, in small triangles that can be sorted by depth.

    Args:
        corner: the point in the middle, (3,).
        along: its two edges, (2, 3).
        half: half of its size, in units of the edges.
        cells: cells along an edge.
    """
    line = np.linspace(-half, half, cells + 1)
    shares = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    return corner + shares @ along, _faces(cells)


def _grid(cells: int) -> tuple[Array, Numbers]:
    line = np.linspace(-np.pi, np.pi, cells + 1)
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2), _faces(cells)


def _faces(cells: int) -> Numbers:
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    return np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, d), (a, d, c))])


def _add(scene: Scene, vertices: Array, faces: Numbers, q: Array, width: float) -> None:
    paints = [np.tile(to_rgba(colour), (len(_LEVELS), 1)) for colour in LINES.values()]
    families = [Isolines(q[:, k], _LEVELS, paint, width) for k, paint in enumerate(paints)]
    add_with_lines(scene, vertices, faces, SURFACE, families)
