"""Comparisons: a grid of parametrisations, solvers, weights and seeds, all evaluated on the same held-out samples."""

from __future__ import annotations

import csv
import io
import math
import os
import pickle
import re
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, as_completed, wait
from dataclasses import dataclass, fields, replace
from itertools import product
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, cast

from orthocas.bases.family import Parametrisation, parametrisation_to_data, parse_parametrisation
from orthocas.charts.chart_file import CHART
from orthocas.charts.quality import evaluate
from orthocas.charts.ready import load
from orthocas.codegen.library import control_tick
from orthocas.errors import ChartFileError, Interrupted, InvalidValueError, OrthocasError
from orthocas.fitting.fit import Fit, fit
from orthocas.fitting.like import Likeness
from orthocas.fitting.stages import choose_solver
from orthocas.fitting.terms import DEFAULT_WEIGHTS, WeightNumbers, Weights
from orthocas.fitting.wide import CLEARANCE, WideFit, fit_wide
from orthocas.solvers.minimisers import GaussNewton
from orthocas.solvers.protocol import Solver, Status
from orthocas.tasks.branches import Branch, branches
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tools.archive import require_free
from orthocas.tools.batch import THREADS
from orthocas.tools.checks import as_path, require_count, require_kind
from orthocas.tools.display import Shown, percent
from orthocas.tools.files import open_draft_folder, publish, require_writable, write_temporary
from orthocas.tools.interrupts import deferred
from orthocas.tools.json import clean, write_json
from orthocas.tools.processes import Processes, begin_worker
from orthocas.tools.progress import Monitor, Progress, silent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_UNSAFE = r"[^\w.-]"  # in names of files
WIDE = "wide"  #: in place of the name of a solver
HELD_OUT_SEED = 2**31  #: seed of the held-out samples; no fit of a grid uses it


def compare(
    problem: Problem,
    parametrisations: Sequence[Parametrisation | str],
    solvers: Sequence[Solver] | None = None,
    *,
    branch: Branch | Box | str | None = None,
    seeds: int = 1,
    weights: Weights | WeightNumbers | Sequence[Weights | WeightNumbers] | None = None,
    like: Likeness | None = None,
    clearance: float | None = None,
    samples: int | None = None,
    held_out: int = 100_000,
    executor: Executor | None = None,
    jobs: int | None = None,
    charts: str | Path | None = None,
    control_ticks: bool = False,
    monitor: Monitor = silent,
    force: bool = False,
) -> Comparison:
    """Fit every parametrisation with every solver, weights and seed, and evaluate all on the same held-out samples.

    If a fit fails, the result says so and the others continue. Coordinates in closed form need no solver and no seed,
    so they are evaluated once.

    With a branch the fits are those of `fit_wide`, each evaluated on its own domain. With several weights, the figure
    (`plot`) and the table (`rows`) show how regular share and conditioning fall as leaks become smaller.

    In scripts, call it under `if __name__ == "__main__"`, because it starts processes.

    Args:
        problem: robot, task, metric and domain. A branch replaces the domain.
        parametrisations: the parametrisations to fit, or their names on the command line, such as "polynomial:4".
        solvers: the solvers to use. Default: for each parametrisation the default of `fit`. Not for wide fits.
        branch: the branch for wide fits: one of `orthocas.branches`, its name, or a box, as in `fit_wide`.
        seeds: number of seeds 0, 1, ... of samples and random starts.
        weights: weights of the loss, or several of them; see `fit`, and `fit_wide` for a branch. Default: those of
            these functions.
        like: quantities to follow, as in `fit` and `fit_wide`; wide charts follow them too, and do not take them
            exactly. For processes it must be a name, a task, or a function of a module.
        clearance: least relative singular value in wide fits, see `fit_wide`. Default: that of the problem's domain, or
            of `fit_wide`.
        samples: number of training samples. Default: grows with the number of parameters.
        held_out: number of held-out samples.
        executor: any `concurrent.futures.Executor` (processes, threads, Dask, MPI, ...). Default: processes on this
            machine with one thread each, so that seconds are those of one core.
        jobs: number of these processes. Default: one for each core.
        charts: folder to save charts in.
        control_ticks: measure after all fits how long a control tick takes with each parametrisation. The tick is
            decoupled PD+ as generated C, on a saved chart. NaN if there is no C compiler.
        monitor: called with progress.
        force: replace files with the names of charts in that folder even if they are no charts.

    Raises:
        InvalidValueError: if the grid is empty, if two of its parametrisations, solvers or weights have the same name,
            or if solvers are given for wide fits.
        UnknownNameError: if there is no such branch.
        ChartFileError: if the folder for charts cannot be written, or has another file with the name of a chart.
        Interrupted: after Ctrl-C; its `result` is the comparison of the finished fits.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> with ThreadPoolExecutor(1) as executor:
        ...     comparison = oc.compare(
        ...         problems.get("planar_3r_xy"),
        ...         [oc.Linear(), oc.Polynomial(degree=2)],
        ...         samples=200,
        ...         held_out=1000,
        ...         executor=executor,
        ...     )
        >>> [result.parametrisation for result in comparison.results]
        ['linear', 'polynomial:2']
    """
    require_kind("problem", problem, Problem)
    seeds, held_out = require_count("seeds", seeds), require_count("held_out", held_out)
    losses = _list_weights(weights, None if branch is not None else DEFAULT_WEIGHTS)
    jobs = None if jobs is None else require_count("jobs", jobs)
    families = _check_grid(parametrisations, solvers)
    part = branches(problem.robot, problem.task)[branch] if isinstance(branch, str) else branch
    if part is not None and solvers is not None:
        raise InvalidValueError("solvers", "given with a branch", "no solvers, because wide fits choose their own")
    if clearance is not None and part is None:
        raise InvalidValueError(
            "clearance", "given without a branch", "a branch, because only wide fits have a clearance"
        )
    bound = problem.domain.singular_bound
    if clearance is None:
        clearance = CLEARANCE if bound is None else bound.least_singular_value
    folder = None if charts is None else as_path("charts", charts)
    if folder is not None:
        require_writable(folder / "chart", ChartFileError)
        # Charts that cannot be saved are refused before the first fit
        for parametrisation in families:
            parametrisation_to_data(parametrisation.for_problem(problem))
    elif control_ticks:
        raise InvalidValueError("charts", None, "a folder for charts: control_ticks are measured on them")

    first = Cell(problem, families[0], None, 0, losses[0], samples, held_out, None, force, part, like, clearance)
    cells = _build_cells(first, families, solvers, losses, seeds, folder)

    # Results arrive in any order: sort them by the order of the grid.
    order = {cell.names: k for k, cell in enumerate(cells)}
    results: list[CellResult] = []
    interrupted = False
    try:
        results.extend(run_cells(cells, executor, jobs, monitor))
        if control_ticks:
            results = measure_control_ticks(results, cells, monitor)
    except KeyboardInterrupt:
        interrupted = True
    results.sort(key=lambda result: order[result.names])
    comparison = Comparison(tuple(results), interrupted)
    if interrupted:
        raise Interrupted(comparison)
    return comparison


def _list_weights(
    weights: Weights | WeightNumbers | Sequence[Weights | WeightNumbers] | None, default: Weights | None
) -> list[Weights | None]:
    """The weights of a grid, as a list.

    Raises:
        InvalidValueError: if two of them have the same label.
    """
    if weights is None:
        return [default]
    # A single set of weights is an object or a list of numbers
    if isinstance(weights, Weights) or not any(isinstance(each, Weights | Sequence) for each in weights):
        return [Weights.of(cast(Weights | WeightNumbers, weights))]
    # Tables distinguish several sets by their labels
    several = [Weights.of(cast(Weights | WeightNumbers, each)) for each in weights]
    labels = [each.label for each in several]
    if twice := [label for label in labels if labels.count(label) > 1]:
        raise InvalidValueError("weights", f"a list with {twice[0]} twice", "weights that all differ")
    return list(several)


def _build_cells(
    first: Cell,
    parametrisations: Sequence[Parametrisation],
    solvers: Sequence[Solver] | None,
    losses: Sequence[Weights | None],
    seeds: int,
    folder: Path | None,
) -> list[Cell]:
    """The cells of a grid; settings that do not vary are those of the first one.

    Raises:
        ChartFileError: if a file has the name of a chart, and is not to be replaced.
    """
    cells = []
    for parametrisation in parametrisations:
        # Coordinates in closed form have a single cell, because they need no solver, weights or seed
        closed = parametrisation.closed_form is not None
        fitting = [choose_solver(parametrisation, first.problem)] if closed or solvers is None else solvers
        for solver, loss, seed in product(fitting, losses[:1] if closed else losses, range(1 if closed else seeds)):
            cell = replace(first, parametrisation=parametrisation, solver=solver, weights=loss, seed=seed)
            # Name the chart file of the cell, and refuse names of other files before the first fit
            if folder is not None:
                words = [parametrisation.label, solver.name if first.branch is None else WIDE, str(seed)]
                words += [cell.weights_label] if len(losses) > 1 else []
                file = folder / f"{re.sub(_UNSAFE, '-', '_'.join(words))}.orthocas"
                require_free(file, CHART, first.force)
                cell = replace(cell, chart_file=file)
            cells.append(cell)
    return cells


def _check_grid(
    parametrisations: Sequence[Parametrisation | str], solvers: Sequence[Solver] | None
) -> list[Parametrisation]:
    """The parametrisations of a grid as objects.

    Raises:
        InvalidValueError: if parametrisations or solvers are none, of another type, or two of the same name.
    """
    families: Any = parametrisations
    if isinstance(parametrisations, list | tuple):
        families = [parse_parametrisation(one) if isinstance(one, str) else one for one in parametrisations]
    # Names must differ, because tables and files identify fits by them
    for name, members, kinds, example in (
        ("parametrisations", families, Parametrisation, "Polynomial(degree=4)"),
        ("solvers", [GaussNewton()] if solvers is None else solvers, Solver, "GaussNewton()"),
    ):
        require_kind(name, members, Sequence)
        if not members:
            raise InvalidValueError(name, "empty", f"at least one, such as [{example}]")
        for member in members:
            if not isinstance(member, kinds):
                raise InvalidValueError(name, repr(member), f"objects such as {example}")
        labels = [getattr(member, "label", getattr(member, "name", "")) for member in members]
        twice = [label for label in labels if labels.count(label) > 1]
        if twice:
            raise InvalidValueError(
                name, f"a list with two called '{twice[0]}'", "different names; compare these in two grids"
            )
    return list(families)


@dataclass(frozen=True, eq=False)
class Cell:
    """One fit of a grid: settings that can be sent to another process."""

    problem: Problem
    parametrisation: Parametrisation
    solver: Solver | None  #: None in the template from which cells are made
    seed: int
    weights: Weights | None  #: None for the default of `fit_wide`
    samples: int | None
    held_out: int
    chart_file: Path | None  #: file to save the chart in
    force: bool = False  #: replace a file there that is not a chart
    branch: Branch | Box | None = None  #: of a wide fit
    like: Likeness | None = None  #: quantities that coordinates follow
    clearance: float = CLEARANCE  #: of a wide fit

    @property
    def solver_name(self) -> str:
        """Name of the solver; "wide" for wide fits, and "closed form" for coordinates that need none."""
        if self.branch is not None:
            return WIDE
        assert self.solver is not None
        return self.solver.name if self.parametrisation.closed_form is None else "closed form"

    def fail(self, error: str) -> CellResult:
        """The result of a cell whose fit failed with this error."""
        return CellResult(*self.names, Status.FAILED.value, " ".join(error.split()))

    @property
    def weights_label(self) -> str:
        """The weights as written on the command line; empty for the default of `fit_wide`."""
        return "" if self.weights is None else self.weights.label

    @property
    def names(self) -> tuple[str, str, str, str, int]:
        """What identifies a cell: problem, parametrisation, solver, weights, seed."""
        return self.problem.name, self.parametrisation.label, self.solver_name, self.weights_label, self.seed

    def fit(self, monitor: Monitor) -> Fit:
        """Fit the chart."""
        settings: dict[str, Any] = {
            "weights": self.weights,
            "samples": self.samples,
            "seed": self.seed,
            "like": self.like,
        }
        if self.branch is None:
            return fit(self.problem, self.parametrisation, self.solver, monitor=monitor, **settings)
        robot, task, metric = self.problem.robot, self.problem.task, self.problem.metric
        settings |= {"parametrisation": self.parametrisation, "clearance": self.clearance, "monitor": monitor}
        return fit_wide(robot, task, self.branch, metric, **settings)


@dataclass(frozen=True)
class CellResult:
    """The result of one fit, or its error. Measured values of a failed fit are NaN, and counts are 0."""

    problem: str
    parametrisation: str
    solver: str
    weights: str  #: as written on the command line; empty for the default of wide fits
    seed: int
    status: str
    error: str = ""
    seconds: float = float("nan")  #: duration of the fit [s]
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
    regular_share: float = float("nan")  #: of the branch, for wide fits
    control_tick_us: float = float("nan")  #: a tick of decoupled PD+ as generated C [us]; NaN if not measured
    #: seconds since the start of the fit, and training loss, in its last stage
    history: tuple[tuple[float, float], ...] = ()

    @property
    def names(self) -> tuple[str, str, str, str, int]:
        """Names of the cell."""
        return self.problem, self.parametrisation, self.solver, self.weights, self.seed

    @property
    def failed(self) -> bool:
        """Whether there is no chart."""
        return bool(self.error)


def run_cell(cell: Cell) -> CellResult:
    """Fit and evaluate. An error becomes part of the result."""
    history: list[tuple[float, float]] = []
    stages: list[str] = []
    start = time.perf_counter()
    # Keep the losses over time of the last stage only

    def record(progress: Progress) -> None:
        if progress.stage not in stages:
            stages.append(progress.stage)
            history.clear()
        if math.isfinite(progress.value):
            history.append((time.perf_counter() - start, progress.value))

    # Any failure becomes the result of this cell, so that the other cells continue
    try:
        result = cell.fit(record)
        if cell.chart_file is not None:
            result.chart.save(cell.chart_file, cell.force)
        report = evaluate(result.chart, cell.held_out, HELD_OUT_SEED)
    except Exception as error:
        return cell.fail(f"{type(error).__name__}: {error}")
    return CellResult(
        *cell.names,
        status=result.status.value,
        seconds=result.seconds,
        parameters=result.chart.coordinates.size,
        samples=int(result.chart.notes["samples"]),
        iterations=sum(stage.result.iterations for stage in result.stages),
        evaluations=sum(stage.result.evaluations for stage in result.stages),
        task_std_deg=report.task_angle.std,
        mutual_std_deg=report.mutual_angle.std,
        leak_rms_deg=report.leak.rms,
        conditioning_min=report.conditioning.min,
        conditioning_p01=report.conditioning.p01,
        conditioning_mean=report.conditioning.mean,
        folded_samples=report.folded_samples,
        regular_share=result.regular_share if isinstance(result, WideFit) else math.nan,
        history=tuple(history),
    )


def run_cells(
    cells: Sequence[Cell], executor: Executor | None = None, jobs: int | None = None, monitor: Monitor = silent
) -> Iterator[CellResult]:
    """Run cells, and yield results as they arrive. A cell that fails or kills its process does not affect the others.

    Args:
        cells: the cells to run.
        executor: runs the cells. Default: processes on this machine with one thread each.
        jobs: number of these processes. Default: one for each core that this process may use.
        monitor: called with the fraction of finished cells.
    """
    results = _run_in_processes(cells, jobs or THREADS) if executor is None else _run_on(executor, cells)
    for done, result in enumerate(results, start=1):
        detail = f"{result.parametrisation}, {result.solver}"
        monitor(Progress("comparing", done / len(cells), f"{done} of {len(cells)}, {detail}"))
        yield result


def _run_on(executor: Executor, cells: Sequence[Cell]) -> Iterator[CellResult]:
    futures = {executor.submit(run_cell, cell): cell for cell in cells}
    try:
        for future in as_completed(futures):
            yield _read_result(future, futures[future])
    finally:
        for future in futures:
            future.cancel()


def _run_in_processes(cells: Sequence[Cell], size: int) -> Iterator[CellResult]:
    """Run cells in new processes, which are killed if the caller stops.

    Cells are passed in files: a pool whose process dies while it receives a large argument hangs in Python 3.11.2.
    """
    with open_draft_folder() as folder, Processes(size, begin_worker, os.getpid()) as processes:
        queue, running = iter(enumerate(cells)), dict[Future[CellResult], Cell]()
        while True:
            # Give each process one cell at a time, so that a process that dies loses only that cell.
            while len(running) < size and (entry := next(queue, None)) is not None:
                k, cell = entry
                try:
                    content = pickle.dumps(cell)
                except (pickle.PicklingError, TypeError, AttributeError) as error:
                    yield cell.fail(f"{type(error).__name__}: {error}")
                    continue
                write_temporary(folder / f"{k}.pickle", content)
                running[processes.submit(_run_stored, folder / f"{k}.pickle")] = cell
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield _read_result(future, running.pop(future))


def _run_stored(file: Path) -> CellResult:
    """Run a cell from a file that this program wrote."""
    cell: Cell = pickle.loads(file.read_bytes())
    return run_cell(cell)


def _read_result(future: Future[CellResult], cell: Cell) -> CellResult:
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, BrokenExecutor):
        reason = "out of memory, or a script that calls compare outside `if __name__ == '__main__'`"
        return cell.fail(f"its process died: {reason}")
    return cell.fail(f"{type(error).__name__}: {error}")


def measure_control_ticks(results: Sequence[CellResult], cells: Sequence[Cell], monitor: Monitor) -> list[CellResult]:
    """Add `control_tick_us` to the results. Ticks are measured one at a time, so that they do not disturb each other.

    It is NaN if there is no chart file, no C compiler, or the controller does not support the chart.
    """
    files = {
        cell.parametrisation.label: cell.chart_file for cell in cells if cell.chart_file and cell.chart_file.exists()
    }
    ticks = {}
    for k, (label, file) in enumerate(files.items()):
        monitor(Progress("timing control ticks", k / len(files), label))
        try:
            # CasADi may make a RuntimeError of Ctrl-C while it builds functions.
            with deferred():
                chart = load(file)
            ticks[label] = control_tick(chart)
        except (OrthocasError, OSError, RuntimeError, MemoryError):
            # A measurement that fails must not lose the fits.
            ticks[label] = math.nan
    return [
        result if result.failed else replace(result, control_tick_us=ticks.get(result.parametrisation, math.nan))
        for result in results
    ]


@dataclass(frozen=True)
class Summary:
    """Results of one parametrisation, solver and weights: medians over seeds, and relative spreads of both angles."""

    parametrisation: str
    solver: str
    weights: str
    seeds: int
    failed: int
    error: str  #: error of the first failed seed
    parameters: int
    seconds: float  #: duration of the fit [s]
    task_std_deg: float
    mutual_std_deg: float
    leak_rms_deg: float  #: in the metric; the two above are the paper's
    conditioning_p01: float
    regular_share: float  #: of the branch, for wide fits
    folded_samples: int
    control_tick_us: float  #: duration of a decoupled PD+ tick as generated C [us]
    task_spread: float  #: (largest - smallest) / median
    mutual_spread: float


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """All fits of a grid."""

    results: tuple[CellResult, ...]
    interrupted: bool = False  #: whether Ctrl-C stopped it before all fits were done

    @property
    def wide(self) -> bool:
        """Whether the fits are wide fits."""
        return any(result.solver == WIDE for result in self.results)

    def summaries(self) -> list[Summary]:
        """One summary for each parametrisation, solver and weights.

        The least task angle comes first (of wide fits the least leak), and failures come last.
        """
        groups: dict[tuple[str, str, str], list[CellResult]] = {}
        for result in self.results:
            groups.setdefault((result.parametrisation, result.solver, result.weights), []).append(result)
        angle = "leak_rms_deg" if self.wide else "task_std_deg"
        summaries = [summarise(results) for results in groups.values()]
        return sorted(summaries, key=lambda s: (math.isnan(getattr(s, angle)), getattr(s, angle)))

    def write(self, folder: Path, force: bool = False) -> None:
        """Write comparison.csv (one line per fit) and comparison.json (with histories).

        Files of these names are replaced if orthocas wrote them, and with `force` in any case.

        Raises:
            ArchiveError: if there are other files of these names, or symbolic links.
        """
        # CSV has the table of the fits, JSON has everything
        names = [field.name for field in fields(CellResult) if field.name != "history"]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, names)
        writer.writeheader()
        for result in self.results:
            writer.writerow({name: getattr(result, name) for name in names})
        with publish(folder, listed=True, force=force) as drafts:
            (drafts / "comparison.csv").write_text(text.getvalue(), newline="")
            (drafts / "comparison.json").write_text(write_json(self.as_dict(), indent=1))

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON. NaN becomes None."""
        return {"summaries": clean(self.summaries()), "fits": clean(self.results)}

    def facts(self) -> dict[str, str]:
        """The summaries, the best one first."""
        failed = sum(result.failed for result in self.results)
        ended = ", interrupted" if self.interrupted else ""
        return {
            "comparison": f"{len(self.results)} fits, {failed} failed{ended}",
            **{
                ", ".join([s.parametrisation, s.solver] + [s.weights] * self._several): _describe(s)
                for s in self.summaries()
            },
        }

    def plot(self) -> Figure:
        """Figure of the angles of all fits or, of wide fits, their leaks; see `comparison_figures.front_figure`."""
        from orthocas.fitting.comparison_figures import front_figure  # with matplotlib, which takes long to import

        return front_figure(self)

    def rows(self) -> list[list[str]]:
        """The rows of a readable table, with the header first."""
        rows = [_row(summary) for summary in self.summaries()]
        hidden = {name for name, shown in (("weights", self._several), ("regular share", self.wide)) if not shown}
        return [[name for name in _COLUMNS if name not in hidden]] + [
            [text for name, text in row.items() if name not in hidden] for row in rows
        ]

    @property
    def _several(self) -> bool:
        return len({result.weights for result in self.results}) > 1


_COLUMNS = (
    "parametrisation",
    "solver",
    "weights",
    "parameters",
    "task std",
    "mutual std",
    "leak rms",
    "cond 1 %",
    "regular share",
    "folded",
    "seconds",
    "control tick",
)
_ANGLES = ("task_std_deg", "mutual_std_deg", "leak_rms_deg", "conditioning_p01")
_MEDIANS = (*_ANGLES, "seconds", "regular_share", "control_tick_us")


def summarise(results: Sequence[CellResult]) -> Summary:
    """Medians over the seeds of one parametrisation, solver and weights."""
    good = [result for result in results if not result.failed]
    first = (good or results)[0]
    # Medians and spreads are over the seeds that did not fail

    def compute_median(name: str) -> float:
        return median(float(getattr(result, name)) for result in good) if good else math.nan

    def compute_spread(name: str) -> float:
        values = [float(getattr(result, name)) for result in good]
        return (max(values) - min(values)) / median(values) if values and median(values) else math.nan

    return Summary(
        parametrisation=first.parametrisation,
        solver=first.solver,
        weights=first.weights,
        seeds=len(results),
        failed=len(results) - len(good),
        error=next((result.error for result in results if result.failed), ""),
        parameters=first.parameters,
        folded_samples=max((result.folded_samples for result in good), default=0),
        task_spread=compute_spread("task_std_deg"),
        mutual_spread=compute_spread("mutual_std_deg"),
        **{name: compute_median(name) for name in _MEDIANS},
    )


def _describe(s: Summary) -> str:
    if s.failed == s.seeds:
        return f"failed: {s.error}"
    if s.solver == WIDE:
        share = percent(s.regular_share, 3)
        return f"leak rms {s.leak_rms_deg:.2f} deg, conditioning 1 % {s.conditioning_p01:.3f}, regular {share}"
    angles = f"task std {s.task_std_deg:.3f}, mutual std {s.mutual_std_deg:.3f}, leak rms {s.leak_rms_deg:.3f} deg"
    return f"{angles}, {s.seconds:.2f} s"


def _row(s: Summary) -> dict[str, str]:
    """The cells of a row by their columns. A row whose seeds all failed ends with the reason."""
    # If some seeds failed, their number stands after the solver
    failed = f" ({s.failed} of {s.seeds} failed)" if 0 < s.failed < s.seeds else ""
    names = {"parametrisation": s.parametrisation, "solver": s.solver + failed, "weights": s.weights}
    if s.failed == s.seeds:
        return {**names, "error": f"failed: {s.error}"}
    several = s.seeds - s.failed > 1
    # With several seeds, angles are shown with half of their spread

    def angle(value: float, spread: float) -> str:
        if math.isnan(value):
            return "-"
        return f"{value:.3f} ±{50 * spread:.1f} %" if several else f"{value:.3f}"

    cells = (
        str(s.parameters),
        angle(s.task_std_deg, s.task_spread),
        angle(s.mutual_std_deg, s.mutual_spread),
        f"{s.leak_rms_deg:.3f}",
        f"{s.conditioning_p01:.3f}",
        percent(s.regular_share, 3) if math.isfinite(s.regular_share) else "-",
        str(s.folded_samples),
        f"{s.seconds:.2f}",
        "-" if math.isnan(s.control_tick_us) else f"{s.control_tick_us:.3g} us",
    )
    return {**names, **dict(zip(_COLUMNS[len(names) :], cells, strict=True))}
