"""The paper's own network and schedule on this machine ([AS2023] Sec. 9): raw inputs, 535,044 parameters.

Layers of 1024 and 512 on the 7 joints themselves, 4 outputs, the idle joint learned like the others, 200 epochs x 50
steps of 200 fresh samples, the two terms of (24) alone. Adam uses a learning rate of 1e-3 that falls to zero (the paper
does not state one), once with the paper's weights and once with lambda2 = 30, in single precision. The last row is the
network of the paper's Fig. 16, with sines and cosines as inputs.
"""

from benchmark import run, table

import orthocas as oc
from orthocas import problems, solvers

HEADER = (
    "| inputs | parameters | weights | training [s] | task std [deg] | mutual std [deg] "
    "| conditioning mean / 1 % / min |\n| --- | --- | --- | --- | --- | --- | --- |"
)
CASES = (((1000.0, 1.0), True), ((1000.0, 30.0), True), ((1000.0, 30.0), False))  # weights, whether inputs are raw


def row(weights: tuple[float, float], raw: bool, quick: bool) -> str:
    """Train once, and evaluate on held-out samples."""
    network = oc.MLP((16, 8) if quick else (1024, 512), raw)
    solver = solvers.Adam(epochs=2) if quick else solvers.Adam(epochs=200, steps=50, batch=200)
    fit = oc.fit(problems.get("iiwa"), network, solver, weights=weights, split_idle=False, precision="single")
    report = oc.evaluate(fit.chart, 2_000 if quick else 100_000)
    quality, inputs = report.conditioning, "q" if raw else "sin q, cos q"
    return (
        f"| {inputs} | {fit.chart.coordinates.size} | {', '.join(f'{w:g}' for w in weights)} | {fit.seconds:.0f} "
        f"| {report.task_angle.std:.3f} | {report.mutual_angle.std:.3f} "
        f"| {quality.mean:.3f} / {quality.p01:.3f} / {quality.min:.3f} |"
    )


def main(quick: bool = False) -> list[str]:
    """One row per case; `quick` uses a small network and two epochs."""
    return table(HEADER, (row(weights, raw, quick) for weights, raw in CASES))


if __name__ == "__main__":
    run(main, __doc__)
