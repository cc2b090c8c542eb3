"""placo: quadratic programs in C++, with and without a joints task as posture."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import placo

from orthocas.tools.checks import Array
from redundancy.arms import TICK, TIP, Arm
from redundancy.protocol import Target


class Placo:
    """A frame task of weight 1, a regularization task, limits of positions and velocities."""

    name = "placo, posture 0"
    packages = ("placo",)
    grid = ({"regularization": 1e-6}, {"regularization": 1e-5}, {"regularization": 1e-4})
    weight = 0.0

    def __init__(self, arm: Arm, regularization: float) -> None:
        self.arm = arm
        with TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(arm.file)
            self.robot = placo.RobotWrapper(str(path), placo.Flags.ignore_collisions)
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.mask_fbase(True)
        self.solver.dt = TICK
        self.solver.enable_velocity_limits(True)
        self.frame = self.solver.add_frame_task(TIP, np.eye(4))
        self.frame.configure(TIP, "soft", 1.0, 1.0)
        self.solver.add_regularization_task(regularization)
        if self.weight:
            self.posture = self.solver.add_joints_task()
            self.posture.configure("posture", "soft", self.weight)

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        for joint, value in zip(self.arm.joints, q, strict=True):
            self.robot.set_joint(joint, value)
        self.robot.update_kinematics()

    def step(self, target: Target) -> Array:
        """Solve and integrate. Without a solution it holds still."""
        position, rotation = self.frame.position(), self.frame.orientation()
        position.target_world, rotation.R_world_frame = target.placement.translation, target.placement.rotation
        if self.weight:
            self.posture.set_joints(dict(zip(self.arm.joints, target.posture.tolist(), strict=True)))
        with suppress(RuntimeError):
            self.solver.solve(True)
            self.robot.update_kinematics()
        return np.array([self.robot.get_joint(joint) for joint in self.arm.joints])


class PlacoPosture(Placo):
    """With a joints task; its weight is the square of a cost of 1e-3."""

    name, weight = "placo, posture 1e-6", 1e-6


METHODS = (Placo, PlacoPosture)
