"""`fit`: fits coordinates to a problem, along stages, and fixes what the loss leaves free."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.bases.circle import CircleFamily
from orthocas.bases.cyclic import over_cyclic_joints
from orthocas.bases.family import (
    CyclicParametrisation,
    Family,
    GradedFamily,
    GradedParametrisation,
    JointSpace,
    Parametrisation,
    ReorderableFamily,
)
from orthocas.bases.mobile import Mobile, anywhere
from orthocas.bases.products import Polynomial, ProductFamily
from orthocas.bases.registry import warn_unless_savable
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import WorstPoints
from orthocas.errors import DomainError, Interrupted, InvalidValueError, OrthocasError
from orthocas.fitting.like import Likeness
from orthocas.fitting.settings import FitSettings, Precision, default_parametrisation
from orthocas.fitting.stages import FoldSearch, Plan, Stage, StageRunner
from orthocas.fitting.terms import DEFAULT_WEIGHTS, LEAST_CONDITIONING, WeightNumbers, Weights
from orthocas.solvers.protocol import Solver, Status
from orthocas.tasks.clear_box import ClearBox
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem, ProblemCheck, check
from orthocas.tasks.samples import Samples, idle_joints, sample_problem
from orthocas.tools.batch import using_threads
from orthocas.tools.checks import Array, require_count, require_kind
from orthocas.tools.display import Shown, listed, percent
from orthocas.tools.interrupts import remembered
from orthocas.tools.progress import Monitor, silent

_STEP = 0.05  # of the bounds that are offered
_FAILS = 0.05  # conditioning below which a chart is of no use; folds have less than 0
_MOST = 0.9  # share of such points that a bound should leave out
_LARGEST = 0.25  # bound; charts that fail at larger singular values have other reasons
_ANY = 1e-12  # bound of a ClearBox that only measures
_DIGITS = 6  # of gradients at the centre that count for the order: fits end with about as many
_SEARCHED = 3  # degree from which worst points are searched: those of lower degrees differ from the last ones
_ROUNDS = 4  # of the last degree
_LEAST_GAIN = 0.01  # of the conditioning in a round
_FIRST_SAMPLES = 1000  # seed tag of the samples that scale coordinates; stages use other tags
Begin = Callable[[ProductFamily], Array | None]  #: parameters to start from, (size,), if some are known


@dataclass(frozen=True)
class ClearPart:
    """A bound on the relative singular value of the task that leaves out near-singular positions where charts fail."""

    least_singular_value: float
    share: float  #: of the box that is left

    @property
    def explained(self) -> str:
        """The offer in words."""
        return f"least singular value {self.least_singular_value:g} stays clear, on {percent(self.share)} of the box"


def clear_part(problem: Problem, check: ProblemCheck, worst: WorstPoints | None) -> ClearPart | None:
    """What to offer after a fit: a bound if the domain touches near-singular positions, or if charts fail near them.

    The bound leaves out nine in ten of the points with a conditioning below 0.05 that the fit's search found.

    Returns:
        The offer; None if nothing is wrong, if charts fail elsewhere too, or if the centre itself would be left out.
    """
    domain = problem.domain
    failed = np.zeros((0, problem.n)) if worst is None else worst.below(_FAILS)
    clear = domain.singular_bound
    if not (isinstance(domain, Box) and (domain.is_box or clear)) or not (len(failed) or check.singular_samples):
        return None
    try:
        measured = clear or ClearBox(domain, problem.task, _ANY)
        values = measured.singular_values(failed)
        wanted = float(np.quantile(values, _MOST)) if len(failed) else 0.0
        if not wanted <= _LARGEST:
            return None
        bound = round(_STEP * (1 + wanted // _STEP), 2)
        return ClearPart(bound, ClearBox(domain, problem.task, bound, measured.scale, measured.rows).share)
    except DomainError:  # the centre is not clear
        return None


def in_closed_form(problem: Problem, parametrisation: Parametrisation, samples: Samples) -> Coordinates:
    """Coordinates in closed form, which need no fit; see `orthocas.bases.ClosedForm`."""
    assert parametrisation.closed_form is not None
    found = parametrisation.closed_form(problem)
    r = problem.r
    raw = Coordinates(parametrisation, JointSpace.of(problem), (), found.theta, np.zeros(r), np.ones(r))
    origin = problem.domain.centre if found.origin is None else found.origin
    scaled = normalised(raw, origin, samples)
    return scaled if found.scaled else replace(scaled, scale=np.ones(r))


def normalised(raw: Coordinates, origin: Array, samples: Samples) -> Coordinates:
    """Shift and scale fitted coordinates so that they vanish at the origin, and their mean gradient length is 1.

    Raises:
        OrthocasError: if the gradient of a coordinate vanishes on the domain.
    """
    r = len(raw.offset)
    if isinstance(raw.family, CircleFamily):  # an angle keeps its period
        return replace(raw, theta=raw.family.turned(raw.theta, raw.once("xi", origin[None, :])[0, :r]))
    lengths = np.linalg.norm(raw.once("jacobian", samples.points)[:, :r], axis=2).mean(axis=0)
    if not lengths.min() > 0:
        raise OrthocasError(f"coordinate {int(np.argmin(lengths))} has a vanishing gradient on the domain")
    return replace(raw, offset=raw.once("xi", origin[None, :])[0, :r], scale=1 / lengths)


def in_gauge(coordinates: Coordinates, centre: Array) -> Coordinates:
    """Reorder coordinates and choose their signs, independently of how a fit found them.

    Coordinates that move the first joints come first. They are sorted by the mean index of the joints that move,
    sum_k k g_k^2 / |g|^2, with the gradient g at the centre of the domain. The joint with the largest |g_k| moves in
    the positive direction. Coordinates that change places in the arm's mirror have the same mean; the one that moves
    the first joint on which they differ further comes first. Idle joints stay last.
    """
    g = coordinates.once("jacobian", centre[None, :])[0, : len(coordinates.offset)]
    size = (g**2).sum(axis=1)
    moved = (g**2 @ np.arange(g.shape[1])) / np.where(size > 0, size, 1.0)  # g = 0: a fold at the centre
    largest = np.take_along_axis(g, np.abs(g).argmax(axis=1)[:, None], axis=1)[:, 0]
    signs = np.where(largest < 0, -1.0, 1.0)
    keys = np.round(np.column_stack([moved, -signs[:, None] * g]), _DIGITS)
    return _rearranged(coordinates, np.lexsort(keys.T[::-1]), signs)


def aligned(coordinates: Coordinates, chart: Chart, samples: Samples) -> Coordinates:
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
    theirs_in_order, order = scipy.optimize.linear_sum_assignment(-np.abs(parallel.T))
    signs = np.sign(parallel.T[theirs_in_order, order])
    back = np.empty(fitted)
    back[order] = signs
    return _rearranged(coordinates, order, back)


def _rearranged(coordinates: Coordinates, order: NDArray[np.int_], signs: Array) -> Coordinates:
    """Coordinates in another order, each times a sign. Families that cannot be reordered keep their order.

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


@dataclass(frozen=True, eq=False)
class Solved:
    """Finished minimisations, the parametrisation that they reached, and its worst points if a search was made."""

    stages: tuple[Stage, ...]
    parametrisation: Parametrisation
    worst: WorstPoints | None

    @property
    def theta(self) -> Array:
        """Parameters found by the last minimisation."""
        return self.stages[-1].result.theta


class Continuation:
    """Solves a low degree from a spectral start, embeds the result, and solves the next degree.

    The worst points of each degree join the loss of the next one. The last degree is solved again until its least
    conditioning is large enough or, without a fold, no longer grows. If folds remain after some rounds, the domain
    forces them: then the last stage leaves the fold term out.

    Args:
        runner: runs single stages.
        r: number of coordinates of the active joints.
        begin: gives parameters of polynomials to start from, instead of a spectral start. Without a mirror only, since
            coordinates of another fit need not be even and odd.
    """

    def __init__(self, runner: StageRunner, r: int, begin: Begin | None = None) -> None:
        self._runner, self._r, self._begin = runner, r, begin
        self._stages: list[Stage] = []
        self._reached: tuple[Parametrisation, Family] | None = None

    def run(self) -> Solved:
        """Run all stages. After Ctrl-C, the last one is marked as interrupted."""
        steps = self._steps(self._runner.settings.parametrisation)
        try:
            for step in steps:
                self._solve(step, step.label, final=step is steps[-1])
            self._unfold(steps[-1])
        except KeyboardInterrupt:  # also between minimisations
            if self._reached is None:
                raise
            self._stages[-1] = self._stages[-1].interrupted()
        assert self._reached is not None
        return Solved(tuple(self._stages), self._reached[0], self._runner.folds.found)

    def _steps(self, target: Parametrisation) -> Sequence[Parametrisation]:
        if not isinstance(target, GradedParametrisation):
            return [target]
        self._runner.require_memory(target, self._r)
        return [target.of_degree(degree) for degree in range(min(target.degree, 2), target.degree + 1)]

    def _solve(self, step: Parametrisation, label: str, final: bool) -> None:
        """Run a stage, and search the worst points of its result."""
        runner, degree = self._runner, step.degree if isinstance(step, GradedParametrisation) else 0
        family = runner.family(step, self._r)
        solver = runner.settings.solver if final else runner.settings.solver.coarser()
        stage = runner.run(Plan(label, family, self._start(family), solver, degree, final))
        self._stages.append(stage)
        self._reached = step, family
        if stage.result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if final or degree >= _SEARCHED:
            runner.folds.search(stage, step, len(self._stages), runner.monitor)

    def _start(self, family: Family) -> Array | None:
        """The last result, embedded; at first that of `begin`."""
        if self._reached is None:
            polynomials = isinstance(self._runner.settings.parametrisation, Polynomial)
            if self._begin is None or not polynomials or self._runner.mirror is not None:
                return None
            assert isinstance(family, ProductFamily)
            return self._begin(family)
        theta, before = self._stages[-1].result.theta, self._reached[1]
        if theta.size == family.size:
            return theta
        assert isinstance(family, GradedFamily)
        assert isinstance(before, GradedFamily)
        return family.embed(theta, before)

    def _unfold(self, step: Parametrisation) -> None:
        """Solve the last step again until there is no point of small conditioning."""
        folds, before = self._runner.folds, 0.0
        for k in range(2, 2 + _ROUNDS):
            if folds.least >= LEAST_CONDITIONING or 0 <= folds.least < before + _LEAST_GAIN:
                break
            before = folds.least
            self._solve(step, f"{step.label}, round {k}", final=True)
        if folds.least < 0:
            folds.give_up()
            self._solve(step, f"{step.label}, with folds", final=True)


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
        meant = [f"{name} {angle:.3g} deg off" for name, angle in self.like.items()]
        stages = [f"{stage.label} {stage.result.value:.4g}" for stage in self.stages]
        return {
            "fit": f"{self.chart.coordinates.label}, {self.status.value} after {self.seconds:.3g} s",
            "problem": self.chart.problem.heading,
            "loss": listed(stages) or "nothing to minimise",
            "samples": str(self.chart.notes.get("samples", "")),
            "idle joints": listed(self.idle_joints) or "none",
            "least conditioning": "not searched" if self.worst is None else self.worst.explained,
            **({"like": listed(meant)} if meant else {}),
            **({"cyclic joints": listed(self.cyclic_joints)} if self.cyclic_joints else {}),
            "near singular": f"{percent(self.problem_check.singular_share, 3, fault=True)} of the domain",
            **({"offer": f"a {self.clear_part.explained}"} if self.clear_part else {}),
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
    align_to: Chart | None = None,
    threads: int | None = None,
    split_idle: bool = True,
    precision: Precision = "double",
    like: Likeness | None = None,
) -> Fit:
    """Find coordinates xi(q) of a family that are nearly orthogonal to the task.

    The fit minimises the mean of [AS2023] eq. (24) over uniform samples of the domain, with angles in the metric for A
    = M and for tasks that turn the tool. Joints that do not affect the task become coordinates themselves. With
    `Polynomial(degree, cyclic="auto")`, the domain of the chart covers all positions of the cyclic joints; see
    `orthocas.cyclic_joints`. Families linear in their parameters start from a spectral solution of low degree, and the
    degree rises step by step. Between the degrees, a search for the worst points of the domain keeps the chart from
    folding. Ctrl-C raises `Interrupted`: its `result` is the fit with the best coordinates so far and status
    INTERRUPTED. So callers that need a finished fit, and loops around them, end as well.

    Args:
        problem: robot, task, metric and domain.
        parametrisation: the family of coordinates. Default: polynomials of degree 5; of degree 4 for eight joints, or
            with a bound on mutual angles; of degree 3 for more joints, and of degree 2 from twelve.
        solver: the minimiser. Default: GaussNewton for families linear in their parameters, QuasiNewton if they have
            more than 300 basis functions or 8 joints, and LBFGS for other families.
        weights: weights of the loss, as `Weights` or as two to five numbers (lambda1, lambda2, ...). The field `angles`
            of `Weights` chooses between the paper's cosines and angles in the metric.
        samples: number of samples. Default: grows with the number of parameters.
        seed: seed of the samples and of random starts.
        monitor: called with progress.
        max_mutual_deg: bound on the root mean square deviation of mutual angles from 90 degrees over the samples [deg],
            at least 1e-6. With a bound, Ipopt minimises the task term, and lambda2 is not used.
        align_to: a chart of the same robot that defines order and signs of the coordinates, for a refit. By default,
            coordinates that move the first joints come first, and each moves its main joint in the positive direction.
        threads: threads that share the work; bases and networks (`MLP`) do not depend on their number. Default:
            OMP_NUM_THREADS, or the number of cores.
        split_idle: whether joints that do not affect the task become coordinates themselves. The paper's network learns
            them; False is for comparisons with it.
        precision: 'double', or 'single' for the large products of loss and gradient: those of a network, and those with
            the gradients of a basis, which then take half of the memory. Losses and angles change by less than 1e-5 of
            their size at the same parameters. Parameters and charts are double.
        like: quantities that the first coordinates follow as far as they can be orthogonal to the task: a joint's name,
            "swivel", a function of an SX column q, several of these, or a task of lower priority, whose missing
            reference orientation is taken at the centre of the domain. Each has the units of its quantity, and its
            value there.

    Returns:
        The chart, the result of each stage, and the seconds.

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
    start = time.perf_counter()
    require_kind("problem", problem, Problem)
    wanted = (
        default_parametrisation(problem, max_mutual_deg is not None) if parametrisation is None else parametrisation
    )
    settings = FitSettings.checked(
        problem, wanted, solver, weights, samples, seed, max_mutual_deg, split_idle, precision, like
    )
    if like is not None and align_to is not None:
        raise InvalidValueError("like", "given with align_to", "one of them: both define order and signs")
    with using_threads(None if threads is None else require_count("threads", threads)):
        return _finished(problem, settings, monitor, align_to, start)


def fit_from(
    begin: Begin,
    problem: Problem,
    parametrisation: Parametrisation,
    weights: Weights,
    seed: int,
    monitor: Monitor,
) -> Fit:
    """The fit of `fit`, from known coordinates if there are some."""
    start = time.perf_counter()
    settings = FitSettings.checked(problem, parametrisation, None, weights, None, seed, None)
    return _finished(problem, settings, monitor, None, start, begin)


def _finished(
    problem: Problem,
    settings: FitSettings,
    monitor: Monitor,
    align_to: Chart | None,
    start: float,
    begin: Begin | None = None,
) -> Fit:
    """The fit on the domain that its parametrisation asks for, or Interrupted."""
    warn_unless_savable(settings.parametrisation)
    if isinstance(settings.parametrisation, CyclicParametrisation):
        problem = over_cyclic_joints(problem, tuple(settings.parametrisation.cyclic))
    if problem.robot.tree.floating and (settings.parametrisation.closed_form is not None or not settings.split_idle):
        wanted_there = "one to fit in the arms' joints, such as Polynomial(1), with split_idle: the base floats"
        raise InvalidValueError("parametrisation", settings.parametrisation.label, wanted_there)
    if isinstance(settings.parametrisation, Mobile):
        problem = anywhere(problem, settings.parametrisation.base)
    with remembered() as pressed:
        result = _fitted(problem, settings, monitor, align_to, start, begin)
        if result.status is Status.INTERRUPTED or pressed():
            raise Interrupted(result)
    return result


def _fitted(
    problem: Problem,
    settings: FitSettings,
    monitor: Monitor,
    align_to: Chart | None,
    start: float,
    begin: Begin | None,
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
        stages, coordinates, worst = _minimised(problem, settings, idle, monitor, first, begin)
        if stages:
            coordinates = _arranged(coordinates, problem, settings, align_to, first)
    return Fit(
        chart=Chart(problem, coordinates, _notes(stages, settings, worst)),
        stages=stages,
        problem_check=found,
        idle_joints=tuple(problem.robot.joint_names[i] for i in idle if i not in problem.robot.tree.floating),
        worst=worst,
        seconds=time.perf_counter() - start,
        like={} if settings.like is None else settings.like.distances(problem, coordinates, settings.seed),
        clear_part=clear_part(problem, found, worst),
    )


def _minimised(
    problem: Problem,
    settings: FitSettings,
    idle: tuple[int, ...],
    monitor: Monitor,
    samples: Samples,
    begin: Begin | None,
) -> tuple[tuple[Stage, ...], Coordinates, WorstPoints | None]:
    """Run the stages of the fit. Returns them, the coordinates, and their worst points."""
    space, r = JointSpace.of(problem), problem.r - len(idle)
    if r == 0:
        return (), Coordinates(settings.parametrisation, space, idle, np.zeros(0), np.zeros(0), np.zeros(0)), None
    active = [i for i in range(problem.n) if i not in idle]
    like = None if settings.like is None else settings.like.term(problem, active)
    settings = settings if like is None else settings.with_term(like)
    folds = FoldSearch(problem, active, settings.fold_weight(problem))
    runner = StageRunner(problem, settings, active, monitor, folds, like)
    solved = Continuation(runner, r, begin).run()
    raw = Coordinates(solved.parametrisation, space, idle, solved.theta, np.zeros(r), np.ones(r))
    return solved.stages, normalised(raw, problem.domain.centre, samples), solved.worst


def _arranged(
    coordinates: Coordinates, problem: Problem, settings: FitSettings, align_to: Chart | None, samples: Samples
) -> Coordinates:
    """Coordinates in their order, with their signs: by what they follow, by another chart, or by the joints."""
    if settings.like is not None:
        return settings.like.named(coordinates, problem)
    return in_gauge(coordinates, problem.domain.centre) if align_to is None else aligned(coordinates, align_to, samples)


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
        **({} if settings.like is None else {"meaning": settings.like.label}),
    }
