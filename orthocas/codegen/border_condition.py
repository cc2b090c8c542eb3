"""Conditions of domains as a part of the border: code that tells how far a position is inside (ours)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.codegen.numbers import numbers
from orthocas.codegen.source import Source
from orthocas.control import Controller
from orthocas.domains import Domain
from orthocas.postures.clear_box import ClearBox
from orthocas.postures.corridor import Corridor


@dataclass(frozen=True)
class BorderCondition:
    """What the supervised law has to know of a condition."""

    template: str  #: code with `clearance(q)`: 0 at the border, 1 as far inside as the middle
    meaning: str  #: of that number, for the header
    values: dict[str, str]  #: of the placeholders in the template
    kernels: tuple[ca.Function, ...] = ()
    inwards: str = ""  #: code that brings `inner` inside, before the borders of the box do


def border_condition(source: Source, controller: Controller) -> BorderCondition | None:
    """The condition of the law's domain as a part of its border, if it has one."""
    condition: Any = source.condition
    make = _MADE.get(type(condition))
    return None if controller.chart is None or make is None else make(condition)


def border_units(domain: Domain) -> Any:
    """What distances to the borders of the box count in, (n,): half-widths, or the radius of a corridor if smaller.

    A path of a corridor ends one radius before the border of its box, which may be many radii wide.
    """
    return np.minimum(domain.half_width, domain.radius) if isinstance(domain, Corridor) else domain.half_width


def _clear(clear: ClearBox) -> BorderCondition:
    span = float(clear.singular_values(clear.centre)) - clear.least_singular_value
    return BorderCondition(
        "clear_border.c",
        "The bound on the relative singular value of the task is a part of the border; its\n"
        " * distance counts in shares of that from the centre.",
        {"clear_bound": repr(clear.least_singular_value), "clear_span": repr(span)},
        (scalar_code(ca.Function("gram", [q := ca.MX.sym("q", len(clear.centre))], [clear.gram(q)])),),
    )


def _near_path(corridor: Corridor) -> BorderCondition:
    starts, axes, squares = corridor.lines
    values = {
        "lines": str(len(squares)),
        "counted": str(len(corridor.counted)),
        "counted_joints": ", ".join(map(str, corridor.counted)),
        "path_radii": numbers(corridor.radius[corridor.counted]),
        "path_starts": _rows(starts),
        "path_axes": _rows(axes),
        "path_lengths": numbers(np.sqrt(squares)),
    }
    return BorderCondition(
        "corridor_border.c",
        "The distance to the path of postures is a part of the border; it counts in radii.",
        values,
        inwards="  towards_path(fmax(share, DEEP), inner);\n",
    )


def _rows(values: Any) -> str:
    return ",\n  ".join(f"{{{numbers(row)}}}" for row in values)


_MADE: dict[type, Callable[[Any], BorderCondition]] = {ClearBox: _clear, Corridor: _near_path}
