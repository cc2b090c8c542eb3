"""Obstacles: solids of scenes, and distances of spheres, capsules and half-spaces to a robot's links as expressions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, RobotError, one_line
from orthocas.robots.kinematics import build_body_poses, build_frame_pose
from orthocas.robots.link_shapes import read_mesh
from orthocas.robots.robot import Robot
from orthocas.robots.scene import Solid
from orthocas.robots.shapes import (
    BallGeometry,
    BoxGeometry,
    CapsuleGeometry,
    CloudGeometry,
    HalfSpaceGeometry,
    HullGeometry,
    Shape,
)
from orthocas.robots.spatial import rotate_z_to, rotation_matrix
from orthocas.robots.tree import BASE_JOINTS
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, as_number, as_path, as_point_set, freeze_array, require_kind

__all__ = ["Box", "Capsule", "LinkDistances", "Mesh", "Obstacle", "Plane", "PointCloud", "Sphere"]


@dataclass(frozen=True, slots=True)
class ObstacleRules:
    """Numbers of obstacles and links."""

    least_square: float = 1e-18  #: [m^2], keeps square roots differentiable
    farthest: float = 1e6  #: [m] largest length
    postures: int = 20  #: by which moving links are found
    move: float = 1e-9  #: [m] of a link that moves
    cells: int = 30_000  #: of a point cloud along an axis, which an octree can have


RULES = ObstacleRules()


@runtime_checkable
class Obstacle(Solid, Protocol):
    """A solid in the world whose distance is an expression."""

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of the segment between two points (3, 1) from the solid [m], a scalar; negative inside it."""
        ...


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

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of a segment from the ball."""
        return ca.sqrt(_measure_point(ca.SX(ca.DM(self.centre)), start, end) + RULES.least_square) - self.radius


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius of a segment.

    Args:
        start: one end of the segment, (3,) in the world [m].
        end: the other end.
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

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of a segment from the capsule."""
        a, b = ca.SX(ca.DM(self.start)), ca.SX(ca.DM(self.end))
        return ca.sqrt(_measure_segment(start, end, a, b) + RULES.least_square) - self.radius


@dataclass(frozen=True, eq=False)
class Plane:
    """A half-space: a floor, a wall, a table. The robot is on the side to which the normal points.

    Args:
        normal: (3,) in the world, of any length > 0.
        point: a point of the surface, (3,) [m].
    """

    normal: Array
    point: Array

    def __init__(self, normal: ArrayLike, point: ArrayLike) -> None:
        direction = freeze_array("normal", normal, (3,))
        length = float(np.linalg.norm(direction))
        if not 1e-9 < length < np.inf:
            raise InvalidValueError("normal", direction.tolist(), "a direction, of a length above 1e-9")
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

    def distance(self, start: ca.SX, end: ca.SX) -> ca.SX:
        """Distance of a segment from the half-space: that of its nearer end."""
        normal, offset = ca.SX(ca.DM(self.normal)), float(self.normal @ self.point)
        return ca.fmin(ca.dot(normal, start), ca.dot(normal, end)) - offset


@dataclass(frozen=True, eq=False)
class Box:
    """A box.

    Args:
        size: edge lengths (3,) [m], > 0.
        centre: (3,) in the world [m].
        rotation: (3, 3), from the axes of its edges to those of the world.
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
        position: of the mesh in the world, (3,) [m].
        rotation: (3, 3), from the axes of the mesh to those of the world.
        scale: by which the points are multiplied.

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
        if isinstance(points, str | PathLike):
            path = as_path("points", points)
            if not path.is_file():
                raise RobotError(f"cannot read mesh file {path}: there is none")
            try:
                corners = read_mesh(path, np.full(3, factor))[0]
            except ValueError as error:
                raise RobotError(f"cannot read mesh file {path}: {one_line(str(error))}") from None
        else:
            corners = factor * freeze_array("points", points, (None, 3))
        try:
            hull = HullGeometry.around(corners)
        except ValueError as error:
            raise InvalidValueError("points", str(error), "corners of a solid") from None
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
    """Points of a camera or a scanner: the cubes of a lattice that hold one.

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
        """The cubes for collision checks."""
        return Shape(CloudGeometry(self.points, self.cell), np.eye(3), np.zeros(3))


def _measure_point(point: ca.SX, start: ca.SX, end: ca.SX) -> ca.SX:
    """Squared distance of a point from a segment, which may have no length."""
    along = end - start
    fraction = _clip(ca.dot(point - start, along) / (ca.dot(along, along) + RULES.least_square))
    gap = point - start - fraction * along
    return ca.dot(gap, gap)


def _measure_segment(a0: ca.SX, a1: ca.SX, b0: ca.SX, b1: ca.SX) -> ca.SX:
    """Squared distance of two segments: the least of five candidates, of which one has an end or none at its place."""
    a, b, between = a1 - a0, b1 - b0, a0 - b0
    aa, ab, bb = ca.dot(a, a), ca.dot(a, b), ca.dot(b, b)
    fraction = _clip((ab * ca.dot(b, between) - bb * ca.dot(a, between)) / (aa * bb - ab**2 + RULES.least_square))
    squares = [_measure_point(a0 + fraction * a, b0, b1)]
    squares += [_measure_point(point, b0, b1) for point in (a0, a1)]
    squares += [_measure_point(point, a0, a1) for point in (b0, b1)]
    least = squares[0]
    for square in squares[1:]:
        least = ca.fmin(least, square)
    return least


def _clip(fraction: ca.SX) -> ca.SX:
    return ca.fmin(ca.fmax(fraction, 0), 1)


def _check_size(name: str, value: float) -> float:
    size = as_number(name, value)
    if not 0 < size < RULES.farthest:
        raise InvalidValueError(name, value, "a length above 0 [m], at most 1e6")
    return size


def _print_point(point: Array) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"


@dataclass(frozen=True, eq=False)
class LinkDistances:
    """Distances of the links on the ways to the tips from obstacles, as functions of q.

    A link is a capsule from the origin of its joint to that of the next joint, or to a tip; the true shape of links
    is not known. Links that no joint moves are left out, and a link on the ways to several tips counts once.

    Args:
        robot: the robot.
        obstacles: the obstacles.
        radius: of the capsules: one for all, or one for each joint of the robot, (n,), >= 0 [m].

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[1.0, 1.0])
        >>> ball = oc.obstacles.Sphere([0.5, 1.0, 0.0], 0.2)
        >>> distances = oc.obstacles.LinkDistances(robot, [ball], 0.1)
        >>> distances.pairs
        ("link of joint 'q1' and obstacle 0", "link of joint 'q2' and obstacle 0")
        >>> distances([0.0, 0.0]).round(3).tolist()  # the arm is stretched along x
        [0.7, 0.818]
    """

    robot: Robot
    obstacles: tuple[Obstacle, ...]
    radii: tuple[float, ...]

    def __init__(self, robot: Robot, obstacles: Sequence[Obstacle], radius: ArrayLike = 0.0) -> None:
        require_kind("robot", robot, Robot)
        require_kind("obstacles", obstacles, Sequence)
        for k, obstacle in enumerate(obstacles):
            if isinstance(obstacle, type) or not isinstance(obstacle, Obstacle):
                raise InvalidValueError(f"obstacles[{k}]", f"a {type(obstacle).__name__}", "a Sphere, Capsule or Plane")
        # One radius for all links, or one for each.
        sizes = as_float_array("radius", radius)
        if sizes.shape not in ((), (robot.n,)):
            raise InvalidValueError("radius", f"an array of shape {sizes.shape}", f"one number, or {robot.n}")
        radii = np.broadcast_to(sizes, (robot.n,))
        if not ((radii >= 0) & (radii < RULES.farthest)).all():
            raise InvalidValueError("radius", sizes.tolist(), "lengths >= 0 [m]")
        object.__setattr__(self, "robot", robot)
        object.__setattr__(self, "obstacles", tuple(obstacles))
        object.__setattr__(self, "radii", tuple(radii.tolist()))

    def __call__(self, q: ArrayLike) -> Array:
        """Distances [m] at q (n,) or (N, n), (K,) or (N, K): for each link, those from all obstacles."""
        points, single = as_point_set("q", q, self.robot.n)
        values: Array = self._batched(points)[0]
        return values[0] if single else values

    def evaluate_gradients(self, points: Array) -> tuple[Array, Array]:
        """Distances (N, K) and their gradients (N, K, n) at points (N, n)."""
        values, gradients = self._batched_gradients(points)
        return values, gradients.reshape(len(points), -1, self.robot.n)

    @cached_property
    def pairs(self) -> tuple[str, ...]:
        """Which link and obstacle each distance belongs to, (K,)."""
        return tuple(
            f"link of joint '{self.robot.joint_names[joint]}' and obstacle {k}"
            for joint, _, _ in self._links
            for k in range(len(self.obstacles))
        )

    @cached_property
    def function(self) -> ca.Function:
        """q (n, 1) -> distances (K, 1)."""
        return dense_function("distances", [self._q], [self._expression])

    @cached_property
    def _q(self) -> ca.SX:
        return ca.SX.sym("q", self.robot.n)

    @cached_property
    def _links(self) -> list[tuple[int, ca.SX, ca.SX]]:
        """Joint, and both ends of its link, for links that move: those on the ways to all tips, each once."""
        tree = self.robot.tree
        ends: dict[tuple[int, int | str], tuple[int, ca.SX, ca.SX]] = {}
        origins = {-1: ca.SX.zeros(3), **{body: pose[1] for body, pose in enumerate(build_body_poses(tree, self._q))}}
        for frame in (tree.tip, *map(tree.frame, tree.tips)):
            way = tree.carriers(frame.parent)
            for start, end in pairwise([-1, *way]):
                # Nothing solid joins the world and a base that moves.
                if tree.joint_names[end] not in BASE_JOINTS:
                    ends[start, end] = max(start, way[0]), origins[start], origins[end]
            ends[frame.parent, frame.name] = (
                frame.parent,
                origins[frame.parent],
                build_frame_pose(tree, self._q, frame)[1],
            )
        links = list(ends.values())
        points = Batched(dense_function("ends", [self._q], [ca.vertcat(*(ca.vertcat(*link[1:]) for link in links))]))
        # Links that do not move between seeded postures stand still.
        postures = np.random.default_rng(0).uniform(-1, 1, (RULES.postures, tree.n))
        places = points(postures)[0].reshape(RULES.postures, -1, 6)
        moves = np.ptp(places, axis=0).max(axis=1) > RULES.move
        return [link for link, moving in zip(links, moves, strict=True) if moving]

    @cached_property
    def _expression(self) -> ca.SX:
        distances = [
            obstacle.distance(start, end) - self.radii[joint]
            for joint, start, end in self._links
            for obstacle in self.obstacles
        ]
        return ca.vertcat(*distances) if distances else ca.SX(0, 1)

    @cached_property
    def _batched(self) -> Batched:
        return Batched(self.function)

    @cached_property
    def _batched_gradients(self) -> Batched:
        both = ca.cse([self._expression, ca.densify(ca.jacobian(self._expression, self._q))])
        return Batched(dense_function("distances", [self._q], both))
