"""Coordinates built on another family: angles of pairs of functions ([AS2023] Sec. 5.1.1; ours), and mobile bases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from orthocas.bases.family import (
    TURN,
    CombinableFamily,
    Expression,
    Family,
    JointSpace,
    LinearFamily,
    Parametrisation,
    component_gradients,
)
from orthocas.errors import InvalidValueError
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

if TYPE_CHECKING:
    from orthocas.tasks.problem import Problem


@dataclass(frozen=True)
class Circle:
    """Angles xi_j = atan2(v_j, u_j) in (-pi, pi] of pairs (u_j, v_j) from another parametrisation.

    (u_j, v_j) / |(u_j, v_j)| is a point of the unit circle, and smooth wherever the pair is not zero. So one coordinate
    can cover a closed leaf without a fold. The jump from pi to -pi may lie anywhere on it.

    Args:
        pairs: the parametrisation of the pairs: a network, polynomials or Fourier terms, without cyclic joints.

    Raises:
        InvalidValueError: if the pairs cannot be fitted, or are angles themselves.

    Example:
        >>> import orthocas as oc
        >>> oc.Circle(oc.Fourier(3)).label
        'circle:fourier:3'
    """

    pairs: Parametrisation
    linear = False
    closed_form = None

    def __post_init__(self) -> None:
        fitted = isinstance(self.pairs, Parametrisation) and not isinstance(self.pairs, type)
        if not fitted or self.pairs.closed_form is not None or isinstance(self.pairs, Circle):
            raise InvalidValueError("pairs", repr(self.pairs)[:80], "a parametrisation to fit, such as Fourier(3)")
        if getattr(self.pairs, "cyclic", ()):
            raise InvalidValueError("pairs", self.pairs.label, "a parametrisation whose joints are not cyclic")

    @property
    def label(self) -> str:
        """'circle:' and the label of the pairs."""
        return f"circle:{self.pairs.label}"

    def for_problem(self, problem: Problem) -> Circle:
        """The parametrisation with pairs for this problem."""
        return Circle(self.pairs.for_problem(problem))

    def family(self, space: JointSpace, outputs: int) -> CircleFamily:
        """The family on the given joints.

        Raises:
            InvalidValueError: if the family of the pairs does not contain linear combinations of its functions.
        """
        pairs = self.pairs.family(space, 2 * outputs)
        if not isinstance(pairs, CombinableFamily):
            raise InvalidValueError(
                "pairs", self.pairs.label, "a family with the method `combined`, see CombinableFamily"
            )
        return CircleFamily(pairs, outputs)


@dataclass(frozen=True, eq=False)
class CircleFamily:
    """Angles of pairs. theta holds the parameters of u_1..u_r, v_1..v_r, then a constant for each of these functions.

    Families with constants of their own, such as networks, need no further ones.
    """

    pairs: Family
    outputs: int

    @cached_property
    def constants(self) -> int:
        """Number of additional constants: 2 r for families without constants, otherwise 0."""
        return 2 * self.outputs if isinstance(self.pairs, LinearFamily) else 0

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.pairs.size + self.constants

    @property
    def periods(self) -> Array:
        """Period 2 pi for each component, (r,)."""
        return np.full(self.outputs, TURN)

    @property
    def as_matrices(self) -> bool:
        """The value of the family of the pairs."""
        return self.pairs.as_matrices

    @property
    def width(self) -> int:
        """The value of the family of the pairs."""
        return self.pairs.width

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """Angles in (-pi, pi], (r, N), for q (n, N)."""
        u, v = self._pairs(q, theta)
        angles: Expression = ca.atan2(v, u)
        return angles

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients (u dv - v du) / (u^2 + v^2), r matrices (n, N)."""
        # Divide the gradients of u and v by |(u, v)|^2, then combine them.
        u, v = self._pairs(q, theta)
        slopes = self.pairs.jacobian(q, theta[: self.pairs.size])
        squared, n = u**2 + v**2, q.shape[0]
        gradients: list[Any] = []
        for j in range(self.outputs):
            along_u, along_v = (ca.repmat(part[j, :] / squared[j, :], n, 1) for part in (u, v))
            gradients.append(along_u * slopes[self.outputs + j] - along_v * slopes[j])
        return gradients

    def initial(self, seed: int) -> Array:
        """Starting point of the pairs, with constants of zero, (size,)."""
        return np.concatenate([self.pairs.initial(seed), np.zeros(self.constants)])

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """Parameters of the coordinates in another order, (size,)."""
        pick, none = np.eye(self.outputs)[list(order)], np.zeros((self.outputs, self.outputs))
        return self._combine(theta, np.block([[pick, none], [none, pick]]))

    def turned(self, theta: Array, angles: Array) -> Array:
        """Parameters of xi - angles, (size,): each pair is rotated by minus its angle (r,) [rad]."""
        # Rotate the plane of each pair.
        c, s = np.diag(np.cos(angles)), np.diag(np.sin(angles))
        return self._combine(theta, np.block([[c, s], [-s, c]]))

    def _combine(self, theta: Array, B: Array) -> Array:
        """Parameters of the pairs B (u, v), for a matrix B (2 r, 2 r)."""
        own, rest = theta[: self.pairs.size], theta[self.pairs.size :]
        assert isinstance(self.pairs, CombinableFamily)
        return np.concatenate([self.pairs.combined(own, B), B @ rest if self.constants else rest])

    def _pairs(self, q: Expression, theta: Expression) -> tuple[Expression, Expression]:
        """u and v, (r, N) each."""
        values = self.pairs.expression(q, theta[: self.pairs.size])
        if self.constants:
            values = values + ca.repmat(theta[self.pairs.size :], 1, q.shape[1])
        return values[: self.outputs, :], values[self.outputs :, :]


# Factor on the arm's own starting point if the coordinates move with a base.
_START = 0.03
# Number of coordinates that move with the base: two of its position, and its heading.
_ON_PLANE = 3


@dataclass(frozen=True)
class Mobile:
    """Coordinates that turn and shift with a base that moves in the plane.

    With the position p = (x, y) and the heading t of the base, and functions f of the arm's joints a,

        (xi_1, xi_2) = p + R(t) (f_1(a) + b_1, f_2(a) + b_2),  xi_3 = t + f_3(a),  xi_k = c_k t + f_k(a) for k > 3.

    A motion in the plane turns and shifts (xi_1, xi_2) and adds its angle to t; it does the same to the tip. If the
    metric does not depend on position and heading, J_x A^-1 J_xi^T and det J are therefore those at p = 0, t = 0, up to
    a rotation. So a chart holds everywhere on the plane, and `fit` makes the domain unbounded there.

    Args:
        arm: the parametrisation of f: polynomials, Fourier terms or a network, without cyclic joints.
        base: names of three joints: two that slide along the world's x and y, and one that then turns about z. Default:
            those of `Robot.from_urdf(..., base="planar")`.

    Raises:
        InvalidValueError: if f cannot be fitted, or there are not three different names.

    Example:
        >>> import orthocas as oc
        >>> oc.Mobile(oc.Polynomial(2)).label
        'mobile:polynomial:2'

    Source:
        ours, docs/how-to/mobile_base.md.
    """

    arm: Parametrisation
    base: tuple[str, ...] = ("base_x", "base_y", "base_heading")
    linear = False
    closed_form = None

    def __post_init__(self) -> None:
        # Check that f can be fitted and has no cyclic joints.
        fitted = isinstance(self.arm, Parametrisation) and not isinstance(self.arm, type)
        if not fitted or self.arm.closed_form is not None or isinstance(self.arm, Mobile):
            raise InvalidValueError("arm", repr(self.arm)[:80], "a parametrisation to fit, such as Polynomial(2)")
        if getattr(self.arm, "cyclic", ()):
            raise InvalidValueError("arm", self.arm.label, "a parametrisation whose joints are not cyclic")
        names = tuple(self.base) if isinstance(self.base, tuple | list) else ()
        if len({*names}) != _ON_PLANE or not all(isinstance(name, str) for name in names):
            raise InvalidValueError("base", repr(self.base)[:80], "names of three joints: x, y and the heading")
        object.__setattr__(self, "base", names)

    @property
    def label(self) -> str:
        """'mobile:' and the label of the arm's functions."""
        return f"mobile:{self.arm.label}"

    def for_problem(self, problem: Problem) -> Mobile:
        """The parametrisation with functions for this problem.

        Raises:
            InvalidValueError: if the joints of the base do not slide along x and y and then turn about z.
        """
        tree = problem.robot.tree
        missing = [name for name in self.base if name not in tree.joint_names]
        if missing:
            raise InvalidValueError("base", repr(missing[0]), f"one of the joints {', '.join(tree.joint_names)}")
        # The first three joints from the world on must be x, y and the heading, exactly along the axes of the world.
        R, parent = np.eye(3), -1
        for name, kind, axis in zip(self.base, ("prismatic", "prismatic", "revolute"), range(3), strict=True):
            k = tree.joint_names.index(name)
            R = R @ tree.rotations[k]
            if tree.joint_kinds[k] != kind or tree.parents[k] != parent or np.abs(R[:, 2] - np.eye(3)[axis]).max() > 0:
                wanted = "joints that slide along x, then along y, and then turn about z, from the world on"
                raise InvalidValueError("base", repr(name), wanted)
            parent = k
        return Mobile(self.arm.for_problem(problem), self.base)

    def family(self, space: JointSpace, outputs: int) -> MobileFamily:
        """The family on the given joints.

        Raises:
            InvalidValueError: if there are fewer than three coordinates, or joints of the base are missing.
        """
        if outputs < _ON_PLANE:
            raise InvalidValueError("extra coordinates of a mobile base", outputs, f"at least {_ON_PLANE}")
        for name in self.base:
            if name not in space.joint_names:
                raise InvalidValueError(f"joint '{name}' of the base", "an idle joint", "one that moves the task")
        places = tuple(space.joint_names.index(name) for name in self.base)
        joints = tuple(i for i in range(space.n) if i not in places)
        return MobileFamily(self.arm.family(space.restricted_to(list(joints)), outputs), places, joints)


@dataclass(frozen=True, eq=False)
class MobileFamily:
    """The coordinates of `Mobile`. theta holds the parameters of f, then b_1, b_2, then c_4..c_r."""

    arm: Family
    places: tuple[int, ...]  #: indices of the base's joints
    joints: tuple[int, ...]  #: indices of the arm's joints

    @property
    def outputs(self) -> int:
        """Number r of components."""
        return self.arm.outputs

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.arm.size + 2 + self.outputs - _ON_PLANE

    @property
    def as_matrices(self) -> bool:
        """The value of the arm's family."""
        return self.arm.as_matrices

    @property
    def width(self) -> int:
        """The value of the arm's family."""
        return self.arm.width

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi, (r, N), for q (n, N)."""
        # Coordinates of the arm; the first two are in the axes of the base.
        own, rest = theta[: self.arm.size], theta[self.arm.size :]
        f = self.arm.expression(q[list(self.joints), :], own)
        x, y, heading = (q[i, :] for i in self.places)
        ahead, aside = f[0, :] + rest[0], f[1, :] + rest[1]
        # Turn them by the heading and shift them by the position.
        c, s = ca.cos(heading), ca.sin(heading)
        rows = [x + c * ahead - s * aside, y + s * ahead + c * aside, heading + f[2, :]]
        rows += [rest[k - 1] * heading + f[k, :] for k in range(_ON_PLANE, self.outputs)]
        xi: Expression = ca.vertcat(*rows)
        return xi

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """Coordinates close to position and heading of the base, (size,).

        If f_1 and f_2 start larger, a fit may let them grow without bound, so that the base's position becomes
        negligible.
        """
        return np.concatenate([_START * self.arm.initial(seed), np.zeros(self.size - self.arm.size)])
