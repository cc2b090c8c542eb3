"""The pairs of coordinates whose angles count."""

from itertools import combinations


def pairs(r: int) -> list[tuple[int, int]]:
    """The pairs (i, j), i > j, of r coordinates in the order of the mutual cosines."""
    return [(i, j) for j, i in combinations(range(r), 2)]
