"""The rows of the task Jacobian, in a form with bounds as sharp as possible.

Rotating all rows of the Jacobian of a position does not change a determinant. In the axes of a body in the middle of
the chain, each entry depends on fewer joints than in the axes of the world, so boxes can be larger (ours).
"""

import casadi as ca

from orthocas.casadi_tools.batch import dense_function
from orthocas.robots.kinematics import Pose
from orthocas.robots.spatial import constant, turn
from orthocas.robots.tree import KinematicTree
from orthocas.tasks import Task


def task_rows(task: Task) -> ca.Function:
    """q (n, 1) -> J_x (m, n), or C(q) J_x with det C = 1."""
    if task.recipe["kind"] != "position:xyz":
        return task.jacobian_function
    q = ca.SX.sym("q", task.robot.n)
    chain = _chain(task.robot.tree)
    choices = [position_jacobian(task.robot.tree, q, body) for body in chain]
    return dense_function("task_rows", [q], [min(choices, key=lambda J: ca.jacobian(ca.vec(J), q).nnz())])


def position_jacobian(tree: KinematicTree, q: ca.SX, body: int) -> ca.SX:
    """Jacobian of the tip position in the axes of a body of the chain, (3, n)."""
    poses = _poses_in(tree, q, body)
    R, p = poses[tree.tip_parent]
    tip = p + R @ constant(tree.tip_translation)
    J = ca.SX(3, tree.n)
    for i, (rotation, origin) in poses.items():
        axis = rotation[:, 2]
        J[:, i] = axis if tree.prismatic[i] else ca.cross(axis, tip - origin)
    return J


def _chain(tree: KinematicTree) -> list[int]:
    """The bodies that carry the tip, from the base."""
    bodies, i = [], tree.tip_parent
    while i >= 0:
        bodies.append(i)
        i = tree.parents[i]
    return bodies[::-1] or [0]


def _poses_in(tree: KinematicTree, q: ca.SX, body: int) -> dict[int, Pose]:
    """Rotation and position of every body of the chain, in the frame of one of them."""
    chain = _chain(tree)
    here = chain.index(body)
    poses: dict[int, Pose] = {body: (ca.SX.eye(3), ca.SX.zeros(3))}
    for below, i in zip(chain[here:], chain[here + 1 :], strict=False):
        R, p = poses[below]
        rotation, shift = _step(tree, q, i)
        poses[i] = (R @ rotation, p + R @ shift)
    for i, below in zip(chain[here:0:-1], chain[here - 1 :: -1] if here else [], strict=False):
        R, p = poses[i]
        rotation, shift = _step(tree, q, i)
        back = R @ rotation.T
        poses[below] = (back, p - back @ shift)
    return poses


def _step(tree: KinematicTree, q: ca.SX, i: int) -> Pose:
    """Rotation and position of a body in the frame of its parent."""
    rotation, shift = constant(tree.rotations[i]), constant(tree.translations[i])
    if tree.prismatic[i]:
        return rotation, shift + rotation[:, 2] * q[i]
    return rotation @ turn(q[i]), shift
