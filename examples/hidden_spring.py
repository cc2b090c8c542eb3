"""A posture spring hides behind a projector and then discharges; a spring in xi does not (3 s).

The arm and both springs are those of Fig. 2 (`python -m examples.paper fig02`). At 1 s, both controllers get a target
posture half a turn along the self-motion curve; at 8 s, a tip target 0.1 m nearer to the base. The projector cancels
the torque of the posture spring, which stays loaded until the small motion of the tip frees it. The spring of impedance
control in the chart has no such minimum: it is loaded while the arm moves, and then relaxes.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from paper.hidden_spring import POSTURE_STIFFNESS, XI_STIFFNESS, HiddenSpring

import orthocas as oc
from orthocas.control import Impedance, Reference
from orthocas.simulation import Trajectory

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))

from baselines import Projector

TASK_STIFFNESS = 500.0  # [N/m]
POSTURE_AT, TIP_AT, DURATION = 1.0, 8.0, 16.0  # [s]
NEARER = 0.5  # final distance of the tip from the base [m]
NATURAL_FREQUENCY = 2.0  # of the low-pass filter [rad/s]
COLOURS = {"projector": "#d95f02", "impedance": "#1b9e77"}
TITLES = {"projector": "posture spring behind a projector", "impedance": "spring in ξ, impedance control"}


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Run both controllers, and draw energy, speed and postures.

    Args:
        out: folder for the picture.
        quick: coarser time steps.

    Returns:
        Energies in the springs [J], torques [N m] just before the tip moves, and peak joint speeds [rad/s].
    """
    out.mkdir(parents=True, exist_ok=True)
    spring = HiddenSpring()
    runs = {"projector": projected(spring, quick), "impedance": geodetic(spring, quick)}
    energies = {
        "projector": (runs["projector"].value - runs["projector"].reference)[:, 2:] ** 2 @ POSTURE_STIFFNESS / 2,
        "impedance": (runs["impedance"].value - runs["impedance"].reference)[:, 2] ** 2 * XI_STIFFNESS / 2,
    }
    draw(spring, runs, energies).savefig(out / "hidden_spring.png", dpi=150)
    found: dict[str, float] = {}
    for name, run in runs.items():
        before = np.searchsorted(run.times, TIP_AT - 1e-9)
        speed = np.abs(run.dq).max(axis=1)
        found |= {
            f"{name}_energy_on_the_way_J": float(energies[name][:before].max()),
            f"{name}_energy_before_tip_moves_J": float(energies[name][before]),
            f"{name}_energy_at_the_end_J": float(energies[name][-1]),
            f"{name}_speed_before_tip_moves": float(speed[before]),
            f"{name}_peak_speed_after": float(speed[before:].max()),
            f"{name}_tip_error_after_m": float(np.linalg.norm((run.value - run.reference)[before:, :2], axis=1).max()),
            f"{name}_instants_without_command": float(np.count_nonzero(run.status)),
        }
    stuck = runs["projector"].q[np.searchsorted(runs["projector"].times, TIP_AT - 1e-9)]
    return found | {
        "hidden_torque_Nm": float(np.linalg.norm(spring.posture_torque(stuck))),
        "projected_torque_Nm": abs(spring.projected_torque(stuck)),
        "distance_from_predicted_point_rad": float(np.linalg.norm(stuck - spring.stuck)),
    }


def projected(spring: HiddenSpring, quick: bool) -> Trajectory:
    """Classical null-space impedance control, with the goal as the target of the posture spring."""
    controller = Projector(spring.problem, TASK_STIFFNESS, POSTURE_STIFFNESS)
    labels = controller.labels
    start = np.concatenate([spring.chart.x(spring.start), spring.start])
    posture = dict(zip(labels[2:], spring.goal, strict=True))
    return run(controller, steps(labels, start, posture), spring, quick)


def geodetic(spring: HiddenSpring, quick: bool) -> Trajectory:
    """Impedance control in the chart, with the value of xi at the goal as its target."""
    controller = Impedance(spring.chart, (TASK_STIFFNESS, TASK_STIFFNESS, XI_STIFFNESS))
    posture = {"xi1": float(spring.chart.xi(spring.goal)[0])}
    return run(controller, steps(controller.labels, spring.chart.phi(spring.start), posture), spring, quick)


def steps(labels: tuple[str, ...], start: np.ndarray, posture: dict[str, float]) -> Reference:
    """First the posture, then the tip."""
    changes = [(POSTURE_AT, posture), (TIP_AT, {labels[0]: NEARER})]
    return Reference.steps(labels, start, changes, DURATION, natural_frequency=NATURAL_FREQUENCY)


def run(controller: Projector | Impedance, reference: Reference, spring: HiddenSpring, quick: bool) -> Trajectory:
    """Simulate the closed loop from rest."""
    return oc.simulate(controller, reference, spring.start, step=0.05 if quick else 0.01)


def draw(spring: HiddenSpring, runs: dict[str, Trajectory], energies: dict[str, np.ndarray]) -> Figure:
    """Draw energy and speed over time, and the arm before and after the tip moves."""
    figure = Figure(figsize=(10.5, 5.4), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(1.7, 1, 1))
    energy, speed = (figure.add_subplot(grid[row, 0]) for row in range(2))
    for name, found in runs.items():
        energy.plot(found.times, energies[name], color=COLOURS[name], label=TITLES[name])
        speed.plot(found.times, np.abs(found.dq).max(axis=1), color=COLOURS[name])
    for axes, label in ((energy, "energy in the spring [J]"), (speed, "largest joint speed [rad/s]")):
        axes.set_ylabel(label, fontsize=9)
        axes.grid(alpha=0.3)
        axes.margins(x=0)
        axes.set_ylim(0, 1.15 * axes.get_ylim()[1])
        for time, text in ((POSTURE_AT, " new posture"), (TIP_AT, " tip 0.1 m nearer")):
            axes.axvline(time, color="0.4", linewidth=1, linestyle=":")
            axes.text(time, 0.97, text, transform=axes.get_xaxis_transform(), fontsize=8, color="0.3", va="top")
    energy.legend(fontsize=8, loc="center", bbox_to_anchor=(0.5, 0.35))
    speed.set_xlabel("time [s]", fontsize=9)
    for row, (name, found) in enumerate(runs.items()):
        for column, (begin, end) in enumerate(((0.0, TIP_AT), (TIP_AT, DURATION))):
            axes = figure.add_subplot(grid[row, column + 1])
            draw_arm(axes, spring, found, begin, end, COLOURS[name])
            axes.set_title(f"{name}, {begin:g} to {end:g} s", fontsize=9)
    return figure


def draw_arm(axes: Axes, spring: HiddenSpring, found: Trajectory, begin: float, end: float, colour: str) -> None:
    """Draw the arm every half second, later postures darker and the last one thick."""
    instants = np.arange(begin, end + 1e-9, 0.5)
    q = found.q[np.minimum(np.searchsorted(found.times, instants - 1e-9), len(found.times) - 1)]
    arms = spring.problem.robot.joint_points(q)[:, :, :2]
    for share, points in zip(np.linspace(0.1, 0.5, len(arms)), arms, strict=True):
        axes.plot(*points.T, color=colour, alpha=share, linewidth=1)
    axes.plot(*arms[-1].T, "-o", color=colour, linewidth=2.5, markersize=4)
    axes.plot(0, 0, "s", color="0.2", markersize=6)
    axes.set_xlim(-1.5, 1.5)
    axes.set_ylim(-1.5, 1.5)
    axes.set_aspect("equal")
    axes.set_xticks((-1, 0, 1))
    axes.set_yticks((-1, 0, 1))
    axes.tick_params(labelsize=8)
    axes.set_xlabel("x [m]", fontsize=8)
    axes.set_ylabel("y [m]", fontsize=8)
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for key, number in main(arguments.out, arguments.quick).items():
        print(f"{key:>40}: {number:.4g}")
