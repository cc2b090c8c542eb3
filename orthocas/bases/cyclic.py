"""Cyclic joints: which joints only turn the whole task, and how a basis takes one linear term for each."""

from collections.abc import Sequence
from typing import Any, Literal

import casadi as ca
import numpy as np

from orthocas.bases.family import JointSpace
from orthocas.errors import InvalidValueError
from orthocas.robots.kinematics import TipTurn
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import Box
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem, is_regular
from orthocas.tasks.samples import NEGLIGIBLE, sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.expressions import find_gradient_dependences, write_tape

_SAMPLES, _POSITIONS = 24, 6  # joint positions, and other positions of one joint at each of them
_SEED = 0
_AXES = "xyz"
_LARGEST_SLIDE = 10.0  # [m]; other positions of a prismatic joint without limits lie within
_WORD = "cyclic"


def cyclic_joints(problem: Problem) -> tuple[str, ...]:
    """Names of the joints that only turn or shift the whole task, for example the base rotation of a position task.

    Joint k is cyclic if h(q + t e_k) = g_t(h(q)) with isometries g_t, and A does not depend on q_k. Then neither does
    span{grad_A h_i}, so coordinates xi = a q_k + f(other joints) are as good at every q_k as at one. That A and the
    span do not depend on q_k is proved, from the kinematics or from the steps of a custom task (see
    `leaves_stay`). That g_t are isometries is tested at samples: A, the A-orthogonal projector on the
    span and the eigenvalues of J_x A^-1 J_x^T must not change when joint k moves through its limits, or a full turn.
    Joints that do not move the task do not count, nor do those without a proof, such as the base rotation for a custom
    task that calls `robot.tip_position`.

    Args:
        problem: robot, task, metric and domain.

    Source:
        ours, docs/explanation/domains.md.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> oc.cyclic_joints(problems.get("planar_3r_xy")), oc.cyclic_joints(problems.get("planar_3r_x"))
        (('q1',), ())
    """
    require_kind("problem", problem, Problem)
    points = sample_uniform(problem.domain, _SAMPLES, _SEED)
    points = points[is_regular(problem, points)]
    names = problem.robot.joint_names
    driven = (k for k in range(problem.n) if k not in problem.robot.tree.floating)
    sampled = (k for k in driven if len(points) and _is_cyclic(problem, points, k))
    return tuple(names[k] for k in sampled if leaves_stay(problem, k))


def over_cyclic_joints(problem: Problem, names: tuple[str, ...]) -> Problem:
    """The problem on a box that covers all positions of the cyclic joints; the problem itself if there is none.

    The box reaches from limit to limit. A joint without limits becomes unbounded: every position of it lies inside.
    """
    require_kind("problem", problem, Problem)
    robot, domain = problem.robot, problem.domain
    if not names or domain.full_turns:
        return problem
    centre, half_width, unbounded = domain.centre.copy(), domain.half_width.copy(), set(domain.unbounded)
    for k in map(robot.joint_names.index, names):
        low, high = _range(problem, k)
        half_width[k] = (high - low) / 2
        if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k]):
            unbounded.add(k)
        else:
            centre[k] = (low + high) / 2
    wider = domain.apply_to(Box(centre, half_width, sorted(unbounded)))
    return Problem(robot, problem.task, problem.metric, wider, problem.name)


def _range(problem: Problem, k: int) -> tuple[float, float]:
    """Limits of joint k. Where it has none: a turn around the domain's centre, or the domain of a prismatic joint."""
    robot, domain = problem.robot, problem.domain
    reach = domain.half_width[k] if robot.tree.prismatic[k] else max(np.pi, domain.half_width[k])
    low = domain.centre[k] - reach if np.isinf(robot.lower[k]) else robot.lower[k]
    high = domain.centre[k] + reach if np.isinf(robot.upper[k]) else robot.upper[k]
    return float(low), float(high)


def _is_cyclic(problem: Problem, points: Array, k: int) -> bool:
    """Whether nothing that matters changes when joint k moves."""
    robot, (low, high) = problem.robot, _range(problem, k)
    if robot.tree.prismatic[k] and np.isinf([robot.lower[k], robot.upper[k]]).any():
        low, high = -_LARGEST_SLIDE, _LARGEST_SLIDE
    places = low + (high - low) * np.random.default_rng((_SEED, k)).uniform(size=(_POSITIONS, len(points)))
    moved = np.repeat(points[None], _POSITIONS, axis=0)
    moved[:, :, k] = places
    J, A = _task_and_metric(problem, points)
    if not np.abs(J[:, :, k]).max() > NEGLIGIBLE * np.abs(J).max():
        return False
    J_there, A_there = _task_and_metric(problem, moved.reshape(-1, problem.n))
    if not (np.isfinite(J_there).all() and np.isfinite(A_there).all() and _same(A, A_there)):
        return False
    try:
        pairs = zip(_invariants(J, A), _invariants(J_there, A_there), strict=True)
        return all(_same(*pair) for pair in pairs)
    except np.linalg.LinAlgError:  # the task loses rank where the joint moves
        return False


def _task_and_metric(problem: Problem, points: Array) -> tuple[Array, Array]:
    """J_x (N, m, n) and A (N, n, n), unchecked: they may be singular or not finite."""
    n = problem.n
    J = problem.task.batched_jacobian(points)[0].reshape(-1, problem.m, n)
    return J, problem.metric.batched(points)[0].reshape(-1, n, n)


def _invariants(J: Array, A: Array) -> tuple[Array, Array]:
    """The A-orthogonal projector on the span of the task gradients (N, n, n), and the eigenvalues of J A^-1 J^T."""
    gradients = np.linalg.solve(A, J.transpose(0, 2, 1))
    gram = J @ gradients
    return gradients @ np.linalg.solve(gram, J), np.linalg.eigvalsh(gram)


def _same(here: Array, there: Array) -> bool:
    """Whether values at the points (N, ...) equal those at the other positions (positions N, ...)."""
    differences = there.reshape(_POSITIONS, *here.shape) - here
    return bool(np.abs(differences).max() <= NEGLIGIBLE * np.abs(here).max())


def require_cyclic(problem: Problem, names: Sequence[str]) -> None:
    """Check joints that a file names cyclic.

    Raises:
        InvalidValueError: if one is not proved to be cyclic. The message names it.
    """
    for name in names:
        if not leaves_stay(problem, problem.robot.joint_names.index(name)):
            raise InvalidValueError("cyclic", repr(name), "a joint that is proved to turn or shift the whole task")


def leaves_stay(problem: Problem, joint: int) -> bool:
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
    return _metric_stays(problem.metric, problem.robot.tree, joint) and (
        _moves_the_task(problem.task, joint) or _is_no_part_of_gradients(problem.task, joint)
    )


def _moves_the_task(task: Task, joint: int) -> bool:
    """Whether the kinematics show that h(q + t e_k) = g_t(h(q))."""
    tree, kind = task.robot.tree, task.recipe["kind"]
    if not task.of_tip:
        return False
    turn = TipTurn.from_kind(kind)
    if turn is not None and turn.whole and joint == tree.tip_parent:
        return True
    return _turns_the_rest(tree, joint) and (turn is not None or _turns_components(tree, joint, kind))


def _is_no_part_of_gradients(task: Task, joint: int) -> bool:
    """Whether the steps of h show that J_x does not depend on a joint."""
    return all(
        joint not in joints
        for row in find_gradient_dependences(write_tape(task.smooth_function))
        for joints in row.values()
    )


def _metric_stays(metric: Metric, tree: KinematicTree, joint: int) -> bool:
    """Whether A is proved not to depend on a joint.

    The inertia M does not depend on a joint that moves all it carries as one rigid body in a world at rest.
    """
    if metric.recipe["kind"] == "inertia" and _turns_the_rest(tree, joint):
        return True
    q = ca.SX.sym("q", tree.n)
    return not ca.depends_on(metric.function(q), q[joint])


def _turns_the_rest(tree: KinematicTree, joint: int) -> bool:
    """Whether all joints below one in the tree are prismatic and, if it is revolute, exactly along its axis."""
    below = tree.carriers(tree.parents[joint])
    if not all(tree.prismatic[i] for i in below):
        return False
    return bool(tree.prismatic[joint]) or all(_is_axis(_rotation(tree, joint, i)[:, 2], 2) for i in below)


def _turns_components(tree: KinematicTree, joint: int, kind: str) -> bool:
    """Whether rotations about the axis of a joint map the position, or two components of it, to themselves."""
    name, _, axes = ("position:xy" if kind == "polar" else kind).partition(":")
    left_out = [k for k, axis in enumerate(_AXES) if axis not in axes]
    if name != "position" or tree.prismatic[joint]:
        return False
    return not left_out or (len(left_out) == 1 and _is_axis(_rotation(tree, joint, -1)[:, 2], left_out[0]))


def _rotation(tree: KinematicTree, joint: int, base: int) -> Array:
    """The rotation of a joint's frame, at zero, in that of a joint that carries it, or in the world for -1."""
    R: Array = np.eye(3)
    while joint != base:
        R = tree.rotations[joint] @ R  # exact where the entries are 0, 1 and -1
        joint = tree.parents[joint]
    return R


def _is_axis(direction: Array, k: int) -> bool:
    """Whether a direction is exactly that of a coordinate axis or its opposite."""
    return bool(np.flatnonzero(direction).tolist() == [k])


Cyclic = tuple[str, ...] | Literal["auto"]  #: names of joints; "auto" for all cyclic joints of the problem


def checked_cyclic(value: Any) -> Cyclic:
    """The value as names, or "auto".

    Raises:
        InvalidValueError: if it is neither, or a name appears twice.
    """
    if isinstance(value, str) and value == "auto":
        return "auto"
    known = isinstance(value, list | tuple) and all(isinstance(name, str) for name in value)
    if not known or len(set(value)) != len(value):
        raise InvalidValueError("cyclic", repr(value)[:80], "a list of different joint names, or 'auto'")
    return tuple(value)


def suffix(cyclic: Cyclic) -> str:
    """What a label adds for cyclic joints: '', ':cyclic' for "auto", or ':cyclic=NAME,NAME'."""
    if not cyclic:
        return ""
    return f":{_WORD}" if cyclic == "auto" else f":{_WORD}={','.join(cyclic)}"


def parse_suffix(text: str) -> Cyclic:
    """Parse what ends a label: '', 'cyclic' or 'cyclic=NAME,NAME'."""
    word, equals, names = text.partition("=")
    if not text:
        return ()
    if word != _WORD or (equals and not names):
        wanted = "'joints=2', then 'cyclic' or 'cyclic=JOINT,JOINT' after the degree"
        raise InvalidValueError("parametrisation", repr(text), wanted)
    return tuple(names.split(",")) if equals else "auto"


def resolved(cyclic: Cyclic, problem: "Problem") -> tuple[str, ...]:
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
        return known
    wrong = [name for name in cyclic if name not in known and not _keeps_leaves(problem, name)]
    if wrong:
        raise InvalidValueError("cyclic", repr(wrong[0]), f"one of the cyclic joints: {', '.join(known) or 'none'}")
    return tuple(name for name in names if name in cyclic)


def _keeps_leaves(problem: "Problem", name: str) -> bool:
    names = problem.robot.joint_names
    return name in names and leaves_stay(problem, names.index(name))


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


def count(cyclic: Cyclic) -> int:
    """Number of cyclic joints; 0 as long as "auto" has not been resolved."""
    return 0 if cyclic == "auto" else len(cyclic)
