"""The joint range less a margin, the default domain of a task, and the posture in its middle."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import DomainError, InvalidValueError, NotRedundantError, degrees_hint
from orthocas.robots.robot import Robot
from orthocas.robots.tree import PRISMATIC_ROOM
from orthocas.tasks.clear_box import row_scale
from orthocas.tasks.domains import Box, default_box, default_half_width
from orthocas.tasks.samples import sample_evenly
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array, as_number, as_point

_PRISMATIC_MARGIN = 0.02  # of the range of a prismatic joint
_REGULAR = 0.04  # regularity that keeps the middle of the limits; 5 % of the box may have less
_SAMPLES, _WORST = 24, 6  # samples of a candidate; the mean of the worst 6 counts
_JUDGES = 256  # samples of the middle
_FARTHEST = np.pi / 2  # largest distance from the middle [rad]
_FIRST_BEND = 0.75  # first bend, as a share of a joint's range
_BENDS = np.linspace(-1, 1, 9)  # later bends, as shares of the range, one joint at a time
_PENALTY = 0.015  # regularity that a bend of 1 rad must gain
_ROUNDS = 10
_REGULAR_HOME = 0.15  # a named posture needs at least this regularity, see `Judge`
_ROOM = 0.5  # and this share of the default half-widths to its joint limits


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


def regular_box(robot: Robot, task: Task) -> Box:
    """The default box of a robot, moved to a bent posture if the task is singular in or near its middle.

    The score of a posture is the regularity of its box, less 0.015 for every radian from the middle of the limits.
    Candidates bend one or two joints. From the best candidate, joints move one at a time while the score improves.
    Prismatic joints stay in the middle. The choice is deterministic.

    Args:
        robot: the robot.
        task: a task of that robot. A missing reference is taken at the centre of each box.

    Raises:
        NotRedundantError: if the task has as many components as the robot has joints.

    Source:
        ours.
    """
    if task.m >= robot.n:
        raise NotRedundantError(task.m, robot.n)
    box = default_box(robot)
    judge = Judge.of(robot, task, box)
    if np.quantile(judge.regularity(box.centre[None], _JUDGES), 0.05) >= _REGULAR:
        return box
    return default_box(robot, bent_posture(judge, robot, box))


def bent_posture(judge: "Judge", robot: Robot, box: Box) -> Array:
    """The posture with the best score, (n,), found from the middle of the default box."""
    room = np.minimum(box.centre - robot.lower, robot.upper - box.centre) - box.half_width
    way = np.where(robot.tree.prismatic, 0.0, np.clip(room, 0.0, _FARTHEST))
    best, value = judge.best(_bent_postures(way))
    for _ in range(_ROUNDS):
        moved, improved = judge.best(_one_joint_moved(best, way))
        if improved <= value:
            break
        best, value = moved, improved
    return box.centre + best


@dataclass(frozen=True)
class Judge:
    """Scores postures: how regular a task is on the default boxes around them."""

    robot: Robot
    m: int
    jacobian: Batched
    middle: Array
    scale: Array  # scale of the rows of J_x, (m,)

    @classmethod
    def of(cls, robot: Robot, task: Task, box: Box) -> "Judge":
        """Scale the rows of J_x by their size on a box."""
        jacobian = Batched(task.centred_jacobian_function)
        points = sample_evenly(box, _JUDGES, 0)
        J = _finite(jacobian(points, np.broadcast_to(box.centre, points.shape))[0].reshape(-1, task.m, robot.n))
        return cls(robot, task.m, jacobian, box.centre, row_scale(J, task.units))

    def regularity(self, centres: Array, samples: int) -> Array:
        """Smallest singular values of [J_x; N^T] on the boxes around centres (N, n), (N, samples + 1).

        Rows of J_x are scaled to order one, and N is an orthonormal basis of the self-motions at the centre. The value
        is zero where the task is singular, and where coordinates along the self-motions of the centre fold over.
        """
        n = self.robot.n
        unit = np.vstack([np.zeros(n), sample_evenly(Box(np.zeros(n), 1.0), samples, 0)])
        points = centres[:, None] + default_half_width(self.robot, centres)[:, None] * unit
        at = np.broadcast_to(centres[:, None], points.shape)
        J = _finite(self.jacobian(points.reshape(-1, n), at.reshape(-1, n))[0]).reshape(*points.shape[:2], self.m, n)
        J = J / self.scale[:, None]
        rest = np.linalg.svd(J[:, 0])[2][:, None, self.m :]
        stacked = np.concatenate([J, np.broadcast_to(rest, (*points.shape[:2], n - self.m, n))], axis=2)
        return np.asarray(np.linalg.svd(stacked, compute_uv=False)[..., -1])

    def worst(self, centres: Array) -> Array:
        """Mean of the smallest regularities on the boxes around centres (N, n), (N,)."""
        values: Array = np.sort(self.regularity(centres, _SAMPLES - 1), axis=1)[:, :_WORST].mean(axis=1)
        return values

    def best(self, offsets: Array) -> tuple[Array, float]:
        """The best of the offsets (N, n) from the middle, and its score."""
        values = self.worst(self.middle + offsets) - _PENALTY * np.abs(offsets).sum(axis=1)
        k = int(np.argmax(values))
        return offsets[k], float(values[k])


def _bent_postures(way: Array) -> Array:
    """Offsets with no joint, one joint or two joints bent, in both directions."""
    single = [sign * _FIRST_BEND * row for row in np.diag(way)[way > 0] for sign in (-1, 1)]
    double = [a + b for a, b in combinations(single, 2) if not (a * b).any()]
    return np.array([np.zeros(len(way)), *single, *double])


def _one_joint_moved(posture: Array, way: Array) -> Array:
    """The posture, and those with one joint moved within its range."""
    moved = [posture]
    for i in np.flatnonzero(way):
        for bend in _BENDS:
            moved.append(posture.copy())
            moved[-1][i] = bend * way[i]
    return np.array(moved)


def _finite(J: Array) -> Array:
    """J with zeros, that is singular, where it is not finite."""
    return np.where(np.isfinite(J), J, 0.0)


@dataclass(frozen=True, eq=False)
class Home:
    """A posture, and where it comes from."""

    q: Array  #: (n,) [rad] or [m]
    source: str  #: in words


def home_posture(robot: Robot, task: Task, home: ArrayLike | str | None = None) -> Home:
    """The posture that is meant.

    Without one, it is the first named posture of the robot's files around which the task is regular and joints have
    room to move. If there is none, it is the bent posture with the best score of `orthocas.tasks.regular_box`.

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
        hint = "" if robot.tree.prismatic[k] else degrees_hint(q[k])
        text = f"home of joint '{robot.joint_names[k]}' is {q[k]:.4g}, expected inside its limits {limits}{hint}"
        raise DomainError(text)
    return Home(q, source)


def _default_home(robot: Robot, task: Task) -> Home:
    box = default_box(robot)
    judge = Judge.of(robot, task, box)
    for name, q in robot.homes.items():
        has_room = np.all(default_half_width(robot, q) >= _ROOM * default_half_width(robot, robot.tree.middle))
        if has_room and judge.worst(q[None])[0] >= _REGULAR_HOME:
            return Home(q, f"posture '{name}' of the robot's files")
    return Home(bent_posture(judge, robot, box), "bent posture where the task is most regular")
