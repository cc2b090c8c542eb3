"""Arms in a scene of viser: one that moves, and a fan of coloured ghosts of it."""

from typing import Any

import casadi as ca
import numpy as np
import scipy

from orthocas.robots.kinematics import body_poses, tip_pose
from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array
from orthocas.viewer.looks import COARSE, Look, by_colour, joined, stick_arm

GHOSTS = 9  #: arms of a fan
_SLIM = 0.32  # thickness of a ghost, as a share of the arm's
_LOW, _MIDDLE, _HIGH = (24, 92, 214), (64, 168, 116), (245, 118, 10)  # colours along a coordinate
_TRACE = 0.004  # thickness of a line, as a share of the size of the arm


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


class Arm:
    """An arm in the scene.

    Args:
        scene: of a viser server.
        name: of its node, such as "/arm".
        robot: the robot.
        look: what its bodies carry.
        shift: where its base stands (3,) [m].
    """

    def __init__(self, scene: Any, name: str, robot: Robot, look: Look, shift: Array | None = None) -> None:
        self._poses = BodyPoses(robot.tree)
        self.shift = np.zeros(3) if shift is None else shift
        scene.add_frame(name, show_axes=False, position=tuple(self.shift))
        self._frames = []
        for i, solids in enumerate(look):
            self._frames.append(scene.add_frame(f"{name}/{i}", show_axes=False))
            for j, solid in enumerate(by_colour(solids)):
                scene.add_mesh_simple(
                    f"{name}/{i}/{j}",
                    solid.vertices,
                    solid.faces,
                    color=solid.colour,
                    side="double",
                    flat_shading=False,
                )

    def show(self, q: Array) -> None:
        """Move to a joint position (n,)."""
        positions, quaternions = self._poses(q[None])
        for frame, position, quaternion in zip(self._frames, positions[0], quaternions[0], strict=True):
            frame.position, frame.wxyz = position, quaternion


class Ghosts:
    """Slim arms at several joint positions, coloured from the first to the last, and lines through their joints."""

    def __init__(self, scene: Any, name: str, robot: Robot) -> None:
        self._scene, self._name, self._robot = scene, name, robot
        self._poses = BodyPoses(robot.tree)
        self._look = [
            joined(solids, (255, 255, 255)) if solids else None for solids in stick_arm(robot.tree, _SLIM, COARSE)
        ]
        self._nodes: list[Any] = []

    def show(self, q: Array, curve: Array) -> None:
        """Show arms at joint positions (N, n), and the way of their joints along a curve (M, n)."""
        self.hide()
        colours = shades(len(q))
        positions, quaternions = self._poses(q)
        for i, solid in enumerate(self._look):
            if i > 0 and solid is not None:
                node = self._scene.add_batched_meshes_simple(
                    f"{self._name}/{i}", solid.vertices, solid.faces, quaternions[:, i], positions[:, i],
                    batched_colors=colours, opacity=0.55, cast_shadow=False, receive_shadow=False, lod="off",
                )  # fmt: skip
                self._nodes.append(node)
        self._show_traces(curve)

    def hide(self) -> None:
        """Remove all."""
        for node in self._nodes:
            node.remove()
        self._nodes = []

    def _show_traces(self, curve: Array) -> None:
        """Lines that the joints move along, except those that stay."""
        points = self._robot.joint_points(curve)
        size = float(np.ptp(points.reshape(-1, 3), axis=0).max())
        colours = shades(len(curve))
        for i in range(points.shape[1]):
            way = points[:, i]
            if np.ptp(way, axis=0).max() > 0.03 * size:
                ends = np.stack([way[:-1], way[1:]], axis=1)
                shade = np.stack([colours[:-1], colours[1:]], axis=1)
                node = self._scene.add_line_segments(
                    f"{self._name}/trace{i}", ends, shade, thickness=_TRACE * max(size, 1e-3)
                )
                self._nodes.append(node)


def shades(count: int) -> Array:
    """Colours from low to high values of a coordinate, (count, 3), 0 to 255."""
    share = np.linspace(0.0, 1.0, count)
    return np.column_stack(
        [np.interp(share, [0, 0.5, 1], channel) for channel in zip(_LOW, _MIDDLE, _HIGH, strict=True)]
    ).astype(np.uint8)
