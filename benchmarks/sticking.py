"""Arms that stick, wrong masses and unknown loads under the supervised law in C, wide and tight charts (about 30 min).

xi1 is asked to move by 0.3 through a filter of 1 Hz, at 1 kHz with torques a tick late, on `StickingPlant`: dry
friction of 2, 5 and 10 N m, at most 10 % of the effort limit, a quarter more to break away; masses 40 % more; 3 kg in
the hand. The start is a random posture from which the whole way lies in the domain, and motors hold the arm with at
most 70 % of their limits; the law is told the torque that holds the arm. `PDPlus(chart)` and
`PDPlus(chart, remembers=FrictionObserver())` with default gains and settings, generated, compiled, and run by a
`Supervisor`, which may hand the arm to its catcher: such arms are lost.

What is left after 5 s, and when the arm with the observer is at its target for good: x within 0.5 mm, xi within 0.02.
With friction, runs go on until joints are slower than 0.1 mrad/s and what the law remembers changes by less than
1 mN m/s, for a second. Arms that do not get there in 60 s hunt. Sawyer and Gen3 are fitted here: nobody tuned them.
"""

import argparse
import sys
import warnings
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import table
from wide_charts import robot_of

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, FrictionObserver, PDPlus
from orthocas.errors import OrthocasError
from orthocas.simulation import Friction, StickingPlant
from orthocas.tools.checks import Array

READY = ("panda", "xarm7", "iiwa7")
FITTED = ("sawyer", "gen3")
CHARTS = (
    *(f"{name}-{kind}" for name in READY for kind in ("wide", "pose")),
    *("sawyer-wide", "gen3-wide"),
)
TICK, BEFORE, SECONDS, LONG, STILL = 1e-3, 0.3, 5.0, 60.0, 1.0  # [s]
NEAR = 0.5, 0.02  # [mm], of xi
STANDS, SLOW, TIMESTEP = 1e-4, 1e-6, 5e-4  # [rad/s]; change of the correction in a tick [N m]; of the plant [s]
WAY, BREAKING, HELD, ROOM, DRAWS = 0.3, 1.25, 0.7, 0.8, 20_000
HEADER = "| chart | case | x off [mm] | xi off | there after [s] |\n| --- | --- | --- | --- | --- |"
LOST = np.inf, np.inf, np.nan


def main(quick: bool = False, names: tuple[str, ...] = CHARTS) -> dict[str, float]:
    """Print the table; return the largest errors of x [mm] and xi with the observer, and counts of runs."""
    found = {"x": 0.0, "xi": 0.0, "after": 0.0, "sticking": 0.0, "lost": 0.0, "hunting": 0.0, "slow": 0.0}

    def rows() -> Iterator[str]:
        for name in names[:1] if quick else names:
            for case, cells, last in measure(name, 1.5 if quick else SECONDS):
                if "N m" in case:
                    found["sticking"] += 1
                    found["lost"] += np.isinf(last[0])
                    found["hunting"] += np.isfinite(last[0]) and np.isnan(last[2])
                    found["slow"] += last[2] > 2.0
                if np.isfinite(last[0]):
                    found.update({key: max(found[key], last[k]) for k, key in enumerate(("x", "xi"))})
                    found["after"] = np.fmax(found["after"], last[2])
                yield f"| {name} | {case} | {cells} |"

    table(HEADER, rows())
    print(found)
    return found


def measure(name: str, seconds: float) -> Iterator[tuple[str, str, tuple[float, float, float]]]:
    """For each case its name, its cells, and what the observer leaves: x [mm], xi, and time to rest."""
    robot_name = name.removesuffix("-wide")
    fitted = robot_name in FITTED
    chart = oc.fit_wide(robot := robot_of(robot_name), oc.Task.pose(robot)).chart if fitted else oc.load(name)
    robot, q = chart.problem.robot, find_start(chart)
    cases: dict[str, tuple[oc.Robot, Friction | None]] = {
        "ideal": (robot, None),
        "+40 %": (robot.with_scaled_masses(1.4), None),
        "3 kg": (robot.with_payload([3.0, 0, 0, 0.05]), None),
    }
    for size in (2.0, 5.0, 10.0):
        coulomb = np.minimum(size, 0.1 * robot.effort_limits)
        cases[f"{size:g} N m"] = robot, Friction(0.0, coulomb, BREAKING * coulomb)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        laws = PDPlus(chart), PDPlus(chart, remembers=FrictionObserver())
    with supervised(laws[0]) as bare, supervised(laws[1]) as observed:
        for case, (true, friction) in cases.items():
            if (np.abs(true.gravity(q)) > robot.effort_limits).any():
                yield case, "motors cannot hold it | |", LOST
                continue
            plant = StickingPlant(true, friction=friction, timestep=TIMESTEP)
            found = [
                lead(law, supervisor, plant, q, seconds) for law, supervisor in zip(laws, (bare, observed), strict=True)
            ]
            errors = (" -> ".join(f"{row[k]:{form}}" for row in found) for k, form in ((0, ".2f"), (1, ".3f")))
            after = "lost" if np.isinf(found[-1][0]) else "hunts" if np.isnan(found[-1][2]) else f"{found[-1][2]:.1f}"
            yield case, f"{' | '.join(errors)} | {after}", found[-1]


@contextmanager
def supervised(law: PDPlus) -> Iterator[Supervisor]:
    """The law in C with default settings."""
    with TemporaryDirectory() as folder:
        path = compile_shared(oc.generate_c(law.chart, Path(folder), law, "arm"), Path(folder), ("-O1",))
        yield Supervisor(CompiledLibrary(path, "arm", law.chart.n), law)


def find_start(chart: oc.Chart) -> Array:
    """A posture in the inner half of the domain from which xi1 can go its whole way, and motors hold the arm easily."""
    rng, domain, robot = np.random.default_rng(3), chart.problem.domain, chart.problem.robot
    draws = domain.centre + 0.5 * np.minimum(domain.half_width, 1.5) * rng.uniform(-1, 1, (DRAWS, chart.n))
    for q in draws[(np.abs(robot.gravity(draws)) < HELD * robot.effort_limits).all(axis=1)]:
        phi, place, steps = chart.phi(q), q, 10
        for step in range(steps + 1):
            # With room to the boundary, where arms that jump off friction are caught.
            roomy = domain.contains(domain.centre + (place - domain.centre) / ROOM)
            if not roomy or (np.abs(robot.gravity(place)) > HELD * robot.effort_limits).any():
                break
            if step == steps:
                return np.asarray(q)
            phi[chart.m] += WAY / steps
            solution = chart.solve(phi, place)
            if not solution.found.all():
                break
            place = solution.q[0]
    raise OrthocasError(f"no start in {DRAWS} draws")


def lead(
    law: PDPlus, supervisor: Supervisor, plant: StickingPlant, q: Array, seconds: float
) -> tuple[float, float, float]:
    """Errors of x [mm] and xi after some seconds, infinite if the arm is lost, and when it is there (NaN: it hunts)."""
    chart, robot = law.chart, law.problem.robot
    start, label = chart.phi(q), chart.labels[chart.m]
    steps = [(BEFORE, {label: start[chart.m] + WAY})]
    reference = oc.control.Reference.steps(chart.labels, start, steps, duration=LONG)
    wanted = np.stack(reference.sample(np.arange(round(LONG / TICK)) * TICK), axis=1)
    plant.reset(q)
    held = plant.robot.gravity(q)
    supervisor.start(q, held)
    late, left, away, busy, before = deque([held]), LOST[:2], 0.0, 0.0, np.zeros(robot.n)
    for k, row in enumerate(wanted):
        command, status = supervisor.step(plant.q, plant.dq, row.ravel(), TICK)
        late.append(command)
        plant.step(late.popleft(), TICK)
        if status in (ControlStatus.CAUGHT, ControlStatus.BAD_INPUT):
            return LOST
        # Whether the arm is there, stands, and nothing that the law remembers will move it later.
        time, speed, error = (k + 1) * TICK - BEFORE, float(np.abs(plant.dq).max()), chart.phi(plant.q) - wanted[-1][0]
        off = float(1e3 * np.linalg.norm(error[:3])), float(np.abs(error[chart.m :]).max())
        now = before if law.remembers is None else supervisor.memory["correction"]
        away = time if off[0] > NEAR[0] or off[1] > NEAR[1] else away
        busy = time if speed > STANDS or np.abs(now - before).max() > SLOW else busy
        before = now
        if k + 1 == round((BEFORE + seconds) / TICK):
            left = off
        done = law.remembers is None or not plant.friction.numbers(robot.n).any() or time - busy > STILL
        if time >= seconds and done:
            return *left, away
    return *left, np.nan


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one chart, 1.5 s")
    parser.add_argument("names", nargs="*", help="charts; default: all")
    options = parser.parse_args(sys.argv[1:])
    main(options.quick, tuple(options.names) or CHARTS)
