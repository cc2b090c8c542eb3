"""The kinds of base leaves by name, for chart files."""

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from orthocas.checks import require_known
from orthocas.growing.circle_leaf import CircleLeaf
from orthocas.growing.disk_leaf import DiskLeaf
from orthocas.growing.leaf import LeafChart
from orthocas.growing.linear_leaf import LinearLeaf
from orthocas.problem import Problem

LEAVES: dict[str, type[LinearLeaf] | type[CircleLeaf] | type[DiskLeaf]] = {
    kind.kind: kind for kind in (LinearLeaf, CircleLeaf, DiskLeaf)
}


def leaf_from_arrays(problem: Problem, kind: str, arrays: Mapping[str, NDArray[Any]]) -> LeafChart:
    """Build the chart of a leaf from its arrays.

    Raises:
        UnknownNameError: if no kind has that name.
        ShapeError: if an array has the wrong shape.
    """
    require_known("leaf", kind, LEAVES)
    return LEAVES[kind](problem, **arrays)
