"""Checks of gains, which are given as one number for all quantities or one number per quantity."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.checks import Array, as_float_array, frozen_array, require_shape
from orthocas.errors import InvalidValueError

STIFFNESS, DAMPING_RATIO, FEEDBACK, LIMIT, SECOND_FORCE = (  #: units of gains, in words
    "J per squared unit of the quantity, > 0",
    ">= 0, 1 is critical damping",
    "1/s, >= 0",
    "largest command per joint, > 0; INFINITY for no limit",
    "J per unit of the second quantity",
)


def positive_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers > 0, (length,), from one number or (length,)."""
    gains = _spread(name, value, length)
    _require(name, gains, gains > 0, "positive numbers")
    return gains


def non_negative_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers >= 0, (length,), from one number or (length,)."""
    gains = _spread(name, value, length)
    _require(name, gains, gains >= 0, "numbers >= 0")
    return gains


def finite_gains(name: str, value: ArrayLike, length: int) -> Array:
    """Finite numbers, (length,), from one number or (length,)."""
    return _spread(name, value, length)


def command_limit(name: str, value: ArrayLike | None, default: Array) -> Array:
    """Numbers > 0, (n,), possibly infinite; the limits of the robot if `value` is None."""
    length = len(default)
    limit = np.array(np.broadcast_to(_one_or(name, default if value is None else value, length), (length,)))
    _require(name, limit, limit > 0, "positive numbers")
    limit.setflags(write=False)
    return limit


def _spread(name: str, value: ArrayLike, length: int) -> Array:
    return frozen_array(name, np.broadcast_to(_one_or(name, value, length), (length,)), (length,))


def _one_or(name: str, value: ArrayLike, length: int) -> Array:
    array = as_float_array(name, value)
    if array.ndim:
        require_shape(name, array.shape, (length,))
    return array


def _require(name: str, gains: Array, good: NDArray[np.bool_], want: str) -> None:
    bad = np.flatnonzero(~good)
    if bad.size:
        raise InvalidValueError(f"{name}[{bad[0]}]", gains[bad[0]], want)
