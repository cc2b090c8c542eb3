"""Quality against seconds on the 7-DoF arm, for all families in one picture, with PyTorch's point.

Every fit runs alone in a process with one thread. Seconds are those of the processor, so that other work on the machine
changes them little. Angles are measured on 100,000 held-out samples.
"""

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

import orthocas as oc
from orthocas import problems


class Point(NamedTuple):
    """One fit."""

    family: str
    label: str
    seconds: float
    task: float  #: std [deg]
    mutual: float  #: std [deg]
    least: float  #: conditioning, 0 where the chart folds over


FREE, SAFE = oc.Weights(folds=0), oc.Weights()
WITHOUT_TERMS = oc.Weights(regularity=0, folds=0)
CASES = (
    *(("polynomials, folds allowed", f"polynomial:{degree}", FREE) for degree in (2, 3, 4, 5, 6)),
    *(("polynomials, without regularity", f"polynomial:{degree}", WITHOUT_TERMS) for degree in (4, 5, 6, 7)),
    *(("polynomials without folds", f"polynomial:{degree}", SAFE) for degree in (4, 5, 6)),
    *(("valid for all A1, without folds", f"polynomial:{degree}:cyclic", SAFE) for degree in (4, 5)),
    ("Fourier, folds allowed", "fourier:2", FREE),
    *(("networks, folds allowed", f"mlp:{size}", FREE) for size in ("16x16", "32x32")),
)
PEER = Point("PyTorch, 128 x 128, Adam (wall seconds)", "", 2.14, 2.06, 3.44, 0.0)  # docs/performance.md
PAPER = (2.06, 3.44)
HEADER = (
    "| fit | CPU seconds | task std [deg] | mutual std [deg] | least conditioning |\n| --- | --- | --- | --- | --- |"
)


def measured(case: tuple[str, str, oc.Weights], samples: int) -> Point:
    """Fit and judge."""
    family, label, weights = case
    problem = problems.get("iiwa")
    oc.fit(problem, oc.Polynomial(1))  # the first call loads libraries
    start = time.process_time()
    fit = oc.fit(problem, oc.parametrisations.parse_parametrisation(label), weights=weights)
    seconds = time.process_time() - start
    report = oc.evaluate(fit.chart, samples)
    return Point(family, label, seconds, report.task_angle.std, report.mutual_angle.std, report.conditioning.min)


def row(point: Point) -> str:
    """One row of the table."""
    family, label, seconds, task, mutual, least = point
    return f"| {label}, {family} | {seconds:.2f} | {task:.3f} | {mutual:.3f} | {least:.3f} |"


def draw(points: list[Point], file: Path) -> None:
    """Task and mutual angles against seconds, a line for each family."""
    figure = Figure(figsize=(10.5, 4.6), layout="constrained")
    panels = figure.subplots(1, 2)
    by_family: dict[str, list[Point]] = {}
    for point in (*points, PEER):
        by_family.setdefault(point.family, []).append(point)
    for axes, name, paper in zip(panels, ("task", "mutual"), PAPER, strict=True):
        for (family, own), marker, height in zip(by_family.items(), "osD^vP*", (4, -11) * 4, strict=False):
            seconds, values = [p.seconds for p in own], [getattr(p, name) for p in own]
            axes.plot(seconds, values, marker=marker, label=family, markersize=11 if own[0] is PEER else 5)
            for point, value in zip(own, values, strict=True):
                short = point.label.split(":", 1)[-1].removesuffix(":cyclic")
                axes.annotate(short, (point.seconds, value), xytext=(4, height), textcoords="offset points", fontsize=7)
        axes.axhline(paper, color="0.7", linestyle="--", zorder=0)
        axes.set(xscale="log", xlabel="seconds", title=f"{name} angle, std [deg]")
        axes.grid(alpha=0.3, which="both")
    panels[0].legend(fontsize=7.5, loc="upper right")
    panels[1].annotate("the paper's network", (0.72, PAPER[1] + 0.02), xycoords=("axes fraction", "data"), fontsize=7)
    figure.savefig(file, dpi=130)


def main(out: Path, quick: bool = False) -> list[Point]:
    """All points, and the picture `front_seconds.png`; `quick` takes two low degrees and few samples."""
    out.mkdir(parents=True, exist_ok=True)
    os.environ["OMP_NUM_THREADS"] = "1"
    points = []
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as alone:
        for case in CASES[:2] if quick else CASES:
            points.append(alone.submit(measured, case, 2_000 if quick else 100_000).result())
            print(row(points[-1]), flush=True)
    draw(points, out / "front_seconds.png")
    return points


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    print(HEADER)
    main(arguments.out, arguments.quick)
