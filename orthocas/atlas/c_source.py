"""Generated C of an atlas, or of a part of it: tables of charts with one code for all."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, log2
from pathlib import Path
from string import Template
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import casadi as ca
import numpy as np

from orthocas.atlas.atlas_file import Turns
from orthocas.atlas.box_fit import clear_part
from orthocas.atlas.lattice import Outcome
from orthocas.charts.chart import Chart
from orthocas.codegen.chart_source import condition_code, position_within
from orthocas.codegen.description import clear_line, filled, numbers, words
from orthocas.codegen.kernels import Kernels, generate_kernels
from orthocas.codegen.library import CompiledLibrary, GeneratedC, compile_shared, compilers, gain_numbers
from orthocas.codegen.precision import DOUBLE, SINGLE, Precision
from orthocas.codegen.proof import Proof
from orthocas.codegen.rows import TABLE_CODE, TableCoordinates
from orthocas.control.controller import Controller, without_boundary
from orthocas.control.memory import memory_of
from orthocas.control.safety import Safety
from orthocas.errors import InvalidValueError, ProofError
from orthocas.tasks.domains import Box, Domain, contains
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.expressions import scalar_code
from orthocas.tools.files import draft_folder

if TYPE_CHECKING:
    from orthocas.atlas.atlas import AtlasPart

_NO_CELL = -1
_BOUNDARY = 1e-12  # of a box, in half-widths, as in `Index.in_boxes`
_PREFIX = "cube_basis"  # of the functions of the polynomials
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
    "boundary_tables": "boundary_tables_of_atlas.c",
    "boundary_c": "boundary_of_atlas.c",
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
_REACH = 1.2  # random positions lie in boxes enlarged by this factor
_LAWS = 5  # charts whose laws are compared; building one takes half a second


@dataclass(frozen=True, eq=False)
class AtlasTables:
    """Tables of a part of an atlas."""

    part: "AtlasPart"

    def values(self) -> dict[str, str]:
        """Values of the placeholders of templates/tables.c.in, without sizes of work arrays."""
        tables = {**self._joints(), **self._tiles(), **self._charts()}
        digest = hashlib.sha256("\n".join(tables.values()).encode()).hexdigest()
        return {**tables, **self._sizes(), "fingerprint": digest}

    @cached_property
    def depth(self) -> int:
        """Most halvings on the way to a cell."""
        return int(self.part.index.stock.records["levels"].sum(axis=1, dtype=int).max())

    @cached_property
    def bytes(self) -> int:
        """Size of the tables."""
        k, active = len(self.part.plan.joints), len(self.part.plan.active)
        tiles, orbits, fits = len(self.tiles), len(self.orbits), len(self.fits)
        terms, fitted = self.part.evaluation.basis.width, self.part.plan.fitted
        of_tiles = tiles * (8 + 4 + 4 + 8 * k + active) + orbits * (8 * k + 8)
        return (
            of_tiles
            + 24 * len(self._cells[0])
            + fits * 8 * (2 * k + fitted * (1 + terms))
            + self._count * (9 * fitted + 4)
        )

    @cached_property
    def tiles(self) -> Indices:
        """Rows of the tiles of the part in `Orbits.tiles`, ascending."""
        return np.unique(self.part.index.rows(self.part.charts)[0])

    @cached_property
    def orbits(self) -> Indices:
        """The fitted tiles, ascending."""
        return np.unique(self.part.index.orbits.fitted[self.tiles])

    @cached_property
    def fits(self) -> Indices:
        """Numbers of the fitted charts, orbit by orbit, in the order in which charts of a tile count."""
        tiles, fitted = self.part.index.rows(self.part.charts)
        orbit = self.part.index.orbits.fitted[tiles]
        found = [list(dict.fromkeys(fitted[orbit == tile].tolist())) for tile in self.orbits.tolist()]
        return np.array([fit for row in found for fit in row], dtype=np.int64)

    @property
    def _count(self) -> int:
        return len(self.part.charts)

    def _sizes(self) -> dict[str, str]:
        plan, overlap = self.part.plan, self.part.plan.settings.overlap
        sizes = {
            "charts": self._count,
            "fits": len(self.fits),
            "tiles": len(self.tiles),
            "orbits": len(self.orbits),
            "divided_count": len(plan.joints),
            "active_count": len(plan.active),
            "fitted_count": plan.fitted,
            "terms": self.part.evaluation.basis.width,
            "cell_count": len(self._cells[0]),
            "table_bytes": self.bytes,
            "depth": self.depth,
            "certified": self.part.certified(self.fits),
            "tile_steps": ceil(log2(len(self.tiles))) if len(self.tiles) > 1 else 0,
            "cells_searched": 1 + 2 * len(plan.joints),
        }
        return {name: str(size) for name, size in sizes.items()} | {
            "boundary": repr(_BOUNDARY),
            "overlap": numbers(overlap * plan.lattice.width / 2),
        }

    def _joints(self) -> dict[str, str]:
        plan, domain, robot = self.part.plan, self.part.plan.problem.domain, self.part.plan.problem.robot
        joints, active = list(plan.joints), list(plan.active)
        cyclic = np.array([joint in plan.cyclic for joint in active])
        idle = [plan.fitted + row for row in range(len(plan.idle))]
        return {
            "divided": _integers(joints),
            "active": _integers(active),
            "row": _integers(active.index(joint) for joint in joints),
            "column": _integers(-1 if joint in plan.cyclic else joints.index(joint) for joint in active),
            "cyclic_centre": numbers(np.where(cyclic, domain.centre[active], 0.0)),
            "cyclic_half_width": numbers(np.where(cyclic, domain.half_width[active], 1.0)),
            "limit_low": numbers(robot.lower[joints]),
            "limit_high": numbers(robot.upper[joints]),
            "lattice_low": numbers(plan.lattice.low),
            "lattice_width": numbers(plan.lattice.width),
            "lattice_count": _integers(plan.lattice.counts),
            "endless": _integers(plan.lattice.endless),
            "idle_values": "".join(
                f"  xi[{row}] = q[{joint}] - {numbers(domain.centre[[joint]])};\n"
                for row, joint in zip(idle, plan.idle, strict=True)
            ),
            "idle_slopes": "".join(
                f"  jacobian[{joint} * R + {row}] = 1.0;\n" for row, joint in zip(idle, plan.idle, strict=True)
            ),
        }

    def _tiles(self) -> dict[str, str]:
        index, plan = self.part.index, self.part.plan
        orbits = index.orbits.fitted[self.tiles]
        charts_of_tile = index.rows(self.part.charts)[0]
        cells, roots = self._cells
        return {
            "tile_number": _integers(index.orbits.tiles[self.tiles]),
            "tile_orbit": _integers(np.searchsorted(self.orbits, orbits)),
            "tile_first": _integers(np.searchsorted(charts_of_tile, self.tiles)),
            "tile_centre": _rows(index.centres[self.tiles]),
            "tile_sign": _rows(plan.maps.signs[index.orbits.maps[self.tiles]].astype(int)),
            "orbit_centre": _rows(plan.lattice.centres(self.orbits)),
            "orbit_root": _integers(roots),
            "orbit_first": _integers(np.searchsorted(self._orbit_of_fits, self.orbits)),
            "cells": ",\n".join(
                f"  {{{threshold!r}, {joint}, {{{low}, {high}}}}}" for threshold, joint, low, high in cells
            ),
        }

    def _charts(self) -> dict[str, str]:
        part, index = self.part, self.part.index
        turns = part.evaluation.turns
        if turns is None:
            count, fitted = index.count, part.plan.fitted
            turns = Turns(np.tile(np.arange(fitted), (count, 1)), np.ones((count, fitted)), np.zeros((count, fitted)))
        own = part.evaluation.numbers(self.fits)
        return {
            "box_centre": _rows(index.box_centres[self.fits]),
            "box_half_width": _rows(index.box_half_widths[self.fits]),
            "coefficients": ",\n".join(f"{{{_rows(table)}}}" for table in own),
            "turns": _rows(((turns.order + 1) * turns.signs)[part.charts].astype(int)),
            "constants": _rows(turns.constants[part.charts]),
            "atlas_charts": _integers(part.charts),
        }

    @cached_property
    def _orbit_of_fits(self) -> Indices:
        stock = self.part.index.stock
        return np.asarray(stock.records["tile"][stock.charts[self.fits]])

    @cached_property
    def _cells(self) -> tuple[list[tuple[float, int, int, int]], list[int]]:
        """Halved cells on the way to the charts of the part, and the cells that are the fitted tiles."""
        cells: list[tuple[float, int, int, int]] = []
        index, records = self.part.index, self.part.index.stock.records
        rank: dict[int, int] = dict(zip(index.stock.charts[self.fits].tolist(), self._ranks, strict=True))

        def place(record: int) -> int:
            """The number of a cell in the table, what stands for its chart, or nothing."""
            if record in rank:
                return -2 - rank[record]
            if record < 0 or records["outcome"][record] != Outcome.SPLIT:
                return _NO_CELL
            halves = [place(int(child)) for child in index.children[record].tolist()]
            if halves == [_NO_CELL, _NO_CELL]:
                return _NO_CELL
            cells.append((float(index.thresholds[record]), int(records["joint"][record]), halves[0], halves[1]))
            return len(cells) - 1

        root_of: dict[int, int] = dict(zip(index.orbits.fitted.tolist(), index.roots.tolist(), strict=True))
        roots = [place(int(root_of[tile])) for tile in self.orbits.tolist()]
        return cells or [(0.0, 0, _NO_CELL, _NO_CELL)], roots

    @property
    def _ranks(self) -> list[int]:
        """Number of each fitted chart in its tile."""
        firsts = np.searchsorted(self._orbit_of_fits, self._orbit_of_fits)
        return [row - int(first) for row, first in enumerate(firsts)]


def region_lines(part: "AtlasPart") -> str:
    """Where the boxes of a part reach, for the header."""
    index, plan = part.index, part.plan
    centres, _ = index.image_centres(part.charts)
    half = index.box_half_widths[index.rows(part.charts)[1]]
    low, high = (centres - half).min(axis=0), (centres + half).max(axis=0)
    names = words(plan.problem.robot.joint_names)
    lines = [
        f" *   {name}: {low[plan.joints.index(i)]:.6g} to {high[plan.joints.index(i)]:.6g}"
        if i in plan.joints
        else f" *   {name}: all positions"
        for i, name in enumerate(names)
    ]
    return "\n".join(lines)


def _integers(values: Iterable[Any]) -> str:
    return ", ".join(str(int(value)) for value in values)


def _rows(table: Array | Sequence[Sequence[int]]) -> str:
    """A matrix in C, column by column."""
    kind = _integers if np.asarray(table).dtype.kind == "i" else numbers
    return ",\n".join(f"{{{kind(row)}}}" for row in np.asarray(table))


@dataclass(frozen=True, eq=False)
class AtlasSource:
    """The charts of a part of an atlas."""

    part: "AtlasPart"
    first: Chart  #: chart 0 in C
    chart: Chart  #: the same, with functions that tables replace
    own_code: ClassVar[Mapping[str, str]] = MappingProxyType(TABLE_CODE)
    title: ClassVar[str] = "atlas"
    has_nearest: ClassVar[bool] = False

    @classmethod
    def of(cls, part: "AtlasPart") -> Self:
        """The source for a part of an atlas."""
        first = part.atlas.chart(int(part.charts[0]))
        return cls(part, first, Chart(first.problem, TableCoordinates(first.coordinates)))

    @cached_property
    def condition(self) -> Domain | None:
        """The condition on singular values, if some of the charts need it."""
        plan = self.part.plan
        if (self.part.clear_shares(self.tables.fits) >= 1).all():
            return None
        domain = self.first.problem.domain
        box = Box(domain.centre, domain.half_width)
        return clear_part(box, plan.problem.task, plan)

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
        if memory_of(controller) is not None:
            raise InvalidValueError("memory", controller.settings["memory"], "none for an atlas")
        found: Controller = replace(law, chart=self.chart)
        return found

    def safety(self, controller: Controller) -> Safety:
        """The default settings, with margins within the overlap of boxes: where charts meet, there is no boundary."""
        room = self._overlap
        return Safety.of(
            controller,
            near_margin=min(0.06, 0.6 * room),
            catch_margin=min(0.01, 0.1 * room),
            return_margin=min(0.1, 0.8 * room),
        )

    def law_values(self, controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
        """The boundary of what charts cover, and the hand-over from chart to chart."""
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
        """The graph without the boundary of the first chart: C code knows which box counts."""
        return without_boundary(graph, self.first.problem.domain.centre)

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
            "nearest_h": "",
            "nearest_c": "",
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


def check_c_of_atlas(
    generated: GeneratedC, part: "AtlasPart", controller: Controller | None = None, states: int = 1000, seed: int = 0
) -> Proof:
    """Compile with gcc and clang (C99, warnings as errors), if installed, and compare with Python.

    Compares the chart found for random positions in and around the boxes, xi and J_xi there, and for some charts phi,
    J, and the law with random references.

    Raises:
        CompileError: if there is no compiler, or compilation fails.
        ProofError: if a result differs by more than 1e-10 of the largest entry (single precision: 1e-3), if C finds a
            chart whose box does not hold the position, or another one than Python.
    """
    precision = SINGLE if generated.single_precision else DOUBLE
    q = precision.rounded(_positions(part, states, seed))
    differences: dict[str, float] = {}
    for compiler in compilers():
        with draft_folder() as folder:
            path = compile_shared(generated, folder, compiler=compiler)
            single, r = generated.single_precision, part.atlas.problem.r
            library = CompiledLibrary(path, generated.name, q.shape[1], single, r)
            found = dict(_compared(library, part, controller, q, seed))
        for name, value in found.items():
            if not value <= precision.tolerance:
                raise ProofError(
                    f"C, compiled by {compiler}, differs from Python by {value:.3g} in {name}, "
                    f"expected at most {precision.tolerance:g} relative"
                )
            differences[name] = max(value, differences.get(name, 0.0))
    return Proof(len(q), tuple(Path(compiler).name for compiler in compilers()), differences)


def _positions(part: "AtlasPart", states: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    boxes = [part.atlas.box(int(part.charts[k])) for k in rng.integers(len(part), size=min(states, 4 * len(part)))]
    rows = [boxes[k % len(boxes)] for k in range(states)]
    n = part.atlas.problem.n
    return np.array([box.centre + _REACH * box.half_width * rng.uniform(-1, 1, n) for box in rows])


def _compared(
    library: CompiledLibrary, part: "AtlasPart", controller: Controller | None, q: Array, seed: int
) -> Iterator[tuple[str, float]]:
    """Largest relative differences by function."""
    yield "check", library.check()
    charts = np.array([library.chart_at(row) for row in q])
    _require_right_charts(part, q, charts)
    q, charts = q[charts >= 0], charts[charts >= 0]
    numbers = part.charts[charts]
    found = [library.xi(*pair) for pair in zip(q, charts.tolist(), strict=True)]
    yield "xi", _difference(np.array([row[0] for row in found]), part.atlas.xi(q, numbers))
    yield "xi_jacobian", _difference(np.array([row[1] for row in found]), part.atlas.jacobian(q, numbers))
    rng = np.random.default_rng(seed)
    rows = np.unique(charts, return_index=True)[1]
    for row in rng.permutation(rows)[:_LAWS].tolist():
        yield from _of_one_chart(library, part, controller, q[row], int(charts[row]), rng)


def _of_one_chart(
    library: CompiledLibrary, part: "AtlasPart", controller: Controller | None, q: Array, number: int, rng: Any
) -> Iterator[tuple[str, float]]:
    chart = part.atlas.chart(int(part.charts[number]), near=q)
    phi, J, _ = library.chart(q, number)
    yield "phi", _difference(phi, chart.phi(q))
    yield "jacobian", _difference(J, chart.jacobian(q))
    if controller is None or not contains(chart.problem.domain, q):
        return
    law: Any = replace(controller, chart=chart)  # type: ignore[type-var]
    dq, velocity, acceleration = library.precision.rounded(rng.normal(size=(3, chart.n)))
    value = library.precision.rounded(chart.phi(q) + 0.01 * rng.normal(size=chart.n))
    wanted, _ = law.function(q, dq, value, velocity, acceleration, *law.gains.values())
    command, _ = library.control(q, dq, np.concatenate([value, velocity, acceleration]), gain_numbers(law), number)
    yield f"control of chart {number}", _difference(command, wanted.full()[:, 0])


def _require_right_charts(part: "AtlasPart", q: Array, charts: Indices) -> None:
    """Raise ProofError unless C finds the charts that Python finds, or others whose boxes hold the positions."""
    wanted = part.atlas.chart_at(q)
    known = np.isin(wanted, part.charts)
    found = np.where(charts >= 0, part.charts[charts], -1)
    different = np.flatnonzero(np.where(known, found != wanted, charts >= 0))
    held = np.zeros(len(q), dtype=bool)
    other = different[charts[different] >= 0]
    held[other] = part.index.in_boxes(q[other][:, list(part.plan.joints)], found[other])
    for row in different[~held[different]].tolist():
        raise ProofError(f"chart_at is {found[row]} at q = {q[row].tolist()}, expected {wanted[row]}")


def _difference(found: Array, wanted: Array) -> float:
    """Largest difference relative to the largest entry; infinite where an entry is not finite."""
    difference = float(np.abs(found - wanted).max() / max(float(np.abs(wanted).max()), 1e-300))
    return difference if np.isfinite(difference) else np.inf
