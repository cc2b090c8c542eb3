"""Triangles in space and their topology."""

from dataclasses import dataclass

import numpy as np

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array, Indices, frozen_array, frozen_indices
from orthocas.errors import NotADiskError
from orthocas.growing import libigl as igl


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles in space.

    Args:
        vertices: (V, 3), finite.
        faces: (F, 3) indices of vertices, counterclockwise seen from the side the normal points to.

    Raises:
        ShapeError: if an array has the wrong shape.
        InvalidValueError: if a vertex is not finite, or a face refers to a vertex that does not exist.
    """

    vertices: Array
    faces: Indices

    def __post_init__(self) -> None:
        vertices = frozen_array("vertices", self.vertices, (None, 3))
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", frozen_indices("faces", self.faces, (None, 3), len(vertices)))

    @cached_property
    def edges(self) -> Indices:
        """Every edge once, (E, 2), the smaller index first."""
        if not len(self.faces):  # libigl would run out of memory
            return np.empty((0, 2), dtype=np.int64)
        edges: Indices = igl.edges(self.faces)
        return edges

    @cached_property
    def boundary_edges(self) -> Indices:
        """Edges with a single triangle, directed as in that triangle, (B, 2)."""
        edges: Indices = igl.boundary_facets(self.faces)[0]
        return edges

    @cached_property
    def clashing_edges(self) -> int:
        """Number of edges with three or more triangles, or with two triangles of opposite orientation.

        Ours, because `igl.is_edge_manifold` misses the second case.
        """
        start, end = half_edges(self.faces)
        keys, count = np.unique(start * len(self.vertices) + end, return_counts=True)
        again = np.stack(np.divmod(keys[count > 1], len(self.vertices)), axis=1)
        return len(np.unique(np.sort(again, axis=1), axis=0))

    @cached_property
    def components(self) -> int:
        """Number of connected components; triangles are connected through edges, not through vertices."""
        return int(igl.facet_components(self.faces)[0])

    @cached_property
    def boundary_loops(self) -> int:
        """Number of separate boundary curves."""
        if not len(self.boundary_edges):
            return 0
        _, edges = np.unique(self.boundary_edges, return_inverse=True)
        return int(igl.vertex_components(edges.reshape(-1, 2)).max()) + 1

    @property
    def euler_characteristic(self) -> int:
        """V - E + F: 1 for a disk, 0 for a tube, 2 for a sphere."""
        return len(self.vertices) - len(self.edges) + len(self.faces)


def require_disk(mesh: TriangleMesh) -> Indices:
    """Check that a mesh is a topological disk, and return its boundary.

    A surface with at most two triangles at each edge is a disk if it has one component, one boundary loop and
    V - E + F = 1. Two corners that touch in a vertex lower V - E + F.

    Returns:
        The boundary loop (B,), counterclockwise seen from the side of the normals, starting at the lowest index.

    Raises:
        NotADiskError: if the mesh is not a disk; the message says what it is.

    Source:
        Ours: docs/derivations.md#disk-chart.
    """
    found = (mesh.components, mesh.boundary_loops, mesh.euler_characteristic)
    if found != (1, 1, 1) or mesh.clashing_edges:
        raise NotADiskError(*found, mesh.clashing_edges)
    loop: Indices = igl.boundary_loop(mesh.faces)
    return np.roll(loop, -int(loop.argmin()))


def half_edges(faces: Indices) -> tuple[Indices, Indices]:
    """Start and end of the edges of all faces, (3 F,) each; edges opposite corner 0 first, then 1, then 2."""
    return faces[:, [1, 2, 0]].T.ravel(), faces[:, [2, 0, 1]].T.ravel()


def edge_keys(start: Indices, end: Indices, count: int) -> Indices:
    """One number per edge, the same for both directions, in a mesh with `count` vertices."""
    return np.minimum(start, end) * count + np.maximum(start, end)
