"""The default box of a task, the default home posture, and the joint range less a margin."""

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

    prismatic_margin: float = 0.02  #: fraction of the range of a prismatic joint
    regular: float = 0.04  #: the centre of the limits is kept if at most 5 % of the box are less regular than this
    samples: int = 24  #: samples of the box around a candidate
    worst: int = 6  #: the score is the mean over this many least regular samples
    centre_samples: int = 256  #: samples of the box around the centre of the limits
    farthest: float = np.pi / 2  #: [rad], largest distance from the centre of the limits
    first_bend: float = 0.75  #: as a fraction of the range of a joint
    penalty: float = 0.015  #: a bend of 1 rad must gain this much regularity
    rounds: int = 10  #: rounds of moves of single joints
    regular_home: float = 0.15  #: regularity that a named posture needs
    room: float = 0.5  #: fraction of the default half-widths that a named posture needs to its joint limits


RULES = PostureRules()


def regular_box(robot: Robot, task: Task) -> Box:
    """The default box of a robot, moved to a bent posture if the task is singular at or near its centre.

    The score of a posture is the regularity of its box minus a penalty per radian from the centre of the limits.
    Candidates bend one or two joints. From the best candidate, joints move one at a time while the score improves.
    Prismatic joints stay at their centre. The choice is deterministic.

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
    source: str  #: origin in words, for messages


def find_home(robot: Robot, task: Task, home: ArrayLike | str | None = None) -> Home:
    """Find the home posture.

    If none is given, it is the first named posture of the robot's files around which the task is regular and the joints
    have room to move. If there is none, it is the bent posture with the best score of `orthocas.tasks.regular_box`.

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
    # A given posture must lie inside the limits.
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
    """The box of all joint positions farther than a margin from the limits. Endless joints get a full turn.

    The turn lies within the limits, and is centred at 0 if possible.

    Raises:
        DomainError: if a joint has no range left.
    """
    margin = np.radians(as_number("margin_deg", margin_deg))
    if not 0 <= margin < np.pi:
        raise InvalidValueError("margin_deg", margin_deg, "an angle from 0 to below 180 degrees")
    # A sliding joint without limits gets the width of a default box, an endless joint a full turn.
    prismatic = np.array(robot.tree.prismatic)
    missing = np.isinf(robot.lower) | np.isinf(robot.upper)
    middle = robot.tree.centre_posture
    low = np.where(missing, middle - PRISMATIC_ROOM, robot.lower)
    high = np.where(missing, middle + PRISMATIC_ROOM, robot.upper)
    room = np.where(prismatic, RULES.prismatic_margin * (high - low), margin) * ~missing
    low, high = low + room, high - room
    endless = ~prismatic & (missing | (robot.upper - robot.lower >= 2 * np.pi))
    # The full turn around 0, or the nearest one within the limits.
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
    """The posture with the best score, (n,), searched from the centre of the default box."""
    room = np.minimum(box.centre - robot.lower, robot.upper - box.centre) - box.half_width
    way = np.where(robot.tree.prismatic, 0.0, np.clip(room, 0.0, RULES.farthest))
    # Start from candidates with no, one or two bent joints, in both directions.
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
    """Scores a posture by the regularity of a task on the default box around it."""

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
        # Use the same points for each box; the centre comes first.
        n = self.robot.n
        unit = np.vstack([np.zeros(n), sample_evenly(Box(np.zeros(n), 1.0), samples, 0)])
        points = centres[:, None] + default_half_width(self.robot, centres)[:, None] * unit
        at = np.broadcast_to(centres[:, None], points.shape)
        # Append the null space at the centre to the scaled J. The square matrix is regular where J turns little.
        J = _fill_singular(self.jacobian(points.reshape(-1, n), at.reshape(-1, n))[0])
        J = J.reshape(*points.shape[:2], self.m, n) / self.scale[:, None]
        rest = np.linalg.svd(J[:, 0])[2][:, None, self.m :]
        stacked = np.concatenate([J, np.broadcast_to(rest, (*points.shape[:2], n - self.m, n))], axis=2)
        return np.asarray(np.linalg.svd(stacked, compute_uv=False)[..., -1])

    def evaluate(self, centres: Array) -> Array:
        """Means over the least regular samples of the boxes around centres (N, n), (N,)."""
        values = np.sort(self.evaluate_regularity(centres, RULES.samples - 1), axis=1)
        return np.asarray(values[:, : RULES.worst].mean(axis=1))

    def find_best(self, offsets: Array) -> tuple[Array, float]:
        """The best of the offsets (N, n) from the centre, and its score."""
        values = self.evaluate(self.centre + offsets) - RULES.penalty * np.abs(offsets).sum(axis=1)
        k = int(np.argmax(values))
        return offsets[k], float(values[k])


def _fill_singular(J: Array) -> Array:
    """J with zeros where it is not finite, so that it counts as singular."""
    return np.where(np.isfinite(J), J, 0.0)
