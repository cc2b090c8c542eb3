"""The stages of a fit, from low degrees to high ones. Each minimises an objective on samples, from a start."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from orthocas.bases.family import (
    ArrayFamily,
    Family,
    GradedFamily,
    GradedParametrisation,
    JointSpace,
    LinearFamily,
    Parametrisation,
)
from orthocas.bases.products import Fourier, Polynomial, ProductFamily
from orthocas.charts.angles import pairs
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import WorstPoints, worst_points
from orthocas.errors import InfeasibleError, InvalidValueError, SolveError
from orthocas.fitting.basis_gradients import BasisGradients, gradients_of
from orthocas.fitting.basis_objective import STRIDE, BasisObjective, BoundedMutual, expanded
from orthocas.fitting.dense_objectives import ArrayObjective, GraphObjective
from orthocas.fitting.like import LikeTerm
from orthocas.fitting.settings import FitSettings
from orthocas.fitting.starts import Mirror, find_mirror, spectral_start
from orthocas.fitting.terms import DEFAULT_WEIGHTS, FOLD_TERM, LEAST_CONDITIONING
from orthocas.solvers.gauss_newton import GaussNewton
from orthocas.solvers.protocol import (
    EstimatedObjective,
    LeastSquaresObjective,
    Objective,
    SampledObjective,
    SmoothObjective,
    Solver,
    SolveResult,
    Status,
)
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, evaluate_samples, sample_evenly, sample_problem
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_memory
from orthocas.tools.interrupts import deferred
from orthocas.tools.progress import Monitor, Progress, Watch

MLP_SAMPLES = 2000  #: default sample count of families that are not linear in theta
_START_SEED = 0  # seed of the samples of spectral starts, the same for all fits
_TRIAL_DEGREE = 3  # of the trial that chooses among symmetric coordinates
_FRESH = 2000  # seed tag of samples drawn while a solver runs; stages use other tags
_SEARCHED = 3  # degree from which worst points are searched: those of lower degrees differ from the last ones
_ROUNDS = 4  # of the last degree
_LEAST_GAIN = 0.01  # of the conditioning in a round
_COLLECTED = 1.5 * LEAST_CONDITIONING  # points below it are collected, before they become worse
Begin = Callable[[ProductFamily], Array | None]  #: parameters to start from, (size,), if some are known


@dataclass(frozen=True, eq=False)
class Stage:
    """One minimisation of a fit."""

    label: str  #: parametrisation, for example 'polynomial:3'
    parameters: int
    samples: int
    result: SolveResult

    def interrupted(self) -> "Stage":
        """The same stage, marked as interrupted by Ctrl-C."""
        return replace(self, result=replace(self.result, status=Status.INTERRUPTED))


@dataclass(frozen=True, eq=False)
class Solution:
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

    def __init__(self, runner: "StageRunner", r: int, begin: Begin | None = None) -> None:
        self._runner, self._r, self._begin = runner, r, begin
        self._stages: list[Stage] = []
        self._reached: tuple[Parametrisation, Family] | None = None

    def run(self) -> Solution:
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
        return Solution(tuple(self._stages), self._reached[0], self._runner.folds.found)

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


class FoldSearch:
    """The worst points that were found so far.

    Args:
        problem: problem of the fit.
        active: joints that are not coordinates themselves.
        weight: weight of the fold term; with 0 nothing is searched.
    """

    def __init__(self, problem: Problem, active: list[int], weight: float) -> None:
        self._problem, self._active, self._weight = problem, active, weight
        self._points = np.zeros((0, problem.n))
        self.found: WorstPoints | None = None  #: of the last search

    @property
    def least(self) -> float:
        """Least conditioning of the last search; 1, the largest there is, without a search."""
        return 1.0 if self.found is None else self.found.least

    def give_up(self) -> None:
        """Forget all points."""
        self._points = self._points[:0]

    def search(self, stage: Stage, parametrisation: Parametrisation, seed: int, monitor: Monitor) -> None:
        """Find and collect the worst points of a stage."""
        if not self._weight:
            return
        monitor(Progress(stage.label, 1.0, "searching for folds"))
        problem = self._problem
        idle = tuple(i for i in range(problem.n) if i not in self._active)
        fitted = problem.r - len(idle)
        space = JointSpace.of(problem)
        coordinates = Coordinates(parametrisation, space, idle, stage.result.theta, np.zeros(fitted), np.ones(fitted))
        self.found = worst_points(problem, coordinates, seed)
        self._points = np.concatenate([self._points, self.found.below(_COLLECTED)])

    def added_to(self, objective: BasisObjective | ArrayObjective | GraphObjective) -> Objective:
        """The objective plus the fold term at all points collected."""
        if not len(self._points):
            return objective
        samples = evaluate_samples(self._problem, self._points).restricted_to(self._active)
        penalty = objective.elsewhere(samples, {FOLD_TERM.name: self._weight})
        return _LinearSum(objective, penalty) if isinstance(objective, BasisObjective) else _Sum(objective, penalty)


class _Sum:
    """A loss on samples of the domain plus a penalty on fixed points."""

    def __init__(self, loss: Objective, penalty: Objective) -> None:
        self._loss, self._penalty = loss, penalty

    def value(self, theta: Array) -> float:
        """Loss plus the penalty of points that fold, at theta (p,)."""
        return self._loss.value(theta) + self._penalty.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """Loss and penalty, and their gradient."""
        (value, gradient), (more, slope) = (part.value_and_gradient(theta) for part in (self._loss, self._penalty))
        return value + more, gradient + slope

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator["_Sum"]:
        """The loss on fresh samples, each time with the same penalty."""
        assert isinstance(self._loss, SampledObjective)
        for loss in self._loss.batches(size, count, seed):
            yield type(self)(loss, self._penalty)


class _LinearSum(_Sum):
    """The same for families linear in theta, with second derivatives."""

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """Loss and penalty, their gradient and their Gauss-Newton matrix."""
        assert isinstance(self._loss, LeastSquaresObjective)
        assert isinstance(self._penalty, LeastSquaresObjective)
        value, gradient, H = self._loss.normal_equations(theta)
        more, slope, curvature = self._penalty.normal_equations(theta)
        return value + more, gradient + slope, H + curvature

    def curvature_estimate(self, theta: Array) -> Array:
        """A rough Gauss-Newton matrix of loss and penalty."""
        assert isinstance(self._loss, EstimatedObjective)
        assert isinstance(self._penalty, EstimatedObjective)
        return self._loss.curvature_estimate(theta) + self._penalty.curvature_estimate(theta)

    def hessian(self, theta: Array) -> Array:
        """Hessian of loss and penalty."""
        assert isinstance(self._loss, SmoothObjective)
        assert isinstance(self._penalty, SmoothObjective)
        return self._loss.hessian(theta) + self._penalty.hessian(theta)


@dataclass(frozen=True, eq=False)
class Plan:
    """What one stage does."""

    label: str  #: name of the stage, unique within a fit
    family: Family
    start: Array | None  #: parameters of the family, (size,); None: a start has to be found
    solver: Solver
    tag: int  #: seed tag of the samples
    final: bool  #: whether a bound on mutual angles has to be met


@dataclass(frozen=True, eq=False)
class StageRunner:
    """Runs single stages of one fit, and holds what they share."""

    problem: Problem
    settings: FitSettings
    active: list[int]  #: joints that are not coordinates themselves
    monitor: Monitor
    folds: FoldSearch
    like: LikeTerm | None = None  #: what the first coordinates follow

    @property
    def space(self) -> JointSpace:
        """The active joints."""
        return JointSpace.of(self.problem).restricted_to(self.active)

    @cached_property
    def mirror(self) -> Mirror | None:
        """The symmetry that halves the coefficients; a bound on mutual angles, or a meaning, is met without one.

        Of the coordinates that it allows, those with the least loss at degree 3 are chosen.
        """
        free = self.settings.max_mutual is None and self.like is None
        found = find_mirror(self.problem, self.active) if free else None
        target = self.settings.parametrisation
        if found is None or not isinstance(target, GradedParametrisation):
            return found
        family = self.family(target.of_degree(min(target.degree, _TRIAL_DEGREE)), len(found.parities))
        assert isinstance(family, LinearFamily)
        return min(found.choices(), key=lambda mirror: self._trial(family, mirror))

    def family(self, parametrisation: Parametrisation, r: int) -> Family:
        """The family on the active joints: the same object every time, so that what it needs is built once."""
        key = parametrisation.label, r
        if key not in self._families:
            self._families[key] = parametrisation.family(self.space, r)
        return self._families[key]

    @cached_property
    def _families(self) -> dict[tuple[str, int], Family]:
        return {}

    @cached_property
    def _bases(self) -> dict[LinearFamily, BasisGradients]:
        """Gradients of the bases so far."""
        return {}

    @cached_property
    def _starts(self) -> dict[tuple[LinearFamily, int, bool], Array]:
        """Spectral starts so far, by family, number of samples, and whether a mirror is used."""
        return {}

    def run(self, plan: Plan) -> Stage:
        """Draw samples, find a start if none is given, and minimise.

        Raises:
            SolveError: if there is no usable point. Only the final stage has to satisfy a bound on mutual angles.
        """
        family = plan.family
        kept = self.mirror.kept(family) if isinstance(family, LinearFamily) and self.mirror is not None else None
        # other networks are few large products: they need the threads of BLAS more than the last digits
        with one_blas_thread() if isinstance(family, LinearFamily | ArrayFamily) else nullcontext():
            return self._minimise(plan, kept)

    def _minimise(self, plan: Plan, kept: NDArray[np.bool_] | None) -> Stage:
        count = self._sample_count(plan.family, kept)
        self.monitor(Progress(plan.label, 0.0, f"sampling {count} points"))
        samples = self._samples(count, 1 + plan.tag)
        with deferred():  # CasADi may swallow Ctrl-C while graphs are built
            objective, theta = self._objective(plan, samples, kept)
        result = plan.solver.minimise(objective, theta, Watch(self.monitor, plan.label))
        if isinstance(objective, BoundedMutual) and not np.isfinite(result.value):
            if plan.final:
                assert self.settings.max_mutual is not None
                raise missed_bound(plan.label, self.settings.max_mutual, objective, result)
        else:
            result.raise_if_failed()
        if kept is not None and self.mirror is not None:
            result = replace(result, theta=self.mirror.coordinates(expanded(result.theta, kept)))
        return Stage(plan.label, plan.family.size, len(samples), result)

    def _objective(self, plan: Plan, samples: Samples, kept: NDArray[np.bool_] | None) -> tuple[Objective, Array]:
        """The loss of a family on samples, and the start in the parameters that it leaves free."""
        family, theta = plan.family, plan.start
        if not isinstance(family, LinearFamily):
            if self.settings.max_mutual is not None:
                raise InvalidValueError(
                    "max_mutual_deg",
                    f"given with {plan.label}",
                    "a parametrisation linear in its parameters, such as polynomial",
                )
            self._require_graph_memory(plan.label, family, len(samples))
            theta = family.initial(self.settings.seed) if theta is None else theta
            return self.folds.added_to(self._network_objective(family, samples, theta)), theta
        objective, start = self._linear_objective(family, samples, theta, None if kept is None else self.mirror)
        if self.settings.max_mutual is None:
            return self.folds.added_to(objective), start
        return self._bounded(objective, start, fresh=theta is None)

    def _network_objective(self, family: Family, samples: Samples, theta: Array) -> ArrayObjective | GraphObjective:
        """The loss of a family that is not linear in its parameters."""
        weights, single = self.settings.weights, self.settings.single
        if isinstance(family, ArrayFamily):
            return ArrayObjective(family, samples, weights, theta, self._draw, single)
        if single:
            label = self.settings.parametrisation.label
            raise InvalidValueError("precision", f"'single' with {label}", "double, or a basis or a network (mlp)")
        return GraphObjective(family, samples, weights, theta, self._draw)

    def _linear_objective(
        self, family: LinearFamily, samples: Samples, theta: Array | None, mirror: Mirror | None
    ) -> tuple[BasisObjective, Array]:
        """The loss of a family that is linear in its parameters, and the start in those that a mirror leaves free."""
        kept = None if mirror is None else mirror.kept(family)
        if theta is None:
            theta = self._spectral_start(family, len(samples), kept)
        elif mirror is not None:
            theta = mirror.components(theta)
        theta = theta if kept is None else theta.reshape(kept.shape)[kept]
        exchanged = () if mirror is None else mirror.exchanged
        objective = BasisObjective(
            family, samples, self.settings.weights, theta, self._draw, kept, exchanged, self._gradients(family)
        )
        return objective, theta

    def _gradients(self, family: LinearFamily) -> BasisGradients:
        """Those of a basis, built once."""
        if family not in self._bases:
            number = np.float32 if self.settings.single else np.float64
            self._bases[family] = gradients_of(family, self.space.n, number)
        return self._bases[family]

    def _trial(self, family: LinearFamily, mirror: Mirror) -> float:
        """The loss that a family reaches with these symmetric coordinates."""
        samples = self._samples(self._sample_count(family, mirror.kept(family)), 0)
        with one_blas_thread():
            with deferred():
                objective, start = self._linear_objective(family, samples, None, mirror)
            result = GaussNewton().coarser().minimise(objective, start)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return result.value

    def _bounded(self, objective: BasisObjective, theta: Array, fresh: bool) -> tuple[Objective, Array]:
        """The problem with a bound on the mutual angles, and its start."""
        assert self.settings.max_mutual is not None
        fitted, all_pairs = len(pairs(objective.r)), len(pairs(self.problem.r))
        if not fitted:
            raise InvalidValueError("max_mutual_deg", "given", "a problem with two or more coordinates to fit")
        # pairs with an idle joint are exactly orthogonal, so the other pairs may use their share
        bounded = BoundedMutual(objective, self.settings.max_mutual * (all_pairs / fitted) ** 0.5)
        if fresh:  # solve the weighted problem first: minima far from its own are worse
            weighted = replace(self.settings.weights, mutual=DEFAULT_WEIGHTS.mutual)
            theta = GaussNewton().minimise(objective.reweighted(weighted), theta).finished().theta
        return bounded, bounded.in_gauge(theta)

    def _spectral_start(self, family: LinearFamily, count: int, kept: NDArray[np.bool_] | None) -> Array:
        """A start that does not depend on the seed: eigenvalues are close, so other samples would mix coordinates."""
        key = family, count, kept is not None
        if key not in self._starts:
            points = sample_evenly(self.problem.domain, count, _START_SEED)
            samples = evaluate_samples(self.problem, points).restricted_to(self.active)
            start = spectral_start(family, samples, kept, self._gradients(family))
            if self.like is not None:
                start = self.like.turned(family, start, samples, self._gradients(family))
            self._starts[key] = start
        return self._starts[key]

    def _samples(self, count: int, tag: int) -> Samples:
        points = sample_evenly(self.problem.domain, count, (self.settings.seed, tag))
        return evaluate_samples(self.problem, points).restricted_to(self.active)

    def _draw(self, count: int, seed: tuple[int, ...]) -> Samples:
        return sample_problem(self.problem, count, (self.settings.seed, _FRESH, *seed)).restricted_to(self.active)

    def _sample_count(self, family: Family, kept: NDArray[np.bool_] | None) -> int:
        """A sample of a mirror symmetric problem counts twice."""
        if not isinstance(family, LinearFamily):
            return self.settings.samples or MLP_SAMPLES
        count = self._linear_sample_count(family.width, family.outputs)
        return count if kept is None or self.settings.samples else ceil(count / 2)

    def _linear_sample_count(self, terms: int, r: int) -> int:
        """Number of samples for a linear family, so that there are about 140 residuals per coefficient."""
        return self.settings.samples or 1000 + ceil(140 * terms / (self.problem.m + r - 1))

    def _require_graph_memory(self, label: str, family: Family, count: int) -> None:
        """Refuse a network whose parameters and solver state exceed the memory."""
        require_memory(f"{label} with {family.size} parameters", 8.0 * (60 * family.size + 100 * count * self.space.n))

    def require_memory(self, target: GradedParametrisation, r: int) -> None:
        """Refuse a degree that exceeds the memory, before building anything."""
        n, half = self.space.n, 1 if self.mirror is None else 2
        K = target.term_count(n)
        N = self._linear_sample_count(K, r) / half
        of_a_joint = K - target.term_count(n - 1) if n > 1 else K
        numbers = 1 + K if isinstance(target, Polynomial | Fourier) else n * of_a_joint  # see BasisGradients
        gradients = 2 * (4 if self.settings.single else 8) * numbers + 4 * n * K / STRIDE  # twice while they are built
        curvature = 16 * (n * r) ** 2 if self.settings.max_mutual is not None else 0
        needed = N * (gradients + curvature) + 32 * (r * K / half) ** 2
        require_memory(f"{target.label} on {self.space.n} joints with {K} basis functions", needed)


def missed_bound(label: str, bound: float, objective: BoundedMutual, result: SolveResult) -> SolveError:
    """The error of a missed bound on mutual angles [rad]: by how much it was missed, and why."""
    wanted = np.degrees(bound)
    reached = wanted * objective.constraints(result.theta)[0][0] ** 0.5
    found = f"{label} coordinates with mutual angles within {wanted:.4g} deg"
    if result.status is Status.INFEASIBLE:
        return InfeasibleError(
            f"there are no {found} nearby, the closest have {reached:.4g} deg: raise max_mutual_deg or the degree"
        )
    return SolveError(
        f"no {found} found in {result.iterations} iterations, the closest have {reached:.4g} deg: "
        "raise max_mutual_deg, the degree, or the number of iterations"
    )
