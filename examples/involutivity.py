"""How orthogonal can coordinates be? The involutivity defect predicts the angles of fits without a fit (60 s).

The left panel compares the held-out angle of fits with the angle that `oc.involutivity` expects: the defect times the
size of the domain, without a fitted constant. The right panel raises the degree. Where exact coordinates exist, the
angle keeps falling; elsewhere it settles where the defect predicts. (Mutual angles have almost no weight in these
fits.) Angles are root mean square deviations from 90 degrees between coordinate gradients and an orthonormal basis of
the task gradients, both in the metric A.
"""

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import StrMethodFormatter

import orthocas as oc
from orthocas import problems
from orthocas.exact.involutivity import Involutivity
from orthocas.fitting.terms import DEFAULT_WEIGHTS, Weights
from orthocas.tasks.samples import sample_problem

METRICS = {"euclidean": "I", "inertia": "M"}
COLOURS = {
    "planar 3R, xy": "#d95f02",
    "iiwa, yz": "#66a61e",
    "iiwa, xy": "#a6761d",
    "iiwa, xyz": "#1f5fa8",
    "iiwa, pose": "#7570b3",
    "panda, xyz": "#e7298a",
    "ur10, xyz": "#00a6c8",
}
DATA = {  # robots of the package example-robot-data: file, tip, centre of the box [rad]
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand", (0, -0.5, 0, -2, 0, 1.5, 0.7)),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0", (0, -1.2, 1.5, -0.3, 0.5, 0)),
}
DEGREES = range(1, 7)
TASK_FIRST = (1000.0, 0.01, 150.0)  # weights that almost ignore mutual angles, which do not matter here


@dataclass(frozen=True)
class Case:
    """A problem, and the degree of the polynomials that are fitted to it."""

    name: str
    problem: oc.Problem
    degree: int


@dataclass(frozen=True)
class Row:
    """The measurements for one case."""

    case: Case
    found: Involutivity
    angle: float  #: on held-out samples, in the metric [deg]
    task_std: float  #: standard deviation as `oc.evaluate` reports it [deg]


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Fit, print a table and draw both panels.

    Args:
        out: folder for the picture.
        quick: the planar arm only, with few boxes and samples, and one degree.

    Returns:
        Rank correlation of expected and measured angles, measured to expected, and ends of the right panel [deg].
    """
    out.mkdir(parents=True, exist_ok=True)
    cases = list(planar_cases((0.05, 0.2, 0.6))) if quick else [*planar_cases(), *iiwa_cases(), *data_cases()]
    rows = [measured(case, samples=2000 if quick else 10_000) for case in cases]
    for line in table(rows):
        print(line)
    sweeps = {(axes, metric): sweep(axes, metric, quick) for axes in ("x", "xy") for metric in METRICS}
    figure = Figure(figsize=(10.5, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_angles(left, rows)
    draw_sweeps(right, sweeps)
    figure.savefig(out / "involutivity.png", dpi=150)
    expected, angles = np.array([(row.found.expected_angle_deg, row.angle) for row in rows]).T
    return {
        "rank_correlation": float(np.corrcoef(*(x.argsort().argsort() for x in (expected, angles)))[0, 1]),
        "median_ratio": float(np.median(angles / expected)),
        "smallest_ratio": float((angles / expected).min()),
        "largest_ratio": float((angles / expected).max()),
        **{f"{axes}_{METRICS[metric]}": angles[-1].angle for (axes, metric), angles in sweeps.items()},
    }


def planar_cases(half_widths: Iterable[float] = (0.05, 0.1, 0.2, 0.4, 0.6)) -> Iterator[Case]:
    """The planar arm with its tip's position as the task, in boxes of such half-widths [rad]."""
    base = problems.get("planar_3r_xy")
    for metric in METRICS:
        for half_width in half_widths:
            box = oc.Box(base.domain.centre, half_width)
            yield Case("planar 3R, xy", oc.Problem(base.robot, base.task, metric, box), 4)


def iiwa_cases() -> Iterator[Case]:
    """The 7-DoF arm with parts of its flange position, and its pose."""
    base = problems.get("iiwa")
    for kind in ("position:yz", "position:xy", "position:xyz", "pose"):
        task = oc.Task.named(base.robot, kind, base.domain.centre)
        for metric in METRICS:
            degree = 4 if kind == "position:xy" and metric == "euclidean" else 3  # degree 3 is too low for this case
            for half_width in (0.05, 0.2, 0.4) if kind == "pose" else (0.05, 0.2, np.pi / 4):
                box = oc.Box(base.domain.centre, half_width)
                name = f"iiwa, {kind.removeprefix('position:')}"
                yield Case(name, oc.Problem(base.robot, task, metric, box), degree)


def data_cases() -> Iterator[Case]:
    """Two more arms, if the package example-robot-data is installed (`pip install orthocas[test]`)."""
    try:
        entries = files("example-robot-data") or []
    except PackageNotFoundError:
        return
    for name, (relative, tip, centre) in DATA.items():
        (path,) = (entry.locate() for entry in entries if str(entry).endswith(f"robots/{relative}"))
        robot = oc.Robot.from_file(str(path), tip)
        for half_width in (0.1, 0.4):
            yield Case(f"{name}, xyz", oc.Problem(robot, oc.Task.position(robot), domain=oc.Box(centre, half_width)), 3)


def measured(case: Case, weights: Weights = DEFAULT_WEIGHTS, samples: int = 10_000) -> Row:
    """Defect and fit of a case."""
    chart = oc.fit(case.problem, oc.Polynomial(case.degree), weights=weights).chart
    task_std = oc.evaluate(chart, samples).task_angle.std
    return Row(case, oc.involutivity(case.problem), angle_in_metric(chart, samples), task_std)


def angle_in_metric(chart: oc.Chart, samples: int, seed: int = 1) -> float:
    """Root mean square deviation from 90 degrees between dxi_j and an A-orthonormal basis of the task gradients."""
    held_out = sample_problem(chart.problem, samples, seed)
    J = chart.coordinates.jacobian(held_out.points)
    lengths = np.sqrt(np.einsum("sjn,sjn->sj", J, held_out.compute_metric_gradients(J)))
    cosines = held_out.task_basis @ (J / lengths[:, :, None]).transpose(0, 2, 1)
    return float(np.degrees(np.sqrt(np.mean(np.arcsin(np.clip(cosines, -1, 1)) ** 2))))


def sweep(axes: str, metric: str, quick: bool) -> list[Row]:
    """The planar arm in a box of half-width 0.2, for rising degrees."""
    robot, box = problems.get("planar_3r_xy").robot, oc.Box((0.6, 0.8, 0.8), 0.2)
    problem = oc.Problem(robot, oc.Task.position(robot, axes), metric, box)
    degrees = DEGREES[4:5] if quick else DEGREES
    return [measured(Case(f"planar 3R, {axes}", problem, degree), TASK_FIRST) for degree in degrees]


def table(rows: list[Row]) -> list[str]:
    """The numbers, one line per case."""
    lines = ["problem        A  half-width  deg  mean defect  expected  angle in A  ratio  task std (evaluate)"]
    for row in rows:
        problem, found = row.case.problem, row.found
        lines.append(
            f"{row.case.name:<14} {METRICS[problem.metric.name]} {problem.domain.half_width[0]:11.3f} "
            f"{row.case.degree:4d} {found.mean:12.4f} {found.expected_angle_deg:9.3f} {row.angle:11.3f} "
            f"{row.angle / found.expected_angle_deg:6.2f} {row.task_std:12.3f}"
        )
    return lines


def draw_angles(axes: Axes, rows: list[Row]) -> None:
    """Draw expected against measured angles."""
    low, high = 0.02, 30.0
    line = np.array([low, high])
    axes.fill_between(line, line / 2, line * 2, color="0.92", zorder=0)
    axes.plot(line, line, color="0.4", linewidth=1, zorder=1)
    for row in rows:
        axes.scatter(
            row.found.expected_angle_deg,
            row.angle,
            s=34,
            color=COLOURS[row.case.name],
            marker="o" if row.case.problem.metric.is_identity else "s",
            edgecolor="white",
            linewidth=0.5,
            zorder=2,
        )
    shown = {row.case.name for row in rows}
    handles = [Line2D([], [], marker="o", ls="", color=c, label=n) for n, c in COLOURS.items() if n in shown]
    handles += [Line2D([], [], marker=m, ls="", color="0.3", label=f"A = {n}") for n, m in (("I", "o"), ("M", "s"))]
    handles += [Line2D([], [], color="0.4", linewidth=1, label="equal (grey: factor 2)")]
    axes.legend(handles=handles, fontsize=8, loc="upper left")
    for name in ("x", "y"):
        getattr(axes, f"set_{name}scale")("log")
        getattr(axes, f"set_{name}lim")(low, high)
        getattr(axes, f"{name}axis").set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_aspect("equal")
    axes.set_xlabel("expected from the involutivity defect [deg]")
    axes.set_ylabel("angle of the fit, held out [deg]")
    axes.set_title("deviation of the task angle from 90°: expected and reached", fontsize=10)
    axes.grid(alpha=0.3)


def draw_sweeps(axes: Axes, sweeps: dict[tuple[str, str], list[Row]]) -> None:
    """Draw angles by degree, with the expected angle where exact coordinates do not exist."""
    for (task, metric), rows in sweeps.items():
        colour = "#d95f02" if task == "xy" else "#1f5fa8"
        marker, style = ("o", "-") if metric == "euclidean" else ("s", "--")
        label = f"task {task}, A = {METRICS[metric]}" + (" (exact solution exists)" if rows[0].found.exact else "")
        degrees = [row.case.degree for row in rows]
        axes.plot(degrees, [row.angle for row in rows], style, marker=marker, color=colour, markersize=5, label=label)
        if not rows[0].found.exact:
            expected = rows[0].found.expected_angle_deg
            above = rows[-1].angle < expected
            axes.axhline(expected, color="0.4", linestyle=":", linewidth=1.2)
            axes.annotate(
                "expected",
                (degrees[-1], expected),
                xytext=(0, 4 if above else -4),
                textcoords="offset points",
                ha="right",
                va="bottom" if above else "top",
                fontsize=8,
                color="0.3",
            )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_xlabel("degree of the polynomials")
    axes.set_ylabel("angle of the fit, held out [deg]")
    axes.set_title("planar 3R, box of half-width 0.2 rad", fontsize=10)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, value in main(arguments.out, arguments.quick).items():
        print(f"{name:>16}: {value:.3g}")
