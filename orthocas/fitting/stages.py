"""The stages of a fit, from low degrees to high ones. Each minimises an objective on samples, from a start."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import reduce
from math import ceil
from typing import Self

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
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import WorstPoints, worst_points
from orthocas.errors import InvalidValueError
from orthocas.fitting.basis_objective import RULES as OBJECTIVE_RULES
from orthocas.fitting.basis_objective import BasisGradients, BasisObjective, build_gradients, expand
from orthocas.fitting.bounded_mutual import BoundedMutual, bound_mutual_angles
from orthocas.fitting.like import LikeTerm
from orthocas.fitting.network_objective import ArrayObjective, GraphObjective
from orthocas.fitting.settings import RULES, FitSettings
from orthocas.fitting.starts import Mirror, find_mirror, find_spectral_start
from orthocas.fitting.terms import FOLD_TERM
from orthocas.fitting.terms import RULES as LOSS_RULES
from orthocas.solvers.minimisers import GaussNewton
from orthocas.solvers.protocol import Objective, SampledObjective, Solver, SolveResult, Status
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, evaluate_samples, sample_evenly, sample_problem
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_memory
from orthocas.tools.interrupts import deferred
from orthocas.tools.progress import Monitor, Progress, Watch

Begin = Callable[[ProductFamily], Array | None]  #: parameters to start from, (size,), if some are known


@dataclass(frozen=True, eq=False)
class Stage:
    """One minimisation of a fit."""

    label: str  #: parametrisation, for example 'polynomial:3'
    parameters: int
    samples: int
    result: SolveResult

    def mark_interrupted(self) -> "Stage":
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
    conditioning is large enough or, without a fold, no longer grows. If folds remain after some rounds, or at once
    where the domain holds singular positions, the domain forces them: then the last stage leaves the fold term out.

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
        runner, folds = self._runner, self._runner.folds
        # degree by degree, if the family has degrees
        target = runner.settings.parametrisation
        steps: list[Parametrisation] = [target]
        if isinstance(target, GradedParametrisation):
            runner.require_memory(target, self._r)
            steps = [target.of_degree(degree) for degree in range(min(target.degree, 2), target.degree + 1)]
        try:
            for step in steps:
                self._solve(step, step.label, final=step is steps[-1])
            # the last one again, until there is no point of small conditioning, or its conditioning no longer grows
            last, before = steps[-1], 0.0
            for k in range(2, 2 + RULES.rounds):
                unfolded = folds.least >= LOSS_RULES.least_conditioning
                settled = 0 <= folds.least < before + RULES.least_gain
                if unfolded or settled or (folds.least < 0 and folds.singular):
                    break
                before = folds.least
                self._solve(last, f"{last.label}, round {k}", final=True)
            # the domain forces folds: their term would only spoil the rest
            if folds.least < 0:
                folds.give_up()
                self._solve(last, f"{last.label}, with folds", final=True)
        except KeyboardInterrupt:  # also between minimisations
            if self._reached is None:
                raise
            self._stages[-1] = self._stages[-1].mark_interrupted()
        assert self._reached is not None
        return Solution(tuple(self._stages), self._reached[0], self._runner.folds.worst)

    def _solve(self, step: Parametrisation, label: str, final: bool) -> None:
        """Run a stage, and search the worst points of its result."""
        runner, degree = self._runner, step.degree if isinstance(step, GradedParametrisation) else 0
        # The family on the active joints, from the last result. Only the last degree is solved exactly, but in another
        # metric than the identity: the loss has long valleys there, and steps of low degrees cost little.
        family, solver = runner.family(step, self._r), runner.settings.solver
        if not final and runner.problem.metric.is_identity:
            solver = solver.coarser()
        stage = runner.run(Plan(label, family, self._start(family), solver, degree, final))
        self._stages.append(stage)
        self._reached = step, family
        # the worst points of low degrees differ from those of the last one
        if stage.result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if final or degree >= RULES.searched:
            runner.folds.search(stage, step, len(self._stages), runner.monitor)

    def _start(self, family: Family) -> Array | None:
        """The last result, embedded; at first that of `begin`."""
        if self._reached is None:
            polynomials = isinstance(self._runner.settings.parametrisation, Polynomial)
            if self._begin is None or not polynomials or self._runner.mirror is not None:
                return None
            assert isinstance(family, ProductFamily)
            return self._begin(family)
        # a basis of higher degree contains the last one
        theta, before = self._stages[-1].result.theta, self._reached[1]
        if theta.size == family.size:
            return theta
        assert isinstance(family, GradedFamily)
        assert isinstance(before, GradedFamily)
        return family.embed(theta, before)


class FoldSearch:
    """The worst points that were found so far.

    Args:
        problem: problem of the fit.
        active: joints that are not coordinates themselves.
        weight: weight of the fold term; with 0 nothing is searched.
        singular: whether samples of the domain are near singular positions of the task. Folds there are the domain's.
    """

    def __init__(self, problem: Problem, active: list[int], weight: float, singular: bool) -> None:
        self._problem, self._active, self._weight, self.singular = problem, active, weight, singular
        self._points = np.zeros((0, problem.n))
        self.worst: WorstPoints | None = None  #: of the last search

    @property
    def least(self) -> float:
        """Least conditioning of the last search; 1, the largest there is, without a search."""
        return 1.0 if self.worst is None else self.worst.least

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
        # points join before they fold, so that the next stage sees them
        self.worst = worst_points(problem, coordinates, seed)
        self._points = np.concatenate([self._points, self.worst.below(RULES.collected)])

    def add_to(self, objective: BasisObjective | ArrayObjective | GraphObjective) -> Objective:
        """The objective plus the fold term at all points collected."""
        if not len(self._points):
            return objective
        samples = evaluate_samples(self._problem, self._points).restricted_to(self._active)
        penalty = objective.elsewhere(samples, {FOLD_TERM.name: self._weight})
        return (LinearSum if isinstance(objective, BasisObjective) else WeightedSum)([(1.0, objective), (1.0, penalty)])


class WeightedSum:
    """A sum of losses of the same parameters on several sets of samples, each times a weight.

    Only the first one may draw fresh samples, such as the loss on the domain beside a penalty on its worst points.
    """

    def __init__(self, parts: Sequence[tuple[float, Objective]]) -> None:
        self.parts = parts

    def value(self, theta: Array) -> float:
        """The sum at theta (size,)."""
        return sum(weight * part.value(theta) for weight, part in self.parts)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The sum and its gradient, (size,)."""
        results = [(weight, *part.value_and_gradient(theta)) for weight, part in self.parts]
        value = sum(weight * value for weight, value, _ in results)
        return value, _add([weight * slope for weight, _, slope in results])

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Self]:
        """The first loss on fresh samples, each time with the same others."""
        (weight, first), *others = self.parts
        assert isinstance(first, SampledObjective)
        for loss in first.batches(size, count, seed):
            yield type(self)([(weight, loss), *others])


class LinearSum(WeightedSum):
    """A weighted sum for families linear in theta, with second derivatives."""

    def normal_equations(self, theta: Array) -> tuple[float, Array, Array]:
        """The sum, its gradient and its Gauss-Newton matrix."""
        results = [(weight, *part.normal_equations(theta)) for weight, part in self._solve_least_squares]
        value = sum(weight * value for weight, value, _, _ in results)
        slopes = _add([weight * slope for weight, _, slope, _ in results])
        return value, slopes, _add([weight * H for weight, *_, H in results])

    def curvature_estimate(self, theta: Array) -> list[Array]:
        """A rough Gauss-Newton matrix of the sum, in blocks."""
        parts = [(weight, part.curvature_estimate(theta)) for weight, part in self._solve_least_squares]
        return [
            _add([weight * block for (weight, _), block in zip(parts, blocks, strict=True)])
            for blocks in zip(*(blocks for _, blocks in parts), strict=True)
        ]

    def hessian(self, theta: Array) -> Array:
        """The Hessian of the sum."""
        return _add([weight * part.hessian(theta) for weight, part in self._solve_least_squares])

    @property
    def _solve_least_squares(self) -> list[tuple[float, BasisObjective]]:
        return [(weight, part) for weight, part in self.parts if isinstance(part, BasisObjective)]


def _add(arrays: Sequence[Array]) -> Array:
    return np.asarray(reduce(np.add, arrays))


class Resampled:
    """A loss of networks on some of its samples. Steps take others, drawn from all.

    Args:
        whole: the loss on all samples.
        watched: places of the samples on which it is watched.
        count: number of all samples.
    """

    def __init__(self, whole: ArrayObjective | GraphObjective, watched: NDArray[np.int_], count: int) -> None:
        self._whole, self._count = whole, count
        self._watched = whole.part(watched)

    def value(self, theta: Array) -> float:
        """The mean over the samples that are watched."""
        return self._watched.value(theta)

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The mean over the samples that are watched, and its gradient."""
        return self._watched.value_and_gradient(theta)

    def batches(self, size: int, count: int, seed: tuple[int, ...]) -> Iterator[Objective]:
        """The mean over `size` samples drawn from all, `count` times."""
        rng, size = np.random.default_rng(seed), min(size, self._count)
        while count > 0:
            # all samples are gathered once in a random order: parts of them need no copies
            shuffled = self._whole.part(rng.permutation(self._count)[: count * size])
            for start in range(0, min(count * size, self._count - size + 1), size):
                yield shuffled.part(slice(start, start + size))
                count -= 1


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
    _families: dict[tuple[str, int], Family] = field(default_factory=dict)
    _bases: dict[LinearFamily, BasisGradients] = field(default_factory=dict)  #: gradients of the bases so far
    #: spectral starts so far, by family, number of samples, and whether a mirror is used
    _starts: dict[tuple[LinearFamily, int, bool], Array] = field(default_factory=dict)

    def run(self, plan: Plan) -> Stage:
        """Draw samples, find a start if none is given, and minimise.

        Raises:
            SolveError: if there is no usable point. Only the final stage has to satisfy a bound on mutual angles.
        """
        # samples: half of them where a mirror symmetry halves the coefficients
        family, mirror = plan.family, self.mirror
        kept = mirror.kept(family) if isinstance(family, LinearFamily) and mirror is not None else None
        count = self._count_samples(family, kept)
        self.monitor(Progress(plan.label, 0.0, f"sampling {count} points"))
        # graphs of other families are few large products: they need the threads of BLAS more than the last digits
        with one_blas_thread() if isinstance(family, LinearFamily | ArrayFamily) else nullcontext():
            samples = self._sample(count, 1 + plan.tag)
            # CasADi may swallow Ctrl-C while graphs are built
            with deferred():
                objective, start = self._build_objective(plan, samples, None if kept is None else mirror)
            result = plan.solver.minimise(objective, start, Watch(self.monitor, plan.label))
        # a bound on mutual angles has to be met in the end only
        if isinstance(objective, BoundedMutual) and not np.isfinite(result.value):
            if plan.final:
                assert self.settings.max_mutual is not None
                raise objective.explain_missed_bound(plan.label, self.settings.max_mutual, result)
        else:
            result.raise_if_failed()
        # back from the free components to all coefficients
        if kept is not None and mirror is not None:
            result = replace(result, theta=mirror.coordinates(expand(result.theta, kept)))
        return Stage(plan.label, family.size, len(samples), result)

    def _build_objective(self, plan: Plan, samples: Samples, mirror: Mirror | None) -> tuple[Objective, Array]:
        """The loss of a family on samples, and the start in the parameters that it leaves free."""
        family, theta, settings = plan.family, plan.start, self.settings
        # linear families: least squares in their coefficients
        if isinstance(family, LinearFamily):
            objective, start = self._build_in_basis(family, samples, theta, mirror)
            if settings.max_mutual is None:
                return self.folds.add_to(objective), start
            return bound_mutual_angles(objective, start, settings.max_mutual, self.problem.r, fresh=theta is None)
        # all others: networks by arrays, anything else by CasADi's graphs
        if settings.max_mutual is not None:
            expected = "a parametrisation linear in its parameters, such as polynomial"
            raise InvalidValueError("max_mutual_deg", f"given with {plan.label}", expected)
        # with the state of the solver
        numbers = 60 * family.size + 100 * len(samples) * self.space.n
        require_memory(f"{plan.label} with {family.size} parameters", 8.0 * numbers)
        start = family.initial(settings.seed) if theta is None else theta
        if isinstance(family, ArrayFamily):
            network = ArrayObjective(family, samples, settings.weights, start, self._draw, settings.single)
            return self.folds.add_to(network), start
        if settings.single:
            label = settings.parametrisation.label
            raise InvalidValueError("precision", f"'single' with {label}", "double, or a basis or a network (mlp)")
        return self.folds.add_to(GraphObjective(family, samples, settings.weights, start, self._draw)), start

    def _build_in_basis(
        self, family: LinearFamily, samples: Samples, theta: Array | None, mirror: Mirror | None
    ) -> tuple[BasisObjective, Array]:
        """The loss of a family that is linear in its parameters, and the start in those that a mirror leaves free."""
        kept = None if mirror is None else mirror.kept(family)
        # the start as components, which a mirror leaves even or odd, and of these the free ones
        if theta is None:
            theta = self._start_spectral(family, len(samples), kept)
        elif mirror is not None:
            theta = mirror.components(theta)
        theta = theta if kept is None else theta.reshape(kept.shape)[kept]
        exchanged = () if mirror is None else mirror.exchanged
        objective = BasisObjective(
            family, samples, self.settings.weights, theta, self._draw, kept, exchanged, self._gradients(family)
        )
        return objective, theta

    def _start_spectral(self, family: LinearFamily, count: int, kept: NDArray[np.bool_] | None) -> Array:
        """A start that does not depend on the seed: eigenvalues are close, so other samples would mix coordinates."""
        key = family, count, kept is not None
        if key not in self._starts:
            points = sample_evenly(self.problem.domain, count, RULES.start_seed)
            samples = evaluate_samples(self.problem, points).restricted_to(self.active)
            start = find_spectral_start(family, samples, kept, self._gradients(family))
            # quantities to follow choose among coordinates of equal loss
            if self.like is not None:
                start = self.like.turn(family, start, samples, self._gradients(family))
            self._starts[key] = start
        return self._starts[key]

    @property
    def space(self) -> JointSpace:
        """The active joints."""
        return JointSpace.of(self.problem).restricted_to(self.active)

    def family(self, parametrisation: Parametrisation, r: int) -> Family:
        """The family on the active joints: the same object every time, so that what it needs is built once."""
        key = parametrisation.label, r
        if key not in self._families:
            self._families[key] = parametrisation.family(self.space, r)
        return self._families[key]

    @cached_property
    def mirror(self) -> Mirror | None:
        """The symmetry that halves the coefficients; a bound on mutual angles, or a meaning, is met without one.

        Of the coordinates that it allows, those with the least loss at degree 3 are chosen.
        """
        free = self.settings.max_mutual is None and self.like is None
        mirror = find_mirror(self.problem, self.active) if free else None
        target = self.settings.parametrisation
        if mirror is None or not isinstance(target, GradedParametrisation):
            return mirror
        family = self.family(target.of_degree(min(target.degree, RULES.trial_degree)), len(mirror.parities))
        assert isinstance(family, LinearFamily)
        return min(mirror.list_choices(), key=lambda choice: self._try(family, choice))

    def _try(self, family: LinearFamily, mirror: Mirror) -> float:
        """The loss that a family reaches with these symmetric coordinates."""
        samples = self._sample(self._count_samples(family, mirror.kept(family)), 0)
        with one_blas_thread():
            with deferred():
                objective, start = self._build_in_basis(family, samples, None, mirror)
            result = GaussNewton().coarser().minimise(objective, start)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return result.value

    def require_memory(self, target: GradedParametrisation, r: int) -> None:
        """Refuse a degree that exceeds the memory, before building anything."""
        n, half = self.space.n, 1 if self.mirror is None else 2
        K = target.term_count(n)
        N = self._count_for_basis(K, r) / half
        # numbers of the basis at a sample, see `BasisGradients`; they are there twice while they are built
        of_a_joint = K - target.term_count(n - 1) if n > 1 else K
        numbers = 1 + K if isinstance(target, Polynomial | Fourier) else n * of_a_joint
        gradients = 2 * (4 if self.settings.single else 8) * numbers + 4 * n * K / OBJECTIVE_RULES.stride
        curvature = 16 * (n * r) ** 2 if self.settings.max_mutual is not None else 0
        needed = N * (gradients + curvature) + 32 * (r * K / half) ** 2
        require_memory(f"{target.label} on {self.space.n} joints with {K} basis functions", needed)

    def _count_samples(self, family: Family, kept: NDArray[np.bool_] | None) -> int:
        """Number of samples of a family. A sample of a mirror symmetric problem counts twice."""
        if not isinstance(family, LinearFamily):
            return self.settings.samples or RULES.network_samples
        count = self._count_for_basis(family.width, family.outputs)
        return count if kept is None or self.settings.samples else ceil(count / 2)

    def _count_for_basis(self, terms: int, r: int) -> int:
        """Number of samples for a linear family, so that there are 70 to 140 residuals per coefficient."""
        rows = self.problem.m + r - 1
        if self.problem.n > RULES.many_joints:
            return self.settings.samples or ceil(RULES.residuals_of_many * terms / rows)
        residuals = RULES.residuals if self.problem.metric.is_identity else RULES.residuals_in_metric
        return self.settings.samples or RULES.least_samples + ceil(residuals * terms / rows)

    def _sample(self, count: int, tag: int) -> Samples:
        points = sample_evenly(self.problem.domain, count, (self.settings.seed, tag))
        return evaluate_samples(self.problem, points).restricted_to(self.active)

    def _draw(self, count: int, seed: tuple[int, ...]) -> Samples:
        fresh = sample_problem(self.problem, count, (self.settings.seed, RULES.fresh_tag, *seed))
        return fresh.restricted_to(self.active)

    def _gradients(self, family: LinearFamily) -> BasisGradients:
        """Gradients of a basis, built once."""
        if family not in self._bases:
            number = np.float32 if self.settings.single else np.float64
            self._bases[family] = build_gradients(family, self.space.n, number)
        return self._bases[family]
