"""A second task in quadratic programs: a posture, or xi. Is it met, and does it leave the tool alone?

pink: the tool follows a circle again and again, and a tick of 10 ms is one program. The tool's task has the cost 1 per
metre. For posture and `XiTask` at the same costs: how far the joints are from home after every turn, the tool's largest
error after the first turn, and the time of a tick.

Inverse dynamics, by the code of docs/how-to/qp.md, 1000 times a second: the tool stays, and xi1 is to change by 0.2 in
two seconds. The posture is the one that `chart.solve` finds for that. For both at the same weights: the tool's largest
error, and what is missing of xi at the end. `--quick` takes three turns, and a tenth of the ticks.
"""

import re
import time
from importlib import import_module
from pathlib import Path
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
PAGE = Path(__file__).parent.parent / "docs" / "how-to" / "qp.md"
PUSHED, STEP, WEIGHTS = 2000, 0.2, (1e-2, 1e-1, 1.0)


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
            error = max(error, float(np.abs(chart.x(q) - wanted).max()))
        if tick % TICKS == 0:
            drift = max(drift, float(np.abs(q - home).max()))
    return drift, error, (time.perf_counter() - start) / (turns * TICKS)


def recipe() -> dict[str, Any]:
    """The names that the first cell of the page defines."""
    cell = re.search(r"```{code-cell} python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert cell is not None
    names: dict[str, Any] = {}
    exec(cell[1], names)
    return names


def pushed(code: dict[str, Any], kind: str, weight: float, ticks: int) -> tuple[float, float]:
    """Error of the tool [m], and what is missing of xi."""
    chart, model = code["chart"], code["model"]
    home = chart.problem.domain.centre
    place, wanted = chart.x(home), chart.xi(home) + STEP * np.eye(chart.r)[0]
    target = wanted if kind == "xi" else chart.solve(np.concatenate([place, wanted]), home).q[0]
    q, dq, error = home, np.zeros(chart.n), 0.0
    for _ in range(ticks):
        tau = code["torque"](
            q, dq, (1.0, code["tool_rows"](q, dq, place)), (weight, code[f"{kind}_rows"](q, dq, target))
        )
        dq = dq + 1e-3 * pin.aba(model, code["data"], q, dq, tau)
        q = q + 1e-3 * dq
        error = max(error, float(np.linalg.norm(chart.x(q) - place)))
    return error, float(np.abs(chart.xi(q) - wanted).max())


def in_dynamics(quick: bool = False) -> dict[str, float]:
    """Print the second table, and return its numbers."""
    code, found = recipe(), {}
    print("| second task | error of the tool [m] | xi missed by |\n| --- | --- | --- |")
    for kind in ("posture", "xi"):
        for weight in WEIGHTS:
            error, missing = pushed(code, kind, weight, PUSHED // 10 if quick else PUSHED)
            name = f"{kind}, weight {weight:g}"
            print(f"| {name} | {error:.1e} | {missing:.1e} |", flush=True)
            found |= {f"{name}, error [m]": error, f"{name}, xi": missing}
    return found


def main(quick: bool = False) -> dict[str, float]:
    """Print the tables, and return their numbers."""
    chart, found = oc.charts.load("panda-position"), {}
    cases = [("none", 0.0), *((kind, cost) for kind in ("posture", "xi") for cost in COSTS)]
    header = "| second task | drift of the joints [rad] | error of the tool [m] | time of a tick [us] |"
    print(f"{header}\n| --- | --- | --- | --- |")
    for kind, cost in cases:
        drift, error, seconds = followed(chart, kind, cost, 3 if quick else TURNS)
        name = kind if kind == "none" else f"{kind}, cost {cost:g}"
        print(f"| {name} | {drift:.1e} | {error:.1e} | {seconds * 1e6:.0f} |", flush=True)
        found |= {f"{name}, drift [rad]": drift, f"{name}, error [m]": error, f"{name}, time [s]": seconds}
    print()
    return found | in_dynamics(quick)


if __name__ == "__main__":
    run(main, __doc__)
