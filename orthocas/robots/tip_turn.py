"""The tip's rotation from a reference orientation, for orientation, pose and axis tasks."""

from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, frozen_array, require_known
from orthocas.errors import InvalidValueError
from orthocas.robots.spatial import half_angle_vector, rotation_z_to, skew, tilt, turn_about

_AXES = ("x", "y", "z")
_KINDS = {  # whether the position comes first, and whether the whole orientation counts
    "orientation": (False, True),
    "pose": (True, True),
    "axis": (False, False),
    "position+axis": (True, False),
}


@dataclass(frozen=True)
class TipTurn:
    """The tip's rotation from a reference. For pose-like tasks its position comes first."""

    with_position: bool
    whole: bool  #: the whole orientation, or only the direction of one axis
    axis: str | None = None  #: of the tip: "x", "y" or "z"; None for a rotation vector

    def __post_init__(self) -> None:
        if self.axis is not None:
            require_known("axis of the tip", self.axis, _AXES)

    @classmethod
    def of_kind(cls, kind: str) -> Self | None:
        """Build from a task's kind: orientation, pose:z, axis, axis:x, position+axis, .... None for other kinds."""
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

    def components(self, turned: ca.SX, position: ca.SX) -> ca.SX:
        """The task value x, from the tip's rotation in the reference frame (3, 3) and its position (3, 1)."""
        turns = half_angle_vector(turned) if self.axis is None else self._about_axis(turned, _AXES.index(self.axis))
        return ca.vertcat(position, turns) if self.with_position else turns

    def _about_axis(self, turned: ca.SX, axis: int) -> ca.SX:
        return ca.vertcat(tilt(turned, axis), *([turn_about(turned, axis)] if self.whole else []))

    def rates(self, turning: ca.SX, moving: ca.SX) -> ca.SX:
        """How fast the components change if the reference is the tip's present orientation, for each joint, (m, n).

        Args:
            turning: angular velocity of the tip in its own axes, (3, n).
            moving: velocity of the tip in whatever axes, (3, n).
        """
        rows = turning
        if self.axis is not None:
            axis = _AXES.index(self.axis)
            tilting = -skew(ca.SX(np.eye(3)[axis])) @ turning  # how fast the axis itself moves
            rows = ca.vertcat(tilting[_others(axis), :], *([turning[axis, :]] if self.whole else []))
        return ca.vertcat(moving, rows) if self.with_position else rows

    def distance_from_half_a_turn(self, x: Array) -> Array:
        """cos(angle / 2) of the larger of tilt and turn, at task values (N, m), (N,): 0 where the components end."""
        turns = x[:, 3:] if self.with_position else x
        angles = 2 * np.arcsin(np.minimum(np.linalg.norm(turns[:, : 3 if self.axis is None else 2], axis=1) / 2, 1.0))
        if self.axis is not None and self.whole:
            angles = np.maximum(angles, np.abs(turns[:, 2]))
        margin: Array = np.cos(angles / 2)
        return margin


def _others(axis: int) -> list[int]:
    return [k for k in range(3) if k != axis]


def frame_along(direction: ArrayLike, axis: str) -> Array:
    """A rotation (3, 3) that takes a coordinate axis to a direction (3,).

    Raises:
        ShapeError, InvalidValueError: if the direction is zero or not (3,).
    """
    wanted = frozen_array("reference", direction, (3,))
    if not wanted.any():
        raise InvalidValueError("reference", wanted.tolist(), "a direction other than zero")
    return np.roll(rotation_z_to(wanted), _AXES.index(axis) - 2, axis=1)
