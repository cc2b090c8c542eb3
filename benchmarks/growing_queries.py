"""Growing against SciPy: time of one query of planar 3R, and of 100,000 queries of Figs. 13 and 15 (1 min).

The peer is the method of the paper: equation (23) by Runge-Kutta 45, stopped when q changes by less than 1e-6 between
two steps. Errors are distances from the same flow at tolerance 1e-13.
"""

import resource
import time
from collections.abc import Callable
from statistics import median

import numpy as np
from benchmark import run
from scipy.integrate import RK45
from sundials_flow import SundialsFlow

import orthocas as oc
from orthocas import problems
from orthocas.exact.flow import TaskFlow
from orthocas.tools.checks import Array

LEVEL = np.zeros(1)
ROUNDS = 3
Rate = Callable[[Array], Array]


def planar_3r(metric: str) -> oc.Problem:
    """The arm of Fig. 15: task x, q1 in (0, pi)."""
    arm = oc.Robot.planar(lengths=[1.0] * 3, masses=[3.0] * 3)
    return oc.Problem(arm, oc.Task.position(arm, "x"), metric, oc.Box([np.pi / 2, 0, 0], [np.pi / 2, np.pi, np.pi]))


def closed_form(q: Array) -> Array:
    """Right-hand side of (23) for x0 = 0 and A = I, written by hand."""
    angles = np.cumsum(q)
    return np.asarray(np.cos(angles).sum() * np.cumsum(np.sin(angles)[::-1])[::-1])


def robot_functions(problem: oc.Problem) -> Rate:
    """The same with the functions of a robot, as a user would write it for any arm."""
    h, J = problem.task.function, problem.task.jacobian_function
    return lambda q: -float(h(q)) * np.asarray(J(q))[0]


def paper_query(rate: Rate, start: Array, change: float, tolerance: float) -> Array:
    """Integrate equation (23) with SciPy until q changes by less than `change` in a step.

    At tolerances looser than 1e-6, the steps stay at the limit of stability, and the rule is hardly ever met.
    """
    solver = RK45(lambda t, q: rate(q), 0.0, start, np.inf, rtol=tolerance, atol=tolerance)
    while solver.status == "running":
        before = solver.y
        solver.step()
        if np.abs(solver.y - before).max() < change:
            break
    return np.asarray(solver.y)


def timed(work: Callable[[], Array], count: int) -> tuple[float, Array]:
    """Microseconds per query, and the result."""
    start = time.perf_counter()
    result = work()
    return 1e6 * (time.perf_counter() - start) / count, result


def flows(metric: str, quick: bool) -> dict[str, tuple[float, Array]]:
    """Microseconds per query (median of several rounds) and errors of every way to pull points."""
    problem = planar_3r(metric)
    count, few = (500, 5) if quick else (100_000, 100)
    unit = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    points = problem.domain.centre + problem.domain.half_width * unit
    ours, sundials = TaskFlow(problem), SundialsFlow(problem)
    some = points[: count // 20]
    ways: dict[str, tuple[Callable[[], Array], int]] = {
        "ours": (lambda: ours.pull(points, LEVEL).points, count),
        "CVODES": (lambda: sundials.pull(some, 0.0).points, len(some)),
    }
    if metric == "euclidean":
        for name, rate in (("NumPy by hand", closed_form), ("robot functions", robot_functions(problem))):
            for stop, tolerance in ((1e-6, 1e-6), (1e-9, 1e-10)):

                def work(rate: Rate = rate, stop: float = stop, tolerance: float = tolerance) -> Array:
                    return np.array([paper_query(rate, point, stop, tolerance) for point in points[:few]])

                ways[f"SciPy RK45, {name}, stop {stop:g}"] = (work, few)
    ours.pull(points[:600], LEVEL)  # graphs are built once
    sundials.pull(points[:600], 0.0)
    exact = ours.pull(points[:5000], LEVEL, 1e-13).points
    found = {}
    for name, (work, size) in ways.items():
        runs = [timed(work, size) for _ in range(1 if quick else ROUNDS)]
        ends = runs[0][1][:5000]
        found[name] = median(seconds for seconds, _ in runs), np.abs(ends - exact[: len(ends)]).max(axis=1)
    return found


def chart_seconds(chart: oc.Chart, count: int) -> float:
    """Seconds to evaluate xi at `count` random points, with chart and graphs ready."""
    domain = chart.problem.domain
    points = domain.centre + domain.half_width * np.random.default_rng(0).uniform(-1, 1, (count, chart.n))
    chart.xi(points[:600])
    start = time.perf_counter()
    chart.xi(points)
    return time.perf_counter() - start


def main(quick: bool = False) -> dict[str, float]:
    """Print tables, and return their figures."""
    found: dict[str, float] = {}
    for metric in ("euclidean", "inertia"):
        rows = flows(metric, quick)
        print(f"| planar 3R, x0 = 0, {metric} | us per query | times ours | error median | 99 % | max |")
        print("| --- | --- | --- | --- | --- | --- |")
        for name, (microseconds, error) in rows.items():
            ratio = microseconds / rows["ours"][0]
            errors = " | ".join(f"{value:.1e}" for value in (np.median(error), np.quantile(error, 0.99), error.max()))
            print(f"| {name} | {microseconds:.1f} | {ratio:.0f} | {errors} |", flush=True)
            found |= {f"{metric} {name}": microseconds, f"{metric} {name} error": float(np.median(error))}
    known = problems.get("planar_2r")
    count = 1000 if quick else 100_000
    for metric in ("euclidean", "inertia"):
        circle = oc.grow(oc.Problem(known.robot, known.task, metric, known.domain), 1.0, origin=[np.pi / 3, 0])
        found[f"circle_{metric}_seconds"] = chart_seconds(circle, count)
        disk = oc.grow(planar_3r(metric), 0.0, cells=20 if quick else 60)
        found[f"disk_{metric}_seconds"] = chart_seconds(disk, count)
    for name in ("circle_euclidean", "circle_inertia", "disk_euclidean", "disk_inertia"):
        print(f"{count} values of a grown chart, {name}: {found[f'{name}_seconds']:.2f} s")
    found["peak_memory_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"largest memory: {found['peak_memory_mib']:.0f} MiB")
    return found


if __name__ == "__main__":
    run(main, __doc__)
