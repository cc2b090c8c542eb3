"""The front door: fit and distil, with a default parametrisation and solver, compare, and load."""

import re
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from itertools import product
from pathlib import Path

from orthocas.archive import require_writable
from orthocas.chart import Chart
from orthocas.checks import as_float_array, require_count
from orthocas.comparison import Cell, CellResult, run_cells
from orthocas.comparison_report import Comparison
from orthocas.comparison_ticks import with_control_ticks
from orthocas.distillation import Distilled, distil_chart
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.fitting import Fit, fit_chart
from orthocas.growing import GrownCoordinates
from orthocas.grown_chart import GrownChart
from orthocas.loss import DEFAULT_WEIGHTS, Weights
from orthocas.objective import Monitor, Solver, Watch, silent
from orthocas.parametrisations import MLP, SEW, Given, GradedParametrisation, Linear, Parametrisation, Polynomial
from orthocas.problem import Problem
from orthocas.solvers import LBFGS, GaussNewton, Ipopt

WeightNumbers = tuple[float, float] | tuple[float, float, float] | tuple[float, float, float, float]


def fit(
    problem: Problem,
    parametrisation: Parametrisation | SEW | None = None,
    solver: Solver | None = None,
    weights: WeightNumbers = DEFAULT_WEIGHTS,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
    max_mutual_deg: float | None = None,
    checkpoint: str | Path | None = None,
) -> Fit:
    """Find coordinates xi(q) that are as orthogonal as possible to the task.

    Minimises the mean of [AS2023] eq. (24) over uniform samples of the domain. Joints that the task does not feel
    become coordinates themselves; families linear in their parameters start from a spectral solution of low degree
    and climb degree by degree. Ctrl-C returns the best coordinates so far, with status INTERRUPTED.

    Args:
        problem: robot, task, metric and domain.
        parametrisation: default Polynomial(degree=4).
        solver: default GaussNewton for families linear in their parameters, LBFGS otherwise.
        weights: (lambda1, lambda2) is the loss of the paper: task term against mutual term; their ratio picks a point
            on the front. A third number lambda3 adds the regularity term (ours), which keeps the gradients of the
            coordinates from collapsing anywhere; a fourth, lambda4, the length term (ours), which keeps their lengths
            even.
        samples: number of samples; default grows with the number of parameters.
        seed: seed of samples and of random starts.
        monitor: called with progress.
        max_mutual_deg: the constrained form: the smallest task term while mutual angles deviate from 90 degrees by at
            most this much (root mean square over the samples) [deg], found by Ipopt; lambda2 is not used then.
        checkpoint: a file that keeps the state of a long fit. If it exists, the fit goes on from there.

    Returns:
        The chart, how each stage went, and seconds.

    Raises:
        SingularTaskError, MetricError: if the problem does not pass its own check.
        MemoryNeedError: if the degree is too large for this machine.
        InvalidValueError, SolveError: if settings do not fit together, or the loss is not finite.
        InfeasibleError: if max_mutual_deg cannot be met.
        CheckpointError: if the checkpoint is damaged, or belongs to another fit.
    """
    parametrisation = Polynomial(degree=4) if parametrisation is None else parametrisation
    if not isinstance(parametrisation, Parametrisation | SEW):
        raise InvalidValueError("parametrisation", repr(parametrisation), "an object such as Polynomial(degree=4)")
    if solver is None:
        solver = Ipopt() if max_mutual_deg is not None else default_solver(parametrisation)
    if not isinstance(solver, Solver):
        raise InvalidValueError("solver", repr(solver), "an object such as GaussNewton()")
    if max_mutual_deg is not None and not isinstance(solver, Ipopt):
        raise InvalidValueError("solver", solver.name, "ipopt, which alone can keep max_mutual_deg")
    loss = _weights(weights)
    starter = None if max_mutual_deg is None else GaussNewton()
    return fit_chart(
        problem, parametrisation, solver, loss, samples, seed, monitor, max_mutual_deg, checkpoint, starter
    )


def distil(
    chart: Chart,
    parametrisation: Parametrisation | None = None,
    solver: Solver | None = None,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
) -> Distilled:
    """Fit a closed expression to the values and gradients of a grown chart, for controllers and generated C.

    Minimises the mean of |xi - xi_grown|^2 + w^2 |J_xi - J_grown|^2 over samples of the domain, with w the mean
    half-width of the domain: bases linear in their parameters by least squares, networks by a minimiser.

    Args:
        chart: a grown chart.
        parametrisation: default Polynomial(degree=6).
        solver: for networks, default LBFGS.
        samples: number of samples; default four for each parameter of a coordinate, 2000 to 20,000.
        seed: of samples and random starts.
        monitor: called with progress.

    Returns:
        The chart, and what was lost: errors of values and gradients, and quality before and after.

    Raises:
        InvalidValueError: if the chart is not grown, or the parametrisation is none to fit.
        GrowError: if the grown chart has no values on its domain.
    """
    parametrisation = Polynomial(degree=6) if parametrisation is None else parametrisation
    if not isinstance(parametrisation, GradedParametrisation | MLP):
        raise InvalidValueError("parametrisation", repr(parametrisation), "Polynomial, Fourier or MLP")
    if not isinstance(chart, Chart):
        raise InvalidValueError("chart", repr(chart), "a grown chart")
    if solver is not None and not (isinstance(parametrisation, MLP) and isinstance(solver, Solver)):
        raise InvalidValueError("solver", repr(solver), "a solver such as LBFGS(), and only for a network")
    solver = LBFGS(max_iterations=500, tolerance=1e-9) if solver is None else solver
    return distil_chart(
        chart, parametrisation, solver, samples, seed, Watch(monitor, f"distil {parametrisation.label}")
    )


def compare(
    problem: Problem,
    parametrisations: Sequence[Parametrisation | SEW],
    solvers: Sequence[Solver] | None = None,
    seeds: int = 1,
    weights: WeightNumbers = DEFAULT_WEIGHTS,
    samples: int | None = None,
    held_out: int = 100_000,
    executor: Executor | None = None,
    jobs: int | None = None,
    charts: str | Path | None = None,
    control_ticks: bool = False,
    monitor: Monitor = silent,
) -> Comparison:
    """Fit every parametrisation with every solver and seed, and judge all on the same held-out samples.

    A fit that fails is reported as such; the others go on. Ctrl-C returns the fits that are done. Coordinates in closed
    form need no solver and no seed, and come once.

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

    Call it under `if __name__ == "__main__"` in scripts, as all that starts processes.

    Raises:
        InvalidValueError: if the grid is empty, or two of its parametrisations or solvers have the same name.
        ChartFileError: if the folder for charts cannot be written.
    """
    count, loss = require_count("seeds", seeds), _weights(weights)
    jobs = None if jobs is None else require_count("jobs", jobs)
    held_out = require_count("held_out", held_out)
    _require_grid(parametrisations, solvers)
    folder = None if charts is None else Path(charts)
    if folder is not None:
        require_writable(folder / "chart")
    elif control_ticks:
        raise InvalidValueError("charts", None, "a folder for charts: control_ticks are measured on them")
    cells = [
        Cell(problem, parametrisation, solver, seed, loss, samples, held_out, file)
        for parametrisation, solver, seed, file in _fits(parametrisations, solvers, count, folder)
    ]
    return _run_grid(cells, executor, jobs, control_ticks, monitor)


def _fits(
    parametrisations: Sequence[Parametrisation | SEW], solvers: Sequence[Solver] | None, seeds: int, folder: Path | None
) -> Iterator[tuple[Parametrisation | SEW, Solver, int, Path | None]]:
    """Parametrisation, solver, seed and chart file of every fit of a grid."""
    for parametrisation in parametrisations:
        closed = isinstance(parametrisation, Linear | Given | SEW)
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
    return Comparison(tuple(results), interrupted)


def default_solver(parametrisation: Parametrisation | SEW) -> Solver:
    """Gauss-Newton for families linear in their parameters, L-BFGS for others."""
    return GaussNewton() if isinstance(parametrisation, GradedParametrisation | Linear) else LBFGS()


def _require_grid(parametrisations: Sequence[Parametrisation | SEW], solvers: Sequence[Solver] | None) -> None:
    """Refuse grids that are empty, hold something else, or whose results could not be told apart."""
    for name, members, kinds, example in (
        ("parametrisations", parametrisations, Parametrisation | SEW, "Polynomial(degree=4)"),
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


def _weights(numbers: WeightNumbers) -> Weights:
    values = as_float_array("weights", numbers)
    if values.shape not in ((2,), (3,), (4,)):
        raise ShapeError("weights", values.shape, (4,))
    weights = Weights(*values.tolist())
    if weights.task == 0:
        raise InvalidValueError("lambda1", weights.task, "a positive number")
    return weights


def load(path: str | Path) -> Chart:
    """Read a chart file; see `Chart.load`. A grown chart comes back as a `GrownChart`."""
    chart = Chart.load(path)
    if isinstance(chart.coordinates, GrownCoordinates):
        return GrownChart(chart.problem, chart.coordinates, chart.notes)
    return chart
