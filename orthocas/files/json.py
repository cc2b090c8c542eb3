"""Plain data for JSON, which has no NaN, no infinity and no arrays."""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


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
