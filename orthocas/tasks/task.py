"""Tasks x = h(q): m < n numbers that describe what the robot does."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.robots.kinematics import TipTurn, frame_along
from orthocas.robots.robot import Robot
from orthocas.robots.spatial import quaternion_of, quaternion_product, rotation_matrix, rotations_of, skew
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_point_set,
    require_finite,
    require_kind,
    require_shape,
    require_text,
)
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.display import Shown, listed
from orthocas.tools.expressions import HoldsFunctions, expression_of

TASK_KINDS = (
    "position",
    "position:AXES",
    "polar",
    "orientation",
    "orientation:AXIS",
    "pose",
    "pose:AXIS",
    "axis",
    "axis:AXIS",
    "position+axis",
    "position+axis:AXIS",
)


@dataclass(frozen=True, eq=False, repr=False)
class Task(Shown, HoldsFunctions):
    """The task map h of a robot. Use the class methods to build one.

    Orientation, pose and axis tasks compare the tip with a reference orientation. If none is given, `Problem` uses the
    tip's orientation at the centre of its domain, and the task itself uses that in the middle of the joint limits.
    """

    robot: Robot
    name: str
    labels: tuple[str, ...]  #: names of the components of x
    units: tuple[str, ...]  #: units of the components: "m", "rad", or "" if unknown
    function: ca.Function  #: q (n, 1) -> x (m, 1), dense, SX
    recipe: dict[str, Any]  #: plain data that `from_recipe` turns into the same task

    @classmethod
    def position(cls, robot: Robot, axes: str = "xyz") -> Self:
        """Position of the tip along the given world axes [m], for example axes="xy".

        Example:
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
            >>> task = oc.Task.position(robot, "xy")
            >>> task.m, task.labels, task.units
            (2, ('x', 'y'), ('m', 'm'))
        """
        require_kind("axes", axes, str)
        if not axes or len(set(axes)) != len(axes) or set(axes) - set("xyz"):
            raise InvalidValueError("axes", repr(axes), "different letters of 'xyz'")
        rows = ["xyz".index(a) for a in axes]
        return cls._of_tip(robot, f"position:{axes}", tuple(axes), ("m",) * len(rows), lambda R, p: p[rows])

    @classmethod
    def polar(cls, robot: Robot) -> Self:
        """Radius [m] and angle [rad] of the tip in the x-y plane: axes="xy" in polar coordinates."""
        return cls._of_tip(
            robot,
            "polar",
            ("radius", "angle"),
            ("m", "rad"),
            lambda R, p: ca.vertcat(ca.sqrt(p[0] ** 2 + p[1] ** 2), ca.atan2(p[1], p[0])),
        )

    @classmethod
    def orientation(cls, robot: Robot, reference: ArrayLike | None = None, axis: str | None = None) -> Self:
        """Orientation of the tip relative to a reference, (3,): a rotation vector, or tilt and turn of an axis.

        By default x = 2 sin(angle / 2) axis of the rotation from the reference to the tip. Near the reference, it is
        the rotation vector [rad]. Half a turn away from the reference it jumps to its opposite; solvers, laws and C
        compare orientations by the turn between them, so they pass there (`orthocas.tasks.relative`).

        With `axis`, the first two components are those of the task `axis`, and the third is the tip's turn about that
        axis in (-pi, pi] [rad], after the shortest rotation that tilts the axis. A last joint along the axis then moves
        the third component only, by its own angle. This suits flanges with little inertia about their axis. x is smooth
        unless the axis tilts by half a turn; the turn jumps at half a turn.

        Args:
            robot: the robot.
            reference: reference rotation (3, 3) in the world. Default: the tip's at the centre of the problem's domain.
            axis: "x", "y" or "z" of the tip frame; None for the rotation vector.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.problems.get("iiwa").robot
            >>> oc.Task.orientation(robot, axis="z").labels
            ('tilt_x', 'tilt_y', 'turn_z')
        """
        return cls._turned(robot, TipTurn(False, True, axis), reference)

    @classmethod
    def pose(cls, robot: Robot, reference: ArrayLike | None = None, axis: str | None = None) -> Self:
        """Position [m] and orientation of the tip, (6,); see `position` and `orientation`."""
        return cls._turned(robot, TipTurn(True, True, axis), reference)

    @classmethod
    def axis(cls, robot: Robot, axis: str = "z", reference: ArrayLike | None = None) -> Self:
        """Direction of one axis of the tip, (2,). It does not depend on the rotation about that axis.

        Let d be the axis, expressed in a frame whose own axis is the reference direction. Then
        x = (d_i, d_j) sqrt(2 / (1 + d_axis)) has the length 2 sin(angle / 2), where angle lies between axis and
        reference. Near the reference, x is in [rad]. It is smooth except half a turn away. The frame is that of the tip
        at the centre of the problem's domain, or some frame about the given direction.

        Args:
            robot: the robot.
            axis: "x", "y" or "z" of the tip frame.
            reference: direction (3,) in the world, of any length. Default: the axis at the centre of the domain.

        Source:
            Lambert's azimuthal equal-area map of the sphere of directions.
        """
        require_kind("axis", axis, str)
        turn = TipTurn(False, False, axis)
        return cls._turned(robot, turn, None if reference is None else frame_along(reference, axis))

    @classmethod
    def position_and_axis(cls, robot: Robot, axis: str = "z", reference: ArrayLike | None = None) -> Self:
        """Position [m] and direction of one axis of the tip, (5,); see `position` and `axis`."""
        require_kind("axis", axis, str)
        turn = TipTurn(True, False, axis)
        return cls._turned(robot, turn, None if reference is None else frame_along(reference, axis))

    @classmethod
    def custom(
        cls,
        robot: Robot,
        name: str,
        function: Callable[[ca.SX], ca.SX] | ca.Function,
        labels: Sequence[str] = (),
        units: Sequence[str] = (),
    ) -> Self:
        """A task of your own, as a CasADi expression.

        Args:
            robot: the robot.
            name: a name for reports.
            function: maps an SX column q (n, 1) to x (m, 1).
            labels: names of the components.
            units: units of the components for figures and reports, for example "m" or "rad". Default: unknown.

        Raises:
            ShapeError: if x is not a column, or labels or units do not have one entry per component.
            InvalidValueError: if the function fails, or a name cannot be printed on one line.

        Example:
            >>> import casadi as ca
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
            >>> reach = oc.Task.custom(robot, "reach", lambda q: 2 * ca.cos(q[1] / 2), labels=["distance"], units=["m"])
            >>> reach.m, reach.labels
            (1, ('distance',))
        """
        require_kind("robot", robot, Robot)
        require_text("name of a task", str(name))
        q = ca.SX.sym("q", robot.n)
        x = expression_of(f"task '{name}'", function, q)
        if x.shape[1] != 1 or x.shape[0] == 0:
            raise ShapeError(f"task '{name}'", x.shape, (None, 1))
        require_kind("labels", labels, Sequence)
        require_kind("units", units, Sequence)
        labels = tuple(str(label) for label in labels) or tuple(f"{name}[{i}]" for i in range(x.shape[0]))
        units = tuple(str(unit) for unit in units) or ("",) * x.shape[0]
        for argument, texts in (("labels", labels), ("units", units)):
            if len(texts) != x.shape[0]:
                raise ShapeError(argument, (len(texts),), (x.shape[0],))
            for text in texts:
                require_text(f"an entry of {argument}", text or "none")
        recipe = {"kind": "custom", "name": str(name), "labels": labels, "units": units}
        return cls(robot, str(name), labels, units, dense_function("h", [q], [x]), recipe)

    @classmethod
    def named(cls, robot: Robot, kind: str, q_reference: ArrayLike | None = None) -> "Task":
        """A task by its short name: position, position:xy, polar, orientation, pose, pose:z, axis:x, position+axis.

        `orthocas.register_task` adds names.

        Args:
            robot: the robot.
            kind: the short name.
            q_reference: posture (n,) that defines the reference of orientation, pose and axis tasks.
        """
        require_kind("kind", kind, str)
        if (turn := TipTurn.of_kind(kind)) is not None:
            return cls._turned(robot, turn, None if q_reference is None else robot.tip_rotation(q_reference))
        name, _, words = kind.partition(":")
        if name not in _REGISTERED or (name == "polar" and words):
            raise UnknownNameError("task", kind, tuple(dict.fromkeys((*TASK_KINDS, *_REGISTERED))))
        return _REGISTERED[name](robot, words)

    @classmethod
    def from_recipe(cls, robot: Robot, recipe: Mapping[str, Any]) -> "Task":
        """The task of a robot that `recipe` describes. Custom tasks have no such recipe."""
        turn = TipTurn.of_kind(recipe["kind"])
        return cls.named(robot, recipe["kind"]) if turn is None else cls._turned(robot, turn, recipe["reference"])

    @property
    def lacks_reference(self) -> bool:
        """Whether the task compares the tip's orientation with a reference that was not given."""
        return self.turn is not None and "reference" not in self.recipe

    @property
    def turn(self) -> TipTurn | None:
        """How the task compares the tip's orientation with a reference; None if it does not."""
        return TipTurn.of_kind(self.recipe["kind"])

    def with_reference_at(self, q: ArrayLike) -> "Task":
        """The task with the tip's orientation at q (n,) as its reference, or the task itself if it has one already."""
        return self.named(self.robot, self.recipe["kind"], q) if self.lacks_reference else self

    @property
    def m(self) -> int:
        """Number of task components."""
        return len(self.labels)

    def facts(self) -> dict[str, str]:
        """Name, components and robot."""
        return {"task": f"{self.name}, m = {self.m} ({listed(self.labels)})", "robot": self.robot.heading}

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """q (n, 1) -> J_x = dh/dq (m, n), by automatic differentiation.

        For a rotation vector x = 2 v of the unit quaternion (w, v), dx/dt = w omega + v x omega with the angular
        velocity omega in the tip's axes, which also holds next to half a turn.
        """
        q = ca.SX.sym("q", self.robot.n)
        if not self._has_rotation_vector:
            return dense_function("task_jacobian", [q], [ca.jacobian(self.smooth_function(q), q)])
        J, p = self.rates_function(q), self._quaternion(q)
        turns = (p[0] * ca.SX.eye(3) + skew(p[1:])) @ J[self.m - 3 :, :]
        return dense_function("task_jacobian", [q], [ca.cse(ca.vertcat(J[: self.m - 3, :], turns))])

    @cached_property
    def rates_function(self) -> ca.Function:
        """q (n, 1) -> rows (m, n): dq gives how fast x moves, as seen from where it is; J_x for most tasks.

        For orientation and pose tasks, the rows of the orientation are the angular velocity in the tip's axes; with an
        AXIS in the order tilt, tilt, turn. They are those of J_x where the tip has the reference orientation.
        """
        turn = self.turn
        if turn is None or not turn.whole:
            return self.jacobian_function
        q = ca.SX.sym("q", self.robot.n)
        J, R = self.robot.function("tip_jacobian")(q), self.robot.function("tip_rotation")(q)
        return dense_function("task_rates", [q], [ca.cse(turn.rates(R.T @ J[3:, :], J[:3, :]))])

    @cached_property
    def rates_derivative_function(self) -> ca.Function:
        """q, v, w (n, 1) -> (d/ds) J(q + s v) w with the rows J of `rates_function`, (m, 1)."""
        if self.rates_function is self.jacobian_function:
            return self.second_derivative_function
        q, v, w = (ca.SX.sym(name, self.robot.n) for name in ("q", "v", "w"))
        change = ca.jtimes(self.rates_function(q) @ w, q, v)
        return dense_function("task_rates_derivative", [q, v, w], [ca.cse(change)], ["q", "v", "w"])

    @cached_property
    def frame_jacobian_function(self) -> ca.Function:
        """q (n, 1) -> rows (m, n) whose singular values measure how near a singular position is, in any x.

        For orientation, pose and axis tasks they are the velocity [m/s] and the angular velocity [rad/s] of the tip in
        its own axes, per unit joint velocity: rows of the geometric Jacobian, of which an axis task takes the two
        across its axis. J_x loses rank half a turn from the reference, where x ends; these rows do not. For other tasks
        they are J_x itself.
        """
        turn = self.turn
        if turn is None:
            return self.jacobian_function
        q = ca.SX.sym("q", self.robot.n)
        J, R = self.robot.function("tip_jacobian")(q), self.robot.function("tip_rotation")(q)
        return dense_function("frame_jacobian", [q], [ca.cse(turn.rates(R.T @ J[3:, :], R.T @ J[:3, :]))])

    @cached_property
    def second_derivative_function(self) -> ca.Function:
        """q, v, w (n, 1) -> d^2 h(q)[v, w] = (d/ds) J_x(q + s v) w, (m, 1)."""
        q, v, w = (ca.SX.sym(name, self.robot.n) for name in ("q", "v", "w"))
        if self._has_rotation_vector:
            J, p, change = self.rates_function(q), self._quaternion(q), self.rates_derivative_function(q, v, w)
            along, there = (J[self.m - 3 :, :] @ rate for rate in (v, w))
            dp = quaternion_product(p, ca.vertcat(0, along)) / 2
            bend = dp[0] * there + ca.cross(dp[1:], there)
            bend += p[0] * change[self.m - 3 :] + ca.cross(p[1:], change[self.m - 3 :])
            second = ca.cse(ca.vertcat(change[: self.m - 3], bend))
        else:
            second = ca.jtimes(ca.jtimes(self.smooth_function(q), q, w), q, v)
        return dense_function("task_second_derivative", [q, v, w], [second], ["q", "v", "w"])

    @cached_property
    def centred_jacobian_function(self) -> ca.Function:
        """q, centre (n, 1) -> J_x at q (m, n). A missing reference is taken at the centre."""
        q, centre = (ca.SX.sym(name, self.robot.n) for name in ("q", "centre"))
        x, turn = self.smooth_function(q), self.turn
        if turn is not None and self.lacks_reference:
            rotation, position = self.robot.function("tip_rotation"), self.robot.function("tip_position")
            x = turn.components(rotation(centre).T @ rotation(q), position(q), True)
        return dense_function("centred_jacobian", [q, centre], [ca.jacobian(x, q)], ["q", "centre"])

    @cached_property
    def batched(self) -> BlockedFunction:
        """Evaluates h at many points."""
        return BlockedFunction(self.function)

    @cached_property
    def batched_jacobian(self) -> BlockedFunction:
        """Evaluates J_x at many points."""
        return BlockedFunction(self.jacobian_function)

    @cached_property
    def batched_frame_jacobian(self) -> BlockedFunction:
        """Evaluates the rows of `frame_jacobian_function` at many points."""
        return self.batched_jacobian if self.turn is None else BlockedFunction(self.frame_jacobian_function)

    def value(self, position: ArrayLike | None, orientation: ArrayLike) -> Array:
        """The task value x, (m,) or (N, m), of a pose of the tip, for tasks of a whole orientation.

        Args:
            position: of the tip [m], (3,) or (N, 3); None for tasks without one.
            orientation: of the tip in the world: rotation matrices (3, 3) or (N, 3, 3), or unit quaternions
                (w, x, y, z), (4,) or (N, 4).

        Raises:
            InvalidValueError, ShapeError: if the task has no whole orientation, or for arguments that do not fit.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.problems.get("iiwa").robot
            >>> task = oc.Task.pose(robot, reference=[[1, 0, 0], [0, 1, 0], [0, 0, 1]])
            >>> task.value([0.5, 0.0, 0.4], [0.0, 1.0, 0.0, 0.0]).round(3).tolist()  # half a turn about x
            [0.5, 0.0, 0.4, 2.0, 0.0, 0.0]
        """
        turn = self._whole_turn()
        R, single = _rotations("orientation", orientation)
        turned = Batched(self.components_function)(self.reference.T @ R)[0]
        if turn.with_position:
            p = as_float_array("position", np.nan if position is None else position)
            require_shape("position", p.shape, (3,) if single else (len(R), 3))
            require_finite("position", p)
            turned = np.hstack([p.reshape(-1, 3), turned])
        elif position is not None:
            raise InvalidValueError("position", repr(position)[:80], f"None for the task {self.name}")
        return np.asarray(turned[0] if single else turned)

    def orientation_of(self, x: ArrayLike) -> Array:
        """The tip's orientation in the world, (3, 3) or (N, 3, 3), at task values x (m,) or (N, m); see `value`."""
        self._whole_turn()
        values, single = as_point_set("x", x, self.m)
        found = self.reference @ rotations_of(Batched(self.quaternion_function)(values)[0])
        return np.asarray(found[0] if single else found)

    @cached_property
    def quaternion_function(self) -> ca.Function:
        """x (m, 1) -> the rotation (w, x, y, z) from the reference to the tip, for tasks of a whole orientation."""
        x = ca.SX.sym("x", self.m)
        return dense_function("quaternion", [x], [self._whole_turn().quaternion(x[self.m - 3 :])], ["x"])

    @cached_property
    def components_function(self) -> ca.Function:
        """The rotation from the reference to the tip (3, 3) -> the components of the orientation (3, 1)."""
        R = ca.SX.sym("R", 3, 3)
        return dense_function("components", [R], [self._whole_turn().components(R, ca.SX.zeros(3))[-3:]], ["R"])

    @property
    def _has_rotation_vector(self) -> bool:
        return self.turn is not None and self.turn.whole and self.turn.axis is None

    def _quaternion(self, q: ca.SX) -> ca.SX:
        """The rotation from the reference to the tip, (4, 1)."""
        return quaternion_of(ca.SX(ca.DM(self.reference.T)) @ self.robot.function("tip_rotation")(q))

    def _whole_turn(self) -> TipTurn:
        if self.turn is None or not self.turn.whole:
            raise InvalidValueError("task", self.name, "one with a whole orientation, such as pose")
        return self.turn

    @property
    def reference(self) -> Array:
        """The reference orientation (3, 3) of a task that has one: as given, or the tip's in mid-range.

        Raises:
            InvalidValueError: if the task has no orientation.
        """
        if self.turn is None:
            raise InvalidValueError("task", self.name, "one with an orientation")
        given = self.recipe.get("reference")
        return self.robot.tip_rotation(self.robot.tree.middle) if given is None else np.array(given)

    @cached_property
    def smooth_function(self) -> ca.Function:
        """q (n, 1) -> x (m, 1) in the form to differentiate: without cases, but with few digits next to half a turn."""
        turn = self.turn
        if turn is None or turn.axis is not None:
            return self.function
        q = ca.SX.sym("q", self.robot.n)
        rotation, position = self.robot.function("tip_rotation")(q), self.robot.function("tip_position")(q)
        x = turn.components(ca.SX(ca.DM(self.reference.T)) @ rotation, position, True)
        return dense_function("h", [q], [x])

    @classmethod
    def _turned(cls, robot: Robot, turn: TipTurn, reference: ArrayLike | None) -> Self:
        """A task of the tip's rotation from a reference (3, 3), or from the default if it is None."""
        if reference is None:
            base, extra = robot.tip_rotation(robot.tree.middle), {}
        else:
            base = rotation_matrix("reference", reference)
            extra = {"reference": base.tolist()}
        across = ca.SX(ca.DM(base.T))
        return cls._of_tip(
            robot, turn.kind, turn.labels, turn.units, lambda R, p: turn.components(across @ R, p), extra
        )

    @classmethod
    def _of_tip(
        cls,
        robot: Robot,
        name: str,
        labels: tuple[str, ...],
        units: tuple[str, ...],
        components: Callable[[ca.SX, ca.SX], ca.SX],
        extra: Mapping[str, Any] | None = None,
    ) -> Self:
        """A task that is a function of the tip's rotation and position."""
        require_kind("robot", robot, Robot)
        q = ca.SX.sym("q", robot.n)
        x = components(robot.function("tip_rotation")(q), robot.function("tip_position")(q))
        return cls(robot, name, labels, units, dense_function("h", [q], [x]), {"kind": name, **(extra or {})})


def _rotations(name: str, value: ArrayLike) -> tuple[Array, bool]:
    """Rotation matrices (N, 3, 3) from such, or from unit quaternions, and whether it was one."""
    given = as_float_array(name, value)
    require_finite(name, given)
    single = given.shape in ((4,), (3, 3))
    if not single and given.shape[1:] not in ((4,), (3, 3)):
        raise InvalidValueError(f"shape of {name}", given.shape, "(3, 3), (N, 3, 3), (4,) or (N, 4)")
    rows = given[None] if single else given
    if rows.ndim == 2:
        off = np.abs(np.linalg.norm(rows, axis=1) - 1)
        if len(rows) and off.max() > 1e-6:
            raise InvalidValueError(name, rows[off.argmax()].tolist(), "a quaternion (w, x, y, z) of length 1")
        return rotations_of(rows / np.linalg.norm(rows, axis=1, keepdims=True)), single
    return np.array([rotation_matrix(name, R) for R in rows]).reshape(-1, 3, 3), single


_REGISTERED: dict[str, Callable[[Robot, str], Task]] = {
    "position": lambda robot, axes: Task.position(robot, axes or "xyz"),
    "polar": lambda robot, _: Task.polar(robot),
}


def register_task(name: str, build: Callable[[Robot, str], Task]) -> None:
    """Let `Task.named` and the option --task build a task of your own. Files need no registration.

    Args:
        name: a short name without a colon.
        build: makes the task from a robot and what follows the colon in "name:words", which may be "".

    Raises:
        InvalidValueError: if the name has a colon or is taken.

    Example:
        >>> import orthocas as oc
        >>> def height(robot, words):
        ...     return oc.Task.custom(robot, "height", lambda q: robot.tip_position(q)[1], ["height"], ["m"])
        >>> oc.register_task("height", height)
        >>> oc.Task.named(oc.Robot.planar([1.0, 1.0], [3.0, 3.0]), "height").labels
        ('height',)
    """
    require_text("name", name)
    taken = name in TASK_KINDS or TipTurn.of_kind(name) is not None or _REGISTERED.get(name, build) is not build
    if ":" in name or taken:
        raise InvalidValueError("name", repr(name), "a free name without a colon")
    if not callable(build):
        raise InvalidValueError("build", repr(build)[:80], "a function of a robot and a text")
    _REGISTERED[name] = build
