"""Coordinates in closed form, which need no fit; for example the shoulder-elbow-wrist angle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca
import numpy as np

from orthocas.bases.family import TURN, ClosedForm, Expression, JointSpace, component_gradients
from orthocas.errors import InvalidValueError, RobotError
from orthocas.robots.kinematics import build_body_poses
from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.problem import Problem
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_count, require_known, require_shape, require_text
from orthocas.tools.expressions import Tape, build_expression, replay, require_tape, write_tape

SEWKind = Literal["conventional", "stereographic"]
SEW_KINDS: tuple[SEWKind, ...] = ("conventional", "stereographic")
# (e_t, e_r) in the world. The singular half-line e_t points down into the base. With e_r = -x, an arm with its elbow up
# that reaches along +x has psi = 0, far from the jump at +-pi.
DIRECTIONS = {"conventional": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), "stereographic": ((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))}


@dataclass(frozen=True, slots=True)
class GivenRules:
    """Numbers of closed-form coordinates and of the elbow angle."""

    most_joints: int = 1000  #: largest number of joints of a function without a robot
    meeting: float = 1e-5  #: [m]; axes nearer than this intersect
    parallel: float = 1e-6  #: [rad]; axes at a smaller angle are parallel


RULES = GivenRules()


@dataclass(frozen=True, eq=False)
class Given:
    """Coordinates xi(q) as a CasADi expression without parameters. Use `from_function` to build one.

    Args:
        label: a name for reports.
        n: number of joints.
        tape: the expression as plain data; see `orthocas.tools.expressions`.

    Raises:
        InvalidValueError: if the tape is malformed.
    """

    label: str
    n: int
    tape: Tape = field(repr=False)
    linear = True

    def __post_init__(self) -> None:
        require_text("label of given coordinates", self.label)
        require_tape(self.tape, require_count("n", self.n))

    @classmethod
    def from_function(cls, name: str, n: int, function: Callable[[ca.SX], ca.SX] | ca.Function) -> Given:
        """Build from a function of an SX column q (n, 1) that returns xi (r, 1).

        Raises:
            ShapeError: if xi is not a column.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> direction = oc.Given.from_function("hand direction", 3, lambda q: q[0] + q[1] + q[2])
            >>> chart = oc.fit(problems.get("planar_3r_xy"), direction).chart
            >>> chart.labels
            ('x', 'y', 'xi1')
        """
        q = ca.SX.sym("q", require_count("n", n, most=RULES.most_joints))
        xi = build_expression(f"coordinates '{name}'", function, q)
        require_shape(f"coordinates '{name}'", xi.shape, (None, 1))
        return cls(name, n, write_tape(dense_function("xi", [q], [xi])))

    def for_problem(self, problem: Problem) -> Given:
        """The same object: it does not depend on the problem."""
        return self

    def closed_form(self, problem: Problem) -> ClosedForm:
        """No parameters."""
        return ClosedForm(np.zeros(0))

    def family(self, space: JointSpace, outputs: int) -> GivenFamily:
        """The coordinates as a family without parameters.

        Raises:
            ShapeError: if the number of coordinates is not `outputs`, or the number of joints differs.
        """
        require_shape(f"q of coordinates '{self.label}'", (self.n,), (space.n,))
        require_shape(f"coordinates '{self.label}'", (self.tape["rows"], self.tape["columns"]), (outputs, 1))
        return GivenFamily(self, outputs)


@dataclass(frozen=True, eq=False)
class GivenFamily:
    """The family with the one function of a `Given`."""

    given: Given
    outputs: int
    size: int = 0
    as_matrices: bool = False

    @cached_property
    def width(self) -> int:
        """Number of operations on the tape."""
        return len(self.given.tape["steps"])

    @cached_property
    def periods(self) -> Array:
        """2 pi for components that are angles, 0 for others, (r,)."""
        return find_periods(self.given.tape)

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi(q), (r, N), for q (n, N)."""
        xi: Expression = ca.vertcat(*replay(self.given.tape, [q[i, :] for i in range(q.shape[0])]))
        return xi

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """An empty array: there are no parameters."""
        return np.zeros(0)


def find_periods(tape: Tape) -> Array:
    """2 pi for components that are results of atan2, and so jump by a full turn; 0 for others, (r,)."""
    angles, periods = set[int](), np.zeros(tape["rows"])
    for name, into, *of in tape["steps"]:
        if name == "output":
            periods[into] = TURN if of[0] in angles else 0.0
        elif name == "atan2" or (name == "assign" and of[0] in angles):
            angles.add(into)
        else:
            angles.discard(into)
    return periods


def sew_angle(robot: Robot, kind: str) -> ca.Function:
    """The SEW angle psi(q): the rotation of the elbow about the line from shoulder to wrist.

    S is the point where axes 1, 2 and 3 intersect, W the point where axes 5 and 6 intersect, and E the point of axis 4
    nearest to axis 3. With p_SE = E - S, p_SW = W - S and e_SW = p_SW / |p_SW|,

        k_r = (e_SW - e_t) x e_r,  k_x = k_r x p_SW,  psi = atan2(e_SW . (k_x x p_SE), k_x . p_SE).

    This is the right-handed angle about e_SW from the half-plane of k_x to the half-plane of E. If axis 7 also passes
    through W, a self-motion rotates E about a fixed line, and changes psi by the same angle. Otherwise W moves with the
    elbow. If these axes do not intersect, as on a Baxter, S is the point of axis 2 nearest to axis 3, and W is the
    point of axis 6 nearest to axis 5; these points move a little.

    - conventional: e_t = 0, e_r = z. Then k_x is the part of e_r across e_SW, and psi = 0 in the vertical plane of S
      and W with the elbow up. It is singular where W is straight above or straight below S, on a line that upright arms
      reach.
    - stereographic: e_t = -z, e_r = -x. Then k_x is e_r, rotated like e_SW from +z by the shortest way. It is singular
      only where W is straight below S, on a half-line inside the base of an upright arm.

    Both are undefined where S, E and W lie on one line, as in a stretched arm. Near a singularity the gradient grows
    like 1 / distance. At a singularity psi is arbitrary, and its gradient is huge or NaN. psi jumps between -pi and pi,
    but its gradient is continuous there.

    Args:
        robot: a chain of seven revolute joints. Its world's z axis is the up direction above.
        kind: one of `SEW_KINDS`.

    Returns:
        q (7, 1) [rad] -> psi (1, 1) [rad] in [-pi, pi], SX, dense.

    Raises:
        UnknownNameError: if there is no such kind.
        RobotError: if the robot is not a chain of seven revolute joints, or neighbouring axes are parallel.

    Source:
        Both angles and their singularities: [EW2024], for axes that intersect in S and W. Ours are: E as the foot of
        the common normal of axes 3 and 4, S and W for other arms, e_r = -x, and the conventional angle as the case e_t
        = 0.
    """
    require_known("SEW angle", kind, SEW_KINDS)
    tree = robot.tree
    tree.require_no_mimics("a shoulder-elbow-wrist angle")
    if tree.n != 7:
        raise RobotError(f"the robot has {tree.n} joints, expected 7 for a shoulder-elbow-wrist angle")
    for i, name in enumerate(tree.joint_names):
        if tree.joint_kinds[i] != "revolute":
            raise RobotError(f"joint '{name}' is {tree.joint_kinds[i]}, expected 7 revolute joints")
        if tree.parents[i] != i - 1:
            raise RobotError(f"joint '{name}' does not follow joint '{tree.joint_names[i - 1]}', expected a chain")
    q = ca.SX.sym("q", robot.n)
    poses = build_body_poses(tree, q)
    # Each point lies on a joint's axis, at a height above the origin of the joint's body. The height does not depend on
    # q, because neighbouring axes are fixed to each other. If axes 1, 2 and 3 intersect, S is fixed in the base and in
    # bodies 1 to 3, so it is a point of axis 1. If axes 5 and 6 intersect, W is a point of axis 5.
    shoulder, on_2, gap_12 = _find_common_normal(tree, 0)
    also_on_2, _, gap_23 = _find_common_normal(tree, 1)
    elbow = _find_common_normal(tree, 2)[1]
    wrist, on_6, gap_56 = _find_common_normal(tree, 4)
    meets = max(gap_12, gap_23, abs(on_2 - also_on_2)) <= RULES.meeting
    places = (
        (0, shoulder) if meets else (1, also_on_2),
        (3, elbow),
        (4, wrist) if gap_56 <= RULES.meeting else (5, on_6),
    )
    S, E, W = (poses[k][1] + poses[k][0][:, 2] * height for k, height in places)
    e_t, e_r = (ca.SX(ca.DM(direction)) for direction in DIRECTIONS[kind])
    return dense_function("sew_angle", [q], [compute_elbow_angle(E - S, W - S, e_t, e_r)])


def compute_elbow_angle(p_SE: ca.SX, p_SW: ca.SX, e_t: ca.SX, e_r: ca.SX) -> ca.SX:
    """psi from columns (3, 1); k_x need not have unit length."""
    e_SW = p_SW / ca.norm_2(p_SW)
    k_r = ca.cross(e_SW - e_t, e_r)
    k_x = ca.cross(k_r, p_SW)
    return ca.atan2(ca.dot(e_SW, ca.cross(k_x, p_SE)), ca.dot(k_x, p_SE))


def _find_common_normal(tree: KinematicTree, i: int) -> tuple[float, float, float]:
    """The common normal of axes i and i + 1: heights of its ends on the two axes, and its length [m]."""
    # Origin and axis of joint i + 1 in body i, whose own axis is z.
    origin, axis = tree.translations[i + 1], tree.rotations[i + 1][:, 2]
    # In a view along the first axis, the foot on the second one is its nearest point to the origin.
    across = axis[:2]
    if np.linalg.norm(across) < RULES.parallel:
        names = tree.joint_names
        raise RobotError(
            f"the axes of joints '{names[i]}' and '{names[i + 1]}' are parallel, expected axes at an angle"
        )
    height = -float(origin[:2] @ across) / float(across @ across)
    end = origin + height * axis
    return float(end[2]), height, float(np.linalg.norm(end[:2]))


@dataclass(frozen=True)
class SEW:
    """xi(q) = psi(q), the rotation of the elbow about the line from shoulder to wrist [EW2024].

    It is a baseline. It describes the self-motion well, but its gradient is not orthogonal to those of the task.

    Args:
        kind: "conventional" or "stereographic"; see `orthocas.bases.given.sew_angle`.
    """

    kind: SEWKind = "stereographic"
    linear = True

    def __post_init__(self) -> None:
        require_known("SEW angle", self.kind, SEW_KINDS)

    @property
    def label(self) -> str:
        """'sew:KIND'."""
        return f"sew:{self.kind}"

    def for_problem(self, problem: Problem) -> Given:
        """The angle of the problem's arm.

        Raises:
            InvalidValueError: if the degree of redundancy is not 1.
            RobotError: if the arm is not a suitable chain; see `sew_angle`.
        """
        if problem.r != 1:
            raise InvalidValueError("r", problem.r, "1 for one SEW angle: use a pose task and a 7-joint arm")
        return Given.from_function(self.label, problem.n, sew_angle(problem.robot, self.kind))

    def closed_form(self, problem: Problem) -> ClosedForm:
        """No parameters."""
        return self.for_problem(problem).closed_form(problem)

    def family(self, space: JointSpace, outputs: int) -> GivenFamily:
        """Not available: call `for_problem` first.

        Raises:
            InvalidValueError: always, because the angle depends on the robot.
        """
        raise InvalidValueError("parametrisation", self.label, "the angle of a robot, from for_problem(problem)")
