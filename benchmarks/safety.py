"""Pushes against the supervised law: compiled C at 1 kHz on arms in MuJoCo with joint stops and limits of effort.

Forces at elbow, wrist and tip in 26 directions, as strong as the motors could hold at rest (times 0.3 to 1, at most
400 N), for 0.05 to 0.5 s, from random postures in the inner 60 % of the domain. Two seconds after the push, the program
asks the catcher for the law again, and the arm goes back at 0.3 rad/s of its fastest joint, which takes long for wrists
that the push turned around. PD+ coupled with default gains and default settings, cubic coordinates (15 min).
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
from benchmark import run, table
from default_gains import chart_of

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, PDPlus
from orthocas.simulation import MuJoCoPlant

CASES = (  # robot, task, metric
    "iiwa position inertia",
    "panda position inertia",
    "xarm7 position inertia",
    "iiwa pose:z euclidean",
    "panda pose:z euclidean",
)
PLACES = {"elbow": 3, "wrist": 5, "tip": None}
DIRECTIONS = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
TICK, QUIET, AFTER, LONGEST = 1e-3, 0.3, 2.0, 60.0  # [s] without push, until the law is asked for, until the end
STRONGEST = 400.0  # [N]
RUNS = 60  # of each case
HEADER = (
    "| arm | left the domain | caught | joints below 2 rad/s after | at rest after | fastest joint | torque a tick "
    "| back under the law, after |\n| --- | --- | --- | --- | --- | --- | --- | --- |"
)
REST = 0.05  # [rad/s]


@dataclass
class Push:
    """What a push did."""

    slow_after: float  #: time after the push until all joints stay below 2 rad/s [s]
    rest_after: float  #: time after the push until all joints stay below 0.05 rad/s, as long as it was caught [s]
    fastest: float  #: [rad/s]
    change: float  #: largest change of a torque in a tick [N m]
    left: bool  #: whether the arm left the domain
    caught: bool
    back_after: float  #: time from asking for the law until it commands inside the domain; infinite if it never did [s]


def main(quick: bool = False) -> list[str]:
    """Print a table; `quick` takes six pushes of one arm."""
    return table(HEADER, (row(case, 6 if quick else RUNS) for case in (CASES[:1] if quick else CASES)))


def row(case: str, runs: int) -> str:
    """The pushes of one arm."""
    name, task, metric = case.split()
    found = pushes(chart_of(name, task, metric), runs)
    return (
        f"| {name}, {task}, {metric} | {sum(p.left for p in found)} of {runs} | {sum(p.caught for p in found)} "
        f"| {max(p.slow_after for p in found):.2f} s | {max(p.rest_after for p in found):.2f} s "
        f"| {max(p.fastest for p in found):.0f} rad/s | {max(p.change for p in found):.2f} N m "
        f"| {sum(p.back_after < np.inf for p in found)}, {max(p.back_after for p in found):.1f} s |"
    )


def pushes(chart: oc.Chart, runs: int, seed: int = 0) -> list[Push]:
    """Push an arm at every place in every direction, and again with other strengths and durations."""
    law, plant, rng = PDPlus.on_chart(chart), MuJoCoPlant(chart.problem.robot), np.random.default_rng(seed)
    cases = [(place, direction) for direction in DIRECTIONS for place in PLACES]
    with TemporaryDirectory() as folder:
        generated = oc.generate_c(chart, folder, law, "arm")
        library = CompiledLibrary(compile_shared(generated, Path(folder), ("-O1",)), "arm", chart.n)
        return [push(chart, Supervisor(library, law), plant, *cases[k % len(cases)], rng) for k in range(runs)]


def push(
    chart: oc.Chart,
    supervisor: Supervisor,
    plant: MuJoCoPlant,
    place: str,
    direction: np.ndarray,
    rng: np.random.Generator,
) -> Push:
    """One run, until the arm is back under the law, or for 60 s."""
    domain, unit = chart.problem.domain, direction / np.linalg.norm(direction)
    q = domain.centre + 0.6 * domain.half_width * rng.uniform(-1, 1, chart.n)
    share, lasts = rng.uniform(0.3, 1), round(rng.uniform(0.05, 0.5) / TICK)
    on, ask = round(QUIET / TICK), round((QUIET + AFTER) / TICK) + lasts
    plant.reset(q)
    supervisor.start(q)
    reference = np.concatenate([chart.phi(q), np.zeros(2 * chart.n)])
    path, speeds, commands, statuses = [], [], [], []
    for k in range(round(LONGEST / TICK)):
        if k == on:
            plant.push(share * strongest(plant, PLACES[place], unit) * unit, link=PLACES[place])
        if k == on + lasts:
            plant.release()
        here, speed = plant.q, plant.dq
        if k >= ask and supervisor.mode != 0:  # not under the law: ask for it where the arm is
            supervisor.resume()
            reference[: chart.n] = chart.phi(here)
        command, status = supervisor.step(here, speed, reference, TICK)
        plant.step(command, TICK)
        speeds.append(np.abs(speed).max())
        commands.append(command)
        statuses.append(status)
        path.append(here)
        if k > ask + round(1 / TICK) and supervisor.mode == 0:
            break
    inside = domain.contains(np.array(path))
    return judged(np.array(speeds), np.array(commands), statuses, inside, on + lasts, ask)


def judged(
    speeds: np.ndarray, commands: np.ndarray, statuses: list[ControlStatus], inside: np.ndarray, end: int, ask: int
) -> Push:
    """The numbers of a run; rest counts only where the catcher held the arm."""
    caught = ControlStatus.CAUGHT in statuses
    away = np.flatnonzero(np.isin(statuses, (ControlStatus.CAUGHT, ControlStatus.RETURNING)))
    last = away[-1] if away.size else ask
    fast, moving = (np.flatnonzero(speeds[end:ask] > limit) for limit in (2.0, REST))
    return Push(
        slow_after=(fast[-1] + 1) * TICK if fast.size else 0.0,
        rest_after=(moving[-1] + 1) * TICK if moving.size and caught else 0.0,
        fastest=speeds.max(),
        change=np.abs(np.diff(commands, axis=0)).max(),
        left=not inside.all(),
        caught=caught,
        back_after=max(0, last - ask) * TICK if inside[-1] and last < len(statuses) - 1 else np.inf,
    )


def strongest(plant: MuJoCoPlant, link: int | None, unit: np.ndarray) -> float:
    """The largest force in a direction that the motors can hold at rest without gravity, at most 400 N."""
    body = plant.robot.n - 1 if link is None else link
    J, handle = np.zeros((3, plant.robot.n)), plant.model.body(f"handle{body}").id
    place = plant.robot.joint_points(plant.q)[-1 if link is None else 1 + link]
    mujoco.mj_jac(plant.model, plant.data, J, None, place, handle)
    limits = np.where(np.isfinite(plant.robot.effort_limits), plant.robot.effort_limits, 50.0)
    return float(min(STRONGEST, (limits / np.abs(J.T @ unit).clip(1e-9)).min()))


if __name__ == "__main__":
    run(main, __doc__)
