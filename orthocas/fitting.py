"""Fitting coordinates to a problem: idle joints split off, spectral start, degree continuation, a minimiser."""

import time
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array, frozen_array, require_count, require_memory
from orthocas.coordinates import Coordinates, joint_space
from orthocas.domains import sample_evenly
from orthocas.errors import InvalidValueError, OrthocasError
from orthocas.graph_objective import GraphObjective
from orthocas.idle_joints import idle_joints
from orthocas.linear_objective import LinearObjective
from orthocas.loss import Weights
from orthocas.objective import Monitor, Objective, Progress, Solver, SolveResult, Status, silent
from orthocas.parametrisations import (
    Family,
    GradedParametrisation,
    JointSpace,
    Linear,
    LinearFamily,
    Parametrisation,
    Polynomial,
    Term,
    embed,
)
from orthocas.problem import Problem, ProblemCheck, check
from orthocas.samples import Samples, sample_problem, samples_at
from orthocas.spectral import spectral_start

_FIRST_SAMPLES = 1000  # tag of the samples that scale coordinates, apart from those of the stages
MLP_SAMPLES = 2000  #: default sample count of families that are not linear in theta


@dataclass(frozen=True, eq=False)
class Stage:
    """One minimisation of a fit."""

    label: str  #: parametrisation, for example 'polynomial:3'
    parameters: int
    samples: int
    result: SolveResult

    def interrupted(self) -> "Stage":
        """The same, marked as the last because of Ctrl-C."""
        return replace(self, result=replace(self.result, status=Status.INTERRUPTED))


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted chart and how it came about."""

    chart: Chart
    stages: tuple[Stage, ...]
    problem_check: ProblemCheck
    idle_joints: tuple[str, ...]  #: joints that are exact coordinates themselves
    seconds: float

    @property
    def status(self) -> Status:
        """How the last stage ended; CONVERGED if there was nothing to minimise."""
        return self.stages[-1].result.status if self.stages else Status.CONVERGED


def fit_chart(
    problem: Problem,
    parametrisation: Parametrisation,
    solver: Solver,
    weights: Weights,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
) -> Fit:
    """Fit coordinates; see `orthocas.fit`, which fills in the default solver."""
    start = time.perf_counter()
    samples = None if samples is None else require_count("samples", samples, least=2)
    seed = require_count("seed", seed, least=0)
    found = check(problem, seed=seed)
    first = sample_problem(problem, 200, (seed, _FIRST_SAMPLES))
    space = joint_space(problem)
    idle = [] if isinstance(parametrisation, Linear) else idle_joints(problem, first)[-problem.r :]
    active = [i for i in range(problem.n) if i not in idle]
    run = _Run(problem, space.restricted_to(active), active, weights, samples, seed, monitor)
    r = problem.r - len(idle)
    stages: list[Stage]
    if r == 0:
        stages, parametrisation, theta = [], Polynomial(1), np.zeros(0)
    elif isinstance(parametrisation, Linear):
        stages, theta = [], run.linear(parametrisation)
    elif isinstance(parametrisation, GradedParametrisation):
        stages, parametrisation, theta = run.graded(parametrisation, r, solver)
    else:
        stages = [run.stage(parametrisation, parametrisation.family(run.space, r), None, solver, 0)]
        theta = stages[-1].result.theta
    coordinates = _normalised(problem, parametrisation, space, tuple(idle), theta, r, first)
    notes: dict[str, str | float] = {
        "solver": solver.name if stages else "closed form",
        "lambda1": weights.task,
        "lambda2": weights.mutual,
        "lambda3": weights.regularity,
        "seed": seed,
        "samples": stages[-1].samples if stages else 0,
        "status": stages[-1].result.status.value if stages else Status.CONVERGED.value,
    }
    return Fit(
        chart=Chart(problem, coordinates, notes),
        stages=tuple(stages),
        problem_check=found,
        idle_joints=tuple(problem.robot.joint_names[i] for i in idle),
        seconds=time.perf_counter() - start,
    )


@dataclass(frozen=True, eq=False)
class _Run:
    """What the stages of one fit share."""

    problem: Problem
    space: JointSpace  # active joints only
    active: list[int]
    weights: Weights
    samples: int | None
    seed: int
    monitor: Monitor

    def graded(
        self, target: GradedParametrisation, r: int, solver: Solver
    ) -> tuple[list[Stage], GradedParametrisation, Array]:
        """Degree continuation: solve a low degree from a spectral start, embed, solve the next, ..."""
        self._require_memory(target, r)
        stages: list[Stage] = []
        reached = target
        terms: tuple[Term, ...] = ()
        for degree in range(min(target.degree, 2), target.degree + 1):
            family = target.of_degree(degree).family(self.space, r)
            start = embed(stages[-1].result.theta, r, terms, family.terms) if stages else None
            minimiser = solver if degree == target.degree else solver.coarser()
            try:
                stages.append(self.stage(target.of_degree(degree), family, start, minimiser, degree))
            except KeyboardInterrupt:  # between minimisations: the last degree is the best so far
                if not stages:
                    raise
                stages[-1] = stages[-1].interrupted()
                break
            reached, terms = target.of_degree(degree), family.terms
            if stages[-1].result.status is Status.INTERRUPTED:
                break
        return stages, reached, stages[-1].result.theta

    def stage(
        self, parametrisation: Parametrisation, family: Family, theta: Array | None, solver: Solver, degree: int
    ) -> Stage:
        """Draw samples, find a start if there is none, and minimise."""
        if isinstance(family, LinearFamily):
            count = self._sample_count(len(family.terms), family.outputs)
        else:
            count = self.samples or MLP_SAMPLES
        self.monitor(Progress(parametrisation.label, 0.0, f"sampling {count} points"))
        points = sample_evenly(self.problem.domain, count, (self.seed, 1 + degree))
        samples = samples_at(self.problem, points).restricted_to(self.active)
        objective: Objective
        if isinstance(family, LinearFamily):
            theta = spectral_start(family, samples) if theta is None else theta
            objective = LinearObjective(family, samples, self.weights, theta)
        else:
            self._require_graph_memory(parametrisation.label, family, count)
            theta = family.initial(self.seed) if theta is None else theta
            objective = GraphObjective(family, samples, self.weights, theta)
        result = solver.minimise(objective, theta, self.monitor, parametrisation.label).raise_if_failed()
        return Stage(parametrisation.label, family.size, count, result)

    def linear(self, parametrisation: Linear) -> Array:
        """Normals of linear coordinates at their base."""
        base = _base(self.problem, parametrisation)
        at_base = samples_at(self.problem, base[None, :])
        if len(at_base) == 0:
            raise InvalidValueError("base", base.tolist(), "a joint position where no task gradient vanishes")
        return parametrisation.normal_vectors(at_base.raised(at_base.task_jacobian)[0]).ravel()

    def _sample_count(self, terms: int, r: int) -> int:
        """Samples for a linear family: enough that every coefficient sees about 140 residuals."""
        return self.samples or 1000 + ceil(140 * terms / (self.problem.m + r - 1))

    def _require_graph_memory(self, label: str, family: Family, count: int) -> None:
        """Refuse a network whose parameters and minimiser memory do not fit."""
        require_memory(f"{label} with {family.size} parameters", 8.0 * (60 * family.size + 100 * count * self.space.n))

    def _require_memory(self, target: GradedParametrisation, r: int) -> None:
        """Refuse a degree that does not fit, before building anything."""
        K = target.term_count(self.space.n)
        N = self._sample_count(K, r)
        needed = 8 * (N * self.space.n * K + 4 * (r * K) ** 2)
        require_memory(f"{target.label} on {self.space.n} joints with {K} basis functions", needed)


def _base(problem: Problem, parametrisation: Linear) -> Array:
    """Base q0 of linear coordinates, (n,)."""
    return frozen_array(
        "base", problem.domain.centre if parametrisation.base is None else parametrisation.base, (problem.n,)
    )


def _normalised(
    problem: Problem,
    parametrisation: Parametrisation,
    space: JointSpace,
    idle: tuple[int, ...],
    theta: Array,
    r: int,
    samples: Samples,
) -> Coordinates:
    """Shift and scale so that xi(centre) = 0 and each coordinate's mean gradient length is 1.

    Linear coordinates keep their unit normals and vanish at their own base.
    """
    raw = Coordinates(parametrisation, space, idle, theta, np.zeros(r), np.ones(r))
    lengths = np.linalg.norm(raw.jacobian(samples.points)[:, :r], axis=2).mean(axis=0)
    if r and not lengths.min() > 0:
        raise OrthocasError(f"coordinate {int(np.argmin(lengths))} has no gradient on the domain")
    base = _base(problem, parametrisation) if isinstance(parametrisation, Linear) else problem.domain.centre
    offset = raw.xi(base[None, :])[0, :r]
    scale = np.ones(r) if isinstance(parametrisation, Linear) else 1 / lengths
    return Coordinates(parametrisation, space, idle, theta, offset, scale)
