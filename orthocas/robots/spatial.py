"""Rigid-body algebra on CasADi SX columns and on numbers."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array, freeze_array

_TINY = 1e-24  #: added under square roots to keep their derivatives finite
_EXACTLY = 1e-9  #: error of R R^T up to which a rotation stays as it is
_NEARLY = 1e-3  #: error of R R^T up to which the nearest rotation takes its place
#: entries of rotations this close to 0 or +-1 are rounding errors of the conversion from roll, pitch, yaw
_ROUNDING = 1e-14


def skew(v: ca.SX) -> ca.SX:
    """[v]x with [v]x w = v x w, (3, 3)."""
    x, y, z = ca.vertsplit(v)
    return ca.vertcat(ca.horzcat(0, -z, y), ca.horzcat(z, 0, -x), ca.horzcat(-y, x, 0))


def turn(q: ca.SX) -> ca.SX:
    """Rz(q), (3, 3)."""
    c, s = ca.cos(q), ca.sin(q)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def half_angle_vector(R: ca.SX) -> ca.SX:
    """2 sin(angle / 2) axis of a rotation matrix, (3, 1): vee(R - R^T) / sqrt(1 + trace R)."""
    vee = ca.vertcat(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return vee / ca.sqrt(1 + ca.trace(R))


def find_quaternion(R: ca.SX) -> ca.SX:
    """Unit quaternion (w, x, y, z) of a rotation matrix, with w >= 0 and full accuracy, (4, 1).

    Beyond 120 degrees it comes from the column of v v^T with the largest diagonal entry, v = (x, y, z).
    """
    trace, far = ca.trace(R), ca.SX(4, 1)
    # 4 v_k^2
    squares = [ca.fmax(1 + 2 * R[k, k] - trace, _TINY) for k in range(3)]
    for k in (2, 1, 0):
        i, j = (k + 1) % 3, (k + 2) % 3
        size, turned = ca.sqrt(squares[k]), R[j, i] - R[i, j]
        column = ca.SX(4, 1)
        column[0], column[1 + k] = turned / size, size
        column[1 + i], column[1 + j] = (R[k, i] + R[i, k]) / size, (R[k, j] + R[j, k]) / size
        column = column * ca.if_else(turned < 0, -0.5, 0.5)
        largest = 1.0 if k == 2 else ca.if_else(squares[k] >= ca.fmax(squares[i], squares[j]), 1, 0)
        far = ca.if_else(largest, column, far)
    cosine = ca.sqrt(ca.fmax(1 + trace, _TINY))
    vee = ca.vertcat(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return ca.if_else(trace > 0, ca.vertcat(cosine, vee / cosine) / 2, far)


def multiply_quaternions(a: ca.SX, b: ca.SX) -> ca.SX:
    """Product a b of quaternions (w, x, y, z), (4, 1)."""
    v, u = a[1:], b[1:]
    return ca.vertcat(a[0] * b[0] - ca.dot(v, u), a[0] * u + b[0] * v + ca.cross(v, u))


def conjugate(a: ca.SX) -> ca.SX:
    """Conjugate of a quaternion (w, x, y, z); for a unit quaternion, its inverse."""
    return ca.vertcat(a[0], -a[1:])


def build_rotations(quaternions: Array) -> Array:
    """Rotation matrices (N, 3, 3) of unit quaternions (w, x, y, z), (N, 4)."""
    w, x, y, z = quaternions.T
    o = np.zeros_like(w)
    cross = np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)
    R: Array = np.eye(3) + 2 * (w[:, None, None] * cross + cross @ cross)
    return R


def tilt(R: ca.SX, axis: int, to_differentiate: bool = False) -> ca.SX:
    """2 sin(angle / 2) times the direction in which a rotation matrix tilts a coordinate axis, (2, 1).

    With d = R e_axis, these are the two other entries of d times sqrt(2 / (1 + d_axis)): Lambert's equal-area map.

    Args:
        R: the rotation matrix.
        axis: number of the axis.
        to_differentiate: use the formula without case distinctions, which loses digits near half a turn.
    """
    d = R[:, axis]
    across = d[[k for k in range(3) if k != axis]]
    factor = ca.sqrt(2 / (1 + d[axis]))
    if to_differentiate:
        return across * factor
    # Formula beyond a quarter of a turn.
    beyond = ca.sqrt(2 * (1 - d[axis]) / ca.fmax(ca.sumsqr(across), _TINY))
    return across * ca.if_else(d[axis] < 0, beyond, factor)


def turn_about(R: ca.SX, axis: int) -> ca.SX:
    """Angle of a rotation matrix about one of its own axes, after the shortest rotation that tilts that axis.

    R = S T. S takes e_axis to R e_axis about an axis perpendicular to both. T turns about e_axis by the angle
    atan2(R_ji - R_ij, R_ii + R_jj) in (-pi, pi], with (i, j, axis) in cyclic order. The angle is singular where S is
    half a turn. Near that, 2 atan2(p_axis, p_w) of the quaternion p is more accurate.
    """
    i, j = (axis + 1) % 3, (axis + 2) % 3
    return ca.atan2(R[j, i] - R[i, j], R[i, i] + R[j, j])


def constant(values: Array) -> ca.SX:
    """A constant whose zeros are structural, so that products with them vanish."""
    return ca.SX(ca.sparsify(ca.DM(values)))


def rotation_matrix(name: str, value: ArrayLike) -> Array:
    """A read-only rotation (3, 3). One in single precision or a few decimals gives way to the nearest rotation.

    Raises:
        ShapeError, InvalidValueError: if it is off by more than 1e-3.
    """
    rotation = freeze_array(name, value, (3, 3))
    # Larger entries are no rotation, and their products may overflow.
    bounded = np.abs(rotation).max() < 2
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max()) if bounded else np.inf
    if not error < _NEARLY or np.linalg.det(rotation) < 0:
        wanted = f"a rotation matrix: R R^T = 1 to {_NEARLY:g}, det R = 1"
        raise InvalidValueError(name, rotation.tolist(), wanted)
    if error <= _EXACTLY:
        return rotation
    left, _, right = np.linalg.svd(rotation)
    return freeze_array(name, left @ right, (3, 3))


def rotate_z_to(axis: Array) -> Array:
    """A rotation T with T z = axis. For a coordinate axis it is a signed permutation, so that zeros stay zeros."""
    z = snap(axis / np.linalg.norm(axis))
    helper = np.roll(np.eye(3)[int(np.argmax(np.abs(z)))], 1)
    y = np.cross(z, helper)
    y = snap(y / np.linalg.norm(y))
    return np.column_stack([np.cross(y, z), y, z])


def snap(values: Array) -> Array:
    """Replace entries within rounding of 0 or +-1 by these values, so that CasADi drops the terms."""
    rounded = np.round(values)
    return np.where(np.abs(values - rounded) < _ROUNDING, rounded, values) + 0.0
