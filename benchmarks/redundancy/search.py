"""A search that methods with a coordinate of their own use for a wished elbow."""

from collections.abc import Callable

STEPS, NEAR, FIRST = 6, 1e-4, 1e-3  # calls; what may be left [rad]; first step of the coordinate


def secant(rest: Callable[[float], float], begin: float) -> float:
    """The coordinate at which what is left of a wish vanishes, from where it is; the last one tried."""
    last, before = begin, rest(begin)
    ahead = begin + FIRST
    for _ in range(STEPS):
        if abs(before) < NEAR:
            break
        left = rest(ahead)
        if left == before:
            break
        ahead, last, before = ahead - left * (ahead - last) / (left - before), ahead, left
    return last
