"""Default gains on arms that stick, with wrong masses and unknown loads, on wide and tight charts (about 40 min).

xi1 is asked to move by 0.3 through a filter of 1 Hz, at 1 kHz with torques a tick late, on `StickingPlant`: dry
friction of 2, 5 and 10 N m, at most 10 % of the effort limit, a quarter more to break away; masses 40 % more; 3 kg in
the hand. The start is a random posture from which the whole way lies in the domain, and motors hold the arm with at
most 70 % of their limits. PD+ in Python with springs of 6 Hz (`matched_stiffness`, once the default), with default
gains, and with default gains and the `FrictionObserver`.

What is left after 5 s, and when the arm with the observer stands for good: joints are at rest, exactly, and
what the law remembers changes by less than 1 mN m/s, for a quarter of a second. Arms that still move after 60 s hunt.
"""

import argparse
import sys
import warnings
from collections import deque
from collections.abc import Iterator

import numpy as np
from benchmark import table

import orthocas as oc
from orthocas.control import FrictionObserver, PDPlus, Remembering, matched_stiffness
from orthocas.errors import OrthocasError
from orthocas.simulation import Friction, StickingPlant
from orthocas.tools.checks import Array

CHARTS = (
    *("panda-wide", "xarm7-wide", "iiwa7-wide", "baxter-left-wide", "tiago-pro-left-wide", "pr2-left-wide"),
    *("panda-pose", "iiwa7-pose"),
)
TICK, SECONDS, LONG, STILL = 1e-3, 5.0, 60.0, 0.25  # [s]
SLOW = 1e-6  # change of the correction in a tick [N m], 0.06 N m in a minute
WAY, BREAKING, HELD, DRAWS = 0.3, 1.25, 0.7, 20_000
RUNAWAY = 30.0  # [rad/s]
HEADER = "| chart | case | x off [mm] | xi off | stands after [s] |\n| --- | --- | --- | --- | --- |"


def main(quick: bool = False, names: tuple[str, ...] = CHARTS) -> dict[str, float]:
    """Print the table; return the largest errors of x [mm] and xi with the observer, over cases without a loss."""
    worst = {"x": 0.0, "xi": 0.0}

    def rows() -> Iterator[str]:
        for name in names[:1] if quick else names:
            for case, cells, last in measure(name, 1.5 if quick else SECONDS):
                if np.isfinite(last).all():
                    worst["x"], worst["xi"] = max(worst["x"], last[0]), max(worst["xi"], last[1])
                yield f"| {name} | {case} | {cells} |"

    table(HEADER, rows())
    print(worst)
    return worst


def measure(name: str, seconds: float) -> Iterator[tuple[str, str, tuple[float, float]]]:
    """For each case its name, its cells, and what the observer leaves: x [mm] and xi."""
    chart = oc.charts.load(name)
    robot = chart.problem.robot
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        laws = PDPlus(chart, matched_stiffness(chart)), PDPlus(chart), PDPlus(chart, remembers=FrictionObserver())
    q = find_start(chart)
    loads = {"ideal": robot, "+40 %": robot.with_scaled_masses(1.4), "3 kg": robot.with_payload([3.0, 0, 0, 0.05])}
    cases = {case: (true, None) for case, true in loads.items()}
    for size in (2.0, 5.0, 10.0):
        coulomb = np.minimum(size, 0.1 * robot.effort_limits)
        cases[f"{size:g} N m"] = robot, Friction(0.0, coulomb, BREAKING * coulomb)
    for case, (true, friction) in cases.items():
        if (np.abs(true.gravity(q)) > robot.effort_limits).any():
            yield case, "motors cannot hold it | |", (np.inf, np.inf)
            continue
        found = [lead(law, StickingPlant(true, friction=friction), q, seconds, friction is not None) for law in laws]
        errors = (" -> ".join(f"{row[k]:{form}}" for row in found) for k, form in ((0, ".2f"), (1, ".3f")))
        after = "" if friction is None else "not" if np.isnan(found[-1][2]) else f"{found[-1][2]:.1f}"
        yield case, f"{' | '.join(errors)} | {after}", found[-1][:2]


def find_start(chart: oc.Chart) -> Array:
    """A posture in the inner half of the domain from which xi1 can go its whole way, and motors hold the arm easily."""
    rng, domain, robot = np.random.default_rng(3), chart.problem.domain, chart.problem.robot
    draws = domain.centre + 0.5 * np.minimum(domain.half_width, 1.5) * rng.uniform(-1, 1, (DRAWS, chart.n))
    for q in draws[(np.abs(robot.gravity(draws)) < HELD * robot.effort_limits).all(axis=1)]:
        phi, place, steps = chart.phi(q), q, 10
        for step in range(steps + 1):
            if not domain.contains(place) or (np.abs(robot.gravity(place)) > HELD * robot.effort_limits).any():
                break
            if step == steps:
                return np.asarray(q)
            phi[chart.m] += WAY / steps
            solution = chart.solve(phi, place)
            if not solution.found.all():
                break
            place = solution.q[0]
    raise OrthocasError(f"no start in {DRAWS} draws")


def lead(law: PDPlus, plant: StickingPlant, q: Array, seconds: float, sticks: bool) -> tuple[float, float, float]:
    """Errors of x [mm] and of xi after some seconds, infinite if the arm is lost, and when it stands (NaN: never)."""
    chart, ticks = law.chart, Remembering(law)
    plant.reset(q)
    start, label = chart.phi(q), chart.labels[chart.m]
    reference = oc.control.Reference.steps(chart.labels, start, [(0.0, {label: start[chart.m] + WAY})], duration=LONG)
    wanted = np.stack(reference.sample(np.arange(round(LONG / TICK)) * TICK), axis=1)
    late, left, since, before = deque([plant.robot.gravity(q)]), (np.inf, np.inf), 0, np.empty(0)
    for k, row in enumerate(wanted):
        try:
            late.append(ticks.tick(plant.q, plant.dq, row, TICK)[0])
            plant.step(late.popleft(), TICK)
        except OrthocasError:
            return np.inf, np.inf, np.nan
        if np.abs(plant.dq).max() > RUNAWAY or not chart.problem.domain.contains(plant.q):
            return np.inf, np.inf, np.nan
        # Whether the arm stands, and has done so for long.
        remembered = np.concatenate([plant.dq, ticks.fields.get("correction", np.empty(0))])
        changed = before.shape != remembered.shape or np.abs(remembered - before).max() > SLOW or plant.dq.any()
        since, before = (k + 1 if changed else since), remembered
        if k + 1 == round(seconds / TICK):
            error = chart.phi(plant.q) - row[0]
            left = float(1e3 * np.linalg.norm(error[:3])), float(np.abs(error[chart.m :]).max())
        # Without friction arms come to rest in the limit only; without a memory, nothing can change later.
        done = law.remembers is None or not sticks or k - since > STILL / TICK
        if k + 1 >= round(seconds / TICK) and done:
            break
    else:
        since = np.nan
    return *left, since * TICK


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one chart, 1.5 s")
    parser.add_argument("names", nargs="*", help="charts; default: all")
    options = parser.parse_args(sys.argv[1:])
    main(options.quick, tuple(options.names) or CHARTS)
