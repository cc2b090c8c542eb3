"""Poses of all bodies of a robot as numbers: positions and quaternions, as viewers take them."""

import casadi as ca
import numpy as np
import scipy

from orthocas.casadi_tools.batch import Batched, dense_function
from orthocas.checks import Array
from orthocas.robots.kinematics import body_poses, tip_pose
from orthocas.robots.tree import KinematicTree


class BodyPoses:
    """Poses of the base, of each body and of the tip frame in the world: n + 2 frames in this order."""

    def __init__(self, tree: KinematicTree) -> None:
        q = ca.SX.sym("q", tree.n)
        base = (ca.SX.eye(3), ca.SX.zeros(3))
        poses = [base, *body_poses(tree, q), tip_pose(tree, q)]
        self._batched = Batched(dense_function("poses", [q], [ca.horzcat(*(ca.horzcat(R, p) for R, p in poses))]))

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Positions (N, n + 2, 3) [m] and unit quaternions w, x, y, z (N, n + 2, 4) at joint positions (N, n)."""
        flat = self._batched(q)[0]
        frames = flat.reshape(len(q), 3, -1, 4).transpose(0, 2, 1, 3)  # (N, n + 2, 3, 4)
        turns = scipy.spatial.transform.Rotation.from_matrix(frames[..., :3].reshape(-1, 3, 3))
        quaternions = turns.as_quat(scalar_first=True).reshape(len(q), -1, 4)
        return np.ascontiguousarray(frames[..., 3]), quaternions
