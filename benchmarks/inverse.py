"""The inverse map of the 7-DoF arm, degree 4: batches, single calls, streams, and generated C (1 min).

"Wrong" rows are reported as found, but their phi differs from the target by more than 1e-8, or q lies outside the
domain. Targets are phi of random points of the domain; starts "near" are off by up to so much in each joint.
"""

import ctypes
import time
from collections.abc import Callable
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from benchmark import run

import orthocas as oc
from orthocas import problems
from orthocas.charts.inverse import Solutions
from orthocas.charts.trackers import TrackerStatus
from orthocas.codegen import CompiledInverse
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.display import percent

REPEATS = 3
TICKS = 100  # of the stream in C, timed together
ITERATIONS = 100  # at most, of a call in C


def main(quick: bool = False) -> dict[str, float]:
    """Print two tables; return seconds, shares and microseconds by name."""
    rows = 2_000 if quick else 100_000
    chart = oc.fit(problems.get("iiwa"), oc.Polynomial(2 if quick else 4)).chart
    begin = time.perf_counter()
    chart.solve(chart.phi(chart.problem.domain.centre))
    found = {"first call s": time.perf_counter() - begin}
    q = sample_uniform(chart.problem.domain, rows, 1)
    with TemporaryDirectory() as folder:
        compiled = oc.compile_inverse(chart, folder)
        print("| solver | starts | rows | s | found | wrong | largest change of q |\n|" + " --- |" * 7)
        for name, solve in (("NumPy", chart.solve), ("compiled C", compiled.solve)):
            for near in (0.01, 0.05, 0.1, None):
                found |= batch(chart, solve, q, name, near)
        found |= stream(chart, compiled, 500 if quick else 5_000)
    found |= inside(chart, rows // 10)
    print("\n| one call | us |\n| --- | --- |")
    for title in [title for title in found if title.endswith(" us")]:
        print(f"| {title.removesuffix(' us')} | {found[title]:.1f} |")
    return found


def batch(chart: oc.Chart, solve: Callable[..., Solutions], q: Any, name: str, near: float | None) -> dict[str, float]:
    """Time one batch, the best of some, and check every row."""
    phi, rng = chart.phi(q), np.random.default_rng(2)
    starts = None if near is None else q + rng.uniform(-near, near, q.shape)
    seconds = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        solutions = solve(phi, starts)
        seconds.append(time.perf_counter() - begin)
    good = solutions.found
    off = np.abs(chart.phi(solutions.q) - phi).max(axis=1) > 1e-8
    wrong = int((good & (off | ~chart.problem.domain.contains(solutions.q))).sum())
    title = "none" if near is None else f"near, {near}"
    change = np.abs(solutions.q - q)[good].max()
    print(
        f"| {name} | {title} | {len(q)} | {min(seconds):.3f} | {percent(good.mean(), 4)} | {wrong} | {change:.1e} |",
        flush=True,
    )
    key = f"{name}, {title}"
    return {f"{key} s": min(seconds), f"{key} found": float(good.mean()), f"{key} wrong": wrong}


def stream(chart: oc.Chart, compiled: CompiledInverse, ticks: int) -> dict[str, float]:
    """Median times of single calls along a circle of the tool and one coordinate at 1 kHz, 0.3 m/s [us]."""
    time_of = np.arange(ticks) * 1e-3
    path = np.tile(chart.phi(chart.problem.domain.centre), (ticks, 1))
    path[:, 0] += 0.05 * np.sin(6 * time_of)
    path[:, 1] += 0.05 * (1 - np.cos(6 * time_of))
    path[:, chart.m] += 0.3 * np.sin(3 * time_of)
    tracker = chart.tracker(chart.problem.domain.centre)
    q, times = [], []
    for phi in path:
        begin = time.perf_counter()
        q.append(tracker.step(phi))
        times.append(time.perf_counter() - begin)
        assert tracker.status == TrackerStatus.OK
    single = []
    for phi, start in zip(path[1:301], q, strict=False):
        begin = time.perf_counter()
        chart.inverse(phi, start)
        single.append(time.perf_counter() - begin)
    return {
        "tracker.step, median us": 1e6 * float(np.median(times)),
        "tracker.step, 99 % us": 1e6 * float(np.quantile(times, 0.99)),
        "chart.inverse, median us": 1e6 * float(np.median(single)),
        "NAME_inverse in C, from the last tick us": 1e6 * in_c(compiled, path, np.array(q)),
    }


def inside(chart: oc.Chart, rows: int) -> dict[str, float]:
    """Times of a row that has to stay inside, for targets of a box half as wide again; most lie outside."""
    domain = chart.problem.domain
    phi = chart.phi(domain.centre + 1.5 * (sample_uniform(domain, rows, 3) - domain.centre))
    begin = time.perf_counter()
    solutions = chart.solve(phi, inside=True)
    seconds = (time.perf_counter() - begin) / rows
    print(f"\n{solutions}")
    return {f"a row of {rows} with inside=True us": 1e6 * seconds}


def in_c(compiled: CompiledInverse, path: Any, q: Any) -> float:
    """Seconds of a call of NAME_inverse: means of 100 calls in one thread, the best of some."""
    run, seconds = ctypes.CDLL(str(compiled.library)).arm_inverse_rows, []
    targets, starts = path[1:].copy(), q[:-1]
    results, residual = np.empty_like(starts), np.empty_like(targets)
    condition, within = np.empty(len(targets)), np.empty(len(targets), dtype=np.bool_)
    for first in [*range(0, len(targets) - TICKS + 1, TICKS)] * REPEATS:
        # C puts solutions in the places of the starts.
        results[first : first + TICKS] = starts[first : first + TICKS]
        places = (
            ctypes.c_void_p(array[first:].ctypes.data) for array in (targets, results, residual, condition, within)
        )
        begin = time.perf_counter()
        run(ctypes.c_long(TICKS), ctypes.c_int(ITERATIONS), *places)
        seconds.append((time.perf_counter() - begin) / TICKS)
    known = slice(len(targets) // TICKS * TICKS)
    np.testing.assert_allclose(results[known], q[1:][known], atol=1e-9)
    return float(np.min(seconds))


if __name__ == "__main__":
    run(main, __doc__)
