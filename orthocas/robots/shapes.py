"""Solids in the frame of a body or of the world: boxes, cylinders, rounded hulls, half-spaces and point clouds."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

import coal
import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.tools.checks import Array, Flags, Indices


@dataclass(frozen=True, slots=True)
class ShapeRules:
    """Numbers of solids."""

    facets: int = 12  #: facets of the prism that bounds a cylinder
    flat: float = 1e-9  #: [m]; thinner point sets have no volume
    #: triangles of a plane face above which it is split differently: coal counts at most 255 neighbours of a corner
    fan: int = 60


RULES = ShapeRules()


class Geometry(Protocol):
    """The geometry of a solid in its own frame."""

    reported_first: bool = False  #: whether coal always reports it as the first of a pair
    knows_clouds: bool = True  #: whether coal can measure its distance from point clouds

    def build(self) -> Any:
        """The coal geometry."""
        ...

    def list_corners(self) -> tuple[Array, float]:
        """Points (K, 3) and a radius: the solid is within the convex hull of balls of this radius at the points."""
        ...

    def contains(self, points: Array) -> Flags:
        """Whether points (N, 3) in its own frame belong to it, (N,)."""
        ...


@dataclass(frozen=True, eq=False)
class BoxGeometry(Geometry):
    """A box with its centre at the origin."""

    size: Array  #: (3,) edge lengths [m]

    def build(self) -> Any:
        """The box."""
        return coal.Box(*self.size)

    def list_corners(self) -> tuple[Array, float]:
        """Its corners."""
        signs = np.array(np.meshgrid(*3 * [[-0.5, 0.5]])).reshape(3, -1).T
        return signs * self.size, 0.0

    def contains(self, points: Array) -> Flags:
        """Whether points lie between all faces."""
        return np.asarray((np.abs(points) <= self.size / 2).all(axis=1))


@dataclass(frozen=True, eq=False)
class CylinderGeometry(Geometry):
    """A cylinder along z with its centre at the origin."""

    radius: float
    length: float

    def build(self) -> Any:
        """The cylinder."""
        return coal.Cylinder(self.radius, self.length)

    def list_corners(self) -> tuple[Array, float]:
        """The corners of a prism around it."""
        angles = 2 * np.pi * np.arange(RULES.facets) / RULES.facets
        ring = self.radius / np.cos(np.pi / RULES.facets) * np.column_stack([np.cos(angles), np.sin(angles)])
        ends = [np.column_stack([ring, np.full(len(ring), z)]) for z in (-self.length / 2, self.length / 2)]
        return np.concatenate(ends), 0.0

    def contains(self, points: Array) -> Flags:
        """Whether points lie within radius and length."""
        return np.asarray(
            (np.hypot(points[:, 0], points[:, 1]) <= self.radius) & (np.abs(points[:, 2]) <= self.length / 2)
        )


@dataclass(frozen=True, eq=False)
class EllipsoidGeometry(Geometry):
    """An ellipsoid with its centre at the origin and its axes along those of the frame."""

    radii: Array  #: (3,) [m]
    knows_clouds = False

    def build(self) -> Any:
        """The ellipsoid."""
        return coal.Ellipsoid(*self.radii)

    def list_corners(self) -> tuple[Array, float]:
        """The corners of its bounding box."""
        return BoxGeometry(2 * self.radii).list_corners()

    def contains(self, points: Array) -> Flags:
        """Whether points lie within the unit ball after division by the radii."""
        return np.asarray(np.linalg.norm(points / self.radii, axis=1) <= 1)


@dataclass(frozen=True, eq=False)
class BallGeometry(Geometry):
    """A ball about the origin."""

    radius: float

    def build(self) -> Any:
        """The ball as a capsule of zero length, because depths of coal's spheres in cylinders are wrong."""
        return coal.Capsule(self.radius, 0.0)

    def list_corners(self) -> tuple[Array, float]:
        """Its centre."""
        return np.zeros((1, 3)), self.radius

    def contains(self, points: Array) -> Flags:
        """Whether points lie within the radius."""
        return np.asarray(np.linalg.norm(points, axis=1) <= self.radius)


@dataclass(frozen=True, eq=False)
class CapsuleGeometry(Geometry):
    """All points within a radius of a segment along z with its centre at the origin."""

    radius: float
    length: float  #: of the segment [m]

    def build(self) -> Any:
        """The capsule."""
        return coal.Capsule(self.radius, self.length)

    def list_corners(self) -> tuple[Array, float]:
        """The ends of the segment."""
        return np.array([[0.0, 0.0, -self.length / 2], [0.0, 0.0, self.length / 2]]), self.radius

    def contains(self, points: Array) -> Flags:
        """Whether points lie within the radius of the segment."""
        beyond = points[:, 2] - np.clip(points[:, 2], -self.length / 2, self.length / 2)
        return np.asarray(np.linalg.norm(np.column_stack([points[:, :2], beyond]), axis=1) <= self.radius)


@dataclass(frozen=True, eq=False)
class HullGeometry(Geometry):
    """The convex hull of points."""

    points: Array  #: (K, 3), all of them corners [m]
    faces: Array  #: (F, 3) triangles

    @classmethod
    def around(cls, points: Array) -> Self:
        """The hull of points (N, 3).

        Raises:
            ValueError: if they span no volume.
        """
        centred = points - points.mean(axis=0)
        if len(points) < 4 or np.linalg.svd(centred, compute_uv=False)[-1] < RULES.flat:
            raise ValueError("the points span no volume")
        hull = scipy.spatial.ConvexHull(points)
        places = np.zeros(len(points), dtype=np.intp)
        places[hull.vertices] = np.arange(len(hull.vertices))
        corners, faces = points[hull.vertices], places[hull.simplices]
        # Qhull divides a plane face into a fan from one corner, which then has hundreds of neighbours. Repeated halving
        # gives few.
        _, owners, counts = np.unique(hull.equations, axis=0, return_inverse=True, return_counts=True)
        for face in np.flatnonzero(counts > RULES.fan):
            own = owners.ravel() == face
            # Sort the corners of the face along its boundary, by their angles in the plane of the face.
            ring, normal = np.unique(faces[own]), hull.equations[own][0, :3]
            u, v = ((corners[ring] - corners[ring].mean(axis=0)) @ scipy.linalg.null_space(normal[None])).T
            ring = ring[np.argsort(np.arctan2(v, u))]
            faces = np.concatenate([faces[~own], _halve(ring)])
            owners = np.concatenate([owners.ravel()[~own], np.full(len(ring) - 2, face)])
        return cls(corners, faces)

    def build(self) -> Any:
        """The hull."""
        points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        for point in self.points:
            points.append(point)
        for face in self.faces.tolist():
            triangles.append(coal.Triangle(*face))
        return coal.Convex(points, triangles)

    def list_corners(self) -> tuple[Array, float]:
        """Its corners."""
        return self.points, 0.0

    def contains(self, points: Array) -> Flags:
        """Whether points are on the inner side of all faces."""
        corners = self.points[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        offsets = np.einsum("fi,fi->f", normals, corners[:, 0])
        outwards = np.sign(offsets - normals @ self.points.mean(axis=0))
        return np.asarray((outwards * (points @ normals.T - offsets) <= 0).all(axis=1))


def _halve(ring: NDArray[np.intp]) -> NDArray[np.intp]:
    """Cut a convex polygon (K,) into triangles (K - 2, 3) by halving: a corner is in at most 4 log2 K of them."""
    if len(ring) == 3:
        return ring[None]
    middle = len(ring) // 2
    first, second = ring[: middle + 1], np.append(ring[middle:], ring[0])
    return np.concatenate([_halve(part) for part in (first, second) if len(part) > 2])


@dataclass(frozen=True, eq=False)
class HalfSpaceGeometry(Geometry):
    """All points below the plane z = 0."""

    def build(self) -> Any:
        """The half-space."""
        return coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)

    def list_corners(self) -> tuple[Array, float]:
        """No points: it is infinite."""
        return np.zeros((0, 3)), 0.0

    def contains(self, points: Array) -> Flags:
        """Whether points are below the plane."""
        return np.asarray(points[:, 2] <= 0)


@dataclass(frozen=True, eq=False)
class CloudGeometry(Geometry):
    """The cubes of a regular grid that contain a point of a cloud."""

    points: Array  #: (N, 3) [m]
    cell: float  #: edge length of the cubes [m]
    reported_first = True

    def build(self) -> Any:
        """The octree."""
        return coal.makeOctree(self.points, self.cell)

    def list_corners(self) -> tuple[Array, float]:
        """The points, with the diagonal of a cube as radius."""
        return self.points, float(np.sqrt(3) * self.cell)

    def contains(self, points: Array) -> Flags:
        """Whether points lie in a cube that holds a point of the cloud."""
        cells = {tuple(cell) for cell in np.floor(self.points / self.cell).astype(int).tolist()}
        return np.array(
            [tuple(cell) in cells for cell in np.floor(points / self.cell).astype(int).tolist()], dtype=bool
        )


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid placed in the frame of a body or of the world."""

    geometry: Geometry
    rotation: Array  #: (3, 3)
    translation: Array  #: (3,) [m]

    def move(self, rotation: Array, translation: Array) -> "Shape":
        """The solid turned by a rotation (3, 3), then shifted by a translation (3,)."""
        return replace(self, rotation=rotation @ self.rotation, translation=rotation @ self.translation + translation)

    def contains(self, points: Array) -> Flags:
        """Whether points (N, 3) belong to it, (N,)."""
        return self.geometry.contains((points - self.translation) @ self.rotation)

    def list_box(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates of a box around it in the frame of the body, (3,) each."""
        corners, rounding = self.list_corners()
        return corners.min(axis=0) - rounding, corners.max(axis=0) + rounding

    def list_corners(self) -> tuple[Array, float]:
        """Corners as in `Geometry.list_corners`, in the frame of the body."""
        corners, rounding = self.geometry.list_corners()
        return corners @ self.rotation.T + self.translation, rounding

    @property
    def bounded(self) -> bool:
        """Whether it is bounded."""
        return len(self.geometry.list_corners()[0]) > 0

    def bound_by_ball(self) -> tuple[Array, float]:
        """Centre (3,) and radius of a ball that contains it; a point of its surface and 0 for half-spaces."""
        corners, rounding = self.list_corners()
        if not len(corners):
            return self.translation, 0.0
        centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        return centre, float(np.linalg.norm(corners - centre, axis=1).max()) + rounding

    def bound(self) -> tuple[Array, Array, float]:
        """Both ends (3,) and the radius of a capsule that contains it; a point of its surface and 0 for half-spaces.

        Among axes along the principal axes of the corners, it takes the one with the smallest capsule.
        """
        corners, rounding = self.geometry.list_corners()
        if not len(corners):
            return self.translation, self.translation, 0.0
        corners = corners @ self.rotation.T + self.translation
        centre = corners.mean(axis=0)
        best: tuple[float, Array, Array, float] | None = None
        for axis in np.linalg.svd(corners - centre)[2] if len(corners) > 1 else np.eye(3)[:1]:
            # Centre of the corners across the axis, and their distances from a line through this centre.
            across = corners - np.outer(corners @ axis, axis)
            middle = (across.min(axis=0) + across.max(axis=0)) / 2
            middle = middle - (middle @ axis) * axis
            away = np.linalg.norm(across - middle, axis=1)
            radius = float(away.max())
            # The segment from low to high has every corner within the radius.
            depth, along = np.sqrt(np.maximum(radius**2 - away**2, 0.0)), corners @ axis
            low, high = float((along + depth).min()), float((along - depth).max())
            low, high = (low, high) if low < high else ((low + high) / 2, (low + high) / 2)
            reach = radius + rounding
            volume = np.pi * reach**2 * (high - low + 4 / 3 * reach)
            if best is None or volume < best[0]:
                best = volume, middle + low * axis, middle + high * axis, reach
        assert best is not None
        return best[1], best[2], best[3] * (1 + 1e-12)


def read_mesh(file: Path, scale: Array) -> tuple[Array, Indices]:
    """Vertices (V, 3) [m] and triangles (F, 3) of a mesh file, scaled.

    Raises:
        ValueError: if it cannot be read, has no triangle, or a vertex is not finite.
    """
    try:
        mesh: Any = coal.MeshLoader().load(str(file), scale)
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    # coal's arrays are views of the mesh and become invalid with it.
    vertices = np.array(mesh.vertices(), dtype=float).reshape(-1, 3)
    faces = np.array([[t[0], t[1], t[2]] for t in map(mesh.tri_indices, range(mesh.num_tris))], dtype=np.intp)
    if not (len(faces) and np.isfinite(vertices).all()):
        raise ValueError("empty")
    return vertices, faces
