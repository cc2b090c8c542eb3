"""Positions and orientations of MJCF elements, in the five notations of MJCF."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from orthocas.robots.mjcf_schema import ORIENTATIONS
from orthocas.robots.xml import Attributes
from orthocas.tools.checks import Array

_ELONGATED = ("capsule", "cylinder", "ellipsoid", "box")  # shapes that fromto can place
_TINY = 1e-10  # MuJoCo's limit below which a vector counts as parallel to z


@dataclass(frozen=True, slots=True)
class Angles:
    """The angle conventions of a file."""

    unit: float  #: one unit of the file [rad]: pi / 180 for degrees
    sequence: str  #: axes of the Euler angles, lower case moving and upper case fixed, such as xyz

    @classmethod
    def of(cls, compiler: Attributes) -> "Angles":
        """Read the attributes angle and eulerseq.

        Raises:
            RobotError: if an attribute is invalid.
        """
        unit = 1.0 if compiler.keyword("angle", ("degree", "radian"), "degree") == "radian" else np.pi / 180
        sequence = compiler.text("eulerseq", "xyz")
        if len(sequence) != 3 or not set(sequence) <= set("xyzXYZ"):
            raise compiler.error(f"has eulerseq '{sequence}', expected three letters of xyzXYZ")
        return cls(unit, sequence)


def pose(element: Attributes, angles: Angles) -> pin.SE3:
    """The pose of an element from pos and its orientation, in the frame around it.

    Raises:
        RobotError: if a vector has the wrong length, or is zero where a direction is needed.
    """
    return pin.SE3(_rotation(element, angles), element.numbers("pos", 3, (0, 0, 0)))


def shape_pose(element: Attributes, angles: Angles) -> tuple[pin.SE3, float | None]:
    """The pose of a geom or site, and half its length [m] if fromto gives two end points.

    The z axis goes from the second point to the first, as in MuJoCo's compiler.

    Raises:
        RobotError: as `pose`. Also if fromto does not suit the shape, or is combined with pos.
    """
    if "fromto" not in element.values:
        return pose(element, angles), None
    if element.text("type", "sphere") not in _ELONGATED:
        raise element.error(f"has fromto, expected one of the shapes {', '.join(_ELONGATED)}")
    if element.numbers("pos", 3, (0, 0, 0)).any():
        raise element.error("has both pos and fromto, expected one of them")
    ends = element.numbers("fromto", 6).reshape(2, 3)
    length = float(np.linalg.norm(ends[0] - ends[1]))
    if length < _TINY:
        raise element.error("has a fromto whose two points are the same")
    return pin.SE3(_turn_z_to((ends[0] - ends[1]) / length), ends.mean(axis=0)), length / 2


def _rotation(element: Attributes, angles: Angles) -> Array:
    for name in ORIENTATIONS:
        if name in element.values:
            return _READERS[name](element, angles)
    return np.eye(3)


def _from_quat(element: Attributes, _: Angles) -> Array:
    w, x, y, z = element.numbers("quat", 4)
    norm = np.linalg.norm([w, x, y, z])
    if norm < _TINY:
        raise element.error("has the quaternion 0 0 0 0, expected one that is not zero")
    return np.asarray(pin.Quaternion(w / norm, x / norm, y / norm, z / norm).matrix())


def _from_axisangle(element: Attributes, angles: Angles) -> Array:
    *axis, angle = element.numbers("axisangle", 4)
    norm = np.linalg.norm(axis)
    if norm < _TINY:
        raise element.error("has an axisangle whose axis is zero")
    return _turn(np.array(axis) / norm, angle * angles.unit)


def _from_xyaxes(element: Attributes, _: Angles) -> Array:
    x, y = element.numbers("xyaxes", 6).reshape(2, 3)
    z = np.cross(x, y)
    if np.linalg.norm(x) < _TINY or np.linalg.norm(z) < _TINY * np.linalg.norm(x):
        raise element.error("has xyaxes that are zero or parallel")
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def _from_zaxis(element: Attributes, _: Angles) -> Array:
    return _turn_z_to(element.direction("zaxis"))


def _from_euler(element: Attributes, angles: Angles) -> Array:
    R = np.eye(3)
    for letter, angle in zip(angles.sequence, element.numbers("euler", 3) * angles.unit, strict=True):
        turn = _turn(np.eye(3)["xyz".index(letter.lower())], angle)
        R = R @ turn if letter.islower() else turn @ R
    return R


_READERS = {
    "quat": _from_quat,
    "axisangle": _from_axisangle,
    "xyaxes": _from_xyaxes,
    "zaxis": _from_zaxis,
    "euler": _from_euler,
}


def _turn(axis: Array, angle: float) -> Array:
    return np.asarray(pin.AngleAxis(angle, axis).matrix())


def _turn_z_to(direction: Array) -> Array:
    """The shortest rotation that takes the z axis to a unit vector. For -z it is half a turn about x."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = float(np.linalg.norm(axis))
    return _turn(axis / sine if sine > _TINY else np.eye(3)[0], float(np.arctan2(sine, direction[2])))
