"""Numbers as C literals."""

import numpy as np

from orthocas.checks import Array


def numbers(values: Array) -> str:
    """C literals that convert back to exactly the same numbers."""
    words = {np.inf: "INFINITY", -np.inf: "-INFINITY"}
    return ", ".join(words.get(float(value), repr(float(value))) for value in values)


def flags(values: Array) -> str:
    """Truth values as C has them."""
    return ", ".join(str(int(value)) for value in values)
