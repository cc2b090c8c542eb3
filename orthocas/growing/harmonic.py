"""Harmonic map of a disk-shaped mesh onto the unit disk."""

import numpy as np

from orthocas.checks import Array, Indices, require_finite, require_shape
from orthocas.errors import FoldedMapError, InvalidValueError
from orthocas.growing import libigl as igl
from orthocas.growing.level_surface import TriangleMesh, require_disk
from orthocas.growing.mesh_improvement import cotangents


def harmonic_disk(mesh: TriangleMesh) -> Array:
    """One-to-one harmonic map of a mesh onto the unit disk.

    Boundary vertices lie on the unit circle, spaced by arc length; the one with the lowest index has angle 0. Every
    inner vertex is the mean of its neighbours, weighted by cot(alpha) + cot(beta) with the angles opposite the edge. If
    no weight is negative (a Delaunay mesh), the map is one-to-one. The result is always checked for folds.

    Args:
        mesh: a topological disk.

    Returns:
        Images of the vertices, (V, 2); all triangles are counterclockwise.

    Raises:
        NotADiskError: if the mesh is not a disk.
        InvalidValueError: if a triangle has no area.
        FoldedMapError: if the map inverts triangles.

    Source:
        [AS2023] eqs. (40)-(43), by libigl. The check is ours: docs/derivations.md#disk-chart.
    """
    loop = require_disk(mesh)
    disk = solve_dirichlet(mesh, loop, igl.map_vertices_to_circle(mesh.vertices, loop))
    areas = signed_areas(disk, mesh.faces)
    folded = int(np.sum(~(areas > 0)))
    if folded:
        raise FoldedMapError(folded, len(areas))
    return disk


def solve_dirichlet(mesh: TriangleMesh, fixed: Indices, values: Array) -> Array:
    """Discrete harmonic functions with given values at some vertices.

    sum_j w_ij (u_j - u_i) = 0 at every other vertex i, with w_ij = cot(alpha_ij) + cot(beta_ij).

    Args:
        mesh: triangles with areas > 0.
        fixed: indices of vertices (B,), at least one in each component of the mesh.
        values: values at these vertices, (B, k).

    Returns:
        Values at all vertices, (V, k).

    Raises:
        ShapeError: if the values do not match the fixed vertices.
        InvalidValueError: if a triangle has no area, or the equations are singular.

    Source:
        [AS2023] eqs. (40), (41), (43), by libigl.
    """
    require_shape("values", values.shape, (len(fixed), None))
    require_finite("cotangent", cotangents(mesh.vertices, mesh.faces))
    try:
        result: Array = igl.harmonic(mesh.vertices, mesh.faces, fixed, values, 1)
    except RuntimeError:
        wanted = "at least one in each component of a mesh without nearly flat triangles"
        raise InvalidValueError("fixed", f"{len(fixed)} vertices", wanted) from None
    return result


def signed_areas(points: Array, faces: Indices) -> Array:
    """Signed areas of triangles in the plane, (F,), positive if counterclockwise."""
    a, b = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    areas: Array = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return areas
