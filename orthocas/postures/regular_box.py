"""A default domain for a task: the middle of the joint limits, or a bent posture if the task is singular there."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from orthocas.casadi_tools.batch import Batched
from orthocas.checks import Array
from orthocas.domains import Box, default_box, default_half_width, sample_evenly
from orthocas.robots import Robot
from orthocas.tasks import Task

_REGULAR = 0.04  # regularity from which the middle of the limits stays: 5 % of the box may have less
_SAMPLES, _WORST = 24, 6  # samples that judge a candidate, by the mean of the worst of them
_JUDGES = 256  # samples that judge the middle
_FARTHEST = np.pi / 2  # [rad] from the middle
_FIRST_BEND = 0.75  # of the way a joint may go
_BENDS = np.linspace(-1, 1, 9)  # of that way, when one joint after the other finds its place
_PENALTY = 0.015  # regularity that a bend by 1 rad must bring
_ROUNDS = 10


def regular_box(robot: Robot, task: Task) -> Box:
    """The default box of a robot, moved to a bent posture if the task is singular in its middle or close by.

    A posture is as good as its box is regular, less 0.015 for every radian between it and the middle of the limits.
    Candidates bend one or two joints; from the best one, joints move one at a time while that improves it. Sliding
    joints stay in the middle. The choice is deterministic.

    Args:
        robot: the robot.
        task: a task of that robot; a reference that it lacks is taken at the centre of each box.

    Source:
        Ours.
    """
    box = default_box(robot)
    judge = _Judge.of(robot, task, box)
    if np.quantile(judge.regularity(box.centre[None], _JUDGES), 0.05) >= _REGULAR:
        return box
    room = np.minimum(box.centre - robot.lower, robot.upper - box.centre) - box.half_width
    way = np.where(robot.tree.prismatic, 0.0, np.clip(room, 0.0, _FARTHEST))
    best, value = judge.best(_bent_postures(way))
    for _ in range(_ROUNDS):
        moved, improved = judge.best(_one_joint_moved(best, way))
        if improved <= value:
            break
        best, value = moved, improved
    return default_box(robot, box.centre + best)


@dataclass(frozen=True)
class _Judge:
    """How regular a task is on the default boxes about other postures."""

    robot: Robot
    m: int
    jacobian: Batched
    middle: Array
    scale: Array  # of the rows of J_x, (m,)

    @classmethod
    def of(cls, robot: Robot, task: Task, box: Box) -> "_Judge":
        jacobian = Batched(task.centred_jacobian_function)
        points = sample_evenly(box, _JUDGES, 0)
        J = _finite(jacobian(points, np.broadcast_to(box.centre, points.shape))[0].reshape(-1, task.m, robot.n))
        return cls(robot, task.m, jacobian, box.centre, _row_scale(J, task.units))

    def regularity(self, centres: Array, samples: int) -> Array:
        """Smallest singular values of [J_x; N^T] on the boxes about centres (N, n), (N, samples + 1).

        Rows of J_x are of order one, N is an orthonormal basis of the self-motions at the centre. It vanishes where the
        task is singular, and where coordinates that are straight along the self-motions of the centre fold over.
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

    def best(self, offsets: Array) -> tuple[Array, float]:
        """The best of some offsets from the middle (N, n), and its value."""
        worst = np.sort(self.regularity(self.middle + offsets, _SAMPLES - 1), axis=1)[:, :_WORST].mean(axis=1)
        values = worst - _PENALTY * np.abs(offsets).sum(axis=1)
        k = int(np.argmax(values))
        return offsets[k], float(values[k])


def _bent_postures(way: Array) -> Array:
    """No bend, one joint bent, or two, either way."""
    single = [sign * _FIRST_BEND * row for row in np.diag(way)[way > 0] for sign in (-1, 1)]
    double = [a + b for a, b in combinations(single, 2) if not (a * b).any()]
    return np.array([np.zeros(len(way)), *single, *double])


def _one_joint_moved(posture: Array, way: Array) -> Array:
    """The posture, and those where one joint is elsewhere on its way."""
    moved = [posture]
    for i in np.flatnonzero(way):
        for bend in _BENDS:
            moved.append(posture.copy())
            moved[-1][i] = bend * way[i]
    return np.array(moved)


def _row_scale(J: Array, units: tuple[str, ...]) -> Array:
    """Root mean square length of the rows with the same unit, (m,), so that turned axes give the same; 1 for none."""
    squares = (J**2).sum(axis=2).mean(axis=0)
    groups = [unit or f"own {i}" for i, unit in enumerate(units)]
    means = [
        np.mean([square for square, other in zip(squares, groups, strict=True) if other == mine]) for mine in groups
    ]
    return np.sqrt([mean if mean > 0 else 1.0 for mean in means])


def _finite(J: Array) -> Array:
    """Singular where it is not finite."""
    return np.where(np.isfinite(J), J, 0.0)
