"""The recipes of docs/how-to/qp.md for TSID and Crocoddyl: a posture or xi beside the tool; does the tool notice?

The tool of a panda is to stay while xi1 changes by 0.2: in TSID within two seconds, 1000 times a second, in Crocoddyl
along a smooth path of a second, 101 nodes. The posture is the one that `chart.solve` finds; in Crocoddyl, postures on
the straight line to it. Each part runs if its library is installed, which needs another Pinocchio: see the page.
`--quick` takes a tenth of the ticks, and one weight.
"""

import importlib.util
import re
import time
from typing import Any

import numpy as np
import pinocchio as pin
from benchmark import run
from xi_in_qp import PAGE, PUSHED, STEP, recipe

from orthocas.tools.checks import Array

WEIGHTS = {"TSID": (1e-4, 1e-2, 1.0), "Crocoddyl": (1.0, 100.0, 1000.0)}
RUNS = 3


def part(title: str) -> dict[str, Any]:
    """The names that the page defines up to the block of a section."""
    names = recipe()
    block = re.search(rf"## In {title}\n.*?```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert block is not None
    exec(block[1], names)
    return names


def targets_of(code: dict[str, Any]) -> tuple[Array, Array, Array, Array]:
    """Where the motion starts, where the tool is, and what xi and the posture are to be."""
    chart = code["chart"]
    home = chart.problem.domain.centre
    place, wanted = chart.x(home), chart.xi(home) + STEP * np.eye(chart.r)[0]
    return home, place, wanted, chart.solve(np.concatenate([place, wanted]), home).q[0]


def in_tsid(code: dict[str, Any], kind: str, weight: float, quick: bool) -> tuple[float, float, float]:
    """Error of the tool [m], what is missing of xi, and seconds a tick."""
    tsid, robot, terms, chart = code["tsid"], code["robot"], code["terms"], code["chart"]
    home, place, wanted, target = targets_of(code)
    robot.computeAllTerms(terms, home, 0 * home)
    sample, now = tsid.TrajectorySample(12, 6), robot.framePosition(terms, code["hand"])
    sample.value(np.concatenate([now.translation, now.rotation.T.ravel()]))
    code["tool"].setReference(sample)
    posture = tsid.TaskJointPosture("posture", robot)
    posture.setKp(100 * np.ones(chart.n))
    posture.setKd(20 * np.ones(chart.n))
    joints = tsid.TrajectorySample(chart.n)
    joints.value(target)
    posture.setReference(joints)
    q, dq, error, ticks = home, 0 * home, 0.0, PUSHED // 10 if quick else PUSHED
    seconds = 0.0
    for _ in range(ticks):
        start = time.perf_counter()
        rows = code["xi_task"](q, dq, wanted) if kind == "xi" else posture.compute(0.0, q, dq, terms)
        dq = dq + 1e-3 * code["acceleration"](q, dq, (weight, rows))
        seconds += time.perf_counter() - start
        q = q + 1e-3 * dq
        error = max(error, float(np.linalg.norm(chart.x(q) - place)))
    return error, float(np.abs(chart.xi(q) - wanted).max()), seconds / ticks


def in_crocoddyl(code: dict[str, Any], kind: str, weight: float, quick: bool) -> tuple[float, float, float]:
    """Error of the tool [m], what is missing of xi, and seconds of a plan."""
    chart, crocoddyl = code["chart"], code["crocoddyl"]
    home, place, wanted, target = targets_of(code)
    t = np.linspace(0, 1, 11 if quick else 101)
    share = (10 * t**3 - 15 * t**4 + 6 * t**5)[:, None]
    only = crocoddyl.ActivationModelWeightedQuad(np.repeat([1.0, 0.0], chart.n))

    def posture_cost(q: Array) -> Any:
        return lambda state: [only, crocoddyl.ResidualModelState(state, np.concatenate([q, 0 * q]))]

    here = chart.xi(home)
    costs = [code["xi_cost"](xi) for xi in here + share * (wanted - here)]
    if kind == "posture":
        costs = [posture_cost(q) for q in home + share * (target - home)]
    seconds = []
    for _ in range(RUNS):
        start = time.perf_counter()
        q = code["plan"](home, place, costs, weight, 1 / (len(t) - 1))
        seconds.append(time.perf_counter() - start)
    error = float(np.linalg.norm(chart.x(q) - place, axis=1).max())
    return error, float(np.abs(chart.xi(q[-1]) - wanted).max()), min(seconds)


MEASURED = {"TSID": in_tsid, "Crocoddyl": in_crocoddyl}


def main(quick: bool = False) -> dict[str, float]:
    """Print a table for each library, and return its numbers."""
    found = {}
    print(f"Pinocchio {pin.__version__}")
    for title, measured in MEASURED.items():
        if importlib.util.find_spec(title.lower()) is None:
            continue
        code, unit = part(title), "us" if title == "TSID" else "ms"
        header = f"| {title}, second task | error of the tool [m] | xi missed by | time [{unit}] |"
        print(f"{header}\n| --- | --- | --- | --- |")
        for kind in ("posture", "xi"):
            for weight in WEIGHTS[title][:1] if quick else WEIGHTS[title]:
                error, missing, seconds = measured(code, kind, weight, quick)
                name = f"{title}, {kind}, weight {weight:g}"
                shown = seconds * (1e6 if unit == "us" else 1e3)
                print(f"| {name} | {error:.1e} | {missing:.1e} | {shown:.0f} |", flush=True)
                found |= {f"{name}, error [m]": error, f"{name}, xi": missing, f"{name}, time [s]": seconds}
        print()
    return found


if __name__ == "__main__":
    run(main, __doc__)
