"""Campaign of sixteen threads that share charts and laws: each number is that of one thread."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from series import SERIES

from fuzz.child import Finding

THREADS = 16


def threads(count: int) -> list[Finding]:
    """Call `count` times, in the proportions of the series of the tests."""
    found, whole = [], sum(share for _, share in SERIES.values())
    for seed, (name, (build, share)) in enumerate(SERIES.items()):
        calls = build()
        expected = [calls[k % len(calls)](k) for k in range(12 * len(calls))]  # after that they repeat
        differ = different(build(), expected, max(1, count * share // whole))
        if differ:
            found.append(Finding("threads", seed, f"{name}: {differ} calls differ"))
    return found


def different(calls: list[Callable[[int], Any]], expected: list[Any], count: int) -> int:
    """How many of `count` calls in threads give something else; functions are not built before that."""

    def differs(k: int) -> bool:
        return not np.array_equal(calls[k % len(calls)](k), expected[k % len(expected)], equal_nan=True)

    with ThreadPoolExecutor(THREADS) as pool:
        return sum(pool.map(differs, range(count), chunksize=1))
