"""What the numbers and names of a robot must be, whatever they come from: a robot file, a chart file or a program."""

from collections.abc import Sequence

import numpy as np

from orthocas.checks import Array, require_text
from orthocas.errors import InvalidValueError, RobotError

MOST_JOINTS = 150  #: the work for a mass matrix grows with their square
_LARGEST = 1e30  # larger numbers overflow in products
_NOT_TURNED = 1e-6  # |R R^T - 1| of a rotation in single precision
_SYMMETRIC = 1e-6  # of the largest entry
_INDEFINITE = 0.1  # of the largest entry: identified inertias in published robot files have -0.07
_NO_INERTIA = 1e-9  # [kg m^2]


def require_joint_names(names: Sequence[str]) -> None:
    """Raise an error unless all names are printable text, each of them once."""
    for i, name in enumerate(names):
        require_text(f"joint_names[{i}]", name)
    if len(set(names)) < len(names):
        twice = next(name for i, name in enumerate(names) if name in names[:i])
        raise RobotError(f"two joints are called '{twice}', expected different names")


def require_bounded(name: str, array: Array) -> None:
    """Raise InvalidValueError if an entry is so large that products overflow."""
    largest = float(np.abs(array).max())
    if largest > _LARGEST:
        raise InvalidValueError(f"largest entry of {name}", f"{largest:g}", f"at most {_LARGEST:g}")


def require_index(name: str, value: int, largest: int) -> None:
    """Raise InvalidValueError unless the value is the index of a body, or -1 for the base."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not -1 <= value <= largest:
        raise InvalidValueError(name, repr(value)[:80], f"an index from -1 to {largest}")


def require_limits(joint: str, lower: float, upper: float, effort: float, velocity: float) -> None:
    """Raise RobotError unless a joint can be somewhere, and move."""
    if not lower <= upper or lower == np.inf or upper == -np.inf:
        raise RobotError(f"joint '{joint}' has limits [{lower:g}, {upper:g}], expected lower <= upper")
    for what, limit in (("effort", effort), ("velocity", velocity)):
        if not limit > 0:
            raise RobotError(f"joint '{joint}' has the {what} limit {limit:g}, expected a number > 0")


def require_body(joint: str, mass: float, inertia: Array, armature: float) -> None:
    """Raise RobotError unless mass, armature and inertia (3, 3) about the centre of mass are not negative.

    Identified inertias in published robot files are often slightly indefinite and violate the triangle inequality.
    Whether the mass matrix is positive definite is for the metric to check.
    """
    body = f"the body moved by joint '{joint}'"
    if mass < 0:
        raise RobotError(f"{body} has mass {mass:g} kg, expected >= 0")
    if armature < 0:
        raise RobotError(f"joint '{joint}' has armature {armature:g}, expected >= 0")
    size = float(np.abs(inertia).max())
    if np.abs(inertia - inertia.T).max() > _SYMMETRIC * size:
        raise RobotError(f"{body} has an inertia matrix that is not symmetric")
    smallest = float(np.linalg.eigvalsh((inertia + inertia.T) / 2)[0])
    if smallest < -_INDEFINITE * size - _NO_INERTIA:
        raise RobotError(f"{body} has the principal moment of inertia {smallest:.3g} kg m^2, expected >= 0")


def require_rotation(name: str, matrix: Array) -> None:
    """Raise InvalidValueError unless the matrix (3, 3) is a rotation, to single precision."""
    bounded = np.abs(matrix).max() < 2
    if not bounded or np.abs(matrix @ matrix.T - np.eye(3)).max() > _NOT_TURNED or np.linalg.det(matrix) < 0:
        raise InvalidValueError(name, matrix.round(6).tolist(), "a rotation matrix")
