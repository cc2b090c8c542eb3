"""The code of coordinates in an exported module, apart from what the library changes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from orthocas.checks import Array
from orthocas.coordinates.fitted import Coordinates


@dataclass(frozen=True, eq=False)
class Form:
    """The functions `_xi` and `_xi_jacobian` of columns q (n, N): a template, and what it uses."""

    template: str  #: name of a file in templates/
    values: Mapping[str, str]  #: of its placeholders
    functions: str  #: further functions
    tables: Mapping[str, Array]
    indices: Mapping[str, Sequence[int]]


def idle_part(coordinates: Coordinates) -> tuple[Array, Array]:
    """A (r, n) and c (r, 1) with A q + c = q - centre for the idle joints, and 0 for the other coordinates."""
    r, n, idle = coordinates.r, coordinates.space.n, list(coordinates.idle)
    A, c = np.zeros((r, n)), np.zeros((r, 1))
    A[r - len(idle) :] = np.eye(n)[idle]
    c[r - len(idle) :, 0] = -coordinates.space.centre[idle]
    return A, c
