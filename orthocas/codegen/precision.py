"""The number type of generated C, and what its check allows."""

import ctypes
import re
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from orthocas.charts.trackers import RULES, ReachingRules
from orthocas.control.controller import LARGEST, SMALLEST_VOLUME, Controller, replace_smallest_volume
from orthocas.tasks.domains import Domain
from orthocas.tools.checks import Array

# 1e+06 becomes 1e6, and 1e-05 1e-5.
_EXPONENT = re.compile(r"e\+?(-?)0*")
_RANGE = float(np.finfo(np.float32).max)
_MATHEMATICS = frozenset(
    (
        *("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "copysign", "cos", "cosh", "erf"),
        *("exp", "expm1", "fabs", "floor", "fmax", "fmin", "fmod", "hypot", "log", "log10", "log1p", "log2", "pow"),
        *("remainder", "rint", "round", "sin", "sinh", "sqrt", "tan", "tanh", "trunc"),
    )
)
_TOKEN = re.compile(
    r"(?P<kept>/\*.*?\*/|\"[^\"\n]*\"|^#\s*include[^\n]*)"
    r"|(?P<call>[a-z]\w*)(?=\()|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<literal>\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)"
    r"|\d+\w*",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True)
class Precision:
    """A number type of C. Templates and kernels are written in double; `translate` puts them into this type."""

    c_name: str
    scalar: type[np.floating[Any]]
    c_type: type[Any]  #: of ctypes
    smallest_volume: float  #: of the gradients, relative to the median; the errors of commands grow with its square
    largest: float  #: larger numbers count as not finite, because their squares may overflow
    smallest: float  #: positive, to divide by
    farthest: float  #: larger joint positions count as not finite in the supervised law, because they are too coarse
    rounding: float  #: relative; references that move less in a tick may stand still
    solved: float  #: error of solutions of the inverse map, in sizes of the components
    exact: float  #: error at which the search for a better solution stops
    coarse: float  #: share of a wanted value that counts as size, so that `solved` of it is not below rounding
    pivot: float  #: of the scaled Jacobian; smaller ones are singular
    checked: float  #: largest difference that `NAME_check` returns
    tolerance: float  #: of the comparison with Python, relative to the largest entry of a result
    sensitive: float  #: relative change of a command by one rounding of q, from which the comparison accepts more
    reaching: ReachingRules  #: of the descent to the nearest x

    @property
    def size(self) -> int:
        """Bytes of a number."""
        return ctypes.sizeof(self.c_type)

    def round(self, values: Array) -> Array:
        """The nearest numbers of this type; those beyond its range become infinite."""
        with np.errstate(over="ignore"):
            return np.asarray(values, dtype=self.scalar).astype(float)

    def next_above(self, values: Array) -> Array:
        """The next larger numbers of this type."""
        return np.nextafter(values.astype(self.scalar), self.scalar(np.inf)).astype(float)

    def graph(self, controller: Controller) -> ca.Function:
        """The graph of a law, whose guard knows how near to a singularity this type still gives good numbers."""
        if self.smallest_volume == SMALLEST_VOLUME:
            return controller.graph
        return replace_smallest_volume(controller.graph, self.smallest_volume)

    def translate(self, text: str) -> str:
        """C code that was written in double, in this type. Comments, strings and integers stay as they are."""
        return text if self is DOUBLE else _TOKEN.sub(_make_single, text)

    def describe(self) -> dict[str, Any]:
        """Values of the templates that depend on the type."""
        names = ("largest", "smallest", "farthest", "rounding", "solved", "exact", "coarse", "pivot", "checked")
        rules = {name: _EXPONENT.sub(r"e\1", f"{getattr(self, name):.0e}") for name in names}
        return {"number": self.c_name, "single": self is SINGLE, "reaching": self.reaching, **rules}


DOUBLE = Precision(
    c_name="double",
    scalar=np.float64,
    c_type=ctypes.c_double,
    smallest_volume=SMALLEST_VOLUME,
    largest=LARGEST,
    smallest=1e-300,
    farthest=1e6,
    rounding=1e-12,
    solved=1e-10,
    exact=1e-14,
    coarse=1e-5,
    pivot=1e-12,
    checked=1e-9,
    tolerance=1e-10,
    sensitive=1e-12,
    reaching=RULES,
)
SINGLE = Precision(
    c_name="float",
    scalar=np.float32,
    c_type=ctypes.c_float,
    smallest_volume=0.03,
    largest=1e15,
    smallest=1e-30,
    farthest=1e3,
    rounding=3e-7,
    solved=1e-5,
    exact=1e-6,
    coarse=0.1,
    pivot=1e-6,
    checked=1e-4,
    tolerance=1e-3,
    sensitive=1e-5,
    reaching=replace(RULES, least_damping=1e-5, converged=1e-7, room=1e-4, still=1e-6),
)


def _make_single(token: re.Match[str]) -> str:
    if token["call"] in _MATHEMATICS:
        return f"{token['call']}f"
    if token["literal"] is not None:
        value = float(token["literal"])
        return f"{np.float32(SINGLE.largest if value > _RANGE else value)!s}f".replace("e+", "e")
    return SINGLE.c_name if token["word"] == DOUBLE.c_name else token[0]


def find_bounds_inside(domain: Domain, precision: Precision) -> tuple[Array, Array]:
    """Lower and upper bounds in a precision, (n,) each, that belong to the domain in Python and in C."""
    centre, largest, bounds = precision.round(domain.centre), domain.reach, []
    for boundary in domain.bounds:
        bound = precision.round(boundary)
        # Joints that Python or C finds outside move inwards, one number after the other.
        while True:
            in_c = precision.round(abs(bound - centre))
            beyond = (abs(bound - domain.centre) > largest) | (in_c > precision.round(largest))
            if not beyond.any():
                break
            inwards = np.nextafter(bound.astype(precision.scalar), centre.astype(precision.scalar))
            bound = np.where(beyond, inwards, bound)
        bounds.append(bound)
    return bounds[0], bounds[1]
