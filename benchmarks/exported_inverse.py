"""The inverse of exported modules on 50,000 rows: rows a second, and whether the answers are those of `chart.solve`.

Every joint starts up to 0.1 rad from the solution. NumPy and PyTorch, which runs eagerly, have a thread for each half
of the rows; JAX is compiled, and takes a tenth of the rows at a time. `--quick` takes 1,000 rows.
"""

import importlib
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from batches import exported
from benchmark import run

import orthocas as oc
from orthocas import problems
from orthocas.charts.solutions import InverseStatus
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

RUNS, AWAY, AT_ONCE, PARTS = 5, 0.1, 4096, 10
Solver = Callable[[], tuple[Any, Any]]


def of_torch(module: Any, phi: Array, starts: Array) -> Solver:
    """PyTorch, a part of the rows for each core."""
    torch: Any = importlib.import_module("torch")
    torch.set_num_threads(1)
    cores = len(os.sched_getaffinity(0))
    module.ROWS = AT_ONCE
    parts = list(zip(*(torch.as_tensor(rows).tensor_split(cores) for rows in (phi, starts)), strict=True))
    pool = ThreadPoolExecutor(cores)

    def solve() -> tuple[Any, Any]:
        found = list(pool.map(lambda part: module.inverse(*part), parts))
        return torch.cat([q for q, _ in found]), torch.cat([status for _, status in found])

    return solve


def of_jax(module: Any, phi: Array, starts: Array) -> Solver:
    """JAX, compiled."""
    jax: Any = importlib.import_module("jax")
    jax.config.update("jax_enable_x64", True)
    compiled = jax.jit(module.inverse)
    parts = [[jax.numpy.asarray(rows[k::PARTS]) for rows in (phi, starts)] for k in range(PARTS)]

    def solve() -> tuple[Any, Any]:
        found = [jax.block_until_ready(compiled(*part)) for part in parts]
        return tuple(
            np.stack(column, axis=1).reshape(phi.shape[: column[0].ndim]) for column in zip(*found, strict=True)
        )

    return solve


def of_numpy(module: Any, phi: Array, starts: Array) -> Solver:
    """NumPy, a part of the rows for each core."""
    cores = len(os.sched_getaffinity(0))
    parts, pool = (
        list(zip(*(np.array_split(rows, cores) for rows in (phi, starts)), strict=True)),
        ThreadPoolExecutor(cores),
    )

    def solve() -> tuple[Any, Any]:
        found = list(pool.map(lambda part: module.inverse(*part), parts))
        return np.concatenate([q for q, _ in found]), np.concatenate([status for _, status in found])

    return solve


SOLVERS = {"torch": of_torch, "jax": of_jax, "numpy": of_numpy}


def measured(solve: Solver) -> tuple[Any, Any, float, float]:
    """Solutions, and of runs after the first the least seconds by the clock, and of the processor."""
    q, status = solve()
    seconds = []
    for _ in range(RUNS):
        start = time.perf_counter(), time.process_time()
        solve()
        seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    wall, cpu = np.min(seconds, axis=0)
    return np.asarray(q), np.asarray(status), float(wall), float(cpu)


def charts() -> dict[str, oc.Chart]:
    """A position and a pose of seven joints."""
    return {
        "iiwa, position, degree 4": oc.fit(problems.get("iiwa"), oc.Polynomial(4)).chart,
        "panda, pose, wide": oc.charts.load("panda-wide"),
    }


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    count, found = 1_000 if quick else 50_000, {}
    header = (
        "| chart | library | rows a second | time of a core, a row [us] | other status | largest difference [rad] |"
    )
    print(f"{header}\n| --- | --- | --- | --- | --- | --- |")
    with TemporaryDirectory() as folder:
        for name, chart in charts().items():
            domain, rng = chart.problem.domain, np.random.default_rng(1)
            points = sample_uniform(domain, count, 3)
            phi, starts = chart.phi(points), points + AWAY * rng.uniform(-1, 1, points.shape)
            known = chart.solve(phi, starts)
            for library, solver in SOLVERS.items():
                if importlib.util.find_spec(library) is None:
                    continue
                q, status, wall, cpu = measured(solver(exported(chart, library, Path(folder)), phi, starts))
                both = (status == InverseStatus.FOUND) & known.found
                worst, others = np.abs(q - known.q)[both].max(), int((status != known.status).sum())
                print(
                    f"| {name} | {library} | {count / wall:.0f} | {cpu / count * 1e6:.1f} | {others} | {worst:.1e} |",
                    flush=True,
                )
                case = f"{name}, {library}"
                found |= {
                    f"{case}, rows a second": count / wall,
                    f"{case}, time of a core, a row [us]": cpu / count * 1e6,
                }
                found |= {f"{case}, other status": others, f"{case}, difference [rad]": worst}
            for library in SOLVERS:
                Path(folder, f"arm_{library}.py").unlink(missing_ok=True)
    return found


if __name__ == "__main__":
    run(main, __doc__)
