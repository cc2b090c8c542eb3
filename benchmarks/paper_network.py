"""The paper's own network and schedule on this machine: 1024 x 512, 200 epochs x 50 steps of 200 fresh samples.

Adam uses a learning rate of 1e-3 that falls to zero (the paper does not state one), once with the paper's weights and
once with lambda2 = 30. The idle joint, which does not move the task, is split off as in every fit here.
"""

from benchmark import run, table

import orthocas as oc
from orthocas import problems, solvers

HEADER = (
    "| weights | training [s] | task std [deg] | mutual std [deg] | conditioning mean / 1 % / min |\n"
    "| --- | --- | --- | --- | --- |"
)
WEIGHTS = ((1000.0, 1.0), (1000.0, 30.0), (1000.0, 30.0, 150.0))


def row(weights: tuple[float, ...], quick: bool) -> str:
    """Train once, and evaluate on held-out samples."""
    network = oc.MLP((16, 8)) if quick else oc.MLP((1024, 512))
    solver = solvers.Adam(epochs=2) if quick else solvers.Adam()
    fit = oc.fit(problems.get("iiwa"), network, solver, weights=weights)  # type: ignore[arg-type]
    report = oc.evaluate(fit.chart, 2_000 if quick else 100_000)
    quality = report.conditioning
    return (
        f"| {', '.join(f'{w:g}' for w in weights)} | {fit.seconds:.0f} | {report.task_angle.std:.3f} "
        f"| {report.mutual_angle.std:.3f} | {quality.mean:.3f} / {quality.p01:.3f} / {quality.min:.3f} |"
    )


def main(quick: bool = False) -> list[str]:
    """One row per choice of weights; `quick` uses a small network and two epochs."""
    return table(HEADER, (row(weights, quick) for weights in WEIGHTS))


if __name__ == "__main__":
    run(main, __doc__)
