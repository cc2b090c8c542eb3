"""Move the tip to the end of a tool, without another robot file."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_float_array, require_finite
from orthocas.errors import InvalidValueError
from orthocas.robots.spatial import rotation_matrix, snap
from orthocas.robots.tree import KinematicTree


def with_tool(tree: KinematicTree, tool: ArrayLike) -> KinematicTree:
    """The tree with its tip moved: tip pose = old tip pose times the tool's transform. The tool has no mass.

    Args:
        tree: the robot.
        tool: (3,) position [m], (6,) position and roll, pitch, yaw [rad] as in URDF, or a homogeneous transform (4, 4).

    Raises:
        InvalidValueError: if the tool has another form.
    """
    R, p = _transform(tool)
    return replace(
        tree,
        tip_name=f"{tree.tip_name} + tool",
        tip_rotation=snap(tree.tip_rotation @ R),
        tip_translation=tree.tip_translation + tree.tip_rotation @ p,
    )


def _transform(tool: ArrayLike) -> tuple[Array, Array]:
    """Rotation (3, 3) and position (3,) of a tool."""
    values = as_float_array("tool", tool)
    require_finite("tool", values)
    if values.shape == (4, 4):
        if not np.allclose(values[3], [0, 0, 0, 1], atol=1e-12):
            raise InvalidValueError("last row of tool", values[3].tolist(), "[0, 0, 0, 1]")
        return rotation_matrix("rotation of tool", values[:3, :3]), values[:3, 3]
    if values.shape == (6,):
        return _from_angles(*values[3:]), values[:3]
    if values.shape == (3,):
        return np.eye(3), values
    raise InvalidValueError("shape of tool", values.shape, "(3,), (6,) or (4, 4)")


def _from_angles(roll: float, pitch: float, yaw: float) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), fixed axes as in URDF."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
