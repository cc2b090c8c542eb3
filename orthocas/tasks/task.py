"""Tasks x = h(q): m < n numbers that describe what the robot does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, ShapeError, SingularTaskError, UnknownNameError
from orthocas.robots.kinematics import TipTurn, align_frame
from orthocas.robots.robot import FrameQuantity, Robot
from orthocas.robots.spatial import build_rotations, find_quaternion, multiply_quaternions, rotation_matrix, skew
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_point_set,
    freeze_array,
    require_finite,
    require_kind,
    require_known,
    require_shape,
    require_text,
)
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.display import Shown, listed
from orthocas.tools.expressions import HoldsFunctions, build_expression, call_user

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
    "relative_position",
    "relative_position:AXES",
    "relative_pose",
    "relative_pose:AXIS",
    "centre_of_mass",
    "centre_of_mass:AXES",
)
_RELATIVE = "relative_"


@dataclass(frozen=True)
class Frames:
    """The frame that a task observes, and its frame of reference."""

    frame: str | None = None  #: None: the tip
    relative_to: str | None = None  #: None: the world

    @classmethod
    def from_recipe(cls, recipe: Mapping[str, Any]) -> Self:
        """Rebuild the frames of a task's recipe."""
        return cls(recipe.get("frame"), recipe.get("relative_to"))

    @property
    def recipe(self) -> dict[str, str]:
        """The names that are not the default."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def suffix(self) -> str:
        """The frames as a suffix of the task's name."""
        frame = "" if self.frame is None else f" of {self.frame}"
        return frame if self.relative_to is None else f"{frame} in {self.relative_to}"

    def build_function(self, robot: Robot, quantity: FrameQuantity) -> ca.Function:
        """q (n, 1) -> position, rotation or geometric Jacobian of the frame."""
        return robot.frame_function(quantity, self.frame, self.relative_to)

    def evaluate_rotation(self, robot: Robot, q: ArrayLike) -> Array:
        """Rotation of the frame at q (n,), (3, 3)."""
        frame = robot.tree.tip_name if self.frame is None else self.frame
        return np.asarray(robot.frame_rotation(q, frame, self.relative_to))


_OF_TIP = Frames()


@dataclass(frozen=True, eq=False, repr=False)
class Task(Shown, HoldsFunctions):
    """The task map h of a robot. Use the class methods to build one.

    Orientation, pose and axis tasks compare the tip with a reference orientation. If none is given, `Problem` uses the
    tip's orientation at the centre of its domain, and the task itself uses that at the centre of the joint limits.
    """

    robot: Robot
    name: str
    labels: tuple[str, ...]  #: names of the components of x
    units: tuple[str, ...]  #: units of the components: "m", "rad", or "" if unknown
    function: ca.Function  #: q (n, 1) -> x (m, 1), dense, SX
    recipe: dict[str, Any]  #: plain data that `from_recipe` turns into the same task
    parts: tuple[Task, ...] = ()  #: the tasks of a stack

    @classmethod
    def position(
        cls, robot: Robot, axes: str = "xyz", frame: str | None = None, relative_to: str | None = None
    ) -> Self:
        """Position of the tip along the given world axes [m], for example axes="xy".

        Args:
            robot: the robot.
            axes: different letters of "xyz".
            frame: name of a frame of the robot, here and in other tasks; default: the (first) tip.
            relative_to: name of the frame of reference for position and orientation; default: the world.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
            >>> task = oc.Task.position(robot, "xy")
            >>> task.m, task.labels, task.units
            (2, ('x', 'y'), ('m', 'm'))
        """
        rows, frames = _find_rows(axes), Frames(frame, relative_to)
        return cls._build_of_pose(
            robot, f"position:{axes}", tuple(axes), ("m",) * len(rows), lambda R, p: p[rows], frames=frames
        )

    @classmethod
    def polar(cls, robot: Robot) -> Self:
        """Radius [m] and angle [rad] of the tip in the x-y plane."""
        return cls._build_of_pose(
            robot,
            "polar",
            ("radius", "angle"),
            ("m", "rad"),
            lambda R, p: ca.vertcat(ca.sqrt(p[0] ** 2 + p[1] ** 2), ca.atan2(p[1], p[0])),
        )

    @classmethod
    def orientation(
        cls,
        robot: Robot,
        reference: ArrayLike | None = None,
        axis: str | None = None,
        frame: str | None = None,
        relative_to: str | None = None,
    ) -> Self:
        """Orientation of the tip relative to a reference, (3,): a rotation vector, or tilt and turn of an axis.

        By default x = 2 sin(angle / 2) axis of the rotation from the reference to the tip. Near the reference, it is
        the rotation vector [rad]. Half a turn away from the reference it jumps to its opposite. Solvers, laws and C use
        the rotation between two orientations as the error, so they move through this point (`orthocas.tasks.relative`).

        With `axis`, the first two components are those of the task `axis`. The third is the tip's turn about that axis
        in (-pi, pi] [rad], after the shortest rotation that tilts the axis. If the last joint lies along the axis, it
        moves the third component only, by its own angle. This suits flanges with little inertia about their axis. The
        tilt is smooth unless the axis tilts by half a turn, and the turn jumps at half a turn.

        Args:
            robot: the robot.
            reference: reference rotation (3, 3) in the world. Default: the tip's at the centre of the problem's domain.
            axis: "x", "y" or "z" of the tip frame; None for the rotation vector.
            frame: as in `position`.
            relative_to: as in `position`.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.problems.get("iiwa").robot
            >>> oc.Task.orientation(robot, axis="z").labels
            ('tilt_x', 'tilt_y', 'turn_z')
        """
        return cls._build_turned(robot, TipTurn(False, True, axis), reference, Frames(frame, relative_to))

    @classmethod
    def pose(
        cls,
        robot: Robot,
        reference: ArrayLike | None = None,
        axis: str | None = None,
        frame: str | None = None,
        relative_to: str | None = None,
    ) -> Self:
        """Position [m] and orientation of the tip, (6,); see `position` and `orientation`."""
        return cls._build_turned(robot, TipTurn(True, True, axis), reference, Frames(frame, relative_to))

    @classmethod
    def axis(
        cls,
        robot: Robot,
        axis: str = "z",
        reference: ArrayLike | None = None,
        frame: str | None = None,
        relative_to: str | None = None,
    ) -> Self:
        """Direction of one axis of the tip, (2,). It does not depend on the rotation about that axis.

        Let d be the axis of the tip, expressed in a frame whose own axis is the reference direction. Then x = (d_i,
        d_j) sqrt(2 / (1 + d_axis)) has the length 2 sin(angle / 2), with the angle between axis and reference. Near the
        reference, x is in [rad]. It is smooth except half a turn away. By default this frame is that of the tip at the
        centre of the problem's domain; with a given direction it is any frame with that axis.

        Args:
            robot: the robot.
            axis: "x", "y" or "z" of the tip frame.
            reference: direction (3,) in the world, of any length. Default: the axis at the centre of the domain.
            frame: as in `position`.
            relative_to: as in `position`.

        Source:
            Lambert's azimuthal equal-area map of the sphere of directions.
        """
        require_kind("axis", axis, str)
        turn, frames = TipTurn(False, False, axis), Frames(frame, relative_to)
        return cls._build_turned(robot, turn, None if reference is None else align_frame(reference, axis), frames)

    @classmethod
    def position_and_axis(
        cls,
        robot: Robot,
        axis: str = "z",
        reference: ArrayLike | None = None,
        frame: str | None = None,
        relative_to: str | None = None,
    ) -> Self:
        """Position [m] and direction of one axis of the tip, (5,); see `position` and `axis`."""
        require_kind("axis", axis, str)
        turn, frames = TipTurn(True, False, axis), Frames(frame, relative_to)
        return cls._build_turned(robot, turn, None if reference is None else align_frame(reference, axis), frames)

    @classmethod
    def relative_position(cls, robot: Robot, base: str, frame: str, axes: str = "xyz") -> Self:
        """Position of one frame in the axes of another [m], such as one hand seen from the other.

        Args:
            robot: the robot.
            base: name of the frame that observes.
            frame: name of the frame that is observed.
            axes: different letters of "xyz".
        """
        return cls.position(robot, axes, frame, base)

    @classmethod
    def relative_pose(
        cls, robot: Robot, base: str, frame: str, reference: ArrayLike | None = None, axis: str | None = None
    ) -> Self:
        """Pose of one frame in another, (6,), such as the relative pose of two hands that hold one object; see `pose`.

        Args:
            robot: the robot.
            base: name of the frame that observes.
            frame: name of the frame that is observed.
            reference: reference rotation (3, 3) of the second frame in the first.
            axis: "x", "y" or "z" of the second frame; None for the rotation vector.
        """
        return cls.pose(robot, reference, axis, frame, base)

    @classmethod
    def centre_of_mass(cls, robot: Robot, axes: str = "xyz") -> Self:
        """Centre of mass of everything that the joints move, along the given world axes [m]."""
        require_kind("robot", robot, Robot)
        rows = _find_rows(axes)
        q, name = ca.SX.sym("q", robot.n), f"centre_of_mass:{axes}"
        h = dense_function("h", [q], [robot.centre_of_mass(q)[rows]])
        return cls(robot, name, tuple(f"com_{a}" for a in axes), ("m",) * len(rows), h, {"kind": name})

    @classmethod
    def pointing(cls, robot: Robot, camera: str, target: ArrayLike | str, axis: str = "z") -> Self:
        """Deviation of a camera's axis from the direction of a target, (2,); 0 if the camera points at the target.

        Let u be the unit vector from the camera to the target, in the camera's frame. Then x = (u_i, u_j) sqrt(2 / (1 +
        u_axis)) has the length 2 sin(angle / 2), with the angle between axis and u.

        Args:
            robot: the robot.
            camera: name of a frame.
            target: a point (3,) in the world [m], or the name of a frame.
            axis: "x", "y" or "z" of the camera.

        Source:
            Lambert's azimuthal equal-area map, as in `axis`.
        """
        require_kind("robot", robot, Robot)
        require_kind("camera", camera, str)
        require_known("axis of the camera", axis, tuple("xyz"))
        q, k = ca.SX.sym("q", robot.n), "xyz".index(axis)
        place = target if isinstance(target, str) else freeze_array("target", target, (3,)).tolist()
        to = robot.frame_position(q, place) if isinstance(place, str) else ca.SX(place)
        # Unit vector to the target in the axes of the camera, mapped by Lambert's projection.
        u = robot.frame_rotation(q, camera).T @ (to - robot.frame_position(q, camera))
        u /= ca.norm_2(u)
        others = [i for i in range(3) if i != k]
        x = u[others] * ca.sqrt(2 / (1 + u[k]))
        recipe = {"kind": "pointing", "camera": camera, "target": place, "axis": axis}
        labels = tuple(f"aim_{'xyz'[i]}" for i in others)
        return cls(robot, f"pointing of {camera}", labels, ("rad", "rad"), dense_function("h", [q], [x]), recipe)

    @classmethod
    def stack(cls, *tasks: Task) -> Self:
        """Combine several tasks of one robot into one, such as the positions of two hands.

        Labels that appear twice get a number. Components are compared as plain numbers, so those of an orientation jump
        half a turn from their reference.

        Args:
            tasks: the tasks, in the order of the components.

        Raises:
            InvalidValueError: if there is no task, or the tasks belong to different robots.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
            >>> task = oc.Task.stack(oc.Task.position(robot, "x"), oc.Task.centre_of_mass(robot, "x"))
            >>> task.labels
            ('x', 'com_x')
        """
        for task in tasks:
            require_kind("task", task, Task)
            if not task.robot.tree.equals(tasks[0].robot.tree):
                raise InvalidValueError("tasks", "of different robots", "tasks of one robot")
        if not tasks:
            raise InvalidValueError("tasks", "none", "at least one")
        # Flatten stacks of stacks.
        tasks = tuple(single for task in tasks for single in task.parts or (task,))
        labels = [label for task in tasks for label in task.labels]
        numbered = (
            f"{label}_{labels[:i].count(label) + 1}" if labels.count(label) > 1 else label
            for i, label in enumerate(labels)
        )
        robot, units = tasks[0].robot, tuple(unit for task in tasks for unit in task.units)
        recipe = {"kind": "stack", "parts": [task.recipe for task in tasks]}
        name = " + ".join(task.name for task in tasks)
        return cls(robot, name, tuple(numbered), units, _stack_functions(tasks, "function"), recipe, tasks)

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
        x = build_expression(f"task '{name}'", function, q)
        if x.shape[1] != 1 or x.shape[0] == 0:
            raise ShapeError(f"task '{name}'", x.shape, (None, 1))
        require_kind("labels", labels, Sequence)
        require_kind("units", units, Sequence)
        # Labels and units are free, but must be printable and one per component.
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
    def named(cls, robot: Robot, kind: str, q_reference: ArrayLike | None = None) -> Task:
        """A task by its short name: position, position:xy, polar, orientation, pose, pose:z, axis:x, position+axis.

        A robot with two tips also has relative_position and relative_pose, of the second tip in the first.
        `orthocas.register_task` adds further names.

        Args:
            robot: the robot.
            kind: the short name.
            q_reference: posture (n,) that defines the reference of orientation, pose and axis tasks.
        """
        require_kind("kind", kind, str)
        frames, base_kind = _OF_TIP, kind
        # Second tip relative to the first one.
        if kind.startswith(_RELATIVE):
            if len(robot.tips) != 2:
                raise InvalidValueError("task", kind, f"a robot with two tips; this one has {listed(robot.tips)}")
            base_kind, frames = kind.removeprefix(_RELATIVE), Frames(robot.tips[1], robot.tips[0])
        # Built-in kinds.
        if (turn := TipTurn.from_kind(base_kind)) is not None:
            reference = None if q_reference is None else frames.evaluate_rotation(robot, q_reference)
            return cls._build_turned(robot, turn, reference, frames)
        if base_kind.partition(":")[0] == "position":
            return cls.position(robot, base_kind.partition(":")[2] or "xyz", frames.frame, frames.relative_to)
        # Registered kinds.
        name, _, words = kind.partition(":")
        if name not in _REGISTERED or (name == "polar" and words):
            raise UnknownNameError("task", kind, list_task_kinds())
        expected = f"'{name}' or '{name}:WORDS' with words that its builder takes"
        task: Task = call_user(f"task '{kind}'", expected, _REGISTERED[name], robot, words)
        require_kind(f"what the builder of task '{name}' returns", task, Task)
        return task

    @classmethod
    def from_recipe(cls, robot: Robot, recipe: Mapping[str, Any]) -> Task:
        """Rebuild the task of a robot from a recipe. Custom tasks and stacks cannot be rebuilt from theirs."""
        kind, frames = recipe["kind"], Frames.from_recipe(recipe)
        if kind == "pointing":
            return cls.pointing(robot, recipe["camera"], recipe["target"], recipe["axis"])
        if (turn := TipTurn.from_kind(kind)) is not None:
            return cls._build_turned(robot, turn, recipe.get("reference"), frames)
        if kind.startswith("position:"):
            return cls.position(robot, kind.removeprefix("position:"), frames.frame, frames.relative_to)
        return cls.named(robot, kind)

    @property
    def of_tip(self) -> bool:
        """Whether the task is of a built-in kind and depends only on the pose of the (first) tip in the world."""
        kind = self.recipe["kind"]
        of_pose = TipTurn.from_kind(kind) is not None or kind == "polar" or kind.startswith("position:")
        return of_pose and Frames.from_recipe(self.recipe) == _OF_TIP

    @property
    def lacks_reference(self) -> bool:
        """Whether the task compares the tip's orientation with a reference, but none was given."""
        own = self.turn is not None and "reference" not in self.recipe
        return own or any(part.lacks_reference for part in self.parts)

    @property
    def turn(self) -> TipTurn | None:
        """The comparison of the tip's orientation with a reference; None if the task has none."""
        return TipTurn.from_kind(self.recipe["kind"])

    def with_reference_at(self, q: ArrayLike) -> Task:
        """The task with the tip's orientation at q (n,) as its reference; the task itself if it has one already."""
        if not self.lacks_reference:
            return self
        if self.parts:
            return self.stack(*(part.with_reference_at(q) for part in self.parts))
        assert self.turn is not None
        return self._build_turned(self.robot, self.turn, self._frames.evaluate_rotation(self.robot, q), self._frames)

    @property
    def m(self) -> int:
        """Number of task components."""
        return len(self.labels)

    def __call__(self, q: Any) -> Any:
        """Task values x = h(q): (n,) -> (m,), (N, n) -> (N, m), and a CasADi column -> an expression."""
        if isinstance(q, ca.SX | ca.MX):
            require_shape("q", q.shape, (self.robot.n, 1))
            return self.function(q)
        points, single = as_point_set("q", q, self.robot.n)
        values = self.batched(points)[0]
        return values[0] if single else values

    def facts(self) -> dict[str, str]:
        """Name, components and robot."""
        return {"task": f"{self.name}, m = {self.m} ({listed(self.labels)})", "robot": self.robot.heading}

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """q (n, 1) -> J_x = dh/dq (m, n), by automatic differentiation.

        For a rotation vector x = 2 v with the unit quaternion (w, v), dx/dt = w omega + v x omega, with the angular
        velocity omega in the tip's axes. This also holds near half a turn.
        """
        if self.parts:
            return _stack_functions(self.parts, "jacobian_function")
        q = ca.SX.sym("q", self.robot.n)
        if not self._has_rotation_vector:
            return dense_function("task_jacobian", [q], [ca.jacobian(self.smooth_function(q), q)])
        J, p = self.rates_function(q), self._build_quaternion(q)
        turns = (p[0] * ca.SX.eye(3) + skew(p[1:])) @ J[self.m - 3 :, :]
        return dense_function("task_jacobian", [q], [ca.cse(ca.vertcat(J[: self.m - 3, :], turns))])

    @cached_property
    def rates_function(self) -> ca.Function:
        """q (n, 1) -> rows (m, n) whose product with dq is the rate of the error of `Relative`; J_x for most tasks.

        For orientation and pose tasks, the orientation rows are the angular velocity in the tip's axes; with an AXIS in
        the order tilt, tilt, turn. They equal those of J_x where the tip has the reference orientation.
        """
        turn = self.turn
        if turn is None or not turn.whole:
            return self.jacobian_function
        q = ca.SX.sym("q", self.robot.n)
        J, R = self._build_frame("jacobian")(q), self._build_frame("rotation")(q)
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
        """q (n, 1) -> rows (m, n) whose singular values measure the distance to singular positions, in any x.

        For orientation, pose and axis tasks they are the velocity [m/s] and the angular velocity [rad/s] of the tip in
        its own axes, per unit joint velocity: rows of the geometric Jacobian. An axis task takes the two angular rows
        across its axis. These rows keep their rank half a turn from the reference, where x ends and J_x loses rank. For
        other tasks they are J_x itself.

        A stack has the rows of its parts. Suppose a stack has the pose of one frame in the world and the pose of a
        second frame in the first. It is equivalent to both poses in the world, so it takes the rows of these: the
        motion of the second frame due to the first one is a linear combination of the first one's rows.
        """
        if self.turn is None and not self.parts:
            return self.jacobian_function
        q = ca.SX.sym("q", self.robot.n)
        # Parts that depend on other parts take the rows of their own frames.
        rows = [part._build_frame_rows(q, frames) for part, frames in _find_independent_frames(self.parts or (self,))]
        return dense_function("frame_jacobian", [q], [ca.cse(ca.vertcat(*rows))])

    def _build_frame_rows(self, q: ca.SX, frames: Frames) -> ca.SX:
        """The rows of a task with one part for given frames at q; positions stay in their own axes."""
        turn = self.turn
        if turn is None and frames == self._frames:
            return self.jacobian_function(q)
        J, R = (frames.build_function(self.robot, quantity)(q) for quantity in ("jacobian", "rotation"))
        if turn is not None:
            return turn.rates(R.T @ J[3:, :], R.T @ J[:3, :])
        axes = Frames(self._frames.relative_to).build_function(self.robot, "rotation")(q)
        return (axes.T @ J[:3, :])[_find_rows(self.recipe["kind"].partition(":")[2]), :]

    @cached_property
    def second_derivative_function(self) -> ca.Function:
        """q, v, w (n, 1) -> d^2 h(q)[v, w] = (d/ds) J_x(q + s v) w, (m, 1)."""
        q, v, w = (ca.SX.sym(name, self.robot.n) for name in ("q", "v", "w"))
        if self._has_rotation_vector:
            # d^2 x = d(w omega + v x omega) includes the change of the quaternion along v.
            J, p, change = self.rates_function(q), self._build_quaternion(q), self.rates_derivative_function(q, v, w)
            along, there = (J[self.m - 3 :, :] @ rate for rate in (v, w))
            dp = multiply_quaternions(p, ca.vertcat(0, along)) / 2
            bend = dp[0] * there + ca.cross(dp[1:], there)
            bend += p[0] * change[self.m - 3 :] + ca.cross(p[1:], change[self.m - 3 :])
            second = ca.cse(ca.vertcat(change[: self.m - 3], bend))
        else:
            second = ca.jtimes(ca.jtimes(self.smooth_function(q), q, w), q, v)
        return dense_function("task_second_derivative", [q, v, w], [second], ["q", "v", "w"])

    @cached_property
    def centred_jacobian_function(self) -> ca.Function:
        """q, centre (n, 1) -> J_x at q (m, n), with a missing reference taken at `centre`."""
        q, centre = (ca.SX.sym(name, self.robot.n) for name in ("q", "centre"))
        x, turn = self.smooth_function(q), self.turn
        if turn is not None and self.lacks_reference:
            rotation, position = self._build_frame("rotation"), self._build_frame("position")
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
        plain = self.turn is None and not self.parts
        return self.batched_jacobian if plain else BlockedFunction(self.frame_jacobian_function)

    def manipulability(self, q: ArrayLike) -> Array:
        """w = sqrt(det(J J^T)) at q (n,), or at each row of (N, n); 0 at singular positions.

        J is `frame_jacobian_function`, for a pose the geometric Jacobian. The units of a pose are mixed, so compare w
        between postures of one robot and task only.

        Raises:
            ShapeError, InvalidValueError: if q has another number of joints, or is not finite.

        Source:
            [Y1985]
        """
        points, single = as_point_set("q", q, self.robot.n)
        w = self._batched_manipulability[0](points)[0][:, 0]
        return np.asarray(w[0] if single else w)

    def manipulability_gradient(self, q: ArrayLike) -> Array:
        """dw/dq (n,) of the manipulability at q (n,), or (N, n) at each row of (N, n); NaN at singular positions.

        Raises:
            ShapeError, InvalidValueError: as in `manipulability`.

        Source:
            The formula: [Y1985], differentiated.
        """
        points, single = as_point_set("q", q, self.robot.n)
        dw = self._batched_manipulability[1](points)[0]
        return np.asarray(dw[0] if single else dw)

    @cached_property
    def manipulability_function(self) -> ca.Function:
        """q (n, 1) -> w (1, 1): the volume that the rows of `frame_jacobian_function` span."""
        q = ca.SX.sym("q", self.robot.n)
        J, volume, units = self.frame_jacobian_function(q), ca.SX(1), list[ca.SX]()
        # Multiply the lengths of the parts of each row across the rows before it. A zero length has no direction.
        for k in range(J.shape[0]):
            across = J[k, :].T
            for unit in units:
                across -= ca.dot(unit, across) * unit
            length = ca.norm_2(across)
            units.append(across / ca.fmax(length, np.finfo(float).tiny))
            volume *= length
        return ca.Function("manipulability", [q], [ca.cse(volume)], ["q"], ["manipulability"])

    @cached_property
    def _batched_manipulability(self) -> tuple[Batched, Batched]:
        """w at many points, and its gradient."""
        q = ca.SX.sym("q", self.robot.n)
        w = self.manipulability_function(q)
        gradient = dense_function("manipulability_gradient", [q], [ca.cse(ca.gradient(w, q))])
        return Batched(self.manipulability_function), Batched(gradient)

    def evaluate_jacobian(self, points: Array, results: Array | None = None) -> Array:
        """J_x at points (N, n), as an array (N, m, n): a new one, or `results`.

        Raises:
            SingularTaskError: if J_x is not finite at a point (for example polar coordinates at the origin).
        """
        J = np.empty((len(points), self.m, self.robot.n)) if results is None else results
        self.batched_jacobian.into(J, points)
        if not np.isfinite(J).all():
            bad = ~np.isfinite(J).all(axis=(1, 2))
            at = np.round(points[np.flatnonzero(bad)[0]], 4).tolist()
            raise SingularTaskError(f"the Jacobian of task '{self.name}' is not finite at q = {at}")
        return J

    def value(self, position: ArrayLike | None, orientation: ArrayLike) -> Array:
        """The task value x, (m,) or (N, m), at a pose of the tip, for tasks of a whole orientation.

        Args:
            position: of the tip [m], (3,) or (N, 3); None for tasks without one.
            orientation: of the tip in the world: rotation matrices (3, 3) or (N, 3, 3), or unit quaternions
                (w, x, y, z), (4,) or (N, 4).

        Raises:
            InvalidValueError, ShapeError: if the task has no whole orientation, or the arguments do not fit it.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.problems.get("iiwa").robot
            >>> task = oc.Task.pose(robot, reference=[[1, 0, 0], [0, 1, 0], [0, 0, 1]])
            >>> task.value([0.5, 0.0, 0.4], [0.0, 1.0, 0.0, 0.0]).round(3).tolist()  # half a turn about x
            [0.5, 0.0, 0.4, 2.0, 0.0, 0.0]
        """
        turn = self._require_whole_turn()
        # Components of the rotation from the reference.
        R, single = _read_rotations("orientation", orientation)
        turned = Batched(self.components_function)(self.reference.T @ R)[0]
        # A pose also has a position.
        if turn.with_position:
            p = as_float_array("position", np.nan if position is None else position)
            require_shape("position", p.shape, (3,) if single else (len(R), 3))
            require_finite("position", p)
            turned = np.hstack([p.reshape(-1, 3), turned])
        elif position is not None:
            raise InvalidValueError("position", repr(position)[:80], f"None for the task {self.name}")
        return np.asarray(turned[0] if single else turned)

    def target(self, pose: Any) -> Array:
        """The task value x, (m,) or (N, m), of a target in any usual form.

        Args:
            pose: one pose or many: matrices (4, 4) or (N, 4, 4); an object with `translation` and `rotation`, such as
                `pinocchio.SE3`, or a list of them; a pair of position and orientation as in `value`, or a list of
                pairs. Rotations may be rounded to single precision or four decimals. Or task values (m,) or (N, m),
                which are returned unchanged. A rotation matrix is refused, so that it is not mistaken for three task
                values.

        Raises:
            InvalidValueError, ShapeError: if the argument has none of these forms, or the task does not use such a
                pose.

        Example:
            >>> import numpy as np
            >>> import orthocas as oc
            >>> robot = oc.problems.get("iiwa").robot
            >>> q = np.array([0.1, 0.5, 0.0, -1.2, 0.0, 0.6, 0.0])
            >>> task = oc.Task.pose(robot, reference=robot.tip_rotation(q))
            >>> bool(np.allclose(task.target(robot.pose(q)), task(q)))
            True
        """
        rows = pose if isinstance(pose, list | tuple) and len(pose) else [pose]
        if all(hasattr(row, "translation") and hasattr(row, "rotation") for row in rows):
            parts = np.array([row.translation for row in rows]), np.array([row.rotation for row in rows])
            x = self._value_of(*parts)
            return x[0] if rows[0] is pose else x
        pairs = isinstance(pose, list) and all(isinstance(row, tuple) and len(row) == 2 for row in rows)
        if pairs and all(np.ndim(row[0]) == 1 for row in rows):
            pose = tuple(np.array([as_float_array("target", row[k]) for row in pose]) for k in (0, 1))
        # Task values are one array; position and orientation are a pair of different shapes.
        if isinstance(pose, tuple) and len(pose) == 2:
            position, orientation = (as_float_array("target", part) for part in pose)
            if position.ndim > 1 or position.shape != orientation.shape:
                return self._value_of(position, orientation)
        values = as_float_array("target", pose)
        if values.shape[-2:] == (4, 4) and (values.ndim == 3 or self.m != 4):
            if np.abs(values[..., 3, :] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0) > 1e-9:
                raise InvalidValueError("target", values[..., 3, :].tolist(), "matrices with the last row (0, 0, 0, 1)")
            return self._value_of(values[..., :3, 3], values[..., :3, :3])
        # A rotation matrix here is most likely meant as an orientation, not as three rotation vectors.
        if values.shape == (3, 3) and self.turn is not None and np.abs(values @ values.T - np.eye(3)).max() < 1e-6:
            raise InvalidValueError(
                "target", values.tolist(), "task values or a pose; for a rotation matrix R use task.value(None, R)"
            )
        return values

    def _value_of(self, position: Array, orientation: Array) -> Array:
        """The task value of a pose, for tasks of a position or of a whole orientation."""
        if self.turn is None and self.recipe["kind"].startswith("position"):
            require_finite("position", position)
            return np.asarray(position[..., ["xyz".index(axis) for axis in self.labels]])
        return self.value(position if self._require_whole_turn().with_position else None, orientation)

    def orientation_of(self, x: ArrayLike) -> Array:
        """The tip's orientation in the world, (3, 3) or (N, 3, 3), at task values x (m,) or (N, m); see `value`."""
        self._require_whole_turn()
        values, single = as_point_set("x", x, self.m)
        R = self.reference @ build_rotations(Batched(self.quaternion_function)(values)[0])
        return np.asarray(R[0] if single else R)

    @cached_property
    def quaternion_function(self) -> ca.Function:
        """x (m, 1) -> quaternion (w, x, y, z) of the rotation from the reference to the tip, for whole orientations."""
        x = ca.SX.sym("x", self.m)
        return dense_function("quaternion", [x], [self._require_whole_turn().quaternion(x[self.m - 3 :])], ["x"])

    @cached_property
    def components_function(self) -> ca.Function:
        """Rotation from the reference to the tip (3, 3) -> components of the orientation (3, 1)."""
        R = ca.SX.sym("R", 3, 3)
        return dense_function("components", [R], [self._require_whole_turn().components(R, ca.SX.zeros(3))[-3:]], ["R"])

    @property
    def _has_rotation_vector(self) -> bool:
        return self.turn is not None and self.turn.whole and self.turn.axis is None

    def _build_quaternion(self, q: ca.SX) -> ca.SX:
        """Quaternion of the rotation from the reference to the tip, (4, 1)."""
        return find_quaternion(ca.SX(ca.DM(self.reference.T)) @ self._build_frame("rotation")(q))

    @property
    def _frames(self) -> Frames:
        return Frames.from_recipe(self.recipe)

    def _build_frame(self, quantity: FrameQuantity) -> ca.Function:
        """q (n, 1) -> position, rotation or geometric Jacobian of the frame that the task observes."""
        return self._frames.build_function(self.robot, quantity)

    def _require_whole_turn(self) -> TipTurn:
        if self.turn is None or not self.turn.whole:
            raise InvalidValueError("task", self.name, "one with a whole orientation, such as pose")
        return self.turn

    @property
    def reference(self) -> Array:
        """The reference orientation (3, 3): the given one, or the tip's orientation at the centre of the joint limits.

        Raises:
            InvalidValueError: if the task compares no orientation.
        """
        if self.turn is None:
            raise InvalidValueError("task", self.name, "one with an orientation")
        if "reference" in self.recipe:
            return np.array(self.recipe["reference"])
        return self._frames.evaluate_rotation(self.robot, self.robot.tree.centre_posture)

    @cached_property
    def smooth_function(self) -> ca.Function:
        """q (n, 1) -> x (m, 1) for differentiation: without case distinctions, but inaccurate near half a turn."""
        turn = self.turn
        if self.parts:
            return _stack_functions(self.parts, "smooth_function")
        if turn is None:
            return self.function
        # Orientation components by the formula without case distinctions.
        q = ca.SX.sym("q", self.robot.n)
        rotation, position = self._build_frame("rotation")(q), self._build_frame("position")(q)
        x = turn.components(ca.SX(ca.DM(self.reference.T)) @ rotation, position, True)
        return dense_function("h", [q], [x])

    @classmethod
    def _build_turned(cls, robot: Robot, turn: TipTurn, reference: ArrayLike | None, frames: Frames = _OF_TIP) -> Self:
        """A task of a frame's rotation relative to a reference (3, 3), or to the default one if it is None."""
        require_kind("robot", robot, Robot)
        if reference is None:
            base, extra = frames.evaluate_rotation(robot, robot.tree.centre_posture), {}
        else:
            base = rotation_matrix("reference", reference)
            extra = {"reference": base.tolist()}
        across = ca.SX(ca.DM(base.T))
        return cls._build_of_pose(
            robot, turn.kind, turn.labels, turn.units, lambda R, p: turn.components(across @ R, p), extra, frames
        )

    @classmethod
    def _build_of_pose(
        cls,
        robot: Robot,
        kind: str,
        labels: tuple[str, ...],
        units: tuple[str, ...],
        components: Callable[[ca.SX, ca.SX], ca.SX],
        extra: Mapping[str, Any] | None = None,
        frames: Frames = _OF_TIP,
    ) -> Self:
        """A task that is a function of a frame's rotation and position."""
        require_kind("robot", robot, Robot)
        q = ca.SX.sym("q", robot.n)
        x = components(frames.build_function(robot, "rotation")(q), frames.build_function(robot, "position")(q))
        recipe = {"kind": kind, **frames.recipe, **(extra or {})}
        return cls(robot, kind + frames.suffix, labels, units, dense_function("h", [q], [x]), recipe)


def _find_rows(axes: str) -> list[int]:
    """Indices of different letters of "xyz".

    Raises:
        InvalidValueError: if the argument is anything else.
    """
    require_kind("axes", axes, str)
    if not axes or len(set(axes)) != len(axes) or set(axes) - set("xyz"):
        raise InvalidValueError("axes", repr(axes), "different letters of 'xyz'")
    return ["xyz".index(a) for a in axes]


def _stack_functions(tasks: Sequence[Task], name: str) -> ca.Function:
    """Stack a function of q (n, 1) that each task has."""
    q = ca.SX.sym("q", tasks[0].robot.n)
    return dense_function("h", [q], [ca.vertcat(*(getattr(task, name)(q) for task in tasks))])


def _find_independent_frames(tasks: Sequence[Task]) -> list[tuple[Task, Frames]]:
    """Choose for each task the frames whose rows to use next to those of the other tasks.

    If a task gives the whole pose of one frame relative to another, and the pose of one of them is known, then the pose
    of the other in the world is known too. The same holds for observations from a frame with a known pose.
    """
    # Mark the second frame of a pose as known once its first one is, until nothing changes.
    stands: dict[int, Frames] = {}
    settled: set[str | None] = {None}  #: frames with a known pose; None: the world
    poses = [task for task in tasks if task.turn is not None and task.turn.whole and task.turn.with_position]
    for _ in poses:
        for task in poses:
            ends = task._frames.relative_to, task._frames.frame or task.robot.tree.tip_name
            new = [end for end in ends if end not in settled]
            if len(new) == 1:
                stands[id(task)] = Frames(new[0])
                settled.add(new[0])
    # Observations from a known frame are equivalent to observations from the world.
    seen = {id(task): Frames(task._frames.frame) for task in tasks if task._frames.relative_to in settled}
    return [(task, stands.get(id(task), seen.get(id(task), task._frames))) for task in tasks]


def _read_rotations(name: str, value: ArrayLike) -> tuple[Array, bool]:
    """Rotation matrices (N, 3, 3) from matrices or unit quaternions, and whether there was only one."""
    values = as_float_array(name, value)
    require_finite(name, values)
    single = values.shape in ((4,), (3, 3))
    if not single and values.shape[1:] not in ((4,), (3, 3)):
        raise InvalidValueError(f"shape of {name}", values.shape, "(3, 3), (N, 3, 3), (4,) or (N, 4)")
    rows = values[None] if single else values
    # Quaternions must have length 1 up to rounding, and are normalised.
    if rows.ndim == 2:
        off = np.abs(np.linalg.norm(rows, axis=1) - 1)
        if len(rows) and off.max() > 1e-6:
            raise InvalidValueError(name, rows[off.argmax()].tolist(), "a quaternion (w, x, y, z) of length 1")
        return build_rotations(rows / np.linalg.norm(rows, axis=1, keepdims=True)), single
    return np.array([rotation_matrix(name, R) for R in rows]).reshape(-1, 3, 3), single


_REGISTERED: dict[str, Callable[[Robot, str], Task]] = {
    "polar": lambda robot, _: Task.polar(robot),
    "centre_of_mass": lambda robot, axes: Task.centre_of_mass(robot, axes or "xyz"),
}


def list_task_kinds() -> tuple[str, ...]:
    """The short names of tasks, including those of `register_task`."""
    return tuple(dict.fromkeys((*TASK_KINDS, *_REGISTERED)))


def register_task(name: str, build: Callable[[Robot, str], Task]) -> None:
    """Let `Task.named` and the option --task build a task of your own. Files need no registration.

    Args:
        name: a short name without a colon.
        build: makes the task from a robot and the text after the colon in "name:text", "" without a colon.

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
    taken = name in TASK_KINDS or TipTurn.from_kind(name) is not None or _REGISTERED.get(name, build) is not build
    if ":" in name or taken:
        raise InvalidValueError("name", repr(name), "a free name without a colon")
    if not callable(build):
        raise InvalidValueError("build", repr(build)[:80], "a function of a robot and a text")
    _REGISTERED[name] = build
