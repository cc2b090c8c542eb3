"""The map phi(q) = [h(q); xi(q)] as functions, its angles, and the scale of its errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.charts.coordinates import CoordinateMap, Coordinates
from orthocas.errors import InvalidValueError
from orthocas.tasks.relative import Relative
from orthocas.tools.checks import Array
from orthocas.tools.expressions import wrap_shortest

ROUNDING = 1e-5  #: of phi: 1e-9 of it are 45 units in the last place
_SINGULAR = 1e-8  # ratio of singular values of J below which the inverse map fails


def leave_over(apart: float, tolerance: float, change: Array, turning: tuple[int, ...]) -> Array | None:
    """What a loop leaves over in the joints: their change (n,), less full turns of those that turn without end.

    None if phi at its ends differs by more than the tolerance, relative to the sizes of the components.
    """
    turns = np.zeros(len(change))
    turns[list(turning)] = 2 * np.pi
    return None if apart > tolerance else np.asarray(wrap_shortest(change, turns))


def counted_on(rows: Array, turns: Array) -> Array:
    """Values along a curve (N, k), continuous: periodic ones are continued by the shorter way from row to row."""
    if not turns.any():
        return rows
    steps = wrap_shortest(np.diff(rows, axis=0), turns)
    return np.asarray(rows[0] + np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(steps, axis=0)]))


def require_no_turns(labels: tuple[str, ...], turns: Array, purpose: str) -> None:
    """Raise InvalidValueError if a component of phi is periodic, for what cannot deal with that yet."""
    circles = [label for label, turn in zip(labels, turns, strict=True) if turn > 0]
    if circles:
        raise InvalidValueError(
            "chart", f"one with circle-valued coordinates ({', '.join(circles)})", f"real-valued ones for {purpose}"
        )


@dataclass(frozen=True)
class Differences:
    """Differences of two phi: the shorter way around for periodic components and for orientations."""

    turns: Array  #: periods of the components, (n,); 0 for those that have none
    task: Relative | None = None  #: of the first components; None for plain differences

    def __call__(self, targets: Any, values: Any) -> Any:
        """Targets - values, as NumPy rows (..., n) or CasADi columns (n, 1)."""
        if self.task is None or not self.task.turned:
            return wrap_shortest(targets - values, self.turns)
        # orientations differ by a rotation, other components by numbers
        m, symbolic = self.task.task.m, isinstance(values, ca.SX | ca.MX)
        pair = (targets[:m], values[:m]) if symbolic else (targets[..., :m], values[..., :m])
        first = self.task.difference(*pair)
        if symbolic:
            return ca.vertcat(first, wrap_shortest(targets[m:] - values[m:], self.turns[m:]))
        rest = wrap_shortest(targets[..., m:] - values[..., m:], self.turns[m:])
        return np.concatenate([first, rest], axis=-1)


@dataclass(frozen=True)
class PhiMap:
    """phi at many points. Points are finite, values need not be."""

    phi: Callable[[Array], Array]  #: (N, n) -> (N, n)
    jacobian: Callable[[Array], Array]  #: (N, n) -> (N, n, n): how fast phi moves, d(difference) = -J dq where it is 0
    sizes: Array  #: sizes of the components, (n,)
    difference: Differences  #: of targets (..., n) and values (..., n)

    def scale(self, targets: Array) -> Array:
        """Scale of errors (N, n): the sizes of the components, and more where rounding of phi exceeds them."""
        scale: Array = self.sizes + ROUNDING * np.abs(targets)
        return scale

    def residual(self, targets: Array, q: Array) -> Array:
        """(phi - phi(q)) / scale, (N, n), by the shorter way around."""
        residual: Array = self.difference(targets, self.phi(q)) / self.scale(targets)
        return residual

    def is_singular(self, q: Array) -> NDArray[np.bool_]:
        """Whether J is singular or undefined at points (N, n), (N,)."""
        J = self.jacobian(q) / self.sizes[:, None]
        known = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        J[~known] = 0.0
        values = np.linalg.svd(J, compute_uv=False)
        return np.asarray(~known | (values[:, -1] <= _SINGULAR * values[:, 0]))


def largest(residual: Array) -> Array:
    """The largest entries of residuals (N, n), (N,): infinite where phi is undefined."""
    error = np.abs(residual).max(axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def fill_coordinates(coordinates: CoordinateMap, name: str, results: Array, points: Array) -> None:
    """Write xi or its Jacobian, by name, at points (N, n) to part of an array."""
    if isinstance(coordinates, Coordinates):
        coordinates.into(name, results, points)
    else:
        results[...] = getattr(coordinates, name)(points)
