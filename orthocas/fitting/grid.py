"""The fits of a grid of parametrisations, solvers and seeds, evaluated on the same held-out samples."""

import math
import os
import pickle
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, as_completed
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

from orthocas.bases.family import Parametrisation
from orthocas.charts.quality import Report, evaluate
from orthocas.fitting.fit import Fit, fit
from orthocas.fitting.settings import Precision
from orthocas.fitting.terms import Weights
from orthocas.solvers.protocol import Solver, Status
from orthocas.tasks.problem import Problem
from orthocas.tools.batch import THREADS
from orthocas.tools.files import open_draft_folder, write_temporary
from orthocas.tools.processes import begin_worker, shared_event, starting_workers, worker_pool
from orthocas.tools.progress import Monitor, Progress, silent

HELD_OUT_SEED = 2**31  #: seed of the held-out samples; no fit of a grid uses it
_DIED = "its process died: out of memory, or a script that calls compare outside `if __name__ == '__main__'`"
_stops: list[Event] = []  # in worker processes: set when the parent no longer needs results


@dataclass(frozen=True, eq=False)
class Cell:
    """One fit of a grid: settings that can be sent to another process."""

    problem: Problem
    parametrisation: Parametrisation
    solver: Solver
    seed: int
    weights: Weights
    samples: int | None
    precision: Precision
    held_out: int
    chart_file: Path | None  #: file to save the chart in
    force: bool = False  #: replace a file there that is not a chart

    @property
    def solver_name(self) -> str:
        """Name of the solver. Coordinates in closed form need none."""
        return self.solver.name if self.parametrisation.closed_form is None else "closed form"


@dataclass(frozen=True)
class CellResult:
    """The result of one fit, or its error. The numbers of a failed fit are NaN."""

    problem: str
    parametrisation: str
    solver: str
    seed: int
    status: str
    error: str = ""
    seconds: float = float("nan")  #: duration of the fit
    parameters: int = 0
    samples: int = 0
    iterations: int = 0
    evaluations: int = 0
    task_std_deg: float = float("nan")
    mutual_std_deg: float = float("nan")
    leak_rms_deg: float = float("nan")  #: in the metric; the two above are the paper's
    conditioning_min: float = float("nan")
    conditioning_p01: float = float("nan")
    conditioning_mean: float = float("nan")
    folded_samples: int = 0
    control_tick_us: float = float("nan")  #: a tick of decoupled PD+ as generated C; NaN if not measured
    history: tuple[
        tuple[float, float], ...
    ] = ()  #: seconds since the start of the fit, and training loss, in its last stage

    @property
    def failed(self) -> bool:
        """Whether there is no chart."""
        return bool(self.error)


def run_cell(cell: Cell) -> CellResult:
    """Fit and evaluate. An error becomes part of the result."""
    history: list[tuple[float, float]] = []
    stages: list[str] = []
    start = time.perf_counter()

    def record(progress: Progress) -> None:
        if _cancelled():
            raise KeyboardInterrupt
        if progress.stage not in stages:
            stages.append(progress.stage)
            history.clear()
        if math.isfinite(progress.value):
            history.append((time.perf_counter() - start, progress.value))

    if _cancelled():
        return failure(cell, "cancelled")
    try:
        found = fit(
            cell.problem,
            cell.parametrisation,
            cell.solver,
            weights=cell.weights,
            samples=cell.samples,
            precision=cell.precision,
            seed=cell.seed,
            monitor=record,
        )
        if cell.chart_file is not None:
            found.chart.save(cell.chart_file, cell.force)
        report = evaluate(found.chart, cell.held_out, HELD_OUT_SEED)
    except KeyboardInterrupt:
        if not _cancelled():
            raise
        return failure(cell, "cancelled")
    except Exception as error:
        return failure(cell, f"{type(error).__name__}: {error}")
    return _result(cell, found, report, history)


def _result(cell: Cell, found: Fit, report: Report, history: list[tuple[float, float]]) -> CellResult:
    """The result of a successful fit."""
    results = [stage.result for stage in found.stages]
    return CellResult(
        problem=cell.problem.name,
        parametrisation=cell.parametrisation.label,
        solver=cell.solver_name,
        seed=cell.seed,
        status=found.status.value,
        seconds=found.seconds,
        parameters=found.chart.coordinates.size,
        samples=int(found.chart.notes["samples"]),
        iterations=sum(result.iterations for result in results),
        evaluations=sum(result.evaluations for result in results),
        task_std_deg=report.task_angle.std,
        mutual_std_deg=report.mutual_angle.std,
        leak_rms_deg=report.leak.rms,
        conditioning_min=report.conditioning.min,
        conditioning_p01=report.conditioning.p01,
        conditioning_mean=report.conditioning.mean,
        folded_samples=report.folded_samples,
        history=tuple(history),
    )


def failure(cell: Cell, error: str) -> CellResult:
    """The result of a fit that failed."""
    text = " ".join(error.split())
    return CellResult(
        cell.problem.name, cell.parametrisation.label, cell.solver_name, cell.seed, Status.FAILED.value, text
    )


def run_cells(
    cells: Sequence[Cell], executor: Executor | None = None, jobs: int | None = None, monitor: Monitor = silent
) -> Iterator[CellResult]:
    """Run cells, and yield results as they arrive. A cell that fails or kills its process does not affect the others.

    Args:
        cells: the cells to run.
        executor: runs the cells. Default: processes on this machine with one thread each.
        jobs: number of these processes. Default: one for each core that this process may use.
        monitor: called with the share of finished cells.
    """
    results = _own_processes(cells, jobs) if executor is None else _submitted(cells, executor)
    for done, result in enumerate(results, start=1):
        detail = f"{result.parametrisation}, {result.solver}"
        monitor(Progress("comparing", done / len(cells), f"{done} of {len(cells)}, {detail}"))
        yield result


def _submitted(cells: Sequence[Cell], executor: Executor) -> Iterator[CellResult]:
    """Run all cells on a given executor."""
    futures = {executor.submit(run_cell, cell): cell for cell in cells}
    try:
        for future in as_completed(futures):
            yield _outcome(future, futures[future])
    finally:
        for future in futures:
            future.cancel()


def _outcome(future: Future[CellResult], cell: Cell) -> CellResult:
    error = future.exception()
    if error is None:
        return future.result()
    died = isinstance(error, BrokenExecutor)
    return failure(cell, _DIED if died else f"{type(error).__name__}: {error}")


def _own_processes(cells: Sequence[Cell], jobs: int | None) -> Iterator[CellResult]:
    """Run all cells in new processes. If a process dies, each remaining cell runs again in a pool of its own.

    Cells are passed in files: a pool whose process dies while it receives a large argument hangs in Python 3.11.2.
    """
    with open_draft_folder() as folder:
        files = {}
        for k, cell in enumerate(cells):
            try:
                content = pickle.dumps(cell)
            except (pickle.PicklingError, TypeError, AttributeError) as error:
                yield failure(cell, f"{type(error).__name__}: {error}")
                continue
            files[cell] = folder / f"{k}.pickle"
            write_temporary(files[cell], content)
        yield from _in_pools(files, jobs)


def _in_pools(files: Mapping[Cell, Path], jobs: int | None) -> Iterator[CellResult]:
    """Run cells stored in files: in one pool, then one by one the cells that a dying process left."""
    left: list[Cell] = []
    stop, parent = shared_event(), os.getpid()
    with worker_pool(jobs or THREADS, _begin, stop, parent) as pool:
        try:
            with starting_workers():
                futures = {pool.submit(_run_stored, file): cell for cell, file in files.items()}
            for future in as_completed(futures):
                if isinstance(future.exception(), BrokenExecutor):
                    left.append(futures[future])
                else:
                    yield _outcome(future, futures[future])
        except BaseException:  # Ctrl-C, or the caller stops: running fits end at their next step
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise
    for cell in left:
        with worker_pool(1, _begin, stop, parent) as pool:
            with starting_workers():
                future = pool.submit(_run_stored, files[cell])
            yield _outcome(future, cell)


def _run_stored(file: Path) -> CellResult:
    """Run a cell from a file that this program wrote."""
    cell: Cell = pickle.loads(file.read_bytes())
    return run_cell(cell)


def _begin(stop: Event, parent: int) -> None:
    """Initialise a worker process: it ignores Ctrl-C, the parent stops it, and it ends with the parent."""
    begin_worker(parent)
    _stops.append(stop)


def _cancelled() -> bool:
    return any(stop.is_set() for stop in _stops)
