"""The paper's own network and schedule on this machine ([AS2023] Sec. 9): raw inputs, 535,044 parameters.

Layers of 1024 and 512 on the 7 joints themselves, 4 outputs, the idle joint learned like the others, 200 epochs x 50
steps of 200 fresh samples, the two terms of (24) alone. Adam uses a learning rate of 1e-3 that falls to zero (the paper
does not state one), once with the paper's weights and once with lambda2 = 30, in single precision. The last row is the
network of the paper's Fig. 16, with sines and cosines as inputs.

`--only 0` trains the first case alone, 1 and 2 the others. Ctrl-C ends a training: its row then shows the best network
so far. Each tenth epoch prints its loss and the seconds so far on standard error.
"""

import argparse
import sys
import time

from benchmark import table

import orthocas as oc
from orthocas import problems, solvers
from orthocas.errors import Interrupted
from orthocas.tools.progress import Monitor, Progress

HEADER = (
    "| inputs | parameters | weights | epochs | task std [deg] | mutual std [deg] "
    "| conditioning mean / 1 % / min |\n| --- | --- | --- | --- | --- | --- | --- |"
)
CASES = (((1000.0, 1.0), True), ((1000.0, 30.0), True), ((1000.0, 30.0), False))  # weights, whether inputs are raw


def told() -> Monitor:
    """A monitor that prints the loss of some epochs."""
    start, epochs = time.perf_counter(), [0]

    def tell(progress: Progress) -> None:
        epochs[0] += 1
        if epochs[0] % 10 == 0:
            seconds = time.perf_counter() - start
            print(f"{progress.fraction:.0%}, {seconds:.0f} s, loss {progress.value:.4g}", file=sys.stderr, flush=True)

    return tell


def row(weights: tuple[float, float], raw: bool, quick: bool) -> str:
    """Train once, and evaluate on held-out samples."""
    network = oc.MLP((16, 8) if quick else (1024, 512), raw)
    solver = solvers.Adam(epochs=2) if quick else solvers.Adam(epochs=200, steps=50, batch=200)
    problem, settings = problems.get("iiwa"), {"weights": weights, "split_idle": False, "precision": "single"}
    try:
        fit = oc.fit(problem, network, solver, monitor=told(), **settings)  # type: ignore[arg-type]
    except Interrupted as stop:
        fit = stop.result
    report = oc.evaluate(fit.chart, 2_000 if quick else 100_000)
    quality, inputs = report.conditioning, "q" if raw else "sin q, cos q"
    return (
        f"| {inputs} | {fit.chart.coordinates.size} | {', '.join(f'{w:g}' for w in weights)} "
        f"| {fit.stages[-1].result.iterations} "
        f"| {report.task_angle.std:.3f} | {report.mutual_angle.std:.3f} "
        f"| {quality.mean:.3f} / {quality.p01:.3f} / {quality.min:.3f} |"
    )


def main(quick: bool = False, only: int | None = None) -> list[str]:
    """One row per case; `quick` uses a small network and two epochs."""
    chosen = CASES if only is None else CASES[only : only + 1]
    return table(HEADER, (row(weights, raw, quick) for weights, raw in chosen))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a small case, to see that it works")
    parser.add_argument("--only", type=int, choices=range(len(CASES)), help="one of the cases")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.only)
