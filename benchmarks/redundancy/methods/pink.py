"""pink: one quadratic program per tick, with a posture task of three costs."""

from collections.abc import Sequence
from contextlib import suppress

import pink

from orthocas.tools.checks import Array
from redundancy.arms import TICK, TIP, Arm
from redundancy.protocol import Target


class Pink:
    """A frame task, a posture task, limits of positions and velocities, DAQP. Without a solution it holds still."""

    name = "pink, posture 0"
    packages = ("pin-pink", "daqp")
    grid = ({"lm_damping": 0.0}, {"lm_damping": 1e-2}, {"lm_damping": 1.0})
    cost = 0.0

    def __init__(self, arm: Arm, lm_damping: float) -> None:
        self.arm = arm
        self.frame = pink.tasks.FrameTask(TIP, position_cost=1.0, orientation_cost=1.0, lm_damping=lm_damping)
        self.posture = pink.tasks.PostureTask(cost=self.cost)
        self.tasks = [self.frame, self.posture] if self.cost else [self.frame]

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        self.configuration = pink.Configuration(self.arm.model, self.arm.model.createData(), q.copy())

    def step(self, target: Target) -> Array:
        """Solve and integrate."""
        self.frame.set_target(target.placement)
        self.posture.set_target(target.posture)
        with suppress(pink.exceptions.NoSolutionFound):
            velocity = pink.solve_ik(self.configuration, self.tasks, TICK, "daqp", safety_break=False)
            self.configuration.integrate_inplace(velocity, TICK)
        return self.configuration.q.copy()


class PinkSlightPosture(Pink):
    """With a small cost."""

    name, cost = "pink, posture 1e-3", 1e-3


class PinkPosture(Pink):
    """With a larger one."""

    name, cost = "pink, posture 1e-2", 1e-2


METHODS = (Pink, PinkSlightPosture, PinkPosture)
