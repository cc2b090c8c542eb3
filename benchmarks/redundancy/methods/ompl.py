"""OMPL: plans a self-motion to a wished posture on the constraint that the tool stays, and plays it."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from ompl import base, geometric, util

from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.protocol import Target, Unsuited

LIMIT, CLOSE = 1.0, 1e-4  # for a plan [s]; of the constraint [m], [rad]


class OMPL:
    """RRT-Connect in the atlas state space. Where there is no plan in time, the arm stays."""

    name = "OMPL, atlas states"
    packages = ("ompl",)
    grid = ({"delta": 0.05}, {"delta": 0.02}, {"delta": 0.1})

    def __init__(self, arm: Arm, delta: float) -> None:
        if arm.mobile:
            raise Unsuited("plans self-motions of a tool at rest")
        util.setLogLevel(util.LogLevel.LOG_NONE)
        util.RNG.setSeed(1)
        self.arm, self.delta = arm, delta
        self.bounds = base.RealVectorBounds(arm.n)
        for i in np.arange(arm.n).tolist():
            self.bounds.setLow(i, float(arm.lower[i]))
            self.bounds.setHigh(i, float(arm.upper[i]))

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q, whose tool is to stay."""
        self.q, self.placement = q.copy(), self.arm.placement(q)
        self.posture: Array | None = None
        self.way: list[Array] = []

    def step(self, target: Target) -> Array:
        """Plan if the posture is new, and go on along the plan."""
        if np.abs(self.arm.error(self.arm.home, target.placement)).max() > CLOSE:
            raise Unsuited("plans self-motions of a tool at rest")
        if target.posture is not self.posture and (self.posture is None or (target.posture != self.posture).any()):
            self.way = self._planned(target.posture)
        self.posture = target.posture
        time = TICK
        while self.way and time > 0:
            needed = float((np.abs(self.way[0] - self.q) / self.arm.fastest).max())
            share = 1.0 if needed <= time else time / needed
            self.q = self.q + share * (self.way[0] - self.q)
            time -= needed
            if share == 1.0:
                self.way.pop(0)
        return self.q

    def _planned(self, goal: Array) -> list[Array]:
        """States of a plan, or none."""
        space = base.RealVectorStateSpace(self.arm.n)
        space.setBounds(self.bounds)
        self.constraint = _ToolStays(self.arm, self.placement)
        constrained = base.AtlasStateSpace(space, self.constraint)
        setup = geometric.SimpleSetup(base.ConstrainedSpaceInformation(constrained))
        constrained.setDelta(self.delta)
        setup.setStateValidityChecker(lambda _: True)
        ends = [constrained.allocState(), constrained.allocState()]
        for state, q in zip(ends, (self.q, goal), strict=True):
            state.copy(q.tolist())
            constrained.anchorChart(state)
        setup.setStartAndGoalStates(*ends)
        setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
        setup.setup()
        setup.solve(LIMIT)
        if not setup.haveExactSolutionPath():
            return []
        setup.simplifySolution()
        path = setup.getSolutionPath()
        path.interpolate()
        return [np.array([state[i] for i in range(self.arm.n)]) for state in path.getStates()]


class _ToolStays(base.Constraint):  # type: ignore[misc]
    """The tip's error in the world's axes is 0."""

    def __init__(self, arm: Arm, placement: pin.SE3) -> None:
        super().__init__(arm.n, 6, CLOSE)
        self.arm, self.placement = arm, placement

    def function(self, q: Array, out: Array) -> None:
        """The residual."""
        out[:] = -self.arm.error(np.array(q), self.placement)

    def jacobian(self, q: Array, out: Array) -> None:
        """Of the residual, near enough to it."""
        out[:, :] = self.arm.jacobian(np.array(q))


METHODS = (OMPL,)
