"""Would a C compiler speed up fits? Loss and slopes of a sample of the 7-DoF arm: compiled against replayed columns."""

import time
from statistics import median

import casadi as ca
import numpy as np
from benchmark import run
from c_timing import nanoseconds_per_call

from orthocas.fitting.sample_loss import Loss, build_loss_with_slopes
from orthocas.fitting.terms import Sizes, Weights
from orthocas.tools.columns import COLUMNS

BLOCKS = 16


def main(quick: bool = False) -> dict[str, float]:
    """Print nanoseconds per sample of both; `quick` takes one round of columns."""
    loss = Loss.of(Sizes(n=7, m=3, r=4, identity_metric=True), Weights.of((1000.0, 30.0)).by_name)
    J, data = loss.arguments()
    value = ca.sumsqr(loss.residuals(J, data)) / 2
    compiled = ca.Function("loss", [J, *data], ca.cse([value, ca.densify(ca.gradient(value, J))]))
    columns, rng = build_loss_with_slopes(loss), np.random.default_rng(0)
    inputs = [rng.normal(size=(BLOCKS, compiled.numel_in(i), COLUMNS)) for i in range(compiled.n_in())]
    columns(*inputs)
    times = []
    for _ in range(1 if quick else 9):
        start = time.perf_counter()
        columns(*inputs)
        times.append(time.perf_counter() - start)
    found = {**nanoseconds_per_call({"compiled": compiled}), "columns": 1e9 * median(times) / (BLOCKS * COLUMNS)}
    for name, value in found.items():
        print(f"{name}: {value:.0f} ns per sample")
    return found


if __name__ == "__main__":
    run(main, __doc__)
