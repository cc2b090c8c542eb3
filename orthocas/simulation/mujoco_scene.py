"""What a simulation with MuJoCo contains besides the robot, as plain settings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocas.control.gains import non_negative_gains, positive_gains
from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.robots.tree import require_body
from orthocas.tools.checks import Array, as_number, frozen_array, require_at_least, require_kind

MUJOCO = "mujoco"  #: name of this plant
TIMESTEP = 1e-3  #: longest step of the physics [s]

_TIMESTEPS = (1e-6, 1e-2)  # [s] shortest and longest


@dataclass(frozen=True, eq=False)
class Payload:
    """A body fixed at the tip.

    Args:
        mass: >= 0 [kg].
        centre: centre of mass in the tip frame, (3,) [m]; default the tip.
        inertia: about the centre of mass, in axes of the tip frame, (3, 3) [kg m^2]; default a point mass.

    Raises:
        ShapeError, InvalidValueError, RobotError: for numbers that no body has.
    """

    mass: float
    centre: Array
    inertia: Array

    def __init__(
        self, mass: float, centre: ArrayLike = (0.0, 0.0, 0.0), inertia: ArrayLike = ((0.0,) * 3,) * 3
    ) -> None:
        require_at_least("mass of a payload", mass, 0.0)
        object.__setattr__(self, "mass", as_number("mass of a payload", mass))
        object.__setattr__(self, "centre", frozen_array("centre of a payload", centre, (3,)))
        object.__setattr__(self, "inertia", frozen_array("inertia of a payload", inertia, (3, 3)))
        require_body("tip", self.mass, self.inertia, 0.0)


@dataclass(frozen=True, eq=False)
class Wall:
    """A fixed wall that a sphere around the tip can touch; the rest of the robot passes through it.

    Args:
        point: middle of its face, in the world, (3,) [m].
        normal: direction in which its face looks, (3,), of any length > 0.
        tip_radius: radius of the sphere [m], > 0.
        size: length of the square face's sides [m], > 0.
        thickness: of the wall behind the face [m], > 0.
        time_constant: of the contact [s], > 0; contacts are critically damped. MuJoCo uses at least two time steps.
    """

    point: Array
    normal: Array
    tip_radius: float = 0.02
    size: float = 1.0
    thickness: float = 0.2
    time_constant: float = 0.01

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", frozen_array("point of a wall", self.point, (3,)))
        normal = frozen_array("normal of a wall", self.normal, (3,))
        if not 0 < np.linalg.norm(normal) < np.inf:
            raise InvalidValueError("normal of a wall", normal.tolist(), "a direction other than zero")
        object.__setattr__(self, "normal", frozen_array("normal", normal / np.linalg.norm(normal), (3,)))
        for name in ("tip_radius", "size", "thickness", "time_constant"):
            if not 0 < as_number(f"{name} of a wall", getattr(self, name)) < np.inf:
                raise InvalidValueError(f"{name} of a wall", getattr(self, name), "a finite number > 0")


@dataclass(frozen=True, eq=False)
class Elasticity:
    """Springs and dampers between the rotors of the motors and the joints, as of gears that give way.

    With rotors at theta, M ddq + C dq + g = k (theta - q) + d (dtheta - dq) + loads and
    B ddtheta = u - friction - k (theta - q) - d (dtheta - dq). Rotors turn about their own axes only [S1987].

    Args:
        stiffness: k > 0, (n,) or one number [N m/rad].
        inertia: B > 0 of the rotors, seen at the joints, which takes the place of the robot's armatures, (n,) or one
            number [kg m^2].
        damping: d >= 0, (n,) or one number [N m s/rad].
    """

    stiffness: ArrayLike
    inertia: ArrayLike
    damping: ArrayLike = 0.0

    def numbers(self, n: int) -> tuple[Array, Array, Array]:
        """Stiffness, inertia and damping of n joints, (n,) each.

        Raises:
            ShapeError, InvalidValueError: for other shapes and values.
        """
        found = [positive_gains(f"{name} of elasticity", getattr(self, name), n) for name in ("stiffness", "inertia")]
        return found[0], found[1], non_negative_gains("damping of elasticity", self.damping, n)


@dataclass(frozen=True, eq=False)
class MuJoCo:
    """MuJoCo as plant of `simulate`: `simulate(..., plant=MuJoCo(...), control_rate=1000)`.

    The model is made from the robot's own numbers, so every chart file has one; see `MuJoCoPlant`. Needs the extra
    `orthocas[mujoco]`.

    Args:
        robot: the true robot; default the controller's model.
        stops: whether the joints stop at their limits of position.
        effort_limits: whether the motors saturate at the robot's limits of effort.
        payload: a body fixed at the tip, which the controller does not know.
        wall: a wall in the tip's way.
        timestep: longest step of the physics [s], from 1e-6 to 0.01.
        elasticity: of the gears; default rigid ones. Sensors then measure joints, not rotors.
    """

    robot: Robot | None = None
    stops: bool = True
    effort_limits: bool = True
    payload: Payload | None = None
    wall: Wall | None = None
    timestep: float = TIMESTEP
    elasticity: Elasticity | None = None

    def __post_init__(self) -> None:
        for name, kind in (("robot", Robot), ("payload", Payload), ("wall", Wall), ("elasticity", Elasticity)):
            if getattr(self, name) is not None:
                require_kind(name, getattr(self, name), kind)
        require_kind("stops", self.stops, bool)
        require_kind("effort_limits", self.effort_limits, bool)
        shortest, longest = _TIMESTEPS
        if not shortest <= as_number("timestep", self.timestep) <= longest:
            raise InvalidValueError("timestep", self.timestep, f"a number from {shortest:g} to {longest:g}")
