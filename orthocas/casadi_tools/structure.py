"""What the steps of a tape say for all real numbers: which joints a gradient depends on, and where a map is periodic.

Both are read from the operations alone, so they hold exactly. They may miss what cancels: a joint that is named need
not matter.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from orthocas.casadi_tools.tape import Tape

Joints = frozenset[int]
Gradient = dict[int, Joints]  #: the joints that each derivative depends on; missing ones are 0
_LINEAR = ("assign", "neg", "twice", "add", "sub")
_NOTHING: Joints = frozenset()


def gradient_dependences(tape: Tape) -> list[Gradient]:
    """For each output, the joints that its derivatives depend on."""
    values: dict[int, Joints] = {}
    slopes: dict[int, Gradient] = {}
    results: dict[int, Gradient] = {}
    for name, into, *of in tape["steps"]:
        if name == "output":
            results[into] = slopes[of[0]]
        elif name in ("const", "input"):
            joints = frozenset(of) if name == "input" else _NOTHING
            values[into], slopes[into] = joints, dict.fromkeys(joints, _NOTHING)
        else:
            found = _slopes(name, [values[k] for k in of], [slopes[k] for k in of])
            values[into], slopes[into] = frozenset().union(*(values[k] for k in of)), found
    return [results[k] for k in range(len(results))]


def _slopes(name: str, values: list[Joints], slopes: list[Gradient]) -> Gradient:
    """What the derivatives of a step depend on."""
    everything = frozenset().union(*values)
    partials = [everything] * len(values)
    if name in _LINEAR:
        partials = [_NOTHING] * len(values)
    elif name == "mul":
        partials = values[::-1]
    elif name == "div":
        partials[0] = values[1]
    total: Gradient = {}
    for partial, part in zip(partials, slopes, strict=True):
        for j, own in part.items():
            total[j] = total.get(j, _NOTHING) | partial | own
    return total


def periodic_joints(tape: Tape, n: int) -> Joints:
    """The joints k of n for which h(q + 2 pi e_k) - h(q) is the same constant at every q, for all outputs h."""
    shifts: dict[int, Any] = {}  # change by a turn of each joint / 2 pi; NaN where it is no constant
    constants: dict[int, float] = {}
    alike = np.ones(n, dtype=bool)
    for name, into, *of in tape["steps"]:
        if name == "output":
            alike &= ~np.isnan(shifts[of[0]])
            continue
        found = np.zeros(n)
        if name == "input":
            found[of[0]] = 1.0
        elif name != "const":
            found = _shift(name, [shifts[k] for k in of], [constants.get(k) for k in of])
        constants.pop(into, None)
        if name == "const":
            constants[into] = float(of[0])
        shifts[into] = found
    return frozenset(np.flatnonzero(alike).tolist())


def _shift(name: str, shifts: list[Any], constants: list[float | None]) -> Any:
    """The change of a step. Only whole numbers of moderate size are added and multiplied, which is exact."""
    if name in _EXACT:
        return _whole(_EXACT[name](*shifts))
    if name == "mul" and any(constant is not None for constant in constants):
        factor, shift = (constants[0], shifts[1]) if constants[0] is not None else (constants[1], shifts[0])
        return _whole(np.where(shift == 0, 0.0, shift * factor))
    still = np.all([shift == 0 for shift in shifts], axis=0)
    if name in ("sin", "cos", "tan"):
        still = ~np.isnan(shifts[0])
    return np.where(still, 0.0, np.nan)


_EXACT: Mapping[str, Callable[..., Any]] = {
    "assign": lambda a: a,
    "neg": lambda a: -a,
    "twice": lambda a: 2 * a,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
}


def _whole(shift: Any) -> Any:
    return np.where((shift == np.round(shift)) & (np.abs(shift) < 2.0**40), shift, np.nan)
