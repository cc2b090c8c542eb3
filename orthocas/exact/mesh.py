"""Triangle meshes of leaves: points on them, and meshes that are improved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, NotADiskError
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    Indices,
    freeze_array,
    freeze_indices,
    import_extra,
    require_finite,
    require_shape,
)


@dataclass(frozen=True, slots=True)
class MeshRules:
    """Numbers of meshes."""

    chunk: int = 10_000  #: points per call of libigl, which Ctrl-C cannot interrupt; 0.1 s on 200,000 triangles
    rounds: int = 200  #: of flips; a few dozen suffice, but there is no proof that they end on a curved surface
    flat: float = -1e-9  #: sum of the cotangents of the opposite angles below which an edge is flipped


RULES = MeshRules()


class _Libigl:
    """libigl, of the extra `mesh`, which is imported on first use."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_extra("igl", "a chart on a surface", "mesh"), name)


igl = _Libigl()


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
        vertices = freeze_array("vertices", self.vertices, (None, 3))
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", freeze_indices("faces", self.faces, (None, 3), len(vertices)))

    @cached_property
    def edges(self) -> Indices:
        """Every edge once, (E, 2), the smaller index first."""
        # Without triangles, libigl would run out of memory.
        if not len(self.faces):
            return np.empty((0, 2), dtype=np.int64)
        return np.asarray(igl.edges(self.faces))

    @cached_property
    def boundary_edges(self) -> Indices:
        """Edges with a single triangle, directed as in that triangle, (B, 2)."""
        return np.asarray(igl.boundary_facets(self.faces)[0])

    @cached_property
    def clashing_edges(self) -> int:
        """Number of edges with three or more triangles, or with two triangles of opposite orientation.

        Ours, because `igl.is_edge_manifold` misses the second case.
        """
        start, end = list_half_edges(self.faces)
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
        Ours: docs/explanation/derivations_disk.md.
    """
    kind = (mesh.components, mesh.boundary_loops, mesh.euler_characteristic)
    if kind != (1, 1, 1) or mesh.clashing_edges:
        raise NotADiskError(*kind, mesh.clashing_edges)
    loop: Indices = igl.boundary_loop(mesh.faces)
    return np.roll(loop, -int(loop.argmin()))


def list_half_edges(faces: Indices) -> tuple[Indices, Indices]:
    """Start and end of the edges of all faces, (3 F,) each; edges opposite corner 0 first, then 1, then 2."""
    return faces[:, [1, 2, 0]].T.ravel(), faces[:, [2, 0, 1]].T.ravel()


def number_edges(start: Indices, end: Indices, count: int) -> Indices:
    """One number per edge, the same for both directions, in a mesh with `count` vertices."""
    return np.minimum(start, end) * count + np.maximum(start, end)


class Located(NamedTuple):
    """Closest points on a mesh.

    The point is barycentric[i] @ vertices[faces[face[i]]].
    """

    face: Indices  #: (N,)
    barycentric: Array  #: (N, 3), >= 0, sums of 1
    distance: Array  #: (N,)


class TriangleLocator:
    """Finds closest points on a mesh, by the tree of bounding boxes of libigl.

    Args:
        vertices: (V, 2) or (V, 3), finite.
        faces: (F, 3) indices of vertices, triangles with areas > 0.

    Raises:
        ShapeError: if an array has the wrong shape.
        InvalidValueError: if there is no triangle, a triangle has no area, a vertex is not finite, or a face refers to
            a vertex that does not exist.

    Source:
        The nearest face by a tree: [AS2023] Sec. 5.2.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        self._vertices = freeze_array("vertices", vertices, (None, None))
        if self._vertices.shape[1] not in (2, 3):
            require_shape("vertices", self._vertices.shape, (None, 3))
        self._faces = freeze_indices("faces", faces, (None, 3), len(self._vertices))
        if not len(self._faces):
            raise InvalidValueError("faces", "empty", "at least one triangle")
        self._points = _pad_to_space(self._vertices)
        areas = np.linalg.norm(_compute_normals(self._points[self._faces]), axis=1) / 2
        if not areas.min() > 0:
            raise InvalidValueError(f"area of triangle {areas.argmin()}", areas.min(), "a positive number")
        # In a list, so that it can be cleared without the object.
        self._trees = [igl.AABB()]
        self._trees[0].init(self._points, self._faces)
        # Also at exit, where libigl would call a tree in use a leak.
        finalize(self, self._trees.clear)

    def __reduce__(self) -> tuple[type[TriangleLocator], tuple[Array, Indices]]:
        """Pickle and copy only the mesh; the tree is rebuilt."""
        return TriangleLocator, (self._vertices, self._faces)

    def locate(self, points: Array) -> Located:
        """Closest points on the mesh to points (N, d).

        Raises:
            ShapeError: if the dimension of the points differs from that of the mesh.
            InvalidValueError: if a point, or its squared distance, is not finite.
        """
        require_finite("points", points)
        require_shape("points", points.shape, (None, self._vertices.shape[1]))
        starts = range(0, max(len(points), 1), RULES.chunk)
        parts = []
        for start in starts:
            part = _pad_to_space(points[start : start + RULES.chunk])
            squares, face, closest = self._trees[0].squared_distance(self._points, self._faces, part)
            # Where a distance is not finite, libigl has found no face.
            require_finite("squared distance", squares)
            weights = _compute_barycentric(closest, self._points[self._faces[face]])
            parts.append(Located(face, weights, np.sqrt(squares)))
        return Located(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _pad_to_space(points: Array) -> Array:
    """Points (N, 2) in the plane z = 0, because libigl's tree reads beyond the end of arrays with two columns."""
    return np.ascontiguousarray(np.pad(points, ((0, 0), (0, 3 - points.shape[1]))))


def _compute_barycentric(points: Array, triangles: Array) -> Array:
    """Barycentric coordinates (N, 3) of points (N, 3) on triangles (N, 3, 3).

    Ours, because those of libigl lose digits in flat triangles. For height 1e-4 and length 1, they reproduce the point
    to 1e-8, and ours to 1e-13.
    """
    normals = _compute_normals(triangles)
    to_corners = triangles - points[:, None]
    # Of the triangles opposite corners 0, 1, 2.
    parts = np.cross(np.roll(to_corners, -1, axis=1), np.roll(to_corners, -2, axis=1))
    weights = np.maximum(np.einsum("ncd,nd->nc", parts, normals), 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _compute_normals(triangles: Array) -> Array:
    """Normal vectors of triangles (N, 3, 3), with twice the area as length, (N, 3)."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def compute_cotangents(vertices: Array, faces: Indices) -> Array:
    """Cotangents of the corner angles, (F, 3); not finite for triangles without area."""
    return np.asarray(2 * igl.cotmatrix_entries(vertices, faces))


def flip_to_delaunay(vertices: Array, faces: Indices) -> Indices:
    """Flip edges until the angles opposite every inner edge add up to at most half a turn.

    All weights cot(alpha) + cot(beta) are then >= 0. An edge is not flipped if the new edge already exists, or if a new
    triangle would face away from the old ones.

    Args:
        vertices: (V, 3).
        faces: (F, 3), triangles of an oriented mesh with at most two triangles at each edge.

    Returns:
        New faces (F, 3) with the same vertices, boundary and topology.

    Source:
        Ours, after [BS2007]: docs/explanation/derivations_disk.md.
    """
    faces = faces.copy()
    for _ in range(RULES.rounds):
        # Sorted keys of all edges, and the two half-edges of each inner edge: four times as fast as `igl.edge_flaps`.
        keys = number_edges(*list_half_edges(faces), len(vertices))
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        twin = np.flatnonzero(keys[1:] == keys[:-1])
        first, second = order[twin], order[twin + 1]
        # Flip those whose opposite angles are too large, the worst first.
        cot = np.nan_to_num(compute_cotangents(vertices, faces), nan=0.0, posinf=1e12, neginf=-1e12).T.ravel()
        weight = cot[first] + cot[second]
        flat = np.flatnonzero(weight < RULES.flat)
        flat = flat[np.argsort(weight[flat], kind="stable")]
        if not _flip(vertices, faces, keys, first[flat], second[flat]):
            break
    return faces


def compute_smoothing_steps(points: Array, faces: Indices) -> Array:
    """Smoothing steps (V, 3) from each vertex to the mean of its neighbours; every vertex must be in a triangle."""
    neighbours = igl.adjacency_matrix(faces)
    mean = (neighbours @ points) / np.diff(neighbours.indptr)[:, None]
    return np.asarray(mean - points)


def _flip(vertices: Array, faces: Indices, keys: Indices, first: Indices, second: Indices) -> bool:
    """Flip edges in place, the worst first, and return whether any was flipped.

    An edge is flipped if the new one does not exist, and the new triangles face the same way as the old ones. Of flips
    with a common triangle or new edge, the first is done.
    """
    # Edges i -> j, with the opposite corners k in the first triangle and n in the second, as rows (N, 4).
    face, corner = first % len(faces), first // len(faces)
    i, j, k = (faces[face, (corner + shift) % 3] for shift in (1, 2, 0))
    quads = np.stack([i, j, k, faces[second % len(faces), second // len(faces)]], axis=1)
    # The edge k - n is new, and the normals of i n k and n j k point as the sum of the old ones does.
    new = number_edges(quads[:, 2], quads[:, 3], len(vertices))
    place = np.minimum(np.searchsorted(keys, new), len(keys) - 1)
    p, q, r, s = (vertices[quads[:, c]] for c in range(4))
    normal = np.cross(q - p, r - p) + np.cross(p - q, s - q)
    one, two = (np.einsum("nd,nd->n", np.cross(a, b), normal) for a, b in ((s - p, r - p), (q - s, r - s)))
    allowed = (keys[place] != new) & (one > 0) & (two > 0)
    quads, face, other, new = quads[allowed], face[allowed], (second % len(faces))[allowed], new[allowed]
    # The first at both of its triangles and at its new edge: `np.unique` names the first of equal ones.
    _, at_face = np.unique(np.stack([face, other], axis=1), return_index=True)
    wins = np.bincount(at_face // 2, minlength=len(face)) == 2
    chosen = wins & np.isin(np.arange(len(face)), np.unique(new, return_index=True)[1])
    # The edge k - n takes the place of i - j.
    i, j, k, n = quads[chosen].T
    faces[face[chosen]] = np.stack([i, n, k], axis=1)
    faces[other[chosen]] = np.stack([n, j, k], axis=1)
    return bool(chosen.any())
