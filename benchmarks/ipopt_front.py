"""Is any point of Ipopt's front dominated by Gauss-Newton's? 7-DoF arm at degree 3, and planar_3r_xy.

Gauss-Newton traces the front by lambda2, without the regularity term, as in the constrained form. Ipopt traces it with
the mutual angles that Gauss-Newton reached as bounds. A point is dominated by p per cent if a point of the other front
is better by p per cent in one figure and not worse in the other. planar_3r_xy has one extra coordinate, so its front is
one point.
"""

import argparse
from itertools import product

import numpy as np

import orthocas as oc
from orthocas import problems, solvers
from orthocas.charts.quality import Report

Point = tuple[float, float]  # task and mutual deviation from a right angle, root mean square [deg]
LAMBDA2 = (3.0, 10.0, 30.0, 100.0, 300.0)


def point(report: Report) -> Point:
    """Root mean square deviations from a right angle."""
    task, mutual = (np.hypot(a.std, a.mean - 90) for a in (report.task_angle, report.mutual_angle))
    return float(task), float(mutual)


def domination(ours: Point, other: Point) -> float:
    """Domination of our point by another: its largest advantage if it is worse in no figure, otherwise 0."""
    advantages = [a / b - 1 for a, b in zip(ours, other, strict=True)]
    return max(advantages) if min(advantages) >= 0 else 0.0


def fronts(degree: int, lambda2: tuple[float, ...], held_out: int) -> tuple[list[Point], list[Point]]:
    """The front of Gauss-Newton by lambda2, and the front of Ipopt by bounds."""
    problem, basis = problems.get("iiwa"), oc.Polynomial(degree)
    fits = [oc.fit(problem, basis, weights=(1000.0, value)) for value in lambda2]
    gauss_newton = [point(oc.evaluate(fit.chart, held_out)) for fit in fits]
    weights = (1000.0, 0.0)
    bounded = [oc.fit(problem, basis, weights=weights, max_mutual_deg=mutual) for _, mutual in gauss_newton]
    return gauss_newton, [point(oc.evaluate(fit.chart, held_out)) for fit in bounded]


def main(quick: bool = False) -> dict[str, float]:
    """Print both fronts, and return the largest domination of an Ipopt point; `quick` uses degree 2 and two points."""
    held_out = 2_000 if quick else 100_000
    gauss_newton, ipopt = fronts(2 if quick else 3, LAMBDA2[2:4] if quick else LAMBDA2, held_out)
    print("| Gauss-Newton: task, mutual [deg] | Ipopt at its mutual bound: task, mutual [deg] |\n| --- | --- |")
    for theirs, ours in zip(gauss_newton, ipopt, strict=True):
        print(f"| {theirs[0]:.3f}, {theirs[1]:.3f} | {ours[0]:.3f}, {ours[1]:.3f} |")
    single = {}
    for solver in (solvers.GaussNewton(), solvers.Ipopt()):
        fit = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(2 if quick else 4), solver, weights=(1000.0, 0.0))
        single[solver.name] = oc.evaluate(fit.chart, held_out).task_angle.std
    return {
        "iiwa_domination": max(domination(ours, theirs) for ours, theirs in product(ipopt, gauss_newton)),
        "planar_3r_xy_domination": single["ipopt"] / single["gauss_newton"] - 1,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    for name, value in main(parser.parse_args().quick).items():
        print(f"{name}: {value:+.2%}")
