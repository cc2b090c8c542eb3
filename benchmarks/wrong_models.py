"""Arms that are not what the law believes, in MuJoCo: masses 40 % off, 3 kg in the hand, torques 2 N m off (10 min).

PD+ coupled of ready charts with default gains and settings, in C at 1 kHz, without a memory, with a momentum observer
and with adaptation. Each case runs ten times, from rest at five random postures in the inner half of the domain: the
start is told nothing of the torque that held the arm before, and it is told that torque, as programs should. The hand
takes the 3 kg, and torques go off, half a second after the start. Sag: how far the flange is from where it should be
2 s later, at most. Left: runs in which the catcher took over. Torques are off at the joints that feel at least 0.02
kg m^2: 2 N m turn a bare flange without a rotor at 13 rad/s after one tick, before anything is measured. Postures at
which the motors could not hold the arm are not drawn (nan: there are no others).
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import Adaptation, ControlStatus, MomentumObserver, PDPlus
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array

ARMS = (
    *("iiwa7-position", "panda-position", "panda-pose", "xarm7-position", "baxter-left-position"),
    *("tiago-pro-left-position", "ur5-position"),
)
MEMORIES = {"none": None, "momentum": MomentumObserver(), "adaptive": Adaptation()}
CASES = ("40 % lighter", "40 % heavier", "3 kg in the hand", "torques 2 N m off")
RUNS, TICK, CHANGE, LENGTH, DRAWS = 5, 1e-3, 500, 2000, 10_000
LEAST_INERTIA = 0.02  # [kg m^2]
HEADER = (
    f"| chart | memory | {', '.join(CASES)}: sag [mm] | left, of {len(CASES) * RUNS}: untold, told |\n"
    "| --- | --- | --- | --- |"
)


def main(quick: bool = False) -> list[str]:
    """Print the table."""
    return table(HEADER, rows(ARMS[:1] if quick else ARMS, 1 if quick else RUNS))


def rows(arms: tuple[str, ...], runs: int) -> Iterator[str]:
    """A row for each arm and memory: the worst of all runs of each case."""
    for name in arms:
        chart = oc.charts.load(name)
        for memory, remembers in MEMORIES.items():
            law = PDPlus(chart, remembers=remembers)
            with TemporaryDirectory() as folder:
                path = compile_shared(oc.generate_c(chart, Path(folder), law, "arm"), Path(folder), ("-O1",))
                library = CompiledLibrary(path, "arm", chart.n)
                told, untold = (
                    [[sag(law, library, case, seed, knows) for seed in range(runs)] for case in CASES]
                    for knows in (True, False)
                )
            worst = [f"{1e3 * max(off for off, _ in (*a, *b)):.2f}" for a, b in zip(told, untold, strict=True)]
            left = [str(sum(left for case in found for _, left in case)) for found in (untold, told)]
            yield f"| {name} | {memory} | {', '.join(worst)} | {', '.join(left)} |"


def sag(law: PDPlus, library: CompiledLibrary, case: str, seed: int, told: bool) -> tuple[float, bool]:
    """How far the flange is off after 2 s [m], and whether the catcher took over.

    Args:
        law: the law.
        library: it in C.
        case: what is wrong.
        seed: of the posture.
        told: whether the start is told the torque that held the arm.
    """
    rng, chart, robot = np.random.default_rng(seed), law.chart, law.problem.robot
    first, then, push = robot, robot, np.zeros(robot.n)
    if case in CASES[:2]:
        first = then = robot.with_scaled_masses(0.6 if case == CASES[0] else 1.4)
    if case == CASES[2]:
        then = robot.with_payload(3.0)
    q = posture(law, then, rng)
    if np.isnan(q).any():
        return np.nan, False
    if case == CASES[3]:
        push = 2.0 * rng.choice([-1.0, 1.0], robot.n) * (np.diag(robot.mass_matrix(q)) > LEAST_INERTIA)
    supervisor, plant = Supervisor(library, law), MuJoCoPlant(first)
    plant.reset(q)
    supervisor.start(q, first.gravity(q) if told else None)
    reference, left = np.concatenate([chart.phi(q), np.zeros(2 * chart.n)]), False
    for k in range(CHANGE + LENGTH):
        if k == CHANGE and then is not first:
            taken = MuJoCoPlant(then)
            taken.reset(plant.q, plant.dq)
            plant = taken
        command, _ = supervisor.step(plant.q, plant.dq, reference, TICK)
        plant.step(command + (k >= CHANGE) * push, TICK)
        left |= supervisor.cause != ControlStatus.OK
    return float(np.linalg.norm(robot.tip_position(plant.q) - robot.tip_position(q))), bool(left)


def posture(law: PDPlus, robot: oc.Robot, rng: np.random.Generator) -> Array:
    """In the inner half of the domain, within 0.75 rad of its centre, where motors can hold the robot, (n,); or NaN."""
    domain = law.problem.domain
    for _ in range(DRAWS):
        q = domain.centre + 0.5 * np.minimum(domain.half_width, 1.5) * rng.uniform(-1, 1, law.chart.n)
        if domain.contains(q) and (np.abs(robot.gravity(q)) < 0.9 * law.limit).all():
            return np.asarray(q)
    return np.full(law.chart.n, np.nan)


if __name__ == "__main__":
    run(main, __doc__)
