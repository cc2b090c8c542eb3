"""How wide may a domain be? Angles grow with the box by geometry, not for lack of basis functions (8 min).

Charts of the 7-DoF arm on cubes around q0, for polynomials of degree 3 to 5. The left panel shows how far the task
angles are off 90 degrees, beside what `oc.involutivity` expects without a fit: the defect times the size of the cube.
Raising the degree changes little, so neither would any number of terms. The middle panel shows the angles between the
coordinates, and the right one the smallest conditioning at samples near faces and corners: around 45 degrees the cube
begins to touch postures where the arm is nearly straight.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from involutivity import angle_in_metric
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

import orthocas as oc
from orthocas import problems
from orthocas.fitting.probe import evaluate_chart

HALF_WIDTHS_DEG = (5, 10, 15, 20, 30, 37, 45, 52, 59)  # A4 meets its limit at 59.8 degrees
DEGREES = (3, 4, 5)
COLOURS = {2: "#7570b3", 3: "#66a61e", 4: "#d95f02", 5: "#1f5fa8"}


@dataclass(frozen=True)
class Row:
    """The measurements for one cube and degree."""

    half_width_deg: float
    degree: int
    angle: float  #: root mean square angle off 90 deg to an orthonormal basis of the task gradients [deg]
    task_std: float  #: as `oc.evaluate` reports it [deg]
    mutual_std: float  #: as `oc.evaluate` reports it [deg]
    conditioning: float  #: smallest, negative where the chart folds over
    expected: float  #: angle expected from the involutivity defect [deg]


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Fit, print a table and draw the three panels.

    Args:
        out: folder for the picture.
        quick: two cubes, two low degrees and fewer samples.

    Returns:
        Growth of the angle with the half-width (exponent) from the smallest cube to 30 degrees, measured and expected;
        the smallest and largest ratio of both up to 30 degrees; and what the highest degree gains over the lowest.
    """
    out.mkdir(parents=True, exist_ok=True)
    degrees = (2, 3) if quick else DEGREES
    widths, samples = ((10, 30), 4000) if quick else (HALF_WIDTHS_DEG, 20_000)
    rows = [measured(width, degree, samples) for width in widths for degree in degrees]
    for line in table(rows):
        print(line)
    drawn(rows).savefig(out / "domain_size.png", dpi=150)
    return numbers(rows)


def drawn(rows: list[Row]) -> Figure:
    """The three panels."""
    figure = Figure(figsize=(12.5, 4.2), layout="constrained")
    angles, mutual, conditioning = figure.subplots(1, 3)
    draw(angles, rows, "angle", "task angles: deviation from 90° [deg]")
    draw_expected(angles, rows)
    draw(mutual, rows, "mutual_std", "mutual angles: deviation from 90° [deg]")
    draw_conditioning(conditioning, rows)
    return figure


def measured(half_width_deg: float, degree: int, samples: int) -> Row:
    """Fit on a cube, and judge with held-out samples."""
    known = problems.get("iiwa")
    box = oc.Box(known.domain.centre, np.radians(half_width_deg))
    problem = oc.Problem(known.robot, known.task, domain=box)
    chart = oc.fit(problem, oc.Polynomial(degree), weights=oc.Weights(folds=0)).chart
    report = oc.evaluate(chart, samples)
    return Row(
        half_width_deg,
        degree,
        angle_in_metric(chart, samples),
        report.task_angle.std,
        report.mutual_angle.std,
        evaluate_chart(chart, 3 * samples, seed=1).conditioning,
        oc.involutivity(problem).expected_angle_deg,
    )


def numbers(rows: list[Row]) -> dict[str, float]:
    """The law in a few numbers, from the cubes up to 30 degrees and the highest degree."""
    highest, lowest = max(row.degree for row in rows), min(row.degree for row in rows)
    small = [row for row in rows if row.degree == highest and row.half_width_deg <= 30]
    size = np.log(small[-1].half_width_deg / small[0].half_width_deg)
    ratios = [row.angle / row.expected for row in small]
    coarse = {row.half_width_deg: row.angle for row in rows if row.degree == lowest}
    return {
        "exponent": float(np.log(small[-1].angle / small[0].angle) / size),
        "expected_exponent": float(np.log(small[-1].expected / small[0].expected) / size),
        "smallest_ratio": min(ratios),
        "largest_ratio": max(ratios),
        "gain_of_degree": max(coarse[row.half_width_deg] / row.angle for row in small),
        "conditioning_at_30": small[-1].conditioning,
    }


def table(rows: list[Row]) -> list[str]:
    """The angles, a line for each cube, and what else the highest degree has."""
    by_place = {(row.half_width_deg, row.degree): row for row in rows}
    widths, degrees = (list(dict.fromkeys(part)) for part in zip(*by_place, strict=True))
    last = f"degree {degrees[-1]}"
    named = " | ".join(f"degree {degree}" for degree in degrees)
    lines = [
        f"| half-width [deg] | expected [deg] | {named} | task / mutual std, {last} | least conditioning, {last} |",
        "| --- |" + " --- |" * (3 + len(degrees)),
    ]
    for width in widths:
        row = by_place[width, degrees[-1]]
        angles = " | ".join(f"{by_place[width, degree].angle:.3g}" for degree in degrees)
        least = f"{row.conditioning:.2f}" if row.conditioning > 0 else "folds"
        lines.append(
            f"| {width} | {row.expected:.3g} | {angles} | {row.task_std:.2f} / {row.mutual_std:.2f} | {least} |"
        )
    return lines


def draw(axes: Axes, rows: list[Row], name: str, label: str) -> None:
    """Draw one number over the half-width, a line for each degree."""
    for degree in sorted({row.degree for row in rows}):
        own = [row for row in rows if row.degree == degree]
        widths, values = zip(*((row.half_width_deg, getattr(row, name)) for row in own), strict=True)
        axes.plot(widths, values, "o-", color=COLOURS[degree], markersize=4, linewidth=1.3, label=f"degree {degree}")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.1, 13)
    axes.yaxis.set_major_locator(FixedLocator([0.1, 0.2, 0.5, 1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    _finish(axes, label)


def draw_expected(axes: Axes, rows: list[Row]) -> None:
    """Draw the expectation from the involutivity defect, and proportional growth for comparison."""
    widths, values = zip(*sorted({(row.half_width_deg, row.expected) for row in rows}), strict=True)
    axes.plot(widths, values, "k--", linewidth=1.3, label="expected from the defect, without a fit")
    axes.plot(widths, values[0] * np.array(widths) / widths[0], ":", color="0.5", label="proportional to the size")
    axes.legend(fontsize=8)


def draw_conditioning(axes: Axes, rows: list[Row]) -> None:
    """Draw the smallest conditioning; folds count as zero."""
    for degree in sorted({row.degree for row in rows}):
        own = [row for row in rows if row.degree == degree]
        values = [max(row.conditioning, 0.0) for row in own]
        axes.plot([row.half_width_deg for row in own], values, "o-", color=COLOURS[degree], markersize=4, linewidth=1.3)
    axes.set_xscale("log")
    axes.set_ylim(-0.02, 1.02)
    axes.axhline(0, color="0.4", linewidth=0.8)
    _finish(axes, "least conditioning (0: the chart folds over)")


def _finish(axes: Axes, label: str) -> None:
    axes.xaxis.set_major_locator(FixedLocator([5, 10, 20, 30, 45, 59]))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("half-width of the cube [deg]")
    axes.set_title(label, fontsize=10)
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, value in main(arguments.out, arguments.quick).items():
        print(f"{name:>18}: {value:.3g}")
