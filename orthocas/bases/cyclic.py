"""Joints at all of whose positions a chart holds: those that only turn or shift the task, and mobile bases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from orthocas.bases.family import Expression, Family, JointSpace, Parametrisation, component_gradients
from orthocas.errors import InvalidValueError
from orthocas.robots.kinematics import TipTurn
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem, is_regular
from orthocas.tasks.samples import NEGLIGIBLE, sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.expressions import find_gradient_dependences, write_tape


@dataclass(frozen=True, slots=True)
class CyclicRules:
    """Numbers of the test for cyclic joints, and of coordinates that move with a base."""

    samples: int = 24  #: joint positions at which a symmetry is tested
    positions: int = 6  #: other positions of one joint at each of them
    seed: int = 0
    largest_slide: float = 10.0  #: [m]; other positions of a prismatic joint without limits lie within
    start: float = 0.03  #: of the arm's own start, where coordinates move with a base
    on_plane: int = 3  #: coordinates that move with the base: two of its place, and the heading


RULES = CyclicRules()
_AXES = "xyz"
_WORD, _WITHOUT = "cyclic", "without"


def cyclic_joints(problem: Problem) -> tuple[str, ...]:
    """Names of the joints that only turn or shift the whole task, for example the base rotation of a position task.

    Joint k is cyclic if h(q + t e_k) = g_t(h(q)) with isometries g_t, and A does not depend on q_k. Then neither does
    span{grad_A h_i}, so coordinates xi = a q_k + f(other joints) are as good at every q_k as at one. That A and the
    span do not depend on q_k is proved, from the kinematics or from the steps of a custom task (see
    `keeps_self_motions`). That g_t are isometries is tested at samples: A, the A-orthogonal projector on the
    span and the eigenvalues of J_x A^-1 J_x^T must not change when joint k moves through its limits, or a full turn.
    Joints that do not move the task do not count, nor do those without a proof, such as the base rotation for a custom
    task that calls `robot.tip_position`.

    Args:
        problem: robot, task, metric and domain.

    Source:
        ours, docs/explanation/domains.md.

    Example:
        >>> from orthocas import problems
        >>> from orthocas.bases import cyclic_joints
        >>> cyclic_joints(problems.get("planar_3r_xy")), cyclic_joints(problems.get("planar_3r_x"))
        (('q1',), ())
    """
    require_kind("problem", problem, Problem)
    points = sample_uniform(problem.domain, RULES.samples, RULES.seed)
    points = points[is_regular(problem, points)]
    names = problem.robot.joint_names
    driven = (k for k in range(problem.n) if k not in problem.robot.tree.floating)
    sampled = (k for k in driven if len(points) and _is_cyclic(problem, points, k))
    return tuple(names[k] for k in sampled if keeps_self_motions(problem, k))


def widen_over_cyclic_joints(problem: Problem, names: tuple[str, ...]) -> Problem:
    """The problem on a box that covers all positions of the cyclic joints; the problem itself if there is none.

    The box reaches from limit to limit. A joint without limits becomes unbounded: every position of it lies inside.
    """
    require_kind("problem", problem, Problem)
    robot, domain = problem.robot, problem.domain
    if not names or domain.full_turns:
        return problem
    # Each named joint takes its whole range; between infinite limits, any position counts.
    centre, half_width, unbounded = domain.centre.copy(), domain.half_width.copy(), set(domain.unbounded)
    for k in map(robot.joint_names.index, names):
        low, high = _find_range(problem, k)
        half_width[k] = (high - low) / 2
        if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k]):
            unbounded.add(k)
        else:
            centre[k] = (low + high) / 2
    # Domains that are parts of boxes keep their conditions.
    wider = domain.apply_to(Box(centre, half_width, sorted(unbounded)))
    return Problem(robot, problem.task, problem.metric, wider, problem.name)


def _find_range(problem: Problem, k: int) -> tuple[float, float]:
    """Limits of joint k. Where it has none: a turn around the domain's centre, or the domain of a prismatic joint."""
    robot, domain = problem.robot, problem.domain
    reach = domain.half_width[k] if robot.tree.prismatic[k] else max(np.pi, domain.half_width[k])
    low = domain.centre[k] - reach if np.isinf(robot.lower[k]) else robot.lower[k]
    high = domain.centre[k] + reach if np.isinf(robot.upper[k]) else robot.upper[k]
    return float(low), float(high)


def _is_cyclic(problem: Problem, points: Array, k: int) -> bool:
    """Whether nothing that matters changes when joint k moves."""
    robot, (low, high) = problem.robot, _find_range(problem, k)
    # Without limits, a slide is tried within a few metres.
    if robot.tree.prismatic[k] and np.isinf([robot.lower[k], robot.upper[k]]).any():
        low, high = -RULES.largest_slide, RULES.largest_slide
    # Each sample with the joint elsewhere, at several places.
    places = low + (high - low) * np.random.default_rng((RULES.seed, k)).uniform(size=(RULES.positions, len(points)))
    moved = np.repeat(points[None], RULES.positions, axis=0)
    moved[:, :, k] = places
    # A joint that does not move the task does not count.
    J, A = _evaluate_task_and_metric(problem, points)
    if not np.abs(J[:, :, k]).max() > NEGLIGIBLE * np.abs(J).max():
        return False
    # Nothing that matters may change: the metric, then the span and its sizes.
    J_there, A_there = _evaluate_task_and_metric(problem, moved.reshape(-1, problem.n))
    if not (np.isfinite(J_there).all() and np.isfinite(A_there).all() and _is_same(A, A_there)):
        return False
    try:
        pairs = zip(_compute_invariants(J, A), _compute_invariants(J_there, A_there), strict=True)
        return all(_is_same(*pair) for pair in pairs)
    except np.linalg.LinAlgError:  # the task loses rank where the joint moves
        return False


def _evaluate_task_and_metric(problem: Problem, points: Array) -> tuple[Array, Array]:
    """J_x (N, m, n) and A (N, n, n), unchecked: they may be singular or not finite."""
    n = problem.n
    J = problem.task.batched_jacobian(points)[0].reshape(-1, problem.m, n)
    return J, problem.metric.batched(points)[0].reshape(-1, n, n)


def _compute_invariants(J: Array, A: Array) -> tuple[Array, Array]:
    """The A-orthogonal projector on the span of the task gradients (N, n, n), and the eigenvalues of J A^-1 J^T."""
    gradients = np.linalg.solve(A, J.transpose(0, 2, 1))
    gram = J @ gradients
    return gradients @ np.linalg.solve(gram, J), np.linalg.eigvalsh(gram)


def _is_same(here: Array, there: Array) -> bool:
    """Whether values at the points (N, ...) equal those at the other positions (positions N, ...)."""
    differences = there.reshape(RULES.positions, *here.shape) - here
    return bool(np.abs(differences).max() <= NEGLIGIBLE * np.abs(here).max())


def require_cyclic(problem: Problem, names: Sequence[str]) -> None:
    """Check joints that a file names cyclic.

    Raises:
        InvalidValueError: if one is not proved to be cyclic. The message names it.
    """
    for name in names:
        if not keeps_self_motions(problem, problem.robot.joint_names.index(name)):
            raise InvalidValueError("cyclic", repr(name), "a joint that is proved to turn or shift the whole task")


def keeps_self_motions(problem: Problem, joint: int) -> bool:
    """Whether A and span{grad_A h_i} are proved not to depend on a joint, at any position of all joints.

    The metric must not depend on the joint, and one of these must hold:

    - J_x does not depend on it, by the steps of h: h = a q_k + f(other joints). A lift under a pose is an example.
    - It turns all that the task sees about a line that stands still in the world: only prismatic joints along its axis
      carry it. Then h(q + t e_k) = g_t(h(q)) with smooth maps g_t, for the tip's position, orientation, pose and axis;
      for two components of the position and for polar coordinates, if the axis is exactly the world axis left out.
    - It is the last joint, and the task is a whole orientation or pose, which it changes by a motion in its own frame.

    Rotations are taken as rotations; those of a robot's file are up to rounding. False where no proof is found: the
    joint may still be cyclic.
    """
    # M does not depend on a joint that moves all it carries as one rigid body in a world at rest: all joints below it
    # in the tree are prismatic and, if it is revolute, exactly along its axis.
    tree, metric, task = problem.robot.tree, problem.metric, problem.task
    below, q = tree.carriers(tree.parents[joint]), ca.SX.sym("q", tree.n)
    if tree.mimic_names:
        # A mimic joint may move with the joint, or carry it.
        return False
    along = tree.prismatic[joint] or all(_is_axis(_fit_rotation(tree, joint, i)[:, 2], 2) for i in below)
    at_rest = along and all(tree.prismatic[i] for i in below)
    rigid = metric.recipe["kind"] == "inertia" and at_rest
    if not rigid and ca.depends_on(metric.function(q), q[joint]):
        return False
    # By the kinematics, h(q + t e_k) = g_t(h(q)).
    kind = task.recipe["kind"]
    turned = TipTurn.from_kind(kind) is not None or _is_turn_of_components(tree, joint, kind)
    if turns_tool(task, joint) or (task.of_tip and at_rest and turned):
        return True
    # By the steps of h, J_x does not depend on the joint.
    rows = find_gradient_dependences(write_tape(task.smooth_function))
    return all(joint not in joints for row in rows for joints in row.values())


def turns_tool(task: Task, joint: int) -> bool:
    """Whether the kinematics show that h(q + t e_k) = h(q) g_t: the last joint, under a whole orientation or pose.

    Then neither ker J_x nor the regularity of coordinates without this joint depends on its position.
    """
    turn, tree = TipTurn.from_kind(task.recipe["kind"]), task.robot.tree
    whole = task.of_tip and turn is not None and turn.whole
    return whole and joint == tree.tip_parent and joint not in tree.mimic_leaders


def _is_turn_of_components(tree: KinematicTree, joint: int, kind: str) -> bool:
    """Whether rotations about the axis of a joint map the position, or two components of it, to themselves."""
    name, _, axes = ("position:xy" if kind == "polar" else kind).partition(":")
    left_out = [k for k, axis in enumerate(_AXES) if axis not in axes]
    if name != "position" or tree.prismatic[joint]:
        return False
    return not left_out or (len(left_out) == 1 and _is_axis(_fit_rotation(tree, joint, -1)[:, 2], left_out[0]))


def _fit_rotation(tree: KinematicTree, joint: int, base: int) -> Array:
    """The rotation of a joint's frame, at zero, in that of a joint that carries it, or in the world for -1."""
    R: Array = np.eye(3)
    while joint != base:
        # exact where the entries are 0, 1 and -1
        R = tree.rotations[joint] @ R
        joint = tree.parents[joint]
    return R


def _is_axis(direction: Array, k: int) -> bool:
    """Whether a direction is exactly that of a coordinate axis or its opposite."""
    return bool(np.flatnonzero(direction).tolist() == [k])


Cyclic = tuple[str, ...] | Literal["auto"]  #: names of joints; "auto" for all cyclic joints of the problem


def check_cyclic(value: Any) -> Cyclic:
    """Return the joint names that were given, or "auto".

    Raises:
        InvalidValueError: if it is neither, or a name appears twice.
    """
    if isinstance(value, str) and value == "auto":
        return "auto"
    known = isinstance(value, list | tuple) and all(isinstance(name, str) for name in value)
    if not known or len(set(value)) != len(value):
        raise InvalidValueError("cyclic", repr(value)[:80], "a list of different joint names, or 'auto'")
    return tuple(value)


def check_without(names: Any, cyclic: Cyclic) -> tuple[str, ...]:
    """Names of joints that coordinates do not depend on.

    Raises:
        InvalidValueError: if a name appears twice, or one is also cyclic.
    """
    known = isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)
    if not known or len(set(names)) != len(names) or (cyclic != "auto" and set(names) & set(cyclic)):
        raise InvalidValueError("without", repr(names)[:80], "a list of different joint names, none of them cyclic")
    return tuple(names)


def suffix(cyclic: Cyclic, without: tuple[str, ...] = ()) -> str:
    """What a label adds: ':cyclic' for "auto", ':cyclic=NAME,NAME', and ':without=NAME,NAME'."""
    linear = "" if not cyclic else f":{_WORD}" if cyclic == "auto" else f":{_WORD}={','.join(cyclic)}"
    return linear + (f":{_WITHOUT}={','.join(without)}" if without else "")


def parse_suffix(text: str, before: str) -> tuple[Cyclic, tuple[str, ...]]:
    """Parse what ends a label: '', 'cyclic' or 'cyclic=NAME,NAME', then 'without=NAME,NAME'.

    Args:
        text: the end of the label.
        before: what may stand before it, for messages.
    """
    cyclic: Cyclic = ()
    without: tuple[str, ...] = ()
    for part in text.split(":") if text else ():
        # each part is a word, with names behind it
        word, equals, names = part.partition("=")
        if word not in (_WORD, _WITHOUT) or (not names if equals else word == _WITHOUT):
            wanted = f"{before}, then 'cyclic' or 'cyclic=JOINT,JOINT', then 'without=JOINT'"
            raise InvalidValueError("parametrisation", repr(text), wanted)
        if word == _WORD:
            cyclic = tuple(names.split(",")) if equals else "auto"
        else:
            without = tuple(names.split(","))
    return cyclic, without


def resolved(cyclic: Cyclic, problem: Problem) -> tuple[str, ...]:
    """The names of the cyclic joints of a problem that are meant.

    A joint that is named need not keep the size of task gradients, only their span: as the first and the last joint of
    a pose, at all of whose positions coordinates are as regular and as orthogonal as at one.

    Raises:
        InvalidValueError: if a named joint is not cyclic.
    """
    if not cyclic:
        return ()
    known, names = cyclic_joints(problem), problem.robot.joint_names
    if cyclic == "auto":
        # Names that were not found at samples may still be proved.
        return known
    for name in cyclic:
        if name not in known and not (name in names and keeps_self_motions(problem, names.index(name))):
            raise InvalidValueError("cyclic", repr(name), f"one of the cyclic joints: {', '.join(known) or 'none'}")
    return tuple(name for name in names if name in cyclic)


def indices(cyclic: Cyclic, space: JointSpace) -> list[int]:
    """The cyclic joints of a space, in order.

    Raises:
        InvalidValueError: if a name is not among the joints, or "auto" has not been resolved.
    """
    if cyclic == "auto":
        raise InvalidValueError("cyclic", "'auto'", "joint names: for_problem(problem) finds them")
    for name in cyclic:
        if name not in space.joint_names:
            raise InvalidValueError("cyclic", repr(name), f"joints of {', '.join(space.joint_names)}")
    return [k for k, name in enumerate(space.joint_names) if name in cyclic]


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
        # A parametrisation to fit, without joints of its own that are cyclic.
        fitted = isinstance(self.arm, Parametrisation) and not isinstance(self.arm, type)
        if not fitted or self.arm.closed_form is not None or isinstance(self.arm, Mobile):
            raise InvalidValueError("arm", repr(self.arm)[:80], "a parametrisation to fit, such as Polynomial(2)")
        if getattr(self.arm, "cyclic", ()):
            raise InvalidValueError("arm", self.arm.label, "a parametrisation without cyclic joints")
        # Three joints of the base, by their names.
        names = tuple(self.base) if isinstance(self.base, tuple | list) else ()
        if len({*names}) != RULES.on_plane or not all(isinstance(name, str) for name in names):
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
            raise InvalidValueError("base", repr(missing[0]), f"joints of {', '.join(tree.joint_names)}")
        # From the world on: x, y and the heading, each exactly along its axis of the world.
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
            InvalidValueError: if there are less than three coordinates, or joints of the base are missing.
        """
        if outputs < RULES.on_plane:
            raise InvalidValueError("extra coordinates of a mobile base", outputs, f"at least {RULES.on_plane}")
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
        return self.arm.size + 2 + self.outputs - RULES.on_plane

    @property
    def as_matrices(self) -> bool:
        """What the functions of the arm say."""
        return self.arm.as_matrices

    @property
    def width(self) -> int:
        """What the functions of the arm say."""
        return self.arm.width

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi, (r, N), for q (n, N)."""
        # The arm's coordinates, the first two of them in the axes of the base.
        own, rest = theta[: self.arm.size], theta[self.arm.size :]
        f = self.arm.expression(q[list(self.joints), :], own)
        x, y, heading = (q[i, :] for i in self.places)
        ahead, aside = f[0, :] + rest[0], f[1, :] + rest[1]
        # Turned by the heading and shifted by the place, they are those of the world.
        c, s = ca.cos(heading), ca.sin(heading)
        rows = [x + c * ahead - s * aside, y + s * ahead + c * aside, heading + f[2, :]]
        rows += [rest[k - 1] * heading + f[k, :] for k in range(RULES.on_plane, self.outputs)]
        xi: Expression = ca.vertcat(*rows)
        return xi

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """Nearly the place and the heading of the base, (size,).

        With larger f_1 and f_2, a fit can let them grow without end, so that (xi_1, xi_2) leaves the place out.
        """
        return np.concatenate([RULES.start * self.arm.initial(seed), np.zeros(self.size - self.arm.size)])


def anywhere(problem: Problem, base: tuple[str, ...]) -> Problem:
    """The problem on a domain without ends in those joints of the base that have no limits."""
    robot, domain = problem.robot, problem.domain
    places = [robot.joint_names.index(name) for name in base]
    free = {k for k in places if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])}
    if free <= {*domain.unbounded}:
        return problem
    wider = domain.apply_to(Box(domain.centre, domain.half_width, sorted(free | {*domain.unbounded})))
    return Problem(robot, problem.task, problem.metric, wider, problem.name)
