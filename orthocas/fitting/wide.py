"""Wide charts: coordinates that are regular on a whole branch of the joint range."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from orthocas.bases.cyclic import leaves_stay, over_cyclic_joints
from orthocas.bases.family import CyclicParametrisation, JointSpace, LinearFamily, Parametrisation
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import worst_points
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import DomainError, Interrupted, InvalidValueError, RobotError
from orthocas.fitting.basis_gradients import BasisGradients, gradients_of
from orthocas.fitting.checkpoint import Stage
from orthocas.fitting.fit import Fit, in_gauge, normalised
from orthocas.fitting.like import SWIVEL, Like, Likeness, quantity_of
from orthocas.fitting.settings import require_parametrisation
from orthocas.robots.robot import Robot
from orthocas.robots.tree import require_driven
from orthocas.solvers.lbfgs import LBFGS
from orthocas.solvers.protocol import Status
from orthocas.tasks.branches import Branch, Branches, branches
from orthocas.tasks.domains import Box, sample_evenly, sample_heavily, sample_uniform
from orthocas.tasks.metric import Metric, MetricSpec, metric_matrices
from orthocas.tasks.problem import Problem, check, relative_singular_values
from orthocas.tasks.regular_box import home_posture
from orthocas.tasks.samples import sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_number, require_count, require_kind
from orthocas.tools.interrupts import remembered
from orthocas.tools.progress import Monitor, Watch, silent

CLEARANCE = 0.1  #: default least relative singular value
LEAST_VOLUME = 0.05  #: over r, of the coordinates in domains of wide charts; see `RegularPart`
DEGREE = 6
_DEGREE_OF_ALL = 5  # where base and tool joints count like all others
_EVEN = 0.5  # share of samples that are uniform; the others are heavy near limits
_PER_TERM, _LEAST_SAMPLES, _MOST_SAMPLES = 30, 5000, 20_000
_TAG, _JUDGED_TAG, _FIRST_TAG = 3000, 3001, 1000  # seed tags; other samples use other ones
_FIRST = 200  # samples that scale coordinates
_JUDGED = 20_000
_TARGET, _ITERATIONS = 0.5, 100  # of the first descent: the volume that is enough at a sample
_FURTHER_TARGET, _FURTHER = 0.3, 60  # of further ones
_BEYOND = 1.2  # over the bound of the domain, the volume in the identity metric that is enough beside another metric
_ROUNDS, _FRESH, _WORST, _FRESH_TAG = 3, 50_000, 5000, 3002  # further descents, each with the worst of fresh samples
_EVENNESS = 0.03  # weight of the mean squared logarithm of lengths of gradients
_TOLERANCE, _RIDGE = 1e-6, 1e-8
_POOR, _POOR_SEVERAL = 1e-3, 5e-3  # share of bad positions with which another family is tried; if r > 1
_ENOUGH = 5e-4  # share of bad positions, many near limits, that is as good as none
_WELL = 0.28  # over r, volume of all but 1 % of positions that is enough; a conditioning of 0.2
_UNIFORM_TAG = 1  # within the other tags
_EVERY = 4  # samples whose gradients count as long
_TINY = 1e-12  # length of a row
_STAGES = ("whole branch", "whole branch, all joints")  # of the families, one after the other
_MEANT = 100.0  # weight of the mean squared error of a meaning, relative to the slope
_STEP, _MOST_STEPS, _FEWEST = 0.02, 400, 5  # of unit self-motions, along which a meaning is taken
_ALIKE = 0.01  # weight of the mean squared distance to gradients of quantities, with r > 1
_STILL = 1e-3  # change of a quantity for a unit self-motion
_MIDDLES, _CLEARER = 20_000, 1.5  # positions that may be the middle of a domain, and their clearance over the bound


@dataclass(frozen=True, eq=False, repr=False)
class WideFit(Fit):
    """A chart of a branch, and how it was found."""

    branch: Branch | None = None  #: the branch of the chart
    regular_share: float = float(
        "nan"
    )  #: of the clear positions of the branch, or the box in its place, the share in the domain, from 20,000 samples

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

    Coordinates are regular where their volume v(q) is not zero: det of an orthonormal basis of the task's gradients and
    of the unit gradients of xi, all in the metric; for r = 1 it is the cosine between the gradient and the self-motion.
    The fit looks for the least

        mean max(0, 1 - v(q) / t)^2 + 0.03 mean |log(l(q) / L)|^2

    over samples of the branch that are clear of singular positions, half of them uniform and half boundary-heavy. The
    second mean keeps the lengths l of gradients near one length, so that xi is a similar motion everywhere. The fit
    descends with L-BFGS from linear coordinates across the task in the middle of the branch, first with t = 0.5. As
    long as more than 0.05 % of other samples are not regular after that, or 1 % of them have a volume below 0.28 / r,
    the worst of 50,000 fresh samples join and t = 0.3, three times at most, and no more once that makes coordinates
    worse. The best of these results is kept: regular in the middle, fewest bad positions, as far as these are more than
    0.05 %, then the largest 1 % quantile of the volume. The domain of the chart is the part of the branch where
    coordinates are regular with a margin, see `RegularPart`. It is judged in the identity metric; with another one, the
    first mean for the volume in the identity metric and t = 0.06 / r is added.

    Coordinates that are linear in the first and the last joint are best to prove and hold at any turn of them. They ask
    that self-motions turn base and tool in one sense on the whole branch, as far as the other joints do not outweigh
    that. Without `parametrisation`, if more than 0.1 % of samples (0.5 % with r > 1) are bad before the worst ones
    join, polynomials of degree 5 in all joints are tried, too, and the better ones are kept. Where these are, a joint
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
            none there, the largest. If its middle is not clear, the largest box around a clear position takes its
            place.
        metric: as in `Problem`.
        clearance: least relative singular value of the task, > 0; see `orthocas.ClearBox`.
        parametrisation: a family that is linear in its parameters. Default: Polynomial(6), with one linear
            term for each joint on whose position self-motions do not depend, such as the first and the last one; or
            Polynomial(5), see above.
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
        DomainError: if no position of the branch is clear by 1.5 times `clearance`, or if coordinates are not regular
            in the middle.
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
    meaning, quantities = None, None
    if problem.r == 1:
        meaning = Meaning.by_default(problem, posture) if like is None else Meaning.of(problem, like, posture)
    elif like is not None:
        quantities = Like.of(problem, like)
        quantities.require_at_most(problem.r)
    searches = [_Search(*case, count, seed, monitor, meaning, quantities) for case in cases]
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
    for name, search in zip(_STAGES, searches, strict=False):
        search.begin(name)
        missed, bad, _ = search.rank
        if not missed and bad <= (_POOR if search.problem.r == 1 else _POOR_SEVERAL):
            break
    _better(searches).go_on()


def _better(searches: Sequence["_Search"]) -> "_Search":
    """The search with the best coordinates."""
    return min((search for search in searches if search.best is not None), key=lambda search: search.rank)


def _finished(search: "_Search", branch: Branch, start: float, *, interrupted: bool) -> WideFit:
    """The result of a search, normalised and judged."""
    assert search.best is not None
    clear, seed = search.problem, search.seed
    centre, status = clear.domain.centre, Status.INTERRUPTED if interrupted else Status.CONVERGED
    if search.rank[0]:
        wrong = f"in the middle of branch '{branch.name}', coordinates fold or have another sign than on most of it"
        raise DomainError(f"{wrong}: give a smaller box as branch, another branch, or another parametrisation")
    first = sample_problem(clear, _FIRST, (seed, _FIRST_TAG))
    raw = search.coordinates(search.best)
    meaning, quantities = search.meaning, search.quantities
    if meaning is not None:
        coordinates = meaning.named(raw)
    elif quantities is not None:
        coordinates = quantities.named(normalised(raw, centre, first), clear)
    else:
        coordinates = in_gauge(normalised(raw, centre, first), centre)
    domain = RegularPart(clear.domain, coordinates, LEAST_VOLUME / clear.r)
    judged = sample_uniform(clear.domain, _JUDGED, (seed, _JUDGED_TAG))
    share = float(domain.is_clear(judged[_beside_the_middle(clear, judged)]).mean())
    problem = Problem(clear.robot, clear.task, clear.metric, domain, clear.name)
    worst = worst_points(problem, coordinates, seed, thorough=True)
    notes: dict[str, str | float] = {
        "solver": "lbfgs",
        "seed": seed,
        "samples": search.samples,
        "status": status.value,
        "branch": branch.name,
        "regular share": share,
        "least conditioning": worst.least,
        **({} if meaning is None else {"meaning": meaning.name, "error of its meaning": meaning.error(coordinates)}),
        **({} if quantities is None else {"meaning": "; ".join(quantities.names)}),
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
        like={} if quantities is None else quantities.distances(problem, coordinates, seed),
    )


class _Wish(NamedTuple):
    """The term c^T E c - 2 g^T c + a of a coordinate's coefficients c (K,)."""

    E: Array
    g: Array
    a: float


@dataclass(frozen=True, eq=False)
class Meaning:
    """Values that a coordinate is to have along the self-motion of a posture."""

    points: Array  #: (k, n), the posture in the middle
    values: Array  #: (k,), monotone
    middle: int  #: place of the posture
    slope: float  #: mean change of the value for a unit self-motion, in the sense of `_self_motion`
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
            several = Like.of(problem, like)
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

    def wish(self, family: LinearFamily) -> _Wish:
        """The mean squared difference from the values, over the squared slope, for coefficients of a family."""
        q = ca.SX.sym("q", self.points.shape[1])
        psi = Batched(dense_function("psi", [q], [family.basis(q)]))(self.points)[0].reshape(len(self.points), -1)
        rows, sides = psi - psi[self.middle], self.values - self.values[self.middle]
        weight = _MEANT / len(rows) / self.slope**2
        return _Wish(weight * rows.T @ rows, weight * rows.T @ sides, weight * float(sides @ sides))

    def named(self, raw: Coordinates) -> Coordinates:
        """Coordinates in units of the quantity, with its value at the posture.

        The scale is that for which they were fitted, or the best one.
        """
        xi, scale = raw.once("xi", self.points)[:, 0], 1.0
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
    found, slope = [posture], partial(_self_motion, problem)
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
        missing = f"no position clear by {_CLEARER * clearance:g}"
        raise DomainError(f"branch '{branch.name}' has {missing}, expected one for clearance = {clearance:g}")
    best = int(np.argmax(np.log(room).sum(axis=1)))
    domain = Box(middles[best], room[best], box.unbounded)
    return Problem(robot, task, metric, domain, branch.name, clearance)


class _Field:
    """Samples, with what the volume of coordinates there needs."""

    def __init__(self, problem: Problem, points: Array, basis: BasisGradients) -> None:
        self.points, self._basis, self._known = points, basis, basis.at(points)
        task, metric = problem.task, problem.metric
        J = task.batched_frame_jacobian(points)[0].reshape(len(points), task.m, problem.n)
        #: R with A^-1 = R R^T, (N, n, n); None for the identity
        self.root = None if metric.is_identity else np.linalg.cholesky(np.linalg.inv(metric_matrices(metric, points)))
        self._judged = _orthonormal(J)
        self._own = self._judged if self.root is None else _orthonormal(J @ self.root)

    def jacobian(self, C: Array) -> Array:
        """dxi/dq of coefficients (r, K), (N, r, n)."""
        return self._basis.jacobian(self._known, C, len(self.points))

    def along(self, directions: Array) -> Array:
        """dpsi/dq . a for directions a (N, n), (N, K)."""
        return self._basis.along(self._known, directions)

    def energy(self) -> Array:
        """Mean of dpsi_i/dq A^-1 dpsi_j/dq, (K, K)."""
        N, n = self.points.shape
        root = np.broadcast_to(np.eye(n), (N, n, n)) if self.root is None else self.root
        parts = (self.along(root[:, :, i]) for i in range(n))
        return np.asarray(sum((G.T @ G for G in parts), start=np.zeros(())) / N)

    def volumes(self, C: Array) -> Array:
        """The volumes of `RegularPart` for coefficients (r, K), (N,)."""
        return np.asarray(np.linalg.det(np.concatenate([self._judged, _unit(self.jacobian(C))[0]], axis=1)))

    def shortfall(self, C: Array, target: float, sense: float, wanted: Array) -> tuple[float, Array]:
        """Sum of max(0, 1 - sense v / target)^2 + w |log(l / wanted)|^2, and its derivative after C (r, K).

        The volumes v and the lengths l (r,) of gradients are those in the metric. In another metric than the identity,
        the sum for the volumes of `RegularPart` and a little more than its bound joins it: coordinates that are
        orthogonal in the inertia may be nearly parallel otherwise.
        """
        J = self.jacobian(C)
        unit, lengths = _unit(J if self.root is None else J @ self.root)
        uneven = np.log(lengths / wanted[:, None])
        value, slopes = _shortfall_and_slopes(unit, lengths, self._own, target, sense)
        value, slopes = value + _EVENNESS * float((uneven**2).sum()), slopes + 2 * _EVENNESS * uneven * unit / lengths
        if self.root is not None:
            bound = _BEYOND * LEAST_VOLUME / J.shape[1]
            own, more = _shortfall_and_slopes(*_unit(J), self._judged, bound, sense)
            value, slopes = value + own, slopes @ self.root.transpose(0, 2, 1) + more
        return value, self._basis.pullback(self._known, slopes)


def _shortfall_and_slopes(
    unit: Array, lengths: Array, basis: Array, target: float, sense: float
) -> tuple[float, Array]:
    """Sum of max(0, 1 - sense v / target)^2 with v = det [basis; unit], and its derivative after unit * lengths."""
    rows = np.concatenate([basis, unit], axis=1)
    volumes = sense * np.linalg.det(rows)
    short = np.maximum(0.0, 1 - volumes / target)
    some = short > 0
    inverse = np.linalg.inv(rows[some] + (volumes[some] == 0)[:, None, None] * _TINY * np.eye(rows.shape[2]))
    G = volumes[some, None, None] * inverse[:, :, -unit.shape[1] :].transpose(0, 2, 1)  # dv after unit gradients
    G -= np.einsum("sri,sri->sr", G, unit[some])[:, :, None] * unit[some]
    G *= (-2 / target * short[some])[:, None, None] / lengths[some]
    slopes = np.zeros_like(unit)
    slopes[some] = G
    return float(short @ short), slopes


def _unit(rows: Array) -> tuple[Array, Array]:
    """Rows (N, k, n) of length 1, and their lengths (N, k, 1)."""
    lengths = np.maximum(np.linalg.norm(rows, axis=2, keepdims=True), _TINY)
    return rows / lengths, lengths


def _orthonormal(rows: Array) -> Array:
    """An orthonormal basis of the span of rows (N, m, n), in their sense."""
    N = np.linalg.qr(rows.transpose(0, 2, 1))[0].transpose(0, 2, 1)
    N[:, 0] *= np.sign(np.linalg.det(N @ rows.transpose(0, 2, 1)))[:, None]
    return np.asarray(N)


def _self_motion(problem: Problem, q: Array) -> Array:
    """The unit self-motion z (n,) of a position for r = 1, with z^T A z = 1 and det [J_x; z^T] > 0."""
    J = problem.task.batched_frame_jacobian(q[None])[0].reshape(problem.m, problem.n)
    z = np.linalg.svd(J)[2][-1]
    z = z * np.sign(np.linalg.det(np.vstack([J, z])))
    square = 1.0 if problem.metric.is_identity else z @ metric_matrices(problem.metric, q[None])[0] @ z
    return np.asarray(z / np.sqrt(square))


class _Shortfall:
    """Mean of max(0, 1 - v / target)^2 over samples, of uneven lengths, and terms of what coordinates mean.

    Its variables Y are in a basis of functions whose gradients are orthonormal in the mean, C = Y L^-1. Coordinates
    begin with gradients of length 1 in the mean there.

    Args:
        fields: the samples.
        target: the volume beyond which nothing is lost.
        sense: sign of the volumes.
        factor: L (K, K), lower triangular, with the mean L L^T of products of gradients.
        wishes: terms of the first coordinates.
        start: coefficients (r, K) that give the lengths.
    """

    def __init__(
        self, fields: list[_Field], target: float, sense: float, factor: Array, wishes: list[_Wish], start: Array
    ) -> None:
        self._fields, self._target, self._sense, self._factor, self._wishes = fields, target, sense, factor, wishes
        self._lengths = np.linalg.norm(start @ factor, axis=1)[:, None]
        self._count = sum(len(field.points) for field in fields)

    def variables(self, C: Array) -> Array:
        """Y of coefficients (r, K), (r K,)."""
        return np.asarray((C @ self._factor / self._lengths).ravel())

    def coefficients(self, theta: Array) -> Array:
        """C (r, K)."""
        return self._solved((theta.reshape(len(self._lengths), -1) * self._lengths).T, trans="T").T

    def value(self, theta: Array) -> float:
        """The mean and the terms."""
        return self.value_and_gradient(theta)[0]

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """The mean and the terms, and the derivative (r K,)."""
        C = self.coefficients(theta)
        wanted = self._lengths[:, 0]
        parts = [field.shortfall(C, self._target, self._sense, wanted) for field in self._fields]
        value = sum(part for part, _ in parts) / self._count
        slopes = sum((part for _, part in parts), start=np.zeros(())) / self._count
        for k, (E, g, a) in enumerate(self._wishes):
            value += float(C[k] @ E @ C[k] - 2 * g @ C[k] + a)
            slopes[k] += 2 * (E @ C[k] - g)
        return value, (self._solved(slopes.T).T * self._lengths).ravel()

    def _solved(self, columns: Array, trans: str = "N") -> Array:
        """L^-1 or L^-T times columns."""
        return np.asarray(scipy.linalg.solve_triangular(self._factor, columns, lower=True, trans=trans))


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
        quantities: Like | None,
    ) -> None:
        self.problem, self.parametrisation, self.seed, self.monitor = problem, parametrisation, seed, monitor
        self.meaning, self.quantities = meaning, quantities
        family = parametrisation.family(JointSpace.of(problem), problem.r)
        assert isinstance(family, LinearFamily)
        self._family: LinearFamily = family
        self.samples = samples or int(np.clip(_PER_TERM * family.width, _LEAST_SAMPLES, _MOST_SAMPLES))
        self.best: Array | None = None  #: coefficients (r, K)
        #: of the best: whether they miss the middle, share of bad positions, if too many, and minus their 1 % volume
        self.rank = (True, np.inf, np.inf)
        self.stages: list[Stage] = []
        self._done = False  # whether coordinates are as regular as they need to be

    def begin(self, name: str) -> None:
        """Descend from coordinates that are linear, as far as the family has such, in a stage of some name."""
        self._basis: BasisGradients = gradients_of(self._family, self.problem.n)  # not before this family is tried
        self._judged = self._field(_JUDGED, _JUDGED_TAG)
        self._fields = [self._field(self.samples, _TAG)]
        some = _Field(self.problem, self._fields[0].points[::_EVERY], self._basis)
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
            fresh = self._field(_FRESH, _FRESH_TAG + turn)
            worst = fresh.points[np.argsort(self._sense * fresh.volumes(self._last))[:_WORST]]
            self._fields.append(_Field(self.problem, worst, self._basis))
            self._descend(_FURTHER_TARGET, _FURTHER, f"worst samples, round {turn} of {_ROUNDS}")

    def coordinates(self, C: Array) -> Coordinates:
        """Coordinates of coefficients (r, K), not normalised."""
        r, space = self.problem.r, JointSpace.of(self.problem)
        return Coordinates(self.parametrisation, space, (), C.ravel(), np.zeros(r), np.ones(r))

    @cached_property
    def _middle(self) -> _Field:
        """The centre of the domain."""
        return _Field(self.problem, self.problem.domain.centre[None], self._basis)

    def _descend(self, target: float, limit: int, name: str) -> None:
        """Minimise from the last coefficients."""
        objective = _Shortfall(self._fields, target, self._sense, self._factor, self._wishes, self._last)
        solver = LBFGS(limit, _TOLERANCE)
        result = solver.minimise(objective, objective.variables(self._last), Watch(self.monitor, name))
        self._last = objective.coefficients(result.theta)
        samples = sum(len(field.points) for field in self._fields)
        self.stages.append(Stage(name, result.theta.size, samples, replace(result, theta=self._last.ravel())))
        self._keep(self._last)
        result.finished()

    def _keep(self, C: Array) -> None:
        """Keep coefficients if they are the best so far."""
        bound = LEAST_VOLUME / self.problem.r
        middle, volumes = (self._sense * field.volumes(C) for field in (self._middle, self._judged))
        missed, bad, low = bool(middle[0] <= bound), float(np.mean(volumes <= bound)), float(np.quantile(volumes, 0.01))
        rank = missed, max(bad, _ENOUGH), -low
        if self.best is None or rank < self.rank:
            self.best, self.rank = C, rank
        self._done = bad <= _ENOUGH and low >= _WELL / self.problem.r

    def _field(self, count: int, tag: int) -> _Field:
        """Samples, half of them uniform like positions that count for the share, the others heavy near limits."""
        domain, even = self.problem.domain, int(_EVEN * count)
        uniform = sample_uniform(domain, even, (self.seed, tag, _UNIFORM_TAG))
        points = np.vstack([uniform, sample_heavily(domain, count - even, (self.seed, tag))])
        return _Field(self.problem, points[_beside_the_middle(self.problem, points)], self._basis)

    def _first(self, field: _Field) -> Array:
        """Coefficients (r, K) of the functions nearest to a^T q, with orthonormal a across the task in the middle.

        The first ones are those of the gradients of quantities that coordinates are to be like.
        """
        problem, centre = self.problem, self.problem.domain.centre
        J = problem.task.batched_frame_jacobian(centre[None])[0].reshape(problem.m, problem.n)
        directions = scipy.linalg.null_space(J).T
        if self.quantities is not None:
            wanted = self.quantities.slopes(centre[None])[0] @ directions.T  # (k, r)
            Q, R = np.linalg.qr(np.vstack([wanted, np.eye(problem.r)]).T)
            directions = (Q * np.where(R.diagonal() < 0, -1.0, 1.0)).T @ directions
        if self.meaning is not None:
            directions = self.meaning.slope * _self_motion(problem, centre)[None]
        parts = [field.along(np.broadcast_to(a, field.points.shape)).mean(axis=0) for a in directions]
        return np.asarray(scipy.linalg.cho_solve((self._factor, True), np.array(parts).T).T)

    def _meant(self, field: _Field) -> list[_Wish]:
        """Terms of what coordinates mean."""
        if self.meaning is not None and self.meaning.wanted:
            return [self.meaning.wish(self._family)]
        return [] if self.quantities is None else _alike(self.problem, self.quantities, field)


def _alike(problem: Problem, quantities: Like, field: _Field) -> list[_Wish]:
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
    return [_Wish(_ALIKE / a * E, _ALIKE / a * pulls[:, k], _ALIKE) for k, a in enumerate(squares)]
