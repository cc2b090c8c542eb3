"""Plain data for JSON, which has no NaN, no infinity and no arrays."""

import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from orthocas.errors import InvalidValueError

T = TypeVar("T")
_KINDS: dict[type, str] = {dict: "an object", list: "a list", str: "text"}


def plain(value: Any) -> Any:
    """Convert arrays and tuples to lists, and numbers that are not finite to None, at all levels."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def to_json(data: Mapping[str, Any], indent: int | None = None) -> str:
    """Write one JSON object. Values are converted by `plain`."""
    return json.dumps(plain(data), allow_nan=False, indent=indent)


def from_strict_json(text: str | bytes) -> Any:
    """Data of a file that programs wrote: finite numbers, no key twice, no halves of surrogate pairs.

    Raises:
        ValueError: in one line, for everything else.
    """
    try:
        data = json.loads(text, parse_constant=_refused, parse_float=_finite, object_pairs_hook=without_doubles)
        json.dumps(data, ensure_ascii=False).encode()
    except json.JSONDecodeError as error:
        raise ValueError(f"{error.msg} (line {error.lineno}, column {error.colno})") from None
    except UnicodeError:
        raise ValueError("it holds half a surrogate pair or is not UTF-8") from None
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    return data


def part(data: Mapping[str, Any], name: str, kind: type[T]) -> T:
    """A field of data that were read.

    Raises:
        InvalidValueError: if it is missing, or of another kind.
    """
    want = _KINDS.get(kind, "an array")
    if name not in data:
        raise InvalidValueError(f"field '{name}'", "missing", want)
    value = data[name]
    if not isinstance(value, kind):
        raise InvalidValueError(f"field '{name}'", repr(value)[:80], want)
    return value


def without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON.

    Raises:
        ValueError: if a key comes twice.
    """
    data = dict(pairs)
    if len(data) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key '{twice[:80]}' appears twice in one object, expected once")
    return data


def _refused(text: str) -> None:
    raise ValueError(f"it holds {text}, expected finite numbers")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        _refused(text[:80])
    return value
