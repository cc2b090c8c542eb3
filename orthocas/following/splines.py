"""Curves through points: cubic splines that are twice continuously differentiable, periodic for closed curves."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from orthocas.checks import Array, as_float_array, frozen_array
from orthocas.errors import InvalidValueError, ShapeError

_SAMPLES = 501  # of a path that is given as a function
_SAME = 1e-9  # relative distance of the ends of closed paths
MOST_WAYPOINTS = 100_000


def sampled(name: str, given: Any, size: int, labels: tuple[str, ...]) -> Array:
    """The points (N, size) of a path: an array, or 501 values of a function of s in [0, 1].

    Raises:
        InvalidValueError, ShapeError: for anything else. The message names the first bad entry.
    """
    if callable(given):
        return np.array([_value(name, given, s, size) for s in np.linspace(0, 1, _SAMPLES)])
    points = as_float_array(name, given)
    if points.ndim != 2 or points.shape[1] != size:
        raise ShapeError(f"{name} ({', '.join(labels)})", points.shape, (None, size))
    if not 2 <= len(points) <= MOST_WAYPOINTS:
        raise InvalidValueError(f"number of rows of {name}", len(points), f"from 2 to {MOST_WAYPOINTS}")
    bad = np.argwhere(~np.isfinite(points))
    if bad.size:
        row, column = (int(k) for k in bad[0])
        raise InvalidValueError(f"{labels[column]} of {name}[{row}]", points[row, column], "a finite number")
    return points


def same_ends(points: Array, sizes: Array) -> bool:
    """Whether a path returns to its first point."""
    return bool((np.abs(points[-1] - points[0]) <= _SAME * sizes).all()) and len(points) > 2


def places(points: Array, sizes: Array) -> Array:
    """Parameters s (N,) of points (N, k) from 0 to 1, in proportion to the lengths of the chords.

    Raises:
        InvalidValueError: if a point repeats the one before it.
    """
    chords = np.linalg.norm(np.diff(points / sizes, axis=0), axis=1)
    repeated = np.flatnonzero(chords <= 1e-12)
    if repeated.size:
        k = int(repeated[0]) + 1
        raise InvalidValueError(f"waypoint {k}", "the same as the one before it", "a path that moves")
    s = np.concatenate([[0.0], np.cumsum(chords)])
    return np.asarray(s / s[-1])


def spline(s: Array, points: Array, closed: bool) -> CubicSpline:
    """The spline through points (N, k) at parameters s (N,)."""
    if closed:
        points = np.vstack([points[:-1], points[:1]])
    return CubicSpline(s, points, bc_type="periodic" if closed else "not-a-knot")


def _value(name: str, function: Callable[[float], Any], s: float, size: int) -> Array:
    try:
        value = function(float(s))
    except Exception as error:
        raise InvalidValueError(f"{name}({s:g})", f"{type(error).__name__}: {error}", "a value") from None
    return frozen_array(f"{name}({s:g})", value, (size,))
