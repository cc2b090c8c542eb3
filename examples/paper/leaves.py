"""Leaves of a scalar task of three joints as triangle meshes, glued to the 3-torus or turned into a printable wall."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .style import TURN

_SAME = 1e-6  # vertices closer than this are one [rad]


def leaf(task: Task, value: float, cells: int) -> trimesh.Trimesh:
    """The surface h(q) = value in the cube 0 <= q_i <= 2 pi, by marching cubes and Newton's method.

    Vertices on faces of the cube stay there, so that opposite faces fit together.

    Args:
        task: task with m = 1 of a robot with n = 3 revolute joints.
        value: a nonsingular task value.
        cells: number of cells along an edge of the cube. A prime number keeps grid vertices away from the surface.
    """
    grid = _grid_values(task, cells) - value
    q, faces, _, _ = marching_cubes(grid, 0.0, spacing=3 * (TURN / cells,))
    inside = ~(np.isclose(q, 0, atol=1e-9) | np.isclose(q, TURN, atol=1e-6))
    q = np.where(inside, q, TURN * np.round(q / TURN)).astype(float)
    for _ in range(4):
        slope = task.batched_jacobian(q)[0][:, 0] * inside
        off = task.batched(q)[0] - value
        q = q - off * slope / (slope**2).sum(axis=1, keepdims=True)
    return trimesh.Trimesh(q, faces, process=False)


def glued(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface in the 3-torus: vertices on opposite faces of the cube become topologically one."""
    q = np.asarray(mesh.vertices) % TURN % TURN  # twice, because tiny negative numbers round up to a whole turn
    tree = cKDTree(q, boxsize=TURN)
    first = np.array([min(near) for near in tree.query_ball_point(q, _SAME)])
    names, merged = np.unique(first, return_inverse=True)
    return trimesh.Trimesh(q[names], merged[np.asarray(mesh.faces)], process=False)


def wall(task: Task, value: float, cells: int, edge: float, thickness: float) -> trimesh.Trimesh:
    """A printable wall around a leaf in the cube: the solid |h - value| / |grad h| <= thickness / 2, cut at the cube.

    Marching cubes on the depth inside the solid (the smaller of the depths inside wall and cube) give a closed surface.
    The grid extends half a cell beyond the cube, so that cut edges are smooth.

    Args:
        task: task with m = 1 of a robot with n = 3 revolute joints.
        value: a nonsingular task value.
        cells: number of cells along an edge of the cube, large enough that a cell is no longer than the wall is thick.
        edge: edge length of the cube [mm].
        thickness: thickness of the wall [mm].
    """
    line = (np.arange(cells + 2) - 0.5) * edge / cells  # [mm]
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    q = points * TURN / edge
    slope = np.linalg.norm(task.batched_jacobian(q)[0][:, 0], axis=1)
    distance = np.abs(task.batched(q)[0][:, 0] - value) / np.maximum(slope, 1e-9) * edge / TURN
    below_cube = np.minimum(points, edge - points).min(axis=1)
    depth = np.maximum(np.minimum(thickness / 2 - distance, below_cube), -thickness)
    vertices, faces, _, _ = marching_cubes(
        depth.reshape(3 * (cells + 2,)), 0.0, spacing=3 * (edge / cells,), gradient_direction="ascent"
    )
    return trimesh.Trimesh(vertices + line[0], faces, process=False)


def _grid_values(task: Task, cells: int) -> Array:
    """The task on a grid in the cube, (cells + 1)^3, with exactly equal values on opposite faces."""
    angle = np.arange(cells + 1) % cells * TURN / cells
    points = np.stack(np.meshgrid(angle, angle, angle, indexing="ij"), axis=-1).reshape(-1, 3)
    return task.batched(points)[0].reshape(3 * (cells + 1,))
