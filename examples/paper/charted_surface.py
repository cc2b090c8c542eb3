"""Meshes drawn with their own triangles, or with isolines of several functions."""

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_rgb

from orthocas.tools.checks import Array

from .painting import Isolines, Numbers, cut, paint
from .scene import Scene

_SAME = 9  # corners that agree in this many decimals are one point [rad]


def add_with_lines(scene: Scene, vertices: Array, faces: Numbers, colour: str, families: Sequence[Isolines]) -> None:
    """Add a triangle mesh with several families of isolines. Later families are drawn over earlier ones.

    Args:
        scene: scene to add the mesh to.
        vertices: (V, 3).
        faces: (F, 3).
        colour: colour of the mesh.
        families: values at the vertices, levels and style of each family.
    """
    corners, colours = vertices[faces], np.tile((*to_rgb(colour), 1.0), (len(faces), 1))
    values = [lines.values[faces] for lines in families]
    for k, lines in enumerate(families):
        own = Isolines(values[k].ravel(), lines.levels, lines.colours, lines.width)
        pieces, colours, source = paint(corners, np.arange(3 * len(corners)).reshape(-1, 3), own, colours)
        shares = _shares(corners[source], pieces)
        values = [np.einsum("fij,fj->fi", shares, value[source]) for value in values]
        corners = pieces
    points, triangles = _welded(corners)
    scene.add_surface(points[:, :3], triangles, colours)


def part_below(
    vertices: Array, faces: Numbers, height: Array, level: float, values: Array
) -> tuple[Array, Numbers, Array]:
    """The part of a triangle mesh where a function, linear on triangles, is below a level.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        height: values of the function at the vertices, (V,).
        level: value at which the mesh is cut.
        values: other functions at the vertices, (V, k).

    Returns:
        Vertices, faces and values of this part.
    """
    corners = np.concatenate([vertices, height[:, None], values], axis=1)[faces]
    pieces, _ = cut(corners, np.arange(len(faces)), np.full(len(faces), level))
    points, triangles = _welded(pieces[pieces[:, :, 3].mean(axis=1) < level])
    return points[:, :3], triangles, points[:, 4:]


def add_with_edges(scene: Scene, vertices: Array, faces: Numbers, colours: Array, edge: Array, width: float) -> None:
    """Add a triangle mesh with its edges drawn as boundaries inside the triangles, which stay flat.

    Args:
        scene: scene to add the mesh to.
        vertices: (V, 3).
        faces: (F, 3).
        colours: colours of the triangles, RGB (F, 3).
        edge: colour of the edges, RGB (3,).
        width: width of an edge, which covers the boundaries of both its triangles.
    """
    corners = vertices[faces]
    opposite = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), axis=2)  # (F, 3)
    around = opposite.sum(axis=1)
    centre = np.einsum("fk,fki->fi", opposite, corners) / around[:, None]  # of the inscribed circle
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    shrunk = np.clip(1 - width / 2 * around / (2 * area), 0, 1)[:, None, None]
    inner = centre[:, None] + shrunk * (corners - centre[:, None])
    here, after = np.arange(3), (np.arange(3) + 1) % 3
    outside = (
        [corners[:, here], corners[:, after], inner[:, after]],
        [corners[:, here], inner[:, after], inner[:, here]],
    )
    boundaries = [np.stack(three, axis=2).reshape(-1, 3, 3) for three in outside]
    triangles = np.concatenate([inner, *boundaries])
    looks = np.concatenate([colours, np.tile(edge, (6 * len(faces), 1))])
    scene.add_surface(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), looks)


def _shares(corners: Array, points: Array) -> Array:
    """Barycentric coordinates of three points in each triangle (F, 3, 3), (F, 3, 3)."""
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)  # (F, 2, 3)
    two = (points - corners[:, :1]) @ np.linalg.pinv(edges)
    shares: Array = np.concatenate([1 - two.sum(axis=2, keepdims=True), two], axis=2)
    return shares


def _welded(corners: Array) -> tuple[Array, Numbers]:
    """Points (P, k) and faces (F, 3) of triangles (F, 3, k), with equal corners merged into one point."""
    flat = corners.reshape(-1, corners.shape[2])
    _, first, number = np.unique(np.round(flat, _SAME), axis=0, return_index=True, return_inverse=True)
    return flat[first], number.reshape(-1, 3)
