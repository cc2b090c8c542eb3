"""Strict reader for JSON files that people write. Errors name the file and the place in it."""

import json
from collections.abc import Collection
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from orthocas.checks import Array
from orthocas.errors import StepsFileError

_LARGEST = 1e6  # larger numbers are mistakes and would overflow later
_LONGEST = 80  # most characters of the input that an error repeats


@dataclass(frozen=True)
class Reader:
    """Reads values from JSON data. Every method raises StepsFileError for data of the wrong kind."""

    path: Path

    def parsed(self) -> object:
        """The data of the file. NaN and duplicate keys are errors."""
        try:
            text = self.path.read_text(encoding="utf-8-sig")
            return json.loads(text, parse_constant=self._refused_constant, object_pairs_hook=self._without_doubles)
        except StepsFileError:
            raise
        except json.JSONDecodeError as error:
            raise self.fault(
                f"truncated or not JSON, {error.msg} (line {error.lineno}, column {error.colno})"
            ) from None
        except (
            RecursionError,
            ValueError,
        ) as error:  # nested too deeply, not text, or a number with thousands of digits
            raise self.fault(f"not JSON, {str(error)[:_LONGEST]}") from None
        except OSError as error:
            raise self.fault(f"cannot be read, {error.strerror}") from None

    def fault(self, text: str) -> StepsFileError:
        """An error that names the file."""
        return StepsFileError(f"steps file {self.path}: {text}")

    def wrong(self, where: str, got: object, want: str) -> StepsFileError:
        """An error that names the place, the value there and what was expected."""
        return self.fault(f"{where} is {json.dumps(got)[:_LONGEST]}, expected {want}")

    def fields(self, data: object, where: str, known: Collection[str], what: str = "key") -> dict[str, Any]:
        """An object that has only known keys."""
        if not isinstance(data, dict):
            raise self.wrong(where, data, "an object")
        for key in data:
            if key not in known:
                names = ", ".join(known)
                raise self.fault(f"{where} has an unknown {what} '{key[:_LONGEST]}', known: {names}")
        return data

    def items(self, data: object, where: str) -> list[Any]:
        """A list."""
        if not isinstance(data, list):
            raise self.wrong(where, data, "a list")
        return data

    def number(self, data: object, where: str, least: float = -_LARGEST, above: float = -inf) -> float:
        """A number that is at least `least` or above `above`, and at most 1e6."""
        if data is None:
            raise self.fault(f"{where} is missing, expected a number")
        low = f"above {above:g}" if isfinite(above) else f"from {least:g}"
        if (
            isinstance(data, bool)
            or not isinstance(data, int | float)
            or not (above < data and least <= data <= _LARGEST)
        ):
            raise self.wrong(where, data, f"a number {low} to {_LARGEST:g}")
        return float(data)

    def numbers(self, data: object, where: str, length: int) -> Array:
        """A list of finite numbers, (length,)."""
        items = self.items(data, where)
        if len(items) != length:
            raise self.wrong(where, items, f"a list of {length} numbers")
        return np.array([self.number(item, f"{where}[{i}]") for i, item in enumerate(items)])

    def _refused_constant(self, text: str) -> None:
        raise self.fault(f"it holds {text}, expected finite numbers")

    def _without_doubles(self, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        data = dict(pairs)
        if len(data) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise self.fault(f"the key '{twice[:_LONGEST]}' appears twice in one object, expected once")
        return data
