"""What C is written from, and the condition of the domain's boundary in C."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.codegen.description import numbers
from orthocas.codegen.precision import Precision
from orthocas.control.controller import Controller
from orthocas.control.safety import Safety
from orthocas.tasks.domains import Domain, PathBound, SingularBound, sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array
from orthocas.tools.expressions import scalar_code

_USUAL = 256  # positions of a domain whose median room to a fold is the usual one


class Source(Protocol):
    """A chart or several ones, as templates see them."""

    @property
    def chart(self) -> Chart:
        """The chart that kernels and sizes are taken from."""
        ...

    @property
    def own_code(self) -> Mapping[str, str]:
        """C bodies by name of the functions that are written by hand; the number of the chart is `mem`."""
        ...

    @property
    def condition(self) -> Domain | None:
        """The condition of the domain beside its box, if there is one."""
        ...

    @property
    def has_nearest(self) -> bool:
        """Whether the library has the function that goes to the nearest x."""
        ...

    @property
    def somewhere(self) -> Array:
        """A position of the domain at which the library checks itself, (n,)."""
        ...

    @property
    def title(self) -> str:
        """What kind of coordinates."""
        ...

    def law(self, controller: Controller) -> Controller:
        """The law on `chart`, for one of the charts; raises InvalidValueError for a law of another chart."""
        ...

    def safety(self, controller: Controller) -> Safety:
        """The default settings of the supervised law."""
        ...

    def law_values(self, controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
        """Values of the placeholders in the templates of laws that depend on the boundary or on the chart."""
        ...

    def graph(self, graph: ca.Function) -> ca.Function:
        """The graph of a law, less the boundary of a domain that C code looks after."""
        ...

    def stack_bytes(self, size: int) -> int:
        """Additional use of the stack by functions of the domain and the charts, with numbers of a size [bytes]."""
        ...

    def values(self, known: Mapping[str, str], precision: Precision) -> dict[str, str]:
        """Values of the placeholders that describe domain and charts, and of the code that belongs to them.

        Args:
            known: values of the other placeholders.
            precision: the number type.
        """
        ...


@dataclass(frozen=True)
class BoundaryCondition:
    """What the supervised law has to know of a condition."""

    templates: tuple[str, ...]  #: code with `clearance(q)`: 0 at the boundary, 1 as far inside as the middle
    meaning: str  #: of that number, for the header
    values: dict[str, str]  #: of the placeholders in the template
    kernels: tuple[ca.Function, ...] = ()
    inwards: str = ""  #: code that brings `inner` inside, before the boundaries of the box do


def boundary_condition(source: Source, controller: Controller) -> BoundaryCondition | None:
    """The condition of the law's domain as a part of its boundary, if it has one."""
    domain = source.condition
    if controller.chart is None or domain is None:
        return None
    if domain.singular_bound is not None:
        return _clear(domain, domain.singular_bound)
    return None if domain.path_bound is None else _near_path(domain.path_bound)


def boundary_units(domain: Domain) -> Any:
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
    kernels = (scalar_code(ca.Function("gram", [q], [clear.gram(q)])),)
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
    folds = scalar_code(ca.Function("room", [q], [room(q)]))
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
