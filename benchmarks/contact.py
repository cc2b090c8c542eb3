"""Stiff walls under the supervised law in C, in MuJoCo: contacts, forces, and what `error_limit` bounds (5 min).

The tip goes 3 cm along x at up to 0.19 m/s, along a spline of 0.3 s; a wall stands 1 cm before it: a spring of 1e4, 1e5
and 1e6 N/m with the damping ratio 0.1 for 3 kg, which pushes and never pulls, in five steps a tick. PD+ and impedance
control with default gains at 1 kHz, torques a tick late; then both with an `error_limit` of 2 mm along x. Number of
contacts, the largest force, and the force in the last 0.2 s of 2 s.
"""

from collections import deque
from collections.abc import Iterator

import numpy as np
from benchmark import run, table
from sticking import supervised

import orthocas as oc
from orthocas.codegen import Supervisor
from orthocas.control import ControlStatus, Impedance, PDPlus, Safety
from orthocas.simulation import MuJoCoPlant

CHARTS = "iiwa7-position", "panda-position", "iiwa7-wide", "panda-wide"
STIFFNESS = 1e4, 1e5, 1e6  # [N/m]
WALL, WAY, DURATION, LIMIT = 0.01, 0.03, 0.3, 2e-3  # [m], [m], [s], [m]
RATIO, MASS = 0.1, 3.0  # of the wall's damping, [kg]
TICK, SECONDS, BEFORE, END, PARTS = 1e-3, 2.0, 0.3, 200, 5
HEADER = (
    "| chart | wall [N/m] | PD+: contacts, largest force, force at the end [N] | with `error_limit` | impedance "
    "| with `error_limit` |\n|" + " --- |" * 6
)


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; return counts of runs, of contacts and of lost arms, and the largest unrest at the end [N]."""
    found = {"runs": 0.0, "contacts": 0.0, "lost": 0.0, "unrest": 0.0}

    def rows() -> Iterator[str]:
        for name in CHARTS[:1] if quick else CHARTS:
            chart = oc.load(name)
            laws = PDPlus(chart), Impedance(chart)
            with supervised(laws[0]) as tracking, supervised(laws[1]) as compliant:
                for stiffness in STIFFNESS[:1] if quick else STIFFNESS:
                    cells = []
                    for law, supervisor in zip(laws, (tracking, compliant), strict=True):
                        limit = Safety.of(law).error_limit.copy()
                        limit[0] = LIMIT
                        bounded = Supervisor(supervisor.library, law, Safety.of(law, error_limit=limit))
                        for guard in (supervisor, bounded):
                            contacts, most, end, unrest, lost = touch(law, guard, stiffness)
                            found["runs"] += 1
                            found["lost"] += lost
                            found["contacts"] = max(found["contacts"], contacts)
                            found["unrest"] = max(found["unrest"], unrest)
                            cells.append(f"{contacts}, {most:.0f}, {end:.0f}{' lost' if lost else ''}")
                    yield f"| {name} | {stiffness:.0e} | {' | '.join(cells)} |".replace("e+0", "e")

    table(HEADER, rows())
    print(found)
    return found


def touch(law: PDPlus | Impedance, supervisor: Supervisor, stiffness: float) -> tuple[int, float, float, float, bool]:
    """Contacts, largest force, mean force and its deviation at the end [N], and whether the catcher took over."""
    chart, robot = law.chart, law.problem.robot
    plant, q = MuJoCoPlant(robot, timestep=TICK / PARTS), chart.problem.domain.home
    plant.reset(q)
    held = robot.gravity(q)
    supervisor.start(q, held)
    start, damping = chart.phi(q), 2 * RATIO * np.sqrt(stiffness * MASS)
    late, forces, contacts, lost, before = deque([held]), [], 0, False, -WALL
    for k in range(round(SECONDS / TICK)):
        # A spline from rest to rest.
        s = float(np.clip((k * TICK - BEFORE) / DURATION, 0.0, 1.0))
        rates = s**3 * (10 - 15 * s + 6 * s * s), 30 * (s * (1 - s)) ** 2, 60 * s * (1 - s) * (1 - 2 * s)
        reference = np.concatenate([start, np.zeros(2 * chart.n)])
        for place, rate in enumerate(rates):
            reference[place * chart.n] += WAY * rate / DURATION**place
        command, status = supervisor.step(plant.q, plant.dq, reference, TICK)
        lost |= status is ControlStatus.CAUGHT
        late.append(command)
        torque = late.popleft()
        for _ in range(PARTS):
            deep = float(robot.tip_position(plant.q)[0] - start[0]) - WALL
            force = max(0.0, stiffness * deep + damping * (deep - before) * PARTS / TICK) if deep > 0 else 0.0
            contacts += deep > 0 >= before
            before = deep
            plant.release()
            plant.push([-force, 0.0, 0.0])
            plant.step(torque, TICK / PARTS)
            forces.append(force)
    end = forces[-END * PARTS :]
    return contacts, max(forces), float(np.mean(end)), float(np.std(end)), lost


if __name__ == "__main__":
    run(main, __doc__)
