"""JSON of results, and strict parsing of JSON."""

import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from orthocas.errors import InvalidValueError

T = TypeVar("T")
_KINDS: dict[type, str] = {dict: "an object", list: "a list", str: "text"}


def clean(value: Any) -> Any:
    """Convert records and arrays like `convert`, and non-finite numbers to None, at all levels."""
    data = convert(value)
    if isinstance(data, dict):
        return {key: clean(item) for key, item in data.items()}
    if isinstance(data, list):
        return [clean(item) for item in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def convert(value: Any) -> Any:
    """Convert arrays and tuples to lists, and records to objects by their `as_dict`, or else with all their fields."""
    if hasattr(value, "as_dict"):
        return value.as_dict()
    if is_dataclass(value):
        return collect_attributes(value, *(field.name for field in fields(value)))
    if isinstance(value, Mapping):
        return {str(key): convert(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [convert(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def collect_attributes(record: Any, *names: str) -> dict[str, Any]:
    """Chosen fields and properties of a record by name, for its `as_dict`; see `convert`."""
    return {name: convert(getattr(record, name)) for name in names}


def write_json(data: Mapping[str, Any], indent: int | None = None) -> str:
    """Write one JSON object. Values are converted by `clean`."""
    return json.dumps(clean(data), allow_nan=False, indent=indent)


def read_strict_json(text: str | bytes) -> Any:
    """Parse data written by programs: finite numbers, unique keys, no unpaired surrogates.

    Raises:
        ValueError: for anything else, in one line.
    """
    try:
        data = json.loads(
            text, parse_constant=_refuse_constant, parse_float=_parse_finite, object_pairs_hook=refuse_doubles
        )
        json.dumps(data, ensure_ascii=False).encode()
    except json.JSONDecodeError as error:
        raise ValueError(f"{error.msg} (line {error.lineno}, column {error.colno})") from None
    except UnicodeError:
        raise ValueError("it holds half a surrogate pair or is not UTF-8") from None
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    return data


def get_part(data: Mapping[str, Any], name: str, kind: type[T]) -> T:
    """A field of parsed data.

    Raises:
        InvalidValueError: if it is missing or of another type.
    """
    want = _KINDS.get(kind, "an array")
    if name not in data:
        raise InvalidValueError(f"field '{name}'", "missing", want)
    value = data[name]
    if not isinstance(value, kind):
        raise InvalidValueError(f"field '{name}'", repr(value)[:80], want)
    return value


def refuse_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a JSON object from pairs.

    Raises:
        ValueError: if a key occurs twice.
    """
    data = dict(pairs)
    if len(data) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key '{twice[:80]}' appears twice in one object, expected once")
    return data


def _refuse_constant(text: str) -> None:
    raise ValueError(f"it holds {text}, expected finite numbers")


def _parse_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        _refuse_constant(text[:80])
    return value
