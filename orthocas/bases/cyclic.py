"""Cyclic joints, which only turn or shift the task, so that a chart holds at all their positions; mobile bases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from orthocas.bases.family import Cyclic
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
    """Numbers of the test for cyclic joints."""

    samples: int = 24  #: joint positions at which a symmetry is tested
    positions: int = 6  #: further positions of the joint at each of them
    seed: int = 0
    #: [m]; for a prismatic joint without limits, further positions are within this distance of 0
    largest_slide: float = 10.0


RULES = CyclicRules()
_AXES = "xyz"


def cyclic_joints(problem: Problem) -> tuple[str, ...]:
    """Names of joints that only turn or shift the whole task, for example the base rotation of a position task.

    Joint k is cyclic if h(q + t e_k) = g_t(h(q)) with isometries g_t, and A does not depend on q_k. Then span{grad_A
    h_i} does not depend on q_k either, so coordinates xi = a q_k + f(other joints) are equally good at every q_k.

    That A and the span do not depend on q_k is proved, from the kinematics or from the operations of a custom task (see
    `keeps_self_motions`). That g_t are isometries is tested at samples: A, the A-orthogonal projector on the span and
    the eigenvalues of J_x A^-1 J_x^T must not change when joint k moves through its limits, or through a full turn.
    Joints that do not move the task are not listed, nor are joints without a proof, such as the base rotation for a
    custom task that calls `robot.tip_position`.

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

    The box reaches from limit to limit. A joint without limits becomes unbounded, so that all its positions are inside.
    """
    require_kind("problem", problem, Problem)
    robot, domain = problem.robot, problem.domain
    if not names or domain.full_turns:
        return problem
    centre, half_width, unbounded = domain.centre.copy(), domain.half_width.copy(), set(domain.unbounded)
    for k in map(robot.joint_names.index, names):
        low, high = _find_range(problem, k)
        half_width[k] = (high - low) / 2
        if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k]):
            unbounded.add(k)
        else:
            centre[k] = (low + high) / 2
    # A domain with a condition keeps it.
    wider = domain.apply_to(Box(centre, half_width, sorted(unbounded)))
    return Problem(robot, problem.task, problem.metric, wider, problem.name)


def _find_range(problem: Problem, k: int) -> tuple[float, float]:
    """Limits of joint k. Without limits, a full turn around the domain's centre, or a slide's range in the domain."""
    robot, domain = problem.robot, problem.domain
    reach = domain.half_width[k] if robot.tree.prismatic[k] else max(np.pi, domain.half_width[k])
    low = domain.centre[k] - reach if np.isinf(robot.lower[k]) else robot.lower[k]
    high = domain.centre[k] + reach if np.isinf(robot.upper[k]) else robot.upper[k]
    return float(low), float(high)


def _is_cyclic(problem: Problem, points: Array, k: int) -> bool:
    """Whether A, the projector on the span and the eigenvalues of J A^-1 J^T stay the same when joint k moves."""
    robot, (low, high) = problem.robot, _find_range(problem, k)
    # Test a slide without limits within a few metres.
    if robot.tree.prismatic[k] and np.isinf([robot.lower[k], robot.upper[k]]).any():
        low, high = -RULES.largest_slide, RULES.largest_slide
    # Move the joint of each sample to several other positions.
    places = low + (high - low) * np.random.default_rng((RULES.seed, k)).uniform(size=(RULES.positions, len(points)))
    moved = np.repeat(points[None], RULES.positions, axis=0)
    moved[:, :, k] = places
    # A joint that does not move the task is not cyclic.
    J, A = _evaluate_task_and_metric(problem, points)
    if not np.abs(J[:, :, k]).max() > NEGLIGIBLE * np.abs(J).max():
        return False
    # Compare the metric, then the projector and the eigenvalues.
    J_there, A_there = _evaluate_task_and_metric(problem, moved.reshape(-1, problem.n))
    if not (np.isfinite(J_there).all() and np.isfinite(A_there).all() and _is_same(A, A_there)):
        return False
    try:
        pairs = zip(_compute_invariants(J, A), _compute_invariants(J_there, A_there), strict=True)
        return all(_is_same(*pair) for pair in pairs)
    # The task loses rank at another position of the joint.
    except np.linalg.LinAlgError:
        return False


def _evaluate_task_and_metric(problem: Problem, points: Array) -> tuple[Array, Array]:
    """J_x (N, m, n) and A (N, n, n), which may be singular or not finite."""
    n = problem.n
    J = problem.task.batched_jacobian(points)[0].reshape(-1, problem.m, n)
    return J, problem.metric.batched(points)[0].reshape(-1, n, n)


def _compute_invariants(J: Array, A: Array) -> tuple[Array, Array]:
    """The A-orthogonal projector on the span of the task gradients (N, n, n), and the eigenvalues of J A^-1 J^T."""
    gradients = np.linalg.solve(A, J.transpose(0, 2, 1))
    gram = J @ gradients
    return gradients @ np.linalg.solve(gram, J), np.linalg.eigvalsh(gram)


def _is_same(here: Array, there: Array) -> bool:
    """Whether values at the samples (N, ...) equal those at the moved samples (positions N, ...)."""
    differences = there.reshape(RULES.positions, *here.shape) - here
    return bool(np.abs(differences).max() <= NEGLIGIBLE * np.abs(here).max())


def require_cyclic(problem: Problem, names: Sequence[str]) -> None:
    """Check the joints that a file lists as cyclic.

    Raises:
        InvalidValueError: if a joint is not proved to be cyclic. The message names it.
    """
    for name in names:
        if not keeps_self_motions(problem, problem.robot.joint_names.index(name)):
            raise InvalidValueError("cyclic", repr(name), "a joint that is proved to turn or shift the whole task")


def keeps_self_motions(problem: Problem, joint: int) -> bool:
    """Whether A and span{grad_A h_i} are proved not to depend on a joint, at any position of all joints.

    The metric must not depend on the joint, and one of these must hold:

    - J_x does not depend on the joint, by the operations of h: h = a q_k + f(other joints). An example is a lift under
      a pose.
    - The joint turns everything that the task observes about a line fixed in the world, because only prismatic joints
      along its axis carry it. Then h(q + t e_k) = g_t(h(q)) with smooth maps g_t, for the tip's position, orientation,
      pose and axis. This also holds for two components of the position and for polar coordinates, if the axis is
      exactly the third world axis.
    - The joint is the last one, and the task is a whole orientation or pose. The joint changes it by a motion in its
      own frame.

    Stored rotations are taken as exact, although those of a file are rotations up to rounding only. The result is False
    if no proof is found; the joint may still be cyclic.
    """
    # M does not depend on a joint that moves everything it carries as one rigid body, in a world at rest. This requires
    # that all joints below it in the tree are prismatic and, if it is revolute, exactly along its axis.
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
    # First proof: by the kinematics, h(q + t e_k) = g_t(h(q)).
    kind = task.recipe["kind"]
    turned = TipTurn.from_kind(kind) is not None
    # A rotation about the joint's axis maps positions to positions, and two components of it if the axis is the third.
    name, _, axes = ("position:xy" if kind == "polar" else kind).partition(":")
    if name == "position" and not tree.prismatic[joint]:
        left_out = [k for k, axis in enumerate(_AXES) if axis not in axes]
        across = len(left_out) == 1 and _is_axis(_fit_rotation(tree, joint, -1)[:, 2], left_out[0])
        turned = not left_out or across
    if turns_tool(task, joint) or (task.of_tip and at_rest and turned):
        return True
    # Second proof: by the operations of h, J_x does not depend on the joint.
    rows = find_gradient_dependences(write_tape(task.smooth_function))
    return all(joint not in joints for row in rows for joints in row.values())


def turns_tool(task: Task, joint: int) -> bool:
    """Whether the kinematics show h(q + t e_k) = h(q) g_t: true for the last joint under a whole orientation or pose.

    Then ker J_x does not depend on its position, nor does the regularity of coordinates without this joint.
    """
    turn, tree = TipTurn.from_kind(task.recipe["kind"]), task.robot.tree
    whole = task.of_tip and turn is not None and turn.whole
    return whole and joint == tree.tip_parent and joint not in tree.mimic_leaders


def _fit_rotation(tree: KinematicTree, joint: int, base: int) -> Array:
    """Rotation of a joint's frame at q = 0, relative to a joint that carries it, or to the world for -1."""
    R: Array = np.eye(3)
    while joint != base:
        # Products are exact where the entries are 0, 1 and -1.
        R = tree.rotations[joint] @ R
        joint = tree.parents[joint]
    return R


def _is_axis(direction: Array, k: int) -> bool:
    """Whether a direction is exactly that of a coordinate axis, or opposite to it."""
    return bool(np.flatnonzero(direction).tolist() == [k])


def resolved(cyclic: Cyclic, problem: Problem) -> tuple[str, ...]:
    """The names of the cyclic joints, with "auto" replaced by all that are found.

    A joint given by name must keep the span of the task gradients, but may change their size. Examples are the first
    and the last joint of a pose: coordinates are equally regular and orthogonal at all their positions.

    Raises:
        InvalidValueError: if a named joint is not cyclic.
    """
    if not cyclic:
        return ()
    known, names = cyclic_joints(problem), problem.robot.joint_names
    if cyclic == "auto":
        # A joint that is not found at samples may still have a proof.
        return known
    for name in cyclic:
        if name not in known and not (name in names and keeps_self_motions(problem, names.index(name))):
            raise InvalidValueError("cyclic", repr(name), f"one of the cyclic joints: {', '.join(known) or 'none'}")
    return tuple(name for name in names if name in cyclic)


def anywhere(problem: Problem, base: tuple[str, ...]) -> Problem:
    """The problem with joints of the base unbounded where they have no limits, and sampled over full turns.

    As the base turns, the first two coordinates of a `Mobile` chart mix, and their angles to others change.
    """
    robot, domain = problem.robot, problem.domain
    places = [robot.joint_names.index(name) for name in base]
    free = {k for k in places if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])}
    half_width = domain.half_width.copy()
    for k in free:
        low, high = _find_range(problem, k)
        half_width[k] = (high - low) / 2
    if free <= {*domain.unbounded} and (half_width == domain.half_width).all():
        return problem
    wider = domain.apply_to(Box(domain.centre, half_width, sorted(free | {*domain.unbounded})))
    return Problem(robot, problem.task, problem.metric, wider, problem.name)
