"""Metrics A(q) on joint space. They define what "orthogonal" means."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, MetricError, ShapeError
from orthocas.robots.pinocchio_model import suggest_lock
from orthocas.robots.robot import Robot
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, freeze_array, require_kind, require_known, require_text
from orthocas.tools.display import listed
from orthocas.tools.expressions import HoldsFunctions, build_expression, call_user

METRIC_KINDS = ("euclidean", "inertia")
MetricSpec = str | ArrayLike | Callable[[ca.SX], ca.SX]  #: what `Metric.from_spec` accepts
_SINGULAR = 1e-12  #: eigenvalue, relative to the largest entry, that counts as zero
_TAKES_PART = 0.1  #: a joint takes part in a motion if its entry is above this fraction of the largest one


@dataclass(frozen=True, eq=False)
class Metric(HoldsFunctions):
    """A symmetric positive definite A(q), (n, n). Use `from_spec` or `custom` to build one."""

    name: str  #: euclidean, inertia, constant, custom, or a name of your own
    function: ca.Function  #: q (n, 1) -> A (n, n), dense, SX
    recipe: dict[str, Any] = field(repr=False)  #: plain data for chart files

    @classmethod
    def from_spec(cls, robot: Robot, spec: MetricSpec) -> Self:
        """Build from "euclidean", "inertia", a constant matrix (n, n), or a map q -> A(q) on SX.

        `orthocas.register_metric` adds further names.

        Raises:
            UnknownNameError: if the name is unknown.
            ShapeError: if A is not (n, n).
            MetricError: if a constant A is not symmetric positive definite, or a joint without mass makes M(q) singular
                everywhere. The message names the joint.
        """
        require_kind("robot", robot, Robot)
        q = ca.SX.sym("q", robot.n)
        # Look for a registered name, then for a built-in one.
        if isinstance(spec, str) and spec in _REGISTERED:
            built = call_user(f"metric '{spec}'", "a builder that takes this robot", _REGISTERED[spec], robot)
            return cls.custom(robot, spec, built)
        if isinstance(spec, str):
            require_known("metric", spec, (*METRIC_KINDS, *_REGISTERED))
            if spec == "inertia":
                require_mass(robot, "the inertia metric")
            A = robot.function("mass_matrix")(q) if spec == "inertia" else ca.SX.eye(robot.n)
            return cls(spec, dense_function("metric", [q], [A]), {"kind": spec})
        if callable(spec):
            return cls.custom(robot, "custom", spec)
        matrix = freeze_array("metric", spec, (robot.n, robot.n))
        require_spd(matrix[None], np.zeros((1, robot.n)))
        return cls(
            "constant",
            dense_function("metric", [q], [ca.SX(ca.DM(matrix))]),
            {"kind": "constant", "matrix": matrix.tolist()},
        )

    @classmethod
    def custom(cls, robot: Robot, name: str, function: Callable[[ca.SX], ca.SX] | ca.Function) -> Self:
        """A metric of your own, as a CasADi expression.

        Args:
            robot: the robot.
            name: a name for reports.
            function: maps an SX column q (n, 1) to a symmetric positive definite A (n, n).

        Raises:
            ShapeError: if A is not (n, n).

        Example:
            >>> import casadi as ca
            >>> import orthocas as oc
            >>> from orthocas.tasks.metric import Metric
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
            >>> metric = Metric.custom(robot, "stiff elbow", lambda q: ca.diag(ca.vertcat(1, 2 + ca.cos(q[1]))))
            >>> oc.Problem(robot, oc.Task.position(robot, "x"), metric).metric.name
            'stiff elbow'
        """
        require_text("name of a metric", str(name))
        require_kind("robot", robot, Robot)
        q = ca.SX.sym("q", robot.n)
        A = build_expression("metric", function, q)
        if A.shape != (robot.n, robot.n):
            raise ShapeError("metric", A.shape, (robot.n, robot.n))
        return cls(str(name), dense_function("metric", [q], [A]), {"kind": "custom", "name": str(name)})

    @cached_property
    def batched(self) -> Batched:
        """Evaluates A at many points."""
        return Batched(self.function)

    def evaluate(self, points: Array) -> Array:
        """A at points (N, n), as an array (N, n, n).

        Raises:
            MetricError: if a matrix is not symmetric positive definite.
        """
        n = points.shape[1]
        if self.is_identity:
            return np.broadcast_to(np.eye(n), (len(points), n, n))
        A = self.batched(points)[0].reshape(-1, n, n)
        missing = ": give links between these joints mass or armature, lock one, or take metric='euclidean'"
        require_spd(A, points, missing if self.is_inertia else "")
        return A

    @property
    def is_identity(self) -> bool:
        """Whether A = I everywhere."""
        return bool(self.recipe["kind"] == "euclidean")

    @property
    def is_inertia(self) -> bool:
        """Whether A = M, the mass matrix."""
        return bool(self.recipe["kind"] == "inertia")


_REGISTERED: dict[str, Callable[[Robot], Callable[[ca.SX], ca.SX]]] = {}


def register_metric(name: str, build: Callable[[Robot], Callable[[ca.SX], ca.SX]]) -> None:
    """Let `Problem` and the option --metric build a metric of your own by its name. Files need no registration.

    Args:
        name: a short name.
        build: makes the map of q to A(q), as for `Metric.custom`, from a robot.

    Raises:
        InvalidValueError: if the name is taken.

    Example:
        >>> import casadi as ca
        >>> import orthocas as oc
        >>> oc.register_metric("stiff base", lambda robot: lambda q: ca.diag(ca.vertcat(5, ca.SX.ones(robot.n - 1))))
        >>> robot = oc.Robot.planar([1.0, 1.0], [3.0, 3.0])
        >>> oc.Problem(robot, oc.Task.position(robot, "x"), "stiff base").metric.name
        'stiff base'
    """
    require_text("name", name)
    if name in METRIC_KINDS or _REGISTERED.get(name, build) is not build:
        raise InvalidValueError("name", repr(name), "a name that is not taken")
    if not callable(build):
        raise InvalidValueError("build", repr(build)[:80], "a function of a robot")
    _REGISTERED[name] = build


def require_spd(matrices: Array, points: Array, advice: str = "") -> None:
    """Raise MetricError, with the worst point, unless all matrices (N, n, n) are symmetric positive definite."""
    if not len(matrices):
        return
    size = np.abs(matrices).max(axis=(1, 2))
    if not np.isfinite(size).all():
        at = points[np.flatnonzero(~np.isfinite(size))[0]]
        raise MetricError(
            f"metric is not finite at q = {np.round(at, 4).tolist()}, expected symmetric positive definite"
        )
    # Differences are relative to the largest entry, since units differ.
    asymmetry = np.abs(matrices - matrices.transpose(0, 2, 1)).max(axis=(1, 2))
    worst = int(np.argmax(asymmetry - 1e-9 * size))
    if asymmetry[worst] > 1e-9 * size[worst]:
        raise MetricError(
            f"metric is not symmetric at q = {np.round(points[worst], 4).tolist()} "
            f"(difference {asymmetry[worst]:.3g}), expected symmetric positive definite"
        )
    # Try a Cholesky factorisation first, which is faster than eigenvalues.
    with suppress(np.linalg.LinAlgError):
        np.linalg.cholesky(matrices - _SINGULAR * size[:, None, None] * np.eye(matrices.shape[1]))
        return
    # Compute the eigenvalue for the message.
    smallest = np.linalg.eigvalsh(matrices)[:, 0]
    worst = int(np.argmin(smallest - _SINGULAR * size))
    if smallest[worst] <= _SINGULAR * size[worst]:
        # Name the joints that take part in the motion of this eigenvalue.
        motion = np.abs(np.linalg.eigh(matrices[worst])[1][:, 0])
        joints = listed(str(k + 1) for k in np.flatnonzero(motion > _TAKES_PART * motion.max()))
        raise MetricError(
            f"metric has eigenvalue {smallest[worst]:.3g} at q = {np.round(points[worst], 4).tolist()} along a motion "
            f"of joints {joints} (numbered from 1), expected symmetric positive definite{advice}"
        )


def require_mass(robot: Robot, use: str) -> None:
    """Raise MetricError if M(q) is singular at several postures, with the massless joint and the use of the mass."""
    M = robot.mass_matrix(np.random.default_rng(0).uniform(-1, 1, (4, robot.n)))
    values, vectors = np.linalg.eigh(M)
    if np.all(values[:, 0] <= _SINGULAR * np.abs(M).max(axis=(1, 2))):
        joint = robot.joint_names[int(np.argmax(np.abs(vectors[0, :, 0])))]
        raise MetricError(
            f"joint '{joint}' moves no mass, so M(q) is singular, expected mass or armature for {use}: "
            f"give the joint's link a mass in the robot file, or {suggest_lock(joint)}"
        )
