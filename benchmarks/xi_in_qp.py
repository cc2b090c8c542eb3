"""pink with a posture task or with `XiTask`: the tool follows a circle again and again; do the joints come back?

A tick of 10 ms is one quadratic program. The tool's task has the cost 1 per metre. For posture and xi at the same
costs: how far the joints are from home after every turn, the tool's largest error after the first turn, and the time
of a tick. `--quick` takes three turns.
"""

import time
from importlib import import_module
from typing import Any

import numpy as np
import pinocchio as pin
from benchmark import run
from default_gains import robot_file

import orthocas as oc
from orthocas.control import XiTask
from orthocas.tools.checks import Array

TURNS, TICKS, TICK, RADIUS = 20, 200, 0.01, 0.08
COSTS = (1e-3, 1e-2, 1e-1)


def model_of(robot: oc.Robot) -> tuple[pin.Model, str]:
    """Pinocchio's model of the arm without fingers, and the name of its tip."""
    with robot_file("panda") as (path, tip, _):
        model = pin.buildModelFromUrdf(str(path))
    idle = [k for k in range(1, model.njoints) if model.names[k] not in robot.joint_names]
    return pin.buildReducedModel(model, idle, pin.neutral(model)), tip


def followed(chart: oc.Chart, kind: str, cost: float, turns: int) -> tuple[float, float, float]:
    """Drift of the joints [rad], error of the tool [m], and seconds a tick."""
    pink: Any = import_module("pink")
    (model, tip), home = model_of(chart.problem.robot), chart.problem.domain.centre
    configuration = pink.Configuration(model, model.createData(), home)
    hand = pink.tasks.FrameTask(tip, position_cost=1.0, orientation_cost=0.0)
    tasks = [hand]
    if kind != "none":
        tasks.append(XiTask(chart, cost) if kind == "xi" else pink.tasks.PostureTask(cost=cost))
        tasks[-1].set_target_from_configuration(configuration)
    placement = configuration.get_transform_frame_to_world(tip).copy()
    drift, error, start = 0.0, 0.0, time.perf_counter()
    for tick in range(1, turns * TICKS + 1):
        angle = 2 * np.pi * tick / TICKS
        wanted = placement.translation + RADIUS * np.array([np.cos(angle) - 1, np.sin(angle), 0.0])
        hand.set_target(pin.SE3(placement.rotation, wanted))
        velocity = pink.solve_ik(configuration, tasks, TICK, "daqp", damping=1e-12)
        configuration.integrate_inplace(velocity, TICK)
        q: Array = np.array(configuration.q)
        if tick > TICKS:
            error = max(error, float(np.abs(chart.task(q) - wanted).max()))
        if tick % TICKS == 0:
            drift = max(drift, float(np.abs(q - home).max()))
    return drift, error, (time.perf_counter() - start) / (turns * TICKS)


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    chart, found = oc.charts.load("panda-position"), {}
    cases = [("none", 0.0), *((kind, cost) for kind in ("posture", "xi") for cost in COSTS)]
    header = "| second task | drift of the joints [rad] | error of the tool [m] | time of a tick [us] |"
    print(f"{header}\n| --- | --- | --- | --- |")
    for kind, cost in cases:
        drift, error, seconds = followed(chart, kind, cost, 3 if quick else TURNS)
        name = kind if kind == "none" else f"{kind}, cost {cost:g}"
        print(f"| {name} | {drift:.1e} | {error:.1e} | {seconds * 1e6:.0f} |", flush=True)
        found |= {f"{name}, drift [rad]": drift, f"{name}, error [m]": error, f"{name}, time [s]": seconds}
    return found


if __name__ == "__main__":
    run(main, __doc__)
