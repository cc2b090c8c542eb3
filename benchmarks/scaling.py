"""How time, memory and quality of a fit grow with joints, degree and metric (5 min).

Arms of random shape, position, degree 2, in boxes of 0.3 rad; then the 7-DoF arm by degree with both metrics. Seconds
are of a core. Each fit has a process of its own, whose largest memory is reported, and so each time includes what the
first fit of a process builds. C of x, xi and their gradients is compiled with gcc -O3 -march=native. `--quick` takes
two small cases; the picture `growth.png` is drawn into `--out`.
"""

import argparse
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from resource import RUSAGE_SELF, getrusage

import casadi as ca
import numpy as np
from arm import random_arm
from benchmark import table
from c_timing import nanoseconds_per_call
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

import orthocas as oc
from orthocas import problems

JOINTS = (6, 8, 10, 12, 16, 20, 25, 30)
EXPONENT_FROM = 12  # joints from which the exponent is fitted
SEED, WIDTH = 0, 0.3
HEADER = (
    "| arm | n, m, r | metric | degree | parameters | samples | fit [s] | memory [MiB] | leak rms [deg] "
    "| least conditioning | C of x, ξ and gradients [us] |\n|" + " --- |" * 11
)


@dataclass(frozen=True)
class Case:
    """A fit to measure."""

    joints: int  #: of a random arm; 0 is the 7-DoF arm
    degree: int
    metric: str = "euclidean"

    def problem(self) -> oc.Problem:
        """The problem; a random arm has its first random posture at which the task is regular."""
        if not self.joints:
            known = problems.get("iiwa")
            return oc.Problem(known.robot, known.task, self.metric, known.domain, "iiwa")
        robot = random_arm(SEED, self.joints)
        for q in np.random.default_rng(SEED).uniform(-1, 1, (100, self.joints)):
            try:
                return oc.Problem(robot, oc.Task.position(robot), self.metric, oc.Box(q, WIDTH), "random")
            except oc.OrthocasError:
                continue
        raise RuntimeError("no regular posture")


@dataclass(frozen=True)
class Measured:
    """What a fit took, and how good it is."""

    case: Case
    row: str
    seconds: float
    memory: float  #: [MiB]
    tick: float  #: [us]


def measure(case: Case) -> Measured:
    """Fit in this process."""
    problem = case.problem()
    began = time.process_time()
    fit = oc.fit(problem, oc.Polynomial(case.degree))
    seconds = time.process_time() - began
    memory = getrusage(RUSAGE_SELF).ru_maxrss / 1024
    report = oc.evaluate(fit.chart, 20_000)
    leak = (report if report.without_idle is None else report.without_idle).leak.rms
    q = ca.SX.sym("q", problem.n)
    phi, J = fit.chart.function("phi")(q), fit.chart.function("jacobian")(q)
    (tick,) = nanoseconds_per_call({"chart": ca.Function("chart", [q], [phi, J])}, rounds=15, calls=2000).values()
    least, last = "-" if fit.worst is None else f"{fit.worst.least:.2f}", fit.stages[-1]
    sizes, metric = f"{problem.n}, {problem.m}, {problem.r}", "A = I" if problem.metric.is_identity else "A = M"
    row = (
        f"| {problem.name} | {sizes} | {metric} | {case.degree} | {last.parameters} | {last.samples} "
        f"| {seconds:.2f} | {memory:.0f} | {leak:.2f} | {least} | {tick / 1e3:.2f} |"
    )
    return Measured(case, row, seconds, memory, tick / 1e3)


def choose_cases(quick: bool) -> list[Case]:
    """By joints; by degree and metric."""
    if quick:
        return [Case(6, 2), Case(0, 2)]
    cases = [Case(n, 2) for n in JOINTS]
    return cases + [Case(0, degree, metric) for metric in ("euclidean", "inertia") for degree in (2, 3, 4, 5)]


def draw(found: list[Measured], file: Path) -> None:
    """Seconds, memory and ticks against the number of joints, with the exponents of many joints."""
    arms = [point for point in found if point.case.joints]
    n = np.array([point.case.joints for point in arms])
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    many = n >= EXPONENT_FROM
    for axes, name, title in zip(
        figure.subplots(1, 3),
        ("seconds", "memory", "tick"),
        ("fit [s]", "memory [MiB]", "C of x, ξ, J [us]"),
        strict=True,
    ):
        values = np.array([getattr(point, name) for point in arms])
        axes.plot(n, values, "o-", color="#1f5fa8")
        if many.sum() > 1:
            slope, height = np.polyfit(np.log(n[many]), np.log(values[many]), 1)
            axes.plot(n[many], np.exp(height) * n[many] ** slope, "--", color="#d94801", label=f"$n^{{{slope:.1f}}}$")
            axes.legend(frameon=False)
        axes.set(xscale="log", yscale="log", xlabel="joints n", title=title)
        axes.set_xticks(n, [str(k) for k in n], minor=False)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=130)


def main(quick: bool = False, out: Path | None = None) -> list[str]:
    """All rows, and the picture `growth.png` in a folder."""
    found: list[Measured] = []

    def rows() -> Iterator[str]:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
            for measured in pool.map(measure, choose_cases(quick)):
                found.append(measured)
                yield measured.row

    printed = table(HEADER, rows())
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        draw(found, out / "growth.png")
    return printed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two small cases, to see that it works")
    parser.add_argument("--out", type=Path, default=Path("docs/figures"), help="folder of the picture")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.out)
