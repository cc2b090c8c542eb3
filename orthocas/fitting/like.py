"""Coordinates that are like given quantities: gradients as near to theirs as they can be across the task."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import casadi as ca
import numpy as np

from orthocas.bases.family import LinearFamily
from orthocas.bases.given import sew_angle
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import InvalidValueError, RobotError
from orthocas.fitting.basis_gradients import BasisGradients
from orthocas.fitting.terms import Data, Sizes, metric_lengths
from orthocas.robots.robot import Robot
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_known, require_shape
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.display import percent
from orthocas.tools.expressions import build_expression, write_tape

Quantity = Callable[[ca.SX], ca.SX]  #: a function of an SX column q
Likeness = Task | Quantity | str | Sequence[Quantity | str]  #: what coordinates may be like
SWIVEL = "swivel"  #: the name of the angle of the elbow


@dataclass(frozen=True, slots=True)
class LikeRules:
    """Numbers of coordinates that follow quantities."""

    weight: float = 300.0  #: of the term of `fit`, between task (1000) and mutual angles (30)
    weight_of_wide: float = 0.01  #: of the mean squared distance to gradients of quantities in wide fits, with r > 1
    held_weight: float = 100.0  #: of the mean squared error of a meaning in wide fits, relative to the slope
    step: float = 0.02  #: of unit self-motions, along which a meaning is taken
    most_steps: int = 400
    fewest: int = 5  #: steps of a self-motion that is long enough
    still: float = 1e-9  #: of the largest projected gradient
    still_motion: float = 1e-3  #: least change of a quantity for a unit self-motion
    tiny: float = 1e-12  #: least sum of squares to divide by
    held_out: int = 2000  #: samples of the distances
    held_out_of_meaning: int = 10_000  #: samples of the domain for errors of a meaning


RULES = LikeRules()


def build_quantity(robot: Robot, like: Quantity | str) -> tuple[str, ca.Function]:
    """Its name with a unit, and q (n, 1) -> the quantity (1, 1): a joint, the swivel, or a function of q."""
    q = ca.SX.sym("q", robot.n)
    if isinstance(like, str):
        require_known("like", like, (SWIVEL, *robot.joint_names))
        if like == SWIVEL:
            return f"{SWIVEL} [rad]", sew_angle(robot, "conventional")
        k = robot.joint_names.index(like)
        return f"{like} [{'m' if robot.tree.prismatic[k] else 'rad'}]", dense_function("like", [q], [q[k]])
    value = build_expression("like", like, q)
    require_shape("like", value.shape, (1, 1))
    name = str(getattr(like, "__name__", ""))
    return name if name.isidentifier() else "a function of q", dense_function("like", [q], [value])


def label_likeness(name: str, where: str = "") -> str:
    """What a coordinate means that is not its quantity, but like it: 'like swivel at home [rad]'."""
    words, bracket, unit = name.rpartition(" [") if name.endswith("]") else (name, "", "")
    return " ".join(filter(None, ("like", words, where))) + bracket + unit


def _require_finite(slopes: Array) -> Array:
    """The gradients of quantities, if all numbers are finite."""
    if not np.isfinite(slopes).all():
        raise InvalidValueError(
            "like", "quantities without a finite gradient in the domain", "others, or a smaller domain"
        )
    return slopes


def _hash(function: ca.Function) -> str:
    return hashlib.sha256(json.dumps(write_tape(function)).encode()).hexdigest()[:12]


@dataclass(frozen=True, eq=False)
class Like:
    """Quantities y(q) (k, 1) that the first k coordinates follow.

    The gradient of xi_j ought to be that part of the gradient of y_j which is orthogonal to the task. Such a field is
    no gradient in general, so a term of the loss holds the one against the other.

    Source:
        ours, docs/explanation/derivations_fits.md#meaning.
    """

    names: tuple[str, ...]  #: of the quantities, with their units
    function: ca.Function  #: q (n, 1) -> y (k, 1)

    @classmethod
    def of(cls, problem: Problem, like: Likeness) -> "Like":
        """Of a task of lower priority, of a quantity, or of several.

        A missing reference orientation of the task is taken at the centre of the domain.
        """
        robot = problem.robot
        q = ca.SX.sym("q", robot.n)
        if isinstance(like, Task):
            if like.robot.joint_names != robot.joint_names:
                raise InvalidValueError("like", "a task of another robot", "one of the problem's robot")
            like = like.with_reference_at(problem.domain.centre)
            labels = zip(like.labels, like.units, strict=True)
            names = tuple(f"{label} [{unit}]" if unit else label for label, unit in labels)
            return cls(names, _require_arms(robot, q, like.smooth_function(q)))
        parts = [like] if isinstance(like, str) or not isinstance(like, Sequence) else like
        quantities = [build_quantity(robot, part) for part in parts]
        if not quantities:
            raise InvalidValueError("like", "an empty list", "at least one quantity")
        values = ca.vertcat(*(function(q) for _, function in quantities))
        return cls(tuple(name for name, _ in quantities), _require_arms(robot, q, values))

    @property
    def label(self) -> str:
        """What the coordinates mean, for the notes of a chart: 'like q3 [rad]; like height'."""
        return "; ".join(label_likeness(name) for name in self.names)

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

    def build_term(self, problem: Problem, active: list[int]) -> "LikeTerm":
        """The term of the loss for coordinates of the active joints; the others stay at the centre of the domain.

        Raises:
            InvalidValueError: if there are fewer coordinates to fit than quantities.
        """
        self.require_at_most(problem.r - (problem.n - len(active)))
        q = ca.SX.sym("q", len(active))
        whole = ca.SX(ca.DM(problem.domain.centre))
        whole[active] = q
        values = self.function(whole)
        slopes = dense_function("like_jacobian", [q], [ca.cse(ca.jacobian(values, q))])
        # functions of a loss are kept by names
        return LikeTerm(f"like {_hash(slopes)}", len(self.names), slopes)

    def hold(self, samples: Samples, along: Callable[[Array], Array]) -> "list[QuadraticTerm]":
        """0.01 mean |Z^T (dxi_k/dq - g_k)|^2 over mean |Z^T g_k|^2, with gradients g_k and a basis Z of ker J_x.

        Args:
            samples: N samples of all joints.
            along: directions a (N, n) -> derivatives of the basis functions along them, (N, K).

        Raises:
            InvalidValueError: if the task leaves nothing of a quantity, or what it leaves of some follows from others.
        """
        N, m = samples.task_jacobian.shape[:2]
        Z, slopes = np.linalg.svd(samples.task_jacobian)[2][:, m:], self.differentiate(samples.points)
        left = np.einsum("sji,ski->skj", Z, slopes)
        gram = np.einsum("ski,sli->kl", left, left) / N
        squares, least = gram.diagonal(), RULES.still_motion**2
        moving = (squares > least * (slopes**2).sum(axis=2).max(axis=0)).all()
        if not moving or np.linalg.eigvalsh(gram / np.sqrt(np.outer(squares, squares)))[0] < least:
            raise InvalidValueError("like", "quantities that the task leaves nothing of", "others, or another task")
        # the quadratic form of coefficients that the mean square is
        parts = [along(Z[:, j]) for j in range(Z.shape[1])]
        E = sum((part.T @ part for part in parts), start=np.zeros(())) / N
        pulls = sum((part.T @ left[:, :, j] for j, part in enumerate(parts)), start=np.zeros(())) / N
        weight = RULES.weight_of_wide
        return [QuadraticTerm(weight / a * E, weight / a * pulls[:, k], weight) for k, a in enumerate(squares)]

    def name_units(self, coordinates: Coordinates, problem: Problem) -> Coordinates:
        """Coordinates in the units of their quantities, with their values at the centre of the domain."""
        k, centre = len(self.names), problem.domain.centre
        offset, scale = coordinates.offset.copy(), coordinates.scale.copy()
        raw = coordinates.once("xi", centre[None])[0, :k] / scale[:k] + offset[:k]
        offset[:k], scale[:k] = raw - np.array(self.function(centre))[:, 0], 1.0
        return replace(coordinates, offset=offset, scale=scale)

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
        # components across the task
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
    correlation: float  #: of the two; angles are taken within half a turn of their value at home
    against: float  #: share of the positions at which self-motions change the two in opposite signs

    @property
    def explained(self) -> str:
        """In words."""
        against = percent(self.against, fault=True)
        return f"{self.rms:.2g} off (rms), correlation {self.correlation:.2f}, against it on {against} of the domain"

    def write_notes(self) -> dict[str, float]:
        """For the notes of a chart."""
        return {
            "error of its meaning": self.rms,
            "correlation with its meaning": self.correlation,
            "share against its meaning": self.against,
        }


@dataclass(frozen=True, eq=False)
class Meaning:
    """Values that a coordinate is to have along the self-motion of a posture."""

    points: Array  #: (k, n), the posture in the middle
    values: Array  #: (k,), monotone
    home: int  #: place of the posture
    slope: float  #: mean change of the value for a unit self-motion, in the direction of `find_self_motion`
    name: str  #: with its unit
    fitted: bool  #: whether coordinates are fitted to the values; otherwise they only get their scale and offset
    quantity: ca.Function  #: q (n, 1) -> the quantity (1, 1)
    turns: bool  #: whether it is an angle that jumps by whole turns

    @property
    def label(self) -> str:
        """What the coordinate means, for the notes of a chart."""
        return label_likeness(self.name, "at home")

    @classmethod
    def by_default(cls, problem: Problem, posture: Array) -> "Meaning | None":
        """The scale of the angle of the elbow, if the arm has shoulder, elbow and wrist and r = 1."""
        try:
            return replace(cls.of(problem, SWIVEL, posture), fitted=False)
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
            name, quantity = build_quantity(problem.robot, like)
        # the quantity along the self-motion, both ways
        sides = [_trace_self_motion(problem, posture, sign * RULES.step) for sign in (-1.0, 1.0)]
        points = np.concatenate([sides[0][:0:-1], sides[1]])
        middle = len(sides[0]) - 1
        # angles do not jump
        values = np.unwrap(Batched(quantity)(points)[0][:, 0])
        turns = like == SWIVEL
        if turns:
            values -= 2 * np.pi * np.round(values[middle] / (2 * np.pi))
        # the stretch around the posture on which it is monotone
        steps = np.diff(values)
        if len(points) < RULES.fewest or not np.isfinite(steps).all():
            raise InvalidValueError(
                "like", "of too short a self-motion at the home", "another home, farther from limits"
            )
        k = min(middle, len(steps) - 1)
        same = np.sign(steps) == np.sign(steps[k])
        low = k - int(np.argmin(same[k::-1])) + 1 if not same[: k + 1].all() else 0
        high = k + int(np.argmin(same[k:])) if not same[k:].all() else len(steps)
        slope = (values[high] - values[low]) / (RULES.step * max(1, high - low))
        if high - low < RULES.fewest or abs(slope) < RULES.still_motion:
            raise InvalidValueError("like", "a quantity that stands still at the home", "one that self-motions change")
        along = points[low : high + 1], values[low : high + 1]
        return cls(*along, middle - low, float(slope), name, True, quantity, turns)

    def hold(self, family: LinearFamily) -> QuadraticTerm:
        """The mean squared difference from the values, over the squared slope, for coefficients of a family."""
        q = ca.SX.sym("q", self.points.shape[1])
        psi = Batched(dense_function("psi", [q], [family.basis(q)]))(self.points)[0].reshape(len(self.points), -1)
        rows, sides = psi - psi[self.home], self.values - self.values[self.home]
        weight = RULES.held_weight / len(rows) / self.slope**2
        return QuadraticTerm(weight * rows.T @ rows, weight * rows.T @ sides, weight * float(sides @ sides))

    def name_units(self, raw: Coordinates) -> Coordinates:
        """Coordinates in units of the quantity, with its value at the posture.

        The scale is that for which they were fitted, or the best one.
        """
        xi, scale = raw.once("xi", self.points)[:, 0], 1.0
        away, values = xi - xi[self.home], self.values - self.values[self.home]
        if not self.fitted:
            scale = float(away @ values / max(away @ away, RULES.tiny))
        return replace(raw, offset=np.array([xi[self.home] - self.values[self.home] / scale]), scale=np.array([scale]))

    def measure_error(self, problem: Problem, coordinates: Coordinates, seed: int) -> MeaningError:
        """What coordinates miss of the quantity at held-out samples of the domain, where it has a value."""
        samples = sample_problem(problem, RULES.held_out_of_meaning, (seed, RULES.held_out_of_meaning))
        q = ca.SX.sym("q", problem.n)
        both = dense_function("quantity", [q], [self.quantity(q), ca.jacobian(self.quantity(q), q)])
        value, slopes = (part.reshape(len(samples), -1) for part in Batched(both)(samples.points))
        xi, J = coordinates.once("xi", samples.points), coordinates.jacobian(samples.points)[:, 0]
        z = samples.null_basis[:, :, 0]
        finite = np.isfinite(value[:, 0]) & np.isfinite(slopes).all(axis=1)
        xi, value = xi[finite, 0], value[finite, 0]
        missed, value = xi - value, value - self.values[self.home]
        if self.turns:
            missed, value = _wrap(missed), _wrap(value)
        # self-motions change the two in opposite directions where the signs differ
        signs = np.einsum("sn,sn->s", J, z) * np.einsum("sn,sn->s", slopes, z)
        return MeaningError(
            rms=float(np.sqrt(np.mean(missed**2))),
            correlation=float(np.corrcoef(xi, value)[0, 1]),
            against=float(np.mean(signs[finite] < 0)),
        )


def _wrap(angles: Array) -> Array:
    return np.asarray(angles - 2 * np.pi * np.round(angles / (2 * np.pi)))


def _trace_self_motion(problem: Problem, posture: Array, step: float) -> Array:
    """The self-motion from a posture in steps of unit self-motions, up to the boundary of the domain, (k, n)."""
    points, slope = [posture], partial(find_self_motion, problem)
    while len(points) < RULES.most_steps and problem.domain.contains(points[-1]):
        q = points[-1]
        middle = q + step / 2 * slope(q)
        again = q + step / 2 * slope(middle)
        points.append(q + step / 6 * (slope(q) + 2 * slope(middle) + 2 * slope(again) + slope(q + step * slope(again))))
    return np.array(points[:-1] if len(points) > 1 else points)


def find_self_motion(problem: Problem, q: Array) -> Array:
    """The unit self-motion z (n,) of a position for r = 1, with z^T A z = 1 and det [J_x; z^T] > 0."""
    J = problem.task.batched_frame_jacobian(q[None])[0].reshape(problem.m, problem.n)
    z = np.linalg.svd(J)[2][-1]
    z = z * np.sign(np.linalg.det(np.vstack([J, z])))
    square = 1.0 if problem.metric.is_identity else z @ problem.metric.evaluate(q[None])[0] @ z
    return np.asarray(z / np.sqrt(square))
