"""The size of the rows of a task Jacobian, so that singular values do not depend on units."""

import numpy as np

from orthocas.checks import Array


def row_scale(J: Array, units: tuple[str, ...]) -> Array:
    """Root mean square length of the rows of each unit, (m,). It does not depend on how axes are turned; 1 if zero.

    Args:
        J: task Jacobians at samples, (N, m, n).
        units: units of the task components; rows with the same unit share one scale, rows of unknown unit have their
            own.
    """
    squares = (J**2).sum(axis=2).mean(axis=0)
    groups = [unit or f"own {i}" for i, unit in enumerate(units)]
    means = [
        np.mean([square for square, other in zip(squares, groups, strict=True) if other == mine]) for mine in groups
    ]
    return np.sqrt([mean if mean > 0 else 1.0 for mean in means])
