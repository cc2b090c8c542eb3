"""Quality against seconds on the 7-DoF arm, for all families in one picture, with PyTorch's points.

Every fit runs alone in a process with one thread. Seconds are those of the processor, so that other work on the machine
changes them little. Angles are measured on 100,000 held-out samples. PyTorch trains the network of
`benchmarks/torch_peer.py` with three schedules, if it is installed.

`--only WORDS` measures the fits whose row contains these words, and draws no picture. `--wall` takes seconds of the
clock with the machine's threads, for a quiet machine.
"""

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

import orthocas as oc
from orthocas import bases, problems


class Point(NamedTuple):
    """One fit."""

    family: str
    label: str
    seconds: float
    task: float  #: std [deg]
    mutual: float  #: std [deg]
    least: float  #: conditioning, 0 where the chart folds over


class Case(NamedTuple):
    """What one fit does."""

    family: str
    label: str
    weights: oc.Weights
    precision: str = "double"


FREE, SAFE = oc.Weights(folds=0), oc.Weights()
WITHOUT_TERMS = oc.Weights(regularity=0, folds=0)
SINGLE = "single precision, lambda2 = 36 to 38, without regularity"
FIRM = "the same, lambda2 = 42 and 39"
CASES = (
    *(Case("polynomials, folds allowed", f"polynomial:{degree}", FREE) for degree in (2, 3, 4, 5, 6)),
    *(Case("polynomials, without regularity", f"polynomial:{degree}", WITHOUT_TERMS) for degree in (4, 5, 6, 7)),
    *(
        Case(SINGLE, f"polynomial:{degree}", oc.Weights(mutual=mutual, regularity=0, folds=0), "single")
        for degree, mutual in ((6, 38), (7, 38), (8, 36))
    ),
    *(
        Case(FIRM, f"polynomial:{degree}", oc.Weights(mutual=mutual, regularity=0, folds=0), "single")
        for degree, mutual in ((7, 42), (8, 39))
    ),
    *(Case("polynomials without folds", f"polynomial:{degree}", SAFE) for degree in (4, 5, 6)),
    *(Case("valid for all A1, without folds", f"polynomial:{degree}:cyclic", SAFE) for degree in (4, 5)),
    Case("Fourier, folds allowed", "fourier:2", FREE),
    *(Case("networks, folds allowed", f"mlp:{size}", FREE) for size in ("16x16", "32x32")),
)
SCHEDULES = ((1000, 100, 2e-2), (2000, 500, 5e-3), (4000, 500, 5e-3))  # steps, batch and learning rate of PyTorch
PEER = "PyTorch, 128 x 128, Adam"
PAPER = (2.06, 3.44)
HEADER = (
    "| fit | CPU seconds | task std [deg] | mutual std [deg] | least conditioning |\n| --- | --- | --- | --- | --- |"
)


def measured(case: Case, samples: int, wall: bool) -> Point:
    """Fit and judge."""
    problem, clock = problems.get("iiwa"), time.perf_counter if wall else time.process_time
    oc.fit(problem, oc.Polynomial(1))  # the first call loads libraries
    chosen = bases.parse_parametrisation(case.label)
    start = clock()
    fit = oc.fit(problem, chosen, weights=case.weights, precision=case.precision)
    seconds = clock() - start
    report = oc.evaluate(fit.chart, samples)
    angles = report.task_angle.std, report.mutual_angle.std
    return Point(case.family, case.label, seconds, *angles, report.conditioning.min)


def peer(schedule: tuple[int, int, float], quick: bool) -> Point | None:
    """PyTorch's network with one schedule; None without PyTorch. Its conditioning is not measured."""
    try:
        from torch_peer import PeerSettings, train
    except ModuleNotFoundError:
        return None
    steps, batch, rate = (2, 10, 1e-2) if quick else schedule
    problem = problems.get("iiwa")
    train(problem, PeerSettings(steps=2, batch=batch))
    found = train(problem, PeerSettings(steps=steps, batch=batch, learning_rate=rate))
    label = f"{steps} steps of {batch}"
    return Point(PEER, label, found.seconds, found.task_std_deg, found.mutual_std_deg, float("nan"))


def row(point: Point) -> str:
    """One row of the table."""
    family, label, seconds, task, mutual, least = point
    return f"| {label}, {family} | {seconds:.2f} | {task:.3f} | {mutual:.3f} | {least:.3f} |"


def draw(points: list[Point], file: Path) -> None:
    """Task and mutual angles against seconds, a line for each family."""
    figure = Figure(figsize=(10.5, 5.4), layout="constrained")
    panels = figure.subplots(1, 2)
    by_family: dict[str, list[Point]] = {}
    for point in points:
        by_family.setdefault(point.family, []).append(point)
    for axes, name, paper in zip(panels, ("task", "mutual"), PAPER, strict=True):
        for (family, own), marker in zip(by_family.items(), "osD^vPX*<>", strict=False):
            seconds, values = [p.seconds for p in own], [getattr(p, name) for p in own]
            (line,) = axes.plot(seconds, values, marker=marker, label=family, markersize=9)
            for point, value in zip(own, values, strict=True):
                short = point.label.split(":", 1)[-1].removesuffix(":cyclic")
                if len(short) == 1:  # degrees stand in their markers, where points may be close to each other
                    place: dict[str, Any] = {
                        "ha": "center",
                        "va": "center_baseline",
                        "color": "white",
                        "weight": "bold",
                    }
                else:
                    side = {
                        "16x16": (0, -12, "center"),
                        "32x32": (7, -4, "left"),
                        "1000 steps of 100": (0, 9, "center"),
                    }.get(short, (7, 4, "left"))
                    place = {
                        "xytext": side[:2],
                        "textcoords": "offset points",
                        "ha": side[2],
                        "color": line.get_color(),
                    }
                axes.annotate(short, (point.seconds, value), **place, fontsize=7)
        axes.axhline(paper, color="0.7", linestyle="--", zorder=0)
        axes.set(xscale="log", xlabel="seconds of one thread", title=f"{name} angle, std [deg]")
        axes.margins(x=0.15)
        axes.set_xlim(right=150)  # room for labels
        axes.grid(alpha=0.3, which="both")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False
    )
    panels[1].annotate("the paper's network", (0.72, PAPER[1] + 0.02), xycoords=("axes fraction", "data"), fontsize=7)
    figure.savefig(file, dpi=130)


def main(out: Path, quick: bool = False, only: str = "", wall: bool = False) -> list[Point]:
    """All points, and the picture `front_seconds.png`; `quick` takes two low degrees and few samples."""
    out.mkdir(parents=True, exist_ok=True)
    if not wall:
        os.environ["OMP_NUM_THREADS"] = "1"
    points = []
    chosen = [case for case in (CASES[:2] if quick else CASES) if only in f"{case.label}, {case.family}"]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as alone:
        for case in chosen:
            points.append(alone.submit(measured, case, 2_000 if quick else 100_000, wall).result())
            print(row(points[-1]), flush=True)
        for schedule in SCHEDULES[: 1 if quick else None] if only in PEER else ():
            found = alone.submit(peer, schedule, quick).result()
            if found is not None:
                points.append(found)
                print(row(found), flush=True)
    if not only:
        draw(points, out / "front_seconds.png")
    return points


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default="", metavar="WORDS")
    parser.add_argument("--wall", action="store_true")
    arguments = parser.parse_args()
    print(HEADER)
    main(arguments.out, arguments.quick, arguments.only, arguments.wall)
