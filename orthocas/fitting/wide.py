"""Wide charts: coordinates that are regular on a whole branch of the joint range."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.bases.cyclic import leaves_stay, over_cyclic_joints
from orthocas.bases.family import (
    CyclicParametrisation,
    GradedFamily,
    GradedParametrisation,
    JointSpace,
    LinearFamily,
    Parametrisation,
)
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import worst_points
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import DomainError, Interrupted, InvalidValueError, RobotError
from orthocas.fitting.basis_gradients import BasisGradients, gradients_of
from orthocas.fitting.checkpoint import Stage
from orthocas.fitting.fit import Fit, fit, in_gauge, normalised
from orthocas.fitting.like import SWIVEL, Quantity, quantity_of
from orthocas.fitting.settings import require_parametrisation
from orthocas.robots.robot import Robot
from orthocas.robots.tree import require_driven
from orthocas.solvers.protocol import SolveResult, Status
from orthocas.tasks.branches import Branch, Branches, branches
from orthocas.tasks.domains import Box, sample_evenly, sample_heavily, sample_uniform
from orthocas.tasks.metric import Metric, MetricSpec, metric_matrices
from orthocas.tasks.problem import Problem, check, relative_singular_values
from orthocas.tasks.regular_box import home_posture
from orthocas.tasks.samples import sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array, as_number, require_count, require_kind
from orthocas.tools.interrupts import remembered
from orthocas.tools.progress import Monitor, Progress, silent

CLEARANCE = 0.1  #: default least relative singular value
LEAST_VOLUME = 0.05  #: over r, of the coordinates in domains of wide charts; see `RegularPart`
DEGREE = 6
_PER_TERM, _LEAST_SAMPLES, _MOST_SAMPLES = 40, 5000, 40_000
_TAG, _JUDGED_TAG, _FIRST_TAG = 3000, 3001, 1000  # seed tags; other samples use other ones
_FIRST = 200  # samples that scale coordinates
_JUDGED = 20_000
_PIECE = 1000  # samples whose gradients of all functions are in memory at once
_SMOOTH = (0.3, 0.1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4)  # weights of the mean squared gradient
_ENOUGH = 5e-4  # share of bad positions, many near limits, at which more smoothness is worth more
_ROUNDS, _ADDED = 2, 5.0  # rounds with worst points, and the weight of each of these
_EVERY = 4  # samples whose gradients count as long
_TINY = 1e-12  # length of a row
_NEWTON_STEPS, _GAIN, _RIDGE = 50, 1e-7, 1e-10
_MEANT = 100.0  # weight of the mean squared error of a meaning, relative to the slope
_STEP, _MOST_STEPS, _FEWEST = 0.02, 400, 5  # of unit self-motions, along which a meaning is taken
_STILL = 1e-3  # change of a quantity for a unit self-motion
_START = 3  # degree of the start, if there are several coordinates
_START_WEIGHTS = (100.0, 3.0, 1000.0, 0.0, 10_000.0)
_MIDDLES, _CLEARER = 20_000, 1.5  # positions that may be the middle of a domain, and their clearance over the bound


@dataclass(frozen=True, eq=False, repr=False)
class WideFit(Fit):
    """A chart of a branch, and how it was found."""

    branch: Branch | None = None  #: the branch of the chart
    regular_share: float = float(
        "nan"
    )  #: of the branch's clear positions, the share in the chart's domain, from 20,000 samples

    def facts(self) -> dict[str, str]:
        """The facts of a fit, with branch and regular share."""
        known = super().facts()
        branch = "" if self.branch is None else self.branch.name
        own = {
            "branch": branch,
            "regular": f"{self.regular_share:.3%} of the branch's clear positions; the domain is this part",
        }
        return {"fit": known.pop("fit"), "problem": known.pop("problem"), **own, **known}


def fit_wide(
    robot: Robot,
    task: Task,
    branch: Branch | Box | str | None = None,
    metric: Metric | MetricSpec = "euclidean",
    *,
    clearance: float = CLEARANCE,
    parametrisation: Parametrisation | None = None,
    home: ArrayLike | str | None = None,
    like: Quantity | str | None = None,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
) -> WideFit:
    """Find coordinates that are regular on a whole branch of the joint range, and as orthogonal as that permits.

    Let z(q), with z^T A z = 1, be the direction of the self-motion; with r > 1, of the self-motion along which the
    other coordinates stay. A coordinate is regular if and only if dxi/dq . z > 0 everywhere, which is linear in its
    coefficients. So the fit solves a convex problem, the least

        mean max(0, 1 - dxi/dq . z)^2 + s mean |dxi/dq|^2_A^-1

    over boundary-heavy samples of the branch that are clear of singular positions, by Newton's method. The second mean
    is least where gradients point along z, that is where coordinates are orthogonal to the task and to each other. Its
    weight s is the largest of seven with which all but 0.05 % of other samples are regular; if there is none, worst
    points are searched and join the samples. With r > 1 the problem is solved for one coordinate after the other, from
    a fit of degree 3. The domain of the chart is the part of the branch where coordinates are regular with a margin,
    see `RegularPart`.

    Wide charts hold on most of what the arm reaches without passing a singular position (`regular_share`), but their
    leaks are large, 20 to 70 degrees on the arms that were measured. They serve inverse kinematics, closed loops,
    trackers and laws with the whole inertia; see `fit` for decoupled control. That det J keeps its sign does not mean
    that phi is one-to-one.

    Args:
        robot: the robot.
        task: a task of that robot. A missing reference orientation is taken at the centre of the branch.
        branch: a branch of `orthocas.branches`, its name, or a box of your own. Default: the branch of the home; with
            none there, the largest.
        metric: as in `Problem`.
        clearance: least relative singular value of the task, > 0; see `orthocas.ClearBox`.
        parametrisation: a family that is linear in its parameters. Default: Polynomial(6), with one linear
            term for each joint on whose position self-motions do not depend, such as the first and the last one.
        home: posture whose branch is meant, (n,) or its name. Default: as for `suggest_domain`.
        like: with r = 1, what xi is to mean: a function of an SX column q, the name of a joint, or "swivel", the angle
            of the elbow about the line from shoulder to wrist [rad]. Along the self-motion of the home, or else of the
            branch's posture, xi then has nearly the values of that quantity, as far as these are monotone there.
            Default: with shoulder, elbow and wrist, the scale and the sense of the swivel there.
        samples: number of samples. Default: 40 for each function, 5,000 to 40,000.
        seed: seed of the samples.
        monitor: called with progress.

    Returns:
        The chart, the branch, and the regular share.

    Raises:
        DomainError: if there is no clear position near the middle of the branch.
        InvalidValueError, UnknownNameError, NotRedundantError: if an argument is invalid.
        Interrupted: after Ctrl-C, once there are coordinates; before that, KeyboardInterrupt.

    Source:
        ours, docs/how-to/wide.md.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
        >>> bent = oc.Box([0.0, 1.3, 1.3], [3.0, 1.2, 1.2])
        >>> found = oc.fit_wide(robot, oc.Task.position(robot, "xy"), bent)
        >>> found.regular_share > 0.99
        True
    """
    start = time.perf_counter()
    require_kind("robot", robot, Robot)
    require_driven("a wide fit", robot.tree)
    require_kind("task", task, Task)
    bound = as_number("clearance", clearance)
    if not 0 < bound < np.inf:
        raise InvalidValueError("clearance", clearance, "positive and finite")
    require_count("seed", seed, least=0)
    chosen = _chosen(robot, task, branch, home)
    problem = _problem(robot, task, metric, chosen, bound)
    wanted = Polynomial(DEGREE, _free_joints(problem)) if parametrisation is None else parametrisation
    require_parametrisation(wanted)
    wanted = wanted.for_problem(problem)
    if isinstance(wanted, CyclicParametrisation):
        problem = over_cyclic_joints(problem, tuple(wanted.cyclic))
    if wanted.closed_form is not None or not isinstance(wanted.family(JointSpace.of(problem), problem.r), LinearFamily):
        raise InvalidValueError("parametrisation", wanted.label, "a family to fit that is linear in its parameters")
    count = None if samples is None else require_count("samples", samples, least=2)
    posture = chosen.posture if home is None else home_posture(robot, task, home).q
    meaning = Meaning.by_default(problem, posture) if like is None else Meaning.of(problem, like, posture)
    search = _Search(problem, wanted, count, seed, monitor, meaning)
    with remembered() as pressed:
        stopped = False
        try:
            search.run()
        except KeyboardInterrupt:
            if search.best is None:
                raise
            stopped = True
        result = _finished(search, chosen, start, interrupted=stopped or pressed())
        if result.status is Status.INTERRUPTED or pressed():
            raise Interrupted(result)
    return result


def _finished(search: "_Search", branch: Branch, start: float, *, interrupted: bool) -> WideFit:
    """The result of a search, normalised and judged."""
    assert search.best is not None
    clear, seed = search.problem, search.seed
    centre, status = clear.domain.centre, Status.INTERRUPTED if interrupted else Status.CONVERGED
    first = sample_problem(clear, _FIRST, (seed, _FIRST_TAG))
    raw = search.coordinates(search.best[2])
    meaning = search.meaning
    coordinates = in_gauge(normalised(raw, centre, first), centre) if meaning is None else meaning.named(raw)
    try:
        domain = RegularPart(clear.domain, coordinates, LEAST_VOLUME / clear.r)
    except DomainError as error:
        advice = "give a smaller box as branch, or another branch"
        raise DomainError(f"in the middle of branch '{branch.name}', {error}: {advice}") from None
    share = float(domain.is_clear(sample_uniform(clear.domain, _JUDGED, (seed, _JUDGED_TAG))).mean())
    problem = Problem(clear.robot, clear.task, clear.metric, domain, clear.name)
    worst = worst_points(problem, coordinates, seed, thorough=True)
    notes: dict[str, str | float] = {
        "solver": "convex",
        "seed": seed,
        "samples": search.samples,
        "status": status.value,
        "branch": branch.name,
        "regular share": share,
        "least conditioning": worst.least,
        **({} if meaning is None else {"meaning": meaning.name, "error of its meaning": meaning.error(coordinates)}),
    }
    return WideFit(
        chart=Chart(problem, coordinates, notes),
        stages=tuple(stage.interrupted() if interrupted else stage for stage in search.stages),
        problem_check=check(problem, seed=seed),
        idle_joints=(),
        worst=worst,
        seconds=time.perf_counter() - start,
        branch=branch,
        regular_share=share,
    )


@dataclass(frozen=True, eq=False)
class Meaning:
    """Values that a coordinate is to have along the self-motion of a posture."""

    points: Array  #: (k, n), the posture in the middle
    values: Array  #: (k,), monotone
    middle: int  #: place of the posture
    slope: float  #: mean change of the value for a unit self-motion, in the sense of `_Field.directions`
    name: str  #: with its unit
    wanted: bool  #: whether coordinates are fitted to the values; otherwise they only get their scale and offset

    @classmethod
    def by_default(cls, problem: Problem, posture: Array) -> "Meaning | None":
        """The scale of the angle of the elbow, if the arm has shoulder, elbow and wrist and r = 1."""
        try:
            return replace(cls.of(problem, SWIVEL, posture), wanted=False)
        except (InvalidValueError, RobotError):
            return None

    @classmethod
    def of(cls, problem: Problem, like: Quantity | str, posture: Array) -> "Meaning":
        """Follow the self-motion of a posture both ways, as long as it is in the domain and the quantity is monotone.

        Raises:
            InvalidValueError: if r > 1, or the quantity stands still there.
        """
        name, quantity = quantity_of(problem.robot, like)
        if problem.r != 1:
            raise InvalidValueError(
                "like", f"given with r = {problem.r}", "none for a wide chart with several coordinates; fit has like"
            )
        sides = [_followed(problem, posture, sign * _STEP) for sign in (-1.0, 1.0)]
        points = np.concatenate([sides[0][:0:-1], sides[1]])
        middle = len(sides[0]) - 1
        values = np.unwrap(Batched(quantity)(points)[0][:, 0])  # angles do not jump
        if like == SWIVEL:
            values -= 2 * np.pi * np.round(values[middle] / (2 * np.pi))
        steps = np.diff(values)
        if len(points) < _FEWEST or not np.isfinite(steps).all():
            raise InvalidValueError(
                "like", "of too short a self-motion at the home", "another home, farther from limits"
            )
        k = min(middle, len(steps) - 1)
        same = np.sign(steps) == np.sign(steps[k])
        low = k - int(np.argmin(same[k::-1])) + 1 if not same[: k + 1].all() else 0
        high = k + int(np.argmin(same[k:])) if not same[k:].all() else len(steps)
        slope = (values[high] - values[low]) / (_STEP * max(1, high - low))
        if high - low < _FEWEST or abs(slope) < _STILL:
            raise InvalidValueError("like", "a quantity that stands still at the home", "one that self-motions change")
        return cls(points[low : high + 1], values[low : high + 1], middle - low, float(slope), name, True)

    def equations(self, family: LinearFamily) -> tuple[Array, Array]:
        """Rows (k, K) and right sides (k,) of the coefficients, over the slope."""
        q = ca.SX.sym("q", self.points.shape[1])
        psi = Batched(dense_function("psi", [q], [family.basis(q)]))(self.points)[0].reshape(len(self.points), -1)
        return psi - psi[self.middle], (self.values - self.values[self.middle]) / self.slope

    def named(self, raw: Coordinates) -> Coordinates:
        """Coordinates in units of the quantity, with its value at the posture.

        The scale is that for which they were fitted, or the best one.
        """
        xi, scale = raw.once("xi", self.points)[:, 0], self.slope
        away, values = xi - xi[self.middle], self.values - self.values[self.middle]
        if not self.wanted:
            scale = float(away @ values / max(away @ away, _TINY))
        return replace(
            raw, offset=np.array([xi[self.middle] - self.values[self.middle] / scale]), scale=np.array([scale])
        )

    def error(self, coordinates: Coordinates) -> float:
        """Root mean square of what coordinates miss along the self-motion."""
        return float(np.sqrt(np.mean((coordinates.once("xi", self.points)[:, 0] - self.values) ** 2)))


def _followed(problem: Problem, posture: Array, step: float) -> Array:
    """The self-motion from a posture in steps of unit self-motions, up to the boundary of the domain, (k, n)."""
    found = [posture]

    def slope(q: Array) -> Array:
        found: Array = _Field(problem, q[None]).directions(np.zeros((1, 1, problem.n)), 0)[0]
        return found

    while len(found) < _MOST_STEPS and problem.domain.contains(found[-1]):
        q = found[-1]
        middle = q + step / 2 * slope(q)
        again = q + step / 2 * slope(middle)
        found.append(q + step / 6 * (slope(q) + 2 * slope(middle) + 2 * slope(again) + slope(q + step * slope(again))))
    return np.array(found[:-1] if len(found) > 1 else found)


def _chosen(robot: Robot, task: Task, branch: Branch | Box | str | None, home: ArrayLike | str | None) -> Branch:
    """The branch that is meant."""
    if isinstance(branch, Branch):
        return branch
    if isinstance(branch, Box):
        return Branch("box", branch, branch.centre, float("nan"), float("nan"))
    found: Branches = branches(robot, task)
    if branch is not None:
        return found[branch]
    return found.of(home_posture(robot, task, home).q) or found[0]


def _free_joints(problem: Problem) -> tuple[str, ...]:
    """Names of the joints on whose position the self-motions do not depend, by proof."""
    return tuple(name for k, name in enumerate(problem.robot.joint_names) if leaves_stay(problem, k))


def _problem(robot: Robot, task: Task, metric: Metric | MetricSpec, branch: Branch, clearance: float) -> Problem:
    """The problem on the clear part of a branch; if its middle is not clear, of the largest box whose middle is."""
    box = branch.box
    try:
        return Problem(robot, task, metric, box, branch.name, clearance)
    except DomainError:
        points = sample_evenly(Box(box.centre, box.half_width), _MIDDLES, 0)
    values = relative_singular_values(Problem(robot, task, metric, box), points)
    middles = points[values > _CLEARER * clearance]
    room = box.half_width - np.abs(middles - box.centre)
    if not len(middles):
        raise DomainError(f"branch '{branch.name}' has no position clear by clearance = {clearance:g}, expected less")
    best = int(np.argmax(np.log(room).sum(axis=1)))
    domain = Box(middles[best], room[best], box.unbounded)
    return Problem(robot, task, metric, domain, branch.name, clearance)


class _Field:
    """Samples with the rows and the metric that self-motions are orthogonal to."""

    def __init__(self, problem: Problem, points: Array, weight: float = 1.0) -> None:
        task = problem.task
        J = task.batched_frame_jacobian(points)[0].reshape(len(points), task.m, problem.n)
        self.points, self.weight = points, weight
        self.rows = J / np.maximum(np.linalg.norm(J, axis=2, keepdims=True), _TINY)
        self.metric = None if problem.metric.is_identity else metric_matrices(problem.metric, points)
        self.design: Array | None = None  # of a single coordinate, which does not depend on others

    def directions(self, J: Array, k: int) -> Array:
        """z (N, n) along which the task and all rows of J (N, r, n) but row k stay, with det [J_x; J] > 0 for row z."""
        unit = J / np.maximum(np.linalg.norm(J, axis=2, keepdims=True), _TINY)
        others = np.concatenate([self.rows, np.delete(unit, k, axis=1)], axis=1)
        z = np.linalg.svd(others)[2][:, -1]
        z = z * np.sign(np.linalg.det(np.insert(others, self.rows.shape[1] + k, z, axis=1)))[:, None]
        squares = 1.0 if self.metric is None else np.einsum("si,sij,sj->s", z, self.metric, z)[:, None]
        return np.asarray(z / np.sqrt(squares))

    def volumes(self, J: Array) -> Array:
        """The volumes of `RegularPart` for gradients J (N, r, n), (N,)."""
        N = np.linalg.qr(self.rows.transpose(0, 2, 1))[0].transpose(0, 2, 1)
        N[:, 0] *= np.sign(np.linalg.det(N @ self.rows.transpose(0, 2, 1)))[:, None]
        unit = J / np.maximum(np.linalg.norm(J, axis=2, keepdims=True), _TINY)
        return np.asarray(np.linalg.det(np.concatenate([N, unit], axis=1)))


class _Search:
    """A search for regular coordinates of a problem."""

    def __init__(
        self,
        problem: Problem,
        parametrisation: Parametrisation,
        samples: int | None,
        seed: int,
        monitor: Monitor,
        meaning: Meaning | None,
    ) -> None:
        self.problem, self.parametrisation, self.seed, self.monitor = problem, parametrisation, seed, monitor
        self.meaning = meaning
        family = parametrisation.family(JointSpace.of(problem), problem.r)
        assert isinstance(family, LinearFamily)
        self._family: LinearFamily = family
        self._basis: BasisGradients = gradients_of(family, problem.n)
        self.samples = samples or int(np.clip(_PER_TERM * family.width, _LEAST_SAMPLES, _MOST_SAMPLES))
        self.best: tuple[float, float, Array] | None = None  #: share of bad positions, smoothness, coefficients
        self.stages: list[Stage] = []

    def run(self) -> None:
        """Solve with less and less smoothness until coordinates are regular enough, then with worst points too."""
        self._judged = _Field(self.problem, self._draw(_JUDGED, _JUDGED_TAG))
        fields = [_Field(self.problem, self._draw(self.samples, _TAG))]
        energy, C = self._energy(fields[0]), self._first()
        for smooth in _SMOOTH:
            C = self._swept(fields, energy, C, smooth, f"smoothness {smooth:g}")
            if self._keep(C, smooth):
                return
        for turn in range(1, 1 + _ROUNDS):
            assert self.best is not None
            _, smooth, C = self.best
            fields.append(
                _Field(self.problem, worst_points(self.problem, self.coordinates(C), self.seed).points, _ADDED)
            )
            if self._keep(self._swept(fields, energy, C, smooth, f"worst points, round {turn}"), smooth):
                return

    def coordinates(self, C: Array) -> Coordinates:
        """Coordinates of coefficients (r, K), not normalised."""
        r, space = self.problem.r, JointSpace.of(self.problem)
        return Coordinates(self.parametrisation, space, (), C.ravel(), np.zeros(r), np.ones(r))

    def _swept(self, fields: list[_Field], energy: Array, C: Array, smooth: float, name: str) -> Array:
        """Coefficients (r, K) after the problem of each coordinate was solved once."""
        started, C = time.perf_counter(), C.copy()
        weights = np.concatenate([np.full(len(field.points), field.weight) for field in fields])
        value, E, pull = 0.0, smooth * energy + _RIDGE * np.trace(energy) / len(energy) * np.eye(len(energy)), None
        if self.meaning is not None and self.meaning.wanted:
            rows, sides = self.meaning.equations(self._family)
            E, pull = E + _MEANT / len(rows) * rows.T @ rows, _MEANT / len(rows) * rows.T @ sides
        for k in range(len(C)):
            design = np.concatenate([self._design(field, C, k) for field in fields])
            C[k], value = least_hinge(design, E, weights, pull)
            self.monitor(Progress(name, (k + 1) / len(C), f"loss {value:.5g}", value))
        result = SolveResult(C.ravel(), value, Status.CONVERGED, len(C), len(C), time.perf_counter() - started)
        self.stages.append(Stage(name, C.size, len(weights), result))
        return C

    def _keep(self, C: Array, smooth: float) -> bool:
        """Keep coefficients if they are the best so far; whether they are regular enough."""
        volumes = self._judged.volumes(self.coordinates(C).jacobian(self._judged.points))
        orientation = 1.0 if np.median(volumes) >= 0 else -1.0
        bad = float(np.mean(orientation * volumes <= LEAST_VOLUME / self.problem.r))
        if self.best is None or bad < self.best[0]:
            self.best = bad, smooth, C
        return bad <= _ENOUGH

    def _first(self) -> Array:
        """Where the search starts, (r, K): anywhere with one coordinate, otherwise at a fit of low degree."""
        r, wanted = self.problem.r, self.parametrisation
        if r == 1:
            return np.zeros((1, self._family.width))
        low = wanted.of_degree(min(wanted.degree, _START)) if isinstance(wanted, GradedParametrisation) else wanted
        found = fit(self.problem, low, weights=_START_WEIGHTS, seed=self.seed, split_idle=False, monitor=self.monitor)
        coarse = found.chart.coordinates
        assert isinstance(coarse, Coordinates)
        theta = coarse.theta
        if isinstance(self._family, GradedFamily):
            theta = self._family.embed(theta, cast(Any, coarse.family))
        return np.asarray(theta.reshape(r, -1) * coarse.scale[:, None])

    def _draw(self, count: int, tag: int) -> Array:
        return sample_heavily(self.problem.domain, count, (self.seed, tag))

    def _gradients(self, points: Array) -> Iterator[tuple[slice, Array]]:
        """Gradients of all functions (c, n, K), some points at a time."""
        for begin in range(0, len(points), _PIECE):
            part = slice(begin, min(begin + _PIECE, len(points)))
            yield part, self._basis.dense(self._basis.at(points[part]), part.stop - begin)

    def _design(self, field: _Field, C: Array, k: int) -> Array:
        """dpsi/dq . z at the samples of a field, (N, K)."""
        if field.design is not None:
            return field.design
        z = field.directions(self.coordinates(C).jacobian(field.points), k)
        found = np.empty((len(field.points), self._family.width))
        for part, G in self._gradients(field.points):
            np.matmul(z[part, None, :], G, out=found[part, None, :])
        if len(C) == 1:
            field.design = found
        return found

    def _energy(self, field: _Field) -> Array:
        """Mean of dpsi_i/dq A^-1 dpsi_j/dq, (K, K), over every fourth sample."""
        total, metric = np.zeros((self._family.width,) * 2), field.metric
        points = field.points[::_EVERY]
        for part, G in self._gradients(points):
            raised = G if metric is None else np.linalg.solve(metric[::_EVERY][part], G)
            total += G.reshape(-1, G.shape[2]).T @ raised.reshape(-1, G.shape[2])
        return total / len(points)


def least_hinge(D: Array, E: Array, weights: Array, pull: Array | None = None) -> tuple[Array, float]:
    """The c (K,) with the least sum_s w_s max(0, 1 - D_s c)^2 / sum w + c^T E c - 2 g^T c, and that value.

    Args:
        D: (N, K).
        E: (K, K), positive definite.
        weights: w, (N,).
        pull: g, (K,). Default: 0.
    """
    weights, g = weights / weights.sum(), np.zeros(len(E)) if pull is None else pull

    def value(c: Array) -> float:
        short = np.maximum(0.0, 1 - D @ c)
        return float(weights @ short**2 + c @ E @ c - 2 * g @ c)

    c, last, now = np.zeros(len(E)), np.inf, np.inf
    for _ in range(_NEWTON_STEPS):
        active = D @ c < 1
        rows = D[active]
        weighted = rows * weights[active, None]
        factor = scipy.linalg.cho_factor(rows.T @ weighted + E)
        step = scipy.linalg.cho_solve(factor, weighted.sum(axis=0) + g) - c
        size = 1.0
        while not value(c + size * step) < last and size > 1e-3:
            size /= 2
        c = c + size * step
        now = value(c)
        if last - now <= _GAIN * abs(now):
            break
        last = now
    return c, now
