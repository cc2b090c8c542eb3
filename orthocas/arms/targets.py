"""Task values as people hold them, as what kernels take."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, as_float_array


@dataclass(frozen=True, eq=False)
class TargetReader:
    """Reads values of x of a task, and turns them into targets of `orthocas.arms.kernel.build_equations`."""

    task: Task

    def read(self, x: Any) -> tuple[Array, bool]:
        """Targets (N, k) of what `Task.target` takes, and whether it is one value. Rows of vectors need not be finite.

        A single pose with NaN is a target of NaN.

        Raises:
            ShapeError, InvalidValueError: if x is none of what the task can have.
        """
        m = self.task.m
        # Poses with NaN, which a broken sensor sends, are a target that trackers answer with BAD_INPUT.
        try:
            values = self.task.target(x)
        except InvalidValueError:
            if not _is_pose_with_nan(x):
                raise
            values = np.full(m, np.nan)
        if values.ndim not in (1, 2) or values.shape[-1] != m:
            raise InvalidValueError("x", f"an array of shape {values.shape}", f"({m},), (N, {m}), or poses of the task")
        return self.build(values.reshape(-1, m)), values.ndim == 1

    def build(self, vectors: Array) -> Array:
        """Targets (N, k) of vectors (N, m), finite or not."""
        turn = self.task.turn
        if turn is None or not turn.whole:
            return np.ascontiguousarray(vectors)
        # Rows that are not finite have no rotation; they stay NaN.
        good = np.asarray(np.isfinite(vectors).all(axis=1))
        targets = np.full((len(vectors), 12 if turn.with_position else 9), np.nan)
        if good.any():
            R = np.asarray(self.task.orientation_of(vectors[good]))
            targets[good, -9:] = R.transpose(0, 2, 1).reshape(-1, 9)
            if turn.with_position:
                targets[good, :3] = vectors[good, :3]
        return targets

    def vector(self, targets: Array) -> Array:
        """Targets (N, k) as vectors of x (N, m); NaN where a target is NaN."""
        turn = self.task.turn
        if turn is None or not turn.whole:
            return targets
        values = np.full((len(targets), self.task.m), np.nan)
        good = np.isfinite(targets).all(axis=1)
        if good.any():
            R = targets[good, -9:].reshape(-1, 3, 3).transpose(0, 2, 1)
            values[good] = self.task.value(targets[good, :3] if turn.with_position else None, R)
        return values


def _is_pose_with_nan(x: Any) -> bool:
    """Whether x is one pose of which a number is not finite."""
    parts = (x.translation, x.rotation) if hasattr(x, "rotation") and hasattr(x, "translation") else x
    parts = parts if isinstance(parts, tuple) and len(parts) == 2 else (parts,)
    try:
        arrays = [as_float_array("x", part) for part in parts]
    except InvalidValueError:
        return False
    shapes = [array.shape for array in arrays]
    whole = shapes in ([(4, 4)], [(3,), (4,)], [(3,), (3, 3)])
    return whole and not all(np.isfinite(array).all() for array in arrays)
