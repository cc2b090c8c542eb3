"""Forward kinematics of a tree as CasADi expressions."""

import casadi as ca

from orthocas.checks import Array
from orthocas.robots.spatial import constant, turn
from orthocas.robots.tree import KinematicTree

Pose = tuple[ca.SX, ca.SX]  #: rotation (3, 3) and position (3, 1) [m] in the world


def body_poses(tree: KinematicTree, q: ca.SX) -> list[Pose]:
    """Rotation and position of every body frame in the world, for q (n, 1)."""
    poses: list[Pose] = []
    for i, parent in enumerate(tree.parents):
        R, p = poses[parent] if parent >= 0 else (ca.SX.eye(3), ca.SX.zeros(3))
        R_joint = R @ constant(tree.rotations[i])
        p_joint = p + R @ constant(tree.translations[i])
        if tree.joint_kinds[i] == "prismatic":
            poses.append((R_joint, p_joint + R_joint[:, 2] * q[i]))
        else:
            poses.append((R_joint @ turn(q[i]), p_joint))
    return poses


def tip_pose(tree: KinematicTree, q: ca.SX) -> Pose:
    """Rotation and position of the tip frame in the world, for q (n, 1)."""
    R, p = body_poses(tree, q)[tree.tip_parent] if tree.tip_parent >= 0 else (ca.SX.eye(3), ca.SX.zeros(3))
    return R @ constant(tree.tip_rotation), p + R @ constant(tree.tip_translation)


def tip_jacobian(tree: KinematicTree, q: ca.SX) -> ca.SX:
    """Geometric Jacobian of the tip in world axes, (6, n): d(position)/dt = J[:3] dq, angular velocity = J[3:] dq."""
    poses = body_poses(tree, q)
    _, p_tip = tip_pose(tree, q)
    J = ca.SX(6, tree.n)
    i = tree.tip_parent
    while i >= 0:
        R, p = poses[i]
        axis = R[:, 2]
        if tree.joint_kinds[i] == "prismatic":
            J[:3, i] = axis
        else:
            J[:3, i], J[3:, i] = ca.cross(axis, p_tip - p), axis
        i = tree.parents[i]
    return J


def point_jacobian(tree: KinematicTree, q: ca.SX, body: int, point: Array) -> ca.SX:
    """Jacobian (3, n) of a point (3,) [m] that is fixed in a body's frame: d(position in the world)/dt = J dq."""
    poses = body_poses(tree, q)
    J = ca.SX(3, tree.n)
    if body >= 0:
        R, p = poses[body]
        position = p + R @ constant(point)
    while body >= 0:
        R, p = poses[body]
        J[:, body] = R[:, 2] if tree.joint_kinds[body] == "prismatic" else ca.cross(R[:, 2], position - p)
        body = tree.parents[body]
    return J


def joint_points(tree: KinematicTree, q: ca.SX) -> ca.SX:
    """Base, origins of the joints that move the tip, and the tip, (3, points), in the world."""
    poses = body_poses(tree, q)
    chain, i = [], tree.tip_parent
    while i >= 0:
        chain.append(poses[i][1])
        i = tree.parents[i]
    return ca.horzcat(ca.SX.zeros(3), *reversed(chain), tip_pose(tree, q)[1])
