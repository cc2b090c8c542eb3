"""Tasks x = h(q): what the robot is to do, with m < n numbers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.user_expression import expression_of
from orthocas.checks import frozen_array, require_kind
from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.robots import Robot
from orthocas.showing import Shown, listed

TASK_KINDS = ("position", "position:AXES", "polar", "orientation", "pose")


@dataclass(frozen=True, eq=False, repr=False)
class Task(Shown):
    """A task map h of a robot. Use the class methods to build one."""

    robot: Robot
    name: str
    labels: tuple[str, ...]  #: names of the components of x
    function: ca.Function  #: q (n, 1) -> x (m, 1), dense, SX
    recipe: dict[str, Any]  #: plain data that `from_recipe` turns into the same task

    @classmethod
    def position(cls, robot: Robot, axes: str = "xyz") -> Self:
        """Position of the tip along some world axes [m], for example axes="xy"."""
        if not axes or len(set(axes)) != len(axes) or set(axes) - set("xyz"):
            raise InvalidValueError("axes", repr(axes), "different letters out of 'xyz'")
        rows = ["xyz".index(a) for a in axes]
        return cls._of_tip(robot, f"position:{axes}", tuple(axes), lambda R, p: p[rows])

    @classmethod
    def polar(cls, robot: Robot) -> Self:
        """Radius [m] and angle [rad] of the tip in the x-y plane: the same task as axes="xy" in other coordinates."""
        return cls._of_tip(
            robot,
            "polar",
            ("radius", "angle"),
            lambda R, p: ca.vertcat(ca.sqrt(p[0] ** 2 + p[1] ** 2), ca.atan2(p[1], p[0])),
        )

    @classmethod
    def orientation(cls, robot: Robot, reference: ArrayLike | None = None) -> Self:
        """Orientation of the tip, x = 2 sin(angle / 2) axis of the rotation from a reference to the tip, (3,).

        Near the reference x is the rotation vector [rad]; it is smooth except half a turn away.

        Args:
            robot: the robot.
            reference: reference rotation (3, 3) in the world, default the identity.
        """
        return cls._relative_to(robot, "orientation", reference)

    @classmethod
    def pose(cls, robot: Robot, reference: ArrayLike | None = None) -> Self:
        """Position [m] and orientation of the tip, (6,); see `position` and `orientation`."""
        return cls._relative_to(robot, "pose", reference)

    @classmethod
    def custom(
        cls, robot: Robot, name: str, function: Callable[[ca.SX], ca.SX] | ca.Function, labels: Sequence[str] = ()
    ) -> Self:
        """Any task of elementary operations that CasADi can express.

        Args:
            robot: the robot.
            name: a name for reports.
            function: maps an SX column q (n, 1) to x (m, 1).
            labels: names of the components.

        Raises:
            ShapeError: if x is not a column.
        """
        require_kind("robot", robot, Robot)
        q = ca.SX.sym("q", robot.n)
        x = expression_of(f"task '{name}'", function, q)
        if x.shape[1] != 1 or x.shape[0] == 0:
            raise ShapeError(f"task '{name}'", x.shape, (None, 1))
        labels = tuple(str(label) for label in labels) or tuple(f"{name}[{i}]" for i in range(x.shape[0]))
        if len(labels) != x.shape[0]:
            raise ShapeError("labels", (len(labels),), (x.shape[0],))
        h = dense_function("h", [q], [x])
        return cls(robot, str(name), labels, h, {"kind": "custom", "name": str(name), "labels": labels})

    @classmethod
    def named(cls, robot: Robot, kind: str, q_reference: ArrayLike | None = None) -> Self:
        """A task from its short name: position, position:xy, polar, orientation, pose.

        Args:
            robot: the robot.
            kind: the short name.
            q_reference: posture (n,) whose tip orientation is the reference of orientation and pose.
        """
        if kind == "position" or kind.startswith("position:"):
            return cls.position(robot, kind.partition(":")[2] or "xyz")
        if kind == "polar":
            return cls.polar(robot)
        if kind in ("orientation", "pose"):
            reference = None if q_reference is None else robot.tip_rotation(q_reference)
            return cls.pose(robot, reference) if kind == "pose" else cls.orientation(robot, reference)
        raise UnknownNameError("task", kind, TASK_KINDS)

    @property
    def m(self) -> int:
        """Number of task components."""
        return len(self.labels)

    def facts(self) -> dict[str, str]:
        """Name, components and robot."""
        return {"task": f"{self.name}, m = {self.m} ({listed(self.labels)})", "robot": self.robot.heading}

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """Q (n, 1) -> J_x = dh/dq (m, n), by automatic differentiation."""
        q = ca.SX.sym("q", self.robot.n)
        return dense_function("task_jacobian", [q], [ca.jacobian(self.function(q), q)])

    @cached_property
    def second_derivative_function(self) -> ca.Function:
        """Q, v, w (n, 1) -> d^2 h(q)[v, w] = (d/ds) J_x(q + s v) w, (m, 1)."""
        q, v, w = (ca.SX.sym(name, self.robot.n) for name in ("q", "v", "w"))
        second = ca.jtimes(ca.jtimes(self.function(q), q, w), q, v)
        return dense_function("task_second_derivative", [q, v, w], [second], ["q", "v", "w"])

    @cached_property
    def batched(self) -> Batched:
        """H at many points."""
        return Batched(self.function)

    @cached_property
    def batched_jacobian(self) -> Batched:
        """J_x at many points."""
        return Batched(self.jacobian_function)

    @classmethod
    def _relative_to(cls, robot: Robot, kind: str, reference: ArrayLike | None) -> Self:
        """Orientation or pose relative to a reference rotation."""
        base = frozen_array("reference", np.eye(3) if reference is None else reference, (3, 3))
        if not np.allclose(base @ base.T, np.eye(3), atol=1e-9) or np.linalg.det(base) < 0:
            raise InvalidValueError("reference", base.tolist(), "a rotation matrix")
        angles = ("rx", "ry", "rz")

        def components(R: ca.SX, p: ca.SX) -> ca.SX:
            turned = _half_angle_vector(ca.SX(ca.DM(base.T)) @ R)
            return ca.vertcat(p, turned) if kind == "pose" else turned

        labels = ("x", "y", "z", *angles) if kind == "pose" else angles
        return cls._of_tip(robot, kind, labels, components, {"reference": base.tolist()})

    @classmethod
    def _of_tip(
        cls,
        robot: Robot,
        name: str,
        labels: tuple[str, ...],
        components: Callable[[ca.SX, ca.SX], ca.SX],
        extra: dict[str, Any] | None = None,
    ) -> Self:
        """A task that is a function of the tip's rotation and position."""
        require_kind("robot", robot, Robot)
        q = ca.SX.sym("q", robot.n)
        x = components(robot.function("tip_rotation")(q), robot.function("tip_position")(q))
        return cls(robot, name, labels, dense_function("h", [q], [x]), {"kind": name, **(extra or {})})


def _half_angle_vector(R: ca.SX) -> ca.SX:
    """2 sin(angle / 2) axis of a rotation matrix, (3, 1): vee(R - R^T) / sqrt(1 + trace R)."""
    vee = ca.vertcat(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return vee / ca.sqrt(1 + ca.trace(R))
