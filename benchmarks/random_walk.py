"""A random walk of actions in (x, xi) through a wide chart: how many steps break a joint limit, and what a step takes.

Steps are correlated, up to 0.02 in every component of phi, and reach the boundaries again and again. One arm goes by
`PhiActions`, which slides along boundaries; 4,000 arms at once by the exported module of JAX, if that is installed,
with few steps of Newton's method. Where it finds nothing inside, the arm stays. `--quick` takes 2,000 steps, 50 arms.
"""

import importlib.util
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from batches import exported
from benchmark import run

import orthocas as oc
from orthocas.charts.trackers import TrackerStatus
from orthocas.learn import PhiActions
from orthocas.tools.checks import Array

STEPS, STEP, KEPT = 20_000, 0.02, 0.95
ARMS, TIMES, NEWTON = 4_000, 250, 3


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


def one_arm(chart: oc.Chart, steps: int) -> tuple[int, int, float, float]:
    """Steps beyond joint limits, those that led out of the domain, seconds by the clock, and of the processor."""
    env, rng = PhiActions(Still(chart), chart, STEP), np.random.default_rng(3)
    env.reset()
    q, cut, drift = np.empty((steps, chart.n)), 0, rng.normal(size=chart.n)
    start = time.perf_counter(), time.process_time()
    for k in range(steps):
        drift = KEPT * drift + rng.normal(size=chart.n)
        *_, info = env.step(np.clip(drift, -1, 1))
        q[k] = env.unwrapped.data.qpos  # type: ignore[attr-defined]
        cut += info["tracker"] != TrackerStatus.OK
    wall, cpu, robot = time.perf_counter() - start[0], time.process_time() - start[1], chart.problem.robot
    return int(((q < robot.lower) | (q > robot.upper)).any(axis=1).sum()), cut, wall, cpu


def many_arms(chart: oc.Chart, arms: int, times: int) -> tuple[int, int, float, float]:
    """The same for arms times steps, in one compiled loop."""
    jax: Any = importlib.import_module("jax")
    jax.config.update("jax_enable_x64", True)
    jnp, robot = jax.numpy, chart.problem.robot
    with TemporaryDirectory() as folder:
        module = exported(chart, "jax", Path(folder))
    module.STEPS, module.LAST_ROUNDS = NEWTON, 1  # type: ignore[attr-defined]  # short steps, without derivatives

    def step(state: Any, key: Any) -> tuple[Any, Any]:
        q, drift = state
        drift = KEPT * drift + jax.random.normal(key, q.shape)
        found, status = module.inverse(module.phi(q) + STEP * jnp.clip(drift, -1, 1), q)
        q = jnp.where((status == module.FOUND)[:, None], found, q)
        return (q, drift), (((q < robot.lower) | (q > robot.upper)).any(1).sum(), (status != module.FOUND).sum())

    walk = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys)[1])
    home = jnp.tile(jnp.asarray(chart.problem.domain.centre), (arms, 1))
    state, keys = (home, jax.random.normal(jax.random.key(1), home.shape)), jax.random.split(jax.random.key(3), times)
    jax.block_until_ready(walk(state, keys))
    start = time.perf_counter(), time.process_time()
    broken, cut = (int(part.sum()) for part in jax.block_until_ready(walk(state, keys)))
    return broken, cut, time.perf_counter() - start[0], time.process_time() - start[1]


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    chart, found = oc.charts.load("panda-wide"), {}
    steps, arms, times = (1_000, 50, 2) if quick else (STEPS, ARMS, TIMES)
    cases = {"one arm": (steps, lambda: one_arm(chart, steps))}
    if importlib.util.find_spec("jax") is not None:
        cases["many arms, JAX"] = arms * times, lambda: many_arms(chart, arms, times)
    header = "| walk | steps | beyond joint limits | led out [%] | time of a step [us] | time of a core [us] |"
    print(f"{header}\n| --- | --- | --- | --- | --- | --- |")
    for name, (count, walked) in cases.items():
        broken, cut, wall, cpu = walked()
        share, each = 100 * cut / count, (wall / count * 1e6, cpu / count * 1e6)
        print(f"| {name} | {count} | {broken} | {share:.1f} | {each[0]:.0f} | {each[1]:.0f} |", flush=True)
        found |= {f"{name}, beyond joint limits": broken, f"{name}, led out [%]": share, f"{name}, time [us]": each[0]}
    return found


if __name__ == "__main__":
    run(main, __doc__)
