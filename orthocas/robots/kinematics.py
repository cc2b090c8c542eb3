"""Forward kinematics of a tree as CasADi expressions, orientation of the tip relative to a reference, and tools."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, units_hint
from orthocas.robots.spatial import (
    constant,
    find_quaternion,
    half_angle_vector,
    multiply_quaternions,
    rotate_z_to,
    rotation_matrix,
    skew,
    snap,
    tilt,
    turn,
    turn_about,
)
from orthocas.robots.tree import Frame, KinematicTree
from orthocas.tools.checks import Array, as_float_array, freeze_array, require_finite, require_known

_AXES = ("x", "y", "z")
_LEAST_SQUARE = 1e-24  #: smallest value under the square root of a cosine
#: kind -> whether the position is included, and whether the whole orientation is
_KINDS = {"orientation": (False, True), "pose": (True, True), "axis": (False, False), "position+axis": (True, False)}

Pose = tuple[ca.SX, ca.SX]  #: rotation (3, 3) and position (3, 1) [m] in the world


TOOL_SUFFIX = " + tool"  #: suffix of a tip's name with a tool


def build_body_poses(tree: KinematicTree, q: ca.SX) -> list[Pose]:
    """Rotation and position of every body frame in the world, for q (n, 1)."""
    positions, poses = tree.expand(q), dict[int, Pose]()
    for i in tree.order:
        parent = poses.get(tree.parents[i], (ca.SX.eye(3), ca.SX.zeros(3)))
        poses[i] = _move_to_child(tree, positions, i, parent)
    return [poses[i] for i in range(tree.bodies)]


def _move_to_child(tree: KinematicTree, positions: ca.SX, i: int, pose: Pose) -> Pose:
    """Pose of body i, from that of its parent, for the positions of all joints (N, 1)."""
    R, p = pose
    R_joint, p_joint = R @ constant(tree.rotations[i]), p + R @ constant(tree.translations[i])
    if tree.body_kinds[i] == "prismatic":
        return R_joint, p_joint + R_joint[:, 2] * positions[i]
    return R_joint @ turn(positions[i]), p_joint


def build_frame_pose(tree: KinematicTree, q: ca.SX, frame: Frame, base: Frame | None = None) -> Pose:
    """Rotation and position of a frame in the world, or in another frame, for q (n, 1).

    Joints that carry both frames cancel and are left out.
    """
    shared = _find_shared(tree, frame, base)
    R, p = _place_frame(tree, q, frame, shared)
    if base is None:
        return R, p
    across, origin = _place_frame(tree, q, base, shared)
    return across.T @ R, across.T @ (p - origin)


def build_frame_jacobian(tree: KinematicTree, q: ca.SX, frame: Frame, base: Frame | None = None) -> ca.SX:
    """Geometric Jacobian of a frame, (6, n), in world axes, or relative to another frame and in its axes.

    d(position)/dt = J[:3] dq, angular velocity = J[3:] dq.
    """
    shared = _find_shared(tree, frame, base)
    point = _place_frame(tree, q, frame, shared)[1]
    J = _build_jacobian(tree, q, frame.parent, point, shared)
    if base is None:
        return J
    across = _place_frame(tree, q, base, shared)[0]
    J -= _build_jacobian(tree, q, base.parent, point, shared)
    return ca.vertcat(across.T @ J[:3, :], across.T @ J[3:, :])


def build_centre_of_mass(tree: KinematicTree, q: ca.SX) -> ca.SX:
    """Centre of mass of all bodies that the joints move, in the world, (3, 1)."""
    places = [p + R @ constant(centre) for (R, p), centre in zip(build_body_poses(tree, q), tree.centres, strict=True)]
    total: ca.SX = sum(mass * place for mass, place in zip(tree.masses, places, strict=True)) / tree.masses.sum()
    return total


def _find_shared(tree: KinematicTree, frame: Frame, base: Frame | None) -> list[int]:
    """The bodies that carry both frames, from the base on; none if the second frame is the world."""
    pairs = zip(tree.carriers(frame.parent), tree.carriers(-1 if base is None else base.parent), strict=False)
    return [body for body, other in pairs if body == other]


def _place_frame(tree: KinematicTree, q: ca.SX, frame: Frame, shared: list[int]) -> Pose:
    """Pose of a frame in the last one of the shared bodies, or in the world if there are none."""
    R, p = ca.SX.eye(3), ca.SX.zeros(3)
    positions = tree.expand(q)
    for body in tree.carriers(frame.parent)[len(shared) :]:
        R, p = _move_to_child(tree, positions, body, (R, p))
    return R @ constant(frame.rotation), p + R @ constant(frame.translation)


def _build_jacobian(tree: KinematicTree, q: ca.SX, carrier: int, point: ca.SX, shared: list[int]) -> ca.SX:
    """Jacobian (6, n) of a point of a body, by the joints between the shared bodies and it."""
    J, pose, positions = ca.SX(6, tree.bodies), (ca.SX.eye(3), ca.SX.zeros(3)), tree.expand(q)
    # A sliding joint moves the point along its axis, a turning one along axis x (point - origin).
    for i in tree.carriers(carrier)[len(shared) :]:
        pose = _move_to_child(tree, positions, i, pose)
        axis = pose[0][:, 2]
        if tree.body_kinds[i] == "prismatic":
            J[:3, i] = axis
        else:
            J[:3, i], J[3:, i] = ca.cross(axis, point - pose[1]), axis
    return J @ ca.sparsify(ca.DM(tree.coupling)) if tree.mimic_names else J


def build_tip_pose(tree: KinematicTree, q: ca.SX) -> Pose:
    """Rotation and position of the tip frame in the world, for q (n, 1)."""
    return build_frame_pose(tree, q, tree.tip)


def build_tip_jacobian(tree: KinematicTree, q: ca.SX) -> ca.SX:
    """Geometric Jacobian of the tip in world axes, (6, n): d(position)/dt = J[:3] dq, angular velocity = J[3:] dq."""
    return build_frame_jacobian(tree, q, tree.tip)


def build_point_jacobian(tree: KinematicTree, q: ca.SX, body: int, point: Array) -> ca.SX:
    """Jacobian (3, n) of a point (3,) [m] that is fixed in a body's frame: d(position in the world)/dt = J dq."""
    return build_frame_jacobian(tree, q, Frame("point", body, np.eye(3), point))[:3, :]


def build_joint_points(tree: KinematicTree, q: ca.SX) -> ca.SX:
    """Base, joint origins and tip as a line to draw, (3, points), in the world.

    With several tips, the line goes to the other tips first and returns along their joints.
    """
    poses, points = build_body_poses(tree, q), [ca.SX.zeros(3)]
    here: list[int] = []
    for name in (*reversed(tree.tips), tree.tip_name):
        frame = tree.frame(name)
        chain = tree.carriers(frame.parent)
        # Go back along the last chain to the branching point, then out to the next tip.
        back = [body for body in here if body not in chain]
        shared = len(here) - len(back)
        points += [poses[body][1] for body in [*reversed(back), *here[shared - 1 : shared]]]
        points += [poses[body][1] for body in chain[shared:]]
        points.append(build_frame_pose(tree, q, frame)[1])
        here = chain
    return ca.horzcat(*points)


@dataclass(frozen=True)
class TipTurn:
    """Rotation of the tip relative to a reference; pose-like tasks put the position before it."""

    with_position: bool
    whole: bool  #: the whole orientation, or only the direction of one axis
    axis: str | None = None  #: axis of the tip, "x", "y" or "z"; None for a rotation vector

    def __post_init__(self) -> None:
        if self.axis is not None:
            require_known("axis of the tip", self.axis, _AXES)

    @classmethod
    def from_kind(cls, kind: str) -> Self | None:
        """Build from a task's kind, such as orientation, pose:z, axis:x or position+axis; None for other kinds."""
        what, _, axis = kind.partition(":")
        if what not in _KINDS:
            return None
        with_position, whole = _KINDS[what]
        return cls(with_position, whole, axis or (None if whole else "z"))

    @property
    def kind(self) -> str:
        """The full name of the kind."""
        what = next(name for name, parts in _KINDS.items() if parts == (self.with_position, self.whole))
        return f"{what}:{self.axis}" if self.axis else what

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the components."""
        tilts = tuple(f"tilt_{a}" for a in _AXES if a != self.axis)
        whole = (*tilts, f"turn_{self.axis}") if self.axis else ("rx", "ry", "rz")
        turns = whole if self.whole else tilts
        return (*_AXES, *turns) if self.with_position else turns

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the components."""
        return tuple("m" if label in _AXES else "rad" for label in self.labels)

    def components(self, turned: ca.SX, position: ca.SX, to_differentiate: bool = False) -> ca.SX:
        """The task value x, from the tip's rotation (3, 3) in the reference frame and its position (3, 1).

        Args:
            turned: the rotation.
            position: the position.
            to_differentiate: use the formula without case distinctions, which loses digits near half a turn.
        """
        if self.axis is None:
            turns = half_angle_vector(turned) if to_differentiate else 2 * find_quaternion(turned)[1:]
        else:
            turns = self._split_about_axis(turned, None if to_differentiate else find_quaternion(turned))
        return ca.vertcat(position, turns) if self.with_position else turns

    def quaternion(self, turns: ca.SX) -> ca.SX:
        """Quaternion (w, x, y, z) of the components (3, 1) of a whole orientation; w >= 0 if no axis is chosen."""
        half = turns / 2
        # Whole rotation vector.
        if self.axis is None:
            return ca.vertcat(_compute_cosine(half), half)
        axis = _AXES.index(self.axis)
        i, j = _others(axis)
        tilted, along, spun = ca.SX(3, 1), ca.SX(3, 1), ca.SX(3, 1)
        # Tilt of the axis, then turn about it.
        tilted[i], tilted[j], along[axis], spun[axis] = half[0], half[1], 1, ca.sin(half[2])
        tilting = ca.cross(along, tilted)
        return multiply_quaternions(ca.vertcat(_compute_cosine(tilting), tilting), ca.vertcat(ca.cos(half[2]), spun))

    def of_quaternion(self, p: ca.SX) -> ca.SX:
        """Components (3, 1) of a whole orientation from its unit quaternion (w, x, y, z)."""
        if self.axis is None:
            return 2 * p[1:] * ca.if_else(p[0] < 0, -1, 1)
        cross = skew(p[1:])
        turned = ca.SX.eye(3) + 2 * (p[0] * cross + cross @ cross)
        return self._split_about_axis(turned, p * ca.if_else(p[0] < 0, -1, 1))

    @property
    def order(self) -> Array:
        """S (3, 3): the components of a whole orientation change at the rate S omega, in the order of `rates`."""
        if self.axis is None:
            return np.eye(3)
        axis = _AXES.index(self.axis)
        along = np.eye(3)[axis]
        tilting = -np.array(ca.DM(skew(ca.SX(along))))
        return np.vstack([tilting[_others(axis)], along])

    def _split_about_axis(self, turned: ca.SX, p: ca.SX | None) -> ca.SX:
        """Tilt and turn of a rotation matrix; the quaternion p (w >= 0) is None for derivatives."""
        assert self.axis is not None
        axis = _AXES.index(self.axis)
        tilts = tilt(turned, axis, p is None)
        if not self.whole:
            return tilts
        return ca.vertcat(tilts, turn_about(turned, axis) if p is None else 2 * ca.atan2(p[1 + axis], p[0]))

    def rates(self, turning: ca.SX, moving: ca.SX) -> ca.SX:
        """Rate of the components per joint, (m, n), with the tip's present orientation as the reference.

        Args:
            turning: angular velocity of the tip in its own axes, (3, n).
            moving: velocity of the tip in any fixed axes, (3, n).
        """
        rows = turning
        if self.axis is not None:
            axis = _AXES.index(self.axis)
            # Rate of the axis itself.
            tilting = -skew(ca.SX(np.eye(3)[axis])) @ turning
            rows = ca.vertcat(tilting[_others(axis), :], *([turning[axis, :]] if self.whole else []))
        return ca.vertcat(moving, rows) if self.with_position else rows

    def measure_half_turn_distance(self, x: Array) -> Array:
        """cos(angle / 2) of the larger of tilt and turn at task values (N, m), (N,); 0 where the components end."""
        turns = x[:, 3:] if self.with_position else x
        angles = 2 * np.arcsin(np.minimum(np.linalg.norm(turns[:, : 3 if self.axis is None else 2], axis=1) / 2, 1.0))
        if self.axis is not None and self.whole:
            angles = np.maximum(angles, np.abs(turns[:, 2]))
        margin: Array = np.cos(angles / 2)
        return margin


def _compute_cosine(sines: ca.SX) -> ca.SX:
    """Positive cosine of half an angle from sin(angle / 2) times the axis, (3, 1); its derivative is finite."""
    return ca.sqrt(ca.fmax(1 - ca.sumsqr(sines), _LEAST_SQUARE))


def _others(axis: int) -> list[int]:
    return [k for k in range(3) if k != axis]


def align_frame(direction: ArrayLike, axis: str) -> Array:
    """A rotation (3, 3) that takes a coordinate axis to a direction (3,).

    Raises:
        ShapeError, InvalidValueError: if the direction is zero or not (3,).
    """
    target = freeze_array("reference", direction, (3,))
    if not target.any():
        raise InvalidValueError("reference", target.tolist(), "a direction other than zero")
    return np.roll(rotate_z_to(target), _AXES.index(axis) - 2, axis=1)


def add_tool(tree: KinematicTree, tool: ArrayLike) -> KinematicTree:
    """The tree with its tip moved: tip pose = old tip pose times the tool's transform. The tool has no mass.

    Args:
        tree: the robot.
        tool: (3,) position [m], (6,) position and roll, pitch, yaw [rad] as in URDF, or a homogeneous transform (4, 4).

    Raises:
        InvalidValueError: if the tool has another form, or numbers that look like millimetres or degrees.
    """
    R, p = _read_tool(tool)
    return replace(
        tree,
        tip_name=f"{tree.tip_name}{TOOL_SUFFIX}",
        tip_rotation=snap(tree.tip_rotation @ R),
        tip_translation=tree.tip_translation + tree.tip_rotation @ p,
    )


def _read_tool(tool: ArrayLike) -> tuple[Array, Array]:
    """Rotation (3, 3) and position (3,) of a tool."""
    values = as_float_array("tool", tool)
    require_finite("tool", values)
    numbers = values[:3, 3] if values.shape == (4, 4) else values.ravel()
    # Millimetres and degrees are the usual mistakes, so the error hints at them.
    if hint := units_hint(("m", "m", "m", "rad", "rad", "rad"), numbers.tolist()):
        raise InvalidValueError("tool", values.tolist(), f"the pose of a tip{hint}")
    if values.shape == (4, 4):
        if not np.allclose(values[3], [0, 0, 0, 1], atol=1e-12):
            raise InvalidValueError("last row of tool", values[3].tolist(), "[0, 0, 0, 1]")
        return rotation_matrix("rotation of tool", values[:3, :3]), values[:3, 3]
    if values.shape == (6,):
        # Rz(yaw) Ry(pitch) Rx(roll), about fixed axes as in URDF.
        (cr, cp, cy), (sr, sp, sy) = np.cos(values[3:]), np.sin(values[3:])
        turned = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        return np.array(turned), values[:3]
    if values.shape == (3,):
        return np.eye(3), values
    raise InvalidValueError("shape of tool", values.shape, "(3,), (6,) or (4, 4)")
