"""The joint range less a margin, the default domain of a task, and the posture in its middle."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import DomainError, InvalidValueError, NotRedundantError, degrees_hint
from orthocas.robots.robot import Robot
from orthocas.robots.tree import PRISMATIC_ROOM
from orthocas.tasks.domains import Box, default_box, default_half_width
from orthocas.tasks.samples import compute_row_scale, sample_evenly
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array, as_number, as_point


@dataclass(frozen=True, slots=True)
class PostureRules:
    """Numbers of the choice of postures and default boxes."""

    prismatic_margin: float = 0.02  #: of the range of a prismatic joint
    regular: float = 0.04  #: regularity that keeps the centre of the limits; 5 % of the box may have less
    samples: int = 24  #: of the box around a candidate
    worst: int = 6  #: samples that count: the mean of the least regular ones
    centre_samples: int = 256  #: of the box around the centre of the limits
    farthest: float = np.pi / 2  #: [rad] from the centre of the limits
    first_bend: float = 0.75  #: as a fraction of the range of a joint
    penalty: float = 0.015  #: regularity that a bend of 1 rad must gain
    rounds: int = 10  #: of moves of one joint at a time
    regular_home: float = 0.15  #: regularity that a named posture must have
    room: float = 0.5  #: and the fraction of the default half-widths that it must have to its joint limits


RULES = PostureRules()


def regular_box(robot: Robot, task: Task) -> Box:
    """The default box of a robot, moved to a bent posture if the task is singular in or near its centre.

    The score of a posture is the regularity of its box, less a penalty for every radian from the centre of the limits.
    Candidates bend one or two joints. From the best candidate, joints move one at a time while the score improves.
    Prismatic joints stay in the centre. The choice is deterministic.

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
    score = PostureScore.build(robot, task, box)
    if np.quantile(score.evaluate_regularity(box.centre[None], RULES.centre_samples), 0.05) >= RULES.regular:
        return box
    return default_box(robot, find_bent_posture(score, robot, box))


@dataclass(frozen=True, eq=False)
class Home:
    """A posture, and where it comes from."""

    q: Array  #: (n,) [rad] or [m]
    source: str  #: in words


def find_home(robot: Robot, task: Task, home: ArrayLike | str | None = None) -> Home:
    """Find the posture that a user means.

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
        box = default_box(robot)
        score, usual_room = PostureScore.build(robot, task, box), default_half_width(robot, robot.tree.centre_posture)
        for name, q in robot.homes.items():
            has_room = np.all(default_half_width(robot, q) >= RULES.room * usual_room)
            if has_room and score.evaluate(q[None])[0] >= RULES.regular_home:
                return Home(q, f"posture '{name}' of the robot's files")
        return Home(find_bent_posture(score, robot, box), "bent posture where the task is most regular")
    # A posture that is given must lie inside the limits.
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


def find_joint_range(robot: Robot, margin_deg: float) -> Box:
    """The box of all joint positions farther than a margin from the limits. Endless joints have a full turn.

    It is within the limits, and the one around 0 if that is.

    Raises:
        DomainError: if a joint has no range left.
    """
    margin = np.radians(as_number("margin_deg", margin_deg))
    if not 0 <= margin < np.pi:
        raise InvalidValueError("margin_deg", margin_deg, "an angle from 0 to below 180 degrees")
    # Joints without limits take the room of a default box; endless ones a full turn.
    prismatic = np.array(robot.tree.prismatic)
    missing = np.isinf(robot.lower) | np.isinf(robot.upper)
    middle = robot.tree.centre_posture
    low = np.where(missing, middle - PRISMATIC_ROOM, robot.lower)
    high = np.where(missing, middle + PRISMATIC_ROOM, robot.upper)
    room = np.where(prismatic, RULES.prismatic_margin * (high - low), margin) * ~missing
    low, high = low + room, high - room
    endless = ~prismatic & (missing | (robot.upper - robot.lower >= 2 * np.pi))
    # the turn around 0, or the one within the limits that is nearest to it
    turn = np.clip(0.0, robot.lower + np.pi, robot.upper - np.pi)
    low, high = np.where(endless, turn - np.pi, low), np.where(endless, turn + np.pi, high)
    empty = np.flatnonzero(low >= high)
    if empty.size:
        k = int(empty[0])
        name, limits = robot.joint_names[k], f"[{robot.lower[k]:.4g}, {robot.upper[k]:.4g}]"
        wanted = "a smaller one" if margin > 0 else "limits with room between them, or a locked joint"
        raise DomainError(
            f"joint '{name}' has no range left within {limits} with a margin of {margin_deg:g} deg, expected {wanted}"
        )
    free = endless & np.isinf(robot.lower) & np.isinf(robot.upper)
    return Box((low + high) / 2, (high - low) / 2, np.flatnonzero(free).tolist())


def find_bent_posture(score: PostureScore, robot: Robot, box: Box) -> Array:
    """The posture with the best score, (n,), found from the centre of the default box."""
    room = np.minimum(box.centre - robot.lower, robot.upper - box.centre) - box.half_width
    way = np.where(robot.tree.prismatic, 0.0, np.clip(room, 0.0, RULES.farthest))
    # Begin with no joint, one joint or two joints bent, in both directions.
    single = [sign * RULES.first_bend * row for row in np.diag(way)[way > 0] for sign in (-1, 1)]
    double = [a + b for a, b in combinations(single, 2) if not (a * b).any()]
    best, value = score.find_best(np.array([np.zeros(len(way)), *single, *double]))
    # Then move one joint at a time within its range while the score improves.
    for _ in range(RULES.rounds):
        candidates = [best]
        for i in np.flatnonzero(way):
            for bend in np.linspace(-1, 1, 9):
                candidates.append(best.copy())
                candidates[-1][i] = bend * way[i]
        moved, improved = score.find_best(np.array(candidates))
        if improved <= value:
            break
        best, value = moved, improved
    return box.centre + best


@dataclass(frozen=True)
class PostureScore:
    """Scores postures: how regular a task is on the default boxes around them."""

    robot: Robot
    m: int
    jacobian: Batched
    centre: Array  #: of the limits, (n,)
    scale: Array  #: of the rows of J_x, (m,)

    @classmethod
    def build(cls, robot: Robot, task: Task, box: Box) -> PostureScore:
        """Scale the rows of J_x by their size on a box."""
        jacobian = Batched(task.centred_jacobian_function)
        points = sample_evenly(box, RULES.centre_samples, 0)
        J = _fill_singular(jacobian(points, np.broadcast_to(box.centre, points.shape))[0].reshape(-1, task.m, robot.n))
        return cls(robot, task.m, jacobian, box.centre, compute_row_scale(J, task.units))

    def evaluate_regularity(self, centres: Array, samples: int) -> Array:
        """Smallest singular values of [J_x; N^T] on the boxes around centres (N, n), (N, samples + 1).

        Rows of J_x are scaled to order one, and N is an orthonormal basis of the self-motions at the centre. The value
        is zero where the task is singular, and where coordinates along the self-motions of the centre fold over.
        """
        # The same points of a box around each centre, the centre itself first.
        n = self.robot.n
        unit = np.vstack([np.zeros(n), sample_evenly(Box(np.zeros(n), 1.0), samples, 0)])
        points = centres[:, None] + default_half_width(self.robot, centres)[:, None] * unit
        at = np.broadcast_to(centres[:, None], points.shape)
        # J over its sizes, completed by the null space at the centre: a square matrix, regular where J turns little.
        J = _fill_singular(self.jacobian(points.reshape(-1, n), at.reshape(-1, n))[0])
        J = J.reshape(*points.shape[:2], self.m, n) / self.scale[:, None]
        rest = np.linalg.svd(J[:, 0])[2][:, None, self.m :]
        stacked = np.concatenate([J, np.broadcast_to(rest, (*points.shape[:2], n - self.m, n))], axis=2)
        return np.asarray(np.linalg.svd(stacked, compute_uv=False)[..., -1])

    def evaluate(self, centres: Array) -> Array:
        """Mean of the smallest regularities on the boxes around centres (N, n), (N,)."""
        values = np.sort(self.evaluate_regularity(centres, RULES.samples - 1), axis=1)
        return np.asarray(values[:, : RULES.worst].mean(axis=1))

    def find_best(self, offsets: Array) -> tuple[Array, float]:
        """The best of the offsets (N, n) from the centre, and its score."""
        values = self.evaluate(self.centre + offsets) - RULES.penalty * np.abs(offsets).sum(axis=1)
        k = int(np.argmax(values))
        return offsets[k], float(values[k])


def _fill_singular(J: Array) -> Array:
    """J with zeros, that is singular, where it is not finite."""
    return np.where(np.isfinite(J), J, 0.0)
