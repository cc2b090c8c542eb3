"""Fit coordinates to a problem: split off idle joints, start spectrally, raise the degree, minimise."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocas.casadi_tools.interrupts import remembered
from orthocas.casadi_tools.threads import using_threads
from orthocas.chart import Chart
from orthocas.checks import as_path, require_count, require_kind
from orthocas.coordinates.fitted import Coordinates
from orthocas.errors import Interrupted
from orthocas.fitting.checkpoint import Checkpoint, Stage
from orthocas.fitting.clear_part import ClearPart, clear_part
from orthocas.fitting.continuation import Continuation
from orthocas.fitting.fold_search import FoldSearch
from orthocas.fitting.gauge import aligned, in_closed_form, in_gauge, normalised
from orthocas.fitting.idle_joints import idle_joints
from orthocas.fitting.loss import DEFAULT_WEIGHTS, WeightNumbers, Weights
from orthocas.fitting.settings import PRECISIONS, FitSettings, default_parametrisation
from orthocas.fitting.stages import StageRunner
from orthocas.minimising.solver import Solver, Status
from orthocas.minimising.watch import Monitor, silent
from orthocas.parametrisations import (
    CyclicParametrisation,
    JointSpace,
    Parametrisation,
    warn_unless_savable,
)
from orthocas.parametrisations.cyclic_joints import over_cyclic_joints
from orthocas.problem import Problem, ProblemCheck, check
from orthocas.samples import Samples, sample_problem
from orthocas.showing import Shown, listed
from orthocas.worst_points import WorstPoints

_FIRST_SAMPLES = 1000  # seed tag of the samples that scale coordinates; stages use other tags


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Shown):
    """A fitted chart, and how it was found.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> fit = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300)
        >>> [stage.label for stage in fit.stages], fit.idle_joints
        (['polynomial:2'], ())
    """

    chart: Chart
    stages: tuple[Stage, ...]
    problem_check: ProblemCheck
    idle_joints: tuple[str, ...]  #: names of joints that are exact coordinates themselves
    worst: WorstPoints | None  #: result of the last search for folds; None if there was none
    seconds: float  #: of this run; the seconds of stages include earlier runs of a checkpoint
    clear_part: ClearPart | None = None  #: a smaller domain to fit on, if this one touches near-singular positions

    @property
    def cyclic_joints(self) -> tuple[str, ...]:
        """Names of joints at all of whose positions the chart holds, because its coordinates are linear in them."""
        coordinates = self.chart.coordinates
        chosen = coordinates.parametrisation if isinstance(coordinates, Coordinates) else None
        return tuple(chosen.cyclic) if isinstance(chosen, CyclicParametrisation) else ()

    @property
    def status(self) -> Status:
        """How the last stage ended, or CONVERGED if there was nothing to minimise."""
        return self.stages[-1].result.status if self.stages else Status.CONVERGED

    def facts(self) -> dict[str, str]:
        """Status, time, stages and the chart."""
        stages = [f"{stage.label} {stage.result.value:.4g}" for stage in self.stages]
        return {
            "fit": f"{self.chart.coordinates.label}, {self.status.value} after {self.seconds:.3g} s",
            "problem": self.chart.problem.heading,
            "loss": listed(stages) or "nothing to minimise",
            "samples": str(self.chart.notes.get("samples", "")),
            "idle joints": listed(self.idle_joints) or "none",
            "least conditioning": "not searched" if self.worst is None else self.worst.told,
            **({"cyclic joints": listed(self.cyclic_joints)} if self.cyclic_joints else {}),
            "near singular": f"{self.problem_check.singular_share:.3%} of the domain",
            **({"offer": f"a {self.clear_part.told}"} if self.clear_part else {}),
        }


def fit(
    problem: Problem,
    parametrisation: Parametrisation | None = None,
    solver: Solver | None = None,
    *,
    weights: Weights | WeightNumbers = DEFAULT_WEIGHTS,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
    max_mutual_deg: float | None = None,
    checkpoint: str | Path | None = None,
    align_to: Chart | None = None,
    threads: int | None = None,
    split_idle: bool = True,
    precision: str = PRECISIONS[0],
) -> Fit:
    """Find coordinates xi(q) of a family that are nearly orthogonal to the task.

    The fit minimises the mean of [AS2023] eq. (24) over uniform samples of the domain, for A = M with angles in the
    metric. Joints that do not affect the task become coordinates themselves. With `Polynomial(degree, cyclic="auto")`,
    the domain of the chart covers all positions of the cyclic joints; see `orthocas.cyclic_joints`. Families linear in
    their parameters start from a spectral solution of low degree, and the degree rises step by step. Between the
    degrees, a search for the worst points of the domain keeps the chart from folding. Ctrl-C raises `Interrupted`: its
    `result` is the fit with the best coordinates so far and status INTERRUPTED. So callers that need a finished fit,
    and loops around them, end as well.

    Args:
        problem: robot, task, metric and domain.
        parametrisation: the family of coordinates. Default: polynomials of degree 5; of degree 4 for eight joints, or
            with a bound on mutual angles; of degree 3 for more joints.
        solver: the minimiser. Default: GaussNewton for families linear in their parameters, QuasiNewton if they have
            more than 300 basis functions or 8 joints, and LBFGS for other families.
        weights: weights of the loss, as `Weights` or as two to five numbers (lambda1, lambda2, ...). The field `angles`
            of `Weights` chooses between the paper's cosines and angles in the metric.
        samples: number of samples. Default: grows with the number of parameters.
        seed: seed of the samples and of random starts.
        monitor: called with progress.
        max_mutual_deg: bound on the root mean square deviation of mutual angles from 90 degrees over the samples [deg],
            at least 1e-6. With a bound, Ipopt minimises the task term, and lambda2 is not used.
        checkpoint: a file that keeps the state of a long fit. If it exists, the fit resumes from it.
        align_to: a chart of the same robot that defines order and signs of the coordinates, for a refit. By default,
            coordinates that move the first joints come first, and each moves its main joint in the positive direction.
        threads: threads that share the work; bases and networks (`MLP`) do not depend on their number. Default:
            OMP_NUM_THREADS, or the number of cores.
        split_idle: whether joints that do not affect the task become coordinates themselves. The paper's network learns
            them; False is for comparisons with it.
        precision: 'double', or 'single' for the large products of loss and gradient: those of a network, and those with
            the gradients of a basis, which then take half of the memory. Losses and angles change by less than 1e-5 of
            their size at the same parameters. Parameters and charts are double.

    Returns:
        The chart, the result of each stage, and the seconds.

    Raises:
        SingularTaskError, MetricError: if the problem does not pass its own check.
        MemoryNeedError: if the degree is too large for this machine.
        InvalidValueError, SolveError: if settings are invalid or contradict each other, or the loss is not finite.
        InfeasibleError: if max_mutual_deg cannot be met.
        CheckpointError: if the checkpoint is damaged, or belongs to another fit.
        Interrupted: after Ctrl-C, once there are coordinates; before that, KeyboardInterrupt.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> fit = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300)
        >>> fit.status.value
        'converged'
        >>> fit.chart.xi([0.6, 0.8, 0.8]).shape
        (1,)
    """
    start = time.perf_counter()
    require_kind("problem", problem, Problem)
    wanted = (
        default_parametrisation(problem, max_mutual_deg is not None) if parametrisation is None else parametrisation
    )
    settings = FitSettings.checked(
        problem, wanted, solver, weights, samples, seed, max_mutual_deg, split_idle, precision
    )
    warn_unless_savable(settings.parametrisation)
    if isinstance(settings.parametrisation, CyclicParametrisation):
        problem = over_cyclic_joints(problem, tuple(settings.parametrisation.cyclic))
    with remembered() as pressed, using_threads(None if threads is None else require_count("threads", threads)):
        result = _fitted(problem, settings, monitor, checkpoint, align_to, start)
        if result.status is Status.INTERRUPTED or pressed():
            raise Interrupted(result)
    return result


def _fitted(
    problem: Problem,
    settings: FitSettings,
    monitor: Monitor,
    checkpoint: str | Path | None,
    align_to: Chart | None,
    start: float,
) -> Fit:
    """Fit with settings that are checked; `start` is when the fit began."""
    found = check(problem, seed=settings.seed)
    first = sample_problem(problem, 200, (settings.seed, _FIRST_SAMPLES))
    if settings.parametrisation.closed_form is not None:
        idle: tuple[int, ...] = ()
        stages: tuple[Stage, ...] = ()
        worst = None
        coordinates = in_closed_form(problem, settings.parametrisation, first)
    else:
        idle = tuple(idle_joints(problem, first)[-problem.r :]) if settings.split_idle else ()
        file = Checkpoint(None if checkpoint is None else as_path("checkpoint", checkpoint), settings.identity(problem))
        stages, coordinates, worst = _minimised(problem, settings, idle, monitor, file, first)
        if stages:
            centre = problem.domain.centre
            coordinates = in_gauge(coordinates, centre) if align_to is None else aligned(coordinates, align_to, first)
    return Fit(
        chart=Chart(problem, coordinates, _notes(stages, settings, worst)),
        stages=stages,
        problem_check=found,
        idle_joints=tuple(problem.robot.joint_names[i] for i in idle),
        worst=worst,
        seconds=time.perf_counter() - start,
        clear_part=clear_part(problem, found, worst),
    )


def _minimised(
    problem: Problem,
    settings: FitSettings,
    idle: tuple[int, ...],
    monitor: Monitor,
    checkpoint: Checkpoint,
    samples: Samples,
) -> tuple[tuple[Stage, ...], Coordinates, WorstPoints | None]:
    """Run the stages of the fit. Returns them, the coordinates, and their worst points."""
    space, r = JointSpace.of(problem), problem.r - len(idle)
    if r == 0:
        return (), Coordinates(settings.parametrisation, space, idle, np.zeros(0), np.zeros(0), np.zeros(0)), None
    active = [i for i in range(problem.n) if i not in idle]
    folds = FoldSearch(problem, active, settings.fold_weight(problem))
    solved = Continuation(StageRunner(problem, settings, active, monitor, checkpoint, folds), r).run()
    raw = Coordinates(solved.parametrisation, space, idle, solved.theta, np.zeros(r), np.ones(r))
    return solved.stages, normalised(raw, problem.domain.centre, samples), solved.worst


def _notes(stages: Sequence[Stage], settings: FitSettings, worst: WorstPoints | None) -> dict[str, str | float]:
    """Notes of the chart: how it was made."""
    weights = settings.weights
    searched = {} if worst is None else {"least conditioning": worst.least}
    extra = {f"weight of {name}": weight for name, weight in weights.extra.items()}
    return {
        "solver": settings.solver.name if stages else "closed form",
        "seed": settings.seed,
        "samples": stages[-1].samples if stages else 0,
        "status": stages[-1].result.status.value if stages else Status.CONVERGED.value,
        **searched,
        "lambda1": weights.task,
        "lambda2": weights.mutual,
        "lambda3": weights.regularity,
        "lambda4": weights.length,
        "lambda5": weights.folds,
        **extra,
        "angles": weights.angles or "paper",
    }
