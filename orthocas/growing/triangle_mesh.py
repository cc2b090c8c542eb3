"""Triangles in space and their topology."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array, frozen_array, require_shape
from orthocas.errors import InvalidValueError, NotADiskError

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles in space.

    Args:
        vertices: (V, 3), finite.
        faces: (F, 3) indices of vertices, counterclockwise seen from the side the normal points to.

    Raises:
        ShapeError: if an array has another shape.
        InvalidValueError: if a vertex is not finite, or a face names a vertex that is not there.
    """

    vertices: Array
    faces: Indices

    def __post_init__(self) -> None:
        faces = np.array(self.faces, dtype=np.int64)
        require_shape("faces", faces.shape, (None, 3))
        object.__setattr__(self, "vertices", frozen_array("vertices", self.vertices, (None, 3)))
        if faces.size and not 0 <= faces.min() <= faces.max() < len(self.vertices):
            bad = faces.min() if faces.min() < 0 else faces.max()
            raise InvalidValueError("faces", int(bad), f"indices of {len(self.vertices)} vertices")
        faces.setflags(write=False)
        object.__setattr__(self, "faces", faces)

    @cached_property
    def edges(self) -> Indices:
        """Every edge once, (E, 2), the smaller index first."""
        keys = np.unique(edge_keys(*half_edges(self.faces), len(self.vertices)))
        return np.stack(np.divmod(keys, len(self.vertices)), axis=1)

    @cached_property
    def boundary_edges(self) -> Indices:
        """Edges of a single triangle, in the direction in which it passes them, (B, 2)."""
        start, end = half_edges(self.faces)
        keys = edge_keys(start, end, len(self.vertices))
        _, edge, count = np.unique(keys, return_inverse=True, return_counts=True)
        alone = count[edge] == 1
        return np.stack([start[alone], end[alone]], axis=1)

    @cached_property
    def clashing_edges(self) -> int:
        """Number of edges with three or more triangles, or with two that turn opposite ways."""
        start, end = half_edges(self.faces)
        keys, count = np.unique(start * len(self.vertices) + end, return_counts=True)
        again = np.stack(np.divmod(keys[count > 1], len(self.vertices)), axis=1)
        return len(np.unique(np.sort(again, axis=1), axis=0))

    @cached_property
    def components(self) -> int:
        """Number of parts whose triangles are joined by edges."""
        _, edge = np.unique(edge_keys(*half_edges(self.faces), len(self.vertices)), return_inverse=True)
        return _parts(np.tile(np.arange(len(self.faces)), 3), edge + len(self.faces))

    @cached_property
    def boundary_loops(self) -> int:
        """Number of separate curves of the boundary."""
        _, vertex = np.unique(self.boundary_edges, return_inverse=True)
        start, end = vertex.reshape(-1, 2).T
        return _parts(start, end)

    @property
    def euler_characteristic(self) -> int:
        """V - E + F: 1 for a disk, 0 for a tube, 2 for a sphere."""
        return len(self.vertices) - len(self.edges) + len(self.faces)


def require_disk(mesh: TriangleMesh) -> Indices:
    """The boundary of a mesh that is a topological disk.

    One part joined by edges, one boundary loop and V - E + F = 1 make a surface whose edges have at most two triangles
    a disk; two corners that touch in a vertex lower V - E + F.

    Returns:
        The boundary loop (B,), counterclockwise seen from the side of the normals, from its lowest index on.

    Raises:
        NotADiskError: if it is no disk; says what was found.

    Source:
        Ours: docs/derivations.md#disk-chart.
    """
    found = (mesh.components, mesh.boundary_loops, mesh.euler_characteristic)
    if found != (1, 1, 1) or mesh.clashing_edges:
        raise NotADiskError(*found, mesh.clashing_edges)
    following = dict(mesh.boundary_edges.tolist())
    loop = [min(following)]
    while len(loop) < len(following):
        loop.append(following[loop[-1]])
    return np.array(loop)


def half_edges(faces: Indices) -> tuple[Indices, Indices]:
    """Start and end of the edges of all faces, (3 F,) each: first those opposite corner 0, then 1, then 2."""
    return faces[:, [1, 2, 0]].T.ravel(), faces[:, [2, 0, 1]].T.ravel()


def edge_keys(start: Indices, end: Indices, count: int) -> Indices:
    """One number for each edge between two of `count` vertices, whatever its direction."""
    return np.minimum(start, end) * count + np.maximum(start, end)


def _parts(start: Indices, end: Indices) -> int:
    """Connected components of a graph whose nodes are 0..N-1 and all have an edge."""
    if not len(start):
        return 0
    size = int(max(start.max(), end.max())) + 1
    graph = coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(size, size))
    return int(connected_components(graph, directed=False, return_labels=False))
