"""Builds an atlas: jobs for any executor, boxes that are split, results appended to the file."""

import hashlib
import logging
import os
import pickle
import random
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from orthocas.atlas.atlas_file import ATLAS, Stock, add_results, header_of, read_stock
from orthocas.atlas.box_fit import BoxChart, BoxFitter, Mask, box_of, chart_of
from orthocas.atlas.index import Index
from orthocas.atlas.lattice import Cell, Outcome, Result, cell_boundaries
from orthocas.atlas.plan import Plan
from orthocas.atlas.regions import Region
from orthocas.certificates.certify import folds_nowhere
from orthocas.errors import AtlasFileError, CertifyError, OrthocasError
from orthocas.tasks.domains import Box
from orthocas.tools.batch import THREADS
from orthocas.tools.block_file import begins, create, owned, set_rest_aside, text_of
from orthocas.tools.checks import Array
from orthocas.tools.processes import ATTEMPTS, Processes, begin_worker, worker_died
from orthocas.tools.progress import Monitor, Progress

_LEAST_CLEAR = 0.3  # share of the samples of a box that have to be clear of singular positions for a chart
_BATCH = 4  # cells in a job
_AHEAD = 3  # jobs in flight for each worker
_IN_FLIGHT = 64  # jobs in flight of an executor that somebody gives
_FLUSH = 2.0  # seconds between blocks of the file
_SEED = 0
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Job:
    """Some cells of one atlas, for a worker anywhere."""

    plan: bytes | None  #: pickled; a worker unpickles it once. None: the worker has it already, see `keep_plan`
    cells: tuple[Cell, ...]


def packed(plan: Plan) -> bytes:
    """A plan for jobs."""
    return pickle.dumps(plan)


def keep_plan(plan: bytes) -> None:
    """Keep a plan in this process for jobs that come without one."""
    _kept[:] = [plan]


def run_job(job: Job) -> list[Result]:
    """Fit, judge and perhaps certify the charts of all cells of a job."""
    fitter = _fitter(_kept[0] if job.plan is None else job.plan)
    return [run_cell(fitter, cell) for cell in job.cells]


_kept: list[bytes] = []


@lru_cache(maxsize=2)
def _fitter(plan: bytes) -> BoxFitter:
    return BoxFitter(pickle.loads(plan))


def run_cell(fitter: BoxFitter, cell: Cell) -> Result:
    """The outcome of one cell. Errors of a fit are outcomes, too."""
    start = time.perf_counter()
    try:
        return _outcome(fitter, cell, start)
    except (OrthocasError, ArithmeticError, np.linalg.LinAlgError):
        return Result(cell, Outcome.FAILED, seconds=time.perf_counter() - start)


def _outcome(fitter: BoxFitter, cell: Cell, start: float) -> Result:
    plan, box = fitter.plan, box_of(fitter.plan, cell)
    centre_is_clear = plan.singular_values(box.centre[None])[0] > plan.settings.least_singular_value
    chart, clear = fitter.fit(box) if centre_is_clear else (None, fitter.clear(box))
    last = cell.depth >= plan.settings.splits
    found = Result(cell, Outcome.SINGULAR, clear=float(clear.mean()))
    if chart is not None and found.clear >= _LEAST_CLEAR:
        found = replace(found, leak_deg=chart.leak_deg, conditioning=chart.conditioning)
        good = _good(plan, chart)
        certified = good and _certified(fitter, box, chart, found.clear)
        if good and (certified or last or not plan.settings.certify_seconds):
            found = replace(found, outcome=Outcome.CHART, numbers=chart.numbers, certified=certified)
        elif last:
            found = replace(found, outcome=Outcome.POOR)
        else:
            found = replace(found, outcome=Outcome.SPLIT, joint=_helping(plan, chart))
    elif clear.any() and not last:
        found = replace(found, outcome=Outcome.SPLIT, joint=_dividing(plan, fitter.tests, clear))
    return replace(found, seconds=time.perf_counter() - start)


def _good(plan: Plan, chart: BoxChart) -> bool:
    asked = plan.settings
    return chart.leak_deg <= asked.leak_deg and chart.conditioning >= asked.conditioning


def _certified(fitter: BoxFitter, box: Box, chart: BoxChart, clear: float) -> bool:
    """Whether the chart is proved not to fold."""
    plan = fitter.plan
    if not plan.settings.certify_seconds:
        return False
    try:
        found = chart_of(plan, box, chart.numbers, clear, fitter.free)
        return folds_nowhere(found, plan.settings.certify_seconds)
    except CertifyError:
        return False


def _helping(plan: Plan, chart: BoxChart) -> int:
    """The joint along which halves gain most: what is missing grows fastest with its u^2, of which halves have less."""
    columns = [plan.active.index(joint) for joint in plan.joints]
    u = chart.u[:, columns]
    regressors = np.column_stack([np.ones(len(u)), u, u**2])
    slopes = np.linalg.lstsq(regressors, chart.excess, rcond=None)[0]
    return int(np.argmax(slopes[1 + len(columns) :]))


def _dividing(plan: Plan, u: Array, clear: Mask) -> int:
    """The joint whose halves differ most in how much of them is clear of singular positions."""
    columns = [plan.active.index(joint) for joint in plan.joints]
    gaps = [abs(clear[u[:, i] < 0].mean() - clear[u[:, i] >= 0].mean()) for i in columns]
    middle = [abs(clear[np.abs(u[:, i]) < 0.5].mean() - clear[np.abs(u[:, i]) >= 0.5].mean()) / 2 for i in columns]
    return int(np.argmax(np.maximum(gaps, middle)))


def _begin(parent: int, plan: bytes) -> None:
    begin_worker(parent)
    keep_plan(plan)


@dataclass(frozen=True)
class Wanted:
    """A cell to fit: one that was halved is its parent."""

    cell: Cell
    parent: int  #: row of the parent's record, -1 for a tile
    upper: bool
    attempts: int = 0


@dataclass(eq=False)
class Building:
    """A build in progress."""

    path: Path
    plan: Plan
    region: Region
    share: float
    monitor: Monitor
    waiting: list[Wanted] = field(default_factory=list)  #: the last one is next
    rows: int = 0
    charts: int = 0
    tiles: int = 0
    begun: set[int] = field(default_factory=set)  #: tiles that are not finished
    _results: list[tuple[int, bool, Result]] = field(default_factory=list)
    _open: dict[int, int] = field(default_factory=dict)  #: cells of a tile that wait or run
    _start: float = field(default_factory=time.monotonic)
    _flushed: float = field(default_factory=time.monotonic)

    def resume(self, stock: Stock) -> None:
        """Find the cells that the file does not have yet."""
        self.rows, self.charts = len(stock.records), len(stock.charts)
        index = Index(stock)
        fitted = sorted(set(index.orbits.fitted.tolist()))
        random.Random(_SEED).shuffle(fitted)
        fitted = fitted[: int(np.ceil(self.share * len(fitted)))]
        self.tiles = len(fitted)
        known, k = set(stock.records["tile"].tolist()), len(self.plan.joints)
        self._images = _images(index)
        self.waiting = [Wanted(Cell.whole(tile, k), -1, False) for tile in reversed(fitted) if tile not in known]
        self.waiting += list(_unfinished(stock, index, set(fitted), self._wanted_halves))
        for wanted in self.waiting:
            self._open[wanted.cell.tile] = self._open.get(wanted.cell.tile, 0) + 1
        self._before = self.tiles - len(self._open)

    def run(self, executor: Executor, in_flight: int, plan: bytes | None, until: float) -> None:
        """Run jobs until nothing is left to do, or until a time. What is done by then is in the file."""
        running: dict[Future[list[Result]], list[Wanted]] = {}
        try:
            while (self.waiting and time.monotonic() < until) or running:
                while self.waiting and len(running) < self._most(in_flight) and time.monotonic() < until:
                    batch = self._batch()
                    running[executor.submit(run_job, Job(plan, tuple(wanted.cell for wanted in batch)))] = batch
                done = wait(running, timeout=_FLUSH, return_when=FIRST_COMPLETED).done
                for future in done:
                    self._take(future, running.pop(future))
                if time.monotonic() > self._flushed + _FLUSH:
                    self.flush()
        finally:
            for future in running:
                future.cancel()
            self.flush()

    def flush(self) -> None:
        """Append what came since the last time to the file."""
        self._flushed = time.monotonic()
        if self._results:
            charts = sum(result.numbers is not None for _, _, result in self._results)
            add_results(self.path, self.plan, self._results, self.charts)
            self.charts += charts
            self._results = []
        self._report()

    def _most(self, in_flight: int) -> int:
        """Jobs in flight: one if workers died over the next cell, which could take others with it."""
        return 1 if self.waiting[-1].attempts else in_flight

    def _batch(self) -> list[Wanted]:
        """The next cells for one job."""
        batch = [self.waiting.pop()]
        while self.waiting and len(batch) < _BATCH and not batch[0].attempts and not self.waiting[-1].attempts:
            batch.append(self.waiting.pop())
        return batch

    def _take(self, future: "Future[list[Result]]", batch: list[Wanted]) -> None:
        """Keep the results of a job; cells of a worker that died run again, after all others."""
        error = future.exception()
        if error is None:
            for wanted, result in zip(batch, future.result(), strict=True):
                self._keep(wanted, result)
            return
        for wanted in batch:
            if wanted.attempts + 1 < ATTEMPTS:
                self.waiting.insert(0, replace(wanted, attempts=wanted.attempts + 1))
            elif worker_died(future):
                _log.warning("worker processes died %d times over a box, which is left for the next build", ATTEMPTS)
            else:
                raise error

    def _keep(self, wanted: Wanted, result: Result) -> None:
        row, tile = self.rows, wanted.cell.tile
        self._results.append((wanted.parent, wanted.upper, result))
        self.rows += 1
        halves = list(self._wanted_halves(row, result.cell, result.joint)) if result.outcome == Outcome.SPLIT else []
        self.waiting += halves
        self._open[tile] += len(halves) - 1
        if not self._open[tile]:
            del self._open[tile]

    def _wanted_halves(self, row: int, cell: Cell, joint: int) -> Iterator[Wanted]:
        """The halves of a cell that the region touches."""
        for upper, half in enumerate(cell.halves(joint)):
            if self._touched(half):
                yield Wanted(half, row, bool(upper))

    def _touched(self, cell: Cell) -> bool:
        """Whether the region touches one of the images of a cell."""
        lattice = self.plan.lattice
        low, width = cell_boundaries(lattice, np.array([cell.tile]), np.array([cell.levels]), np.array([cell.places]))
        own = lattice.centres(np.array([cell.tile]))[0]
        centres, signs = self._images[cell.tile]
        middle = centres + signs * (low[0] + width[0] / 2 - own)
        turns = lattice.turns(self.region.low, self.region.high)
        middle = (middle[:, None] + turns).reshape(-1, len(width[0]))
        return bool(self.region.touches(middle - width / 2, middle + width / 2).any())

    def _report(self) -> None:
        finished = self.tiles - len(self._open)
        seconds, gained = time.monotonic() - self._start, finished - self._before
        left = f", {_duration(seconds * (self.tiles - finished) / gained)} left" if gained > 0 else ""
        detail = f"{finished} of {self.tiles} tiles, {self.charts} charts fitted{left}"
        self.monitor(Progress("atlas", finished / max(self.tiles, 1), detail))


@contextmanager
def opened(path: Path, plan: Plan, region: Region, force: bool) -> Iterator[Stock]:
    """The file of a plan, a new one or one to go on with, for this process alone.

    Raises:
        AtlasFileError: if it cannot be written, is the file of another plan, or another process writes it.
    """
    header = header_of(plan, region)
    if not begins(path, ATLAS):
        create(path, header, ATLAS, force)
    elif force:
        with owned(path, ATLAS):
            create(path, header, ATLAS, force)
    stock = read_stock(path)
    if hashlib.sha256(text_of(header)).digest() != stock.contents.digest:
        raise AtlasFileError(
            f"cannot write {path}: it is an atlas of another problem, region or settings, "
            "expected the same ones, another name, or force (--force) to replace it"
        )
    with owned(path, ATLAS):
        stock = read_stock(path)  # another process may have gone on meanwhile
        set_rest_aside(path, stock.contents, ATLAS)
        yield stock


@contextmanager
def workers(executor: Executor | None, jobs: int | None, plan: Plan) -> Iterator[tuple[Executor, int, bytes | None]]:
    """What runs the jobs: the executor that is given, or processes of this machine; how many jobs; and their plan."""
    content = packed(plan)
    if executor is not None:
        yield executor, _IN_FLIGHT, content
        return
    size = THREADS if jobs is None else jobs
    own = Processes(size, _begin, os.getpid(), content)
    try:
        yield own, _AHEAD * size, None
    finally:
        own.shutdown()


def _images(index: Index) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """For every fitted tile, centres and signs of the tiles that are images of it."""
    found: dict[int, list[int]] = {}
    for row, tile in enumerate(index.orbits.fitted.tolist()):
        found.setdefault(tile, []).append(row)
    return {tile: (index.centres[rows], index.signs[rows]) for tile, rows in found.items()}


def _unfinished(stock: Stock, index: Index, tiles: set[int], halves: object) -> Iterator[Wanted]:
    """Halves of cells that have no record yet."""
    records = stock.records
    for row in np.flatnonzero((records["outcome"] == Outcome.SPLIT) & (index.children < 0).any(axis=1)).tolist():
        record = records[row]
        cell = Cell(int(record["tile"]), tuple(record["levels"].tolist()), tuple(record["places"].tolist()))
        if cell.tile in tiles:
            for wanted in halves(row, cell, int(record["joint"])):  # type: ignore[operator]
                if index.children[row, int(wanted.upper)] < 0:
                    yield wanted


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"
