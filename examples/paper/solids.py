"""Small triangle meshes for scenes: tubes, arrows, balls."""

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from orthocas.tools.checks import Array

from .painting import Numbers

Mesh = tuple[Array, Numbers]  #: vertices (V, 3) and faces (F, 3)
_SIDES = 10
_PIECES = 16  # pieces of a straight line, so that its parts can be sorted by depth


def tube(points: ArrayLike, radius: ArrayLike, sides: int = _SIDES) -> Mesh:
    """A closed tube around a polyline, with flat ends.

    Args:
        points: (P, 3), P >= 2.
        radius: one number, or one per point (P,).
        sides: number of corners of the cross-section.
    """
    path = np.asarray(points, dtype=float)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(path))
    side, up = _frames(path)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    round_ = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    rings = path[:, None] + radii[:, None, None] * round_
    vertices = np.concatenate([rings.reshape(-1, 3), path[[0, -1]]])
    here = np.arange(sides)
    after = (here + 1) % sides
    start = sides * np.arange(len(path) - 1)[:, None]
    a, b, c, d = (start + here, start + after, start + sides + here, start + sides + after)
    walls = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, d), (a, d, c))])
    last, base, tip = sides * (len(path) - 1), len(vertices) - 2, len(vertices) - 1
    ends = [
        np.stack([np.full(sides, base), after, here], 1),
        np.stack([np.full(sides, tip), last + here, last + after], 1),
    ]
    return vertices, np.concatenate([walls, *ends])


def straight_tube(start: ArrayLike, end: ArrayLike, radius: float, sides: int = 6) -> Mesh:
    """A tube along a straight line, in short pieces."""
    return tube(np.linspace(np.asarray(start, dtype=float), np.asarray(end, dtype=float), _PIECES + 1), radius, sides)


def arrow(start: ArrayLike, vector: ArrayLike, radius: float) -> Mesh:
    """A shaft with a cone at its end, from `start` to `start + vector`."""
    base, along = np.asarray(start, dtype=float), np.asarray(vector, dtype=float)
    head = min(8 * radius / float(np.linalg.norm(along)), 0.6)  # share of the length
    shaft, cone = np.linspace(0, 1 - head, _PIECES + 1), np.linspace(1 - head, 1, 5)
    radii = np.concatenate([np.full(len(shaft), radius), 2.7 * radius * np.linspace(1, 1e-3, len(cone))])
    return tube(base + np.concatenate([shaft, cone])[:, None] * along, radii, 16)


def ball(centre: ArrayLike, radius: float) -> Mesh:
    """A sphere."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return np.asarray(mesh.vertices) + np.asarray(centre, dtype=float), np.asarray(mesh.faces)


def _frames(path: Array) -> tuple[Array, Array]:
    """Two unit vectors across a polyline at each point, with minimal rotation along it, (P, 3) each."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.empty_like(path)
    before = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    for k, t in enumerate(tangent):
        across = before - (before @ t) * t
        before = side[k] = across / np.linalg.norm(across)
    return side, np.cross(tangent, side)
