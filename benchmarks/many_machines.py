"""Workers of a Dask scheduler: jobs of a known length, and the proof of a chart against processes of this machine.

Jobs sleep, so that the number of workers is not that of cores: efficiency is the time of all jobs, over the time that
they took times the number of workers. What is lost is the scheduler's and the client's. The client's share is the time
of its processor, for each job. Proofs are compared by the time of all processors, scheduler and client among them.
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
JOBS_HEADER = (
    "| Dask's workers | jobs of half a second | efficiency | client's time, a job [ms] |\n| --- | --- | --- | --- |"
)
PROOF_HEADER = (
    "| proof of a chart by | boxes | time [s] | all processors' time [s] | of two processes |\n"
    "| --- | --- | --- | --- | --- |"
)


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
    arm = oc.problems.get("iiwa")
    domain = oc.Box(arm.domain.centre, 0.4 if quick else 0.55)
    chart = oc.fit(oc.Problem(arm.robot, arm.task, domain=domain), oc.Polynomial(3)).chart
    with starting_workers(), ProcessPoolExecutor(2, get_context("spawn")) as pool:
        seconds, least, boxes = _prove(chart, pool, 2)
    yield f"| two processes | {boxes} | {seconds:.1f} | {least:.1f} | 1.00 |"
    for count in (1, 2):
        with _workers(count, processes=True) as executor:
            seconds, spent, boxes = _prove(chart, executor, count)
        yield f"| Dask, workers: {count} | {boxes} | {seconds:.1f} | {spent:.1f} | {spent / least:.2f} |"


def _prove(chart: oc.Chart, executor: Executor, count: int) -> tuple[float, float, int]:
    """Seconds, those of all processors together, and boxes; workers have started, and know the chart's functions."""
    oc.certify(chart, executor=executor, time_limit=5.0)
    wait([executor.submit(time.sleep, 0.1 + k * 1e-6) for k in range(count)])
    start, before = time.perf_counter(), _add_processors()
    certificate = oc.certify(chart, executor=executor)
    return time.perf_counter() - start, _add_processors() - before, certificate.boxes


def _add_processors() -> float:
    """Processor time of this process and all that it started [s]: other work on the machine hardly changes it."""
    own = import_module("psutil").Process()
    times = [process.cpu_times() for process in (own, *own.children(recursive=True))]
    return float(sum(each.user + each.system for each in times))


if __name__ == "__main__":
    run(main, __doc__)
