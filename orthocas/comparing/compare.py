"""`compare`: a grid of parametrisations, solvers and seeds, fitted and judged side by side."""

import re
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from itertools import product
from pathlib import Path

from orthocas.checks import require_count, require_kind
from orthocas.comparing.cells import Cell, CellResult, run_cells
from orthocas.comparing.report import Comparison
from orthocas.comparing.ticks import with_control_ticks
from orthocas.errors import ChartFileError, Interrupted, InvalidValueError
from orthocas.files.archive import require_free
from orthocas.files.atomic import require_writable
from orthocas.files.chart_file import CHART
from orthocas.fitting.loss import DEFAULT_WEIGHTS, WeightNumbers, Weights
from orthocas.fitting.settings import default_solver
from orthocas.minimising.solver import Solver
from orthocas.minimising.watch import Monitor, silent
from orthocas.parametrisations import Parametrisation, require_savable
from orthocas.problem import Problem
from orthocas.solvers import GaussNewton


def compare(
    problem: Problem,
    parametrisations: Sequence[Parametrisation],
    solvers: Sequence[Solver] | None = None,
    *,
    seeds: int = 1,
    weights: Weights | WeightNumbers = DEFAULT_WEIGHTS,
    samples: int | None = None,
    held_out: int = 100_000,
    executor: Executor | None = None,
    jobs: int | None = None,
    charts: str | Path | None = None,
    control_ticks: bool = False,
    monitor: Monitor = silent,
    force: bool = False,
) -> Comparison:
    """Fit every parametrisation with every solver and seed, and judge all on the same held-out samples.

    A fit that fails is reported as such; the others go on. Coordinates in closed form need no solver and no seed, and
    come once.

    Args:
        problem: robot, task, metric and domain.
        parametrisations: what to fit.
        solvers: default for each parametrisation what `fit` takes.
        seeds: number of seeds 0, 1, ... of samples and random starts.
        weights: of the loss; see `fit`.
        samples: number of training samples; default grows with the number of parameters.
        held_out: number of held-out samples.
        executor: any `concurrent.futures.Executor` (of processes or threads, Dask, MPI, ...); default processes of this
            machine. Those use one thread each, so seconds are those of one core.
        jobs: number of such processes, default one for each core.
        charts: folder to save charts in.
        control_ticks: measure, after all fits, how long a control tick takes with each parametrisation: decoupled PD+
            as generated C, on a chart of the folder. NaN where there is no C compiler.
        monitor: called with progress.
        force: replace files in the folder for charts that are no charts.

    Call it under `if __name__ == "__main__"` in scripts, as all that starts processes.

    Raises:
        InvalidValueError: if the grid is empty, or two of its parametrisations or solvers have the same name.
        ChartFileError: if the folder for charts cannot be written, or has another file of a chart's name.
        Interrupted: after Ctrl-C; its `result` is the comparison of the fits that are done.
    """
    require_kind("problem", problem, Problem)
    count, loss = require_count("seeds", seeds), Weights.of(weights)
    jobs = None if jobs is None else require_count("jobs", jobs)
    held_out = require_count("held_out", held_out)
    _require_grid(parametrisations, solvers)
    folder = None if charts is None else Path(charts)
    if folder is not None:
        require_writable(folder / "chart", ChartFileError)
        for parametrisation in parametrisations:
            require_savable(parametrisation.for_problem(problem))
    elif control_ticks:
        raise InvalidValueError("charts", None, "a folder for charts: control_ticks are measured on them")
    cells = [
        Cell(problem, parametrisation, solver, seed, loss, samples, held_out, file, force)
        for parametrisation, solver, seed, file in _fits(parametrisations, solvers, count, folder)
    ]
    for cell in cells:
        if cell.chart_file is not None:
            require_free(cell.chart_file, CHART, force)
    return _run_grid(cells, executor, jobs, control_ticks, monitor)


def _fits(
    parametrisations: Sequence[Parametrisation],
    solvers: Sequence[Solver] | None,
    seeds: int,
    folder: Path | None,
) -> Iterator[tuple[Parametrisation, Solver, int, Path | None]]:
    """Parametrisation, solver, seed and chart file of every fit of a grid."""
    for parametrisation in parametrisations:
        closed = parametrisation.closed_form is not None
        fitting = [default_solver(parametrisation)] if closed or solvers is None else solvers
        for solver, seed in product(fitting, range(1 if closed else seeds)):
            name = re.sub(r"[^\w.-]", "-", f"{parametrisation.label}_{solver.name}_{seed}.orthocas")
            yield parametrisation, solver, seed, None if folder is None else folder / name


def _run_grid(
    cells: Sequence[Cell], executor: Executor | None, jobs: int | None, control_ticks: bool, monitor: Monitor
) -> Comparison:
    """All fits, in the order of the grid; after Ctrl-C those that are done."""
    order = {(cell.parametrisation.label, cell.solver_name, cell.seed): k for k, cell in enumerate(cells)}
    results: list[CellResult] = []
    interrupted = False
    try:
        results.extend(run_cells(cells, executor, jobs, monitor))
        if control_ticks:
            results = with_control_ticks(results, cells, monitor)
    except KeyboardInterrupt:
        interrupted = True
    results.sort(key=lambda result: order[result.parametrisation, result.solver, result.seed])
    found = Comparison(tuple(results), interrupted)
    if interrupted:
        raise Interrupted(found)
    return found


def _require_grid(parametrisations: Sequence[Parametrisation], solvers: Sequence[Solver] | None) -> None:
    """Refuse grids that are empty, hold something else, or whose results could not be told apart."""
    for name, members, kinds, example in (
        ("parametrisations", parametrisations, Parametrisation, "Polynomial(degree=4)"),
        ("solvers", [GaussNewton()] if solvers is None else solvers, Solver, "GaussNewton()"),
    ):
        if not members:
            raise InvalidValueError(name, "empty", f"at least one, as [{example}]")
        for member in members:
            if not isinstance(member, kinds):
                raise InvalidValueError(name, repr(member), f"objects such as {example}")
        labels = [getattr(member, "label", getattr(member, "name", "")) for member in members]
        twice = [label for label in labels if labels.count(label) > 1]
        if twice:
            raise InvalidValueError(
                name, f"holding two called '{twice[0]}'", "different ones; compare those in two grids"
            )
