"""The rows of the task Jacobian, in a form with bounds as sharp as possible.

Multiplying the rows from the left by a matrix that is never singular changes neither whether J is, nor the sign of its
determinant if that matrix has a positive one. So rows of a tip task become those of the frame Jacobian: the velocity of
the tip and its angular velocity. In the axes of a body in the middle of the chain, each entry depends on fewer joints
than in the axes of the world, so boxes can be larger. Half a turn of the tool away from the reference, where the
components of x lose rank though the arm does not, these rows are as regular as anywhere.

The stored rotations of a robot are rotations up to rounding only. Each of the at most n factors then changes an entry
by at most their deviation times the length of the chain, and an allowance covers all changes. It also covers the
constants that CasADi multiplies and adds while it builds these rows: fewer than 10 n roundings of numbers up to the
length, and the allowance is 512 n of them. All other rows come from `derivative_graph`, which rounds nothing unseen.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from orthocas.certificates.taylor import UNIT
from orthocas.robots.kinematics import Pose, TipTurn
from orthocas.robots.spatial import constant, turn
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import Domain
from orthocas.tasks.task import Task
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array

_AXES = "xyz"


@dataclass(frozen=True)
class TipRows:
    """What a task compares of the tip, so that x(q) = x(p) if and only if these agree at q and p."""

    position: tuple[int, ...] = ()  #: axes of the world along which the position counts
    rotation: bool = False  #: the whole orientation
    axis: int | None = None  #: the direction of one axis of the tip, unless the whole orientation counts

    @classmethod
    def of(cls, task: Task) -> "TipRows | None":
        """Of a task; None for tasks of other kinds or frames, and for a tip that does not move."""
        kind = task.recipe["kind"]
        if task.robot.tree.tip_parent < 0 or not task.of_tip:
            return None
        if kind == "polar":
            return cls((0, 1))
        if kind.startswith("position:"):
            return cls(tuple(map(_AXES.index, kind.removeprefix("position:"))))
        if (turned := TipTurn.from_kind(kind)) is None:
            return None
        whole = turned.whole or turned.axis is None
        return cls((0, 1, 2) if turned.with_position else (), whole, None if whole else _AXES.index(str(turned.axis)))


def task_rows(task: Task, domain: Domain) -> tuple[ca.Function, float]:
    """q (n, 1) -> J_x (m, n), or C(q) J_x with det C > 0 up to an error of the entries, and that error."""
    tip, tree = TipRows.of(task), task.robot.tree
    if tip is None or tip.position not in ((), (0, 1, 2)):  # some axes of the world only cannot be rotated
        return task.jacobian_function, 0.0
    q = ca.SX.sym("q", task.robot.n)
    parts = []
    if tip.position:
        parts.append(_sparsest(q, [velocity_rows(tree, q, body)[:3, :] for body in tree.carriers(tree.tip_parent)]))
    if tip.rotation:
        parts.append(_sparsest(q, [velocity_rows(tree, q, body)[3:, :] for body in tree.carriers(tree.tip_parent)]))
    if tip.axis is not None:
        parts.append(axis_rows(tree, q, tip.axis))
    return dense_function("task_rows", [q], [ca.vertcat(*parts)]), _allowance(tree, domain)


def velocity_rows(tree: KinematicTree, q: ca.SX, body: int) -> ca.SX:
    """Jacobian of the tip's velocity and angular velocity in the axes of a body of the chain, (6, n)."""
    poses = _poses_in(tree, q, body)
    R, p = poses[tree.tip_parent]
    tip = p + R @ constant(tree.tip_translation)
    J = ca.SX(6, tree.n)
    for i, (rotation, origin) in poses.items():
        axis = rotation[:, 2]
        if tree.prismatic[i]:
            J[:3, i] = axis
        else:
            J[:3, i], J[3:, i] = ca.cross(axis, tip - origin), axis
    return J


def axis_rows(tree: KinematicTree, q: ca.SX, axis: int) -> ca.SX:
    """Jacobian of the direction of a tip axis, along the two other axes of the tip, (2, n)."""
    own, others = tip_axes(tree, axis)
    J = velocity_rows(tree, q, tree.tip_parent)[3:, :]
    along = ca.horzcat(*[ca.cross(J[:, i], ca.SX(ca.DM(own))) for i in range(tree.n)])
    return constant(others.T) @ along


def tip_axes(tree: KinematicTree, axis: int) -> tuple[Array, Array]:
    """An axis of the tip (3,) and the two others (3, 2) in the frame of the body that carries it."""
    return tree.tip_rotation[:, axis], tree.tip_rotation[:, [k for k in range(3) if k != axis]]


def rotation_deviation(tree: KinematicTree) -> float:
    """A bound of how far a stored rotation, or one in floating-point numbers, is from a rotation."""
    stored = np.concatenate([tree.rotations, tree.tip_rotation[None]])
    squares = stored.transpose(0, 2, 1) @ stored - np.eye(3)
    return 3 * float(np.abs(squares).max()) + 32 * UNIT


def longest_reach(tree: KinematicTree, domain: Domain) -> float:
    """A bound of the distance of the tip from any joint's origin on the box of a domain [m], plus 1."""
    furthest = np.abs(domain.centre) + domain.half_width
    slides = float(furthest[np.array(tree.prismatic)].sum())
    return float(np.abs(tree.translations).sum() + np.abs(tree.tip_translation).sum()) + slides + 1.0


def _allowance(tree: KinematicTree, domain: Domain) -> float:
    """A bound of what stored rotations change in an entry: 16 n deviations times the length of the chain."""
    return 16 * (tree.n + 1) * rotation_deviation(tree) * longest_reach(tree, domain)


def _sparsest(q: ca.SX, choices: list[ca.SX]) -> ca.SX:
    return min(choices, key=lambda J: int(ca.jacobian(ca.vec(J), q).nnz()))


def _poses_in(tree: KinematicTree, q: ca.SX, body: int) -> dict[int, Pose]:
    """Rotation and position of every body of the chain, in the frame of one of them."""
    chain = tree.carriers(tree.tip_parent)
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
