"""Workers of a Dask scheduler: jobs of a known length, and the proof of a chart against processes of this machine.

Jobs sleep, so that the number of workers is not that of cores: efficiency is the time of all jobs, over the time that
they took times the number of workers. What is lost is the scheduler's and the client's. The client's share is the time
of its processor, for each job.
"""

import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, wait
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context

from benchmark import run, table

import orthocas as oc
from orthocas.tools.processes import scheduler_executor, starting_workers

WORKERS = (1, 2, 4, 64)
JOB, JOBS_OF_A_WORKER = 0.5, 8
CHART = "iiwa7-position"
JOBS_HEADER = (
    "| Dask's workers | jobs of half a second | efficiency | client's time, a job [ms] |\n| --- | --- | --- | --- |"
)
PROOF_HEADER = "| proof of a chart by | boxes | time [s] | of two processes |\n| --- | --- | --- | --- |"


def main(quick: bool = False) -> list[str]:
    """Print two tables in Markdown; return their rows."""
    counts = (1, 4) if quick else WORKERS
    rows = table(JOBS_HEADER, (_measure_jobs(count) for count in counts))
    print()
    return rows + table(PROOF_HEADER, _measure_proofs(quick))


def _measure_jobs(count: int) -> str:
    jobs = count * JOBS_OF_A_WORKER
    with _workers(count) as executor:
        # The first jobs start the workers' threads.
        wait([executor.submit(time.sleep, 0.01 + k * 1e-6) for k in range(count)])
        start, spent = time.perf_counter(), time.process_time()
        wait([executor.submit(time.sleep, JOB) for _ in range(jobs)])
        seconds, spent = time.perf_counter() - start, time.process_time() - spent
    return f"| {count} | {jobs} | {jobs * JOB / (count * seconds):.2f} | {1e3 * spent / jobs:.2f} |"


@contextmanager
def _workers(count: int, *, processes: bool = False) -> Iterator[Executor]:
    """Workers with one thread each, in two processes at most unless each has its own; the scheduler has another."""
    cluster = import_module("distributed.deploy.subprocess").SubprocessCluster
    parts = count if processes or count == 1 else 2
    options = {"nthreads": count // parts, "dashboard": False}
    with (
        cluster(n_workers=parts, worker_kwargs=options, silence_logs=50) as workers,
        scheduler_executor(workers.scheduler_address) as executor,
    ):
        yield executor


def _measure_proofs(quick: bool) -> Iterator[str]:
    chart, limit = oc.load(CHART), 10.0 if quick else None
    with starting_workers(), ProcessPoolExecutor(2, get_context("spawn")) as pool:
        wait([pool.submit(time.sleep, 0.5) for _ in range(2)])
        processes, boxes = _prove(chart, pool, limit)
    yield f"| two processes | {boxes} | {processes:.0f} | 1.00 |"
    with _workers(2, processes=True) as executor:
        dask, boxes = _prove(chart, executor, limit)
    yield f"| Dask, two workers | {boxes} | {dask:.0f} | {dask / processes:.2f} |"


def _prove(chart: oc.Chart, executor: Executor, limit: float | None) -> tuple[float, int]:
    """Seconds, and boxes that were looked at."""
    start = time.perf_counter()
    certificate = oc.certify(chart, executor=executor, time_limit=limit)
    return time.perf_counter() - start, certificate.boxes


if __name__ == "__main__":
    run(main, __doc__)
