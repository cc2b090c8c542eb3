"""Default fits look for folds: time and quality, and the least conditioning at ten million other samples."""

import argparse
import time

import numpy as np

import orthocas as oc
from orthocas.domains import sample_heavily, sample_uniform
from orthocas.judging.gradients import Judged

HEADER = (
    "| degree | fit [s] | task std [deg] | mutual std [deg] | least conditioning: search of the fit | uniform "
    "| near faces and corners | folds |\n| --- | --- | --- | --- | --- | --- | --- | --- |"
)
_CHUNK = 200_000


def least(chart: oc.Chart, samples: int, heavy: bool) -> tuple[float, int]:
    """Least conditioning and number of folds at samples of the domain."""
    draw = sample_heavily if heavy else sample_uniform
    smallest, positive, negative = 1.0, 0, 0
    for k in range(max(1, samples // _CHUNK)):
        points = draw(chart.problem.domain, min(samples, _CHUNK), (1000, k))
        judged = Judged.at(chart.problem, chart.coordinates, points)
        smallest = min(smallest, float(judged.conditioning.min()))
        positive, negative = positive + int((judged.signs > 0).sum()), negative + int((judged.signs <= 0).sum())
    return smallest, min(positive, negative)


def main(quick: bool = False) -> list[str]:
    """Rows for the 7-DoF arm; `quick` takes degree 2 and few samples."""
    problem, rows = oc.problems.get("iiwa"), []
    oc.fit(problem, oc.Polynomial(1))  # the first call loads libraries
    for degree in (2,) if quick else (4, 5, 6):
        start = time.perf_counter()
        fit = oc.fit(problem, oc.Polynomial(degree))
        seconds = time.perf_counter() - start
        report = oc.evaluate(fit.chart, samples=5_000 if quick else 100_000)
        found = [least(fit.chart, 10_000 if quick else 5_000_000, heavy) for heavy in (False, True)]
        worst = np.nan if fit.worst is None else fit.worst.least
        rows.append(
            f"| {degree} | {seconds:.1f} | {report.task_angle.std:.2f} | {report.mutual_angle.std:.2f} | {worst:.3f} "
            f"| {found[0][0]:.3f} | {found[1][0]:.3f} | {found[0][1] + found[1][1]} |"
        )
        print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    print(HEADER)
    main(parser.parse_args().quick)
