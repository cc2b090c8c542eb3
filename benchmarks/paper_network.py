"""The paper's own network and schedule on this machine ([AS2023] Sec. 9): raw inputs, 535,044 parameters.

Layers of 1024 and 512 on the 7 joints themselves, 4 outputs, the idle joint learned like the others, 200 epochs x 50
steps of 200 fresh samples, the two terms of (24) alone. Adam uses a learning rate of 1e-3 that falls to zero (the paper
does not state one), once with the paper's weights and once with lambda2 = 30. `--sines` adds the network of the paper's
Fig. 16, with sines and cosines as inputs, at the same weights.
"""

import argparse

import orthocas as oc
from orthocas import problems, solvers

HEADER = (
    "| inputs | parameters | weights | training [s] | task std [deg] | mutual std [deg] "
    "| conditioning mean / 1 % / min |\n| --- | --- | --- | --- | --- | --- | --- |"
)
WEIGHTS = ((1000.0, 1.0), (1000.0, 30.0))


def row(weights: tuple[float, float], raw: bool, quick: bool) -> str:
    """Train once, and evaluate on held-out samples."""
    network = oc.MLP((16, 8) if quick else (1024, 512), raw)
    solver = solvers.Adam(epochs=2) if quick else solvers.Adam(epochs=200, steps=50, batch=200)
    fit = oc.fit(problems.get("iiwa"), network, solver, weights=weights, split_idle=False)
    report = oc.evaluate(fit.chart, 2_000 if quick else 100_000)
    quality, inputs = report.conditioning, "q" if raw else "sin q, cos q"
    return (
        f"| {inputs} | {fit.chart.coordinates.size} | {', '.join(f'{w:g}' for w in weights)} | {fit.seconds:.0f} "
        f"| {report.task_angle.std:.3f} | {report.mutual_angle.std:.3f} "
        f"| {quality.mean:.3f} / {quality.p01:.3f} / {quality.min:.3f} |"
    )


def main(quick: bool = False) -> list[str]:
    """One row per choice of weights; `quick` uses a small network and two epochs."""
    return [row(weights, True, quick) for weights in WEIGHTS]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--sines", action="store_true")
    arguments = parser.parse_args()
    print(HEADER)
    for raw in (True, False) if arguments.sines else (True,):
        for weights in WEIGHTS:
            print(row(weights, raw, arguments.quick), flush=True)
