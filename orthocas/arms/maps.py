"""Data of robot and task that all parts of an arm need, built on first use, and a reader of task values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.arms.kernel import Curve, CurveKernel, StoredPostures, build_equations
from orthocas.charts.walls import Stop
from orthocas.errors import InvalidValueError, SingularTaskError
from orthocas.robots.robot import Robot
from orthocas.tasks.branches import Branch, branches
from orthocas.tasks.domains import Box, StopKind
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.samples import sample_evenly
from orthocas.tasks.task import Frames, Task
from orthocas.tools.batch import Batched, dense_function, use_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array


@dataclass(frozen=True, slots=True)
class MapRules:
    """Numbers of scales and stored postures."""

    scaled: int = 2000  #: postures from which the lengths of rows of J are taken
    stored: int = 20_000  #: postures from which searches start
    seed: int = 0  #: random seed of these postures
    least_volume: float = 1e-12  #: smallest det(J J^T) that is used in a weight; smaller values are raised to it
    shifted: int = 16  #: postures at which the shift of x by a rail is compared
    same: float = 1e-9  #: largest difference of such shifts that counts as none [m], for a metre of the rail
    no_rotation: float = 1e-8  #: sum of squares above that of rotations: vectors longer than half a turn by 1e-9


RULES = MapRules()


@dataclass(frozen=True, eq=False)
class ArmMaps:
    """Kernel, readers and stored postures of a task with r = 1. Threads may share it; pickles hold the task only."""

    task: Task

    @property
    def robot(self) -> Robot:
        """The robot of the task."""
        return self.task.robot

    @cached_property
    def scale(self) -> Array:
        """Divisors of the components of errors, (m,): 1 for angles, else how far a radian of a joint moves them."""
        # Lengths of the rows of J for revolute joints, at even postures; one for each unit, such as all positions.
        whole = find_joint_range(self.robot, 0)
        q = sample_evenly(Box(whole.centre, whole.half_width), RULES.scaled, 0)
        J = Batched(build_equations(self.task, np.ones(self.task.m)))(q, np.tile(self._some_target, (len(q), 1)))[1]
        lengths = (J.reshape(len(q), self.task.m, self.robot.n) ** 2)[:, :, self.turning].sum(axis=2)
        lengths = np.where(np.isfinite(lengths), lengths, 0.0)
        units = np.array(self.task.units)
        sizes = np.ones(self.task.m)
        for unit in set(self.task.units) - {"rad"}:
            own = units == unit
            sizes[own] = np.sqrt(lengths[:, own].mean() / max(1, int(self.turning.sum())) * 3) or 1.0
        return sizes

    @cached_property
    def equations(self) -> ca.Function:
        """q, target -> e and J: `orthocas.arms.kernel.build_equations`."""
        return build_equations(self.task, self.scale)

    @cached_property
    def target_function(self) -> ca.Function:
        """x (m, 1) -> target (k, 1), as `TargetReader.build`."""
        task, x = self.task, ca.SX.sym("x", self.task.m)
        if not self.turned:
            return dense_function("target", [x], [x], ["x"])
        # R(x) by Rodrigues' formula, R = 1 + 2 w [v] + 2 [v]^2, on the task's reference.
        w, *axis = ca.vertsplit(task.quaternion_function(x))
        cross = ca.skew(ca.vertcat(*axis))
        R = ca.SX(ca.DM(task.reference)) @ (ca.SX.eye(3) + 2 * (w * cross + cross @ cross))
        position = [x[:3]] if self.task.turn is not None and self.task.turn.with_position else []
        return dense_function("target", [x], [ca.vertcat(*position, ca.vec(R))], ["x"])

    @cached_property
    def place_sizes(self) -> Array:
        """A target divided by these is a place: distances of places are errors of x as in `equations`, (k,).

        A divisor is infinite if a rail without limits can correct that component at all postures.
        """
        sizes = self.scale
        if self.turned:
            # |R - S| / sqrt(2) is the angle between both, for small ones.
            position = self.scale[:3] if self.task.turn is not None and self.task.turn.with_position else np.zeros(0)
            sizes = np.concatenate([position, np.full(9, np.sqrt(2))])
        # A rail moves one component of the target, and at all postures alike.
        whole, sizes = find_joint_range(self.robot, 0), sizes.copy()
        q = sample_evenly(Box(whole.centre, whole.half_width), RULES.shifted, 0)
        for k in np.flatnonzero(~self.turning & np.isinf(self.robot.lower) & np.isinf(self.robot.upper)):
            shifts = self.targets_of(q + np.eye(self.robot.n)[k]) - self.targets_of(q)
            moved = np.flatnonzero(np.abs(shifts).max(axis=0) > RULES.same)
            if moved.size == 1 and np.ptp(shifts[:, moved]) < RULES.same:
                sizes[moved] = np.inf
        return sizes

    @cached_property
    def kernel(self) -> CurveKernel:
        """The search for curves."""
        return CurveKernel(self.equations, self.robot.lower, self.robot.upper, self.turning)

    @cached_property
    def stored(self) -> StoredPostures:
        """Random postures from which searches start."""
        # Others may wait for this value, so no other threads take part.
        with use_threads(1):
            robot, whole, rng = self.robot, find_joint_range(self.robot, 0), np.random.default_rng(RULES.seed)
            # `branches` may refuse small arms with slides as singular, but these arms still have curves.
            try:
                parts: Sequence[Branch] = branches(robot, self.task)
            except SingularTaskError:
                parts = ()
            low, high = whole.centre - whole.half_width, whole.centre + whole.half_width
            q = rng.uniform(low, high, (RULES.stored, robot.n))
            # Sort by branch; postures outside all branches come last.
            own = np.full(len(q), len(parts))
            for k, branch in enumerate(parts):
                own[np.asarray(branch.box.contains(q))] = k
            order = np.argsort(own, kind="stable")
            q, own = q[order], own[order]
            # Next to singular positions, x moves less for the same way of joints: distances there count more.
            J = self.evaluate(q, np.tile(self._some_target, (len(q), 1)))[1]
            volume = np.linalg.det(J @ J.transpose(0, 2, 1))
            if not parts and np.linalg.matrix_rank(J).max() < self.task.m:
                raise SingularTaskError("the task is singular at all postures, expected one that the joints can move")
            weights = np.maximum(volume, RULES.least_volume) ** (-1 / self.task.m)
            places = np.ascontiguousarray((self.targets_of(q) / self.place_sizes).T, dtype=np.float32)
        begins = np.flatnonzero(np.diff(own, prepend=-1, append=len(parts) + 1))
        return StoredPostures(q, places, weights.astype(np.float32), begins.astype(np.intc))

    @cached_property
    def targets(self) -> TargetReader:
        """Reads x."""
        return TargetReader(self.task)

    @cached_property
    def stops(self) -> tuple[tuple[Stop, Stop], ...]:
        """The stops of a motion at the lowest and the highest position of each joint."""
        robot = self.robot
        return tuple(
            (Stop(StopKind.JOINT, name, float(low), True), Stop(StopKind.JOINT, name, float(high), True))
            for name, low, high in zip(robot.joint_names, robot.lower, robot.upper, strict=True)
        )

    @cached_property
    def limits(self) -> tuple[tuple[float, float, bool], ...]:
        """The lowest and the highest position of each joint, and whether it turns."""
        robot = self.robot
        return tuple(zip(robot.lower.tolist(), robot.upper.tolist(), self.turning.tolist(), strict=True))

    @property
    def turning(self) -> NDArray[np.bool_]:
        """Revolute joints, (n,)."""
        return ~np.array(self.robot.tree.prismatic)

    def find_curves(self, target: Array, *starts: Array) -> list[Curve]:
        """The curves of a target (k,), from given starts (S, n) and from stored postures."""
        near = self.kernel.choose_starts(self.stored, target / self.place_sizes)
        return self.kernel.find_curves(target, np.ascontiguousarray(np.vstack([*starts, near])))

    def choose_postures(self, targets: Array, starts: Array | None) -> Array:
        """Postures (N, n) of targets (N, k), as `CurveKernel.choose_postures` finds them."""
        return self.kernel.choose_postures(targets, starts, self.stored, targets / self.place_sizes)

    def evaluate(self, q: Array, targets: Array) -> tuple[Array, Array]:
        """Errors e (N, m) and rates J (N, m, n) of postures (N, n) and targets (N, k)."""
        e, J = self._batched_equations(q, targets)
        return e.reshape(len(q), -1), J.reshape(len(q), self.task.m, -1)

    def targets_of(self, q: Array) -> Array:
        """Targets (N, k) that postures (N, n) meet."""
        task = self.task
        if not self.turned:
            return np.ascontiguousarray(task.batched(q)[0])
        frames = Frames.from_recipe(task.recipe)
        frame = task.robot.tree.tip_name if frames.frame is None else frames.frame
        R = np.asarray(task.robot.frame_rotation(q, frame, frames.relative_to)).reshape(-1, 3, 3)
        parts = [R.transpose(0, 2, 1).reshape(-1, 9)]
        if task.turn is not None and task.turn.with_position:
            parts.insert(0, np.asarray(task.robot.frame_position(q, frame, frames.relative_to)).reshape(-1, 3))
        return np.hstack(parts)

    @property
    def turned(self) -> bool:
        """Whether x holds a whole orientation."""
        return self.task.turn is not None and self.task.turn.whole

    @cached_property
    def _batched_equations(self) -> Batched:
        return Batched(self.equations)

    @property
    def _some_target(self) -> Array:
        turn = self.task.turn
        if turn is None or not turn.whole:
            return np.zeros(self.task.m)
        return np.concatenate([np.zeros(3 if turn.with_position else 0), np.eye(3).ravel()])


@dataclass(frozen=True, eq=False)
class TargetReader:
    """Reads values of x of a task, and turns them into targets of `orthocas.arms.kernel.build_equations`."""

    task: Task

    def read(self, x: Any) -> tuple[Array, bool]:
        """Targets (N, k) of what `Task.target` takes, and whether it is one value. Rows of vectors need not be finite.

        A single pose with NaN is a target of NaN.

        Raises:
            ShapeError, InvalidValueError: if x is not a value of the task.
        """
        m = self.task.m
        # A broken sensor may send poses with NaN. They become targets that trackers answer with BAD_INPUT.
        try:
            values = self.task.target(x)
        except InvalidValueError:
            if not _is_pose_with_nan(x):
                raise
            values = np.full(m, np.nan)
        if values.ndim not in (1, 2) or values.shape[-1] != m:
            raise InvalidValueError("x", f"an array of shape {values.shape}", f"({m},), (N, {m}), or poses of the task")
        return self.build(values.reshape(-1, m)), values.ndim == 1

    def build(self, vectors: Array) -> Array:
        """Targets (N, k) of vectors (N, m), finite or not."""
        turn = self.task.turn
        if turn is None or not turn.whole:
            return np.ascontiguousarray(vectors)
        # Rows that are not finite have no rotation; they stay NaN.
        good = np.asarray(np.isfinite(vectors).all(axis=1))
        targets = np.full((len(vectors), 12 if turn.with_position else 9), np.nan)
        if good.any():
            R = np.asarray(self.task.orientation_of(vectors[good]))
            targets[good, -9:] = R.transpose(0, 2, 1).reshape(-1, 9)
            if turn.with_position:
                targets[good, :3] = vectors[good, :3]
        return targets

    def lack_rotation(self, targets: Array) -> NDArray[np.bool_]:
        """Whether each target (N, k) comes from a vector beyond half a turn, which no rotation has, (N,)."""
        turn = self.task.turn
        if turn is None or not turn.whole:
            return np.zeros(len(targets), dtype=bool)
        # Beyond half a turn, Rodrigues' formula gives no rotation, but a matrix with a larger sum of squares.
        return np.asarray((targets[:, -9:] ** 2).sum(axis=1) > 3 + RULES.no_rotation)

    def vector(self, targets: Array) -> Array:
        """Targets (N, k) as vectors of x (N, m); NaN where a target is NaN."""
        turn = self.task.turn
        if turn is None or not turn.whole:
            return targets
        values = np.full((len(targets), self.task.m), np.nan)
        good = np.isfinite(targets).all(axis=1)
        if good.any():
            R = targets[good, -9:].reshape(-1, 3, 3).transpose(0, 2, 1)
            values[good] = self.task.value(targets[good, :3] if turn.with_position else None, R)
        return values


def _is_pose_with_nan(x: Any) -> bool:
    """Whether x is one pose with a number that is not finite."""
    parts = (x.translation, x.rotation) if hasattr(x, "rotation") and hasattr(x, "translation") else x
    parts = parts if isinstance(parts, tuple) and len(parts) == 2 else (parts,)
    try:
        arrays = [as_float_array("x", part) for part in parts]
    except InvalidValueError:
        return False
    shapes = [array.shape for array in arrays]
    whole = shapes in ([(4, 4)], [(3,), (4,)], [(3,), (3, 3)])
    return whole and not all(np.isfinite(array).all() for array in arrays)
