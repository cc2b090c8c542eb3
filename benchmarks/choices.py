"""Effect of the choices behind a fit, and the spread of the results: 7-DoF arm, degree 4, without the fold term."""

from itertools import product
from unittest.mock import patch

import numpy as np
from benchmark import run

import orthocas as oc
from orthocas import problems
from orthocas.fitting import stages, starts
from orthocas.tasks.samples import sample_uniform

HEADER = (
    "| choice | task std [deg] | mutual std [deg] | conditioning mean | 1 % quantile |\n| --- | --- | --- | --- | --- |"
)


def row(name: str, quick: bool, degree: int = 4, **settings: object) -> str:
    """Range of each figure over fit seeds 0, 1, 2 and held-out seeds 1, 2, 3; `quick`: one of each at degree 2."""
    problem = problems.get("iiwa")
    settings = {"weights": oc.Weights(folds=0), **settings}
    fit_seeds, seeds, samples = ((0,), (1,), 1_000) if quick else ((0, 1, 2), (1, 2, 3), 100_000)
    charts = [oc.fit(problem, oc.Polynomial(2 if quick else degree), seed=seed, **settings).chart for seed in fit_seeds]  # type: ignore[arg-type]
    reports = [oc.evaluate(chart, samples, seed) for chart, seed in product(charts, seeds)]
    columns = {
        "task": [report.task_angle.std for report in reports],
        "mutual": [report.mutual_angle.std for report in reports],
        "mean": [report.conditioning.mean for report in reports],
        "p01": [report.conditioning.p01 for report in reports],
    }
    return f"| {name} | " + " | ".join(f"{min(v):.3f} to {max(v):.3f}" for v in columns.values()) + " |"


def main(quick: bool = False) -> None:
    """Print the table row by row."""
    print(HEADER)
    print(row("default", quick), flush=True)
    print(row("default, degree 5", quick, degree=5), flush=True)
    with patch.object(stages, "sample_evenly", sample_uniform):
        print(row("independent training samples", quick), flush=True)
    with patch.object(starts, "_MIXING_ANGLE", np.radians(0)):
        print(row("no mixing of the spectral start", quick), flush=True)
    print(row("no regularity term", quick, weights=(1000.0, 30.0)))


if __name__ == "__main__":
    run(main, __doc__)
