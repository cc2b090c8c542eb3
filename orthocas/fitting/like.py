"""Coordinates that are like given quantities: gradients as near to theirs as they can be across the task."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from orthocas.bases.family import LinearFamily
from orthocas.bases.given import sew_angle
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import InvalidValueError
from orthocas.fitting.basis_gradients import BasisGradients
from orthocas.fitting.terms import Data, Sizes, metric_lengths
from orthocas.robots.robot import Robot
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_known, require_shape
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.expressions import build_expression, write_tape

Quantity = Callable[[ca.SX], ca.SX]  #: a function of an SX column q
Likeness = Task | Quantity | str | Sequence[Quantity | str]  #: what coordinates may be like
SWIVEL = "swivel"  #: the name of the angle of the elbow
WEIGHT = 300.0  #: of the term, between task (1000) and mutual angles (30)
_HELD_OUT = 2000  # samples of the distances
_STILL = 1e-9  # of the largest projected gradient


def quantity_of(robot: Robot, like: Quantity | str) -> tuple[str, ca.Function]:
    """Its name with a unit, and q (n, 1) -> the quantity (1, 1): a joint, the swivel, or a function of q."""
    q = ca.SX.sym("q", robot.n)
    if isinstance(like, str):
        require_known("like", like, (SWIVEL, *robot.joint_names))
        if like == SWIVEL:
            return f"{SWIVEL} [rad]", sew_angle(robot, "conventional")
        k = robot.joint_names.index(like)
        return f"{like} [{'m' if robot.tree.prismatic[k] else 'rad'}]", dense_function("like", [q], [q[k]])
    found = build_expression("like", like, q)
    require_shape("like", found.shape, (1, 1))
    name = str(getattr(like, "__name__", ""))
    return name if name.isidentifier() else "a function of q", dense_function("like", [q], [found])


def like_label(name: str, where: str = "") -> str:
    """What a coordinate means that is not its quantity, but like it: 'like swivel at home [rad]'."""
    words, bracket, unit = name.rpartition(" [") if name.endswith("]") else (name, "", "")
    return " ".join(filter(None, ("like", words, where))) + bracket + unit


def _finite(slopes: Array) -> Array:
    """The gradients of quantities, if all numbers are finite."""
    if not np.isfinite(slopes).all():
        raise InvalidValueError(
            "like", "quantities without a finite gradient in the domain", "others, or a smaller domain"
        )
    return slopes


def _digest(function: ca.Function) -> str:
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
            return cls(names, _of_arms(robot, q, like.smooth_function(q)))
        parts = [like] if isinstance(like, str) or not isinstance(like, Sequence) else like
        found = [quantity_of(robot, part) for part in parts]
        if not found:
            raise InvalidValueError("like", "an empty list", "at least one quantity")
        values = ca.vertcat(*(function(q) for _, function in found))
        return cls(tuple(name for name, _ in found), _of_arms(robot, q, values))

    @property
    def label(self) -> str:
        """What the coordinates mean, for the notes of a chart: 'like q3 [rad]; like height'."""
        return "; ".join(like_label(name) for name in self.names)

    def require_at_most(self, count: int) -> None:
        """Raise InvalidValueError if there are more quantities than coordinates."""
        if len(self.names) > count:
            raise InvalidValueError("like", f"{len(self.names)} quantities", f"at most {count}, one for a coordinate")

    def slopes(self, points: Array) -> Array:
        """dy/dq at points (N, n), (N, k, n)."""
        return _finite(self._slopes(points)[0].reshape(len(points), len(self.names), -1))

    @cached_property
    def _slopes(self) -> BlockedFunction:
        q = ca.SX.sym("q", self.function.numel_in(0))
        return BlockedFunction(dense_function("slopes", [q], [ca.jacobian(self.function(q), q)]))

    def term(self, problem: Problem, active: list[int]) -> "LikeTerm":
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
        return LikeTerm(f"like {_digest(slopes)}", len(self.names), slopes)  # functions of a loss are kept by names

    def named(self, coordinates: Coordinates, problem: Problem) -> Coordinates:
        """Coordinates in the units of their quantities, with their values at the centre of the domain."""
        k, centre = len(self.names), problem.domain.centre
        offset, scale = coordinates.offset.copy(), coordinates.scale.copy()
        raw = coordinates.once("xi", centre[None])[0, :k] / scale[:k] + offset[:k]
        offset[:k], scale[:k] = raw - np.array(self.function(centre))[:, 0], 1.0
        return replace(coordinates, offset=offset, scale=scale)

    def distances(self, problem: Problem, coordinates: Coordinates, seed: int) -> dict[str, float]:
        """Root mean square angles between gradients of coordinates and what the task leaves of quantities' [deg]."""
        samples, k = sample_problem(problem, _HELD_OUT, (seed, _HELD_OUT)), len(self.names)
        J, Z = coordinates.jacobian(samples.points)[:, :k], samples.null_basis
        left = self.slopes(samples.points) @ Z
        lengths = np.sqrt(np.einsum("skn,skn->sk", J, samples.compute_metric_gradients(J))) * np.linalg.norm(
            left, axis=2
        )
        cosines = np.einsum("skz,skz->sk", J @ Z, left) / np.maximum(lengths, _STILL)
        angles = np.degrees(np.sqrt((np.arccos(np.clip(cosines, -1, 1)) ** 2).mean(axis=0)))
        return dict(zip(self.names, angles.tolist(), strict=True))


def _of_arms(robot: Robot, q: ca.SX, values: ca.SX) -> ca.Function:
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
        wanted = self.slopes(data["points"])
        whole = ca.repmat(metric_lengths(wanted, A) + _STILL, 1, sizes.r)
        rho: ca.SX = (1 / self.count) ** 0.5 * ca.vec(((coordinate_jacobian[: self.count, :] - wanted) @ Z / whole).T)
        return rho

    @cached_property
    def batched(self) -> BlockedFunction:
        """Evaluates dy/dq at many points."""
        return BlockedFunction(self.slopes)

    def turned(self, family: LinearFamily, theta: Array, samples: Samples, gradients: BasisGradients) -> Array:
        """Combinations of coordinates, (r K,): the first k are nearest to the quantities, the others across them."""
        C = theta.reshape(family.outputs, family.width)
        G = gradients.dense(gradients.at(samples.points), len(samples))
        Z = samples.null_basis
        own = np.einsum("rk,snk,snz->szr", C, G, Z, optimize=True).reshape(-1, len(C))  # components across the task
        slopes = _finite(self.batched(samples.points)[0].reshape(len(samples), self.count, -1))
        wanted = (slopes @ Z).transpose(0, 2, 1)
        B = np.linalg.lstsq(own, wanted.reshape(-1, self.count), rcond=None)[0].T  # (k, r)
        if np.linalg.matrix_rank(B) < self.count:
            raise InvalidValueError("like", "quantities that the task leaves nothing of", "others, or another task")
        return np.asarray((np.vstack([B, np.linalg.svd(B)[2][self.count :]]) @ C).ravel())
