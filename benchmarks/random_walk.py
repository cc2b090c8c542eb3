"""A random walk of actions in (x, xi) through a wide chart: how many steps break a joint limit, and what a step takes.

Steps are correlated, up to 0.02 in every component of phi, and reach the boundaries again and again. `--quick` takes
2,000 steps.
"""

import time
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from benchmark import run

import orthocas as oc
from orthocas.charts.solutions import TrackerStatus
from orthocas.learn import PhiActions
from orthocas.tools.checks import Array

STEPS, STEP, KEPT = 200_000, 0.02, 0.95


class Still(gymnasium.Env[Array, Array]):
    """An environment without physics: joints are where the action says."""

    def __init__(self, chart: oc.Chart) -> None:
        self.data, self.home = SimpleNamespace(qpos=np.zeros(chart.n)), chart.problem.domain.centre
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (chart.n,), np.float64)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (0,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        """At the centre of the domain."""
        self.data.qpos = self.home.copy()
        return np.empty(0), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Go there."""
        self.data.qpos = action
        return np.empty(0), 0.0, False, False, {}


def main(quick: bool = False) -> dict[str, float]:
    """Print a row, and return its numbers."""
    chart, steps = oc.charts.load("panda-wide"), 2_000 if quick else STEPS
    env, rng = PhiActions(Still(chart), chart, STEP), np.random.default_rng(3)
    env.reset()
    q, refused, drift = np.empty((steps, chart.n)), 0, rng.normal(size=chart.n)
    start = time.perf_counter()
    for k in range(steps):
        drift = KEPT * drift + rng.normal(size=chart.n)
        *_, info = env.step(np.clip(drift, -1, 1))
        q[k] = env.unwrapped.data.qpos  # type: ignore[attr-defined]
        refused += info["tracker"] != TrackerStatus.OK
    seconds, robot = time.perf_counter() - start, chart.problem.robot
    broken = int(((q < robot.lower) | (q > robot.upper)).any(axis=1).sum())
    print("| steps | beyond joint limits | refused [%] | time of a step [us] |\n| --- | --- | --- | --- |")
    print(f"| {steps} | {broken} | {100 * refused / steps:.1f} | {seconds / steps * 1e6:.0f} |")
    return {"beyond joint limits": broken, "refused [%]": 100 * refused / steps, "time [us]": seconds / steps * 1e6}


if __name__ == "__main__":
    run(main, __doc__)
