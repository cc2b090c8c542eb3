"""Differences of circle-valued coordinates, by the shorter way around the circle (ours)."""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.checks import Array
from orthocas.errors import InvalidValueError


def shortest(difference: Any, turns: Array) -> Any:
    """Differences of phi without whole turns of its periodic components.

    Args:
        difference: NumPy rows (N, k) or (k,), or a CasADi column (k, 1).
        turns: periods of the components, (k,); 0 for those that have none.
    """
    if not turns.any():
        return difference
    periods = np.where(turns > 0, turns, 1.0)
    if isinstance(difference, ca.SX | ca.MX | ca.DM):
        whole: Any = ca.floor(difference / ca.DM(periods) + 0.5)
        return difference - ca.DM(turns) * whole
    return difference - turns * np.round(difference / periods)


def counted_on(rows: Array, turns: Array) -> Array:
    """Rows (N, k) of values along a curve; periodic ones go on by the shorter way from row to row."""
    if not turns.any():
        return rows
    steps = shortest(np.diff(rows, axis=0), turns)
    return np.asarray(rows[0] + np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(steps, axis=0)]))


def require_no_turns(labels: tuple[str, ...], turns: Array, purpose: str) -> None:
    """Raise InvalidValueError if a component of phi is periodic, for what cannot deal with that yet."""
    circles = [label for label, turn in zip(labels, turns, strict=True) if turn > 0]
    if circles:
        raise InvalidValueError(
            "chart", f"one with circle-valued coordinates ({', '.join(circles)})", f"real-valued ones for {purpose}"
        )
