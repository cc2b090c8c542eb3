"""What every part of an arm needs of its robot and task, built on first use."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.arms.kernel import Curve, CurveKernel, build_equations
from orthocas.arms.stored import PlaceReader, StoredPostures
from orthocas.arms.targets import TargetReader
from orthocas.charts.self_motion import Stop
from orthocas.robots.robot import Robot
from orthocas.tasks.branches import branches
from orthocas.tasks.domains import Box, StopKind
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.samples import sample_evenly
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function, use_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

_SCALED = 2000  # postures from which the lengths of rows of J are taken


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
        """What components of errors are divided by, (m,): 1 for angles, else how far a joint moves them, per radian."""
        # Lengths of the rows of J for revolute joints, at even postures; one for each unit, such as all positions.
        whole = find_joint_range(self.robot, 0)
        q = sample_evenly(Box(whole.centre, whole.half_width), _SCALED, 0)
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
        if not self.places.turned:
            return dense_function("target", [x], [x], ["x"])
        # R(x) by Rodrigues' formula, R = 1 + 2 w [v] + 2 [v]^2, on the task's reference.
        w, *axis = ca.vertsplit(task.quaternion_function(x))
        cross = ca.skew(ca.vertcat(*axis))
        R = ca.SX(ca.DM(task.reference)) @ (ca.SX.eye(3) + 2 * (w * cross + cross @ cross))
        position = [x[:3]] if self.task.turn is not None and self.task.turn.with_position else []
        return dense_function("target", [x], [ca.vertcat(*position, ca.vec(R))], ["x"])

    @cached_property
    def place_scale(self) -> Array:
        """A place is a target times this, (k,)."""
        probe = np.ones(len(self._some_target))
        return np.asarray(self.places.of_targets(probe.copy()) / probe)

    @cached_property
    def kernel(self) -> CurveKernel:
        """The search for curves."""
        return CurveKernel(self.equations, self.robot.lower, self.robot.upper, self.turning)

    @cached_property
    def stored(self) -> StoredPostures:
        """Postures from which searches start."""
        # Others may wait for this value, so no other threads take part.
        with use_threads(1):
            return StoredPostures.build(self.places, self._evaluate_rates, branches(self.robot, self.task))

    @cached_property
    def places(self) -> PlaceReader:
        """Reads places of x."""
        return PlaceReader(self.task, self.scale)

    @cached_property
    def targets(self) -> TargetReader:
        """Reads x."""
        return TargetReader(self.task)

    @cached_property
    def stops(self) -> tuple[tuple[Stop, Stop], ...]:
        """What the lowest and the highest position of each joint is to a motion."""
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
        """The curves of a target (k,), from starts (S, n) of one's own and from stored postures."""
        near = self.kernel.choose_starts(self.stored, self.places.of_targets(target))
        return self.kernel.find_curves(target, np.ascontiguousarray(np.vstack([*starts, near])))

    def choose_postures(self, targets: Array, starts: Array | None) -> Array:
        """Postures (N, n) of targets (N, k), as of the kernel."""
        return self.kernel.choose_postures(targets, starts, self.stored, self.places.of_targets(targets))

    def evaluate(self, q: Array, targets: Array) -> tuple[Array, Array]:
        """Errors e (N, m) and rates J (N, m, n) of postures (N, n) and targets (N, k)."""
        e, J = self._batched_equations(q, targets)
        return e.reshape(len(q), -1), J.reshape(len(q), self.task.m, -1)

    def targets_of(self, q: Array) -> Array:
        """Targets (N, k) that postures (N, n) meet."""
        places = self.places
        if not places.turned:
            return np.ascontiguousarray(self.task.batched(q)[0])
        # Places are targets times `place_scale`, so back again.
        targets = places.of_postures(q) * np.sqrt(2)
        if targets.shape[1] > 9:
            targets[:, :3] *= self.scale[:3] / np.sqrt(2)
        return np.ascontiguousarray(targets)

    def _evaluate_rates(self, q: Array) -> Array:
        """J (N, m, n) of postures (N, n)."""
        return self.evaluate(q, np.tile(self._some_target, (len(q), 1)))[1]

    @cached_property
    def _batched_equations(self) -> Batched:
        return Batched(self.equations)

    @property
    def _some_target(self) -> Array:
        turn = self.task.turn
        if turn is None or not turn.whole:
            return np.zeros(self.task.m)
        return np.concatenate([np.zeros(3 if turn.with_position else 0), np.eye(3).ravel()])
