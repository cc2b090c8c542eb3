"""The domain of a chart in C: its bounds, its condition, and how far a position is inside."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.codegen.description import chart_values, filled, flags, numbers, words
from orthocas.codegen.precision import Precision, bounds_inside
from orthocas.control.controller import Controller
from orthocas.tasks.domains import Domain, PathBound, SingularBound
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array
from orthocas.tools.expressions import expand_scalars

_USUAL = 256  # positions of a domain whose median room to a fold is the usual one


@dataclass(frozen=True)
class BoundaryCondition:
    """What the supervised law has to know of a condition."""

    templates: tuple[str, ...]  #: code with `clearance(q)`: 0 at the boundary, 1 as far inside as the middle
    meaning: str  #: of that number, for the header
    values: dict[str, str]  #: of the placeholders in the template
    kernels: tuple[ca.Function, ...] = ()
    inwards: str = ""  #: code that brings `inner` inside, before the boundaries of the box do


def condition_of(chart: Chart) -> Domain | None:
    """The domain of a chart, if it has a condition beside its box.

    Raises:
        DomainError: if that condition has no form in C.
    """
    domain = chart.problem.domain
    domain.require_bounds("form in C")
    return None if domain.is_box else domain


def position_within(domain: Domain) -> Array:
    """A joint position of a domain between its centre and a corner, (n,); of a corridor one on the path."""
    near = domain.path_bound
    if near is not None:
        inside = near.postures[near.contains(near.postures)]
        return np.asarray(inside[len(inside) // 2])
    shares = [0.5**k for k in range(1, 20) if domain.contains(domain.centre + 0.5**k * domain.half_width)]
    return np.round(domain.centre + (shares[0] if shares else 0.0) * domain.half_width, 3)


def domain_values(chart: Chart, known: Mapping[str, str], precision: Precision) -> dict[str, str]:
    """Values of the placeholders that describe the domain, and of the code that belongs to it.

    Args:
        chart: the chart.
        known: values of the other placeholders.
        precision: the number type.
    """
    domain, condition = chart.problem.domain, condition_of(chart)
    lowest, highest = bounds_inside(domain, precision)
    values = {
        **chart_values(chart),
        "domain_lower": numbers(lowest),
        "domain_upper": numbers(highest),
        "domain_centre": numbers(domain.centre),
        "domain_reach": numbers(domain.reach),
        "is_clear": "1" if condition is None else "is_clear(q)",
        "clear_c": "" if condition is None else _condition_code(condition, known),
    }
    rules = {name: repr(number) for name, number in asdict(precision.reaching).items()}
    rooms = max(1, chart.reaching.size1_out(2))
    size = {"rooms": str(rooms), "m": str(chart.m), "domain_width": numbers(domain.half_width)}
    filled_in = {**known, **values, **size, **rules}
    return values | {f"nearest_{kind}": filled(f"nearest.{kind}", filled_in) for kind in ("h", "c")}


def _condition_code(domain: Domain, values: Mapping[str, str]) -> str:
    """The test of the condition of a domain that has one."""
    known = domain.condition
    assert known is not None
    condition = {"pivots": str(known.pivots.size1_out(0)), "condition": "\n * ".join(words([known.heading]))}
    return filled("clear.c", {**values, **condition})


def bound_values(controller: Controller) -> dict[str, str]:
    """The boundary of the box, which is none for laws without a chart."""
    domain = controller.problem.domain
    lower, upper = domain.bounds
    bounded = np.isfinite(lower) & np.isfinite(upper) & (controller.chart is not None)
    return {
        "domain_half_width": numbers(domain.half_width),
        "boundary_unit": numbers(_boundary_units(domain)),
        "bounded": flags(bounded),
    }


def boundary_condition(controller: Controller) -> BoundaryCondition | None:
    """The condition of the law's domain as a part of its boundary, if it has one."""
    domain = None if controller.chart is None else condition_of(controller.chart)
    if domain is None:
        return None
    if domain.singular_bound is not None:
        return _clear(domain, domain.singular_bound)
    return None if domain.path_bound is None else _near_path(domain.path_bound)


def _boundary_units(domain: Domain) -> Any:
    """What distances to the boundaries of the box count in, (n,): half-widths, or the radius of a corridor if smaller.

    A path of a corridor ends one radius before the boundary of its box, which may be many radii wide.
    """
    near = domain.path_bound
    return domain.half_width if near is None else np.minimum(domain.half_width, near.radius)


def _clear(domain: Domain, clear: SingularBound) -> BoundaryCondition:
    span = float(clear.singular_values(clear.centre)) - clear.least_singular_value
    meaning = (
        "The bound on the relative singular value of the task is a part of the boundary; its\n"
        " * distance counts in shares of that from the centre."
    )
    words = {"clear_bound": repr(clear.least_singular_value), "clear_span": repr(span)}
    q = ca.MX.sym("q", len(clear.centre))
    kernels = (expand_scalars(ca.Function("gram", [q], [clear.gram(q)])),)
    room = domain.room_to_fold
    if room is None:
        words |= dict.fromkeys(("least_of", "end_of_least", "or_volume"), "")
        return BoundaryCondition(("clear_boundary.c",), meaning, words, kernels)
    usual = float(np.median(Batched(room)(sample_uniform(domain, _USUAL, 0))[0]))  # the centre may be near the bound
    words |= {
        "least_of": "fmin(room_to_fold(q), ",
        "end_of_least": ")",
        "or_volume": ";\n * or the room to a fold, if that is less",
        "fold_span": repr(usual),
    }
    meaning += " So is\n * the bound on the volume of the coordinates, in shares of the median."
    folds = expand_scalars(ca.Function("room", [q], [room(q)]))
    return BoundaryCondition(("fold_boundary.c", "clear_boundary.c"), meaning, words, (*kernels, folds))


def _near_path(corridor: PathBound) -> BoundaryCondition:
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
    return BoundaryCondition(
        ("corridor_boundary.c",),
        "The distance to the path of postures is a part of the boundary; it counts in radii.",
        values,
        inwards="  towards_path(fmax(share, DEEP), inner);\n",
    )


def _rows(values: Any) -> str:
    return ",\n  ".join(f"{{{numbers(row)}}}" for row in values)
