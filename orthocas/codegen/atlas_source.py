"""Generated C of an atlas, or of a part of it: tables of charts with one code for all (ours)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from string import Template
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import casadi as ca

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.codegen.atlas_tables import AtlasTables, region_lines
from orthocas.codegen.chart_source import condition_code, position_within
from orthocas.codegen.description import clear_line
from orthocas.codegen.filling import filled
from orthocas.codegen.kernels import Kernels, generate_kernels
from orthocas.codegen.precision import Precision
from orthocas.codegen.table_coordinates import TABLE_CODE, TableCoordinates
from orthocas.control import Controller, Safety
from orthocas.control.controller import without_border
from orthocas.domains import Box
from orthocas.errors import InvalidValueError
from orthocas.postures.clear_box import ClearBox

if TYPE_CHECKING:
    from orthocas.atlases.part import AtlasPart

_PREFIX = "cube_basis"  # of the functions of the polynomials


@dataclass(frozen=True, eq=False)
class AtlasSource:
    """The charts of a part of an atlas."""

    part: "AtlasPart"
    first: Chart  #: chart 0 in C
    chart: Chart  #: the same, with functions that tables replace
    own_code: ClassVar[Mapping[str, str]] = MappingProxyType(TABLE_CODE)
    title: ClassVar[str] = "atlas"

    @classmethod
    def of(cls, part: "AtlasPart") -> Self:
        """The source for a part of an atlas."""
        first = part.atlas.chart(int(part.charts[0]))
        return cls(part, first, Chart(first.problem, TableCoordinates(first.coordinates)))

    @cached_property
    def condition(self) -> ClearBox | None:
        """The condition on singular values, if some of the charts need it."""
        plan = self.part.plan
        if (self.part.clear_shares(self.tables.fits) >= 1).all():
            return None
        domain = self.first.problem.domain
        box = Box(domain.centre, domain.half_width)
        return ClearBox(box, plan.problem.task, plan.settings.least_singular_value, plan.scale, rows="x")

    @property
    def somewhere(self) -> Array:
        """A position in the box of the first chart, (n,)."""
        return position_within(self.first.problem.domain)

    @cached_property
    def tables(self) -> AtlasTables:
        """The tables."""
        return AtlasTables(self.part)

    def law(self, controller: Controller) -> Controller:
        """The law with the same settings for whichever chart is the present one."""
        law: Any = controller
        own, problem = self.part.plan.problem, controller.problem
        same = (own.robot, own.task, own.metric) == (problem.robot, problem.task, problem.metric)
        if law.chart is None or law.labels != self.chart.labels or not same:
            raise InvalidValueError("controller", f"a {law.name} of something else", "a law on a chart of the atlas")
        found: Controller = replace(law, chart=self.chart)
        return found

    def safety(self, controller: Controller) -> Safety:
        """The default settings, with margins within the overlap of boxes: where charts meet, there is no border."""
        room = self._overlap
        return Safety.of(
            controller,
            near_margin=min(0.06, 0.6 * room),
            catch_margin=min(0.01, 0.1 * room),
            return_margin=min(0.1, 0.8 * room),
        )

    def law_values(self, controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
        """The border of what charts cover, and the hand-over from chart to chart."""
        values = {place: Template(text).substitute(known) for place, text in _LAW.items()}
        values["enough"] = repr(round(0.99 * self._overlap, 6))
        everything = {**known, **values}
        for place, template in _LAW_PARTS.items():
            values[place] = filled(template, everything)
        return values

    @property
    def _overlap(self) -> float:
        """How far cells are inside their boxes, in half-widths of the boxes."""
        overlap = self.part.plan.settings.overlap
        return overlap / (1 + overlap)

    def graph(self, graph: ca.Function) -> ca.Function:
        """The graph without the border of the first chart: C code knows which box counts."""
        return without_border(graph, self.first.problem.domain.centre)

    def stack_bytes(self, size: int) -> int:
        """Work arrays of the polynomials, of their terms and slopes, and positions on the cube."""
        basis, active = self._basis, len(self.part.plan.active)
        terms = self.part.evaluation.basis.width
        return max(basis.array_bytes(name, size) for name in basis.work) + size * (terms * active + 6 * active)

    def values(self, known: Mapping[str, str], precision: Precision) -> dict[str, str]:
        """The tables, and the number of a chart in every function of the chart."""
        clear = self.condition
        values = {
            **self.tables.values(),
            **self._basis.sizes(),
            "region_lines": region_lines(self.part) + ("" if clear is None else clear_line(clear)),
            "is_clear": "" if clear is None else " && is_clear(q)",
            "and_clear": "" if clear is None else ", and it is clear of singular positions",
            "mem": "chart",
            "which": "int chart, ",
            "that": "chart, ",
            "check_that": "0, ",
            "of_chart": " for chart 0",
            "require_chart": "  if (!known(chart)) return {NAME}_OUTSIDE_DOMAIN;\n".format(**known),
            "dynamics_status": "{NAME}_OK".format(**known),
            "basis": self._basis.code,
            "rn": str(self.chart.r * self.chart.n),
            "domain_c": "",
        }
        everything = {**known, **values}
        values["clear_c"] = everything["clear_c"] = "" if clear is None else condition_code(clear, everything)
        for place, template in _PARTS.items():
            values[place] = filled(template, everything)
        return values

    @cached_property
    def _basis(self) -> Kernels:
        """The polynomials on the cube: values, slopes (row by row), and second derivatives along two directions."""
        basis = self.part.evaluation.basis
        u, v, w = (ca.SX.sym(letter, len(basis.names)) for letter in "uvw")
        psi = ca.densify(basis.family.basis(u))
        slopes = ca.jacobian(psi, u)
        functions = [
            ca.Function("values", [u], [psi]),
            ca.Function("slopes", [u], [ca.densify(slopes.T)]),
            ca.Function("bends", [u, v, w], [ca.densify(ca.jtimes(slopes @ v, u, w))]),
        ]
        return generate_kernels([scalar_code(function) for function in functions], _PREFIX)


_LAW = {  # lines of templates that are empty for a single chart
    "posture_evaluations": "12",  # a few steps of Newton's method from the arm, which is near
    "law_mem": "known(chart) ? chart : 0",
    "law_now": "(state->law[i] + state->carry[i])",
    "middle": "middle",
    "const_reference": "",
    "home": "state->chart, ",
    "no_chart_yet": ", 0",
    "changed": ", changed",
    "other_chart": " || reference->chart != state->chart",
    "reference_chart": "  int chart; /* whose xi these are; ${name}_step changes all with the chart */\n",
    "state_chart": "  int chart;                 /* in use; NO_CHART until there was one */\n"
    "  int hand_overs;            /* from one chart to another */\n",
    "state_carry": "  double carry[$n];          /* what the law of the last chart commanded more; fades */\n",
    "first_chart": "  state->chart = state->reference.chart = ${name}_chart_at(state->q, NO_CHART);\n",
    "choose_chart": "  changed = choose_chart(state, reference, here);\n",
    "carry": "      if (changed && state->mode == ${NAME}_LAW)\n"
    "        state->carry[i] += state->law[i] - (law[i] - fallback[i]);\n",
    "fade_carry": "  for (i = 0; i < N; ++i) state->carry[i] *= LEFT_BEHIND / (LEFT_BEHIND + period);\n",
    "reference_of_chart": "  reference->chart = chart;\n",
}
_LAW_PARTS = {
    "beyond": "beyond.c",
    "border_tables": "border_tables_of_atlas.c",
    "border_c": "border_of_atlas.c",
    "hand_over_h": "hand_over.h",
}
_PARTS = {
    "about_chart": "about_atlas.h",
    "about_md": "about_atlas.md",
    "domain_h": "atlas.h",
    "atlas_functions_h": "atlas_functions.h",
    "tables_c": "tables.c",
    "inside_c": "box_of_chart.c",
}
