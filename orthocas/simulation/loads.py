"""Pushes as numbers over time, and as joint torques of the plant."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.robots import KinematicTree
from orthocas.robots.kinematics import point_jacobian
from orthocas.simulation.disturbances import Push
from orthocas.simulation.places import Place, place_of


class Loads:
    """The pushes of a run, as rows [force at each of P places (3 P); torque of the joints (n)].

    Raises:
        UnknownNameError, InvalidValueError, ShapeError: if a push does not fit the robot.
    """

    def __init__(self, tree: KinematicTree, pushes: Sequence[Push] = ()) -> None:
        self.pushes = tuple(pushes)
        self._tree = tree
        self._of_push = [place_of(tree, push.link, push.point) for push in self.pushes]
        self._rows  # noqa: B018 (refuses torques of other robots at once)

    @cached_property
    def places(self) -> tuple[Place, ...]:
        """The different places where forces act."""
        return tuple(dict.fromkeys(self._of_push))

    @property
    def size(self) -> int:
        """Length of a row, 3 P + n."""
        return 3 * len(self.places) + self._tree.n

    def shares(self, starts: Array, length: float) -> Array:
        """How much of each interval of equal length each push lasts, (N, pushes): short pushes keep their impulses."""
        shares = [
            np.maximum(np.minimum(starts + length, push.end) - np.maximum(starts, push.start), 0.0) / length
            for push in self.pushes
        ]
        return np.array(shares).reshape(-1, len(starts)).T

    def mean(self, starts: Array, length: float) -> Array:
        """Mean rows over time intervals of equal length, (N, 3 P + n)."""
        return np.asarray(self.shares(starts, length) @ self._rows)

    def at(self, times: Array) -> Array:
        """Rows at times (N,), (N, 3 P + n). A push acts from its start until just before its end."""
        active = [(times >= push.start) & (times < push.end) for push in self.pushes]
        return np.asarray(np.array(active).reshape(-1, len(times)).T @ self._rows)

    def joint_torques(self, q: ca.SX, row: ca.SX) -> ca.SX:
        """J^T f at every place, plus the torque of the joints, (n, 1), for a row (3 P + n, 1)."""
        torque = row[3 * len(self.places) :]
        for k, place in enumerate(self.places):
            torque += point_jacobian(self._tree, q, place.body, np.array(place.point)).T @ row[3 * k : 3 * k + 3]
        return torque

    @cached_property
    def _rows(self) -> Array:
        """The row of each push while it acts, (pushes, 3 P + n)."""
        rows = np.zeros((len(self.pushes), self.size))
        for row, push, place in zip(rows, self.pushes, self._of_push, strict=True):
            load, k = push.load(self._tree.n), self.places.index(place)
            row[3 * k : 3 * k + 3], row[3 * len(self.places) :] = load[:3], load[3:]
        return rows
