"""Would a C compiler speed up fits? Loss and slopes of a sample of the 7-DoF arm: compiled against replayed columns."""

import time
from statistics import median

import casadi as ca
import numpy as np
from c_timing import nanoseconds_per_call

from orthocas.casadi_tools.columns import COLUMNS
from orthocas.fitting.loss import Loss, Sizes, Weights
from orthocas.fitting.loss.residuals import loss_columns

BLOCKS = 16


def main(rounds: int = 9) -> dict[str, float]:
    """Nanoseconds per sample of both."""
    loss = Loss.of(Sizes(n=7, m=3, r=4, identity_metric=True), Weights.of((1000.0, 30.0)).by_name)
    J, data = loss.arguments()
    value = ca.sumsqr(loss.residuals(J, data)) / 2
    compiled = ca.Function("loss", [J, *data], ca.cse([value, ca.densify(ca.gradient(value, J))]))
    columns, rng = loss_columns(loss), np.random.default_rng(0)
    inputs = [rng.normal(size=(BLOCKS, compiled.numel_in(i), COLUMNS)) for i in range(compiled.n_in())]
    columns(*inputs)
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        columns(*inputs)
        times.append(time.perf_counter() - start)
    return {**nanoseconds_per_call({"compiled": compiled}), "columns": 1e9 * median(times) / (BLOCKS * COLUMNS)}


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name}: {value:.0f} ns per sample")
