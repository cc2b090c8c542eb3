"""The stages of a fit. Each is a minimisation: samples, a start, an objective, a solver."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from orthocas.casadi_tools.interrupts import deferred
from orthocas.casadi_tools.threads import one_blas_thread
from orthocas.checks import Array, require_memory
from orthocas.domains import sample_evenly
from orthocas.errors import CheckpointError, InfeasibleError, InvalidValueError, SolveError
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.bounded_mutual import BoundedMutual
from orthocas.fitting.checkpoint import Checkpoint, Stage
from orthocas.fitting.graph_objective import GraphObjective
from orthocas.fitting.loss import DEFAULT_WEIGHTS, pairs
from orthocas.fitting.settings import FitSettings
from orthocas.fitting.spectral_start import spectral_start
from orthocas.minimising.objective import Objective
from orthocas.minimising.solver import Solver, SolveResult, Status
from orthocas.minimising.watch import Monitor, Progress, Watch
from orthocas.parametrisations import Family, GradedParametrisation, JointSpace, LinearFamily, Parametrisation
from orthocas.problem import Problem
from orthocas.samples import Samples, sample_problem, samples_at
from orthocas.solvers import GaussNewton

MLP_SAMPLES = 2000  #: default sample count of families that are not linear in theta
_START_SEED = 0  # seed of the samples of spectral starts, the same for all fits
_FRESH = 2000  # seed tag of samples drawn while a solver runs; stages use other tags


@dataclass(frozen=True, eq=False)
class Solved:
    """Finished minimisations, and the parametrisation that they reached."""

    stages: tuple[Stage, ...]
    parametrisation: Parametrisation

    @property
    def theta(self) -> Array:
        """Parameters found by the last minimisation."""
        return self.stages[-1].result.theta


@dataclass(frozen=True, eq=False)
class StageRunner:
    """Runs the stages of one fit, and holds what they share."""

    problem: Problem
    settings: FitSettings
    active: list[int]  #: joints that are not coordinates themselves
    monitor: Monitor
    checkpoint: Checkpoint

    @property
    def space(self) -> JointSpace:
        """The active joints."""
        return JointSpace.of(self.problem).restricted_to(self.active)

    def run(self, r: int) -> Solved:
        """Run all minimisations for r coordinates of the active joints."""
        parametrisation, solver = self.settings.parametrisation, self.settings.solver
        if isinstance(parametrisation, GradedParametrisation):
            return self.graded(parametrisation, r, solver)
        stage = self.stage(parametrisation, parametrisation.family(self.space, r), None, solver)
        return Solved((stage,), parametrisation)

    def graded(self, target: GradedParametrisation, r: int, solver: Solver) -> Solved:
        """Degree continuation: solve a low degree from a spectral start, embed the result, solve the next degree."""
        self._require_memory(target, r)
        stages: list[Stage] = []
        lower = None
        for degree in range(min(target.degree, 2), target.degree + 1):
            current = target.of_degree(degree)
            family = current.family(self.space, r)
            start = None if lower is None else family.embed(stages[-1].result.theta, lower)
            final = degree == target.degree
            try:
                minimiser = solver if final else solver.coarser()
                stages.append(self.stage(current, family, start, minimiser, degree, final))
            except KeyboardInterrupt:  # between minimisations: the last degree is the best result so far
                if not stages:
                    raise
                return Solved((*stages[:-1], stages[-1].interrupted()), target.of_degree(degree - 1))
            lower = family
            if stages[-1].result.status is Status.INTERRUPTED:
                return Solved(tuple(stages), current)
        return Solved(tuple(stages), target)

    def stage(
        self,
        parametrisation: Parametrisation,
        family: Family,
        theta: Array | None,
        solver: Solver,
        degree: int = 0,
        final: bool = True,
    ) -> Stage:
        """Draw samples, find a start if none is given, and minimise. A finished stage comes from the checkpoint.

        Raises:
            SolveError: if there is no usable point. Only the final stage has to satisfy a bound on mutual angles.
        """
        label = parametrisation.label
        self.checkpoint.require_fitting(label, family.size)
        done = self.checkpoint.finished(label)
        if done is not None:
            return done
        # networks are few large products: they need the threads of BLAS more than the last digits
        with one_blas_thread() if isinstance(family, LinearFamily) else nullcontext():
            return self._minimised(label, family, theta, solver, degree, final)

    def _minimised(
        self, label: str, family: Family, theta: Array | None, solver: Solver, degree: int, final: bool
    ) -> Stage:
        """A stage that is not in the checkpoint."""
        count = self._sample_count(family)
        self.monitor(Progress(label, 0.0, f"sampling {count} points"))
        points = sample_evenly(self.problem.domain, count, (self.settings.seed, 1 + degree))
        samples = samples_at(self.problem, points).restricted_to(self.active)
        with deferred():  # CasADi may swallow Ctrl-C while graphs are built
            objective, theta = self._objective(label, family, samples, theta)
        keeper = self.checkpoint.keeper(label)
        watch = Watch(self.monitor, label, keeper)
        try:
            result = solver.minimise(objective, theta, watch)
        except CheckpointError as error:  # the solver's own part of the state
            raise self.checkpoint.inconsistent(str(error)) from None
        if result.status is Status.INTERRUPTED:
            keeper.flush()
        if isinstance(objective, BoundedMutual) and not np.isfinite(result.value):
            if final:
                assert self.settings.max_mutual is not None
                raise missed_bound(label, self.settings.max_mutual, objective, result)
        else:
            result.raise_if_failed()
        stage = Stage(label, family.size, len(samples), result)
        self.checkpoint.add(stage)
        return stage

    def _objective(self, label: str, family: Family, samples: Samples, theta: Array | None) -> tuple[Objective, Array]:
        """The loss of a family on samples, and the start."""
        if not isinstance(family, LinearFamily):
            if self.settings.max_mutual is not None:
                raise InvalidValueError(
                    "max_mutual_deg",
                    f"given with {label}",
                    "a parametrisation linear in its parameters, such as polynomial",
                )
            self._require_graph_memory(label, family, len(samples))
            theta = family.initial(self.settings.seed) if theta is None else theta
            return GraphObjective(family, samples, self.settings.weights, theta, self._draw), theta
        fresh = theta is None
        theta = self._spectral_start(family, len(samples)) if theta is None else theta
        objective = BasisObjective(family, samples, self.settings.weights, theta, self._draw)
        if self.settings.max_mutual is None:
            return objective, theta
        fitted, all_pairs = len(pairs(family.outputs)), len(pairs(self.problem.r))
        if not fitted:
            raise InvalidValueError("max_mutual_deg", "given", "a problem with two or more coordinates to fit")
        # pairs with an idle joint are exactly orthogonal, so the other pairs may use their share
        bounded = BoundedMutual(objective, self.settings.max_mutual * (all_pairs / fitted) ** 0.5)
        if fresh:  # solve the weighted problem first: minima far from its own are worse
            weighted = replace(self.settings.weights, mutual=DEFAULT_WEIGHTS.mutual)
            theta = GaussNewton().minimise(objective.reweighted(weighted), theta).finished().theta
        return bounded, bounded.in_gauge(theta)

    def _spectral_start(self, family: LinearFamily, count: int) -> Array:
        """A start that does not depend on the seed: eigenvalues are close, so other samples would mix coordinates."""
        points = sample_evenly(self.problem.domain, count, _START_SEED)
        return spectral_start(family, samples_at(self.problem, points).restricted_to(self.active))

    def _draw(self, count: int, seed: tuple[int, ...]) -> Samples:
        return sample_problem(self.problem, count, (self.settings.seed, _FRESH, *seed)).restricted_to(self.active)

    def _sample_count(self, family: Family) -> int:
        if isinstance(family, LinearFamily):
            return self._linear_sample_count(family.width, family.outputs)
        return self.settings.samples or MLP_SAMPLES

    def _linear_sample_count(self, terms: int, r: int) -> int:
        """Number of samples for a linear family, so that there are about 140 residuals per coefficient."""
        return self.settings.samples or 1000 + ceil(140 * terms / (self.problem.m + r - 1))

    def _require_graph_memory(self, label: str, family: Family, count: int) -> None:
        """Refuse a network whose parameters and solver state exceed the memory."""
        require_memory(f"{label} with {family.size} parameters", 8.0 * (60 * family.size + 100 * count * self.space.n))

    def _require_memory(self, target: GradedParametrisation, r: int) -> None:
        """Refuse a degree that exceeds the memory, before building anything."""
        K = target.term_count(self.space.n)
        N = self._linear_sample_count(K, r)
        curvature = (self.space.n * r) ** 2 if self.settings.max_mutual is not None else 0
        needed = 8 * (N * (2 * self.space.n * K + 2 * curvature) + 4 * (r * K) ** 2)
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
