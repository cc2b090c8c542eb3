"""A MuJoCo environment for actions."""

from typing import Any

import gymnasium
import mujoco
import numpy as np

import orthocas as oc
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array


class Arm(gymnasium.Env[Array, Array]):
    """A small MuJoCo environment whose actions are joint positions, reached at once."""

    def __init__(self, chart: oc.Chart) -> None:
        self.model = MuJoCoPlant(chart.problem.robot).model
        self.data, self.home, n = mujoco.MjData(self.model), chart.problem.domain.centre, chart.n
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float64)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.data.qpos[:] = self.home
        return self._tip(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        self.data.qpos[:] = action
        return self._tip(), 0.0, False, False, {}

    def _tip(self) -> Array:
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.body("tip").xpos.copy()
