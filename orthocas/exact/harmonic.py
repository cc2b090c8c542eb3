"""Level surfaces of a task as meshes, and harmonic maps of them ([AS2023] App. B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import skimage
from numpy.typing import ArrayLike, NDArray

from orthocas.errors import FoldedMapError, InvalidValueError
from orthocas.exact.mesh import (
    TriangleMesh,
    compute_cotangents,
    compute_smoothing_steps,
    flip_to_delaunay,
    igl,
    require_disk,
)
from orthocas.tools.checks import Array, Indices, freeze_array, require_count, require_finite, require_shape


@dataclass(frozen=True, slots=True)
class SurfaceRules:
    """Numbers of marching cubes and of the vertices on a surface."""

    on_level: float = 2e-13  #: |h - level| of a vertex, relative to the larger of 1 and the largest |h|
    rounds: int = 4  #: of flips and smoothing
    newton_steps: int = 20  #: of a vertex to the surface
    bisections: int = 60  #: of a grid edge, where Newton steps fail
    #: smallest distance of marching cubes vertices from grid points, as a fraction of a cell's edge
    clearance: float = 0.1
    tiny: float = 1e-300  #: to divide by
    chunk: int = 500_000  #: grid points per call of h


RULES = SurfaceRules()


Mask = NDArray[np.bool_]
Function = Callable[[Array], Array]  #: (N, 3) -> (N,), or (N, 3) for a gradient


def build_level_surface(
    h: Function, gradient: Function, level: float, low: ArrayLike, high: ArrayLike, cells: int
) -> TriangleMesh:
    """The surface {q : low <= q <= high, h(q) = level}.

    Marching cubes finds the topology, Newton steps along the gradient move every vertex onto the surface, and edge
    flips with tangential smoothing make the triangles round and Delaunay. Vertices on faces of the box stay there.

    Args:
        h: function (N, 3) -> (N,).
        gradient: dh/dq, (N, 3) -> (N, 3).
        level: the value of h on the surface.
        low: (3,) lower corner of the box [rad] or [m].
        high: (3,) upper corner of the box, > low.
        cells: number of grid cells along the longest edge of the box, >= 2.

    Returns:
        A mesh with normals along the gradient and |h - level| <= 1e-12 at its vertices, relative to the largest |h| if
        that exceeds 1. Components smaller than a cell may be missed.

    Raises:
        ShapeError: if low, high, or a value of h or its gradient has the wrong shape.
        InvalidValueError: if h does not take the value in the box, is not finite, or jumps across the value.

    Source:
        Marching cubes: [AS2023] Sec. 5.2. Exact vertices and the improvement of the triangles are ours:
        docs/explanation/derivations_disk.md.
    """
    freeze_array("level", level, ())
    corners = np.stack([freeze_array("low", low, (3,)), freeze_array("high", high, (3,))])
    if not np.all(corners[0] < corners[1]):
        raise InvalidValueError("low", corners[0].tolist(), f"less than high = {corners[1].tolist()}")
    # A grid of nearly cubic cells, so many of them along the longest edge.
    width = corners[1] - corners[0]
    longest = require_count("cells", cells, least=2)
    counts = np.maximum(1, np.ceil(longest * width / width.max() - 1e-9)).astype(int) + 1
    axes = [np.linspace(corners[0, i], corners[1, i], counts[i]) for i in range(3)]
    # Marching cubes, then Newton steps onto the surface, then flips and smoothing in turns.
    gap, largest = _sample_gap(h, level, axes)
    points, faces, free, ends = _march_cubes(gap, axes)
    tolerance, cell = RULES.on_level * max(1.0, largest), float(axes[0][1] - axes[0][0])
    sheet = _Sheet(h, gradient, level, corners, free, tolerance, cell)
    points = sheet.start(points, ends)
    for _ in range(RULES.rounds):
        faces = flip_to_delaunay(points, faces)
        points = sheet.slide(points, compute_smoothing_steps(points, faces))
    return TriangleMesh(points, flip_to_delaunay(points, faces))


@dataclass(frozen=True)
class _Sheet:
    """The surface and the box; vertices of the mesh move on both."""

    h: Function
    gradient: Function
    level: float
    corners: Array  #: (2, 3)
    free: Mask  #: (V, 3): whether a vertex may move along an axis; false across the faces of the box that it lies on
    tolerance: float  #: of h
    cell: float  #: edge length of a grid cell

    def start(self, points: Array, ends: Array) -> Array:
        """Move marching cubes vertices onto the surface, by bisection between ends (2, V, 3) where Newton fails."""
        moved, failed = self._take_newton_steps(points)
        if failed.any():
            moved[failed] = self._bisect(ends[:, failed])
        return moved

    def slide(self, points: Array, steps: Array) -> Array:
        """Move vertices by the part of their steps along surface and box; a vertex stays in place if Newton fails."""
        normal = _evaluate_checked(self.gradient, points, "gradient", (3,)) * self.free
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), RULES.tiny)
        along = steps * self.free
        moved, failed = self._take_newton_steps(points + along - normal * np.sum(normal * along, axis=1, keepdims=True))
        moved[failed] = points[failed]
        return moved

    def _take_newton_steps(self, start: Array) -> tuple[Array, Mask]:
        """Take Newton steps along the free part of the gradient; return vertices that fail or move more than a cell."""
        points, moving = start.copy(), np.arange(len(start))
        for _ in range(RULES.newton_steps):
            gap = self._evaluate_gap(points[moving])
            moving, gap = moving[np.abs(gap) > self.tolerance], gap[np.abs(gap) > self.tolerance]
            if not len(moving):
                break
            # A Newton step along the free part of the gradient, at most a cell long.
            slope = _evaluate_checked(self.gradient, points[moving], "gradient", (3,)) * self.free[moving]
            step = slope * (gap / np.maximum(np.sum(slope**2, axis=1), RULES.tiny))[:, None]
            length = np.linalg.norm(step, axis=1, keepdims=True)
            step *= self.cell / np.maximum(length, self.cell)
            points[moving] = np.clip(points[moving] - step, *self.corners)
        failed = np.linalg.norm(points - start, axis=1) > self.cell
        failed[moving] = True
        return points, failed

    def _bisect(self, ends: Array) -> Array:
        """A point of the surface between each pair of ends (2, K, 3)."""
        # Halves whose value has the sign of the first end move that end.
        a, b = ends
        below = self._evaluate_gap(a) < 0
        for _ in range(RULES.bisections):
            centre = (a + b) / 2
            same = ((self._evaluate_gap(centre) < 0) == below)[:, None]
            a, b = np.where(same, centre, a), np.where(same, b, centre)
        # Of the two ends, the one nearer to the level; where h jumps, neither is near.
        points: Array = np.where((np.abs(self._evaluate_gap(a)) < np.abs(self._evaluate_gap(b)))[:, None], a, b)
        off = np.flatnonzero(np.abs(self._evaluate_gap(points)) > self.tolerance)
        if len(off):
            place = np.round(points[off[0]], 4).tolist()
            raise InvalidValueError("level", self.level, f"a value that h does not jump across, as near {place}")
        return points

    def _evaluate_gap(self, points: Array) -> Array:
        """Checked values of h - level."""
        return _evaluate_checked(self.h, points, "h", ()) - self.level


def _sample_gap(h: Function, level: float, axes: list[Array]) -> tuple[NDArray[np.float32], float]:
    """h - level on the grid in single precision with the signs preserved, and the largest |h|."""
    # Slab by slab, since the grid does not fit into memory in double precision.
    shape = tuple(len(axis) for axis in axes)
    gap = np.empty(shape, dtype=np.float32)
    slab = max(1, RULES.chunk // (shape[1] * shape[2]))
    lowest, highest = np.inf, -np.inf
    for start in range(0, shape[0], slab):
        grid = np.stack(np.meshgrid(axes[0][start : start + slab], *axes[1:], indexing="ij"), axis=-1)
        values = _evaluate_checked(h, grid.reshape(-1, 3), "h", ())
        lowest, highest = min(lowest, float(values.min())), max(highest, float(values.max()))
        gap[start : start + slab] = (values - level).reshape(grid.shape[:3])
    # Without a value on both sides there is no surface.
    if not lowest < level < highest:
        raise InvalidValueError("level", level, f"a value of h in the box, found {lowest:.6g} to {highest:.6g}")
    return gap, max(abs(lowest), abs(highest))


def _march_cubes(gap: NDArray[np.float32], axes: list[Array]) -> tuple[Array, Indices, Mask, Array]:
    """Marching cubes: vertices (V, 3), faces (F, 3), free axes (V, 3), and the ends of their grid edges (2, V, 3).

    First the surface moves away from grid points, where triangles shrink to zero size. In place, |h - level| becomes at
    least `clearance` times the largest change to a neighbour, along each axis and both ways. Zeros become positive.
    """
    change = np.zeros_like(gap)
    for axis in range(3):
        step = np.abs(np.diff(gap, axis=axis))
        for side in (slice(None, -1), slice(1, None)):
            part = change[tuple(side if i == axis else slice(None) for i in range(3))]
            np.maximum(part, step, out=part)
    change *= RULES.clearance
    np.copyto(gap, np.where(gap < 0, -change, change), where=np.abs(gap) < change)
    # Vertices lie on grid edges, between the grid points around them.
    index, faces, _, _ = skimage.measure.marching_cubes(gap, 0.0, gradient_direction="descent")
    corners = np.stack([np.floor(index), np.ceil(index)]).astype(int)
    ends = np.stack([axis[corners[:, :, i]] for i, axis in enumerate(axes)], axis=2)
    points = ends[0] + (index - corners[0]) * (ends[1] - ends[0])
    return points, faces.astype(np.int64), (index > 0) & (index < np.array(gap.shape) - 1), ends


def _evaluate_checked(function: Function, points: Array, name: str, shape: tuple[int, ...]) -> Array:
    """Checked values of h or its gradient."""
    values = np.asarray(function(points), dtype=float)
    require_shape(f"{name}(q)", values.shape, (len(points), *shape))
    require_finite(f"{name}(q)", values)
    return values


def map_to_disk(mesh: TriangleMesh) -> Array:
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
