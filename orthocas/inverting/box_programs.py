"""Quadratic programs with equations and bounds, for many rows at once (ours).

    minimise  d^T H d / 2 + g^T d   subject to   A d = 0,  low <= d <= high,

by a primal-dual active set method: guess which bounds hold with equality, solve the linear equations of that guess,
hold the variables that leave their bounds, let go those whose multipliers have the wrong sign, and repeat until nothing
changes. It need not end, but nearly always does so within a few rounds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.checks import Array

_ROUNDS = 12
_SLACK = 1e-13  # of bounds
_SOFTNESS = 1e-12  # A d = softness * multipliers, so that bounds that leave no room for A d = 0 do no harm


@dataclass(frozen=True)
class Programs:
    """The programs of N rows; low <= 0 <= high."""

    H: Array  #: (N, n, n), positive definite
    g: Array  #: (N, n)
    A: Array  #: (N, m, n)
    low: Array  #: (N, n)
    high: Array  #: (N, n)


@dataclass(frozen=True)
class Minimum:
    """Where N programs have their minimum."""

    d: Array  #: (N, n), within the bounds
    multipliers: Array  #: of A d = 0, (N, m)
    at_low: NDArray[np.bool_]  #: (N, n)
    at_high: NDArray[np.bool_]  #: (N, n)
    solved: NDArray[np.bool_]  #: whether d is the minimum, (N,)


def minimum(programs: Programs, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_]) -> Minimum:
    """Minima of programs, from a guess of which bounds hold, (N, n) each."""
    N, n = programs.g.shape
    d, multipliers, left = np.zeros((N, n)), np.zeros((N, programs.A.shape[1])), np.arange(N)
    at_low, at_high = at_low.copy(), at_high.copy()
    for _ in range(_ROUNDS):
        part = Programs(*(getattr(programs, name)[left] for name in ("H", "g", "A", "low", "high")))
        d[left], multipliers[left] = _solved(part, at_low[left], at_high[left])
        low, high = _guess(part, d[left], multipliers[left], at_low[left], at_high[left])
        changed = ((low != at_low[left]) | (high != at_high[left])).any(axis=1)
        at_low[left], at_high[left] = low, high
        left = left[changed]
        if not left.size:
            break
    solved = np.ones(N, dtype=bool)
    solved[left] = False
    return Minimum(np.clip(d, programs.low, programs.high), multipliers, at_low, at_high, solved)


def _solved(programs: Programs, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_]) -> tuple[Array, Array]:
    """d (N, n) and multipliers (N, m) where the guessed bounds hold with equality, and no others."""
    (N, m, n), held = programs.A.shape, at_low | at_high
    K = np.zeros((N, n + m, n + m))
    K[:, :n, :n], K[:, :n, n:], K[:, n:, :n] = programs.H, programs.A.transpose(0, 2, 1), programs.A
    K[:, n:, n:] = -_SOFTNESS * np.eye(m)
    rows, joints = np.nonzero(held)
    K[rows, joints], K[rows, joints, joints] = 0.0, 1.0
    bounds = np.where(at_low, programs.low, programs.high)
    right = np.concatenate([np.where(held, bounds, -programs.g), np.zeros((N, m))], axis=1)
    solution = np.linalg.solve(K, right[:, :, None])[:, :, 0]
    return solution[:, :n], solution[:, n:]


def _guess(
    programs: Programs, d: Array, multipliers: Array, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which bounds hold by what the last guess led to, (N, n) each."""
    slope = (programs.H @ d[:, :, None] + programs.g[:, :, None])[:, :, 0]
    slope = slope + np.einsum("nmi,nm->ni", programs.A, multipliers)
    free = ~(at_low | at_high)
    low = np.where(free, d < programs.low - _SLACK, at_low & (slope > 0))
    high = np.where(free, d > programs.high + _SLACK, at_high & (slope < 0))
    return low, high
