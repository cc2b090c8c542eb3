"""A base leaf with disk topology, for n = 3 and m = 1, charted by a harmonic map ([AS2023] Sec. 5.2)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from orthocas.errors import GrowError, InvalidValueError
from orthocas.exact.harmonic import TriangleMesh, harmonic_disk, level_surface
from orthocas.exact.leaf import LeafValues, covers, require_on_leaf, without_turns
from orthocas.exact.mesh import TriangleLocator
from orthocas.tasks.domains import Box, sample_uniform
from orthocas.tasks.problem import Problem
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices, frozen_array, frozen_indices, require_memory

CELLS = 60  #: default number of marching cubes cells along the longest edge of the region
_ROUNDS = 30  # Newton steps from a triangle to the leaf above it
_ON_LEAF = 1e-12  # accepted distance from the leaf [rad] or [m]
_FEWEST_ACROSS = 5  # smallest number of cells along the shortest edge of a region
_SCALE_SAMPLES = 1000  # samples to measure the size of the gradient


@dataclass(frozen=True, eq=False)
class DiskLeaf:
    """xi0(q), the harmonic map of a triangulated leaf onto the unit disk, linear on every triangle.

    A point of the leaf gets the coordinates of the nearest point of the mesh. Between neighbouring triangles, the jump
    of the gradient is of the order of the cell size, and the jump of the value is of the order of its third power.
    """

    problem: Problem = field(repr=False)
    level: Array  #: x0, (1,)
    region_centre: Array  #: (3,)
    region_half_width: Array  #: (3,)
    vertices: Array = field(repr=False)  #: (V, 3), on the leaf
    faces: Indices = field(repr=False)  #: (F, 3), indices of vertices
    disk: Array = field(repr=False)  #: images of the vertices, (V, 2)
    kind = "disk"
    turn = 0.0
    periodic = True

    def __post_init__(self) -> None:
        count = len(self.vertices)
        shapes: dict[str, tuple[int | None, ...]] = {
            "level": (1,),
            "region_centre": (3,),
            "region_half_width": (3,),
            "vertices": (count, 3),
            "disk": (count, 2),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen_array(name, getattr(self, name), shape))
        object.__setattr__(self, "faces", frozen_indices("faces", self.faces, (None, 3), count))
        if not len(self.faces):
            raise InvalidValueError("faces", "empty", "at least one triangle")
        if np.linalg.norm(self.disk, axis=1).max() > 1 + 1e-9:
            raise InvalidValueError("disk", "outside the unit disk", "images of the vertices in the unit disk")
        require_on_leaf(self.problem, self.level, self.vertices)

    @property
    def region(self) -> Box:
        """The box that bounds the charted part of the leaf."""
        return Box(self.region_centre, self.region_half_width)

    @cached_property
    def mesh(self) -> TriangleMesh:
        """The leaf as triangles."""
        return TriangleMesh(self.vertices, self.faces)

    def values(self, points: Array) -> LeafValues:
        """Coordinates of points on the leaf, (N, 3)."""
        points = self.region_centre + without_turns(self.problem, points - self.region_centre)
        found = self._in_space.locate(points)
        corners = self.disk[self.faces[found.face]]
        xi = np.einsum("sk,skr->sr", found.barycentric, corners)
        return LeafValues(xi, self._gradients[found.face], covers(self.region, points))

    def points(self, xi: Array, near: Array | None = None) -> Array:
        """Points of the leaf with coordinates xi (N, 2) in the disk; NaN for other xi.

        Each point moves from its triangle along the triangle's normal onto the leaf, so that `values` returns xi.
        """
        inside = np.hypot(xi[:, 0], xi[:, 1]) <= 1
        found = self._in_disk.locate(np.where(inside[:, None], xi, 0.0))
        corners = self.faces[found.face]
        feet = np.einsum("sk,skn->sn", found.barycentric, self.vertices[corners])
        normals = self._normals[found.face]
        height = np.zeros((len(xi), 1))
        for _ in range(_ROUNDS):
            q = feet + height * normals
            residual = self.problem.task.batched(q)[0] - self.level
            slope = (self.problem.task.batched_jacobian(q)[0].reshape(-1, 3) * normals).sum(axis=1, keepdims=True)
            height = height - residual / slope
            if np.abs(residual / slope).max(initial=0.0) < _ON_LEAF:
                break
        known = inside & (found.distance < _ON_LEAF)
        return np.where(known[:, None], feet + height * normals, np.nan)

    def to_arrays(self) -> Mapping[str, Array | Indices]:
        """All arrays, for chart files."""
        names = ("level", "region_centre", "region_half_width", "vertices", "faces", "disk")
        return {name: getattr(self, name) for name in names}

    @cached_property
    def _in_space(self) -> TriangleLocator:
        return TriangleLocator(self.vertices, self.faces)

    @cached_property
    def _in_disk(self) -> TriangleLocator:
        return TriangleLocator(self.disk, self.faces)

    @cached_property
    def _edges(self) -> tuple[Array, Array]:
        """Two edges of every triangle in space, (F, 2, 3), and in the disk, (F, 2, 2)."""
        first, *others = (self.faces[:, k] for k in range(3))
        in_space = np.stack([self.vertices[other] - self.vertices[first] for other in others], axis=1)
        in_disk = np.stack([self.disk[other] - self.disk[first] for other in others], axis=1)
        return in_space, in_disk

    @cached_property
    def _normals(self) -> Array:
        normals = np.cross(self._edges[0][:, 0], self._edges[0][:, 1])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    @cached_property
    def _gradients(self) -> Array:
        """Gradients G of the two coordinates on every triangle, (F, 2, 3): E G^T = edges in the disk, n G^T = 0."""
        in_space, in_disk = self._edges
        return np.asarray((np.linalg.pinv(in_space) @ in_disk).transpose(0, 2, 1))


def disk_leaf(problem: Problem, level: Array, region: Box, cells: int = CELLS) -> DiskLeaf:
    """Triangulate the part of a leaf inside a region, and map it onto the unit disk.

    Args:
        problem: a problem with n = 3 and m = 1.
        level: x0, (1,).
        region: box that bounds the charted part of the leaf.
        cells: number of cells along the longest edge of the region.

    Raises:
        GrowError: if n is not 3, m is not 1, or the shortest edge of the region has fewer than 5 cells.
        NotADiskError: if that part of the leaf is not a disk; the message says what it is.
    """
    if (problem.n, problem.m) != (3, 1):
        raise GrowError(
            f"the problem has n = {problem.n} and m = {problem.m}, expected n = 3 and m = 1 for a disk leaf"
        )
    low, high = region.centre - region.half_width, region.centre + region.half_width
    shortest = cells * float(region.half_width.min() / region.half_width.max())
    if shortest < _FEWEST_ACROSS:
        widths = (2 * region.half_width).round(4).tolist()
        raise GrowError(
            f"the region has edges {widths}, so {cells} cells along the longest give {shortest:.1f} along "
            f"the shortest, expected at least {_FEWEST_ACROSS}"
        )
    require_memory(f"a mesh with {cells} cells", 40.0 * cells**3)
    task = problem.task
    points = sample_uniform(region, _SCALE_SAMPLES, 0)
    scale = float(np.sqrt((task.batched_jacobian(points)[0] ** 2).sum(axis=(1, 2)).mean()))  # makes units irrelevant
    mesh = level_surface(
        lambda q: task.batched(q)[0][:, 0] / scale,
        lambda q: task.batched_jacobian(q)[0].reshape(-1, 3) / scale,
        float(level[0]) / scale,
        low,
        high,
        cells,
    )
    disk = harmonic_disk(mesh)
    return DiskLeaf(problem, level, region.centre, region.half_width, mesh.vertices, mesh.faces, disk)
