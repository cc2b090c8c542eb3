"""Coordinates of an arm on a mobile base, as good at every place and heading as at one."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from orthocas.bases.family import Expression, Family, JointSpace, Parametrisation, component_gradients
from orthocas.errors import InvalidValueError
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array

_START = 0.03  # of the arm's own start
_ON_PLANE = 3  # coordinates that move with the base: two of its place, and the heading


@dataclass(frozen=True)
class Mobile:
    """Coordinates that turn and shift with a base that moves on a plane.

    With the place p = (x, y) and the heading t of the base, and functions f of the arm's joints a,

        (xi_1, xi_2) = p + R(t) (f_1(a) + b_1, f_2(a) + b_2),  xi_3 = t + f_3(a),  xi_k = c_k t + f_k(a) for k > 3.

    A motion of the plane turns and shifts (xi_1, xi_2), adds its angle to t, and does the same to the tip. So where the
    metric does not depend on place and heading, J_x A^-1 J_xi^T and det J are those at p = 0, t = 0, up to a rotation:
    a chart holds everywhere on the plane, and `fit` takes away the ends of the domain there.

    Args:
        arm: the parametrisation of f: polynomials, Fourier terms or networks, without cyclic joints.
        base: names of the two joints that slide along the world's x and y, and of the one that turns about z after
            them. Default: those of `Robot.from_urdf(..., base="planar")`.

    Raises:
        InvalidValueError: if f cannot be fitted, or the names are not three.

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
        fitted = isinstance(self.arm, Parametrisation) and not isinstance(self.arm, type)
        if not fitted or self.arm.closed_form is not None or isinstance(self.arm, Mobile):
            raise InvalidValueError("arm", repr(self.arm)[:80], "a parametrisation to fit, such as Polynomial(2)")
        if getattr(self.arm, "cyclic", ()):
            raise InvalidValueError("arm", self.arm.label, "a parametrisation without cyclic joints")
        names = tuple(self.base) if isinstance(self.base, tuple | list) else ()
        if len({*names}) != _ON_PLANE or not all(isinstance(name, str) for name in names):
            raise InvalidValueError("base", repr(self.base)[:80], "names of three joints: x, y and the heading")
        object.__setattr__(self, "base", names)

    @property
    def label(self) -> str:
        """'mobile:' and the label of the arm's functions."""
        return f"mobile:{self.arm.label}"

    def for_problem(self, problem: Problem) -> "Mobile":
        """The parametrisation with functions for this problem.

        Raises:
            InvalidValueError: if the joints of the base do not slide along x and y and then turn about z.
        """
        tree = problem.robot.tree
        missing = [name for name in self.base if name not in tree.joint_names]
        if missing:
            raise InvalidValueError("base", repr(missing[0]), f"joints of {', '.join(tree.joint_names)}")
        R, parent = np.eye(3), -1
        for name, kind, axis in zip(self.base, ("prismatic", "prismatic", "revolute"), range(3), strict=True):
            k = tree.joint_names.index(name)
            R = R @ tree.rotations[k]
            if tree.joint_kinds[k] != kind or tree.parents[k] != parent or np.abs(R[:, 2] - np.eye(3)[axis]).max() > 0:
                wanted = "joints that slide along x, then along y, and then turn about z, from the world on"
                raise InvalidValueError("base", repr(name), wanted)
            parent = k
        return Mobile(self.arm.for_problem(problem), self.base)

    def family(self, space: JointSpace, outputs: int) -> "MobileFamily":
        """The family on the given joints.

        Raises:
            InvalidValueError: if there are less than three coordinates, or joints of the base are missing.
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
    places: tuple[int, ...]  #: of the base's joints
    joints: tuple[int, ...]  #: of the arm

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
        """As the functions of the arm."""
        return self.arm.as_matrices

    @property
    def width(self) -> int:
        """As the functions of the arm."""
        return self.arm.width

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi, (r, N), for q (n, N)."""
        own, rest = theta[: self.arm.size], theta[self.arm.size :]
        f = self.arm.expression(q[list(self.joints), :], own)
        x, y, heading = (q[i, :] for i in self.places)
        ahead, aside = f[0, :] + rest[0], f[1, :] + rest[1]
        c, s = ca.cos(heading), ca.sin(heading)
        rows = [x + c * ahead - s * aside, y + s * ahead + c * aside, heading + f[2, :]]
        rows += [rest[k - 1] * heading + f[k, :] for k in range(_ON_PLANE, self.outputs)]
        xi: Expression = ca.vertcat(*rows)
        return xi

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """Nearly the place and the heading of the base, (size,).

        With larger f_1 and f_2, a fit can let them grow without end, so that (xi_1, xi_2) leaves the place out.
        """
        return np.concatenate([_START * self.arm.initial(seed), np.zeros(self.size - self.arm.size)])


def anywhere(problem: Problem, base: tuple[str, ...]) -> Problem:
    """The problem on a domain without ends in those joints of the base that have no limits."""
    robot, domain = problem.robot, problem.domain
    places = [robot.joint_names.index(name) for name in base]
    free = {k for k in places if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])}
    if free <= {*domain.unbounded}:
        return problem
    wider = domain.apply_to(Box(domain.centre, domain.half_width, sorted(free | {*domain.unbounded})))
    return Problem(robot, problem.task, problem.metric, wider, problem.name)
