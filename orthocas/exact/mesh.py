"""Level surfaces of a task as triangle meshes, and their harmonic maps ([AS2023] App. B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np
import skimage
from numpy.typing import ArrayLike, NDArray

from orthocas.errors import FoldedMapError, InvalidValueError, NotADiskError
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    Indices,
    freeze_array,
    freeze_indices,
    import_extra,
    require_count,
    require_finite,
    require_shape,
)


@dataclass(frozen=True, slots=True)
class MeshRules:
    """Numbers of meshes."""

    chunk: int = 10_000  #: points per call of libigl, which Ctrl-C cannot interrupt; 0.1 s on 200,000 triangles
    #: largest number of rounds of flips; a few dozen suffice, but termination is not proved on curved surfaces
    rounds: int = 200
    flat: float = -1e-9  #: an edge is flipped if the cotangents of its opposite angles sum to less than this


RULES = MeshRules()


class _Libigl:
    """The package libigl of the extra `mesh`, imported on first use."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_extra("igl", "a chart on a surface", "mesh"), name)


igl = _Libigl()


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles in space.

    Args:
        vertices: (V, 3), finite.
        faces: (F, 3) indices of vertices, counterclockwise as seen from the side of the normal.

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
        # libigl would run out of memory without triangles.
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

        This is our own count, because `igl.is_edge_manifold` misses the second case.
        """
        start, end = list_half_edges(self.faces)
        keys, count = np.unique(start * len(self.vertices) + end, return_counts=True)
        again = np.stack(np.divmod(keys[count > 1], len(self.vertices)), axis=1)
        return len(np.unique(np.sort(again, axis=1), axis=0))

    @cached_property
    def components(self) -> int:
        """Number of connected components. Triangles are connected through edges, not through vertices."""
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

    A surface with at most two triangles at each edge is a disk if it has one component, one boundary loop and V - E + F
    = 1. If two corners touch in one vertex, V - E + F is lower.

    Returns:
        The boundary loop (B,), counterclockwise as seen from the side of the normals, starting at the lowest index.

    Raises:
        NotADiskError: if the mesh is not a disk. The message says what it is.

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
        # The list can be cleared without a reference to this object.
        self._trees = [igl.AABB()]
        self._trees[0].init(self._points, self._faces)
        # Clear the tree also at exit, where libigl would otherwise report a leak.
        finalize(self, self._trees.clear)

    def __reduce__(self) -> tuple[type[TriangleLocator], tuple[Array, Indices]]:
        """Pickle and copy only the mesh; the copy rebuilds the tree."""
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
            # If a distance is not finite, libigl has found no face.
            require_finite("squared distance", squares)
            weights = _compute_barycentric(closest, self._points[self._faces[face]])
            parts.append(Located(face, weights, np.sqrt(squares)))
        return Located(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _pad_to_space(points: Array) -> Array:
    """Points (N, 2) in the plane z = 0, because libigl's tree reads beyond the end of arrays with two columns."""
    return np.ascontiguousarray(np.pad(points, ((0, 0), (0, 3 - points.shape[1]))))


def _compute_barycentric(points: Array, triangles: Array) -> Array:
    """Barycentric coordinates (N, 3) of points (N, 3) on triangles (N, 3, 3).

    This is our own code, because libigl loses accuracy in flat triangles. For height 1e-4 and length 1, libigl's
    coordinates reproduce the point to 1e-8, and ours to 1e-13.
    """
    normals = _compute_normals(triangles)
    to_corners = triangles - points[:, None]
    # Areas of the triangles opposite corners 0, 1, 2.
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
    """Flip edges until the angles opposite every inner edge sum to at most half a turn.

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
        # Sort the keys of all edges, and find the two half-edges of each inner edge; four times as fast as
        # `igl.edge_flaps`.
        keys = number_edges(*list_half_edges(faces), len(vertices))
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        twin = np.flatnonzero(keys[1:] == keys[:-1])
        first, second = order[twin], order[twin + 1]
        # Flip edges whose opposite angles are too large, the worst first.
        cot = np.nan_to_num(compute_cotangents(vertices, faces), nan=0.0, posinf=1e12, neginf=-1e12).T.ravel()
        weight = cot[first] + cot[second]
        flat = np.flatnonzero(weight < RULES.flat)
        flat = flat[np.argsort(weight[flat], kind="stable")]
        if not _flip(vertices, faces, keys, first[flat], second[flat]):
            break
    return faces


def compute_smoothing_steps(points: Array, faces: Indices) -> Array:
    """Smoothing steps (V, 3) from each vertex to the mean of its neighbours. Every vertex must be in a triangle."""
    neighbours = igl.adjacency_matrix(faces)
    mean = (neighbours @ points) / np.diff(neighbours.indptr)[:, None]
    return np.asarray(mean - points)


def _flip(vertices: Array, faces: Indices, keys: Indices, first: Indices, second: Indices) -> bool:
    """Flip edges in place, the worst first; returns whether any edge was flipped.

    An edge is flipped if the new edge does not exist yet, and the new triangles face the same way as the old ones. If
    several flips share a triangle or a new edge, only the first is done.
    """
    # Edges i -> j with the opposite corners k in the first triangle and n in the second, as rows (N, 4).
    face, corner = first % len(faces), first // len(faces)
    i, j, k = (faces[face, (corner + shift) % 3] for shift in (1, 2, 0))
    quads = np.stack([i, j, k, faces[second % len(faces), second // len(faces)]], axis=1)
    # The new edge is k - n. The normals of i n k and n j k must point along the sum of the old normals.
    new = number_edges(quads[:, 2], quads[:, 3], len(vertices))
    place = np.minimum(np.searchsorted(keys, new), len(keys) - 1)
    p, q, r, s = (vertices[quads[:, c]] for c in range(4))
    normal = np.cross(q - p, r - p) + np.cross(p - q, s - q)
    one, two = (np.einsum("nd,nd->n", np.cross(a, b), normal) for a, b in ((s - p, r - p), (q - s, r - s)))
    allowed = (keys[place] != new) & (one > 0) & (two > 0)
    quads, face, other, new = quads[allowed], face[allowed], (second % len(faces))[allowed], new[allowed]
    # Keep flips that are the first at both triangles and at their new edge; `np.unique` returns first occurrences.
    _, at_face = np.unique(np.stack([face, other], axis=1), return_index=True)
    wins = np.bincount(at_face // 2, minlength=len(face)) == 2
    chosen = wins & np.isin(np.arange(len(face)), np.unique(new, return_index=True)[1])
    # Replace the edge i - j by k - n.
    i, j, k, n = quads[chosen].T
    faces[face[chosen]] = np.stack([i, n, k], axis=1)
    faces[other[chosen]] = np.stack([n, j, k], axis=1)
    return bool(chosen.any())


@dataclass(frozen=True, slots=True)
class SurfaceRules:
    """Numbers of marching cubes and of the vertices on a surface."""

    on_level: float = 2e-13  #: |h - level| allowed at a vertex, relative to the larger of 1 and the largest |h|
    rounds: int = 4  #: rounds of flips and smoothing
    newton_steps: int = 20  #: Newton steps of a vertex to the surface
    bisections: int = 60  #: bisections of a grid edge, where Newton's method fails
    #: smallest distance of vertices from grid points in marching cubes, as a fraction of a cell's edge
    clearance: float = 0.1
    tiny: float = 1e-300  #: lower bound of divisors
    chunk: int = 500_000  #: grid points per call of h


SURFACE = SurfaceRules()


Mask = NDArray[np.bool_]
Function = Callable[[Array], Array]  #: (N, 3) -> (N,), or (N, 3) for a gradient


def build_level_surface(
    h: Function, gradient: Function, level: float, low: ArrayLike, high: ArrayLike, cells: int
) -> TriangleMesh:
    """The surface {q : low <= q <= high, h(q) = level}.

    Marching cubes finds the topology. Newton steps along the gradient move every vertex onto the surface. Edge flips
    with tangential smoothing make the triangles round and Delaunay. Vertices on faces of the box stay there.

    Args:
        h: function (N, 3) -> (N,).
        gradient: dh/dq, (N, 3) -> (N, 3).
        level: value of h on the surface.
        low: (3,) lower corner of the box [rad] or [m].
        high: (3,) upper corner of the box, > low.
        cells: number of grid cells along the longest edge of the box, >= 2.

    Returns:
        A mesh with normals along the gradient and |h - level| <= 1e-12 at its vertices, relative to the largest |h| if
        that exceeds 1. It may miss components smaller than a cell.

    Raises:
        ShapeError: if low, high, or a value of h or its gradient has the wrong shape.
        InvalidValueError: if h does not take this value in the box, is not finite, or jumps across the value.

    Source:
        Marching cubes: [AS2023] Sec. 5.2. Exact vertices and the improvement of the triangles are ours:
        docs/explanation/derivations_disk.md.
    """
    freeze_array("level", level, ())
    corners = np.stack([freeze_array("low", low, (3,)), freeze_array("high", high, (3,))])
    if not np.all(corners[0] < corners[1]):
        raise InvalidValueError("low", corners[0].tolist(), f"less than high = {corners[1].tolist()}")
    # Use a grid of nearly cubic cells, with the given number along the longest edge.
    width = corners[1] - corners[0]
    longest = require_count("cells", cells, least=2)
    counts = np.maximum(1, np.ceil(longest * width / width.max() - 1e-9)).astype(int) + 1
    axes = [np.linspace(corners[0, i], corners[1, i], counts[i]) for i in range(3)]
    # Marching cubes, then Newton steps onto the surface, then alternating flips and smoothing.
    gap, largest = _sample_gap(h, level, axes)
    points, faces, free, ends = _march_cubes(gap, axes)
    tolerance, cell = SURFACE.on_level * max(1.0, largest), float(axes[0][1] - axes[0][0])
    sheet = _Sheet(h, gradient, level, corners, free, tolerance, cell)
    points = sheet.start(points, ends)
    for _ in range(SURFACE.rounds):
        faces = flip_to_delaunay(points, faces)
        points = sheet.slide(points, compute_smoothing_steps(points, faces))
    return TriangleMesh(points, flip_to_delaunay(points, faces))


@dataclass(frozen=True)
class _Sheet:
    """The surface and the box, on which the vertices of the mesh move."""

    h: Function
    gradient: Function
    level: float
    corners: Array  #: (2, 3)
    free: Mask  #: (V, 3): whether a vertex may move along an axis; false across a face of the box that contains it
    tolerance: float  #: tolerance of h
    cell: float  #: edge length of a grid cell

    def start(self, points: Array, ends: Array) -> Array:
        """Move marching cubes vertices onto the surface, by bisection between ends (2, V, 3) where Newton fails."""
        moved, failed = self._take_newton_steps(points)
        if failed.any():
            moved[failed] = self._bisect(ends[:, failed])
        return moved

    def slide(self, points: Array, steps: Array) -> Array:
        """Move vertices by the part of their steps along surface and box; they stay in place if Newton fails."""
        normal = _evaluate_checked(self.gradient, points, "gradient", (3,)) * self.free
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), SURFACE.tiny)
        along = steps * self.free
        moved, failed = self._take_newton_steps(points + along - normal * np.sum(normal * along, axis=1, keepdims=True))
        moved[failed] = points[failed]
        return moved

    def _take_newton_steps(self, start: Array) -> tuple[Array, Mask]:
        """Take Newton steps along the free part of the gradient; also returns vertices that fail or leave a cell."""
        points, moving = start.copy(), np.arange(len(start))
        for _ in range(SURFACE.newton_steps):
            gap = self._evaluate_gap(points[moving])
            moving, gap = moving[np.abs(gap) > self.tolerance], gap[np.abs(gap) > self.tolerance]
            if not len(moving):
                break
            # Newton step along the free part of the gradient, at most one cell long.
            slope = _evaluate_checked(self.gradient, points[moving], "gradient", (3,)) * self.free[moving]
            step = slope * (gap / np.maximum(np.sum(slope**2, axis=1), SURFACE.tiny))[:, None]
            length = np.linalg.norm(step, axis=1, keepdims=True)
            step *= self.cell / np.maximum(length, self.cell)
            points[moving] = np.clip(points[moving] - step, *self.corners)
        failed = np.linalg.norm(points - start, axis=1) > self.cell
        failed[moving] = True
        return points, failed

    def _bisect(self, ends: Array) -> Array:
        """A point of the surface between each pair of ends (2, K, 3)."""
        # The midpoint replaces the end at which h - level has the same sign.
        a, b = ends
        below = self._evaluate_gap(a) < 0
        for _ in range(SURFACE.bisections):
            centre = (a + b) / 2
            same = ((self._evaluate_gap(centre) < 0) == below)[:, None]
            a, b = np.where(same, centre, a), np.where(same, b, centre)
        # Take the end nearer to the level. If h jumps, neither end is near.
        points: Array = np.where((np.abs(self._evaluate_gap(a)) < np.abs(self._evaluate_gap(b)))[:, None], a, b)
        off = np.flatnonzero(np.abs(self._evaluate_gap(points)) > self.tolerance)
        if len(off):
            place = np.round(points[off[0]], 4).tolist()
            raise InvalidValueError("level", self.level, f"a value that h does not jump across; it does near {place}")
        return points

    def _evaluate_gap(self, points: Array) -> Array:
        """h - level at points, checked to be finite."""
        return _evaluate_checked(self.h, points, "h", ()) - self.level


def _sample_gap(h: Function, level: float, axes: list[Array]) -> tuple[NDArray[np.float32], float]:
    """h - level on the grid in single precision with the right signs, and the largest |h|."""
    # Work in slabs, because the grid in double precision does not fit into memory.
    shape = tuple(len(axis) for axis in axes)
    gap = np.empty(shape, dtype=np.float32)
    slab = max(1, SURFACE.chunk // (shape[1] * shape[2]))
    lowest, highest = np.inf, -np.inf
    for start in range(0, shape[0], slab):
        grid = np.stack(np.meshgrid(axes[0][start : start + slab], *axes[1:], indexing="ij"), axis=-1)
        values = _evaluate_checked(h, grid.reshape(-1, 3), "h", ())
        lowest, highest = min(lowest, float(values.min())), max(highest, float(values.max()))
        gap[start : start + slab] = (values - level).reshape(grid.shape[:3])
    # Without values on both sides there is no surface.
    if not lowest < level < highest:
        raise InvalidValueError("level", level, f"a value of h in the box, found {lowest:.6g} to {highest:.6g}")
    return gap, max(abs(lowest), abs(highest))


def _march_cubes(gap: NDArray[np.float32], axes: list[Array]) -> tuple[Array, Indices, Mask, Array]:
    """Marching cubes: vertices (V, 3), faces (F, 3), free axes (V, 3), and the ends of their grid edges (2, V, 3).

    Triangles would shrink to zero size near grid points, so the surface is first moved away from them. In place, |h -
    level| is increased to at least `clearance` times the largest change to a neighbour, along each axis and in both
    directions. Zeros become positive.
    """
    change = np.zeros_like(gap)
    for axis in range(3):
        step = np.abs(np.diff(gap, axis=axis))
        for side in (slice(None, -1), slice(1, None)):
            part = change[tuple(side if i == axis else slice(None) for i in range(3))]
            np.maximum(part, step, out=part)
    change *= SURFACE.clearance
    np.copyto(gap, np.where(gap < 0, -change, change), where=np.abs(gap) < change)
    # Vertices lie on grid edges, between two neighbouring grid points.
    index, faces, _, _ = skimage.measure.marching_cubes(gap, 0.0, gradient_direction="descent")
    corners = np.stack([np.floor(index), np.ceil(index)]).astype(int)
    ends = np.stack([axis[corners[:, :, i]] for i, axis in enumerate(axes)], axis=2)
    points = ends[0] + (index - corners[0]) * (ends[1] - ends[0])
    return points, faces.astype(np.int64), (index > 0) & (index < np.array(gap.shape) - 1), ends


def _evaluate_checked(function: Function, points: Array, name: str, shape: tuple[int, ...]) -> Array:
    """Values of h or its gradient, with checked shape and finite entries."""
    values = np.asarray(function(points), dtype=float)
    require_shape(f"{name}(q)", values.shape, (len(points), *shape))
    require_finite(f"{name}(q)", values)
    return values


def map_to_disk(mesh: TriangleMesh) -> Array:
    """One-to-one harmonic map of a mesh onto the unit disk.

    Boundary vertices lie on the unit circle, spaced by arc length. The one with the lowest index has angle 0. Every
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
        [AS2023] eqs. (40)-(43), by libigl. The check is ours: docs/explanation/derivations_disk.md.
    """
    loop = require_disk(mesh)
    disk = solve_dirichlet(mesh, loop, igl.map_vertices_to_circle(mesh.vertices, loop))
    areas = compute_signed_areas(disk, mesh.faces)
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
    require_finite("cotangent", compute_cotangents(mesh.vertices, mesh.faces))
    try:
        result: Array = igl.harmonic(mesh.vertices, mesh.faces, fixed, values, 1)
    except RuntimeError:
        expected = "at least one in each component of a mesh without nearly flat triangles"
        raise InvalidValueError("fixed", f"{len(fixed)} vertices", expected) from None
    return result


def compute_signed_areas(points: Array, faces: Indices) -> Array:
    """Signed areas of triangles in the plane, (F,), positive if counterclockwise."""
    a, b = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    return np.asarray((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)
