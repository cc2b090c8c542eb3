"""Task values as people hold them: vectors, 4 x 4 matrices, positions with rotations, and poses of Pinocchio."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.robots.spatial import build_rotations
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, as_float_array

_POSE = "a 4 x 4 matrix, (position, rotation (3, 3)), (position, quaternion wxyz), or pin.SE3"
_ORTHOGONAL = 1e-6  # largest entry of R R^T - 1 of a rotation that is read


@dataclass(frozen=True, eq=False)
class TargetReader:
    """Reads values of x of a task, and turns them into targets of `orthocas.arms.kernel.build_equations`."""

    task: Task

    def read(self, x: Any) -> tuple[Array, bool]:
        """Targets (N, k), and whether x is one value. Rows need not be finite.

        Raises:
            ShapeError, InvalidValueError: if x is none of what the task can have.
        """
        turn = self.task.turn
        if turn is None or not turn.whole:
            return self._read_vectors(x)
        pose = _find_pose(x)
        if pose is None:
            values, single = self._read_vectors(x)
            return self._build_targets(values), single
        p, R = pose
        single = R.ndim == 2
        R = R.reshape(-1, 3, 3)
        off = np.asarray(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)))
        wrong = np.flatnonzero((off > _ORTHOGONAL) | (np.linalg.det(R) < 0))
        if wrong.size:
            raise InvalidValueError("rotation of x", R[wrong[0]].round(4).tolist(), "a rotation matrix")
        columns = R.transpose(0, 2, 1).reshape(-1, 9)
        if turn.with_position:
            p = p.reshape(-1, 3)
            if len(p) != len(R):
                raise InvalidValueError("x", f"{len(p)} positions and {len(R)} rotations", "as many of both")
            columns = np.hstack([p, columns])
        return np.ascontiguousarray(columns), single

    def vector(self, targets: Array) -> Array:
        """Values of x as vectors (N, m), of targets (N, k); NaN where these are."""
        turn = self.task.turn
        if turn is None or not turn.whole:
            return targets
        values = np.full((len(targets), self.task.m), np.nan)
        good = np.isfinite(targets).all(axis=1)
        R = targets[good, -9:].reshape(-1, 3, 3).transpose(0, 2, 1)
        if good.any():
            values[good] = self.task.value(targets[good, :3] if turn.with_position else None, R)
        return values

    def _read_vectors(self, x: Any) -> tuple[Array, bool]:
        values = as_float_array("x", x)
        m = self.task.m
        if values.ndim not in (1, 2) or values.shape[-1] != m:
            turned = self.task.turn is not None and self.task.turn.whole
            expected = f"the task's vector ({m},) or vectors (N, {m})" + (f", {_POSE}" if turned else "")
            raise InvalidValueError("x", f"an array of shape {values.shape}", expected)
        return np.ascontiguousarray(values.reshape(-1, m)), values.ndim == 1

    def _build_targets(self, values: Array) -> Array:
        """Targets (N, k) of vectors (N, m)."""
        turn = self.task.turn
        assert turn is not None
        good = np.asarray(np.isfinite(values).all(axis=1))
        targets = np.full((len(values), 12 if turn.with_position else 9), np.nan)
        if good.any():
            R = np.asarray(self.task.orientation_of(values[good]))
            targets[good, -9:] = R.transpose(0, 2, 1).reshape(-1, 9)
        if turn.with_position:
            targets[:, :3] = np.where(good[:, None], values[:, :3], np.nan)
        return targets


def _find_pose(x: Any) -> tuple[Array, Array] | None:
    """Positions (..., 3) and rotations (..., 3, 3) of x; None if it is an array of vectors."""
    if hasattr(x, "translation") and hasattr(x, "rotation"):  # pin.SE3
        return as_float_array("x", x.translation), as_float_array("x", x.rotation)
    if isinstance(x, Sequence) and len(x) > 0 and all(hasattr(part, "translation") for part in x):
        parts = [(as_float_array("x", part.translation), as_float_array("x", part.rotation)) for part in x]
        return np.array([p for p, _ in parts]), np.array([R for _, R in parts])
    if isinstance(x, tuple) and len(x) == 2:
        p, turned = (as_float_array("x", part) for part in x)
        if turned.shape[-2:] == (3, 3) and turned.ndim == p.ndim + 1:
            return p, turned
        if turned.shape[-1:] == (4,) and p.shape[-1:] == (3,) and turned.ndim == p.ndim:
            size = np.linalg.norm(turned, axis=-1, keepdims=True)
            R = build_rotations((turned / size).reshape(-1, 4))
            return p, R[0] if turned.ndim == 1 else R
        raise InvalidValueError("x", f"a pair of arrays of shapes {p.shape} and {turned.shape}", f"{_POSE}")
    array = np.asarray(x) if isinstance(x, np.ndarray | list) else None
    if array is not None and array.shape[-2:] == (4, 4):
        matrix = as_float_array("x", array)
        return matrix[..., :3, 3], matrix[..., :3, :3]
    return None
