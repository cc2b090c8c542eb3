"""How fast a path is traversed: the fastest smooth speed profile within limits of velocity and acceleration (ours).

With z(s) = (ds/dt)^2, joint velocities and accelerations are dq = q' sqrt(z) and ddq = q'' z + q' dz/ds / 2. Both
limits are linear in z, and so a linear program finds the fastest profile. z is a cubic spline with z = 0 at both ends,
so that accelerations are continuous between start and end. The transformation is that of time-optimal path following
(Verscheure et al., IEEE Trans. Automatic Control 54, 2009); spline and linear program are ours.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import linprog
from scipy.sparse import coo_array, vstack

from orthocas.checks import Array, Indices
from orthocas.errors import SolveError

_DEGREE = 3
_PIECES = 60  # of the spline
_BINS, _PLACES = 300, 8  # parts of the path, and places of each; limits count where a joint turns most within a part
_TURNS = 0.01  # share of its largest slope that a joint counts with where the path turns back
_FINE = 6000  # steps of the integration of time
_LEAST = 1e-9  # smallest z inside the path, relative to its largest value


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """s(t) from rest to rest, with ds/dt and d2s/dt2."""

    times: Array  #: (M,) fine grid [s]
    s: Array  #: (M,)
    speed: Array  #: (M,) ds/dt

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return float(self.times[-1])

    def stretched(self, duration: float) -> "TimeLaw":
        """The same motion in another time."""
        factor = duration / self.duration
        return TimeLaw(self.times * factor, self.s, self.speed / factor)

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """s, ds/dt and d2s/dt2 at times (N,): parts of constant acceleration."""
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        since, length = times - self.times[k], self.times[k + 1] - self.times[k]
        acceleration = (self.speed[k + 1] - self.speed[k]) / length
        s = self.s[k] + self.speed[k] * since + acceleration * since**2 / 2
        return np.clip(s, 0.0, 1.0), np.maximum(self.speed[k] + acceleration * since, 0.0), acceleration


def checked_places() -> Array:
    """The parameters s at which `fastest` wants q' and q'', (P,)."""
    return np.linspace(0.0, 1.0, _BINS * _PLACES)


def fastest(first: Array, second: Array, velocity: Array, acceleration: Array) -> TimeLaw:
    """The fastest profile.

    Args:
        first: q' at `checked_places()`, (P, n).
        second: q'' there, (P, n).
        velocity: limits (n,) [rad/s] or [m/s].
        acceleration: limits (n,) [rad/s^2] or [m/s^2].

    Raises:
        SolveError: if the linear program fails.
    """
    knots = _knots()
    moves = np.maximum(np.abs(first), _TURNS * np.abs(first).max(axis=0) + 1e-12)
    speeds = ((velocity / moves) ** 2).min(axis=1)
    slowest = _worst(-speeds)
    rows, bounds = [_basis(slowest, knots)[0]], [speeds[slowest]]
    for i in range(first.shape[1]):
        if np.abs(first[:, i]).max() > 1e-12:
            k = _worst(np.abs(second[:, i]))
            values, slopes = _basis(k, knots)
            forces = values.multiply(second[k, i : i + 1]) + slopes.multiply(first[k, i : i + 1] / 2)
            rows += [forces, -forces]
            bounds += [np.full(_BINS, acceleration[i])] * 2
    limits, matrix = np.concatenate(bounds), vstack(rows).tocsr()
    scale = float(limits[:_BINS].min())
    size = len(knots) - _DEGREE - 1
    ends = [(0.0, 0.0), *[(0.0, None)] * (size - 2), (0.0, 0.0)]
    gain = -np.asarray(rows[0].sum(axis=0)).ravel()
    found = linprog(gain, matrix, limits / scale, bounds=ends, method="highs")
    if found.x is None or found.x.max() <= 0:
        raise SolveError(f"the speed profile of a path was not found: {found.message}")
    return _integrated(BSpline(knots, found.x * scale, _DEGREE))


def _integrated(z: BSpline) -> TimeLaw:
    """Time along the path: steps of constant acceleration take 2 ds / (speed before + speed after)."""
    s = (1 - np.cos(np.linspace(0.0, np.pi, _FINE + 1))) / 2  # finer near the ends, where the speed changes most
    squares = z(s)
    squares = np.maximum(squares, _LEAST * squares.max())
    squares[[0, -1]] = 0.0
    speed = np.sqrt(squares)
    times = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (speed[1:] + speed[:-1]))])
    return TimeLaw(times, s, speed)


def _knots() -> Array:
    inner = np.linspace(0.0, 1.0, _PIECES + 1)
    return np.concatenate([np.zeros(_DEGREE), inner, np.ones(_DEGREE)])


def _worst(values: Array) -> Indices:
    """The place with the largest value (P,) in each part of the path, (_BINS,)."""
    parts = values.reshape(_BINS, _PLACES)
    return np.asarray(np.arange(_BINS) * _PLACES + parts.argmax(axis=1), dtype=np.int64)


def _basis(k: Indices, knots: Array) -> tuple[coo_array, coo_array]:
    """Values and derivatives of the basis at places k (P,), (P, size) each."""
    basis = BSpline(knots, np.eye(len(knots) - _DEGREE - 1), _DEGREE)
    s = checked_places()[k]
    return coo_array(np.asarray(basis(s))), coo_array(np.asarray(basis.derivative()(s)))
