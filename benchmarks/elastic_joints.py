"""Elastic joints under the supervised law in C, in MuJoCo: where the tip is, with and without torque sensors (5 min).

Springs of 3,000, 5,000 and 10,000 N m/rad without damping between the joints and rotors of 0.2 and 1 kg m^2
(`Elasticity`). From the centre of the domain, x moves by 5 cm and xi by 0.2 through a filter of 1 Hz, at 1 kHz, under
PD+ with default gains, whose model knows no rotor and no spring. What the law measures:

- motors: positions and velocities of the rotors, as if gears were rigid;
- gravity: the same velocities, and positions by `NAME_link_positions`: what gravity takes springs is taken off;
- torque: the same with measured joint torques behind a low-pass of 5 1/s, in place of the model's gravity.

Error of x on the way, and in the last half second of 4 s, on the side of the links.
"""

from collections.abc import Iterator

import numpy as np
from benchmark import run, table
from sticking import supervised

import orthocas as oc
from orthocas.codegen import Supervisor
from orthocas.control import ControlStatus, PDPlus
from orthocas.simulation import Elasticity, MuJoCoPlant
from orthocas.tools.checks import Array

CHARTS = "iiwa7-position", "iiwa7-wide", "panda-position", "panda-wide"
STIFFNESS, ROTORS = (3000.0, 5000.0, 10_000.0), (0.2, 1.0)  # [N m/rad], [kg m^2]
TICK, SECONDS, BEFORE, END = 1e-3, 4.0, 0.3, 500
LOW_PASS = 5.0  # of measured torques [1/s]
SEEN = "motors", "gravity", "torque"
HEADER = (
    "| chart | stiffness [N m/rad], rotor [kg m²] | motors: x off on the way, at the end [mm] | gravity "
    "| torque |\n|" + " --- |" * 5
)


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; return the largest errors at the end by case [mm], and how many runs were lost."""
    worst = dict.fromkeys([*SEEN, "lost", "runs"], 0.0)

    def rows() -> Iterator[str]:
        for name in CHARTS[:1] if quick else CHARTS:
            chart = oc.load(name)
            law = PDPlus(chart)
            with supervised(law) as supervisor:
                for stiffness in STIFFNESS[1:2] if quick else STIFFNESS:
                    for rotor in ROTORS[:1] if quick else ROTORS:
                        cells = []
                        for seen in SEEN:
                            way, end = lead(law, supervisor, Elasticity(stiffness, rotor), seen)
                            worst["runs"] += 1
                            worst["lost"] += np.isinf(end)
                            worst[seen] = max(worst[seen], end if np.isfinite(end) else 0.0)
                            cells.append(f"{way:.2f}, {end:.2f}")
                        yield f"| {name} | {stiffness:g}, {rotor:g} | {' | '.join(cells)} |"

    table(HEADER, rows())
    print(worst)
    return worst


def lead(law: PDPlus, supervisor: Supervisor, gears: Elasticity, seen: str) -> tuple[float, float]:
    """Largest errors of x on the way and at the end [mm]; infinite if the catcher takes over."""
    chart, robot, library = law.chart, law.problem.robot, supervisor.library
    q, k = chart.problem.domain.home, gears.numbers(law.chart.n)[0]
    plant = MuJoCoPlant(robot, elasticity=gears)
    plant.reset(q)
    supervisor.start(q, plant.bias)
    start = chart.phi(q)
    steps = [(BEFORE, {chart.labels[0]: start[0] + 0.05, chart.labels[chart.m]: start[chart.m] + 0.2})]
    reference = oc.control.Reference.steps(chart.labels, start, steps, duration=SECONDS)
    errors, felt = [], None
    for row in np.stack(reference.sample(np.arange(round(SECONDS / TICK)) * TICK), axis=1):
        measured: Array = k * (plant.motor_q - plant.q)
        felt = measured if felt is None else felt + TICK * LOW_PASS * (measured - felt)
        joints = plant.motor_q
        if seen != "motors":
            joints, _ = library.link_positions(plant.motor_q, k, felt if seen == "torque" else None)
        command, status = supervisor.step(joints, plant.motor_dq, row.ravel(), TICK)
        if status is ControlStatus.CAUGHT:
            return np.inf, np.inf
        plant.step(command, TICK)
        errors.append(1e3 * float(np.linalg.norm((chart.phi(plant.q) - row[0])[:3])))
    return max(errors), max(errors[-END:])


if __name__ == "__main__":
    run(main, __doc__)
