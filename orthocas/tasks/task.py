"""Tasks x = h(q): m < n numbers that describe what the robot does."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.robots.kinematics import TipTurn, frame_along
from orthocas.robots.robot import Robot
from orthocas.robots.spatial import rotation_matrix
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import require_kind, require_text
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
        the rotation vector [rad]. It is smooth except half a turn away from the reference.

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
        """q (n, 1) -> J_x = dh/dq (m, n), by automatic differentiation."""
        q = ca.SX.sym("q", self.robot.n)
        return dense_function("task_jacobian", [q], [ca.jacobian(self.function(q), q)])

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
        second = ca.jtimes(ca.jtimes(self.function(q), q, w), q, v)
        return dense_function("task_second_derivative", [q, v, w], [second], ["q", "v", "w"])

    @cached_property
    def centred_jacobian_function(self) -> ca.Function:
        """q, centre (n, 1) -> J_x at q (m, n). A missing reference is taken at the centre."""
        q, centre = (ca.SX.sym(name, self.robot.n) for name in ("q", "centre"))
        x, turn = self.function(q), self.turn
        if turn is not None and self.lacks_reference:
            rotation, position = self.robot.function("tip_rotation"), self.robot.function("tip_position")
            x = turn.components(rotation(centre).T @ rotation(q), position(q))
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
