"""Arms with a chart and a model for peers, and what is wanted of their tools: circles, self-motion, lines."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from default_gains import problem_of, robot_file

import orthocas as oc
from orthocas.tools.checks import Array

TICK = 0.01  # [s]
RADIUS, PERIOD = 0.08, 2.0  # of the circle [m], [s]
MOVE, MOVE_TIME = 0.3, 4.0  # of the first extra coordinate: largest joint motion [rad], there and back [s]
LENGTH, LINE_TIME = 0.6, 4.0  # of a line [m], there and back [s]


@dataclass(frozen=True)
class Target:
    """What is wanted at a tick, in the words of every method."""

    x: Array  #: task value (m,)
    placement: pin.SE3  #: of the tool; only its position counts for a position task
    posture: Array  #: (n,): charts hold its coordinates


class Arm:
    """A chart, and its robot in Pinocchio."""

    def __init__(self, name: str, task: str) -> None:
        self.name, self.task = name, task
        self.chart = oc.fit(problem_of(name, task, "euclidean"), oc.Polynomial(3), weights=(1000, 30, 150, 1)).chart
        self.robot, self.domain = self.chart.problem.robot, self.chart.problem.domain
        self.home: Array = self.domain.centre
        with robot_file(name) as (path, self.tip, locked):
            self.file = Path(path).read_text()
            model = pin.buildModelFromUrdf(str(path))
        values = pin.neutral(model)
        for joint, value in locked.items():
            values[model.joints[model.getJointId(joint)].idx_q] = value
        idle = [i for i in range(1, model.njoints) if model.names[i] not in self.robot.joint_names]
        self.model = pin.buildReducedModel(model, idle, values)
        self.data, self.frame = self.model.createData(), self.model.getFrameId(self.tip)

    def placement(self, q: Array) -> pin.SE3:
        """Of the tool."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.frame].copy()

    def jacobian(self, q: Array) -> Array:
        """Of the tool, in the world's axes (m, n), linear rows first."""
        J = pin.computeFrameJacobian(self.model, self.data, q, self.frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        return np.asarray(J[: self.chart.m])

    def error(self, q: Array, wanted: pin.SE3) -> Array:
        """Position [m], and rotation [rad] for a pose, in the world's axes (m,)."""
        found = self.placement(q)
        turn = found.rotation @ pin.log3(found.rotation.T @ wanted.rotation)
        return np.concatenate([wanted.translation - found.translation, turn])[: self.chart.m]

    def target(self, q: Array, posture: Array | None = None, shift: Array | None = None) -> Target:
        """The tool as at q, or shifted (3,), and a posture; default q."""
        shift = np.zeros(3) if shift is None else shift
        placement, x = self.placement(q), self.chart.task(q)
        x[:3] += shift
        return Target(x, pin.SE3(placement.rotation, placement.translation + shift), q if posture is None else posture)


def smooth(share: Array) -> Array:
    """From 0 to 1 and back to 0, at rest at both ends and in the middle."""
    s = np.minimum(2 * share, 2 - 2 * share)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def circles(arm: Arm, count: int) -> list[Target]:
    """The tool follows a horizontal circle through where it is; the posture is that of the start."""
    angles = 2 * np.pi * TICK / PERIOD * np.arange(1, round(count * PERIOD / TICK) + 1)
    shifts = RADIUS * np.stack([np.cos(angles) - 1, np.sin(angles), 0 * angles], axis=1)
    return [arm.target(arm.home, shift=shift) for shift in shifts]


def self_motion(arm: Arm) -> list[Target]:
    """The tool rests, the first extra coordinate goes out and back."""
    chart, q, targets = arm.chart, arm.home, []
    size = MOVE / np.abs(np.linalg.inv(chart.jacobian(q))[:, chart.m]).max()
    for share in smooth(np.arange(TICK, MOVE_TIME, TICK) / MOVE_TIME):
        wanted = chart.phi(arm.home)
        wanted[chart.m] += share * size
        q = chart.inverse(wanted, q, outside=True)  # a target for all methods
        targets.append(arm.target(arm.home, posture=q))
    return [*targets, arm.target(arm.home)]


def lines(arm: Arm, count: int) -> Iterator[list[Target]]:
    """The tool goes out on a line and back, in random directions; the posture is that of the start."""
    directions = np.random.default_rng(5).standard_normal((count, 3))
    for direction in directions / np.linalg.norm(directions, axis=1)[:, None]:
        shares = smooth(np.arange(TICK, LINE_TIME, TICK) / LINE_TIME)
        yield [arm.target(arm.home, shift=LENGTH * share * direction) for share in shares]
