"""Scenes of named solids around a robot, and the solids, which links may also carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, RobotError, one_line
from orthocas.robots.shapes import (
    BallGeometry,
    BoxGeometry,
    CapsuleGeometry,
    CloudGeometry,
    HalfSpaceGeometry,
    HullGeometry,
    Shape,
    read_mesh,
)
from orthocas.robots.spatial import rotate_z_to, rotation_matrix
from orthocas.tools.checks import Array, as_number, as_path, freeze_array, require_kind, require_text
from orthocas.tools.display import Shown, listed

__all__ = ["Box", "Capsule", "Mesh", "Plane", "PointCloud", "Sphere"]


@dataclass(frozen=True, slots=True)
class ObstacleRules:
    """Numbers of obstacles."""

    farthest: float = 1e6  #: [m] largest length
    cells: int = 30_000  #: largest number of cells of a point cloud along an axis, a limit of octrees


RULES = ObstacleRules()


def __getattr__(name: str) -> Any:
    """Explain a name that was removed."""
    if name in ("LinkDistances", "Obstacle"):
        now = "robot.with_rods(radius).collisions.with_scene(oc.Scene({name: solid})) has these distances"
        raise AttributeError(f"orthocas.obstacles has no {name}: {now}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@runtime_checkable
class Solid(Protocol):
    """A solid, placed in the world or in the frame that carries it."""

    @property
    def heading(self) -> str:
        """The solid in a few words."""
        ...

    @property
    def shape(self) -> Shape:
        """The solid for collision checks."""
        ...


class Scene(Shown):
    """Solids around a robot, by name, in the frame of the world; see `Collisions.with_scene`.

    Args:
        solids: boxes, spheres, capsules, planes, meshes and point clouds of `orthocas.obstacles`, by name.

    Example:
        >>> import orthocas as oc
        >>> table = oc.obstacles.Box([0.6, 1.0, 0.02], [0.5, 0.0, 0.2])
        >>> scene = oc.Scene({"table": table, "post": oc.obstacles.Capsule([0.4, 0.3, 0.2], [0.4, 0.3, 0.9], 0.03)})
        >>> scene.names
        ('table', 'post')
    """

    def __init__(self, solids: Mapping[str, Solid]) -> None:
        require_kind("solids", solids, Mapping)
        for name, solid in solids.items():
            require_text("name of a solid", name)
            if isinstance(solid, type) or not isinstance(solid, Solid):
                raise InvalidValueError(f"solid '{name}'", f"a {type(solid).__name__}", "one of orthocas.obstacles")
        self.solids = MappingProxyType(dict(solids))

    def __reduce__(self) -> tuple[Any, ...]:
        return Scene, (dict(self.solids),)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the solids."""
        return tuple(self.solids)

    def facts(self) -> dict[str, str]:
        """The solids."""
        return {"scene": f"{len(self.solids)} solids: {listed(self.solids)}"} | {
            name: solid.heading for name, solid in self.solids.items()
        }


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball.

    Args:
        centre: (3,) in the world [m].
        radius: > 0 [m].

    Example:
        >>> import orthocas as oc
        >>> oc.obstacles.Sphere([0.5, 0.0, 0.3], 0.1).heading
        'sphere of radius 0.1 at (0.5, 0, 0.3)'
    """

    centre: Array
    radius: float

    def __init__(self, centre: ArrayLike, radius: float) -> None:
        object.__setattr__(self, "centre", freeze_array("centre", centre, (3,)))
        object.__setattr__(self, "radius", _check_size("radius", radius))

    @property
    def heading(self) -> str:
        """One line: radius [m] and centre [m] in the base frame."""
        return f"sphere of radius {self.radius:.4g} at {_print_point(self.centre)}"

    @property
    def shape(self) -> Shape:
        """The ball for collision checks."""
        return Shape(BallGeometry(self.radius), np.eye(3), self.centre)


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius of a segment.

    Args:
        start: one end of the segment, (3,) in the world [m].
        end: the other end of the segment.
        radius: > 0 [m].
    """

    start: Array
    end: Array
    radius: float

    def __init__(self, start: ArrayLike, end: ArrayLike, radius: float) -> None:
        object.__setattr__(self, "start", freeze_array("start", start, (3,)))
        object.__setattr__(self, "end", freeze_array("end", end, (3,)))
        object.__setattr__(self, "radius", _check_size("radius", radius))

    @property
    def heading(self) -> str:
        """One line: radius [m] and the ends of the axis [m] in the base frame."""
        return f"capsule of radius {self.radius:.4g} from {_print_point(self.start)} to {_print_point(self.end)}"

    @property
    def shape(self) -> Shape:
        """The capsule for collision checks."""
        length = float(np.linalg.norm(self.end - self.start))
        rotation = rotate_z_to((self.end - self.start) / length) if length > 0 else np.eye(3)
        return Shape(CapsuleGeometry(self.radius, length), rotation, (self.start + self.end) / 2)


@dataclass(frozen=True, eq=False)
class Plane:
    """A half-space: a floor, a wall, a table. The robot is on the side to which the normal points.

    Args:
        normal: (3,) in the world, of any length > 0.
        point: any point of the surface, (3,) [m].
    """

    normal: Array
    point: Array

    def __init__(self, normal: ArrayLike, point: ArrayLike) -> None:
        direction = freeze_array("normal", normal, (3,))
        length = float(np.linalg.norm(direction))
        if not 1e-9 < length < np.inf:
            raise InvalidValueError("normal", direction.tolist(), "a vector longer than 1e-9")
        object.__setattr__(self, "normal", freeze_array("normal", direction / length, (3,)))
        object.__setattr__(self, "point", freeze_array("point", point, (3,)))

    @property
    def heading(self) -> str:
        """One line: a point [m] and the unit normal in the base frame."""
        return f"plane through {_print_point(self.point)} with normal {_print_point(self.normal)}"

    @property
    def shape(self) -> Shape:
        """The half-space for collision checks."""
        return Shape(HalfSpaceGeometry(), rotate_z_to(self.normal), self.point)


@dataclass(frozen=True, eq=False)
class Box:
    """A box.

    Args:
        size: edge lengths (3,) [m], > 0.
        centre: (3,) in the world [m].
        rotation: (3, 3), from the axes of the box to those of the world.
    """

    size: Array
    centre: Array
    rotation: Array

    def __init__(self, size: ArrayLike, centre: ArrayLike, rotation: ArrayLike | None = None) -> None:
        edges = freeze_array("size", size, (3,))
        for edge in edges.tolist():
            _check_size("size", edge)
        object.__setattr__(self, "size", edges)
        object.__setattr__(self, "centre", freeze_array("centre", centre, (3,)))
        turn = np.eye(3) if rotation is None else rotation
        object.__setattr__(self, "rotation", rotation_matrix("rotation", turn))

    @property
    def heading(self) -> str:
        """One line: size and centre [m]."""
        return f"box of {' x '.join(f'{edge:.4g}' for edge in self.size)} at {_print_point(self.centre)}"

    @property
    def shape(self) -> Shape:
        """The box for collision checks."""
        return Shape(BoxGeometry(self.size), self.rotation, self.centre)


@dataclass(frozen=True, eq=False)
class Mesh:
    """The convex hull of points, or of a mesh file.

    Args:
        points: (N, 3) in the frame of the mesh [m], or the path of a mesh file (STL, OBJ, DAE).
        position: origin of the mesh in the world, (3,) [m].
        rotation: (3, 3), from the axes of the mesh to those of the world.
        scale: factor of the points.

    Raises:
        RobotError: if the file cannot be read.
        InvalidValueError: if the points span no volume.
    """

    points: Array
    position: Array
    rotation: Array

    def __init__(
        self,
        points: ArrayLike | str | PathLike[str],
        position: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        scale: float = 1.0,
    ) -> None:
        factor = _check_size("scale", scale)
        # Corners come from a file, or are given.
        if isinstance(points, str | PathLike):
            path = as_path("points", points)
            if not path.is_file():
                raise RobotError(f"cannot read mesh file {path}: no such file")
            try:
                corners = read_mesh(path, np.full(3, factor))[0]
            except ValueError as error:
                raise RobotError(f"cannot read mesh file {path}: {one_line(str(error))}") from None
        else:
            corners = factor * freeze_array("points", points, (None, 3))
        try:
            hull = HullGeometry.around(corners)
        except ValueError as error:
            raise InvalidValueError("points", str(error), "points that span a volume") from None
        object.__setattr__(self, "points", freeze_array("points", hull.points, (None, 3)))
        object.__setattr__(self, "position", freeze_array("position", position, (3,)))
        turn = np.eye(3) if rotation is None else rotation
        object.__setattr__(self, "rotation", rotation_matrix("rotation", turn))

    @property
    def heading(self) -> str:
        """One line: number of corners and position [m]."""
        return f"hull of {len(self.points)} corners at {_print_point(self.position)}"

    @property
    def shape(self) -> Shape:
        """The hull for collision checks."""
        return Shape(HullGeometry.around(self.points), self.rotation, self.position)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of a camera or a scanner; solid are the cubes of a grid that contain at least one point.

    Args:
        points: (N, 3) in the world [m].
        cell: edge length of the cubes [m].
    """

    points: Array
    cell: float

    def __init__(self, points: ArrayLike, cell: float = 0.02) -> None:
        object.__setattr__(self, "points", freeze_array("points", points, (None, 3)))
        if not len(self.points):
            raise InvalidValueError("points", "no points", "at least one")
        object.__setattr__(self, "cell", _check_size("cell", cell))
        spread = float(np.ptp(self.points, axis=0).max() / self.cell)
        if spread > RULES.cells:
            raise InvalidValueError("cell", cell, f"at least 1/{RULES.cells} of the extent of the points")

    @property
    def heading(self) -> str:
        """One line: number of points, and cell [m]."""
        return f"cloud of {len(self.points)} points, in cubes of {self.cell:.4g}"

    @property
    def shape(self) -> Shape:
        """The cubes as an octree for collision checks."""
        return Shape(CloudGeometry(self.points, self.cell), np.eye(3), np.zeros(3))


def _check_size(name: str, value: float) -> float:
    size = as_number(name, value)
    if not 0 < size < RULES.farthest:
        raise InvalidValueError(name, value, "a length above 0 [m], at most 1e6")
    return size


def _print_point(point: Array) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"
