"""The rows of the task Jacobian, in a form with bounds as sharp as possible.

Rotating all rows of the Jacobian of a position does not change a determinant. In the axes of a body in the middle of
the chain, each entry depends on fewer joints than in the axes of the world, so boxes can be larger (ours). The stored
rotations of a robot are rotations up to rounding only. Each of the at most n factors then changes an entry by at most
their deviation times the length of the chain, and an allowance covers all changes. It also covers the constants that
CasADi multiplies and adds while it builds these rows: fewer than 10 n roundings of numbers up to the length, and the
allowance is 512 n of them. All other rows come from `derivative_graph`, which rounds nothing unseen.
"""

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import dense_function
from orthocas.certifying.rounding import UNIT
from orthocas.domains import Domain
from orthocas.robots.kinematics import Pose
from orthocas.robots.spatial import constant, turn
from orthocas.robots.tree import KinematicTree
from orthocas.tasks import Task


def task_rows(task: Task, domain: Domain) -> tuple[ca.Function, float]:
    """q (n, 1) -> J_x (m, n), or C(q) J_x with det C = 1 up to an error of the entries, and that error."""
    if task.recipe["kind"] != "position:xyz" or task.robot.tree.tip_parent < 0:
        return task.jacobian_function, 0.0
    q = ca.SX.sym("q", task.robot.n)
    chain = _chain(task.robot.tree)
    choices = [position_jacobian(task.robot.tree, q, body) for body in chain]
    best = min(choices, key=lambda J: int(ca.jacobian(ca.vec(J), q).nnz()))
    return dense_function("task_rows", [q], [best]), _allowance(task.robot.tree, domain)


def _allowance(tree: KinematicTree, domain: Domain) -> float:
    """A bound of what stored rotations change in an entry: 16 n deviations times the length of the chain."""
    squares = tree.rotations.transpose(0, 2, 1) @ tree.rotations - np.eye(3)
    deviation = 3 * float(np.abs(squares).max()) + 32 * UNIT
    furthest = np.abs(domain.centre) + domain.half_width
    slides = float(furthest[np.array(tree.prismatic)].sum())
    length = float(np.abs(tree.translations).sum() + np.abs(tree.tip_translation).sum()) + slides + 1.0
    return 16 * tree.n * deviation * length


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
    return bodies[::-1]


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
