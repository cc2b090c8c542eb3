"""Default gains on arms that stick, with wrong masses and unknown loads, on wide and tight charts (about 30 min).

xi1 is asked to move by 0.3 (tight charts: 0.1) in a second, from a random posture that motors hold with at most 55 % of
their limits, at 1 kHz with torques a tick late, on `StickingPlant`: dry friction of 2, 5 and 10 N m, at most 10 % of
the effort limit, a quarter more to break away; masses 40 % more; 3 kg in the hand. PD+ in Python with springs of 6 Hz
(`matched_stiffness`, once the default), with default gains, and with default gains and the `FrictionObserver`. What is
left after 5 s, and the largest speed of a joint in the last second.
"""

import warnings
from collections import deque
from collections.abc import Iterator

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas.control import FrictionObserver, PDPlus, Remembering, matched_stiffness
from orthocas.errors import OrthocasError
from orthocas.simulation import Friction, StickingPlant
from orthocas.tools.checks import Array

CHARTS = (
    "panda-wide",
    "xarm7-wide",
    "iiwa7-wide",
    "baxter-left-wide",
    "tiago-pro-left-wide",
    "pr2-left-wide",
    "panda-pose",
    "iiwa7-pose",
)
FORMS = ".2f", ".3f", ".2f"
TICK, SECONDS, RUNS, BREAKING = 1e-3, 5.0, 1, 1.25
HEADER = "| chart | case | x off [mm] | xi off | speed [rad/s] |\n| --- | --- | --- | --- | --- |"


def main(quick: bool = False, names: tuple[str, ...] = CHARTS) -> dict[str, float]:
    """Print the table; return the largest errors of x [mm] and xi with the observer, over cases without a loss."""
    charts, seconds = (names[:1], 1.5) if quick else (names, SECONDS)
    worst = {"rows": 0.0, "x": 0.0, "xi": 0.0}

    def rows() -> Iterator[str]:
        for name in charts:
            for case, cells, last in measure(name, seconds, 1 if quick else RUNS):
                worst["rows"] += 1
                worst["x"], worst["xi"] = max(worst["x"], last[0]), max(worst["xi"], last[1])
                yield f"| {name} | {case} | {cells} |"

    table(HEADER, rows())
    print(worst)
    return worst


def measure(name: str, seconds: float, runs: int) -> Iterator[tuple[str, str, Array]]:
    """For each case its name, its cells, and what the observer leaves: x [mm], xi, speed [rad/s]."""
    chart, way = oc.charts.load(name), 0.3 if name.endswith("wide") else 0.1
    robot = chart.problem.robot
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        laws = (
            PDPlus(chart, matched_stiffness(chart)),
            PDPlus(chart),
            PDPlus(chart, remembers=FrictionObserver()),
        )
    starts = find_starts(chart, runs)
    loads = {"ideal": robot, "+40 %": robot.with_scaled_masses(1.4), "3 kg": robot.with_payload([3.0, 0, 0, 0.05])}
    cases = {case: (true, None) for case, true in loads.items()}
    for size in (2.0, 5.0, 10.0):
        coulomb = np.minimum(size, 0.1 * robot.effort_limits)
        cases[f"{size:g} N m"] = robot, Friction(0.0, coulomb, BREAKING * coulomb)
    for case, (true, friction) in cases.items():
        found = np.array(
            [
                np.max([lead(law, StickingPlant(true, friction=friction), q, way, seconds) for q in starts], axis=0)
                for law in laws
            ]
        )
        texts = (
            " -> ".join(f"{value:{form}}" for value in column) for column, form in zip(found.T, FORMS, strict=True)
        )
        yield case, " | ".join(texts), found[-1]


def find_starts(chart: oc.Chart, count: int) -> list[Array]:
    """Random postures in the inner half of the domain that the motors hold easily."""
    rng, domain, robot, found = np.random.default_rng(3), chart.problem.domain, chart.problem.robot, []
    while len(found) < count:
        q = domain.centre + 0.5 * np.minimum(domain.half_width, 1.5) * rng.uniform(-1, 1, chart.n)
        if domain.contains(q) and (np.abs(robot.gravity(q)) < 0.55 * robot.effort_limits).all():
            found.append(q)
    return found


def lead(law: PDPlus, plant: StickingPlant, q: Array, way: float, seconds: float) -> Array:
    """Errors of x [mm] and of xi at the end, and the fastest joint of the last second; infinite if the arm is lost."""
    chart, ticks = law.chart, Remembering(law)
    plant.reset(q)
    start, label = chart.phi(q), chart.labels[chart.m]
    change = [(0.0, {label: start[chart.m] + way})]
    reference = oc.control.Reference.steps(chart.labels, start, change, duration=seconds)
    wanted = np.stack(reference.sample(np.arange(round(seconds / TICK)) * TICK), axis=1)
    late, speeds = deque([plant.robot.gravity(q)]), []
    for row in wanted:
        try:
            late.append(ticks.tick(plant.q, plant.dq, row, TICK)[0])
            plant.step(late.popleft(), TICK)
        except OrthocasError:
            return np.full(3, np.inf)
        speeds.append(np.abs(plant.dq).max())
        if speeds[-1] > 30:
            return np.full(3, np.inf)
    error = chart.phi(plant.q) - wanted[-1, 0]
    lost = not chart.problem.domain.contains(plant.q)
    found = 1e3 * np.linalg.norm(error[:3]), np.abs(error[chart.m :]).max(), max(speeds[-round(1 / TICK) :])
    return np.full(3, np.inf) if lost else np.array(found)


if __name__ == "__main__":
    run(main, __doc__)
