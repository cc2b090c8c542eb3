"""Time of `orthocas.Arm.solve`: 10,000 poses with one xi and no start, x alone, and rows from a start near by (2 min).

Poses are those of random postures within the limits, of which not all can have that xi; starts are 0.05 rad (standard
deviation, each joint) from postures of a chart. Processor times count all threads. `--quick` takes one arm, few rows.
"""

import time
from collections.abc import Callable

import numpy as np
from benchmark import run, table

import orthocas as oc

ARMS, ROWS, CALLS, RUNS = ("panda", "iiwa7", "xarm7"), 10_000, 1000, 3
XI, NEAR = 0.2, 0.05


def least(call: Callable[[], object]) -> tuple[float, float]:
    """Seconds of wall clock and of processors, the least of some runs."""
    found = []
    for _ in range(RUNS):
        wall, cpu = time.perf_counter(), time.process_time()
        call()
        found.append((time.perf_counter() - wall, time.process_time() - cpu))
    return min(wall for wall, _ in found), min(cpu for _, cpu in found)


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    result: dict[str, float] = {}

    def measure(name: str) -> str:
        arm, rng = oc.Arm.load(name), np.random.default_rng(0)
        x = arm.x(arm.robot.sample(100 if quick else ROWS, seed=3))
        chart = arm.charts[0]
        postures = chart.domain.sample(20 if quick else CALLS, 5)
        near, xi, starts = arm.x(postures), chart.xi(postures)[:, 0], postures + rng.normal(0, NEAR, postures.shape)
        # All is built before times are taken.
        arm.solve(x[:64], XI)
        arm.solve(x[:64])
        (wall, cpu), (_, alone) = least(lambda: arm.solve(x, XI)), least(lambda: arm.solve(x[:CALLS]))
        _, row = least(lambda: arm.solve(near, xi, starts))
        single = []
        for k in range(len(near)):
            began = time.perf_counter()
            arm.solve(near[k], float(xi[k]), starts[k])
            single.append(time.perf_counter() - began)
        shares = np.bincount(arm.solve(x, XI).status, minlength=3)[:3] / len(x)
        us = 1e6 * np.array([cpu / len(x), alone / min(CALLS, len(x)), np.median(single), row / len(near)])
        labels = ("with xi, us", "x alone, us", "one call, us", "row, us")
        result.update({f"{name}, {label}": float(value) for label, value in zip(labels, us, strict=True)})
        found, nearest, outside = (100 * shares).tolist()
        cells = f"{found:.0f}, {nearest:.0f}, {outside:.0f} | {wall:.1f}, {cpu:.1f}"
        return f"| {name} | {cells} | {us[1]:.0f} | {us[2]:.0f} | {us[3]:.0f} |"

    columns = ("arm", "FOUND, NEAREST, OUTSIDE_DOMAIN [%]", "10,000 with xi: time, of processors [s]")
    columns += ("a row with x alone [us]", "a call from a start [us]", "a row from a start [us]")
    table(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}", map(measure, ARMS[:1] if quick else ARMS))
    return result


if __name__ == "__main__":
    run(main, __doc__)
