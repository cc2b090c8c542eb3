"""The work of an atlas in pieces for any executor: some cells, each fitted, judged and perhaps split (ours)."""

import pickle
import time
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from orthocas.atlases.box_fit import BoxChart, BoxFitter, Mask
from orthocas.atlases.cells import Cell
from orthocas.atlases.chart_of_box import box_of, chart_of
from orthocas.atlases.outcomes import Outcome, Result
from orthocas.atlases.plan import Plan
from orthocas.certifying.certify import folds_nowhere
from orthocas.checks import Array
from orthocas.domains import Box
from orthocas.errors import CertifyError, OrthocasError

_LEAST_CLEAR = 0.3  # share of the samples of a box that have to be clear of singular positions for a chart


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
