"""Self-motion on command: the tool of the 7-DoF arm holds still while each xi follows steps (30 s).

Each xi goes up, down and back, with steps that move the joints by about 0.4 rad. Velocity control with A = I keeps the
tool in place, up to integration errors. So does coupled PD+ on the full dynamics, in any chart, because it uses the
full inertia in the coordinates. Decoupled PD+ relies on condition (5) in the metric M, so the tool moves by as much as
the chart violates it.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import orthocas as oc
from orthocas.control import Kinematic, PDPlus, Reference
from orthocas.control.operational_space import Coupling
from orthocas.simulation import Trajectory

MOTION = 0.4  # motion of the joint that moves most, per step [rad]
FIRST, PAUSE, REST = 0.5, 1.5, 2.0  # time of the first step, between steps, and extra time after the last step [s]
BANDWIDTH = 15.0  # of PD+ [rad/s]: K = BANDWIDTH^2 times the inertia of each coordinate at the start
TOLERANCE = 1e-10
EVEN = (1000.0, 30.0, 150.0, 1.0)  # weights of the fit with A = M, with gradients of even lengths
COLOURS = ("#1f5fa8", "#d95f02", "#1b9e77", "#7570b3")


@dataclass(frozen=True)
class Case:
    """A chart, and the controller that follows the steps in it."""

    name: str
    chart: oc.Chart
    law: Kinematic | PDPlus


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Run all cases, and draw postures, coordinates and the motion of the tool.

    Args:
        out: folder for the picture.
        quick: a coarser chart, and no chart with A = M.

    Returns:
        Motion of the tool [m], motion of the joints and their final distance from the start [rad], by case; and the
        task angles of the charts [deg].
    """
    out.mkdir(parents=True, exist_ok=True)
    problem = oc.problems.get("iiwa")
    charts = {"A = I": oc.fit(problem, oc.Polynomial(2 if quick else 4)).chart}
    cases = [Case("velocity, A = I", charts["A = I"], Kinematic(charts["A = I"], 0.0, np.inf))]
    cases += [pd_plus("A = I", charts["A = I"], coupling) for coupling in ("coupled", "decoupled")]
    if not quick:
        inertia = oc.Problem(problem.robot, problem.task, "inertia", problem.domain)
        charts["A = M"] = oc.fit(inertia, oc.Polynomial(3), weights=EVEN).chart
        cases.append(pd_plus("A = M", charts["A = M"], "decoupled"))
    runs = [follow(case) for case in cases]
    draw(cases, runs).savefig(out / "self_motion_on_command.png", dpi=150)
    found: dict[str, float] = {}
    for case, run in zip(cases, runs, strict=True):
        away = np.abs(run.q - run.q[0])
        found |= {
            f"{case.name}: tool moves [m]": float(tool_motion(case, run).max()),
            f"{case.name}: joints move [rad]": float(away.max()),
            f"{case.name}: joints at the end [rad]": float(away[-1].max()),
            f"{case.name}: instants without command": float(np.count_nonzero(run.status)),
        }
    for name, chart in charts.items():
        found[f"task angle of the chart with {name}, std [deg]"] = oc.evaluate(chart, 5_000).task_angle.std
    return found


def pd_plus(metric: str, chart: oc.Chart, coupling: Coupling) -> Case:
    """PD+ with the same bandwidth for all coordinates."""
    q = chart.problem.domain.centre
    J, M = chart.jacobian(q), np.asarray(chart.problem.robot.mass_matrix(q))
    inertia = np.linalg.inv(J @ np.linalg.solve(M, J.T))
    return Case(f"PD+ {coupling}, {metric}", chart, PDPlus(chart, BANDWIDTH**2 * np.diag(inertia), coupling=coupling))


def steps(chart: oc.Chart) -> Reference:
    """Steps of each xi up, down and back, with all other targets constant."""
    q = chart.problem.domain.centre
    start, columns = chart.phi(q), np.linalg.inv(chart.jacobian(q))[:, chart.m :]
    sizes = MOTION / np.abs(columns).max(axis=0)
    places = [(chart.m + k, factor * size) for k, size in enumerate(sizes) for factor in (1, -1, 0)]
    changes = [(FIRST + PAUSE * i, {chart.labels[j]: float(start[j] + move)}) for i, (j, move) in enumerate(places)]
    return Reference.steps(chart.labels, start, changes, FIRST + PAUSE * len(places) + REST)


def follow(case: Case) -> Trajectory:
    """Simulate from rest at the centre of the domain; the status of the run tells whether it stays inside."""
    start = case.chart.problem.domain.centre
    return oc.simulate(case.law, steps(case.chart), start, must_be_reachable=False, tolerance=TOLERANCE)


def tool_motion(case: Case, run: Trajectory) -> np.ndarray:
    """Distance of the tool from its start, (N,) [m]."""
    return np.asarray(np.linalg.norm(run.value[:, : case.chart.m] - run.value[0, : case.chart.m], axis=1))


def draw(cases: list[Case], runs: list[Trajectory]) -> Figure:
    """Draw postures at the ends of the steps, coordinates over time, and the motion of the tool."""
    figure = Figure(figsize=(10.5, 7.4), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=(1, 1.15))
    top, bottom = halves
    for k in range(cases[0].chart.r):
        draw_postures(top.add_subplot(1, cases[0].chart.r, k + 1, projection="3d"), cases[0].chart, runs[0], k)
    left, right = bottom.subplots(1, 2)
    draw_coordinates(left, cases[0].chart, runs[0])
    draw_tool(right, cases, runs)
    return figure


def draw_postures(axes: Any, chart: oc.Chart, run: Trajectory, k: int) -> None:
    """Draw the arm with xi_k up, down and back, seen from the front."""
    ends = FIRST + PAUSE * np.arange(3 * k + 1, 3 * k + 4)
    arms = chart.problem.robot.joint_points(run.q[np.searchsorted(run.times, ends - 1e-6)])
    for points, strength, width in zip(arms, (0.9, 0.45, 1.0), (1.8, 1.8, 1.0), strict=True):
        colour = "#222222" if width == 1.0 else COLOURS[k]
        axes.plot(*points.T, "-o", color=colour, alpha=strength, linewidth=width, markersize=3)
    low, high = np.array([[-0.15, -0.3, 0.0], [0.75, 0.3, 0.9]])
    for name, least, most in zip("xyz", low, high, strict=True):
        getattr(axes, f"set_{name}lim")(least, most)
    axes.plot([0, 0.5], [0, 0], [0, 0], color="0.6", linewidth=0.8)
    axes.plot([0, 0], [-0.3, 0.3], [0, 0], color="0.6", linewidth=0.8)
    axes.text(0.55, 0, 0, "x", fontsize=8, color="0.4")
    axes.text(0, 0.33, 0, "y", fontsize=8, color="0.4")
    axes.set_axis_off()
    axes.set_box_aspect(high - low, zoom=1.5)
    axes.view_init(elev=22, azim=-40)
    still = np.abs(arms - arms[-1]).max() < 1e-6
    what = "turns the flange only" if still else "up, down (pale), back (black)"
    axes.set_title(rf"$\xi_{k + 1}$ {what}", fontsize=9)


def draw_coordinates(axes: Axes, chart: oc.Chart, run: Trajectory) -> None:
    """Draw coordinates over time, relative to their values at the start."""
    for k, (values, colour) in enumerate(zip(run.value[:, chart.m :].T, COLOURS, strict=True)):
        axes.plot(run.times, values - values[0], color=colour, label=rf"$\xi_{k + 1}$")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("coordinates relative to the start [1]")
    axes.set_title("commanded motion: velocity control, A = I", fontsize=10)
    axes.legend(fontsize=8, loc="upper right", ncols=4)
    axes.set_ylim(-0.6, 0.75)
    axes.grid(alpha=0.3)
    axes.margins(x=0)


def draw_tool(axes: Axes, cases: list[Case], runs: list[Trajectory]) -> None:
    """Draw the distance of the tool from its start, on a logarithmic axis."""
    for case, run, colour in zip(cases, runs, ("#1b9e77", "#1f5fa8", "#d95f02", "#7570b3"), strict=False):
        away = tool_motion(case, run)
        axes.plot(run.times[1:], np.maximum(away[1:], 1e-13), color=colour, label=f"{case.name}: {away.max():.1e} m")
    axes.set_yscale("log")
    axes.set_ylim(1e-13, 1e2)
    axes.set_yticks(10.0 ** np.arange(-12, 0, 2))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("tool distance from its start [m]")
    axes.set_title("motion of the tool", fontsize=10)
    axes.legend(fontsize=7, loc="upper center", ncols=2, columnspacing=1)
    axes.grid(alpha=0.3)
    axes.margins(x=0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for key, number in main(arguments.out, arguments.quick).items():
        print(f"{key:>60}: {number:.4g}")
