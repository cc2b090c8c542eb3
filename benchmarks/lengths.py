"""Cost and benefit of the length term: task angle and spread of gradient lengths against lambda4 (1 min)."""

from benchmark import run

import orthocas as oc
from orthocas import problems
from orthocas.charts.quality import Report

CASES = (("planar_3r_x", 6), ("planar_3r_x", 8), ("iiwa", 4))


def main(quick: bool = False) -> dict[str, Report]:
    """Print a row for each problem, degree and weight; return the reports on held-out samples."""
    found = {}
    print("| problem | degree | lambda4 | task std [deg] | longest over shortest gradient |\n|" + " --- |" * 5)
    for name, degree in (("planar_3r_x", 4),) if quick else CASES:
        for weight in (0.0, 0.1, 1.0):
            chart = oc.fit(problems.get(name), oc.Polynomial(degree), weights=(1000, 30, 150, weight)).chart
            report = oc.evaluate(chart, samples=20_000, seed=1)
            row = f"{name} | {degree} | {weight:g} | {report.task_angle.std:.3f} | {report.length_ratio:.3g}"
            print(f"| {row} |", flush=True)
            found[f"{name} {degree} {weight:g}"] = report
    return found


if __name__ == "__main__":
    run(main, __doc__)
