"""Fig. 28 with servos in MuJoCo: the journey of the 7-DoF arm, with joints that give way and rub (3 min).

The law of Sec. 9 of [AS2023] gives joint velocities, and their integral is what the servos are asked for. Each servo is
a spring and a damper between the wanted and the actual motor, plus the gravity torque at the wanted posture. Gears are
rigid, or give way: then the servos measure the rotors only, hold them where the springs carry the weight of the wanted
posture, and the joints swing on their springs. The motion is logged as a lab would log it, and drawn from the log.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from paper.chosen_fit import USUAL
from paper.fig28 import arm_chart, draw_log, journey

from orthocas.charts.chart import Chart
from orthocas.control import Kinematic
from orthocas.simulation import Elasticity, Friction, MuJoCoPlant, simulate
from orthocas.tools.checks import Array

TICK, LOGGED = 1e-3, 10  # period of the servos [s], and ticks between rows of the log
BANDWIDTH = 2 * np.pi * 30  # of the servos [rad/s]
LEAST = 200.0  # stiffness [N m/rad]
RATIO = 0.7  # of damping
COULOMB = (1.0, 1.0, 0.6, 0.6, 0.3, 0.1, 0.1)  # friction of the joints [N m]
VISCOUS = (2.0, 2.0, 1.0, 1.0, 0.5, 0.2, 0.2)  # [N m s/rad]
GEARS = Elasticity(  # of the order of light arms with strain wave gears; those of the paper's arm are not published
    stiffness=(10e3, 10e3, 8e3, 8e3, 6e3, 4e3, 4e3), inertia=(3.0, 3.0, 2.0, 2.0, 1.0, 0.5, 0.5), damping=10.0
)
RESTING = 150  # rows of the log
SECONDS = 5.0  # of the quick run


def servo_run(
    chart: Chart,
    times: Array,
    wanted: Array,
    rates: Array,
    friction: Friction | None,
    gears: Elasticity | None = None,
) -> Array:
    """Joint positions (N, n) of servos that are asked for positions (N, n) and rates (N, n), at the rows of the log."""
    robot = chart.problem.robot
    plant = MuJoCoPlant(robot, friction=friction, timestep=TICK, elasticity=gears)
    plant.reset(wanted[0])
    # what a joint feels while the others are free: the diagonal of M is too much, as A1 and A3 are nearly parallel
    sag = np.zeros(robot.n)
    inertia = 1 / np.diagonal(np.linalg.inv(np.array(robot.function("mass_matrix")(wanted[0]))))
    if gears is not None:
        inertia = gears.numbers(robot.n)[1]  # a servo feels its rotor first
    stiffness = np.maximum(BANDWIDTH**2 * inertia, LEAST)
    damping = 2 * RATIO * np.sqrt(stiffness * inertia)
    rows = []
    for k in range(len(times)):
        if k % LOGGED == 0:
            rows.append(plant.q)
        gravity = np.asarray(robot.gravity(wanted[k]), dtype=float).ravel()
        if gears is not None:
            sag = gravity / gears.numbers(robot.n)[0]
        error, rate = wanted[k] + sag - plant.motor_q, rates[k] - plant.motor_dq
        plant.step(stiffness * error + damping * rate + gravity, TICK)
    return np.array(rows)


def coupling(chart: Chart, q: Array, desired: Array) -> dict[str, float]:
    """Largest error of each component of phi while its reference has not moved for 1.5 s, at rows of the log."""
    phi, found = chart.phi(q), {}
    for k, label in enumerate(chart.labels):
        still = 1e-5 * max(1.0, float(np.ptp(desired[:, k])))
        rests = [np.ptp(desired[max(0, i - RESTING) : i + 1, k]) < still for i in range(len(q))]
        found[f"coupling_{label}"] = float(np.abs(phi[rests, k] - desired[rests, k]).max(initial=0.0))
    return found


def write_log(path: Path, chart: Chart, times: Array, q: Array, desired: Array) -> None:
    """A CSV file that `python -m examples.paper fig28 --log` draws."""
    names = chart.problem.robot.joint_names
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time_s", *names, *(f"desired_{label}" for label in chart.labels)])
        writer.writerows(np.column_stack([times, q, desired]).round(9).tolist())


def main(out: Path, quick: bool = False) -> dict[str, dict[str, float]]:
    """Largest errors of task and coordinates, for ideal joints, and for servos with rigid and elastic gears.

    Args:
        out: folder for logs and pictures.
        quick: the first seconds only.
    """
    out.mkdir(parents=True, exist_ok=True)
    chart = arm_chart(quick, USUAL)
    reference = journey(chart)
    run = simulate(Kinematic(chart, 0.0, np.inf), reference, chart.problem.domain.centre)
    times = np.arange(0.0, SECONDS if quick else reference.duration, TICK)
    wanted, rates, desired = (
        np.column_stack([np.interp(times, run.times, column) for column in rows.T])
        for rows in (run.q, run.dq, run.reference)
    )
    logged = slice(None, None, LOGGED)
    friction = Friction(VISCOUS, COULOMB)
    rows = {
        "ideal": wanted[logged],
        "servos": servo_run(chart, times, wanted, rates, None),
        "with friction": servo_run(chart, times, wanted, rates, friction),
        "elastic gears": servo_run(chart, times, wanted, rates, None, GEARS),
        "elastic, with friction": servo_run(chart, times, wanted, rates, friction, GEARS),
    }
    found = {}
    for name, q in rows.items():
        path = out / f"fig28_{name.replace(',', '').replace(' ', '_')}.csv"
        write_log(path, chart, times[logged], q, desired[logged])
        drawing = draw_log(path, chart)
        drawing.figures[""].savefig(path.with_suffix(".png"), dpi=110)
        found[name] = dict(drawing.numbers) | coupling(chart, q, desired[logged])
    print("\n".join(table(found, chart, "largest_error")))
    print("\n".join(table(found, chart, "coupling")))
    return found


def table(found: dict[str, dict[str, float]], chart: Chart, what: str) -> list[str]:
    """One kind of number for each component of phi, the task in mm, a line for each kind of joints."""
    m, last = chart.m, [] if what == "coupling" else ["joint_difference_of_end_and_start_rad"]
    units = [f"{label} [mm]" for label in chart.labels[:m]] + list(chart.labels[m:])
    lines = [f"| joints | {' | '.join(units)} |" + " at the end [rad] |" * len(last)]
    lines.append("| --- |" + " --- |" * (len(units) + len(last)))
    for name, numbers in found.items():
        cells = [numbers[f"{what}_{label}"] * (1e3 if k < m else 1) for k, label in enumerate(chart.labels)]
        cells += [numbers[key] for key in last]
        lines.append(f"| {name} | {' | '.join(f'{value:.2g}' for value in cells)} |")
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    main(arguments.out, arguments.quick)
