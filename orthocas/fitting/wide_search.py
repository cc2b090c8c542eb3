"""The stages of a wide fit: one descent in each family, then rounds with the worst samples in the best family."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.bases.family import ArrayFamily, CombinableFamily, JointSpace, LinearFamily, Parametrisation
from orthocas.bases.mlp import MLP
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import InvalidValueError
from orthocas.fitting.basis_objective import BasisGradients, BasisObjective, build_gradients
from orthocas.fitting.combined import Resampled, WeightedSum
from orthocas.fitting.like import Like, QuadraticTerm
from orthocas.fitting.network_objective import ArrayObjective, GraphObjective
from orthocas.fitting.stages import Stage
from orthocas.fitting.terms import RULES as LOSS
from orthocas.fitting.terms import Weights, find_least_volume
from orthocas.robots.collisions import Collisions
from orthocas.solvers.minimisers import LBFGS, Adam
from orthocas.solvers.protocol import Objective, Solver, SolveResult
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import NEGLIGIBLE, Samples, sample_boundary_weighted, sample_uniform
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred
from orthocas.tools.progress import Monitor, Watch, silent

_NETWORK = MLP((64, 64, 64), raw=True, activation="isru")
_SMALL_NETWORK = MLP((24, 24, 24), raw=True, activation="isru")


@dataclass(frozen=True, slots=True)
class WideRules:
    """Numbers of wide fits. Chosen on iiwa and panda, held on eight arms."""

    clearance: float = 0.1  #: default least relative singular value of the task
    degree: int = 6  #: of polynomials that are linear in base and tool joints
    degree_of_all: int = 5  #: of polynomials that are linear in none of these joints
    network: MLP = _NETWORK  #: for branches of which polynomials leave out much
    small_network: MLP = _SMALL_NETWORK  #: of coordinates that do not depend on some of the joints

    alignment: float = 0.3  #: weight of the mean sin^2 of the leaks
    alignment_in_metric: float = 1.0  #: the same in another metric than the identity
    closer: float = 4.0  #: factor of this weight in a last descent, once coordinates are regular enough
    closer_of_several: float = 2.0  #: the same with r > 1
    mutual: float = 0.15  #: weight of the mean cos^2 between gradients of different coordinates
    evenness: float = 0.03  #: weight of the mean squared logarithm of the lengths of gradients
    uniform: float = 0.5  #: fraction of samples that are uniform; the others are boundary-weighted
    uniform_of_networks: float = 0.7  #: the same of networks
    per_term: int = 30  #: samples for each basis function
    least_samples: int = 5000
    most_samples: int = 20_000
    network_samples: int = 100_000
    small_network_samples: int = 50_000  #: of networks that leave out joints
    near: float = 0.03  #: fraction of samples of networks that lie near the centre, and of the half-widths there
    watched: int = 5000  #: samples on which the loss of a network is watched

    iterations: int = 100  #: of the first descent
    further: int = 60  #: iterations of each round with the worst samples
    tolerance: float = 1e-6  #: of L-BFGS
    ridge: float = 1e-8  #: of the matrix of mean products of gradients, relative
    every: int = 4  #: every fourth sample is used for this matrix
    every_of_networks: int = 50  #: every 50th sample is used for the mean lengths of gradients of networks
    rounds: int = 3  #: with the worst samples
    rounds_of_networks: int = 1  #: the same of networks, which take long
    rounds_of_small_networks: int = 3
    fresh: int = 50_000  #: samples of which the worst join
    worst: int = 5000
    fresh_of_networks: int = 200_000
    worst_of_networks: int = 10_000
    fresh_of_small_networks: int = 100_000
    worst_of_small_networks: int = 8000

    divided: float = 0.9  #: regular share below which a smaller box is tried, if the branch has a singular centre
    held_out: int = 20_000  #: samples that evaluate coordinates
    enough: float = 5e-4  #: fraction of bad positions that counts as none; many of them are near limits
    well: float = 0.28  #: over r: volume that all but 1 % of positions should reach, for a conditioning of 0.2
    poor: float = 1e-3  #: fraction of bad positions above which another family is tried
    poor_of_several: float = 4e-3  #: the same with r > 1
    poor_without_turns: float = 3e-3  #: the same, after all rounds, of coordinates that leave out tool and base joints
    poor_without_tool: float = 6e-3  #: the same of coordinates that leave out the tool's joint only
    hopeless: float = 0.1  #: fraction above which no family that leaves out the tool's joint can be regular enough
    very_poor: float = 2e-2  #: fraction above which a network is tried before polynomials in all joints
    still_poor: float = 6e-3  #: fraction above which a network is tried after polynomials in all joints

    bounded: int = 2000  #: positions whose mean bounds the leak
    bounded_tag: int = 3004  #: their seed tag
    first: int = 200  #: samples that scale coordinates
    first_tag: int = 1000  #: their seed tag
    tag: int = 3000  #: seed tag of the samples of a descent
    uniform_tag: int = 1  #: of uniform samples, within tags
    centre_tag: int = 2  #: of samples near the centre, within tags
    held_out_tag: int = 3001
    fresh_tag: int = 3002
    counted_tag: int = 3003  #: of the positions of the branch that count for its share


RULES = WideRules()
_ADAM = Adam(epochs=8, steps=500, batch=512, learning_rate=1e-2)
# Adam for rounds with the worst samples
_SLOWER = replace(_ADAM, learning_rate=5e-3)
_SLOWER_OF_SMALL = replace(_SLOWER, epochs=5)
# Names of first stages begin with this
_STAGE = "whole branch"


@dataclass(frozen=True, eq=False)
class WideSettings:
    """Settings of a wide fit, apart from the problem and the families."""

    samples: int | None = None  #: default: by the kind of family
    seed: int = 0
    monitor: Monitor = silent
    weights: Weights | Mapping[str, float] | None = None  #: of additional terms; `Weights` also replace those of angles
    quantities: Like | None = None  #: what the first coordinates follow
    collisions: Collisions | None = None  #: samples in collision are left out


@dataclass(frozen=True, eq=False)
class WideSolution:
    """Coordinates of one family, and how they were found."""

    problem: Problem
    coordinates: Coordinates  #: not normalised
    solver: str  #: name of the minimiser, for the notes of the chart
    samples: int
    stages: tuple[Stage, ...]
    misses_centre: bool = False  #: whether coordinates fold at the centre, or have another sign there than elsewhere


def search_families(searches: Sequence["Search"]) -> "Search":
    """Fit families one by one, and improve the best one in rounds with its worst samples.

    Families that leave out joints come first. One of them is the result if its coordinates are regular on nearly all of
    the branch. Otherwise the first of the other families is fitted and, if that is poor, those that follow it; then the
    best of all is improved.
    """
    symmetric = [search for search in searches if search.left_out]
    hopeless = False
    for search in symmetric:
        search.begin(f"{_STAGE}, {search.parametrisation.label}")
        most = RULES.poor_without_turns if len(search.left_out) > 1 else RULES.poor_without_tool
        # Rounds divide the fraction of bad positions by four, or by two if both tool and base are left out: they are
        # worth while if that could be enough
        if search.is_enough(4 / len(search.left_out) * most):
            search.go_on()
        if search.is_enough(most) or len(searches) == 1:
            return search
        hopeless = search.rank[1] > RULES.hopeless
    first, *others = searches[len(symmetric) :]
    # If those were hopeless, polynomials that are linear in base and tool joints are as bad: skip them for a network
    if not hopeless or all(search.linear for search in others):
        first.begin(_STAGE)
    missed, bad, _ = first.rank
    if missed or bad > (RULES.poor if first.problem.r == 1 else RULES.poor_of_several):
        networks = [search for search in others if not search.linear]
        polynomials = [search for search in others if search.linear]
        for search in (*networks, *polynomials) if bad > RULES.very_poor else (*polynomials, *networks):
            search.begin(f"{_STAGE}, all joints" if search.linear else f"{_STAGE}, network")
            missed, bad, _ = search.rank
            if not missed and (not search.linear or bad <= RULES.still_poor):
                break
    best = find_best(searches)
    best.go_on()
    return best


def list_left_out(family: Parametrisation | None) -> tuple[str, ...]:
    """Names of the joints that coordinates of a family do not depend on."""
    return getattr(family, "without", ())


def find_best(searches: Sequence["Search"]) -> "Search":
    """The search with the best coordinates so far."""
    return min((search for search in searches if search.best is not None), key=lambda search: search.rank)


class Search:
    """A search for regular coordinates of one family on the nonsingular part of a branch.

    It minimises::

        L = mean_q [ max(0, 1 - v(q) / t)^2 + a mean_j sin^2 leak_j(q) + 0.15 mean_jk cos^2(j, k)
                     + 0.03 sum_j log^2(l_j(q) / L_j) ] + meaning

    Symbols are those of `orthocas.fit_wide`. a is 0.3 in the identity metric and 1 in others; a last descent takes four
    times as much, or twice with r > 1. Terms of the user are added. Families that are linear in their parameters
    descend with L-BFGS from linear coordinates, in variables for which the mean products of basis gradients are the
    identity matrix. All others descend with Adam from a random start.

    Args:
        problem: the problem, on the nonsingular part of a branch.
        parametrisation: the family.
        settings: all other settings.
    """

    def __init__(self, problem: Problem, parametrisation: Parametrisation, settings: WideSettings) -> None:
        self.problem, self.parametrisation, self.settings = problem, parametrisation, settings
        self.family = parametrisation.family(JointSpace.of(problem), problem.r)
        self.linear = isinstance(self.family, LinearFamily)
        #: names of joints that coordinates do not depend on
        self.left_out = list_left_out(parametrisation)
        wide = int(np.clip(RULES.per_term * self.family.width, RULES.least_samples, RULES.most_samples))
        of_networks = RULES.small_network_samples if self.left_out else RULES.network_samples
        self.samples = settings.samples or (wide if self.linear else of_networks)
        self.solver: Solver = LBFGS(RULES.iterations, RULES.tolerance) if self.linear else self._of_batch(_ADAM)
        self.best: Array | None = None  #: parameters, (size,)
        #: of `best`: whether they miss the centre; fraction of bad positions, at least 5e-4; minus their 1 % volume
        self.rank = (True, np.inf, np.inf)
        self.stages: list[Stage] = []
        self._alignment = RULES.alignment if problem.metric.is_identity else RULES.alignment_in_metric
        self._objectives: list[BasisObjective] = []
        self._sign = 1.0  # of the volumes
        # `_done`: coordinates are as regular as they need to be. `_finished`: all rounds have been made
        self._done = self._finished = False

    def begin(self, name: str) -> None:
        """Draw samples, choose a start, and run the first stage under this name."""
        points = self.sample(self.samples, RULES.tag)
        if self.linear:
            self._samples = [sample_frames(self.problem, points)]
            self._last = self._start_linear()
            self._sign = 1.0 if self._evaluate_volumes(self._last, self._centre)[0] > 0 else -1.0
            self._descend(name, "volume", self.solver)
        else:
            # Add samples near the centre, because the sign of the volume there decides which part of the domain is kept
            problem, domain, count = self.problem, self.problem.domain, max(2, int(RULES.near * self.samples))
            seed = self.settings.seed, RULES.tag, RULES.centre_tag
            near = sample_uniform(Box(domain.home, RULES.near * domain.half_width), count, seed)
            self._samples = [sample_frames(problem, np.vstack([points, near[domain.contains(near)]]))]
            if problem.metric.is_identity or problem.r > 1 or self.left_out:
                # A random start; gradients are scaled to length 1 in the mean if the family permits that
                self._last, some = self.family.initial(self.settings.seed), self._samples[0][:: RULES.every_of_networks]
                if isinstance(self.family, CombinableFamily):
                    J = self.coordinates(self._last).jacobian(some.points)
                    lengths = np.sqrt(np.einsum("srn,srn->sr", J, some.compute_metric_gradients(J)).mean(axis=0))
                    self._last = self.family.combined(self._last, np.diag(1 / lengths))
            else:
                # Networks of all joints start from those of A = I: from a random start, some would stay folded
                plain = Problem(problem.robot, problem.task, "euclidean", problem.domain, problem.name)
                leader = Search(plain, self.parametrisation, self.settings)
                leader.begin(f"{name}, A = I")
                self._last, self.stages = leader._last, leader.stages
            self._descend(name, "volume with the worst", self.solver)

    def go_on(self) -> None:
        """Run rounds with the worst samples, then a descent for smaller leaks if coordinates are regular enough.

        Rounds end when coordinates are regular enough, or do not get better.
        """
        if self._finished:
            return
        self._finished = True
        of_networks = RULES.rounds_of_small_networks if self.left_out else RULES.rounds_of_networks
        for turn in range(1, 1 + (RULES.rounds if self.linear else of_networks)):
            few = turn > 1 and not self.linear and self.is_enough(RULES.enough)
            if self._done or few or self._last is not self.best:
                break
            if self.linear:
                self._add_worst(RULES.fresh, RULES.worst, RULES.fresh_tag + turn)
                solver: Solver = LBFGS(RULES.further, RULES.tolerance)
            elif self.left_out:
                self._add_worst(RULES.fresh_of_small_networks, RULES.worst_of_small_networks, RULES.fresh_tag + turn)
                solver = self._of_batch(_SLOWER_OF_SMALL)
            else:
                self._add_worst(RULES.fresh_of_networks, RULES.worst_of_networks, RULES.fresh_tag + turn)
                solver = _SLOWER
            self._descend(f"worst samples, round {turn}", "volume with the worst", solver)
        # Reduce leaks in a last descent, unless the user chose the weights; keep its result if it is regular enough
        balanced = self.settings.weights or self.settings.quantities
        finished = self._done if self.linear else self.left_out and self.is_enough(RULES.enough)
        if finished and self._last is self.best and not balanced:
            self._alignment *= RULES.closer if self.problem.r == 1 else RULES.closer_of_several
            first = self.linear and len(self._samples) == 1
            solver = LBFGS(RULES.further, RULES.tolerance) if self.linear else self._of_batch(_SLOWER_OF_SMALL)
            rank = self._descend("smaller leaks", "volume" if first else "volume with the worst", solver)
            if self._done or (not self.linear and not rank[0] and rank[1] <= RULES.enough):
                self.best, self.rank = self._last, rank

    def _of_batch(self, solver: Adam) -> Adam:
        """The solver with its batch size: half as many samples are enough for small networks."""
        return replace(solver, batch=solver.batch // 2) if self.left_out else solver

    def is_enough(self, bad: float) -> bool:
        """Whether the best coordinates are regular at the centre, and at all but a fraction `bad` of samples."""
        return not self.rank[0] and self.rank[1] <= bad

    @property
    def solution(self) -> WideSolution:
        """The best coordinates so far."""
        assert self.best is not None
        coordinates, stages = self.coordinates(self.best), tuple(self.stages)
        return WideSolution(self.problem, coordinates, self.solver.name, self.samples, stages, self.rank[0])

    def coordinates(self, theta: Array) -> Coordinates:
        """Coordinates of parameters (size,), not normalised."""
        r, space = self.problem.r, JointSpace.of(self.problem)
        return Coordinates(self.parametrisation, space, (), theta, np.zeros(r), np.ones(r))

    def sample(self, count: int, tag: int) -> Array:
        """Draw up to `count` positions of the domain: some uniform, the others boundary-weighted."""
        domain, seed = self.problem.domain, self.settings.seed
        even = int((RULES.uniform if self.linear else RULES.uniform_of_networks) * count)
        uniform = sample_uniform(domain, even, (seed, tag, RULES.uniform_tag))
        points = np.vstack([uniform, sample_boundary_weighted(domain, count - even, (seed, tag))])
        points = points[is_on_side_of_centre(self.problem, points)]
        if not len(points):
            raise InvalidValueError(
                "samples", count, "more samples: all lie beyond singular positions, seen from the centre"
            )
        if self.settings.collisions is not None:
            points = points[self.settings.collisions.check_free(points)]
            if not len(points):
                raise InvalidValueError(
                    "collisions", "a contact at all samples of the branch", "a branch with free postures"
                )
        return points

    def _start_linear(self) -> Array:
        """Parameters (size,) of functions close to a^T q, with orthonormal a across the task at the centre.

        Quantities to follow determine the first a.
        """
        problem, some = self.problem, self._samples[0][:: RULES.every]
        X = self._basis.at(some.points)
        # Mean of dpsi_i/dq A^-1 dpsi_j/dq, (K, K)
        inverse = np.eye(problem.n)[None] if some.metric_inverse is None else some.metric_inverse
        root = np.broadcast_to(np.linalg.cholesky(inverse), (len(some), problem.n, problem.n))
        parts = (self._basis.differentiate_along(X, root[:, :, i]) for i in range(problem.n))
        energy = sum((G.T @ G for G in parts), start=np.zeros(())) / len(some)
        self._factor = np.linalg.cholesky(energy + RULES.ridge * np.trace(energy) / len(energy) * np.eye(len(energy)))
        # Directions a across the task at the centre. Quantities to follow choose the first ones
        directions = scipy.linalg.null_space(self._centre.task_jacobian[0]).T
        quantities, self._likeness = self.settings.quantities, list[QuadraticTerm]()
        if quantities is not None:
            directions = quantities.choose_directions(some, self._centre)
            self._likeness = quantities.hold(some, lambda a: self._basis.differentiate_along(X, a))
        # Combinations of basis functions whose gradients are nearest to the directions in the mean
        sides = [
            self._basis.differentiate_along(X, np.broadcast_to(a, some.points.shape)).mean(axis=0) for a in directions
        ]
        C = scipy.linalg.cho_solve((self._factor, True), np.array(sides).T).T
        # Scale coordinates that follow quantities to gradients as long as those of the quantities
        for k, (E, _, a) in enumerate(self._likeness):
            C[k] *= np.sqrt(a / (C[k] @ E @ C[k]))
        return np.asarray(C.ravel())

    def _add_worst(self, fresh: int, worst: int, tag: int) -> None:
        """Add the `worst` of `fresh` samples, at which the last coordinates have the least volumes."""
        points = self.sample(fresh, tag)
        # Take parts, because matrices of all samples would take a gigabyte
        parts = np.array_split(points, -(-fresh // RULES.held_out))
        frames = (sample_plain_frames(self.problem, part) for part in parts)
        volumes = np.concatenate([self._sign * self._evaluate_volumes(self._last, part) for part in frames])
        self._samples.append(sample_frames(self.problem, points[np.argsort(volumes)[:worst]]))

    def _descend(self, name: str, volume: str, solver: Solver) -> tuple[bool, float, float]:
        """Minimise from the last parameters, and keep the result if it is the best so far; returns its rank."""
        count = sum(len(samples) for samples in self._samples)
        with one_blas_thread():
            if self.linear:
                with deferred():
                    objective = self._build_in_basis(volume)
                start = objective.variables(self._last)
                result = solver.minimise(objective, start, Watch(self.settings.monitor, name))
                self._last = objective.parameters(result.theta)
            else:
                # The loss of any other family, on batches drawn from all samples so far
                samples = join_samples(self._samples)
                self._samples = [samples]
                watched = np.arange(0, count, max(1, count // RULES.watched))
                with deferred():
                    common = samples, self._choose_weights(volume), self._last, self._draw
                    whole: ArrayObjective | GraphObjective
                    if isinstance(self.family, ArrayFamily):
                        whole = ArrayObjective(self.family, *common, single=True, orientation=self._sign)
                    else:
                        whole = GraphObjective(self.family, *common, orientation=self._sign)
                    resampled = Resampled(whole, watched, count)
                result = solver.minimise(resampled, self._last, Watch(self.settings.monitor, name))
                self._last = result.theta
        return self._take(name, replace(result, theta=self._last), count)

    def _weigh_regularity(self, volume: str) -> dict[str, float]:
        """Weights of the terms that keep coordinates regular; `volume` is the name of the volume term.

        Weights are twice the factors of the loss, because terms add weight |rho|^2 / 2.
        """
        target = LOSS.wide_volume if volume == "volume" else LOSS.worst_volume
        weights = {volume: 2 / target**2, "metric length": 2 * RULES.evenness}
        if not self.problem.metric.is_identity:
            weights["euclidean volume"] = 2 / (LOSS.beyond * find_least_volume(self.problem)) ** 2
        return weights

    def _choose_weights(self, volume: str) -> Weights:
        """Weights of all terms. If the user gives `Weights`, these replace the weights of the angles."""
        own, users = self._weigh_regularity(volume), self.settings.weights
        if not isinstance(users, Weights):
            # Coordinates that follow quantities take over their mutual angles
            mutual = RULES.mutual if self.settings.quantities is None else 0.0
            angles = 2 * self.problem.m * self._alignment, 2 * mutual
            users = Weights(*angles, 0.0, 0.0, 0.0, dict(users or {}), "metric")
        users = replace(users, folds=0.0, extra={**own, **users.extra}).for_problem(self.problem)
        if self.problem.r > 1 or users.angles == "paper":
            return users
        # With r = 1, the term with the self-motion gives the same leak with less work
        return replace(users, task=0.0, extra={**users.extra, "self-motion": users.task / self.problem.m})

    def _build_in_basis(self, volume: str) -> "Orthonormal":
        """The loss of a family that is linear in its parameters, on all samples so far.

        All terms act at the first samples. At the worst ones, only those that keep coordinates regular do.
        """
        weights = self._choose_weights(volume)
        assert isinstance(self.family, LinearFamily)
        # Mean lengths of the gradients where this descent begins
        lengths = np.linalg.norm(self._last.reshape(self.problem.r, -1) @ self._factor, axis=1)
        # The first samples have all terms
        if self._objectives:
            self._objectives[0] = self._objectives[0].reweigh(weights)
        else:
            common = self.family, self._samples[0], weights, self._last, self._draw
            self._objectives.append(BasisObjective(*common, gradients=self._basis, orientation=self._sign))
        # Objectives of the worst samples that were added since
        for samples in self._samples[len(self._objectives) :]:
            self._objectives.append(self._objectives[0].elsewhere(samples, self._weigh_regularity(volume)))
        # The loss is the mean over all samples
        count = sum(len(samples) for samples in self._samples)
        parts: list[tuple[float, Objective]] = [
            (len(samples) / count, objective)
            for samples, objective in zip(self._samples, self._objectives, strict=True)
        ]
        if self._likeness:
            parts.append((1.0, Likenesses(self._likeness, lengths)))
        return Orthonormal(WeightedSum(parts), self._factor, lengths)

    def _draw(self, count: int, seed: tuple[int, ...]) -> Samples:
        points = sample_uniform(self.problem.domain, count, (self.settings.seed, RULES.tag, *seed))
        return sample_frames(self.problem, points)

    def _take(self, name: str, result: SolveResult, samples: int) -> tuple[bool, float, float]:
        """Record a stage, keep its parameters if they are the best so far, and return their rank."""
        theta, bound = result.theta, find_least_volume(self.problem)
        self.stages.append(Stage(name, theta.size, samples, result))
        # Volumes at the centre and at held-out samples
        at_centre, volumes = (
            self._sign * self._evaluate_volumes(theta, samples) for samples in (self._centre, self._held_out)
        )
        missed, bad = bool(at_centre[0] <= bound), float(np.mean(volumes <= bound))
        low = float(np.quantile(volumes, 0.01))
        rank = missed, max(bad, RULES.enough), -low
        if self.best is None or rank < self.rank:
            self.best, self.rank = theta, rank
        self._done = not missed and bad <= RULES.enough and low >= RULES.well / self.problem.r
        result.require_finished()
        return rank

    def _evaluate_volumes(self, theta: Array, samples: Samples) -> Array:
        """The volumes (N,) of `RegularPart`, in the identity metric, at samples of `sample_plain_frames`."""
        if self.linear:
            C = theta.reshape(self.problem.r, -1)
            J = self._basis.jacobian(self._basis.at(samples.points), C, len(samples))
        else:
            J = self.coordinates(theta).jacobian(samples.points)
        # det of orthonormal task rows and unit gradients, computed with a basis across the task
        unit = J / np.maximum(np.linalg.norm(J, axis=2, keepdims=True), LOSS.shortest)
        return np.asarray(np.linalg.det(unit @ samples.null_basis))

    @cached_property
    # Built on first use, because not every family is tried
    def _basis(self) -> BasisGradients:
        assert isinstance(self.family, LinearFamily)
        return build_gradients(self.family, self.problem.n)

    @cached_property
    def _centre(self) -> Samples:
        """The centre of the domain as a sample."""
        return sample_plain_frames(self.problem, self.problem.domain.home[None])

    @cached_property
    def _held_out(self) -> Samples:
        """Samples that evaluate coordinates."""
        return sample_plain_frames(self.problem, self.sample(RULES.held_out, RULES.held_out_tag))


def is_on_side_of_centre(problem: Problem, points: Array) -> NDArray[np.bool_]:
    """Whether points (N, n) are on the centre's side of singular positions, (N,).

    Sides are known if exactly m joints move the task: the sign of det of their columns tells them. Otherwise all True.
    """
    q, task = np.vstack([problem.domain.home, points]), problem.task
    J = task.batched_frame_jacobian(q)[0].reshape(len(q), task.m, problem.n)
    moving = np.abs(J).max(axis=(0, 1)) > NEGLIGIBLE * np.abs(J).max()
    if moving.sum() != task.m:
        return np.ones(len(points), bool)
    sides = np.linalg.det(J[:, :, moving]) > 0
    return np.asarray(sides[1:] == sides[0])


def sample_frames(problem: Problem, points: Array) -> Samples:
    """Samples with the frame Jacobian, which has no singularity at half a turn of the tool."""
    frames = sample_plain_frames(problem, points)
    if problem.metric.is_identity:
        return frames
    return Samples(points, frames.task_jacobian, np.asarray(np.linalg.inv(problem.metric.evaluate(points))))


def sample_plain_frames(problem: Problem, points: Array) -> Samples:
    """Samples with the frame Jacobian in the identity metric, in which regularity is measured."""
    J = problem.task.batched_frame_jacobian(points)[0].reshape(len(points), problem.task.m, problem.n)
    return Samples(points, J, None)


def join_samples(parts: Sequence[Samples]) -> Samples:
    """Several sets of samples as one."""
    inverses = [part.metric_inverse for part in parts if part.metric_inverse is not None]
    return Samples(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.task_jacobian for part in parts]),
        np.concatenate(inverses) if inverses else None,
    )


@dataclass(frozen=True, eq=False)
class Likenesses:
    """The sum of the terms of quantities, as a function of coefficients that are divided by mean gradient lengths."""

    terms: Sequence[QuadraticTerm]
    lengths: Array  #: lengths that the coefficients are divided by, (r,)

    def value(self, theta: Array) -> float:
        """The sum of the terms."""
        return self.value_and_gradient(theta)[0]

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The sum of the terms, and its derivative (size,)."""
        C, value = theta.reshape(len(self.lengths), -1), 0.0
        slopes = np.zeros(C.shape)
        for k, (E, g, a) in enumerate(self.terms):
            c, pull = self.lengths[k] * C[k], E @ (self.lengths[k] * C[k])
            value += float(c @ pull - 2 * g @ c + a)
            slopes[k] = 2 * self.lengths[k] * (pull - g)
        return value, slopes.ravel()


@dataclass(frozen=True, eq=False)
class Orthonormal:
    """A loss of coefficients C (r, K) in variables Y for which mean products of basis gradients are the identity.

    Y = diag(1 / lengths) C L, where L L^T is the mean of products of basis gradients. The loss is evaluated at
    diag(1 / lengths) C, whose gradients have a mean length of 1 where the descent begins.
    """

    loss: Objective
    factor: Array  #: L, lower triangular, (K, K)
    lengths: Array  #: (r,)

    def variables(self, theta: Array) -> Array:
        """Variables (size,) that belong to coefficients (size,)."""
        C = theta.reshape(len(self.lengths), -1)
        return np.asarray((C @ self.factor / self.lengths[:, None]).ravel())

    def parameters(self, variables: Array) -> Array:
        """Coefficients (size,) that belong to variables (size,)."""
        return np.asarray((self._coefficients(variables) * self.lengths[:, None]).ravel())

    def value(self, variables: Array) -> float:
        """The loss."""
        return self.value_and_gradient(variables)[0]

    def value_and_gradient(self, variables: Array) -> tuple[float, Array]:
        """The loss and its derivative, (size,)."""
        value, slopes = self.loss.value_and_gradient(self._coefficients(variables).ravel())
        columns = slopes.reshape(len(self.lengths), -1).T
        # Do not check for NaN here: the solver reports it
        solved = scipy.linalg.solve_triangular(self.factor, columns, lower=True, check_finite=False)
        return value, np.asarray(solved).T.ravel()

    def _coefficients(self, variables: Array) -> Array:
        columns = variables.reshape(len(self.lengths), -1).T
        solved = scipy.linalg.solve_triangular(self.factor, columns, lower=True, trans="T", check_finite=False)
        return np.asarray(solved.T)
