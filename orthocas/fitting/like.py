"""Coordinates that are given quantities, or like them: gradients as near to theirs as they can be across the task."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy

from orthocas.bases.family import JointSpace, LinearFamily, Parametrisation, require_parametrisation
from orthocas.bases.given import Given, find_periods, sew_angle
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import DomainError, InvalidValueError, RobotError
from orthocas.fitting.basis_objective import BasisGradients
from orthocas.fitting.terms import Data, Sizes, find_least_volume, metric_lengths
from orthocas.robots.robot import Robot
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_kind, require_known, require_shape
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.display import listed, percent
from orthocas.tools.expressions import build_expression, replay, wrap_shortest, write_tape

Quantity = Callable[[ca.SX], ca.SX]  #: a function of an SX column q
Likeness = Task | Quantity | str | Sequence[Quantity | str]  #: what coordinates may be like
SWIVEL = "swivel"  #: the name of the angle of the elbow


@dataclass(frozen=True, slots=True)
class LikeRules:
    """Numbers of coordinates that follow quantities."""

    weight: float = 300.0  #: of the term of `fit`, between task (1000) and mutual angles (30)
    weight_of_one: float = 1.0  #: of the mean squared distance to the gradient of a quantity in wide fits, with r = 1
    weight_of_several: float = 0.01  #: the same with r > 1
    along_task: float = 0.1  #: of the squares of what gradients have along the task, relative to the rest
    still: float = 1e-9  #: of the largest projected gradient
    still_motion: float = 1e-3  #: least change of a quantity for a unit self-motion, over the length of its gradient
    scaled_against: float = 0.1  #: share of positions against the swivel up to which it gives a scale
    enough_itself: float = 0.995  #: share of nonsingular positions on which a quantity is regular, to be xi itself
    held_out: int = 2000  #: samples of the distances
    held_out_of_meaning: int = 10_000  #: samples of the domain for errors of a meaning
    quantiles: tuple[float, float] = (0.05, 0.95)  #: of rates of a meaning


RULES = LikeRules()


def choose_quantities(
    problem: Problem, like: Likeness | None, exact: bool | None, parametrisation: Parametrisation | None
) -> tuple[Like | None, bool | None]:
    """The quantities of `like`, or those that a parametrisation without parameters is; and whether xi is to be these.

    Raises:
        InvalidValueError: if arguments contradict each other, or there are more quantities than coordinates.
    """
    if exact is not None:
        require_kind("exact", exact, bool)
    if parametrisation is not None:
        require_parametrisation(parametrisation)
        if parametrisation.closed_form is not None and isinstance(given := parametrisation.for_problem(problem), Given):
            if like is not None or exact is False:
                name = "exact" if like is None else "like"
                raise InvalidValueError(name, f"given with {given.label}", "this left out: xi is what is given")
            given.family(JointSpace.of(problem), problem.r)  # of the right shape
            return Like.of_given(given), True
    if like is None:
        if exact is not None:
            raise InvalidValueError("exact", "given without like", "a quantity, such as like='swivel'")
        return None, None
    if exact and parametrisation is not None:
        raise InvalidValueError("exact", "given with a parametrisation to fit", "one of them")
    quantities = Like.of(problem, like)
    quantities.require_at_most(problem.r)
    return quantities, exact if parametrisation is None else False


def take_exactly(problem: Problem, quantities: Like, exact: bool | None, counted: Array) -> Coordinates | None:
    """Quantities as coordinates, xi = y(q), if they are to be that.

    Coordinates of r quantities are regular where the volume of `RegularPart`, with r = 1 the cosine between gradient
    and self-motion, is above the least one of wide charts, with the sign of the centre of the domain.

    Args:
        problem: the problem, on the clear part of a branch.
        quantities: at most r quantities.
        exact: True to take them on however small a part, False never, None where they are regular nearly everywhere.
        counted: nonsingular positions of the branch, (N, n).

    Returns:
        The coordinates; None if coordinates are to be fitted to the quantities.

    Raises:
        InvalidValueError: with `exact`, if there are fewer quantities than coordinates, or they are not independent.
        DomainError: with `exact`, if they are not regular at the centre.
    """
    count = len(quantities.names)
    if exact is False or (count < problem.r and not exact):
        return None
    if count < problem.r:
        what = f"given with {count} {'quantity' if count == 1 else 'quantities'}"
        raise InvalidValueError("exact", what, f"{problem.r} of them, one for each coordinate; or leave it out")
    # The quantities themselves: not shifted, and not scaled
    domain, space, r = problem.domain, JointSpace.of(problem), problem.r
    coordinates = Coordinates(quantities.given, space, (), np.zeros(0), np.zeros(r), np.ones(r))
    inside = counted[domain.contains(counted)]
    try:
        regular = RegularPart(domain, coordinates, find_least_volume(problem))
    except DomainError:
        if not exact:
            return None
        # That they are nowhere regular is worse
        quantities.project(sample_problem(problem, RULES.held_out, RULES.held_out))
        turning = f"in the middle of branch '{problem.name}', self-motions do not change {listed(quantities.names)}"
        raise DomainError(f"{turning}: give a smaller box as branch, another branch, or another quantity") from None
    return coordinates if exact or np.mean(regular.contains(inside)) >= RULES.enough_itself else None


def build_quantity(robot: Robot, like: Quantity | str) -> tuple[str, ca.Function]:
    """Its name with a unit, and q (n, 1) -> the quantity (1, 1): a joint, the swivel, or a function of q."""
    q = ca.SX.sym("q", robot.n)
    # By name: the swivel angle, or a joint
    if isinstance(like, str):
        require_known("like", like, (SWIVEL, *robot.joint_names))
        if like == SWIVEL:
            return f"{SWIVEL} [rad]", sew_angle(robot, "conventional")
        k = robot.joint_names.index(like)
        return f"{like} [{'m' if robot.tree.prismatic[k] else 'rad'}]", dense_function("like", [q], [q[k]])
    # Or any function of q with one value
    value = build_expression("like", like, q)
    require_shape("like", value.shape, (1, 1))
    name = str(getattr(like, "__name__", ""))
    return name if name.isidentifier() else "a function of q", dense_function("like", [q], [value])


def _require_finite(slopes: Array) -> Array:
    """The gradients of quantities, if all numbers are finite."""
    if not np.isfinite(slopes).all():
        raise InvalidValueError(
            "like", "quantities without a finite gradient in the domain", "others, or a smaller domain"
        )
    return slopes


@dataclass(frozen=True, eq=False)
class Like:
    """Quantities y(q) (k, 1) that the first k coordinates follow.

    The gradient of xi_j ought to be that part of the gradient of y_j which is orthogonal to the task. Such a field is
    no gradient in general, so a term of the loss holds the one against the other.

    Source:
        ours, docs/explanation/derivations_meaning.md#meaning.
    """

    names: tuple[str, ...]  #: of the quantities, with their units
    function: ca.Function  #: q (n, 1) -> y (k, 1)

    @classmethod
    def of(cls, problem: Problem, like: Likeness) -> Like:
        """Build from a task of lower priority, a quantity, or of several.

        A missing reference orientation of the task is taken at the centre of the domain.
        """
        robot = problem.robot
        q = ca.SX.sym("q", robot.n)
        # A task stands for its components, relative to the centre of the domain
        if isinstance(like, Task):
            if not like.robot.tree.equals(robot.tree):
                raise InvalidValueError("like", "a task of another robot", "one of the problem's robot")
            like = like.with_reference_at(problem.domain.home)
            labels = zip(like.labels, like.units, strict=True)
            names = tuple(f"{label} [{unit}]" if unit else label for label, unit in labels)
            return cls(names, _require_arms(robot, q, like.smooth_function(q)))
        # All else is one quantity, or several
        parts = [like] if isinstance(like, str) or not isinstance(like, Sequence) else like
        quantities = [build_quantity(robot, part) for part in parts]
        if not quantities:
            raise InvalidValueError("like", "an empty list", "at least one quantity")
        values = ca.vertcat(*(function(q) for _, function in quantities))
        return cls(tuple(name for name, _ in quantities), _require_arms(robot, q, values))

    @classmethod
    def of_given(cls, given: Given) -> Like:
        """Build from coordinates in closed form; angles have the unit rad."""
        q = ca.SX.sym("q", given.n)
        values = ca.vertcat(*replay(given.tape, ca.vertsplit(q)))
        several = [""] if values.numel() == 1 else [f" {k + 1}" for k in range(values.numel())]
        units = [" [rad]" if period else "" for period in find_periods(given.tape)]
        names = tuple(f"{given.label}{number}{unit}" for number, unit in zip(several, units, strict=True))
        return cls(names, dense_function("like", [q], [values]))

    @classmethod
    def by_default(cls, problem: Problem) -> Like | None:
        """The angle of the elbow, if the arm has shoulder, elbow and wrist, and r = 1."""
        try:
            return cls.of(problem, SWIVEL) if problem.r == 1 else None
        except RobotError:
            return None

    @property
    def label(self) -> str:
        """What the coordinates mean, for the notes of a chart: 'like q3 [rad]; like height'."""
        return "; ".join(f"like {name}" for name in self.names)

    @cached_property
    def given(self) -> Given:
        """The quantities as coordinates in closed form."""
        words = ", ".join(name.partition(" [")[0] for name in self.names)
        return Given.from_function(words, self.function.numel_in(0), self.function)

    @cached_property
    def periods(self) -> Array:
        """2 pi for quantities that jump by whole turns, 0 for others, (k,)."""
        return find_periods(self.given.tape)

    def require_at_most(self, count: int) -> None:
        """Raise InvalidValueError if there are more quantities than coordinates."""
        if len(self.names) > count:
            raise InvalidValueError("like", f"{len(self.names)} quantities", f"at most {count}, one for a coordinate")

    def differentiate(self, points: Array) -> Array:
        """dy/dq at points (N, n), (N, k, n)."""
        return _require_finite(self._slopes(points)[0].reshape(len(points), len(self.names), -1))

    @cached_property
    def _slopes(self) -> BlockedFunction:
        q = ca.SX.sym("q", self.function.numel_in(0))
        return BlockedFunction(dense_function("slopes", [q], [ca.jacobian(self.function(q), q)]))

    def build_term(self, problem: Problem, active: list[int]) -> LikeTerm:
        """The term of the loss for coordinates of the active joints; the others stay at the centre of the domain.

        Raises:
            InvalidValueError: if there are fewer coordinates to fit than quantities.
        """
        self.require_at_most(problem.r - (problem.n - len(active)))
        q = ca.SX.sym("q", len(active))
        whole = ca.SX(ca.DM(problem.domain.home))
        whole[active] = q
        values = self.function(whole)
        slopes = dense_function("like_jacobian", [q], [ca.cse(ca.jacobian(values, q))])
        # Functions of a loss are kept by names
        return LikeTerm(
            f"like {hashlib.sha256(json.dumps(write_tape(slopes)).encode()).hexdigest()[:12]}", len(self.names), slopes
        )

    def project(self, samples: Samples) -> tuple[Array, Array]:
        """An orthonormal basis (N, n, n), the last r of ker J_x, and gradients of quantities along it, (N, k, n).

        Raises:
            InvalidValueError: if the task leaves nothing of a quantity, or what it leaves of some follows from others.
        """
        m, B = samples.task_jacobian.shape[1], _split_directions(samples)
        slopes = self.differentiate(samples.points) @ B
        # What self-motions move of each quantity, and whether that is enough to tell them apart
        left = slopes[:, :, m:]
        gram = np.einsum("skj,slj->kl", left, left) / len(left)
        squares, least = gram.diagonal(), RULES.still_motion**2
        moving = (squares > least * (slopes**2).sum(axis=2).mean(axis=0)).all()
        if not moving or np.linalg.eigvalsh(gram / np.sqrt(np.outer(squares, squares)))[0] < least:
            raise InvalidValueError("like", "quantities that the task leaves nothing of", "others, or another task")
        return B, slopes

    def choose_directions(self, samples: Samples, centre: Samples) -> Array:
        """Orthonormal directions (r, n) across the task at the centre, the first k in those of the quantities.

        With r = 1, it is the one in which self-motions change the quantity at most samples.
        """
        m = centre.task_jacobian.shape[1]
        across = _split_directions(centre)[0, :, m:].T
        if len(across) == 1:
            return np.asarray(across * np.sign(np.median(self.project(samples)[1][:, 0, m])))
        Q, R = np.linalg.qr(np.vstack([self.differentiate(centre.points)[0] @ across.T, np.eye(len(across))]).T)
        return np.asarray((Q * np.where(R.diagonal() < 0, -1.0, 1.0)).T @ across)

    def hold(self, samples: Samples, along: Callable[[Array], Array]) -> list[QuadraticTerm]:
        """Weighted means of squared distances of gradients from those g_k of quantities, above all along self-motions.

        They are those of |Z^T d_k|^2 + 0.1 |N^T d_k|^2 with the distance d_k = dxi_k/dq - g_k and orthonormal bases Z
        of ker J_x and N of its complement. Weights are in proportion to 1 / (l_k^2 + |Z^T g_k|^2), with the median l_k
        of |Z^T g_k|, and their sum to 1 / l_k^2: distances count relative to gradients where these are large, as near
        positions at which a quantity jumps. With r = 1, a regular xi grows everywhere along z, so positions at which a
        quantity that grows at most of them falls do not count.

        Args:
            samples: N samples of all joints.
            along: directions a (N, n) -> derivatives of the basis functions along them, (N, K).
        """
        m = samples.task_jacobian.shape[1]
        B, slopes = self.project(samples)
        r = B.shape[2] - m
        shares = np.repeat([RULES.along_task, 1.0], [m, r])
        parts = [along(B[:, :, j]) for j in range(m + r)]
        terms = []
        for k in range(len(self.names)):
            squares = (slopes[:, k, m:] ** 2).sum(axis=1)
            # Samples count alike, whatever the size of the quantity's rate there
            even = 1 / (np.median(squares) + squares)
            if r == 1:
                even *= slopes[:, k, m] * np.median(slopes[:, k, m]) > 0
            even *= (RULES.weight_of_one if r == 1 else RULES.weight_of_several) / even.sum() / np.median(squares)
            # The quadratic form of coefficients that the mean square is
            E, pull = np.zeros(()), np.zeros(())
            for j, part in enumerate(parts):
                weighted = (shares[j] * even[:, None] * part).T
                E, pull = E + weighted @ part, pull + weighted @ slopes[:, k, j]
            terms.append(QuadraticTerm(E, pull, float(even @ (slopes[:, k] ** 2 @ shares))))
        return terms

    def name_units(self, coordinates: Coordinates, posture: Array) -> Coordinates:
        """Coordinates in the units of their quantities, with their values at a posture (n,)."""
        k = len(self.names)
        offset, scale = coordinates.offset.copy(), coordinates.scale.copy()
        raw = coordinates.once("xi", posture[None])[0, :k] / scale[:k] + offset[:k]
        offset[:k], scale[:k] = raw - np.array(self.function(posture))[:, 0], 1.0
        return replace(coordinates, offset=offset, scale=scale)

    def scale(self, coordinates: Coordinates, problem: Problem, posture: Array, seed: int) -> Coordinates | None:
        """A coordinate with the median rate of the quantity along self-motions, and its value at a posture (n,).

        None if it moves against the quantity at too many positions.
        """
        samples = sample_problem(problem, RULES.held_out, (seed, RULES.held_out))
        own, left = self._compare_rates(coordinates, samples)
        against = np.mean(own * left < 0)
        if RULES.scaled_against < against < 1 - RULES.scaled_against:
            return None
        scale = float(np.median(left / own))
        offset = float(coordinates.once("xi", posture[None])[0, 0]) - float(self.function(posture)) / scale
        return replace(
            coordinates,
            offset=coordinates.offset + offset / coordinates.scale,
            scale=coordinates.scale * scale,
        )

    def measure_error(self, problem: Problem, coordinates: Coordinates, seed: int) -> MeaningError:
        """What the first coordinate misses of the first quantity at samples of the domain, where it has a value."""
        samples = sample_problem(problem, RULES.held_out_of_meaning, (seed, RULES.held_out_of_meaning))
        value = Batched(self.function)(samples.points)[0].reshape(len(samples), -1)[:, 0]
        # Where both have a value, angles by the shorter way
        own, left = self._compare_rates(coordinates, samples)
        finite = np.isfinite(value) & np.isfinite(left)
        xi, value = coordinates.once("xi", samples.points)[finite, 0], value[finite]
        period = float(self.periods[0])
        missed = wrap_shortest((xi - value)[:, None], np.array([period]))[:, 0]
        value = xi - missed
        # How much of the quantity's rate is left along self-motions
        slow, fast = np.quantile((left / own)[finite], RULES.quantiles)
        # What no function of xi can explain
        order = np.argsort(xi)
        monotone = scipy.optimize.isotonic_regression(value[order])
        return MeaningError(
            rms=float(np.sqrt(np.mean(missed**2))),
            undetermined=float(np.sqrt(np.mean((value[order] - monotone.x) ** 2))),
            correlation=float(np.corrcoef(xi, value)[0, 1]),
            against=float(np.mean((own * left)[finite] < 0)),
            slow=float(slow),
            fast=float(fast),
        )

    def _compare_rates(self, coordinates: Coordinates, samples: Samples) -> tuple[Array, Array]:
        """How fast self-motions change the first coordinate and the first quantity, (N,) each; z has any sign."""
        z = samples.null_basis[:, :, 0]
        slopes = self._slopes(samples.points)[0].reshape(len(samples), len(self.names), -1)[:, 0]
        J = coordinates.once("jacobian", samples.points)[:, : samples.points.shape[1]]
        return tuple(np.einsum("sn,sn->s", rows, z) for rows in (J.reshape(len(samples), -1, z.shape[1])[:, 0], slopes))

    def measure_distances(self, problem: Problem, coordinates: Coordinates, seed: int) -> dict[str, float]:
        """Root mean square angles between gradients of coordinates and what the task leaves of quantities' [deg]."""
        samples, k = sample_problem(problem, RULES.held_out, (seed, RULES.held_out)), len(self.names)
        J, Z = coordinates.jacobian(samples.points)[:, :k], samples.null_basis
        left = self.differentiate(samples.points) @ Z
        squares = np.einsum("skn,skn->sk", J, samples.compute_metric_gradients(J))
        lengths = np.sqrt(squares) * np.linalg.norm(left, axis=2)
        cosines = np.einsum("skz,skz->sk", J @ Z, left) / np.maximum(lengths, RULES.still)
        angles = np.degrees(np.sqrt((np.arccos(np.clip(cosines, -1, 1)) ** 2).mean(axis=0)))
        return dict(zip(self.names, angles.tolist(), strict=True))


def _split_directions(samples: Samples) -> Array:
    """An orthonormal basis (N, n, n), the last r of ker J_x; with r = 1, det [J_x; z^T] > 0 for that one."""
    J = samples.task_jacobian
    B = np.linalg.svd(J)[2].transpose(0, 2, 1)
    if J.shape[1] == J.shape[2] - 1:
        B[:, :, -1] *= np.sign(np.linalg.det(np.concatenate([J, B[:, None, :, -1]], axis=1)))[:, None]
    return np.asarray(B)


def _require_arms(robot: Robot, q: ca.SX, values: ca.SX) -> ca.Function:
    """Quantities as a function of q, if no floating base moves them: xi depends on the arms' joints alone."""
    base = list(robot.tree.floating)
    if base and ca.depends_on(values, q[base]):
        raise InvalidValueError("like", "a quantity that a floating base moves", "a quantity of the arms' joints")
    return dense_function("like", [q], [values])


@dataclass(frozen=True)
class LikeTerm:
    """Mean over quantities of the squared distance between gradients, without their part along the task, over theirs.

    With an A-orthonormal basis z_1..z_r of ker J_x, the residuals are (v_xi,j - g_j) . z_k / |g_j|_A^-1, with the
    gradient g_j of the quantity.
    """

    name: str
    count: int
    slopes: ca.Function = field(compare=False, hash=False)  #: q (n, 1) -> dy/dq (k, n)
    data: tuple[str, ...] = ("metric_inverse", "null_basis", "points")
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Data, sizes: Sizes) -> ca.SX:
        """Differences over sqrt(k), quantity by quantity, (k r, 1)."""
        A, Z = data.get("metric_inverse"), data["null_basis"]
        targets = self.slopes(data["points"])
        whole = ca.repmat(metric_lengths(targets, A) + RULES.still, 1, sizes.r)
        rho: ca.SX = (1 / self.count) ** 0.5 * ca.vec(((coordinate_jacobian[: self.count, :] - targets) @ Z / whole).T)
        return rho

    @cached_property
    def batched(self) -> BlockedFunction:
        """Evaluates dy/dq at many points."""
        return BlockedFunction(self.slopes)

    def turn(self, family: LinearFamily, theta: Array, samples: Samples, gradients: BasisGradients) -> Array:
        """Combinations of coordinates, (r K,): the first k are nearest to the quantities, the others across them."""
        C = theta.reshape(family.outputs, family.width)
        G = gradients.expand(gradients.at(samples.points), len(samples))
        Z = samples.null_basis
        # Components across the task
        own = np.einsum("rk,snk,snz->szr", C, G, Z, optimize=True).reshape(-1, len(C))
        slopes = _require_finite(self.batched(samples.points)[0].reshape(len(samples), self.count, -1))
        targets = (slopes @ Z).transpose(0, 2, 1)
        B = np.linalg.lstsq(own, targets.reshape(-1, self.count), rcond=None)[0].T  # (k, r)
        if np.linalg.matrix_rank(B) < self.count:
            raise InvalidValueError("like", "quantities that the task leaves nothing of", "others, or another task")
        return np.asarray((np.vstack([B, np.linalg.svd(B)[2][self.count :]]) @ C).ravel())


class QuadraticTerm(NamedTuple):
    """The term c^T E c - 2 g^T c + a of a coordinate's coefficients c (K,)."""

    E: Array
    g: Array
    a: float


@dataclass(frozen=True)
class MeaningError:
    """How far a coordinate is from a quantity at samples of the domain, not only at home."""

    rms: float  #: root mean square difference, in the unit of the quantity; of angles, the shortest
    undetermined: float  #: the same after the best monotone map of the coordinate; angles within half a turn of it
    correlation: float  #: of the two; angles are taken within half a turn of the coordinate
    against: float  #: share of the positions at which self-motions change the two in opposite signs
    slow: float  #: 5 % quantile of how much self-motions change the quantity for a unit change of the coordinate
    fast: float  #: 95 % quantile of that

    @property
    def explained(self) -> str:
        """How far the coordinate is from its quantity, in words."""
        rates = f"moves it by {self.slow:.2g} to {self.fast:.2g} (5 to 95 %) for each unit"
        off = f"{self.rms:.2g} off (rms), {self.undetermined:.2g} after the best monotone map"
        against = f"against it on {percent(self.against, fault=True)} of the domain, where it turns back"
        return f"{rates}, {off}, correlation {self.correlation:.2f}, {against}"

    def write_notes(self) -> dict[str, float]:
        """What the notes of a chart say."""
        return {
            "error of its meaning": self.rms,
            "error after the best monotone map": self.undetermined,
            "correlation with its meaning": self.correlation,
            "share against its meaning": self.against,
            "slow rate of its meaning": self.slow,
            "fast rate of its meaning": self.fast,
        }
