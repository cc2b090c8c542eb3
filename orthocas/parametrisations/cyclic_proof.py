"""Proofs that joints are cyclic, from the kinematics and from the steps of expressions, without samples (ours)."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from orthocas.casadi_tools.structure import gradient_dependences
from orthocas.casadi_tools.tape import to_tape
from orthocas.checks import Array
from orthocas.errors import InvalidValueError
from orthocas.metrics import Metric
from orthocas.problem import Problem
from orthocas.robots.tip_turn import TipTurn
from orthocas.robots.tree import KinematicTree
from orthocas.tasks import Task

_AXES = "xyz"


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
    """Whether the kinematics tell that h(q + t e_k) = g_t(h(q))."""
    tree, kind = task.robot.tree, task.recipe["kind"]
    turn = TipTurn.of_kind(kind)
    if turn is not None and turn.whole and joint == tree.tip_parent:
        return True
    return _turns_the_rest(tree, joint) and (turn is not None or _turns_components(tree, joint, kind))


def _is_no_part_of_gradients(task: Task, joint: int) -> bool:
    """Whether the steps of h tell that J_x does not depend on a joint."""
    return all(joint not in joints for row in gradient_dependences(to_tape(task.function)) for joints in row.values())


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
    below = _below(tree, joint)
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


def _below(tree: KinematicTree, joint: int) -> list[int]:
    """The joints that carry a joint, the nearest first."""
    found, i = [], tree.parents[joint]
    while i >= 0:
        found.append(i)
        i = tree.parents[i]
    return found


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
