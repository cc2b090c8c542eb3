"""Generated C of one chart: its box, and the functions as CasADi writes them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import ClassVar

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.codegen.boundary import boundary_units
from orthocas.codegen.description import chart_values, filled, flags, numbers, words
from orthocas.codegen.precision import Precision, bounds_inside
from orthocas.control.controller import Controller
from orthocas.control.safety import Safety
from orthocas.errors import InvalidValueError
from orthocas.tasks.domains import Domain, bounds_of, contains, reach
from orthocas.tools.checks import Array


@dataclass(frozen=True, eq=False)
class ChartSource:
    """One chart."""

    chart: Chart
    own_code: ClassVar[Mapping[str, str]] = MappingProxyType({})
    title: ClassVar[str] = "chart"
    has_nearest: ClassVar[bool] = True

    @property
    def condition(self) -> Domain | None:
        """The domain, if it has a condition.

        Raises:
            DomainError: if its condition has no form in C.
        """
        domain = self.chart.problem.domain
        domain.require_bounds("form in C")
        return None if domain.is_box else domain

    @property
    def somewhere(self) -> Array:
        """A joint position of the domain between its centre and a corner, (n,)."""
        return position_within(self.chart.problem.domain)

    def law(self, controller: Controller) -> Controller:
        """The law as it is."""
        if (controller.chart or self.chart) is not self.chart or controller.problem is not self.chart.problem:
            raise InvalidValueError("controller", f"a {controller.name} of another chart", "a controller of this chart")
        return controller

    def safety(self, controller: Controller) -> Safety:
        """The default settings of the supervised law."""
        return Safety.of(controller)

    def law_values(self, controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
        """The boundary of the box, which is none for laws without a chart, and nothing about charts."""
        domain = controller.problem.domain
        lower, upper = bounds_of(domain)
        bounded = np.isfinite(lower) & np.isfinite(upper) & (controller.chart is not None)
        values = {
            "domain_half_width": numbers(domain.half_width),
            "boundary_unit": numbers(boundary_units(domain)),
            "bounded": flags(bounded),
            "law_mem": "0",
            "law_now": "state->law[i]",
            "middle": "centre",
            "const_reference": "const ",
            **dict.fromkeys(_OF_CHARTS, ""),
        }
        everything = {**known, **values}
        return {
            **values,
            "boundary_tables": filled("boundary_tables.c", everything),
            "boundary_c": filled("boundary_of_box.c", everything),
        }

    def graph(self, graph: ca.Function) -> ca.Function:
        """The graph as it is."""
        return graph

    def stack_bytes(self, size: int) -> int:
        """None."""
        return 0

    def values(self, known: Mapping[str, str], precision: Precision) -> dict[str, str]:
        """The domain as a box, and no number of a chart in any function."""
        domain = self.chart.problem.domain
        lowest, highest = bounds_inside(domain, precision)
        values = {
            **chart_values(self.chart),
            "domain_lower": numbers(lowest),
            "domain_upper": numbers(highest),
            "domain_centre": numbers(domain.centre),
            "domain_reach": numbers(reach(domain)),
            "is_clear": "1" if self.condition is None else "is_clear(q)",
            "mem": "0",
            "dynamics_status": "inside(q) ? {NAME}_OK : {NAME}_OUTSIDE_DOMAIN".format(**known),
            **dict.fromkeys(
                ("which", "that", "check_that", "require_chart", "tables_c", "atlas_functions_h", "of_chart"), ""
            ),
        }
        everything = {**known, **values}
        values["clear_c"] = "" if self.condition is None else condition_code(self.condition, everything)
        everything["clear_c"] = values["clear_c"]
        rules = {name: repr(number) for name, number in asdict(precision.reaching).items()}
        rooms = max(1, self.chart.reaching.size1_out(2))
        size = {"rooms": str(rooms), "m": str(self.chart.m), "domain_width": numbers(domain.half_width)}
        filled_in = {**everything, **size, **rules}
        values |= {f"nearest_{kind}": filled(f"nearest.{kind}", filled_in) for kind in ("h", "c")}
        for place, template in _PARTS.items():
            values[place] = filled(template, everything)
        return values


def condition_code(domain: Domain, values: Mapping[str, str]) -> str:
    """The test of the condition of a domain that has one."""
    known = domain.condition
    assert known is not None
    condition = {"pivots": str(known.pivots.size1_out(0)), "condition": "\n * ".join(words([known.heading]))}
    return filled("clear.c", {**values, **condition})


def position_within(domain: Domain) -> Array:
    """A joint position of a domain between its centre and a corner, (n,); of a corridor one on the path."""
    near = domain.path_bound
    if near is not None:
        inside = near.postures[near.contains(near.postures)]
        return np.asarray(inside[len(inside) // 2])
    shares = [0.5**k for k in range(1, 20) if contains(domain, domain.centre + 0.5**k * domain.half_width)]
    return np.round(domain.centre + (shares[0] if shares else 0.0) * domain.half_width, 3)


_NUMBERS_OF_CHARTS = ("which", "that", "check_that", "require_chart", "of_chart", "tables_c", "atlas_functions_h")
_OF_CHARTS = (
    *("beyond", "reference_chart", "no_chart_yet", "state_chart", "state_carry", "hand_over_h", "home", "first_chart"),
    *("choose_chart", "carry", "fade_carry", "reference_of_chart", "other_chart", "changed"),
)
_PARTS = {
    "about_chart": "about_box.h",
    "about_md": "about_box.md",
    "domain_h": "box.h",
    "domain_c": "bounds.c",
    "inside_c": "box.c",
}
