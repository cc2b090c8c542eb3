"""Passivity: the energy of robot and springs along random runs, with coordinates and with projectors (1 min).

V is the kinetic energy plus the energy in all springs, at constant references. Impedance control in a chart gives
dV/dt = -dq^T J^T D J dq. So V never rises if D is positive semi-definite, whatever the quality of the chart, and with
coupled or decoupled inertia. The paper's damping (29) can be indefinite, so D is the other design here. A projector P
removes part of the torque tau_q of the posture spring, but all of dq stretches the spring. This adds
tau_q^T (P - I) dq to dV/dt, which can have either sign, and V rises.

Every run has its own start, velocity, stiffness and reference. The reference combines the task value of one posture
with the coordinates (or joint positions) of another.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import orthocas as oc
from orthocas.control import Impedance, Reference
from orthocas.control.operational_space import Coupling
from orthocas.simulation import Trajectory

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))

from baselines import Projector

DURATION, STEP = 3.0, 0.01  # [s]
TOLERANCE = 1e-10  # of CVODES
RISE = 1e-8  # smallest rise that counts, relative to V(0); V differs by some 1e-9 from runs at tolerance 1e-12
NEAR, AWAY, SPEED = 0.2, 0.1, 0.2  # start from the centre [rad], target from the start [rad], start speed [rad/s]
EVEN = (1000.0, 30.0, 150.0, 1.0)  # weights of the fit, with gradients of even lengths
STYLES = {
    "impedance, coupled": ("#1b9e77", "-"),
    "impedance, decoupled": ("#66c2a5", "--"),
    "projector, A = I": ("#d95f02", "-"),
    "projector, A = M": ("#7570b3", "-"),
}


@dataclass(frozen=True)
class Arm:
    """A chart, and ranges of stiffness, drawn uniformly in the logarithm."""

    name: str
    chart: oc.Chart
    runs: int
    task: tuple[float, float]  #: [N/m]
    xi: tuple[float, float]  #: [J]
    posture: tuple[float, float]  #: [N m/rad]


@dataclass(frozen=True)
class Found:
    """The results of all runs of one controller."""

    rises: np.ndarray  #: largest rise of V divided by V(0), for the runs that stayed in the domain
    left: int  #: number of runs that left the domain, where the controller only compensates gravity
    worst: Trajectory  #: the run with the largest rise


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Run all cases, and draw the energy of one run and the rises of all runs.

    Args:
        out: folder for the picture.
        quick: few runs of the planar arm only.

    Returns:
        Runs with a rise, the largest rise over V(0) and runs that left the domain, by arm and controller; and the
        number of stiffnesses for which the damping (29) is indefinite somewhere in the domain.
    """
    out.mkdir(parents=True, exist_ok=True)
    arms = [planar(3)] if quick else [planar(100), iiwa(4)]
    found = {arm.name: {name: run_all(arm, name) for name in STYLES} for arm in arms}
    figure = Figure(figsize=(10.5, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_worst(left, arms[0], found[arms[0].name])
    draw_rises(right, found[arms[0].name])
    figure.savefig(out / "passivity.png", dpi=150)
    rows = {f"{arm}, {name}": row for arm, by_name in found.items() for name, row in by_name.items()}
    values = {f"{case}: {key}": value for case, row in rows.items() for key, value in numbers(row).items()}
    return values | {f"{arm.name}: stiffnesses with an indefinite (29)": indefinite(arm) for arm in arms}


def planar(runs: int) -> Arm:
    """The planar arm with three joints and task x, in a box wide enough for oscillations of the light wrist."""
    known = oc.problems.get("planar_3r_x")
    problem = oc.Problem(known.robot, known.task, "inertia", oc.Box((0.6, 0.9, 1.0), (0.7, 0.85, 1.4)))
    chart = oc.fit(problem, oc.Polynomial(4), weights=EVEN).chart
    return Arm("planar 3R", chart, runs, (50, 500), (50, 500), (30, 300))


def iiwa(runs: int) -> Arm:
    """The 7-DoF arm, flange position, A = I."""
    chart = oc.fit(oc.problems.get("iiwa"), oc.Polynomial(4)).chart
    return Arm("7-DoF", chart, runs, (200, 2000), (5, 50), (5, 50))


def run_all(arm: Arm, name: str) -> Found:
    """All runs of one controller; every controller has the same seed, so that the starts are the same."""
    rises, worst, left = [0.0], None, 0
    for controller, reference, q, dq in cases(arm, name):
        run = oc.simulate(
            controller, reference, q, dq_start=dq, step=STEP, must_be_reachable=False, tolerance=TOLERANCE
        )
        if run.status.any():
            left += 1
            continue
        rises.append(run.storage_rise / run.storage[0])
        if worst is None or rises[-1] == max(rises):
            worst = run
    assert worst is not None
    return Found(np.array(rises[1:]), left, worst)


def cases(arm: Arm, name: str) -> Iterator[tuple[Impedance | Projector, Reference, np.ndarray, np.ndarray]]:
    """Controller, reference, start and velocity of each run."""
    rng, chart = np.random.default_rng(0), arm.chart
    n, m = chart.n, chart.m
    problem = chart.problem
    plain = oc.Problem(problem.robot, problem.task, "inertia" if name.endswith("M") else "euclidean", problem.domain)
    for _ in range(arm.runs):
        start = problem.domain.centre + rng.uniform(-NEAR, NEAR, n)
        for_task, for_rest = start + rng.uniform(-AWAY, AWAY, (2, n))
        speed = rng.normal(0, SPEED, n)
        task, xi, posture = (
            np.exp(rng.uniform(np.log(span[0]), np.log(span[1]), size))
            for span, size in ((arm.task, m), (arm.xi, chart.r), (arm.posture, n))
        )
        controller: Impedance | Projector
        if name.startswith("projector"):
            controller, rest = Projector(plain, task, posture), for_rest
        else:
            coupling: Coupling = "decoupled" if name.endswith("decoupled") else "coupled"
            controller = Impedance(chart, np.concatenate([task, xi]), coupling=coupling, damping="double_diagonal")
            rest = chart.xi(for_rest)
        target = np.concatenate([chart.x(for_task), rest])
        yield controller, Reference.steps(controller.labels, target, [], DURATION), start, speed


def indefinite(arm: Arm) -> float:
    """Number of stiffnesses of coupled impedance control for which the damping (29) is indefinite somewhere."""
    drawn = (controller.stiffness for controller, *_ in cases(arm, "impedance, coupled"))
    checks = [Impedance(arm.chart, stiffness, damping="square_root").check_damping(100) for stiffness in drawn]
    return float(sum(check.smallest_eigenvalue < 0 for check in checks))


def numbers(found: Found) -> dict[str, float]:
    """The numbers of one controller."""
    return {
        "runs that stayed": float(len(found.rises)),
        "runs that left": float(found.left),
        "runs with a rise": float(np.count_nonzero(found.rises > RISE)),
        "largest rise": float(found.rises.max()),
    }


def draw_worst(axes: Axes, arm: Arm, found: dict[str, Found]) -> None:
    """Draw V over time for the worst run of each controller."""
    for name, row in found.items():
        colour, style = STYLES[name]
        axes.plot(row.worst.times, row.worst.storage / row.worst.storage[0], style, color=colour, label=name)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("V(t) / V(0)")
    axes.set_title(f"{arm.name}: energy, the run with the largest rise", fontsize=10)
    axes.set_xlim(0, DURATION)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def draw_rises(axes: Axes, found: dict[str, Found]) -> None:
    """Draw the rises of all runs in order of size; rises too small to count lie on the axis."""
    for name, row in found.items():
        colour, style = STYLES[name]
        shown = np.sort(np.maximum(row.rises, RISE))[::-1]
        count = np.count_nonzero(row.rises > RISE)
        label = f"{name}: {count} of {len(row.rises)}"
        axes.plot(np.arange(1, len(shown) + 1), shown, style, color=colour, label=label, clip_on=False)
    axes.set_yscale("log")
    axes.set_ylim(RISE, 1)
    axes.set_xlim(1, None)
    axes.set_xlabel("runs, by size of the rise")
    axes.set_ylabel("largest rise of V over V(0)")
    axes.set_title(f"runs in which V rises (by more than {RISE:g} of V(0))", fontsize=10)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for key, number in main(arguments.out, arguments.quick).items():
        print(f"{key:>60}: {number:.4g}")
