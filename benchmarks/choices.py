"""Effect of the choices behind a fit, and the spread of the results: 7-DoF arm, degree 4, without the fold term."""

from itertools import product
from unittest.mock import patch

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.domains import sample_uniform
from orthocas.fitting import spectral_start as spectral
from orthocas.fitting import stages

HEADER = (
    "| choice | task std [deg] | mutual std [deg] | conditioning mean | 1 % quantile |\n| --- | --- | --- | --- | --- |"
)


def row(name: str, degree: int = 4, fit_seeds: tuple[int, ...] = (0, 1, 2), **settings: object) -> str:
    """Range of each figure over fit seeds and held-out seeds 1, 2, 3."""
    problem = problems.get("iiwa")
    settings = {"weights": oc.Weights(folds=0), **settings}
    charts = [oc.fit(problem, oc.Polynomial(degree), seed=seed, **settings).chart for seed in fit_seeds]  # type: ignore[arg-type]
    reports = [oc.evaluate(chart, 100_000, seed) for chart, seed in product(charts, (1, 2, 3))]
    columns = {
        "task": [report.task_angle.std for report in reports],
        "mutual": [report.mutual_angle.std for report in reports],
        "mean": [report.conditioning.mean for report in reports],
        "p01": [report.conditioning.p01 for report in reports],
    }
    return f"| {name} | " + " | ".join(f"{min(v):.3f} to {max(v):.3f}" for v in columns.values()) + " |"


def main() -> None:
    """Print the table row by row."""
    print(HEADER)
    print(row("default"))
    print(row("default, degree 5", degree=5))
    with patch.object(stages, "sample_evenly", sample_uniform):
        print(row("independent training samples"))
    with patch.object(spectral, "_MIXING_ANGLE", np.radians(0)):
        print(row("no mixing of the spectral start"))
    print(row("no regularity term", weights=(1000.0, 30.0)))


if __name__ == "__main__":
    main()
