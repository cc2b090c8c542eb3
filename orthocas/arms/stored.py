"""Stored postures of an arm, from which a search for the self-motion curves of any task value starts."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.tasks.branches import Branches
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.task import Frames, Task
from orthocas.tools.checks import Array


@dataclass(frozen=True, slots=True)
class StoredRules:
    """Numbers of stored postures."""

    count: int = 20_000  #: of them
    seed: int = 0
    least_volume: float = 1e-12  #: det(J J^T) of postures that count as singular


RULES = StoredRules()


@dataclass(frozen=True, eq=False)
class StoredPostures:
    """Random postures within the limits, in the order of the branches, and where they are in x.

    Those near a value of x are taken by |x - x_d|^2 det(J J^T)^(-1/m): then each self-motion curve gets a part of them
    like its part of the length of all curves, whatever its distance from singular positions.
    """

    q: Array  #: (S, n)
    places: NDArray[np.float32]  #: (k, S): distances between them are errors of x
    weights: NDArray[np.float32]  #: of squared distances, (S,)
    begins: NDArray[np.intc]  #: numbers of the first posture of each branch, and S

    @classmethod
    def build(cls, reader: "PlaceReader", rates: Callable[[Array], Array], branches: Branches) -> "StoredPostures":
        """Postures of a robot.

        Args:
            reader: of places.
            rates: q (N, n) -> J (N, m, n), as of `orthocas.arms.kernel.build_equations`.
            branches: of the robot's task.
        """
        task = reader.task
        whole = find_joint_range(task.robot, 0)
        rng = np.random.default_rng(RULES.seed)
        q = rng.uniform(whole.centre - whole.half_width, whole.centre + whole.half_width, (RULES.count, task.robot.n))
        # In the order of branches; postures of none come last.
        own = np.full(len(q), len(branches))
        for k, branch in enumerate(branches):
            own[np.asarray(branch.box.contains(q))] = k
        order = np.argsort(own, kind="stable")
        q, own = q[order], own[order]
        J = rates(q)
        # Next to singular positions, x moves less for the same way of joints: distances there count more.
        volume = np.linalg.det(J @ J.transpose(0, 2, 1))
        weights = np.maximum(volume, RULES.least_volume) ** (-1 / task.m)
        places = np.ascontiguousarray(reader.of_postures(q).T, dtype=np.float32)
        begins = np.flatnonzero(np.diff(own, prepend=-1, append=len(branches) + 1))
        return cls(q, places, weights.astype(np.float32), begins.astype(np.intc))


@dataclass(frozen=True, eq=False)
class PlaceReader:
    """Values of x as places whose distances are errors of x, in radians or as long as a radian moves the tip."""

    task: Task
    scale: Array  #: of the components of the errors, (m,)

    def of_postures(self, q: Array) -> Array:
        """Places of postures (N, n), (N, k)."""
        task = self.task
        if not self.turned:
            return np.asarray(task.batched(q)[0]) / self.scale
        robot, frames, turn = task.robot, Frames.from_recipe(task.recipe), task.turn
        frame = robot.tree.tip_name if frames.frame is None else frames.frame
        R = np.asarray(robot.frame_rotation(q, frame, frames.relative_to)).reshape(-1, 3, 3)
        #
        # R - S
        #  / sqrt(2) is the angle between both, for small ones.
        parts = [R.transpose(0, 2, 1).reshape(-1, 9) / np.sqrt(2)]
        if turn is not None and turn.with_position:
            p = np.asarray(robot.frame_position(q, frame, frames.relative_to)).reshape(-1, 3)
            parts.insert(0, p / self.scale[:3])
        return np.hstack(parts)

    def of_targets(self, targets: Array) -> Array:
        """Places of targets (..., k), as `orthocas.arms.kernel.build_equations` takes them."""
        if not self.turned:
            return targets / self.scale
        places = targets / np.sqrt(2)
        if targets.shape[-1] > 9:
            places[..., :3] = targets[..., :3] / self.scale[:3]
        return np.asarray(places)

    @property
    def turned(self) -> bool:
        """Whether x holds a whole orientation."""
        return self.task.turn is not None and self.task.turn.whole
