"""Harmonic map of a disk-shaped mesh onto the unit disk."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from orthocas.checks import Array, require_finite, require_shape
from orthocas.errors import FoldedMapError, InvalidValueError
from orthocas.growing.level_surface import TriangleMesh, require_disk
from orthocas.growing.mesh_improvement import cotangents
from orthocas.growing.triangle_mesh import Indices, half_edges


def harmonic_disk(mesh: TriangleMesh) -> Array:
    """One-to-one harmonic map of a mesh onto the unit disk.

    Boundary vertices go to the unit circle by arc length, from angle 0 at the lowest index on; every inner vertex is
    the mean of its neighbours with the weights cot(alpha) + cot(beta). Where these are >= 0 (a Delaunay mesh) the map
    is one-to-one; whether it is, is checked for every mesh.

    Args:
        mesh: a topological disk.

    Returns:
        (V, 2); all triangles are counterclockwise.

    Raises:
        NotADiskError: if the mesh is no disk.
        InvalidValueError: if a triangle has no area, or an edge of the boundary no length.
        FoldedMapError: if triangles are turned over.

    Source:
        [AS2023] eqs. (40)-(43). The check is ours: docs/derivations.md#disk-chart.
    """
    loop = require_disk(mesh)
    disk = solve_dirichlet(mesh, loop, circle_by_arc_length(mesh.vertices[loop]))
    areas = signed_areas(disk, mesh.faces)
    folded = int(np.sum(~(areas > 0)))
    if folded:
        raise FoldedMapError(folded, len(areas))
    return disk


def circle_by_arc_length(loop: Array) -> Array:
    """Points of a closed polygon (B, d) on the unit circle, (B, 2), from angle 0 on, spaced as their edges are long.

    Raises:
        InvalidValueError: if an edge has no length.

    Source:
        [AS2023] eq. (42).
    """
    lengths = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    if not lengths.min() > 0:
        raise InvalidValueError("length of a boundary edge", lengths.min(), "a positive number")
    angles = 2 * np.pi * np.concatenate([[0.0], np.cumsum(lengths[:-1])]) / lengths.sum()
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def solve_dirichlet(mesh: TriangleMesh, fixed: Indices, values: Array) -> Array:
    """Discrete harmonic functions with given values at some vertices.

    sum_j w_ij (u_j - u_i) = 0 at every other vertex i. With the rows of fixed vertices eliminated the matrix is
    symmetric, and positive definite whatever the signs of the weights: u^T L u is the Dirichlet energy of the
    piecewise linear function u.

    Args:
        mesh: triangles with areas > 0.
        fixed: vertices (B,), at least one in each part of the mesh.
        values: (B, k).

    Returns:
        (V, k).

    Source:
        [AS2023] eqs. (40), (41), (43).
    """
    require_shape("values", values.shape, (len(fixed), None))
    laplacian = _laplacian(mesh)
    inner = np.setdiff1d(np.arange(len(mesh.vertices)), fixed)
    result = np.empty((len(mesh.vertices), values.shape[1]))
    result[fixed] = values
    if len(inner):
        rows = laplacian[inner]
        factors = splu(
            rows[:, inner].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        result[inner] = factors.solve(-(rows[:, fixed] @ values))
    return result


def signed_areas(points: Array, faces: Indices) -> Array:
    """Areas of triangles in the plane, (F,), > 0 where counterclockwise."""
    a, b = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    areas: Array = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return areas


def _laplacian(mesh: TriangleMesh) -> coo_array:
    """L (V, V): off the diagonal -w_ij = -(cot(alpha_ij) + cot(beta_ij)), rows sum up to 0. [AS2023] eq. (43)."""
    weight = cotangents(mesh.vertices, mesh.faces)
    require_finite("cotangent", weight)
    start, end = half_edges(mesh.faces)
    weight, size = weight.T.ravel(), len(mesh.vertices)
    row, column = np.concatenate([start, end, start, end]), np.concatenate([end, start, start, end])
    return coo_array((np.concatenate([-weight, -weight, weight, weight]), (row, column)), shape=(size, size)).tocsr()
