"""JSON of results, and strict reading of JSON: what programs wrote, and what people write."""

import json
import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, is_dataclass
from math import inf, isfinite
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from orthocas.errors import InvalidValueError, StepsFileError
from orthocas.tools.checks import Array

T = TypeVar("T")
_KINDS: dict[type, str] = {dict: "an object", list: "a list", str: "text"}


@dataclass(frozen=True, slots=True)
class JsonRules:
    """Bounds of what people write."""

    file: int = 2**23  #: bytes of a file
    largest: float = 1e6  #: larger numbers are mistakes and would overflow later
    longest: int = 80  #: most characters of the input that an error repeats


RULES = JsonRules()


def clean(value: Any) -> Any:
    """Convert records and arrays as `convert` does, and numbers that are not finite to None, at all levels."""
    data = convert(value)
    if isinstance(data, dict):
        return {key: clean(item) for key, item in data.items()}
    if isinstance(data, list):
        return [clean(item) for item in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def convert(value: Any) -> Any:
    """Convert arrays and tuples to lists, and records to objects: by their own `as_dict`, or with all their fields."""
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
    """The chosen fields and properties of a record by name, for its `as_dict`; see `convert`."""
    return {name: convert(getattr(record, name)) for name in names}


def write_json(data: Mapping[str, Any], indent: int | None = None) -> str:
    """Write one JSON object. Values are converted by `clean`."""
    return json.dumps(clean(data), allow_nan=False, indent=indent)


def read_strict_json(text: str | bytes) -> Any:
    """Data of a file that programs wrote: finite numbers, no key twice, no halves of surrogate pairs.

    Raises:
        ValueError: in one line, for everything else.
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


def refuse_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON.

    Raises:
        ValueError: if a key comes twice.
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


@dataclass(frozen=True)
class Reader:
    """Reads values from JSON data. Every method raises StepsFileError for data of the wrong kind."""

    path: Path

    def parsed(self) -> object:
        """The data of the file. NaN and duplicate keys are errors."""
        try:
            with self.path.open("rb") as stream:
                content = stream.read(RULES.file + 1)
        except OSError as error:
            raise self.fault(f"cannot be read, {error.strerror}") from None
        # ValueError stands for a path with a zero.
        except ValueError as error:
            raise self.fault(f"cannot be read, {error}") from None
        if len(content) > RULES.file:
            raise self.fault(f"larger than {RULES.file / 2**20:.0f} MiB, no steps file")
        try:
            return read_strict_json(content.decode("utf-8-sig"))
        # ValueError also stands for bytes that are no text.
        except ValueError as error:
            raise self.fault(f"truncated or not JSON, {str(error)[: RULES.longest]}") from None

    def fault(self, text: str) -> StepsFileError:
        """An error that names the file."""
        return StepsFileError(f"steps file {self.path}: {text}")

    def wrong(self, where: str, got: object, want: str) -> StepsFileError:
        """An error that names the place, the value there and what was expected."""
        return self.fault(f"{where} is {json.dumps(got)[: RULES.longest]}, expected {want}")

    def fields(self, data: object, where: str, known: Collection[str], what: str = "key") -> dict[str, Any]:
        """An object that has only known keys."""
        if not isinstance(data, dict):
            raise self.wrong(where, data, "an object")
        for key in data:
            if key not in known:
                names = ", ".join(known)
                raise self.fault(f"{where} has an unknown {what} '{key[: RULES.longest]}', known: {names}")
        return data

    def items(self, data: object, where: str) -> list[Any]:
        """Return the data if it is a list; raise otherwise."""
        if not isinstance(data, list):
            raise self.wrong(where, data, "a list")
        return data

    def number(self, data: object, where: str, least: float = -RULES.largest, above: float = -inf) -> float:
        """A number that is at least `least` or above `above`, and at most 1e6."""
        if data is None:
            raise self.fault(f"{where} is missing, expected a number")
        low = f"above {above:g}" if isfinite(above) else f"from {least:g}"
        if (
            isinstance(data, bool)
            or not isinstance(data, int | float)
            or not (above < data and least <= data <= RULES.largest)
        ):
            raise self.wrong(where, data, f"a number {low} to {RULES.largest:g}")
        return float(data)

    def numbers(self, data: object, where: str, length: int) -> Array:
        """A list of finite numbers, (length,)."""
        items = self.items(data, where)
        if len(items) != length:
            raise self.wrong(where, items, f"a list of {length} numbers")
        return np.array([self.number(item, f"{where}[{i}]") for i, item in enumerate(items)])
