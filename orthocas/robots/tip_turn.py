"""The tip's rotation from a reference orientation, for orientation, pose and axis tasks."""

from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, frozen_array, require_known
from orthocas.errors import InvalidValueError
from orthocas.robots.spatial import half_angle_vector, rotation_z_to, tilt

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class TipTurn:
    """The tip's rotation from a reference. For pose-like tasks its position comes first."""

    with_position: bool
    axis: str | None  #: axis of the tip to compare: "x", "y" or "z"; None for the whole orientation

    def __post_init__(self) -> None:
        if self.axis is not None:
            require_known("axis of the tip", self.axis, _AXES)

    @classmethod
    def of_kind(cls, kind: str) -> Self | None:
        """Build from a task's kind: orientation, pose, axis, axis:x, position+axis, .... None for other kinds."""
        what, _, axis = kind.partition(":")
        if what in ("axis", "position+axis"):
            return cls(what != "axis", axis or "z")
        return cls(kind == "pose", None) if kind in ("orientation", "pose") else None

    @property
    def kind(self) -> str:
        """The full name of the kind."""
        if self.axis is None:
            return "pose" if self.with_position else "orientation"
        return f"{'position+' if self.with_position else ''}axis:{self.axis}"

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the components."""
        turns = tuple(f"tilt_{a}" for a in _AXES if a != self.axis) if self.axis else ("rx", "ry", "rz")
        return (*_AXES, *turns) if self.with_position else turns

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the components."""
        return tuple("m" if label in _AXES else "rad" for label in self.labels)

    def components(self, turned: ca.SX, position: ca.SX) -> ca.SX:
        """The task value x, from the tip's rotation in the reference frame (3, 3) and its position (3, 1)."""
        x = tilt(turned, _AXES.index(self.axis)) if self.axis else half_angle_vector(turned)
        return ca.vertcat(position, x) if self.with_position else x


def frame_along(direction: ArrayLike, axis: str) -> Array:
    """A rotation (3, 3) that takes a coordinate axis to a direction (3,).

    Raises:
        ShapeError, InvalidValueError: if the direction is zero or not (3,).
    """
    wanted = frozen_array("reference", direction, (3,))
    if not wanted.any():
        raise InvalidValueError("reference", wanted.tolist(), "a direction other than zero")
    return np.roll(rotation_z_to(wanted), _AXES.index(axis) - 2, axis=1)
