"""The numbers of a kinematic tree: Pinocchio's robot as plain data, which chart files store."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from orthocas.checks import Array, frozen_array, require_known, require_shape
from orthocas.errors import InvalidValueError, RobotError

JointKind = Literal["revolute", "prismatic"]
REVOLUTE_ROOM = np.pi / 4  #: [rad] on either side of a default posture, as the hypercube of [AS2023] Sec. 9
PRISMATIC_ROOM = 0.25  #: [m]
JOINT_KINDS: tuple[JointKind, ...] = ("revolute", "prismatic")


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """Joints, bodies and one tip frame. Joint i moves body i, and parents come before children.

    Body frames are rotated so that every joint axis is the body's z axis. Joint i places its body at
    `rotations[i] Rz(q_i), translations[i]` (revolute) or `rotations[i], translations[i] + q_i rotations[i] z`
    (prismatic) in the parent body's frame.
    """

    joint_names: tuple[str, ...]
    joint_kinds: tuple[JointKind, ...]
    parents: tuple[int, ...]  #: index of the parent body, -1 for the base
    rotations: Array  #: (n, 3, 3) joint frames in the parent's frame
    translations: Array  #: (n, 3) [m]
    masses: Array  #: (n,) [kg]
    centres: Array  #: (n, 3) centre of mass in the body frame [m]
    inertias: Array  #: (n, 3, 3) about the centre of mass, in the body frame [kg m^2]
    armatures: Array  #: (n,) rotor inertia seen at the joint [kg m^2] or [kg]
    lower: Array  #: (n,) joint limits [rad] or [m], -inf where unlimited
    upper: Array  #: (n,)
    effort_limits: Array  #: (n,) largest torque [N m] or force [N], inf where unknown
    velocity_limits: Array  #: (n,) largest speed [rad/s] or [m/s], inf where unknown
    tip_name: str
    tip_parent: int  #: body that carries the tip, -1 for the base
    tip_rotation: Array  #: (3, 3) in that body's frame
    tip_translation: Array  #: (3,) [m]
    gravity: Array  #: (3,) gravity acceleration in the world [m/s^2]

    def __post_init__(self) -> None:
        n = self.n
        if n == 0:
            raise RobotError("the robot has no movable joint, expected at least one")
        shapes: dict[str, tuple[int, ...]] = {
            "rotations": (n, 3, 3),
            "translations": (n, 3),
            "masses": (n,),
            "centres": (n, 3),
            "inertias": (n, 3, 3),
            "armatures": (n,),
            "tip_rotation": (3, 3),
            "tip_translation": (3,),
            "gravity": (3,),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen_array(name, getattr(self, name), shape))
        for name in ("lower", "upper", "effort_limits", "velocity_limits"):  # these may be infinite
            limits = np.array(getattr(self, name), dtype=float)
            require_shape(name, limits.shape, (n,))
            limits.setflags(write=False)
            object.__setattr__(self, name, limits)
        self._require_sense()

    def _require_sense(self) -> None:
        """Check lengths, limits, masses and the order of bodies."""
        require_shape("joint_kinds", (len(self.joint_kinds),), (self.n,))
        require_shape("parents", (len(self.parents),), (self.n,))
        for i, name in enumerate(self.joint_names):
            require_known("joint kind", self.joint_kinds[i], JOINT_KINDS)
            if not -1 <= self.parents[i] < i:
                raise InvalidValueError(f"parents[{i}]", self.parents[i], f"an index from -1 to {i - 1}")
            if not self.lower[i] <= self.upper[i]:
                raise RobotError(
                    f"joint '{name}' has limits [{self.lower[i]:g}, {self.upper[i]:g}], expected lower <= upper"
                )
            for what, limit in (("effort", self.effort_limits[i]), ("velocity", self.velocity_limits[i])):
                if not limit > 0:
                    raise RobotError(f"joint '{name}' has the {what} limit {limit:g}, expected a number > 0")
            if self.masses[i] < 0:
                raise RobotError(f"the body moved by joint '{name}' has mass {self.masses[i]:g} kg, expected >= 0")
        if not -1 <= self.tip_parent < self.n:
            raise InvalidValueError("tip_parent", self.tip_parent, f"an index from -1 to {self.n - 1}")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def middle(self) -> Array:
        """A posture away from the joint limits, (n,) [rad] or [m].

        It is the middle of the limits. A joint without both limits has the value closest to 0 that is pi/4 rad (0.25 m)
        away from its limit.
        """
        room = np.where(self.prismatic, PRISMATIC_ROOM, REVOLUTE_ROOM)
        posture = np.clip(np.zeros(self.n), self.lower + room, self.upper - room)
        limited = np.isfinite(self.lower) & np.isfinite(self.upper)
        posture[limited] = (self.lower[limited] + self.upper[limited]) / 2
        return np.asarray(posture)

    @property
    def prismatic(self) -> tuple[bool, ...]:
        """Whether each joint is prismatic."""
        return tuple(kind == "prismatic" for kind in self.joint_kinds)
