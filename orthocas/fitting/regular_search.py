"""Searches for coordinates that are regular on a whole branch of the joint range."""

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.bases.family import ArrayFamily, JointSpace, LinearFamily, Parametrisation
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import InvalidValueError
from orthocas.fitting.basis_gradients import BasisGradients, gradients_of
from orthocas.fitting.like import Like
from orthocas.fitting.meaning import Meaning, Wish, unit_self_motion
from orthocas.fitting.stages import Stage
from orthocas.fitting.volume_loss import LEAST_VOLUME, BasisField, BasisShortfall, Field, NetworkField, NetworkShortfall
from orthocas.solvers.adam import Adam
from orthocas.solvers.lbfgs import LBFGS
from orthocas.solvers.protocol import SolveResult
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import NEGLIGIBLE, sample_boundary_weighted, sample_uniform
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.progress import Monitor, Watch

_EVEN = 0.5  # share of samples that are uniform; the others are heavy near limits
_PER_TERM, _LEAST_SAMPLES, _MOST_SAMPLES = 30, 5000, 20_000
_NETWORK_SAMPLES = 100_000
JUDGED, JUDGED_TAG = 20_000, 3001  #: samples that judge, and their seed tag
_TAG, _UNIFORM_TAG, _MIDDLE_TAG = 3000, 1, 2  # seed tags of others; of uniform ones and the middle, within tags
_NEAR = 0.03  # share of samples of networks that lie near the middle, and of the half-widths there
_TARGET, _ITERATIONS = 0.5, 100  # of the first descent: the volume that is enough at a sample
_FURTHER_TARGET, _FURTHER = 0.3, 60  # of further ones, and of networks
_ROUNDS, _FRESH, _WORST, _FRESH_TAG = 3, 50_000, 5000, 3002  # further descents, each with the worst of fresh samples
_TOLERANCE, _RIDGE = 1e-6, 1e-8
_ADAM = Adam(epochs=8, steps=500, batch=512, learning_rate=1e-2)
_SLOWER = replace(_ADAM, learning_rate=5e-3)  # with the worst of more fresh samples
_FRESH_OF_NETWORKS, _WORST_OF_NETWORKS = 200_000, 30_000
_ENOUGH = 5e-4  # share of bad positions, many near limits, that is as good as none
_WELL = 0.28  # over r, volume of all but 1 % of positions that is enough; a conditioning of 0.2
_EVERY, _EVERY_OF_NETWORKS = 4, 50  # steps through samples, to those that give the mean lengths of gradients
_ALIKE = 0.01  # weight of the mean squared distance to gradients of quantities, with r > 1
_STILL = 1e-3  # change of a quantity for a unit self-motion


def beside_the_middle(problem: Problem, points: Array) -> NDArray[np.bool_]:
    """Whether points (N, n) are on the middle's side of singular positions, (N,), if r joints do not move the task."""
    q, task = np.vstack([problem.domain.centre, points]), problem.task
    J = task.batched_frame_jacobian(q)[0].reshape(len(q), task.m, problem.n)
    moving = np.abs(J).max(axis=(0, 1)) > NEGLIGIBLE * np.abs(J).max()
    if moving.sum() != task.m:
        return np.ones(len(points), bool)
    sides = np.linalg.det(J[:, :, moving]) > 0
    return np.asarray(sides[1:] == sides[0])


class Search(ABC):
    """A search for regular coordinates of a problem.

    Args:
        problem: the problem, on the clear part of a branch.
        parametrisation: the family.
        samples: their number; default: that of the kind of search.
        seed: their seed.
        monitor: called with progress.
    """

    solver: str  #: name of the minimiser, for the notes of the chart

    def __init__(
        self, problem: Problem, parametrisation: Parametrisation, samples: int, seed: int, monitor: Monitor
    ) -> None:
        self.problem, self.parametrisation, self.samples = problem, parametrisation, samples
        self.seed, self.monitor = seed, monitor
        self.best: Array | None = None  #: parameters
        #: of the best: whether they miss the middle, share of bad positions, if too many, and minus their 1 % volume
        self.rank = (True, np.inf, np.inf)
        self.stages: list[Stage] = []
        self._sense = 1.0  # of the volumes
        self._done = False  # whether coordinates are as regular as they need to be

    @abstractmethod
    def begin(self, name: str) -> None:
        """Look for coordinates, in a stage of some name."""

    @abstractmethod
    def go_on(self) -> None:
        """Make them better, if there is a way."""

    def coordinates(self, theta: Array) -> Coordinates:
        """Coordinates of parameters, not normalised."""
        r, space = self.problem.r, JointSpace.of(self.problem)
        return Coordinates(self.parametrisation, space, (), theta.ravel(), np.zeros(r), np.ones(r))

    @abstractmethod
    def _at(self, points: Array) -> Field:
        """Samples at points."""

    @cached_property
    def _middle(self) -> Field:
        """The centre of the domain."""
        return self._at(self.problem.domain.centre[None])

    @cached_property
    def _judged(self) -> Field:
        """Samples that judge."""
        return self._at(self._points(JUDGED, JUDGED_TAG))

    def _points(self, count: int, tag: int) -> Array:
        """Samples, half of them uniform like positions that count for the share, the others heavy near limits."""
        domain, even = self.problem.domain, int(_EVEN * count)
        uniform = sample_uniform(domain, even, (self.seed, tag, _UNIFORM_TAG))
        points = np.vstack([uniform, sample_boundary_weighted(domain, count - even, (self.seed, tag))])
        points = points[beside_the_middle(self.problem, points)]
        if not len(points):
            wanted = "more: none lies on the middle's side of singular positions"
            raise InvalidValueError("samples", count, wanted)
        return points

    def _take(self, name: str, result: SolveResult, theta: Array, samples: int) -> None:
        """Take the result of a stage, and keep its parameters if they are the best so far."""
        self.stages.append(Stage(name, result.theta.size, samples, replace(result, theta=theta.ravel())))
        bound = LEAST_VOLUME / self.problem.r
        middle, volumes = (self._sense * field.volumes(theta) for field in (self._middle, self._judged))
        missed, bad, low = bool(middle[0] <= bound), float(np.mean(volumes <= bound)), float(np.quantile(volumes, 0.01))
        rank = missed, max(bad, _ENOUGH), -low
        if self.best is None or rank < self.rank:
            self.best, self.rank = theta, rank
        self._done = bad <= _ENOUGH and low >= _WELL / self.problem.r
        result.finished()


class IdleSearch(Search):
    """No search: r joints that do not move the task are the coordinates, exact everywhere.

    Args:
        problem, parametrisation, seed, monitor: as in `Search`.
        idle: the joints.
    """

    solver = "none"

    def __init__(
        self, problem: Problem, parametrisation: Parametrisation, idle: tuple[int, ...], seed: int, monitor: Monitor
    ) -> None:
        super().__init__(problem, parametrisation, 0, seed, monitor)
        self._idle = idle
        self.best, self.rank = np.zeros(0), (False, 0.0, -1.0)

    def begin(self, name: str) -> None:
        """Nothing."""

    def go_on(self) -> None:
        """Nothing."""

    def coordinates(self, theta: Array) -> Coordinates:
        """The joints."""
        return Coordinates(self.parametrisation, JointSpace.of(self.problem), self._idle, theta, theta, theta)

    def _at(self, points: Array) -> Field:
        raise NotImplementedError


class BasisSearch(Search):
    """A search in a family that is linear in its parameters, which are coefficients C (r, K), with L-BFGS.

    Args:
        problem, parametrisation, samples, seed, monitor: as in `Search`; default: 30 samples for each function.
        meaning, quantities: what coordinates mean, if anything.
    """

    solver = "lbfgs"

    def __init__(
        self,
        problem: Problem,
        parametrisation: Parametrisation,
        samples: int | None,
        seed: int,
        monitor: Monitor,
        meaning: Meaning | None,
        quantities: Like | None,
    ) -> None:
        family = parametrisation.family(JointSpace.of(problem), problem.r)
        assert isinstance(family, LinearFamily)
        count = samples or int(np.clip(_PER_TERM * family.width, _LEAST_SAMPLES, _MOST_SAMPLES))
        super().__init__(problem, parametrisation, count, seed, monitor)
        self._family: LinearFamily = family
        self._meaning, self._quantities = meaning, quantities

    def begin(self, name: str) -> None:
        """Descend from coordinates that are linear, as far as the family has such, in a stage of some name."""
        self._fields = [self._at(self._points(self.samples, _TAG))]
        some = self._at(self._fields[0].points[::_EVERY])
        energy, K = some.energy(), self._family.width
        self._factor = np.linalg.cholesky(energy + _RIDGE * np.trace(energy) / K * np.eye(K))
        self._last = self._first(some)
        self._sense = 1.0 if self._middle.volumes(self._last)[0] > 0 else -1.0
        self._wishes = self._meant(some)
        self._descend(_TARGET, _ITERATIONS, name)

    def go_on(self) -> None:
        """Descend with the worst of fresh samples, as long as coordinates are not regular enough and get better."""
        for turn in range(1, 1 + _ROUNDS):
            if self._done or self._last is not self.best:
                return
            fresh = self._at(self._points(_FRESH, _FRESH_TAG + turn))
            worst = fresh.points[np.argsort(self._sense * fresh.volumes(self._last))[:_WORST]]
            self._fields.append(self._at(worst))
            self._descend(_FURTHER_TARGET, _FURTHER, f"worst samples, round {turn} of {_ROUNDS}")

    def _descend(self, target: float, limit: int, name: str) -> None:
        """Minimise from the last coefficients."""
        objective = BasisShortfall(self._fields, target, self._sense, self._factor, self._wishes, self._last)
        result = LBFGS(limit, _TOLERANCE).minimise(
            objective, objective.variables(self._last), Watch(self.monitor, name)
        )
        self._last = objective.coefficients(result.theta)
        self._take(name, result, self._last, sum(len(field.points) for field in self._fields))

    @cached_property
    def _basis(self) -> BasisGradients:  # not before this family is tried
        return gradients_of(self._family, self.problem.n)

    def _at(self, points: Array) -> BasisField:
        return BasisField(self.problem, points, self._basis)

    def _first(self, field: BasisField) -> Array:
        """Coefficients (r, K) of the functions nearest to a^T q, with orthonormal a across the task in the middle.

        The first ones are those of the gradients of quantities that coordinates are to be like.
        """
        problem, centre = self.problem, self.problem.domain.centre
        J = problem.task.batched_frame_jacobian(centre[None])[0].reshape(problem.m, problem.n)
        directions = scipy.linalg.null_space(J).T
        if self._quantities is not None:
            wanted = self._quantities.slopes(centre[None])[0] @ directions.T  # (k, r)
            Q, R = np.linalg.qr(np.vstack([wanted, np.eye(problem.r)]).T)
            directions = (Q * np.where(R.diagonal() < 0, -1.0, 1.0)).T @ directions
        if self._meaning is not None:
            directions = self._meaning.slope * unit_self_motion(problem, centre)[None]
        parts = [field.along(np.broadcast_to(a, field.points.shape)).mean(axis=0) for a in directions]
        return np.asarray(scipy.linalg.cho_solve((self._factor, True), np.array(parts).T).T)

    def _meant(self, field: BasisField) -> list[Wish]:
        """Terms of what coordinates mean."""
        if self._meaning is not None and self._meaning.wanted:
            return [self._meaning.wish(self._family)]
        return [] if self._quantities is None else _alike(self.problem, self._quantities, field)


class NetworkSearch(Search):
    """A search in a family of networks, with Adam.

    It takes longer than one in a basis, and gets farther where self-motions turn in many ways within one branch.

    Args:
        problem, parametrisation, samples, seed, monitor: as in `Search`; default: 100,000 samples.
    """

    solver = "adam"

    def __init__(
        self, problem: Problem, parametrisation: Parametrisation, samples: int | None, seed: int, monitor: Monitor
    ) -> None:
        super().__init__(problem, parametrisation, samples or _NETWORK_SAMPLES, seed, monitor)
        family = parametrisation.family(JointSpace.of(problem), problem.r)
        assert isinstance(family, ArrayFamily)
        self._family: ArrayFamily = family

    def begin(self, name: str) -> None:
        """Descend from a random network, in a stage of some name."""
        points = np.vstack([self._points(self.samples, _TAG), self._around_the_middle()])
        self._field, start = self._at(points), self._family.initial(self.seed)
        self._lengths = self._field.part(slice(None, None, _EVERY_OF_NETWORKS)).lengths(start)
        self._descend(_ADAM, start, name)

    def go_on(self) -> None:
        """Descend once more with the worst of fresh samples, if coordinates are not regular enough."""
        if self._done:
            return
        assert self.best is not None
        fresh = self._points(_FRESH_OF_NETWORKS, _FRESH_TAG)
        parts = np.array_split(fresh, -(-len(fresh) // JUDGED))  # matrices of all would take a gigabyte
        volumes = np.concatenate([self._sense * self._at(part).volumes(self.best) for part in parts])
        worst = fresh[np.argsort(volumes)[:_WORST_OF_NETWORKS]]
        self._field = self._at(np.vstack([self._field.points, worst]))
        self._descend(_SLOWER, self.best, "worst samples")

    def _around_the_middle(self) -> Array:
        """Clear samples near the centre of the domain, whose sign decides which part of it is kept."""
        domain = self.problem.domain
        near = Box(domain.centre, _NEAR * domain.half_width)
        points = sample_uniform(near, max(2, int(_NEAR * self.samples)), (self.seed, _TAG, _MIDDLE_TAG))
        return np.asarray(points[domain.contains(points)])

    def _descend(self, solver: Adam, start: Array, name: str) -> None:
        """Minimise from parameters."""
        objective = NetworkShortfall(self._field, _FURTHER_TARGET, self._sense, self._lengths)
        result = solver.minimise(objective, start, Watch(self.monitor, name))
        self._take(name, result, result.theta, len(self._field.points))

    def _at(self, points: Array) -> NetworkField:
        return NetworkField(self.problem, points, self._family)


def _alike(problem: Problem, quantities: Like, field: BasisField) -> list[Wish]:
    """Mean |Z^T (dxi_k/dq - g_k)|^2 over mean |Z^T g_k|^2 for quantities with gradients g_k, and a basis Z of ker J_x.

    Raises:
        InvalidValueError: if the task leaves nothing of a quantity, or what it leaves of some depends on the others.
    """
    N, task = len(field.points), problem.task
    J = task.batched_frame_jacobian(field.points)[0].reshape(N, task.m, problem.n)
    Z, slopes = np.linalg.svd(J)[2][:, task.m :], quantities.slopes(field.points)
    left = np.einsum("sji,ski->skj", Z, slopes)
    gram = np.einsum("ski,sli->kl", left, left) / N
    squares = gram.diagonal()
    moving = (squares > _STILL**2 * (slopes**2).sum(axis=2).max(axis=0)).all()
    if not moving or np.linalg.eigvalsh(gram / np.sqrt(np.outer(squares, squares)))[0] < _STILL**2:
        raise InvalidValueError("like", "quantities that the task leaves nothing of", "others, or another task")
    parts = [field.along(Z[:, j]) for j in range(problem.r)]
    E = sum((part.T @ part for part in parts), start=np.zeros(())) / N
    pulls = sum((part.T @ left[:, :, j] for j, part in enumerate(parts)), start=np.zeros(())) / N
    return [Wish(_ALIKE / a * E, _ALIKE / a * pulls[:, k], _ALIKE) for k, a in enumerate(squares)]
