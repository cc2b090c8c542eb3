"""The textbook's torque law: operational space with a posture in its null space, on an arm in MuJoCo at 1 kHz."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import pinocchio as pin

from orthocas.errors import SimulationError
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.protocol import Target

CALLS = 10  # in a tick


class OperationalSpace:
    """tau = J^T Lambda (a - dJ dq) + (I - J^T Jbar^T) M (k_p e_q - k_d dq) + C dq + g, damping ratio 0.7.

    The target moves straight from tick to tick, with feed-forward of its velocity. The arm's joints have stops. Where
    the simulation fails, the arm stays.
    """

    name = "operational space"
    packages = ("mujoco", "pin")
    grid = ({"frequency": 6.0}, {"frequency": 3.0}, {"frequency": 10.0})

    def __init__(self, arm: Arm, frequency: float) -> None:
        self.arm, self.plant = arm, MuJoCoPlant(arm.robot)
        omega = 2 * np.pi * frequency
        self.stiffness, self.damping = omega**2, 1.4 * omega

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at rest at q."""
        self.plant.reset(q)
        self.q, self.last = q.copy(), self.arm.placement(q)

    def step(self, target: Target) -> Array:
        """Simulate ten milliseconds."""
        turn = pin.log3(target.placement.rotation @ self.last.rotation.T)
        rate = np.concatenate([target.placement.translation - self.last.translation, turn]) / TICK
        with suppress(SimulationError, np.linalg.LinAlgError):
            for k in range(1, CALLS + 1):
                s = k / CALLS * TICK
                wanted = pin.SE3(pin.exp3(s * rate[3:]) @ self.last.rotation, self.last.translation + s * rate[:3])
                self.plant.step(self._torque(wanted, rate, target.posture), TICK / CALLS)
            self.q = np.array(self.plant.q)
        self.last = target.placement
        return self.q

    def _torque(self, wanted: pin.SE3, rate: Array, posture: Array) -> Array:
        q, dq, model, data = np.array(self.plant.q), np.array(self.plant.dq), self.arm.model, self.arm.data
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        M, bias = pin.crba(model, data, q), pin.nonLinearEffects(model, data, q, dq)
        pin.forwardKinematics(model, data, q, dq, 0 * dq)
        drift = pin.getFrameClassicalAcceleration(model, data, self.arm.frame, axes).vector
        J = self.arm.jacobian(q)
        dual = np.linalg.solve(M, J.T)
        inertia = np.linalg.inv(J @ dual)
        acceleration = self.damping * (rate - J @ dq) + self.stiffness * self.arm.error(q, wanted)
        force = M @ (self.stiffness * (posture - q) - self.damping * dq)
        return J.T @ (inertia @ (acceleration - drift - dual.T @ force)) + force + bias


METHODS = (OperationalSpace,)
