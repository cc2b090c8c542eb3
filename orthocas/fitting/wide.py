"""Wide charts: coordinates that are regular on a whole branch of the joint range."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

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
from orthocas.fitting.like import SWIVEL, Like, Likeness, quantity_of
from orthocas.fitting.settings import require_parametrisation
from orthocas.fitting.terms import Weights
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
_DEGREE_OF_ALL = 4  # where base and tool joints count like all others
_EVEN = 0.5  # share of samples that are uniform; the others are heavy near limits
_PER_TERM, _LEAST_SAMPLES, _MOST_SAMPLES = 30, 5000, 20_000
_TAG, _JUDGED_TAG, _FIRST_TAG = 3000, 3001, 1000  # seed tags; other samples use other ones
_FIRST = 200  # samples that scale coordinates
_JUDGED = 20_000
_FIRST_STEP = (0.0, 1e-2)  # margin, and weight of the mean squared gradient
_EASY, _HARDER = ((0.2, 1e-3), (0.2, 1e-4)), ((0.05, 1e-4), (0.05, 1e-5))  # further ones
_HARD = 0.01  # share of bad positions after the first step with which a large margin asks too much
_POOR, _POOR_SEVERAL = 1e-3, 5e-3  # share of bad positions with which another family is tried; if r > 1
_ENOUGH = 5e-4  # share of bad positions, many near limits, that is as good as none
_WELL = 0.28  # over r, volume of all but 1 % of positions that is enough; a conditioning of 0.2
_ROUNDS, _FRESH, _WORST, _FRESH_TAG = 2, 50_000, 5000, 3002  # rounds with the worst of fresh samples
_UNIFORM_TAG = 1  # within the other tags
_EVERY = 4  # samples whose gradients count as long
_TINY = 1e-12  # length of a row
_NEWTON_STEPS, _GAIN, _RIDGE = 30, 5e-3, 1e-10
_MEANT = 100.0  # weight of the mean squared error of a meaning, relative to the slope
_STEP, _MOST_STEPS, _FEWEST = 0.02, 400, 5  # of unit self-motions, along which a meaning is taken
_ALIKE = 0.01  # weight of the mean squared distance to gradients of quantities, with r > 1
_STILL = 1e-3  # change of a quantity for a unit self-motion
_START = 3  # degree of the start, if there are several coordinates
_START_WEIGHTS = Weights(100.0, 3.0, 1000.0, 0.0, 10_000.0, angles="paper")  # better than in the metric on TIAGo Pro
_MIDDLES, _CLEARER = 20_000, 1.5  # positions that may be the middle of a domain, and their clearance over the bound


Rows = Callable[[NDArray[np.bool_]], Array]  #: samples that are kept (N,) -> rows (kept, K)
Lengths = Callable[[Array], tuple[Array, Rows]]


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
    like: Likeness | None = None,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
) -> WideFit:
    """Find coordinates that are regular on a whole branch of the joint range, and as orthogonal as that permits.

    Let z(q), with z^T A z = 1, be the direction of the self-motion; with r > 1, of the self-motion along which the
    other coordinates stay. A coordinate is regular if and only if dxi/dq . z > 0 everywhere, which is linear in its
    coefficients. So the fit solves a convex problem, the least

        mean max(0, 1 + c |dxi/dq|_A^-1 - dxi/dq . z)^2 + s mean |dxi/dq|^2_A^-1

    over samples of the branch that are clear of singular positions, half of them uniform and half boundary-heavy, by
    Newton's method. A coordinate loses nothing where the cosine between its gradient and the self-motion is above the
    margin c, as far as its gradient is long enough. The second mean is least where gradients point along z, that is
    where coordinates are orthogonal to the task and to each other. First c = 0, then c = 0.2, or c = 0.05 if more than
    1 % of other samples are not regular yet, each with two weights s. As long as more than 0.05 % are not regular after
    that, the worst of 50,000 fresh samples join, twice at most. The best of these results is kept: fewest bad
    positions, as far as these are more than 0.05 %, then the largest 1 % quantile of the volume of `RegularPart`. With
    r > 1 the problem is solved for one coordinate after the other, from a fit of degree 3. The domain of the chart is
    the part of the branch where coordinates are regular with a margin, see `RegularPart`.

    Coordinates that are linear in the first and the last joint are best to prove and hold at any turn of them. They ask
    that self-motions turn base and tool in one sense on the whole branch, as far as the other joints do not outweigh
    that. Without `parametrisation`, if more than 0.1 % of samples (0.5 % with r > 1) are bad before the worst ones
    join, polynomials of degree 4 in all joints are tried, too, and the better ones are kept. Where these are, a joint
    without limits has one turn in which samples lie; beyond it, positions belong to the domain as far as coordinates
    are regular there.

    If r joints do not move the task at all, such as the last one under a tool with an axis, singular positions divide
    the branch once more, by the sign of det of the other joints' columns. Samples and share are of the middle's side.

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
            term for each joint on whose position self-motions do not depend, such as the first and the last one; or
            Polynomial(4), see above.
        home: posture whose branch is meant, (n,) or its name. Default: as for `suggest_domain`.
        like: what coordinates are to mean: a function of an SX column q, the name of a joint, or "swivel", the angle
            of the elbow about the line from shoulder to wrist [rad]. With r = 1, xi then has nearly the values of that
            quantity along the self-motion of the home, or else of the branch's posture, as far as these are monotone
            there. With r > 1, several are allowed, or a task of lower priority: the gradients of the first coordinates
            are held against the parts of theirs that are orthogonal to the task. Default: with shoulder, elbow and
            wrist and r = 1, the scale and the sense of the swivel there.
        samples: number of samples. Default: 30 for each function, 5,000 to 20,000.
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
    wanted = _families(problem) if parametrisation is None else (parametrisation,)
    cases = [_case(problem, family) for family in wanted]
    problem, _ = cases[0]
    count = None if samples is None else require_count("samples", samples, least=2)
    posture = chosen.posture if home is None else home_posture(robot, task, home).q
    if problem.r > 1:
        meaning, several = None, like
    else:
        meaning = Meaning.by_default(problem, posture) if like is None else Meaning.of(problem, like, posture)
        several = None
    searches = [_Search(*case, count, seed, monitor, meaning, several) for case in cases]
    with remembered() as pressed:
        stopped = False
        try:
            _run(searches)
        except KeyboardInterrupt:
            if searches[0].best is None:
                raise
            stopped = True
        result = _finished(_better(searches), chosen, start, interrupted=stopped or pressed())
        if result.status is Status.INTERRUPTED or pressed():
            raise Interrupted(result)
    return result


def _case(problem: Problem, family: Parametrisation) -> tuple[Problem, Parametrisation]:
    """A problem and a family that suit each other."""
    require_parametrisation(family)
    family = family.for_problem(problem)
    if isinstance(family, CyclicParametrisation):
        problem = over_cyclic_joints(problem, tuple(family.cyclic))
    if family.closed_form is not None or not isinstance(family.family(JointSpace.of(problem), problem.r), LinearFamily):
        raise InvalidValueError("parametrisation", family.label, "a family to fit that is linear in its parameters")
    return problem, family


def _run(searches: Sequence["_Search"]) -> None:
    """Search in one family after the other, as long as results are poor, then go on in the best one."""
    for search in searches:
        search.begin()
        if search.rank[0] <= (_POOR if search.problem.r == 1 else _POOR_SEVERAL):
            break
    _better(searches).go_on()


def _better(searches: Sequence["_Search"]) -> "_Search":
    """The search with the best coordinates, regular in the middle if there are such."""
    found = (search for search in searches if search.best is not None)
    return min(found, key=lambda search: (not search.holds_in_the_middle(), *search.rank))


def _finished(search: "_Search", branch: Branch, start: float, *, interrupted: bool) -> WideFit:
    """The result of a search, normalised and judged."""
    assert search.best is not None
    clear, seed = search.problem, search.seed
    centre, status = clear.domain.centre, Status.INTERRUPTED if interrupted else Status.CONVERGED
    first = sample_problem(clear, _FIRST, (seed, _FIRST_TAG))
    raw = search.coordinates(search.best[2])
    meaning, alike = search.meaning, search.alike
    coordinates = in_gauge(normalised(raw, centre, first), centre) if meaning is None else meaning.named(raw)
    if alike is not None:
        scaled = search.coordinates(alike.scaled(search.best[2]))
        coordinates = alike.quantities.named(normalised(scaled, centre, first), clear)
    try:
        domain = RegularPart(clear.domain, coordinates, LEAST_VOLUME / clear.r)
    except DomainError as error:
        advice = "give a smaller box as branch, or another branch"
        raise DomainError(f"in the middle of branch '{branch.name}', {error}: {advice}") from None
    judged = sample_uniform(clear.domain, _JUDGED, (seed, _JUDGED_TAG))
    share = float(domain.is_clear(judged[_beside_the_middle(clear, judged)]).mean())
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
        **({} if alike is None else {"meaning": "; ".join(alike.quantities.names)}),
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
        like={} if alike is None else alike.quantities.distances(problem, coordinates, seed),
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
    def of(cls, problem: Problem, like: Likeness, posture: Array) -> "Meaning":
        """Follow the self-motion of a posture both ways, as long as it is in the domain and the quantity is monotone.

        Raises:
            InvalidValueError: if there is more than one quantity, or it stands still there.
        """
        if isinstance(like, Task) or (isinstance(like, Sequence) and not isinstance(like, str)):
            several = Like.of(problem.robot, like)
            if len(several.names) != 1:
                raise InvalidValueError("like", f"{len(several.names)} quantities", "one, as r = 1")
            name, quantity = several.names[0], several.function
        else:
            name, quantity = quantity_of(problem.robot, like)
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


def _families(problem: Problem) -> tuple[Polynomial, ...]:
    """Polynomials that are linear in the joints on whose position the self-motions do not depend, by proof.

    Then those that are so in such slides without limits only, if there are others: a joint that turns has one turn.
    """
    robot = problem.robot
    free = [k for k in range(robot.n) if leaves_stay(problem, k)]
    slides = robot.tree.prismatic
    endless = [k for k in free if slides[k] and np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])]
    names, fewer = (tuple(robot.joint_names[k] for k in joints) for joints in (free, endless))
    first = Polynomial(DEGREE, names)
    return (first,) if names == fewer else (first, Polynomial(_DEGREE_OF_ALL, fewer))


def _beside_the_middle(problem: Problem, points: Array) -> NDArray[np.bool_]:
    """Whether points (N, n) are on the middle's side of singular positions, (N,), if r joints do not move the task."""
    q, task = np.vstack([problem.domain.centre, points]), problem.task
    J = task.batched_frame_jacobian(q)[0].reshape(len(q), task.m, problem.n)
    moving = np.abs(J).max(axis=(0, 1)) > _TINY * np.abs(J).max()
    if moving.sum() != task.m:
        return np.ones(len(points), bool)
    sides = np.linalg.det(J[:, :, moving]) > 0
    return np.asarray(sides[1:] == sides[0])


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

    def __init__(self, problem: Problem, points: Array, basis: BasisGradients | None = None) -> None:
        task = problem.task
        J = task.batched_frame_jacobian(points)[0].reshape(len(points), task.m, problem.n)
        self.points, self.basis = points, basis
        self.rows = J / np.maximum(np.linalg.norm(J, axis=2, keepdims=True), _TINY)
        self.metric = None if problem.metric.is_identity else metric_matrices(problem.metric, points)
        self._inverse = None if self.metric is None else np.linalg.inv(self.metric)
        self._known = None if basis is None else basis.at(points)

    def jacobian(self, C: Array) -> Array:
        """dxi/dq of coefficients (r, K), (N, r, n)."""
        assert self.basis is not None
        assert self._known is not None
        return self.basis.jacobian(self._known, C, len(self.points))

    def along(self, directions: Array, kept: NDArray[np.bool_] | None = None) -> Array:
        """dpsi/dq . a for directions a (N, n), of some samples (N,), (kept, K)."""
        assert self.basis is not None
        assert self._known is not None
        return self.basis.along(self._known, directions, kept)

    def lengths(self, c: Array) -> tuple[Array, Array]:
        """|dxi/dq| of one coordinate (K,), (N,), and its derivative after dxi/dq, (N, n)."""
        slopes = self.jacobian(c[None])[:, 0]
        raised = slopes if self._inverse is None else np.einsum("sij,sj->si", self._inverse, slopes)
        long = np.sqrt(np.maximum(np.einsum("si,si->s", slopes, raised), _TINY**2))
        return long, raised / long[:, None]

    def energy(self) -> Array:
        """Mean of dpsi_i/dq A^-1 dpsi_j/dq, (K, K)."""
        N, n = self.rows.shape[0], self.rows.shape[2]
        root = np.broadcast_to(np.eye(n), (N, n, n)) if self._inverse is None else np.linalg.cholesky(self._inverse)
        parts = (self.along(root[:, :, i]) for i in range(n))
        return np.asarray(sum((G.T @ G for G in parts), start=np.zeros(())) / N)

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
        quantities: Likeness | None,
    ) -> None:
        self.problem, self.parametrisation, self.seed, self.monitor = problem, parametrisation, seed, monitor
        self.meaning, self._quantities = meaning, quantities
        self.alike: _Alike | None = None  #: once the search runs
        family = parametrisation.family(JointSpace.of(problem), problem.r)
        assert isinstance(family, LinearFamily)
        self._family: LinearFamily = family
        self.samples = samples or int(np.clip(_PER_TERM * family.width, _LEAST_SAMPLES, _MOST_SAMPLES))
        self.best: tuple[float, float, Array] | None = None  #: share of bad positions, -1 % volume, coefficients
        self.stages: list[Stage] = []

    def begin(self) -> None:
        """Solve with a larger margin and less smoothness."""
        self._basis: BasisGradients = gradients_of(self._family, self.problem.n)  # not before this family is tried
        self._judged = self._field(_JUDGED, _JUDGED_TAG)
        self._fields, self._last = [self._field(self.samples, _TAG)], self._first()
        some = _Field(self.problem, self._fields[0].points[::_EVERY], self._basis)
        self._energy = some.energy()
        if self._quantities is not None:
            self.alike = _Alike(Like.of(self.problem.robot, self._quantities), some)
        self._sweep(_FIRST_STEP)
        self._steps = _EASY if self.rank[0] <= _HARD else _HARDER
        for step in self._steps:
            if self._sweep(step):
                return

    def go_on(self) -> None:
        """Solve with the worst of fresh samples, if that was not enough."""
        for turn in range(1, 1 + _ROUNDS):
            if self.rank[0] <= _ENOUGH:
                return
            fresh = self._field(_FRESH, _FRESH_TAG + turn)
            worst = fresh.points[np.argsort(self._volumes(fresh, self._last))[:_WORST]]
            self._fields.append(_Field(self.problem, worst, self._basis))
            self._sweep(self._steps[-1], f", worst samples, round {turn}")

    @property
    def rank(self) -> tuple[float, float]:
        """Share of bad positions with the best coefficients so far, if too many, and minus their 1 % volume."""
        assert self.best is not None
        return max(self.best[0], _ENOUGH), self.best[1]

    def holds_in_the_middle(self) -> bool:
        """Whether the best coordinates are regular at the centre of the domain."""
        assert self.best is not None
        middle = _Field(self.problem, self.problem.domain.centre[None], self._basis)
        return abs(float(middle.volumes(middle.jacobian(self.best[2]))[0])) > LEAST_VOLUME / self.problem.r

    def coordinates(self, C: Array) -> Coordinates:
        """Coordinates of coefficients (r, K), not normalised."""
        r, space = self.problem.r, JointSpace.of(self.problem)
        return Coordinates(self.parametrisation, space, (), C.ravel(), np.zeros(r), np.ones(r))

    def _sweep(self, step: tuple[float, float], more: str = "") -> bool:
        """Solve the problem of each coordinate once; whether coordinates are regular enough then."""
        started, C, (margin, smooth) = time.perf_counter(), self._last.copy(), step
        fields, energy = self._fields, self._energy
        name = f"margin {margin:g}, smoothness {smooth:g}{more}"
        value, E, pull = 0.0, smooth * energy + _RIDGE * np.trace(energy) / len(energy) * np.eye(len(energy)), None
        if self.meaning is not None and self.meaning.wanted:
            rows, sides = self.meaning.equations(self._family)
            E, pull = E + _MEANT / len(rows) * rows.T @ rows, _MEANT / len(rows) * rows.T @ sides
        for k in range(len(C)):
            own, towards = (E, pull) if self.alike is None else self.alike.added(E, C, k)
            C[k], value = _Hinge(fields, C, k, margin).least(own, towards, C[k])
            self.monitor(Progress(name, (k + 1) / len(C), f"loss {value:.5g}", value))
        samples = sum(len(field.points) for field in fields)
        result = SolveResult(C.ravel(), value, Status.CONVERGED, len(C), len(C), time.perf_counter() - started)
        self.stages.append(Stage(name, C.size, samples, result))
        self._last = C
        return self._keep(C)

    def _volumes(self, field: _Field, C: Array) -> Array:
        """Volumes of coordinates at samples, (N,), positive at most."""
        volumes = field.volumes(field.jacobian(C))
        return volumes if np.median(volumes) >= 0 else -volumes

    def _keep(self, C: Array) -> bool:
        """Keep coefficients if they are the best so far; whether they are regular enough."""
        volumes = self._volumes(self._judged, C)
        bad = float(np.mean(volumes <= LEAST_VOLUME / self.problem.r))
        low = float(np.quantile(volumes, 0.01))
        if self.best is None or (max(bad, _ENOUGH), -low) < self.rank:
            self.best = bad, -low, C
        return bad <= _ENOUGH and low >= _WELL / self.problem.r

    def _first(self) -> Array:
        """Where the search starts, (r, K): anywhere with one coordinate, otherwise at a fit of low degree."""
        r, wanted = self.problem.r, self.parametrisation
        if r == 1:
            return np.zeros((1, self._family.width))
        low = wanted.of_degree(min(wanted.degree, _START)) if isinstance(wanted, GradedParametrisation) else wanted
        found = fit(
            self.problem,
            low,
            weights=_START_WEIGHTS,
            seed=self.seed,
            split_idle=False,
            like=self._quantities,
            monitor=self.monitor,
        )
        coarse = found.chart.coordinates
        assert isinstance(coarse, Coordinates)
        theta = coarse.theta
        if isinstance(self._family, GradedFamily):
            theta = self._family.embed(theta, cast(Any, coarse.family))
        return np.asarray(theta.reshape(r, -1) * coarse.scale[:, None])

    def _field(self, count: int, tag: int) -> _Field:
        """Samples, half of them uniform like positions that count for the share, the others heavy near limits."""
        domain, even = self.problem.domain, int(_EVEN * count)
        uniform = sample_uniform(domain, even, (self.seed, tag, _UNIFORM_TAG))
        points = np.vstack([uniform, sample_heavily(domain, count - even, (self.seed, tag))])
        return _Field(self.problem, points[_beside_the_middle(self.problem, points)], self._basis)


class _Alike:
    """Adds mean |Z^T (dxi_k/dq - g_k / slope_k)|^2 to the problems of the first coordinates, with a basis Z of ker J_x.

    The g_k are the gradients of the quantities, and slope_k is the median of g_k along the self-motion of coordinate k.

    Args:
        quantities: what coordinates are to be like.
        field: some samples.
    """

    def __init__(self, quantities: Like, field: _Field) -> None:
        self.quantities, self._field = quantities, field
        N, count, n = len(field.points), len(quantities.names), field.points.shape[1]
        q = ca.SX.sym("q", n)
        slopes = dense_function("slopes", [q], [ca.jacobian(quantities.function(q), q)])
        self._gradients, self._slopes = Batched(slopes)(field.points)[0].reshape(N, count, n), np.ones(count)
        Z = np.linalg.svd(field.rows)[2][:, field.rows.shape[1] :]
        parts = [field.along(Z[:, j]) for j in range(Z.shape[1])]
        self._square = sum((part.T @ part for part in parts), start=np.zeros(())) / N
        sides = (np.einsum("si,ski->sk", Z[:, j], self._gradients) / N for j in range(Z.shape[1]))
        self._pulls = sum((part.T @ side for part, side in zip(parts, sides, strict=True)), start=np.zeros(()))

    def added(self, E: Array, C: Array, k: int) -> tuple[Array, Array | None]:
        """E and the pull for coordinate k of coefficients (r, K), with the term.

        Raises:
            InvalidValueError: if the task leaves nothing of the quantity.
        """
        if k >= len(self._slopes):
            return E, None
        along = np.einsum("si,si->s", self._gradients[:, k], self._field.directions(self._field.jacobian(C), k))
        self._slopes[k] = np.median(along)
        if not abs(self._slopes[k]) > _STILL * np.linalg.norm(self._gradients[:, k], axis=1).max():
            wanted = "others, in another order, or another task"
            raise InvalidValueError("like", "quantities that the task leaves nothing of", wanted)
        return E + _ALIKE * self._square, _ALIKE * self._pulls[:, k] / self._slopes[k]

    def scaled(self, C: Array) -> Array:
        """Coefficients (r, K) in the units of the quantities."""
        found = C.copy()
        found[: len(self._slopes)] *= self._slopes[:, None]
        return found


class _Hinge:
    """Mean of max(0, 1 + margin |dxi/dq| - dxi/dq . z)^2 over samples, for one coordinate; convex in its coefficients.

    Args:
        fields: the samples.
        C: coefficients of all coordinates, (r, K).
        k: which one.
        margin: the least cosine between dxi/dq and z beyond which nothing is lost, 0 <= margin < 1.
    """

    def __init__(self, fields: list[_Field], C: Array, k: int, margin: float) -> None:
        self._fields, self._margin = fields, margin
        self._rows = np.concatenate([field.along(field.directions(field.jacobian(C), k)) for field in fields])

    def least(self, E: Array, pull: Array | None, start: Array) -> tuple[Array, float]:
        """The c with the least mean + c^T E c - 2 pull^T c, see `least_hinge`."""
        return least_hinge(self._rows, E, pull, start, self._lengths if self._margin else None)

    def _lengths(self, c: Array) -> tuple[Array, Rows]:
        """margin |dxi/dq|, (N,), and its derivative after c at some samples."""
        pairs = [field.lengths(c) for field in self._fields]
        ends = np.cumsum([len(field.points) for field in self._fields])[:-1]

        def slopes(kept: NDArray[np.bool_]) -> Array:
            parts = zip(self._fields, pairs, np.split(kept, ends), strict=True)
            return self._margin * np.concatenate([field.along(pair[1], some) for field, pair, some in parts])

        return self._margin * np.concatenate([long for long, _ in pairs]), slopes


def least_hinge(
    D: Array,
    E: Array,
    pull: Array | None = None,
    start: Array | None = None,
    lengths: Lengths | None = None,
    gain: float = _GAIN,
) -> tuple[Array, float]:
    """The c (K,) with the least mean of max(0, 1 + l_s(c) - D_s c)^2 + c^T E c - 2 g^T c, and that value.

    Newton's method without the curvature of l, with halved steps. The function is convex if l is.

    Args:
        D: (N, K).
        E: (K, K), positive definite.
        pull: g, (K,). Default: 0.
        start: (K,). Default: 0.
        lengths: c -> l (N,), convex in c and >= 0, and what gives rows of dl/dc for samples that are kept (N,).
            Default: 0.
        gain: relative decrease of the value in a step at which the search ends.
    """
    g, N = np.zeros(len(E)) if pull is None else pull, len(D)

    def state(c: Array) -> tuple[float, Array, Rows | None]:
        long, slopes = (np.zeros(()), None) if lengths is None else lengths(c)
        short = np.maximum(0.0, 1 + long - D @ c)
        return float(short @ short / N + c @ E @ c - 2 * g @ c), short, slopes

    c = np.zeros(len(E)) if start is None else start
    last, short, slopes = state(c)
    for _ in range(_NEWTON_STEPS):
        active = short > 0
        rows = D[active] if slopes is None else D[active] - slopes(active)
        factor = scipy.linalg.cho_factor(rows.T @ rows / N + E)
        step = scipy.linalg.cho_solve(factor, rows.T @ short[active] / N - E @ c + g)
        size, now = 1.0, state(c + step)
        while not now[0] < last and size > 1e-3:
            size /= 2
            now = state(c + size * step)
        if not now[0] < last:
            break
        gained, (last, short, slopes), c = last - now[0], now, c + size * step
        if gained <= gain * abs(last):
            break
    return c, last
