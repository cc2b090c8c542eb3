"""The minimisations a fit is made of: samples, a start, an objective, a solver."""

from dataclasses import dataclass
from math import ceil

import numpy as np

from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array, require_memory
from orthocas.domains import sample_evenly
from orthocas.errors import InfeasibleError, InvalidValueError, SolveError
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.bounded_mutual import BoundedMutual
from orthocas.fitting.checkpoint import Checkpoint, Stage
from orthocas.fitting.graph_objective import GraphObjective
from orthocas.fitting.loss import DEFAULT_WEIGHTS, Weights, pairs
from orthocas.fitting.spectral_start import spectral_start
from orthocas.minimising.objective import Objective
from orthocas.minimising.solver import Solver, SolveResult, Status
from orthocas.minimising.watch import Monitor, Progress, Watch
from orthocas.parametrisations import Family, GradedParametrisation, JointSpace, LinearFamily, Parametrisation, embed
from orthocas.problem import Problem
from orthocas.samples import Samples, sample_problem, samples_at

MLP_SAMPLES = 2000  #: default sample count of families that are not linear in theta
_FRESH = 2000  # tag of samples drawn while a solver runs, apart from those of the stages


@dataclass(frozen=True, eq=False)
class StageRunner:
    """What the stages of one fit share."""

    problem: Problem
    space: JointSpace  #: active joints only
    active: list[int]
    weights: Weights
    max_mutual: float | None  #: bound on the root mean square mutual cosine, over all pairs of coordinates
    samples: int | None
    seed: int
    monitor: Monitor
    checkpoint: Checkpoint
    starter: Solver | None = None  #: solves the weighted problem before a bounded one: minima far from it are worse

    def graded(
        self, target: GradedParametrisation, r: int, solver: Solver
    ) -> tuple[list[Stage], GradedParametrisation]:
        """Degree continuation: solve a low degree from a spectral start, embed, solve the next, ..."""
        self._require_memory(target, r)
        stages: list[Stage] = []
        lower = None
        for degree in range(min(target.degree, 2), target.degree + 1):
            current = target.of_degree(degree)
            family = current.family(self.space, r)
            start = None if lower is None else embed(stages[-1].result.theta, r, lower.terms, family.terms)
            final = degree == target.degree
            try:
                minimiser = solver if final else solver.coarser()
                stages.append(self.stage(current, family, start, minimiser, degree, final))
            except KeyboardInterrupt:  # between minimisations: the last degree is the best so far
                if not stages:
                    raise
                return [*stages[:-1], stages[-1].interrupted()], target.of_degree(degree - 1)
            lower = family
            if stages[-1].result.status is Status.INTERRUPTED:
                return stages, current
        return stages, target

    def stage(
        self,
        parametrisation: Parametrisation,
        family: Family,
        theta: Array | None,
        solver: Solver,
        degree: int = 0,
        final: bool = True,
    ) -> Stage:
        """Draw samples, find a start if there is none, and minimise; or take the stage from the checkpoint.

        Raises:
            SolveError: if there is no usable point. A bound on mutual angles has to be kept by the final stage only.
        """
        label = parametrisation.label
        done = self.checkpoint.finished(label)
        if done is not None:
            return done
        count = self._sample_count(family)
        self.monitor(Progress(label, 0.0, f"sampling {count} points"))
        points = sample_evenly(self.problem.domain, count, (self.seed, 1 + degree))
        samples = samples_at(self.problem, points).restricted_to(self.active)
        with deferred():  # CasADi may swallow Ctrl-C while graphs are built
            objective, theta = self._objective(label, family, samples, theta)
        keeper = self.checkpoint.keeper(label)
        watch = Watch(self.monitor, label, keeper)
        result = solver.minimise(objective, theta, watch)
        if result.status is Status.INTERRUPTED:
            keeper.flush()
        if isinstance(objective, BoundedMutual) and not np.isfinite(result.value):
            if final:
                raise self._missed(label, objective, result)
        else:
            result.raise_if_failed()
        stage = Stage(label, family.size, len(samples), result)
        self.checkpoint.add(stage)
        return stage

    def _objective(self, label: str, family: Family, samples: Samples, theta: Array | None) -> tuple[Objective, Array]:
        """The loss of a family on samples, and where to start."""
        if not isinstance(family, LinearFamily):
            if self.max_mutual is not None:
                raise InvalidValueError(
                    "max_mutual_deg", f"given with {label}", "a parametrisation linear in its parameters, as polynomial"
                )
            self._require_graph_memory(label, family, len(samples))
            theta = family.initial(self.seed) if theta is None else theta
            return GraphObjective(family, samples, self.weights, theta, self._draw), theta
        fresh = theta is None
        theta = spectral_start(family, samples) if theta is None else theta
        objective = BasisObjective(family, samples, self.weights, theta, self._draw)
        if self.max_mutual is None:
            return objective, theta
        fitted, all_pairs = len(pairs(family.outputs)), len(pairs(self.problem.r))
        if not fitted:
            raise InvalidValueError("max_mutual_deg", "given", "a problem with two or more coordinates to fit")
        # pairs with an idle joint are exactly orthogonal, so the others may use their share
        bounded = BoundedMutual(objective, self.max_mutual * (all_pairs / fitted) ** 0.5)
        if fresh and self.starter is not None:
            weighted = Weights(self.weights.task, DEFAULT_WEIGHTS[1], self.weights.regularity, self.weights.length)
            theta = self.starter.minimise(objective.reweighted(weighted), theta).theta
        return bounded, bounded.in_gauge(theta)

    def _missed(self, label: str, objective: BoundedMutual, result: SolveResult) -> SolveError:
        """The error that says how far a bound was missed, and why."""
        assert self.max_mutual is not None
        wanted = np.degrees(self.max_mutual)
        reached = wanted * objective.constraints(result.theta)[0][0] ** 0.5
        found = f"{label} coordinates with mutual angles within {wanted:.4g} deg"
        if result.status is Status.INFEASIBLE:
            return InfeasibleError(
                f"there are no {found} near, the closest have {reached:.4g} deg: raise max_mutual_deg or the degree"
            )
        return SolveError(
            f"no {found} found in {result.iterations} iterations, the closest have {reached:.4g} deg: "
            "raise max_mutual_deg, the degree, or the number of iterations"
        )

    def _draw(self, count: int, seed: tuple[int, ...]) -> Samples:
        return sample_problem(self.problem, count, (self.seed, _FRESH, *seed)).restricted_to(self.active)

    def _sample_count(self, family: Family) -> int:
        if isinstance(family, LinearFamily):
            return self._linear_sample_count(len(family.terms), family.outputs)
        return self.samples or MLP_SAMPLES

    def _linear_sample_count(self, terms: int, r: int) -> int:
        """Samples for a linear family: enough that every coefficient sees about 140 residuals."""
        return self.samples or 1000 + ceil(140 * terms / (self.problem.m + r - 1))

    def _require_graph_memory(self, label: str, family: Family, count: int) -> None:
        """Refuse a network whose parameters and minimiser memory do not fit."""
        require_memory(f"{label} with {family.size} parameters", 8.0 * (60 * family.size + 100 * count * self.space.n))

    def _require_memory(self, target: GradedParametrisation, r: int) -> None:
        """Refuse a degree that does not fit, before building anything."""
        K = target.term_count(self.space.n)
        N = self._linear_sample_count(K, r)
        curvature = (self.space.n * r) ** 2 if self.max_mutual is not None else 0
        needed = 8 * (N * (2 * self.space.n * K + 2 * curvature) + 4 * (r * K) ** 2)
        require_memory(f"{target.label} on {self.space.n} joints with {K} basis functions", needed)
