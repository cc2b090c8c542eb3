"""Input checks that raise the package's errors."""

from __future__ import annotations

import os
from collections.abc import Collection
from importlib import import_module
from numbers import Real
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.errors import InvalidValueError, MemoryNeedError, MissingExtraError, ShapeError, UnknownNameError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

_LONGEST_TEXT = 500  #: characters of a name
_REAL = "biuf"  #: NumPy's kinds of numbers: bool, int, unsigned, float
_NO_NUMBER = (str, bytes, complex, type(None))  #: types that are rejected although NumPy converts them


def import_extra(package: str, feature: str, extra: str) -> ModuleType:
    """Import a package that only one feature needs; raise MissingExtraError if it is not installed."""
    try:
        return import_module(package)
    except ModuleNotFoundError:
        raise MissingExtraError(feature, package, extra) from None


def require_shape(name: str, got: tuple[int, ...], want: tuple[int | None, ...]) -> None:
    """Raise ShapeError unless `got` matches `want`, where None stands for any length."""
    if len(got) != len(want) or any(w is not None and g != w for g, w in zip(got, want, strict=True)):
        raise ShapeError(name, got, want)


def require_known(what: str, name: str, known: Collection[str]) -> None:
    """Raise UnknownNameError unless `name` is in `known`."""
    if not isinstance(name, str) or name not in known:
        raise UnknownNameError(what, str(name), known)


def require_count(name: str, value: int, least: int = 1, most: int | None = None) -> int:
    """Return the value as a Python int. Raise InvalidValueError unless it is a whole number from least to most."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise InvalidValueError(name, value, f"a whole number >= {least}")
    if most is not None and value > most:
        raise InvalidValueError(name, value, f"a whole number from {least} to {most}")
    return int(value)


def require_text(name: str, value: str) -> str:
    """The value; raises InvalidValueError unless it is text of 1 to 500 characters that can be printed on one line."""
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= _LONGEST_TEXT:
        raise InvalidValueError(name, repr(value)[:80], f"printable text of 1 to {_LONGEST_TEXT} characters")
    return value


def require_memory(what: str, needed: float) -> None:
    """Raise MemoryNeedError if `needed` [bytes] exceeds 80 % of this machine's memory."""
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > 0.8 * available:
        raise MemoryNeedError(what, needed, available)


def freeze_array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Copy to a read-only float array of the given shape, with finite entries.

    Raises:
        ShapeError: if the shape differs.
        InvalidValueError: if the value is not numeric, or contains NaN or infinity.
    """
    array = as_float_array(name, value)
    require_shape(name, array.shape, shape)
    require_finite(name, array)
    frozen = array.copy()
    frozen.setflags(write=False)
    return frozen


def freeze_indices(name: str, value: ArrayLike, shape: tuple[int | None, ...], count: int) -> Indices:
    """Copy to a read-only integer array of the given shape with entries from 0 to count - 1.

    Whole numbers stored as floats are accepted: chart files of early versions contain such indices.

    Raises:
        ShapeError: if the shape differs.
        InvalidValueError: if an entry is not a whole number from 0 to count - 1.
    """
    # Floats represent integers exactly up to 2^53.
    numbers = as_float_array(name, value)
    require_shape(name, numbers.shape, shape)
    bad = ~((numbers >= 0) & (numbers < count) & (numbers == np.floor(numbers)))
    if bad.any():
        raise InvalidValueError(name, f"{numbers[bad][0]:g}", f"whole numbers from 0 to {count - 1}")
    frozen = numbers.astype(np.int64)
    frozen.setflags(write=False)
    return frozen


def as_float_array(name: str, value: Any) -> Array:
    """Convert to a float array.

    Raises:
        InvalidValueError: if the value does not consist of real numbers: text (even "1.0"), complex numbers, None,
            expressions, or arrays with masked entries, whose hidden values NumPy would use.
    """
    if np.ma.is_masked(value) or (isinstance(value, list | tuple) and any(map(np.ma.is_masked, value))):
        raise InvalidValueError(name, "an array with masked entries", "an array without masked entries")
    try:
        array = np.asarray(value)
        kind = array.dtype.kind
        if kind in _REAL or (kind == "O" and not any(isinstance(entry, _NO_NUMBER) for entry in array.flat)):
            return np.asarray(array, dtype=float)
    # RuntimeError: CasADi expressions inside lists.
    except (TypeError, ValueError, OverflowError, RuntimeError):
        pass
    raise InvalidValueError(name, repr(value)[:80], "an array of numbers")


def as_number(name: str, value: Any) -> float:
    """Convert one number of Python, NumPy or CasADi to a float.

    Raises:
        InvalidValueError: for anything else, including lists and tensors with one number: many callers only check that
            a value is a number, and continue with the original value.
    """
    if not isinstance(value, Real | np.ndarray | ca.DM) or (isinstance(value, np.ndarray) and value.ndim):
        raise InvalidValueError(name, repr(value)[:80], "a number")
    array = as_float_array(name, value)
    if array.size != 1:
        raise InvalidValueError(name, repr(value)[:80], "a number")
    return float(array.item())


def as_path(name: str, value: Any) -> Path:
    """Convert a file name to a path.

    Raises:
        InvalidValueError: for values other than text or a path, and for text that no file system accepts.
    """
    if not isinstance(value, str | os.PathLike) or "\0" in (text := os.fspath(value)):
        raise InvalidValueError(name, repr(value)[:80], "a path")
    return Path(text)


def require_finite(name: str, array: Array) -> None:
    """Raise InvalidValueError, with the index of the first bad entry, unless all entries are finite."""
    if not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InvalidValueError(f"{name}{list(place) if place else ''}", array[place], "a finite number")


def as_rows(name: str, value: ArrayLike, n: int) -> tuple[Array, bool]:
    """Convert one point or a set of points, finite or not, to a set (N, n), and whether it was one point.

    A point is (n,), or a column (n, 1), such as a `casadi.DM`; for n = 1 a column is a set.

    Raises:
        ShapeError: if the last axis does not have n entries.
    """
    array = as_float_array(name, value)
    # A column, as CasADi returns it, is one point.
    if n > 1 and array.shape == (n, 1):
        array = array[:, 0]
    single = array.ndim == 1
    points = array[None, :] if single else array
    if points.ndim != 2 or points.shape[1] != n:
        raise ShapeError(name, array.shape, (n,) if single else (None, n))
    return points, single


def as_point_set(name: str, value: ArrayLike, n: int) -> tuple[Array, bool]:
    """Convert one point or a set of points as `as_rows` does.

    Raises:
        ShapeError: if the last axis does not have n entries.
        InvalidValueError: if an entry is not finite.
    """
    points, single = as_rows(name, value, n)
    require_finite(name, points[0] if single else points)
    return points, single


def as_point(name: str, value: ArrayLike, n: int) -> Array:
    """One point, (n,) or a column (n, 1), as a read-only copy (n,).

    Raises:
        ShapeError, InvalidValueError: as in `as_point_set`. A set of points raises ShapeError.
    """
    points, single = as_point_set(name, value, n)
    if not single:
        raise ShapeError(name, points.shape, (n,))
    return freeze_array(name, points[0], (n,))


def require_executor(executor: object) -> None:
    """Raise InvalidValueError unless the argument `executor` is None or has a method `submit`."""
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise InvalidValueError("executor", f"a {type(executor).__name__}", "an executor with a method submit, or None")


def require_kind(name: str, value: object, kind: type) -> None:
    """Raise InvalidValueError unless `value` is an instance of `kind`."""
    if not isinstance(value, kind):
        plain = isinstance(value, str | int | float | None)
        received = repr(value)[:80] if plain else f"a {type(value).__name__}"
        hint = suggest_attribute(value, kind) or _MAKERS.get(kind.__name__, "")
        raise InvalidValueError(name, received, f"a {kind.__name__}{hint}")


#: class -> how to make an object of it, for the end of a message
_MAKERS = {
    "Task": ", such as oc.Task.pose(robot)",
    "Problem": ", such as oc.Problem(robot, task), or oc.problems.get(name)",
    "Robot": ", such as oc.Robot.from_name(name), or oc.Robot.from_urdf(path)",
    "KinematicTree": ": oc.Robot.from_name(name) and oc.Robot.from_urdf(path) build a robot",
    "Chart": ", such as oc.load(path), or oc.fit(problem).chart",
}


def suggest_attribute(value: object, kind: type) -> str:
    """Hint for a value with an attribute of class `kind`, as a fit has a chart; "" for other values."""
    name = kind.__name__.lower()
    return f": use its attribute '{name}'" if isinstance(getattr(value, name, None), kind) else ""


def require_at_least(name: str, value: float, least: float) -> float:
    """The value as a float; raises InvalidValueError unless it is a finite number >= least."""
    if not least <= (number := as_number(name, value)) < np.inf:
        raise InvalidValueError(name, value, f"a finite number >= {least:g}")
    return number


def require_positive(name: str, value: float) -> float:
    """The value as a float; raises InvalidValueError unless it is a finite number > 0."""
    if not 0 < (number := as_number(name, value)) < np.inf:
        raise InvalidValueError(name, value, "a finite number > 0")
    return number
