"""The posture around which a domain is suggested if none is given."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_point
from orthocas.domains import default_box, default_half_width
from orthocas.errors import DomainError, NotRedundantError
from orthocas.postures.regular_box import Judge, bent_posture
from orthocas.robots import Robot
from orthocas.tasks import Task

_REGULAR = 0.15  # a named posture needs at least this regularity, see `Judge`
_ROOM = 0.5  # and this share of the default half-widths to its joint limits


@dataclass(frozen=True, eq=False)
class Home:
    """A posture, and where it comes from."""

    q: Array  #: (n,) [rad] or [m]
    source: str  #: in words


def home_posture(robot: Robot, task: Task, home: ArrayLike | str | None = None) -> Home:
    """The posture that is meant.

    Without one, it is the first named posture of the robot's files around which the task is regular and joints have
    room to move. If there is none, it is the bent posture with the best score of `orthocas.postures.regular_box`.

    Args:
        robot: the robot.
        task: a task of that robot.
        home: joint positions (n,), the name of a posture of the robot's files, or None.

    Raises:
        UnknownNameError: if there is no posture of that name.
        DomainError: if the posture lies at or beyond a joint limit. The message names the joint.
        NotRedundantError: if m >= n.
    """
    if task.m >= robot.n:
        raise NotRedundantError(task.m, robot.n)
    if home is None:
        return _default_home(robot, task)
    source = f"posture '{home}' of the robot's files" if isinstance(home, str) else "as given"
    q = robot.home(home) if isinstance(home, str) else as_point("home", home, robot.n)
    outside = np.flatnonzero((q <= robot.lower) | (q >= robot.upper))
    if outside.size:
        k = int(outside[0])
        limits = f"[{robot.lower[k]:.4g}, {robot.upper[k]:.4g}]"
        raise DomainError(f"home of joint '{robot.joint_names[k]}' is {q[k]:.4g}, expected inside its limits {limits}")
    return Home(q, source)


def _default_home(robot: Robot, task: Task) -> Home:
    box = default_box(robot)
    judge = Judge.of(robot, task, box)
    for name, q in robot.homes.items():
        has_room = np.all(default_half_width(robot, q) >= _ROOM * default_half_width(robot, robot.tree.middle))
        if has_room and judge.worst(q[None])[0] >= _REGULAR:
            return Home(q, f"posture '{name}' of the robot's files")
    return Home(bent_posture(judge, robot, box), "bent posture where the task is most regular")
