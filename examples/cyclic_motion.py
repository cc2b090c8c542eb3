"""The 7-DoF arm repeats a closed tool path 50 times. Where are its joints after each cycle? (10 s).

Pseudo-inverse control uses velocities only, so the joints drift although the tool returns. With constant xi_d, the same
tool pose gives the same joint positions. Only the integration error remains. It falls with the tolerance, and a small
feedback keeps it from growing.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import orthocas as oc
from orthocas.control import Kinematic, Reference
from orthocas.simulation import Trajectory

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))

from baselines import KinematicProjector

RADIUS, PERIOD, POINTS = 0.1, 4.0, 16  # horizontal circle: radius [m], period [s], points of its spline
CYCLES = 50
FEEDBACK = 1.0  # Lambda of the run with feedback [1/s]
TIGHT, LOOSE = 1e-10, 1e-8  # tolerances of CVODES


@dataclass(frozen=True)
class Case:
    """A controller with a tolerance, and its line style."""

    name: str
    law: Kinematic | KinematicProjector
    tolerance: float
    colour: str
    style: str = "-"


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Run all cases, and draw drift and postures.

    Args:
        out: folder for the picture.
        quick: three cycles, and a coarser chart.

    Returns:
        Distance of the joints from their start after one cycle and after all [rad], and tool error [m], by case.
    """
    out.mkdir(parents=True, exist_ok=True)
    cycles = 3 if quick else CYCLES
    chart = oc.fit(oc.problems.get("iiwa"), oc.Polynomial(3 if quick else 4)).chart
    cases = [
        Case("pseudo-inverse", KinematicProjector(chart.problem, limit=np.inf), TIGHT, "#d95f02"),
        Case("pseudo-inverse, loose", KinematicProjector(chart.problem, limit=np.inf), LOOSE, "#222222", ":"),
        Case("xi constant, loose", Kinematic(chart, 0.0, np.inf), LOOSE, "#66c2a5", "--"),
        Case("xi constant", Kinematic(chart, 0.0, np.inf), TIGHT, "#1b9e77"),
        Case("xi constant, feedback", Kinematic(chart, FEEDBACK, np.inf), TIGHT, "#1f5fa8"),
    ]
    runs = [repeat(case, chart, cycles) for case in cases]
    drifts = [drift(run, cycles) for run in runs]
    figure = Figure(figsize=(10.5, 4.8), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.2, 1))
    draw_drifts(figure.add_subplot(grid[:, 0]), cases, drifts)
    for row, k in enumerate((0, 3)):
        draw_postures(figure.add_subplot(grid[row, 1]), chart, cases[k], runs[k], cycles)
    figure.savefig(out / "cyclic_motion.png", dpi=150)
    found: dict[str, float] = {}
    for case, run, away in zip(cases, runs, drifts, strict=True):
        error = np.linalg.norm((run.value - run.reference)[:, :3], axis=1)
        found |= {
            f"{case.name}: drift of the first cycle [rad]": float(away[0]),
            f"{case.name}: drift after {cycles} cycles [rad]": float(away[-1]),
            f"{case.name}: largest tool error [m]": float(error.max()),
            f"{case.name}: instants without command": float(np.count_nonzero(run.status)),
        }
    return found


def repeat(case: Case, chart: oc.Chart, cycles: int) -> Trajectory:
    """Move the tool around the circle, from rest to rest in every cycle."""
    start = chart.problem.domain.centre
    share = np.linspace(0, 1, POINTS, endpoint=False)
    angle = 2 * np.pi * np.append((share**3 * (10 - 15 * share + 6 * share**2) + np.arange(cycles)[:, None]), cycles)
    circle = RADIUS * np.stack([np.cos(angle) - 1, np.sin(angle), np.zeros_like(angle)], axis=1)
    rest = start if isinstance(case.law, KinematicProjector) else chart.xi(start)
    points = np.hstack([chart.x(start) + circle, np.tile(rest, (len(angle), 1))])
    reference = Reference.through(case.law.labels, PERIOD / POINTS * np.arange(len(angle)), points)
    return oc.simulate(case.law, reference, start, step=0.05, tolerance=case.tolerance, must_be_reachable=False)


def drift(run: Trajectory, cycles: int) -> np.ndarray:
    """Distance of the joints from their start after each cycle, (cycles,) [rad]."""
    ends = np.searchsorted(run.times, PERIOD * np.arange(1, cycles + 1) - 1e-6)
    return np.asarray(np.linalg.norm(run.q[ends] - run.q[0], axis=1))


def draw_drifts(axes: Axes, cases: list[Case], drifts: list[np.ndarray]) -> None:
    """Draw the drift over cycles on a logarithmic axis."""
    for case, away in zip(cases, drifts, strict=True):
        label = f"{case.name.replace('xi', 'ξ').removesuffix(', loose')}, tolerance {case.tolerance:.0e}"
        axes.plot(np.arange(1, len(away) + 1), away, case.style, color=case.colour, label=label)
    axes.set_yscale("log")
    axes.set_ylim(1e-10, 1e1)
    axes.set_xlabel("cycles")
    axes.set_ylabel("joint distance from the start, norm [rad]")
    axes.set_title("joint positions after each cycle", fontsize=10)
    axes.legend(fontsize=8, loc="center right", bbox_to_anchor=(1.0, 0.66))
    axes.grid(alpha=0.3)


def draw_postures(axes: Axes, chart: oc.Chart, case: Case, run: Trajectory, cycles: int) -> None:
    """Draw the arm from above at the end of some cycles, later ones darker, and the tool path."""
    shown = np.unique(np.linspace(0, cycles, 6).round())
    arms = chart.problem.robot.joint_points(run.q[np.searchsorted(run.times, PERIOD * shown - 1e-6)])
    axes.plot(*run.value[:, :2].T, color="0.6", linewidth=1, label="tool path")
    axes.plot(*arms[0, :, :2].T, "-o", color="#222222", linewidth=2.5, markersize=5, label="arm at the start")
    for strength, points in zip(np.linspace(0.4, 1, len(arms) - 1), arms[1:], strict=True):
        axes.plot(points[:, 0], points[:, 1], "-o", color=case.colour, alpha=strength, linewidth=1.2, markersize=2.5)
    axes.set_aspect("equal")
    axes.set_xlim(-0.05, 1.15)
    axes.set_ylim(-0.16, 0.2)
    axes.set_xlabel("x [m]", fontsize=9)
    axes.set_ylabel("y [m]", fontsize=9)
    counts = ", ".join(f"{count:g}" for count in shown[1:])
    axes.set_title(f"{case.name.replace('xi', 'ξ')}: from above, after {counts} cycles", fontsize=9)
    axes.legend(fontsize=8, loc="upper right")
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for key, number in main(arguments.out, arguments.quick).items():
        print(f"{key:>60}: {number:.4g}")
