"""Plain data for JSON, which has no NaN, no infinity and no arrays."""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """The value with arrays and tuples as lists, and numbers that are not finite as None, all the way down."""
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
    """One JSON object; see `plain`."""
    return json.dumps(plain(data), allow_nan=False, indent=indent)
