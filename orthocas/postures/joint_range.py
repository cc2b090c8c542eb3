"""All joint positions farther than a margin from the limits."""

import numpy as np

from orthocas.checks import as_number
from orthocas.domains import Box
from orthocas.errors import DomainError, InvalidValueError
from orthocas.robots import Robot
from orthocas.robots.tree import PRISMATIC_ROOM

_PRISMATIC_MARGIN = 0.02  # of the range of a prismatic joint


def joint_range(robot: Robot, margin_deg: float) -> Box:
    """The box of all joint positions farther than a margin from the limits. Endless joints have a full turn.

    Raises:
        DomainError: if a joint has no range left.
    """
    margin = np.radians(as_number("margin_deg", margin_deg))
    if not 0 <= margin < np.pi:
        raise InvalidValueError("margin_deg", margin_deg, "an angle from 0 to below 180 degrees")
    prismatic = np.array(robot.tree.prismatic)
    missing = np.isinf(robot.lower) | np.isinf(robot.upper)
    middle = robot.tree.middle
    low = np.where(missing, middle - PRISMATIC_ROOM, robot.lower)
    high = np.where(missing, middle + PRISMATIC_ROOM, robot.upper)
    room = np.where(prismatic, _PRISMATIC_MARGIN * (high - low), margin) * ~missing
    low, high = low + room, high - room
    endless = ~prismatic & (missing | (robot.upper - robot.lower >= 2 * np.pi))
    low[endless], high[endless] = -np.pi, np.pi
    empty = np.flatnonzero(low >= high)
    if empty.size:
        name = robot.joint_names[int(empty[0])]
        raise DomainError(
            f"joint '{name}' has no range left with a margin of {margin_deg:g} deg, expected a smaller one"
        )
    free = endless & np.isinf(robot.lower) & np.isinf(robot.upper)
    return Box((low + high) / 2, (high - low) / 2, np.flatnonzero(free).tolist())
