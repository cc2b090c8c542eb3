"""`fit`: fits coordinates to a problem in stages, and fixes their zero, scale, order and signs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.bases.composed import CircleFamily, Mobile
from orthocas.bases.cyclic import anywhere, widen_over_cyclic_joints
from orthocas.bases.family import (
    CyclicParametrisation,
    JointSpace,
    Parametrisation,
    ReorderableFamily,
    warn_unless_savable,
)
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import WorstPoints
from orthocas.charts.quality import evaluate
from orthocas.errors import DomainError, Interrupted, InvalidValueError, OrthocasError
from orthocas.fitting.like import Likeness
from orthocas.fitting.stages import RULES, Begin, Continuation, FitSettings, FoldSearch, Precision, Solution, Stage
from orthocas.fitting.terms import DEFAULT_WEIGHTS, WeightNumbers, Weights
from orthocas.robots.robot import Robot
from orthocas.solvers.protocol import Solver, Status
from orthocas.tasks.clear_box import ClearBox
from orthocas.tasks.domains import Box, Domain
from orthocas.tasks.metric import Metric, MetricSpec
from orthocas.tasks.problem import Problem, ProblemCheck, check
from orthocas.tasks.samples import Samples, find_idle_joints, sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import use_threads
from orthocas.tools.checks import Array, require_count
from orthocas.tools.display import Shown, listed, percent
from orthocas.tools.interrupts import remembered
from orthocas.tools.progress import Monitor, silent

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def fit(
    problem: Problem | Robot,
    task: Task | Parametrisation | None = None,
    solver: Solver | None = None,
    *,
    parametrisation: Parametrisation | None = None,
    metric: Metric | MetricSpec = "euclidean",
    domain: Domain | None = None,
    weights: Weights | WeightNumbers = DEFAULT_WEIGHTS,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
    max_mutual_deg: float | None = None,
    align_to: Chart | None = None,
    threads: int | None = None,
    split_idle: bool = True,
    precision: Precision = "double",
    like: Likeness | None = None,
) -> Fit:
    """Find coordinates xi(q) of a family that are nearly orthogonal to the task.

    The parameters theta of the family minimise, over uniform samples q of the domain and its worst points::

        L = mean_q [ lambda1 / (2 m r) sum_ij c_ij^2 + lambda2 / (r (r - 1)) sum_j<k e_jk^2
                     + lambda3 / 2 max(0.9 - det D, 0)^2 + lambda4 / (2 r) sum_j log^2 |dxi_j| ]
            + lambda5 / 2 mean_worst max(0.32 - det D, 0)^2

    c_ij is the cosine between the gradients of task component i and coordinate j, e_jk that between two coordinates
    ([AS2023] eq. (24)); det D is the volume of the coordinates' gradients across the task, 0 at a fold. Angles are
    those in the metric for A = M and for tasks that turn the tool.

    Joints that do not affect the task become coordinates themselves. With `Polynomial(degree, cyclic="auto")`, the
    domain of the chart covers all positions of the cyclic joints (`orthocas.bases.cyclic_joints`). Families linear in
    their parameters start from a spectral solution of low degree, and the degree rises step by step. Between the
    degrees, a search for the worst points of the domain keeps the chart from folding. Ctrl-C raises `Interrupted`: its
    `result` is the fit with the best coordinates so far and status INTERRUPTED. So callers that need a finished fit,
    and loops around them, end as well.

    Args:
        problem: robot, task, metric and domain; or a robot, with `task`, `metric` and `domain` as in `Problem`.
        task: the robot's task. After a problem, the parametrisation stands here.
        solver: the minimiser. Default: GaussNewton for families linear in their parameters, QuasiNewton if they have
            more than 300 basis functions or 8 joints, and LBFGS for other families.
        parametrisation: the family of coordinates. Default: polynomials of degree 5; of degree 4 for eight joints, or
            with a bound on mutual angles; of degree 3 for more joints, and of degree 2 from twelve.
        metric: for a robot and a task, as in `Problem`; so is `domain`.
        domain: the domain. Default: as in `Problem`.
        weights: weights of the loss, as `Weights` or as two to five numbers (lambda1, lambda2, ...). The field `angles`
            of `Weights` chooses between the paper's cosines and angles in the metric.
        samples: number of samples. Default: grows with the number of parameters.
        seed: seed of the samples and of random starts.
        monitor: called with progress.
        max_mutual_deg: bound on the root mean square deviation of mutual angles from 90 degrees over the samples [deg],
            at least 1e-6. With a bound, Ipopt minimises the task term, and lambda2 is not used.
        align_to: a chart of the same robot that defines order and signs of the coordinates, for a refit. By default,
            coordinates that move the first joints come first, and each moves its main joint in the positive direction.
        threads: number of threads that share the work. Results of bases and networks (`MLP`) do not depend on it.
            Default: OMP_NUM_THREADS, or the number of cores.
        split_idle: whether joints that do not affect the task become coordinates themselves. The paper's network learns
            them; False is for comparisons with it.
        precision: 'double' or 'single'. 'single' computes the large products of loss and gradient in single precision:
            those of a network, and those with the gradients of a basis, which then take half of the memory. At the same
            parameters, losses and angles change by less than 1e-5 of their size. Parameters and charts are double.
        like: quantities that the first coordinates follow as far as they can be orthogonal to the task: a joint's name,
            "swivel", a function of an SX column q, several of these, or a task of lower priority. If that task lacks a
            reference orientation, the one at the centre of the domain is taken. Each coordinate has the units of its
            quantity, and the same value at the centre.

    Returns:
        The chart, the result of each stage, and the time taken [s].

    Raises:
        SingularTaskError, MetricError: if the problem does not pass its own check.
        MemoryNeedError: if the degree is too large for this machine.
        InvalidValueError, SolveError: if settings are invalid or contradict each other, or the loss is not finite.
        InfeasibleError: if max_mutual_deg cannot be met.
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
    # `fit(robot, task, ...)` builds the problem; in `fit(problem, parametrisation)` the family is the second argument
    if isinstance(problem, Robot):
        of_robot: Any = task
        problem = Problem(problem, of_robot, metric, domain)
    elif task is not None:
        if parametrisation is not None or isinstance(task, Task):
            raise InvalidValueError("task", repr(task)[:80], "no task or second family: the problem has a task")
        parametrisation = task
    settings = FitSettings.check(
        problem, parametrisation, solver, weights, samples, seed, max_mutual_deg, split_idle, precision, like
    )
    if like is not None and align_to is not None:
        raise InvalidValueError("like", "given with align_to", "one of them: both define order and signs")
    with use_threads(None if threads is None else require_count("threads", threads)):
        return _fit(problem, settings, monitor, align_to)


def fit_from(
    begin: Begin,
    problem: Problem,
    parametrisation: Parametrisation,
    weights: Weights,
    seed: int,
    monitor: Monitor,
) -> Fit:
    """Like `fit`, but starts from the parameters that `begin` gives, if it gives some."""
    settings = FitSettings.check(problem, parametrisation, None, weights, None, seed, None)
    return _fit(problem, settings, monitor, begin=begin)


def _fit(
    problem: Problem,
    settings: FitSettings,
    monitor: Monitor,
    align_to: Chart | None = None,
    begin: Begin | None = None,
) -> Fit:
    """Fit with settings that have been checked."""
    start = time.perf_counter()
    # Families with cyclic joints or a mobile base widen the domain. Fitted families do not depend on a floating base
    parametrisation = settings.parametrisation
    warn_unless_savable(parametrisation)
    if isinstance(parametrisation, CyclicParametrisation) and parametrisation.cyclic:
        problem = widen_over_cyclic_joints(problem, tuple(parametrisation.cyclic))
    if problem.robot.tree.floating and (parametrisation.closed_form is not None or not settings.split_idle):
        expected = "one to fit in the arms' joints, such as Polynomial(1), with split_idle: the base floats"
        raise InvalidValueError("parametrisation", parametrisation.label, expected)
    if isinstance(parametrisation, Mobile):
        problem = anywhere(problem, parametrisation.base)
    with remembered() as pressed:
        problem_check = check(problem, seed=settings.seed)
        samples = sample_problem(problem, RULES.first, (settings.seed, RULES.first_tag))
        # Closed forms need no minimisation; others run the stages of `orthocas.fitting.stages`
        if parametrisation.closed_form is not None:
            values, solution = parametrisation.closed_form(problem), Solution((), parametrisation, None)
            r, space = problem.r, JointSpace.of(problem)
            raw = Coordinates(parametrisation, space, (), values.theta, np.zeros(r), np.ones(r))
            origin = problem.domain.home if values.origin is None else values.origin
            coordinates = normalise(raw, origin, samples)
            coordinates = coordinates if values.scaled else replace(coordinates, scale=np.ones(r))
        else:
            singular = problem_check.singular_samples > 0
            solution, coordinates = _solve(problem, settings, monitor, samples, align_to, begin, singular)
        # The chart, and facts about it: idle joints, worst points, and a smaller domain if the fit suggests one
        joints = [i for i in coordinates.idle if i not in problem.robot.tree.floating]
        result = Fit(
            chart=Chart(problem, coordinates, _write_notes(solution, settings)),
            stages=solution.stages,
            problem_check=problem_check,
            idle_joints=tuple(problem.robot.joint_names[i] for i in joints),
            worst=solution.worst,
            seconds=time.perf_counter() - start,
            like={} if settings.like is None else settings.like.measure_distances(problem, coordinates, settings.seed),
            clear_part=offer_clear_part(problem, problem_check, solution.worst),
        )
        if result.status is Status.INTERRUPTED or pressed():
            raise Interrupted(result)
    return result


def _solve(
    problem: Problem,
    settings: FitSettings,
    monitor: Monitor,
    samples: Samples,
    align_to: Chart | None,
    begin: Begin | None,
    singular: bool,
) -> tuple[Solution, Coordinates]:
    """Run the stages, and choose scale, order and signs. Joints that do not affect the task become coordinates."""
    idle = tuple(find_idle_joints(problem, samples)[-problem.r :]) if settings.split_idle else ()
    space, r = JointSpace.of(problem), problem.r - len(idle)
    if r == 0:
        none = np.zeros(0)
        coordinates = Coordinates(settings.parametrisation, space, idle, none, none, none)
        return Solution((), settings.parametrisation, None), coordinates
    # The other coordinates depend on the joints that move the task. Quantities to follow add a term to the loss
    active = [i for i in range(problem.n) if i not in idle]
    like = None if settings.like is None else settings.like.build_term(problem, active)
    settings = settings if like is None else settings.add_term(like)
    folds = FoldSearch(problem, active, settings.fold_weight(problem), singular)
    solution = Continuation(problem, settings, active, monitor, folds, like, begin).run()
    # The loss does not determine where xi is zero, how long its gradient is, the order and the signs
    raw = Coordinates(solution.parametrisation, space, idle, solution.theta, np.zeros(r), np.ones(r))
    coordinates = normalise(raw, problem.domain.home, samples)
    if settings.like is not None:
        return solution, settings.like.name_units(coordinates, problem.domain.home)
    if align_to is not None:
        return solution, align(coordinates, align_to, samples)
    return solution, fix_gauge(coordinates, problem.domain.home)


def normalise(raw: Coordinates, origin: Array, samples: Samples) -> Coordinates:
    """Shift and scale fitted coordinates so that they vanish at the origin, and their mean gradient length is 1.

    Raises:
        OrthocasError: if the gradient of a coordinate vanishes on the domain.
    """
    r = len(raw.offset)
    # Coordinates that are angles keep their period of 2 pi: they are shifted, not scaled
    if isinstance(raw.family, CircleFamily):
        return replace(raw, theta=raw.family.turned(raw.theta, raw.once("xi", origin[None, :])[0, :r]))
    lengths = np.linalg.norm(raw.once("jacobian", samples.points)[:, :r], axis=2).mean(axis=0)
    if not lengths.min() > 0:
        raise OrthocasError(f"coordinate {int(np.argmin(lengths))} has a vanishing gradient on the domain")
    return replace(raw, offset=raw.once("xi", origin[None, :])[0, :r], scale=1 / lengths)


def fix_gauge(coordinates: Coordinates, centre: Array) -> Coordinates:
    """Reorder coordinates and choose their signs, independently of how a fit found them.

    Coordinates that move the first joints come first. They are sorted by the mean index of the joints that move,
    sum_k k g_k^2 / |g|^2, with the gradient g at the centre of the domain. The joint with the largest |g_k| moves in
    the positive direction. Coordinates that a mirror symmetry of the arm exchanges have the same mean index: of these,
    the one with the larger g_k comes first, for the first joint k at which they differ. Idle joints stay last.
    """
    # The mean index of the joints that a coordinate moves, and the sign of its largest entry
    g = coordinates.once("jacobian", centre[None, :])[0, : len(coordinates.offset)]
    size = (g**2).sum(axis=1)
    # A gradient vanishes if the coordinate folds at the centre: avoid the division by zero
    moved = (g**2 @ np.arange(g.shape[1])) / np.where(size > 0, size, 1.0)
    largest = np.take_along_axis(g, np.abs(g).argmax(axis=1)[:, None], axis=1)[:, 0]
    signs = np.where(largest < 0, -1.0, 1.0)
    keys = np.round(np.column_stack([moved, -signs[:, None] * g]), RULES.digits)
    return _reorder(coordinates, np.lexsort(keys.T[::-1]), signs)


def align(coordinates: Coordinates, chart: Chart, samples: Samples) -> Coordinates:
    """Reorder coordinates and choose their signs so that they are closest to those of a chart.

    Each is matched with the coordinate of the chart whose gradient is most parallel, on average over samples.

    Raises:
        InvalidValueError: if the chart has other joints, another number of coordinates, or other idle joints.
    """
    fitted = len(coordinates.offset)
    if chart.n != coordinates.space.n or chart.r != coordinates.r:
        raise InvalidValueError(
            "align_to",
            f"a chart with n = {chart.n}, r = {chart.r}",
            f"one with n = {coordinates.space.n}, r = {coordinates.r}",
        )
    ours, theirs = (
        J / np.linalg.norm(J, axis=2, keepdims=True)
        for J in (coordinates.jacobian(samples.points)[:, :fitted], chart.coordinates.jacobian(samples.points))
    )
    parallel = np.einsum("sin,sjn->ij", ours, theirs[:, :fitted]) / len(samples)
    # Pair the coordinates so that the sum of the mean |cosines| within pairs is largest
    theirs_in_order, order = scipy.optimize.linear_sum_assignment(-np.abs(parallel.T))
    signs = np.sign(parallel.T[theirs_in_order, order])
    back = np.empty(fitted)
    back[order] = signs
    return _reorder(coordinates, order, back)


def _reorder(coordinates: Coordinates, order: NDArray[np.int_], signs: Array) -> Coordinates:
    """Put coordinates in another order, each times a sign. Families that cannot be reordered keep their order.

    Args:
        coordinates: the coordinates.
        order: the old place of each new place.
        signs: signs of the coordinates in their old places.
    """
    family = coordinates.family
    if not isinstance(family, ReorderableFamily):
        return replace(coordinates, scale=coordinates.scale * signs)
    places = [int(k) for k in order]
    return replace(
        coordinates,
        theta=family.reordered(coordinates.theta, places),
        offset=coordinates.offset[places],
        scale=(coordinates.scale * signs)[places],
    )


def _write_notes(solution: Solution, settings: FitSettings) -> dict[str, str | float]:
    """Settings and results of the fit, which the chart keeps as notes."""
    weights, stages, worst = settings.weights, solution.stages, solution.worst
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
        **({} if settings.like is None else {"meaning": settings.like.label}),
    }


def offer_clear_part(problem: Problem, check: ProblemCheck, worst: WorstPoints | None) -> ClearPart | None:
    """Offer a bound after a fit if the domain touches near-singular positions, or if charts fail near them.

    The bound leaves out nine in ten of the points with a conditioning below 0.05 that the fit's search found.

    Returns:
        The offer; None if nothing is wrong, if charts fail elsewhere too, or if the centre itself would be left out.
    """
    # Worst points where the conditioning is too small for a chart to be of use
    domain = problem.domain
    failed = np.zeros((0, problem.n)) if worst is None else worst.below(RULES.failed)
    clear = domain.singular_bound
    if not (isinstance(domain, Box) and (domain.is_box or clear)) or not (len(failed) or check.singular_samples):
        return None
    # The least multiple of `bound_step` that leaves most of them out, unless it is too large
    try:
        measured = clear or ClearBox(domain, problem.task, RULES.any_bound)
        values = measured.singular_values(failed)
        target = float(np.quantile(values, RULES.failed_fraction)) if len(failed) else 0.0
        if not target <= RULES.largest_bound:
            return None
        bound = round(RULES.bound_step * (1 + target // RULES.bound_step), 2)
        return ClearPart(bound, ClearBox(domain, problem.task, bound, measured.scale, measured.rows).share)
    except DomainError:  # the centre is not clear
        return None


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
    seconds: float
    like: Mapping[str, float] = field(default_factory=dict)  #: root mean square angle to each quantity's gradient [deg]
    clear_part: ClearPart | None = None  #: a smaller domain to fit on, if this one touches near-singular positions

    def plot(self, samples: int = 20_000) -> Figure:
        """Histograms of angles and leaks on held-out samples, as a matplotlib figure: `evaluate(fit.chart).plot()`."""
        return evaluate(self.chart, samples, seed=1).plot()

    @property
    def cyclic_joints(self) -> tuple[str, ...]:
        """Names of cyclic joints: the chart holds at all their positions, as its coordinates are linear in them."""
        coordinates = self.chart.coordinates
        family = coordinates.parametrisation if isinstance(coordinates, Coordinates) else None
        return tuple(family.cyclic) if isinstance(family, CyclicParametrisation) else ()

    @property
    def status(self) -> Status:
        """How the last stage ended, or CONVERGED if there was nothing to minimise."""
        return self.stages[-1].result.status if self.stages else Status.CONVERGED

    def facts(self) -> dict[str, str]:
        """Status, time, stages and the chart."""
        angles = [f"{name} {angle:.3g} deg off" for name, angle in self.like.items()]
        stages = [f"{stage.label} {stage.result.value:.4g}" for stage in self.stages]
        return {
            "fit": f"{self.chart.coordinates.label}, {self.status.value} after {self.seconds:.3g} s",
            "problem": self.chart.problem.heading,
            "loss": listed(stages) or "nothing to minimise",
            "samples": str(self.chart.notes.get("samples", "")),
            "idle joints": listed(self.idle_joints) or "none",
            "least conditioning": "not searched" if self.worst is None else self.worst.explained,
            **({"like": listed(angles)} if angles else {}),
            **({"cyclic joints": listed(self.cyclic_joints)} if self.cyclic_joints else {}),
            "near singular": f"{percent(self.problem_check.singular_share, 3, fault=True)} of the domain",
            **({"offer": f"a {self.clear_part.explained}"} if self.clear_part else {}),
        }


@dataclass(frozen=True)
class ClearPart:
    """A bound on the relative singular value of the task that leaves out near-singular positions where charts fail."""

    least_singular_value: float
    share: float  #: of the box that is left

    @property
    def explained(self) -> str:
        """The offer in words."""
        return f"least singular value {self.least_singular_value:g} stays clear, on {percent(self.share)} of the box"
