"""What tests of supervised laws share: an arm, and runs of it."""

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np

import orthocas as oc
from orthocas.codegen import Supervisor
from orthocas.control import ControlStatus
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array

TICK = 1e-3


def at_rest(chart: oc.Chart, q: Array) -> Array:
    return np.concatenate([chart.phi(q), np.zeros(2 * chart.n)])


def moving(chart: oc.Chart, q: Array, dq: Array) -> Array:
    """The reference of a joint motion without acceleration."""
    curvature = chart.function("second_derivative")(q, dq, dq).full().ravel()
    return np.concatenate([chart.phi(q), chart.jacobian(q) @ dq, curvature])


@cache
def _moved(robot: oc.Robot, steps: int) -> Batched:
    """q, dq, torque, length of a step -> q, dq after so many steps, in one call."""
    q, dq, torque, h = (ca.MX.sym(name, size) for name, size in zip("qvuh", (*[robot.n] * 3, 1), strict=True))
    after, speed = q, dq
    for _ in range(steps):
        speed = speed + h * robot.forward_dynamics(after + h / 2 * speed, speed, torque)
        after = after + h * speed
    return Batched(ca.Function("moved", [q, dq, torque, h], [after, speed]))


class Arm:
    """The rigid body dynamics, integrated in small steps."""

    def __init__(self, robot: oc.Robot, q: Array, dq: Array | None = None) -> None:
        self.robot, self.q, self.dq = robot, q.copy(), np.zeros(robot.n) if dq is None else dq.copy()

    def move(self, torque: Array, seconds: float = TICK, steps: int = 2) -> None:
        state = (self.q, self.dq, torque, np.array([seconds / steps]))
        self.q, self.dq = (part[0] for part in _moved(self.robot, steps)(*(value[None] for value in state)))


def run(
    supervisor: Supervisor,
    arm: Arm,
    reference: Array,
    seconds: float,
    load: Callable[[float], Array] | None = None,
) -> tuple[list[ControlStatus], Array, Array]:
    """Statuses, commands and speeds of a run."""
    statuses, commands, speeds = [], [], []
    for k in range(round(seconds / TICK)):
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command + (0 if load is None else load(k * TICK)))
        statuses.append(status)
        commands.append(command)
        speeds.append(np.abs(arm.dq).max())
    return statuses, np.array(commands), np.array(speeds)
