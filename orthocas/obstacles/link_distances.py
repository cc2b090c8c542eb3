"""Distances of a robot's links from obstacles: links are capsules between the origins of neighbouring joints (ours)."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array, as_float_array, as_point_set, require_kind
from orthocas.errors import InvalidValueError
from orthocas.obstacles.shapes import Obstacle
from orthocas.robots import Robot
from orthocas.robots.kinematics import joint_points

_FARTHEST = 1e6  # [m]
_POSTURES, _MOVES = 20, 1e-9  # postures that tell which links move, and how far they do [m]


@dataclass(frozen=True, eq=False)
class LinkDistances:
    """Distances of the links on the way to the tip from obstacles, as functions of q.

    A link is a capsule from the origin of its joint to that of the next joint, or to the tip; the true shape of links
    is not known. Links that no joint moves are left out.

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
        given = as_float_array("radius", radius)
        if given.shape not in ((), (robot.n,)):
            raise InvalidValueError("radius", f"an array of shape {given.shape}", f"one number, or {robot.n}")
        radii = np.broadcast_to(given, (robot.n,))
        if not ((radii >= 0) & (radii < _FARTHEST)).all():
            raise InvalidValueError("radius", given.tolist(), "lengths >= 0 [m]")
        object.__setattr__(self, "robot", robot)
        object.__setattr__(self, "obstacles", tuple(obstacles))
        object.__setattr__(self, "radii", tuple(radii.tolist()))

    def __call__(self, q: ArrayLike) -> Array:
        """Distances [m] at q (n,) or (N, n), (K,) or (N, K): for each link, those from all obstacles."""
        points, single = as_point_set("q", q, self.robot.n)
        values: Array = self._batched(points)[0]
        return values[0] if single else values

    def with_gradients(self, points: Array) -> tuple[Array, Array]:
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
        """Joint, and both ends of its link, for links that move."""
        tree = self.robot.tree
        points = joint_points(tree, self._q)
        seen = self.robot.joint_points(np.random.default_rng(0).uniform(-1, 1, (_POSTURES, tree.n)))
        moves = np.ptp(seen, axis=0).max(axis=1) > _MOVES
        chain: list[int] = []
        i = tree.tip_parent
        while i >= 0:
            chain.insert(0, i)
            i = tree.parents[i]
        joints = [chain[0] if chain else 0, *chain]
        moving = np.flatnonzero(moves[:-1] | moves[1:])
        return [(joints[k], points[:, int(k)], points[:, int(k) + 1]) for k in moving]

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
