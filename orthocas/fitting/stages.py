"""The stages of a fit, and its settings. Each stage minimises a loss on samples; degrees rise from stage to stage."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import ceil
from typing import Literal, Self

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
    require_parametrisation,
)
from orthocas.bases.products import Fourier, Polynomial, ProductFamily
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import WorstPoints, worst_points
from orthocas.errors import InvalidValueError
from orthocas.fitting.basis_objective import RULES as OBJECTIVE_RULES
from orthocas.fitting.basis_objective import BasisGradients, BasisObjective, build_gradients, expand
from orthocas.fitting.combined import BoundedMutual, LinearSum, WeightedSum, bound_mutual_angles
from orthocas.fitting.like import RULES as LIKE_RULES
from orthocas.fitting.like import Like, Likeness, LikeTerm
from orthocas.fitting.network_objective import ArrayObjective, GraphObjective
from orthocas.fitting.starts import Mirror, find_mirror, find_spectral_start
from orthocas.fitting.terms import FOLD_TERM, WeightNumbers, Weights, register_loss_term
from orthocas.fitting.terms import RULES as LOSS_RULES
from orthocas.solvers.casadi_solvers import Ipopt
from orthocas.solvers.minimisers import LBFGS, GaussNewton, QuasiNewton
from orthocas.solvers.protocol import Objective, Solver, SolveResult, Status
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, evaluate_samples, sample_evenly, sample_problem
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_number, require_count, require_kind, require_known, require_memory
from orthocas.tools.interrupts import deferred
from orthocas.tools.progress import Monitor, Progress, Watch

Begin = Callable[[ProductFamily], Array | None]  #: parameters to start from, (size,), if some are known
Precision = Literal["double", "single"]
PRECISIONS: tuple[Precision, ...] = ("double", "single")  #: of the large products of a fit


@dataclass(frozen=True, slots=True)
class FitRules:
    """Numbers of fits. Chosen on the planar arms and the iiwa, held on the arms of docs/which_tool.md."""

    default_degree: int = 5
    degree_with_bound: int = 4  #: with a bound on mutual angles
    lower_degrees: tuple[tuple[int, int], ...] = ((8, 4), (9, 3), (12, 2))  #: joints, and the degree from there on
    many_joints: int = 8  #: with more joints, coordinates are many as well, and the matrix grows with their square
    many_terms: int = 300  #: from here on a Gauss-Newton matrix takes longer than ten gradients: degree 4, 7 joints
    least_bound_deg: float = 1e-6  #: on mutual angles; rounding hides smaller ones

    least_samples: int = 1000  #: of bases
    residuals: int = 140  #: per coefficient: number of residuals of the samples beyond `least_samples`
    residuals_in_metric: int = 70  #: the same in another metric than the identity: leaks are of the same size
    renewal_in_metric: float = 0.95  #: `renewal` of QuasiNewton there, where losses fall along long valleys
    tolerance_of_many: float = 1e-3  #: of the solver for many joints: half the time, and leaks are 2 % larger
    residuals_of_many: int = 100  #: per coefficient, of all samples, for many joints
    network_samples: int = 2000  #: of families that are not linear in their parameters
    first: int = 200  #: samples that scale coordinates
    first_tag: int = 1000  #: their seed tag; stages use other tags
    fresh_tag: int = 2000  #: seed tag of samples drawn while a solver runs
    start_seed: int = 0  #: of the samples of spectral starts, the same for all fits
    trial_degree: int = 3  #: of the trial that chooses among symmetric coordinates

    searched: int = 3  #: degree from which worst points are searched: those of lower degrees differ from the last ones
    rounds: int = 4  #: of the last degree, with the worst points
    least_gain: float = 0.01  #: of the conditioning in a round
    collected: float = 1.5 * 0.2  #: conditioning below which points are collected, before they become worse
    digits: int = 6  #: of gradients at the centre that count for the order: fits end with about as many

    bound_step: float = 0.05  #: of the bounds on the relative singular value that are offered
    failed: float = 0.05  #: conditioning below which a chart is of no use; folds have less than 0
    failed_fraction: float = 0.9  #: of such points that a bound should leave out
    largest_bound: float = 0.25  #: charts that fail at larger singular values have other reasons
    any_bound: float = 1e-12  #: of a ClearBox that only measures


RULES = FitRules()


@dataclass(frozen=True, eq=False)
class Stage:
    """One minimisation of a fit."""

    label: str  #: parametrisation, for example 'polynomial:3'
    parameters: int
    samples: int
    result: SolveResult

    def mark_interrupted(self) -> Stage:
        """The same stage, marked as interrupted by Ctrl-C."""
        return replace(self, result=replace(self.result, status=Status.INTERRUPTED))


@dataclass(frozen=True, eq=False)
class Solution:
    """Finished stages, the parametrisation of the last one, and its worst points if there was a search."""

    stages: tuple[Stage, ...]
    parametrisation: Parametrisation
    worst: WorstPoints | None

    @property
    def theta(self) -> Array:
        """Parameters found by the last minimisation."""
        return self.stages[-1].result.theta


class Continuation:
    """Solves a low degree from a spectral start, embeds the result in the next degree, and solves that one.

    The worst points of each degree from 3 on join the loss of the next one. The last degree is solved again, in up to
    four more rounds, until its least conditioning is large enough or, without a fold, no longer grows. If the last
    round folds but an earlier one did not, the best round is the result. If it folds and the domain has near-singular
    positions, these force the fold: then the degree is solved once more without the fold term.

    Args:
        problem: problem of the fit.
        settings: its settings.
        active: joints that are not coordinates themselves.
        monitor: called with progress.
        folds: collects worst points.
        like: the loss term of the quantities that the first coordinates follow.
        begin: gives parameters of polynomials to start from, instead of a spectral start. It is not used with a mirror
            symmetry, because coordinates of another fit need not be even or odd.
    """

    def __init__(
        self,
        problem: Problem,
        settings: FitSettings,
        active: list[int],
        monitor: Monitor,
        folds: FoldSearch,
        like: LikeTerm | None = None,
        begin: Begin | None = None,
    ) -> None:
        self.problem, self.settings, self.active, self.monitor = problem, settings, active, monitor
        self.folds, self.like, self.begin = folds, like, begin
        self.space, self.r = JointSpace.of(problem).restricted_to(active), len(active) - problem.m
        self._stages: list[Stage] = []
        self._reached: tuple[Parametrisation, Family] | None = None
        # Caches: families by label, gradients by family, spectral starts by family, number of samples, use of a mirror
        self._families: dict[str, Family] = {}
        self._bases: dict[LinearFamily, BasisGradients] = {}
        self._starts: dict[tuple[LinearFamily, int, bool], Array] = {}

    def run(self) -> Solution:
        """Run all stages. After Ctrl-C, the last one is marked as interrupted."""
        # One step for each degree, if the family has degrees
        target, folds = self.settings.parametrisation, self.folds
        steps: list[Parametrisation] = [target]
        if isinstance(target, GradedParametrisation):
            self._require_memory(target)
            steps = [target.of_degree(degree) for degree in range(min(target.degree, 2), target.degree + 1)]
        last, before = steps[-1], -np.inf
        # The best round: its conditioning, number of stages up to it, and worst points
        best: tuple[float, int, WorstPoints | None] = (-np.inf, 0, None)
        try:
            for step in steps:
                self._solve(step, step.label, final=step is last)
            # Solve the last step again, until its least conditioning is large enough or no longer grows
            for k in range(2, 2 + RULES.rounds):
                unfolded = folds.least >= LOSS_RULES.least_conditioning
                settled = 0 <= folds.least < before + RULES.least_gain
                if unfolded or settled or (folds.least < 0 and folds.singular):
                    break
                if folds.least >= best[0]:
                    best = folds.least, len(self._stages), folds.worst
                before = folds.least
                self._solve(last, f"{last.label}, round {k}", final=True)
            # The worst points of a round may cause folds elsewhere: if an earlier round had none, take the best one
            if folds.least < min(best[0], 0):
                self._stages, folds.worst = self._stages[: best[1]], best[2]
            # Singular positions of the domain force folds: the fold term would only make the rest of the chart worse
            if folds.least < 0 and folds.singular:
                folds.give_up()
                self._solve(last, f"{last.label}, with folds", final=True)
        except KeyboardInterrupt:  # also between minimisations
            if self._reached is None:
                raise
            self._stages[-1] = self._stages[-1].mark_interrupted()
        assert self._reached is not None
        return Solution(tuple(self._stages), self._reached[0], folds.worst)

    def _solve(self, step: Parametrisation, label: str, final: bool) -> None:
        """Run a stage from the last result, and search for the worst points of its coordinates.

        Raises:
            SolveError: if the solver fails, or a final stage misses the bound on mutual angles.
        """
        settings, problem, family = self.settings, self.problem, self._family(step)
        degree = step.degree if isinstance(step, GradedParametrisation) else 0
        # With A = I, only the last degree is solved to the full tolerance. Other metrics give the loss long valleys:
        # there all degrees are, because steps of low degrees cost little
        solver = settings.solver if final or not problem.metric.is_identity else settings.solver.coarser()
        # A mirror symmetry halves the coefficients, and then half of the samples suffice
        mirror = self.mirror
        kept = mirror.kept(family) if isinstance(family, LinearFamily) and mirror is not None else None
        count = self._count_samples(family, kept)
        self.monitor(Progress(label, 0.0, f"sampling {count} points"))
        # Graphs of other families consist of few large products: there the threads of BLAS save more time, although
        # the last digits then depend on their number
        with one_blas_thread() if isinstance(family, LinearFamily | ArrayFamily) else nullcontext():
            samples = self._sample(count, (settings.seed, 1 + degree))
            # CasADi may swallow Ctrl-C while graphs are built
            with deferred():
                objective, start = self._build_objective(label, family, samples, None if kept is None else mirror)
            result = solver.minimise(objective, start, Watch(self.monitor, label))
        # Only the final stage has to meet a bound on mutual angles
        if isinstance(objective, BoundedMutual) and not np.isfinite(result.value):
            if final:
                assert settings.max_mutual is not None
                raise objective.explain_missed_bound(label, settings.max_mutual, result)
        else:
            result.raise_if_failed()
        # Convert the free coefficients of the components to all coefficients of the coordinates
        if kept is not None and mirror is not None:
            result = replace(result, theta=mirror.coordinates(expand(result.theta, kept)))
        stage = Stage(label, family.size, len(samples), result)
        self._stages.append(stage)
        self._reached = step, family
        # Low degrees are not searched: their worst points differ from those of the last degree
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if final or degree >= RULES.searched:
            self.folds.search(stage, step, len(self._stages), self.monitor)

    def _build_objective(
        self, label: str, family: Family, samples: Samples, mirror: Mirror | None
    ) -> tuple[Objective, Array]:
        """The loss of a family on samples, and the start, in the parameters that are free."""
        settings, theta = self.settings, None
        if self._reached is not None:
            # Start from the last result. A basis of higher degree contains the last one
            theta, before = self._stages[-1].result.theta, self._reached[1]
            if theta.size != family.size:
                assert isinstance(family, GradedFamily)
                assert isinstance(before, GradedFamily)
                theta = family.embed(theta, before)
        elif self.begin is not None and isinstance(settings.parametrisation, Polynomial) and self.mirror is None:
            assert isinstance(family, ProductFamily)
            theta = self.begin(family)
        # The loss of linear families is a least-squares problem in their coefficients
        if isinstance(family, LinearFamily):
            objective, start = self._build_in_basis(family, samples, theta, mirror)
            if settings.max_mutual is None:
                return self.folds.add_to(objective), start
            return bound_mutual_angles(objective, start, settings.max_mutual, self.problem.r, fresh=theta is None)
        # The loss of networks is computed with arrays, that of other families with CasADi graphs
        if settings.max_mutual is not None:
            expected = "a family linear in its parameters, such as a polynomial"
            raise InvalidValueError("max_mutual_deg", f"given with {label}", expected)
        # The estimate includes the state of the solver
        numbers = 60 * family.size + 100 * len(samples) * self.space.n
        require_memory(f"{label} with {family.size} parameters", 8.0 * numbers)
        start, single = family.initial(settings.seed) if theta is None else theta, settings.precision == "single"
        if isinstance(family, ArrayFamily):
            network = ArrayObjective(family, samples, settings.weights, start, self._draw, single)
            return self.folds.add_to(network), start
        if single:
            label = settings.parametrisation.label
            raise InvalidValueError("precision", f"'single' with {label}", "double, or a basis or a network (mlp)")
        return self.folds.add_to(GraphObjective(family, samples, settings.weights, start, self._draw)), start

    def _build_in_basis(
        self, family: LinearFamily, samples: Samples, theta: Array | None, mirror: Mirror | None
    ) -> tuple[BasisObjective, Array]:
        """The loss of a family that is linear in its parameters, and the start, in the coefficients that are free."""
        kept = None if mirror is None else mirror.kept(family)
        key = family, len(samples), kept is not None
        if theta is None and key not in self._starts:
            # Eigenvalues are close, so other samples would mix the coordinates: use the same ones for all seeds
            even = self._sample(len(samples), RULES.start_seed)
            start = find_spectral_start(family, even, kept, self._gradients(family))
            # Among coordinates of equal loss, choose those that follow the quantities
            if self.like is not None:
                start = self.like.turn(family, start, even, self._gradients(family))
            self._starts[key] = start
        # With a mirror, the start is in even and odd components, and only their free coefficients remain
        if theta is None:
            theta = self._starts[key]
        elif mirror is not None:
            theta = mirror.components(theta)
        theta = theta if kept is None else theta.reshape(kept.shape)[kept]
        exchanged = () if mirror is None else mirror.exchanged
        objective = BasisObjective(
            family, samples, self.settings.weights, theta, self._draw, kept, exchanged, self._gradients(family)
        )
        return objective, theta

    def _family(self, parametrisation: Parametrisation) -> Family:
        """The family on the active joints. The same label gives the same object, so that its functions are reused."""
        label = parametrisation.label
        if label not in self._families:
            self._families[label] = parametrisation.family(self.space, self.r)
        return self._families[label]

    @cached_property
    def mirror(self) -> Mirror | None:
        """The mirror symmetry that halves the coefficients; None with `max_mutual_deg` or `like`, or without symmetry.

        Of the coordinates that it allows, those with the least loss at degree 3 are chosen.
        """
        free = self.settings.max_mutual is None and self.like is None
        mirror = find_mirror(self.problem, self.active) if free else None
        target = self.settings.parametrisation
        if mirror is None or not isinstance(target, GradedParametrisation):
            return mirror
        family = self._family(target.of_degree(min(target.degree, RULES.trial_degree)))
        assert isinstance(family, LinearFamily)
        losses: list[tuple[float, Mirror]] = []
        for choice in mirror.list_choices():
            samples = self._sample(self._count_samples(family, choice.kept(family)), (self.settings.seed, 0))
            with one_blas_thread():
                with deferred():
                    objective, start = self._build_in_basis(family, samples, None, choice)
                result = GaussNewton().coarser().minimise(objective, start)
            if result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            losses.append((result.value, choice))
        return min(losses, key=lambda pair: pair[0])[1]

    def _require_memory(self, target: GradedParametrisation) -> None:
        """Refuse a degree that needs more memory than there is, before anything large is built."""
        n, r, half = self.space.n, self.r, 1 if self.mirror is None else 2
        K = target.term_count(n)
        N = self._count_for_basis(K, r) / half
        # Numbers X of a sample, see `BasisGradients`: they are stored twice while they are built
        of_a_joint = K - target.term_count(n - 1) if n > 1 else K
        numbers = 1 + K if isinstance(target, Polynomial | Fourier) else n * of_a_joint
        gradients = 2 * (4 if self.settings.precision == "single" else 8) * numbers + 4 * n * K / OBJECTIVE_RULES.stride
        curvature = 16 * (n * r) ** 2 if self.settings.max_mutual is not None else 0
        needed = N * (gradients + curvature) + 32 * (r * K / half) ** 2
        require_memory(f"{target.label} on {n} joints with {K} basis functions", needed)

    def _count_samples(self, family: Family, kept: NDArray[np.bool_] | None) -> int:
        """Number of samples of a family; half of it if a mirror symmetry halves the coefficients."""
        if not isinstance(family, LinearFamily):
            return self.settings.samples or RULES.network_samples
        count = self._count_for_basis(family.width, family.outputs)
        return count if kept is None or self.settings.samples else ceil(count / 2)

    def _count_for_basis(self, terms: int, r: int) -> int:
        """Samples of a linear family: 70 to 140 residuals per coefficient; up to 8 joints, 1000 samples are added."""
        rows = self.problem.m + r - 1
        if self.problem.n > RULES.many_joints:
            return self.settings.samples or ceil(RULES.residuals_of_many * terms / rows)
        residuals = RULES.residuals if self.problem.metric.is_identity else RULES.residuals_in_metric
        return self.settings.samples or RULES.least_samples + ceil(residuals * terms / rows)

    def _sample(self, count: int, seed: int | tuple[int, ...]) -> Samples:
        points = sample_evenly(self.problem.domain, count, seed)
        return evaluate_samples(self.problem, points).restricted_to(self.active)

    def _draw(self, count: int, seed: tuple[int, ...]) -> Samples:
        fresh = sample_problem(self.problem, count, (self.settings.seed, RULES.fresh_tag, *seed))
        return fresh.restricted_to(self.active)

    def _gradients(self, family: LinearFamily) -> BasisGradients:
        """Gradients of a basis, built once."""
        if family not in self._bases:
            number = np.float32 if self.settings.precision == "single" else np.float64
            self._bases[family] = build_gradients(family, self.space.n, number)
        return self._bases[family]


class FoldSearch:
    """Searches coordinates for their worst points, and collects these for the fold term of the next stage.

    Args:
        problem: problem of the fit.
        active: joints that are not coordinates themselves.
        weight: weight of the fold term; with 0 there is no search.
        singular: whether the domain has samples near singular positions of the task, which force folds.
    """

    def __init__(self, problem: Problem, active: list[int], weight: float, singular: bool) -> None:
        self._problem, self._active, self._weight, self.singular = problem, active, weight, singular
        self._points = np.zeros((0, problem.n))
        self.worst: WorstPoints | None = None  #: of the last search

    @property
    def least(self) -> float:
        """Least conditioning that the last search found; 1, the largest possible value, without a search."""
        return 1.0 if self.worst is None else self.worst.least

    def give_up(self) -> None:
        """Discard the collected points, so that the fold term is left out."""
        self._points = self._points[:0]

    def search(self, stage: Stage, parametrisation: Parametrisation, seed: int, monitor: Monitor) -> None:
        """Find the worst points of a stage's coordinates, and collect those of small conditioning."""
        if not self._weight:
            return
        monitor(Progress(stage.label, 1.0, "searching for folds"))
        problem = self._problem
        idle = tuple(i for i in range(problem.n) if i not in self._active)
        fitted = problem.r - len(idle)
        space = JointSpace.of(problem)
        coordinates = Coordinates(parametrisation, space, idle, stage.result.theta, np.zeros(fitted), np.ones(fitted))
        # Points are collected before they fold, so that the next stage can prevent that
        self.worst = worst_points(problem, coordinates, seed)
        self._points = np.concatenate([self._points, self.worst.below(RULES.collected)])

    def add_to(self, objective: BasisObjective | ArrayObjective | GraphObjective) -> Objective:
        """The objective plus the fold term at all points collected."""
        if not len(self._points):
            return objective
        samples = evaluate_samples(self._problem, self._points).restricted_to(self._active)
        penalty = objective.elsewhere(samples, {FOLD_TERM.name: self._weight})
        return (LinearSum if isinstance(objective, BasisObjective) else WeightedSum)([(1.0, objective), (1.0, penalty)])


@dataclass(frozen=True)
class FitSettings:
    """All settings that determine the result of a fit."""

    parametrisation: Parametrisation
    solver: Solver
    weights: Weights
    samples: int | None
    seed: int
    max_mutual_deg: float | None
    split_idle: bool = True
    precision: Precision = "double"
    like: Like | None = None

    @classmethod
    def check(
        cls,
        problem: Problem,
        parametrisation: Parametrisation | None,
        solver: Solver | None,
        weights: Weights | WeightNumbers,
        samples: int | None,
        seed: int,
        max_mutual_deg: float | None,
        split_idle: bool = True,
        precision: Precision = "double",
        like: Likeness | None = None,
    ) -> FitSettings:
        """Check the settings, and fill in the default parametrisation, solver and angles.

        Raises:
            InvalidValueError, ShapeError: if a setting is invalid, or contradicts another one.
        """
        # Choose the family, and adapt it to the problem
        require_kind("problem", problem, Problem)
        if parametrisation is None:
            parametrisation = choose_parametrisation(problem, bounded=max_mutual_deg is not None)
        require_parametrisation(parametrisation)
        bound = parametrisation.for_problem(problem)
        if max_mutual_deg is not None:
            max_mutual_deg = _check_bound(bound, max_mutual_deg)
        # The solver: only Ipopt handles the bound on mutual angles
        if solver is None:
            solver = choose_solver(bound, problem) if max_mutual_deg is None else Ipopt()
        if not isinstance(solver, Solver) or isinstance(solver, type):
            raise InvalidValueError("solver", repr(solver), "an object such as GaussNewton()")
        if max_mutual_deg is not None and not isinstance(solver, Ipopt):
            raise InvalidValueError("solver", solver.name, "ipopt, the only solver that supports max_mutual_deg")
        count = None if samples is None else require_count("samples", samples, least=2)
        loss = Weights.of(weights).for_problem(problem)
        require_kind("split_idle", split_idle, bool)
        require_known("precision", precision, PRECISIONS)
        if precision == "single" and max_mutual_deg is not None:
            raise InvalidValueError("precision", "'single' with max_mutual_deg", "double, which Ipopt needs")
        tag = require_count("seed", seed, least=0)
        if like is not None and (max_mutual_deg is not None or bound.closed_form is not None):
            other = bound.label if max_mutual_deg is None else "max_mutual_deg"
            raise InvalidValueError("like", f"given with {other}", "one of them: `like` needs the weighted loss")
        quantities = None if like is None else Like.of(problem, like)
        return cls(bound, solver, loss, count, tag, max_mutual_deg, split_idle, precision, quantities)

    def add_term(self, term: LikeTerm) -> Self:
        """The settings with the loss term of the quantities that coordinates follow."""
        register_loss_term(term)
        return replace(self, weights=replace(self.weights, extra={**self.weights.extra, term.name: LIKE_RULES.weight}))

    @property
    def max_mutual(self) -> float | None:
        """Bound on the root mean square mutual angle's deviation from a right angle [rad]."""
        return None if self.max_mutual_deg is None else float(np.radians(self.max_mutual_deg))

    def fold_weight(self, problem: Problem) -> float:
        """Weight of the fold term; 0 on a torus, where every coordinate has critical points, and with a bound."""
        free = not problem.domain.full_turns and self.max_mutual_deg is None
        return self.weights.folds if free else 0.0


def choose_parametrisation(problem: Problem, bounded: bool) -> Polynomial:
    """Polynomials of degree 5; of 4 with a bound or 8 joints, of 3 from 9 joints, of 2 from 12, to limit the terms."""
    fewer = [degree for joints, degree in RULES.lower_degrees if problem.n >= joints]
    return Polynomial(
        degree=min(RULES.degree_with_bound if bounded else RULES.default_degree, *fewer, RULES.default_degree)
    )


def choose_solver(parametrisation: Parametrisation, problem: Problem) -> Solver:
    """GaussNewton for families linear in their parameters, QuasiNewton if their matrices are large; else LBFGS."""
    if not parametrisation.linear:
        return LBFGS()
    terms = parametrisation.term_count(problem.n) if isinstance(parametrisation, GradedParametrisation) else 0
    if terms and problem.n > RULES.many_joints:
        return QuasiNewton(tolerance=RULES.tolerance_of_many)
    if terms <= RULES.many_terms:
        return GaussNewton()
    return QuasiNewton() if problem.metric.is_identity else QuasiNewton(renewal=RULES.renewal_in_metric)


def _check_bound(parametrisation: Parametrisation, max_mutual_deg: float) -> float:
    if parametrisation.closed_form is not None:
        expected = "a family with parameters to fit"
        raise InvalidValueError("max_mutual_deg", f"given with {parametrisation.label}", expected)
    bound = as_number("max_mutual_deg", max_mutual_deg)
    if not RULES.least_bound_deg <= bound < 90:
        expected = f"an angle from {RULES.least_bound_deg:g} to below 90 degrees"
        raise InvalidValueError("max_mutual_deg", max_mutual_deg, expected)
    return bound
