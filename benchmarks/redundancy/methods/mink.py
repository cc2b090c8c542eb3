"""mink: the same with MuJoCo's kinematics."""

from collections.abc import Sequence
from contextlib import suppress

import mink
import numpy as np

from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.protocol import Target


class Mink:
    """A frame task, a posture task, limits of positions and velocities, DAQP. Without a solution it holds still."""

    name = "mink, posture 0"
    packages = ("mink", "daqp", "mujoco")
    grid = ({"lm_damping": 1.0}, {"lm_damping": 1e-2}, {"lm_damping": 0.0})
    cost = 0.0

    def __init__(self, arm: Arm, lm_damping: float) -> None:
        self.model = MuJoCoPlant(arm.robot).model
        self.frame = mink.FrameTask("tip", "body", position_cost=1.0, orientation_cost=1.0, lm_damping=lm_damping)
        self.posture = mink.PostureTask(self.model, cost=self.cost)
        self.tasks = [self.frame, self.posture] if self.cost else [self.frame]
        fastest = {name: limit for name, limit in zip(arm.joints, arm.fastest, strict=True) if np.isfinite(limit)}
        self.limits = [mink.ConfigurationLimit(self.model), mink.VelocityLimit(self.model, fastest)]

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        self.configuration = mink.Configuration(self.model, q.copy())

    def step(self, target: Target) -> Array:
        """Solve and integrate."""
        self.frame.set_target(mink.SE3.from_matrix(target.placement.homogeneous))
        self.posture.set_target(target.posture)
        with suppress(mink.NoSolutionFound):
            velocity = mink.solve_ik(self.configuration, self.tasks, TICK, "daqp", limits=self.limits)
            self.configuration.integrate_inplace(velocity, TICK)
        return np.array(self.configuration.q)


class MinkSlightPosture(Mink):
    """With a small cost."""

    name, cost = "mink, posture 1e-3", 1e-3


class MinkPosture(Mink):
    """With a larger one."""

    name, cost = "mink, posture 1e-2", 1e-2


METHODS = (Mink, MinkSlightPosture, MinkPosture)
