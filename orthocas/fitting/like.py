"""Coordinates that are given quantities y(q), or follow them as far as orthogonality to the task permits."""

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
    along_task: float = 0.1  #: weight of squared differences along the task, relative to those along self-motions
    still: float = 1e-9  #: least length that gradients are divided by
    still_motion: float = 1e-3  #: least change of a quantity for a unit self-motion, over the length of its gradient
    scaled_against: float = 0.1  #: xi takes the swivel's scale if at most this share of positions moves against it
    enough_itself: float = 0.995  #: share of nonsingular positions where a quantity must be regular to be taken as xi
    held_out: int = 2000  #: samples on which distances are measured
    held_out_of_meaning: int = 10_000  #: samples on which the errors of a meaning are measured
    quantiles: tuple[float, float] = (0.05, 0.95)  #: of the rates dy/dxi of a meaning


RULES = LikeRules()


def choose_quantities(
    problem: Problem, like: Likeness | None, exact: bool | None, parametrisation: Parametrisation | None
) -> tuple[Like | None, bool | None]:
    """The quantities of `like` or of a parametrisation without parameters, and whether xi is exactly these.

    Returns:
        The quantities, or None. Then True to take them as xi, False to follow them, None to decide by regularity.

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
                raise InvalidValueError(name, f"given with {given.label}", "no such argument: xi is this function")
            given.family(JointSpace.of(problem), problem.r)  # raises an error if the shape is wrong
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
    """Take quantities as the coordinates themselves, xi = y(q), if `exact` or their regularity says so.

    Such coordinates are regular where the volume of `RegularPart` has the sign that it has at the centre, and at least
    the size that wide charts require. With r = 1 the volume is the cosine between gradient and self-motion.

    Args:
        problem: the problem, on the clear part of a branch.
        quantities: at most r quantities.
        exact: True takes them even if they are regular on a small part only, False never does, None does if they are
            regular on 99.5 % of the counted positions.
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
    # The offsets are 0 and the scales are 1, so that xi equals the quantities
    domain, space, r = problem.domain, JointSpace.of(problem), problem.r
    coordinates = Coordinates(quantities.given, space, (), np.zeros(0), np.zeros(r), np.ones(r))
    inside = counted[domain.contains(counted)]
    try:
        regular = RegularPart(domain, coordinates, find_least_volume(problem))
    except DomainError:
        if not exact:
            return None
        # If they are regular nowhere, this raises an error that says so
        quantities.project(sample_problem(problem, RULES.held_out, RULES.held_out))
        turning = f"at the centre of branch '{problem.name}', self-motions do not change {listed(quantities.names)}"
        raise DomainError(f"{turning}: give a smaller box as branch, another branch, or another quantity") from None
    return coordinates if exact or np.mean(regular.contains(inside)) >= RULES.enough_itself else None


def build_quantity(robot: Robot, like: Quantity | str) -> tuple[str, ca.Function]:
    """Name and function q (n, 1) -> y (1, 1) of a quantity: a joint, the swivel, or a function of q."""
    q = ca.SX.sym("q", robot.n)
    # A name is that of the swivel angle, or of a joint
    if isinstance(like, str):
        require_known("like", like, (SWIVEL, *robot.joint_names))
        if like == SWIVEL:
            return f"{SWIVEL} [rad]", sew_angle(robot, "conventional")
        k = robot.joint_names.index(like)
        return f"{like} [{'m' if robot.tree.prismatic[k] else 'rad'}]", dense_function("like", [q], [q[k]])
    # Otherwise it is a function of q with one value
    value = build_expression("like", like, q)
    require_shape("like", value.shape, (1, 1))
    name = str(getattr(like, "__name__", ""))
    return name if name.isidentifier() else "a function of q", dense_function("like", [q], [value])


def _require_finite(slopes: Array) -> Array:
    """Return gradients of quantities, or raise InvalidValueError if some are not finite."""
    if not np.isfinite(slopes).all():
        raise InvalidValueError(
            "like", "quantities without a finite gradient in the domain", "others, or a smaller domain"
        )
    return slopes


@dataclass(frozen=True, eq=False)
class Like:
    """Quantities y(q) (k, 1) that the first k coordinates follow.

    The target for the gradient of xi_j is the part of the gradient of y_j that is orthogonal to the task. In general
    that vector field is not the gradient of any function, so a term of the loss keeps the difference small.

    Source:
        ours, docs/explanation/derivations_meaning.md#meaning.
    """

    names: tuple[str, ...]  #: of the quantities, with their units
    function: ca.Function  #: q (n, 1) -> y (k, 1)

    @classmethod
    def of(cls, problem: Problem, like: Likeness) -> Like:
        """Build from a task of lower priority, from a quantity, or from several.

        If the task lacks a reference orientation, the one at the centre of the domain is taken.
        """
        robot = problem.robot
        q = ca.SX.sym("q", robot.n)
        # The quantities of a task are its components
        if isinstance(like, Task):
            if not like.robot.tree.equals(robot.tree):
                raise InvalidValueError("like", "a task of another robot", "one of the problem's robot")
            like = like.with_reference_at(problem.domain.home)
            labels = zip(like.labels, like.units, strict=True)
            names = tuple(f"{label} [{unit}]" if unit else label for label, unit in labels)
            return cls(names, _require_arms(robot, q, like.smooth_function(q)))
        # Otherwise it is one quantity, or several
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
        """Text for the notes of a chart: 'like q3 [rad]; like height'."""
        return "; ".join(f"like {name}" for name in self.names)

    @cached_property
    def given(self) -> Given:
        """The quantities as coordinates in closed form."""
        words = ", ".join(name.partition(" [")[0] for name in self.names)
        return Given.from_function(words, self.function.numel_in(0), self.function)

    @cached_property
    def periods(self) -> Array:
        """Periods of the quantities, (k,): 2 pi for angles that jump by whole turns, 0 for others [rad]."""
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
        """The term of the loss, for coordinates of the active joints. Other joints are at the centre of the domain.

        Raises:
            InvalidValueError: if there are fewer coordinates to fit than quantities.
        """
        self.require_at_most(problem.r - (problem.n - len(active)))
        q = ca.SX.sym("q", len(active))
        whole = ca.SX(ca.DM(problem.domain.home))
        whole[active] = q
        values = self.function(whole)
        slopes = dense_function("like_jacobian", [q], [ca.cse(ca.jacobian(values, q))])
        # Functions of a loss are cached by the names of its terms, so different quantities need different names
        return LikeTerm(
            f"like {hashlib.sha256(json.dumps(write_tape(slopes)).encode()).hexdigest()[:12]}", len(self.names), slopes
        )

    def project(self, samples: Samples) -> tuple[Array, Array]:
        """Orthonormal bases (N, n, n), with columns, and components (N, k, n) of the quantities' gradients in them.

        The last r columns of a basis span ker J_x.

        Raises:
            InvalidValueError: if self-motions hardly change a quantity, or only together with others.
        """
        m, B = samples.task_jacobian.shape[1], _split_directions(samples)
        slopes = self.differentiate(samples.points) @ B
        # Rates of the quantities along self-motions must not vanish, and must be linearly independent
        left = slopes[:, :, m:]
        gram = np.einsum("skj,slj->kl", left, left) / len(left)
        squares, least = gram.diagonal(), RULES.still_motion**2
        moving = (squares > least * (slopes**2).sum(axis=2).mean(axis=0)).all()
        if not moving or np.linalg.eigvalsh(gram / np.sqrt(np.outer(squares, squares)))[0] < least:
            came = "quantities that self-motions cannot change independently"
            raise InvalidValueError("like", came, "others, or another task")
        return B, slopes

    def choose_directions(self, samples: Samples, centre: Samples) -> Array:
        """Orthonormal directions (r, n) across the task at the centre, the first k along the quantities' gradients.

        With r = 1, its sign is the one for which the quantity grows along self-motions at most samples.
        """
        m = centre.task_jacobian.shape[1]
        across = _split_directions(centre)[0, :, m:].T
        if len(across) == 1:
            return np.asarray(across * np.sign(np.median(self.project(samples)[1][:, 0, m])))
        Q, R = np.linalg.qr(np.vstack([self.differentiate(centre.points)[0] @ across.T, np.eye(len(across))]).T)
        return np.asarray((Q * np.where(R.diagonal() < 0, -1.0, 1.0)).T @ across)

    def hold(self, samples: Samples, along: Callable[[Array], Array]) -> list[QuadraticTerm]:
        """Loss terms that hold the gradients of coordinates to those g_k of quantities, mainly along self-motions.

        Term k is a weighted mean over samples of |Z^T d_k|^2 + 0.1 |N^T d_k|^2, with d_k = dxi_k/dq - g_k and
        orthonormal bases Z of ker J_x and N of its complement. The weight of a sample is in proportion to
        1 / (l_k^2 + |Z^T g_k|^2), with the median l_k of |Z^T g_k|. So where gradients are large, as near a jump of the
        quantity, relative differences count. The sum of the weights is in proportion to 1 / l_k^2. With r = 1, a
        regular xi grows along z everywhere, so samples where the quantity changes against its usual sign have no
        weight.

        Args:
            samples: N samples of all joints.
            along: function of directions (N, n) that returns derivatives of the basis functions along them, (N, K).

        Returns:
            One term for each quantity.
        """
        m = samples.task_jacobian.shape[1]
        B, slopes = self.project(samples)
        r = B.shape[2] - m
        shares = np.repeat([RULES.along_task, 1.0], [m, r])
        parts = [along(B[:, :, j]) for j in range(m + r)]
        terms = []
        for k in range(len(self.names)):
            squares = (slopes[:, k, m:] ** 2).sum(axis=1)
            # Weights of the samples
            even = 1 / (np.median(squares) + squares)
            if r == 1:
                even *= slopes[:, k, m] * np.median(slopes[:, k, m]) > 0
            even *= (RULES.weight_of_one if r == 1 else RULES.weight_of_several) / even.sum() / np.median(squares)
            # The weighted mean is a quadratic form of the coefficients
            E, pull = np.zeros(()), np.zeros(())
            for j, part in enumerate(parts):
                weighted = (shares[j] * even[:, None] * part).T
                E, pull = E + weighted @ part, pull + weighted @ slopes[:, k, j]
            terms.append(QuadraticTerm(E, pull, float(even @ (slopes[:, k] ** 2 @ shares))))
        return terms

    def name_units(self, coordinates: Coordinates, posture: Array) -> Coordinates:
        """The same coordinates, the first k in the units of their quantities, and equal to them at a posture (n,)."""
        k = len(self.names)
        offset, scale = coordinates.offset.copy(), coordinates.scale.copy()
        raw = coordinates.once("xi", posture[None])[0, :k] / scale[:k] + offset[:k]
        offset[:k], scale[:k] = raw - np.array(self.function(posture))[:, 0], 1.0
        return replace(coordinates, offset=offset, scale=scale)

    def scale(self, coordinates: Coordinates, problem: Problem, posture: Array, seed: int) -> Coordinates | None:
        """The coordinate, scaled so that self-motions change it as fast as the quantity, in the median.

        It is shifted to equal the quantity at a posture (n,). None if it grows where the quantity falls at some
        positions, and both grow at others: at more than 10 % of each.
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
        """How far the first coordinate is from the first quantity, at samples of the domain where both are finite."""
        samples = sample_problem(problem, RULES.held_out_of_meaning, (seed, RULES.held_out_of_meaning))
        value = Batched(self.function)(samples.points)[0].reshape(len(samples), -1)[:, 0]
        # Differences where the quantity is finite; those of angles are wrapped to half a turn
        own, left = self._compare_rates(coordinates, samples)
        finite = np.isfinite(value) & np.isfinite(left)
        xi, value = coordinates.once("xi", samples.points)[finite, 0], value[finite]
        period = float(self.periods[0])
        missed = wrap_shortest((xi - value)[:, None], np.array([period]))[:, 0]
        value = xi - missed
        # Changes of the quantity for a unit change of xi along self-motions
        slow, fast = np.quantile((left / own)[finite], RULES.quantiles)
        # The best monotone function of xi: what it leaves is not determined by xi
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
        """Rates of the first coordinate and the first quantity along the unit self-motion z of any sign, (N,) each."""
        z = samples.null_basis[:, :, 0]
        slopes = self._slopes(samples.points)[0].reshape(len(samples), len(self.names), -1)[:, 0]
        J = coordinates.once("jacobian", samples.points)[:, : samples.points.shape[1]]
        return tuple(np.einsum("sn,sn->s", rows, z) for rows in (J.reshape(len(samples), -1, z.shape[1])[:, 0], slopes))

    def measure_distances(self, problem: Problem, coordinates: Coordinates, seed: int) -> dict[str, float]:
        """Root mean square angle of each coordinate's gradient to its quantity's, projected across the task [deg]."""
        samples, k = sample_problem(problem, RULES.held_out, (seed, RULES.held_out)), len(self.names)
        J, Z = coordinates.jacobian(samples.points)[:, :k], samples.null_basis
        left = self.differentiate(samples.points) @ Z
        squares = np.einsum("skn,skn->sk", J, samples.compute_metric_gradients(J))
        lengths = np.sqrt(squares) * np.linalg.norm(left, axis=2)
        cosines = np.einsum("skz,skz->sk", J @ Z, left) / np.maximum(lengths, RULES.still)
        angles = np.degrees(np.sqrt((np.arccos(np.clip(cosines, -1, 1)) ** 2).mean(axis=0)))
        return dict(zip(self.names, angles.tolist(), strict=True))


def _split_directions(samples: Samples) -> Array:
    """Orthonormal bases (N, n, n); the last r columns span ker J_x. With r = 1, z has det [J_x; z^T] > 0."""
    J = samples.task_jacobian
    B = np.linalg.svd(J)[2].transpose(0, 2, 1)
    if J.shape[1] == J.shape[2] - 1:
        B[:, :, -1] *= np.sign(np.linalg.det(np.concatenate([J, B[:, None, :, -1]], axis=1)))[:, None]
    return np.asarray(B)


def _require_arms(robot: Robot, q: ca.SX, values: ca.SX) -> ca.Function:
    """Quantities as a function of q. Raise InvalidValueError if a floating base moves them, as it must not move xi."""
    base = list(robot.tree.floating)
    if base and ca.depends_on(values, q[base]):
        raise InvalidValueError("like", "a quantity that a floating base moves", "a quantity of the arms' joints")
    return dense_function("like", [q], [values])


@dataclass(frozen=True)
class LikeTerm:
    """Mean over quantities of the squared relative difference between the gradients v_xi,j and g_j, across the task.

    With an A-orthonormal basis z_1..z_r of ker J_x, the residuals are (v_xi,j - g_j) . z_k / |g_j|_A^-1, where g_j is
    the gradient of quantity j.
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
        """Coefficients (r K,) of combinations of the coordinates; the first k are nearest to the quantities.

        The others have combinations orthogonal to those.
        """
        C = theta.reshape(family.outputs, family.width)
        G = gradients.expand(gradients.at(samples.points), len(samples))
        Z = samples.null_basis
        # Components of the gradients along ker J_x
        own = np.einsum("rk,snk,snz->szr", C, G, Z, optimize=True).reshape(-1, len(C))
        slopes = _require_finite(self.batched(samples.points)[0].reshape(len(samples), self.count, -1))
        targets = (slopes @ Z).transpose(0, 2, 1)
        B = np.linalg.lstsq(own, targets.reshape(-1, self.count), rcond=None)[0].T  # (k, r)
        if np.linalg.matrix_rank(B) < self.count:
            came = "quantities that self-motions cannot change independently"
            raise InvalidValueError("like", came, "others, or another task")
        return np.asarray((np.vstack([B, np.linalg.svd(B)[2][self.count :]]) @ C).ravel())


class QuadraticTerm(NamedTuple):
    """The term c^T E c - 2 g^T c + a of a coordinate's coefficients c (K,)."""

    E: Array
    g: Array
    a: float


@dataclass(frozen=True)
class MeaningError:
    """How far a coordinate is from a quantity at samples of the domain, not only at home."""

    rms: float  #: root mean square difference, in the unit of the quantity; differences of angles are wrapped
    undetermined: float  #: the same after the best monotone map of the coordinate
    correlation: float  #: between coordinate and quantity; angles are taken within half a turn of the coordinate
    against: float  #: share of the positions at which self-motions change the two with opposite signs
    slow: float  #: 5 % quantile of the quantity's change for a unit change of the coordinate, along self-motions
    fast: float  #: 95 % quantile of that

    @property
    def explained(self) -> str:
        """How far the coordinate is from its quantity, in words."""
        rates = f"moves it by {self.slow:.2g} to {self.fast:.2g} (5 to 95 %) for each unit"
        off = f"{self.rms:.2g} off (rms), {self.undetermined:.2g} after the best monotone map"
        against = f"against it on {percent(self.against, fault=True)} of the domain, where it turns back"
        return f"{rates}, {off}, correlation {self.correlation:.2f}, {against}"

    def write_notes(self) -> dict[str, float]:
        """The errors as notes of a chart."""
        return {
            "error of its meaning": self.rms,
            "error after the best monotone map": self.undetermined,
            "correlation with its meaning": self.correlation,
            "share against its meaning": self.against,
            "slow rate of its meaning": self.slow,
            "fast rate of its meaning": self.fast,
        }
