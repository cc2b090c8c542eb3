"""The way along the self-motion of a chart within its domain, and the search for the nearest xi, r = 1, in C."""

from __future__ import annotations

import ctypes
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from orthocas.charts.coordinates import Coordinates
from orthocas.charts.curve_tracer import RULES as TRACER
from orthocas.errors import CompileError, InvalidValueError
from orthocas.native import curves
from orthocas.native.kernels import Kernels, generate_kernels
from orthocas.native.libraries import keep_library, load_library, pointer
from orthocas.native.rendering import get_source, render
from orthocas.tools.batch import dense_function, run_in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

# -O3 takes twice as long, and gains a tenth.
_FLAGS = ("-O1",)


@dataclass(frozen=True, slots=True)
class MotionKernelRules:
    """Numbers of the way."""

    points: int = 30_000  #: of a way, at most: with more, Python follows it
    nodes: int = 4000  #: of the curve, after which it counts as endless
    divided: float = 0.95  #: parts of a step between two points, of the spacing that is wanted
    rounding: float = 2e-12  #: of the place of a boundary on a step [rad] or [m]
    piece: int = 64  #: rows that a thread takes at once


RULES = MotionKernelRules()
ENDLESS, SINGULAR, WALL, FOLD = range(4)  #: what ends a way, as in templates/chart_motion.c.jinja


@dataclass(frozen=True, eq=False)
class Way:
    """What C finds from a start in one direction."""

    q: Array  #: (N, n), the start first
    xi: Array  #: (N,)
    length: Array  #: of the way up to each point, (N,)
    stop: int
    beyond: Array  #: a point just beyond the end, (n,), where that is a wall or a fold


@dataclass(frozen=True, eq=False)
class MotionKernel:
    """Follows self-motions of a chart in C, with `runtime/self_motion.c`. Threads may share it."""

    chart: Chart

    def follow(self, q: Array, x: Array, direction: int, folds: bool, spacing: float) -> Way | None:
        """The way from q (n,) inside along which xi rises, 1, or falls, -1; None if it has too many points.

        Args:
            q: the start.
            x: its task value, (m,).
            direction: 1 or -1.
            folds: whether it ends where xi turns back.
            spacing: of points [rad] or [m], at most.
        """
        n, most = len(q), RULES.points
        # Memory that nothing writes to costs nothing.
        room, points = np.empty(RULES.nodes * (2 * n + 1)), np.empty((most, n))
        xi, length, beyond = np.empty(most), np.empty(most), np.full(n, np.nan)
        stop = ctypes.c_int()
        count = self._c.follow_inside(
            *(pointer(q), pointer(x), direction, int(folds), ctypes.c_double(spacing), pointer(room), RULES.nodes),
            *(pointer(points), pointer(xi), pointer(length), most, pointer(beyond), ctypes.byref(stop)),
        )
        if not count:
            return None
        return Way(points[:count].copy(), xi[:count].copy(), length[:count].copy(), stop.value, beyond)

    @cached_property
    def _c(self) -> Any:
        return load_library(keep_library("chart", write_motion(self.chart), _FLAGS))


@dataclass(frozen=True, eq=False)
class SearchKernel:
    """Searches the self-motion curves of many task values of a chart in C, with `runtime/curve_rows.c`.

    Threads may share it.
    """

    chart: Chart
    folder: Path | None = None  #: where its library is kept; None: as `keep_library`

    def search(self, targets: Array, starts: Array, first: int, tolerance: float) -> tuple[Array, Array, Any]:
        """As `SelfMotionCurves.search`, for starts (N, S, n); those after the `first` ones serve unsolved rows.

        Returns:
            Points (N, n), their distances (N,), and whether they are neither solutions nor ends of arcs, (N,).
        """
        count = len(targets)
        q, distance, between = np.empty(targets.shape), np.empty(count), np.empty(count, dtype=np.bool_)
        inputs = np.ascontiguousarray(targets), np.ascontiguousarray(starts)
        most, room = starts.shape[1], self._c.curve_room()

        def search_piece(begin: int) -> None:
            rows = slice(begin, begin + RULES.piece)
            phi, own, *found = (pointer(part[rows]) for part in (*inputs, q, distance, between))
            memory = np.empty(room, dtype=np.uint8)
            sizes = ctypes.c_long(first), ctypes.c_long(most), ctypes.c_double(tolerance)
            self._c.curve_rows(
                ctypes.c_long(min(RULES.piece, count - begin)), phi, own, *sizes, pointer(memory), *found
            )

        run_in_threads(search_piece, range(0, count, RULES.piece))
        return q, distance, between

    def trace(self, target: Array, starts: Array) -> list[tuple[Array, Array]]:
        """Points (P, n) and unit tangents of each curve of a target to which starts (S, n) lead."""
        n, nodes, used = self.chart.n, np.empty((curves.RULES.nodes, 2 * self.chart.n + 1)), ctypes.c_int()
        ends, closed = (np.zeros(curves.RULES.curves, dtype=np.intc) for _ in range(2))
        first = np.ascontiguousarray(starts)
        count = self._c.find_curves(
            *(pointer(np.ascontiguousarray(target)), pointer(first), len(first), len(first)),
            *(pointer(nodes), len(nodes), pointer(ends), pointer(closed), ctypes.byref(used)),
        )
        parts = np.split(nodes[: ends[count - 1]], ends[: count - 1]) if count else []
        return [(part[:, :n], part[:, n : 2 * n]) for part in parts]

    @cached_property
    def _c(self) -> Any:
        library = load_library(keep_library("search", write_search(self.chart), _FLAGS, self.folder))
        library.curve_room.restype, library.curve_rows.restype = ctypes.c_ulong, None
        return library


def has_library(kernel: MotionKernel | SearchKernel) -> bool:
    """Whether a kernel is there, compiled now or earlier: not without a compiler, nor for charts that C does not know.

    C knows fitted coordinates with r = 1, on domains whose condition, if there is one, has an expression.
    """
    chart, domain = kernel.chart, kernel.chart.problem.domain
    known = domain.is_box or domain.known_condition is not None
    if chart.r != 1 or not known or not isinstance(chart.coordinates, Coordinates):
        return False
    try:
        kernel._c  # noqa: B018
    except (CompileError, InvalidValueError):
        return False
    return True


def write_motion(chart: Chart) -> dict[str, str]:
    """Sources of `MotionKernel`, by the names of their files."""
    values = _write_chart(chart) | {"divided": RULES.divided, "rounding": RULES.rounding, "rules": asdict(curves.RULES)}
    return {"chart_motion.c": render("chart_motion.c", values, __package__), **_read_sources()}


def write_search(chart: Chart) -> dict[str, str]:
    """Sources of `SearchKernel`, by the names of their files.

    Raises:
        DomainError: if the domain has a condition, but no expression of it.
    """
    values = _write_chart(chart) | {
        "rules": asdict(curves.RULES) | {"starts": 1 + TRACER.near_phi + TRACER.near_x + TRACER.more},
        "row_rules": asdict(TRACER),
        "xi_size": float(chart.parts.phi_sizes[chart.m]),
        "period": float(chart.parts.turns[chart.m]),
        "winding": chart.parts.boxed.winding,
    }
    source = render("chart_search.c", values, __package__)
    return {"chart_search.c": source, **_read_sources(), "curve_rows.c": get_source("curve_rows.c")}


def _read_sources() -> dict[str, str]:
    return {name: get_source(name) for name in ("self_motion.c", "curve_math.c")}


def _write_chart(chart: Chart) -> dict[str, Any]:
    """What the templates take of a chart."""
    domain, kernels, (low, high) = chart.domain, generate_curve_kernels(chart), chart.domain.bounds
    revolute = ~np.array(chart.problem.robot.tree.prismatic)
    return {
        "kernels": kernels.code,
        "arrays": kernels.declare_arrays,
        "call": kernels.write_call,
        "n": chart.n,
        "low": low,
        "high": high,
        "centre": domain.centre,
        "half_width": domain.half_width,
        "revolute": revolute,
        "endless": np.isinf(low) & revolute,
        "bounded": np.isfinite(low),
        "pivots": kernels.numbers.get("pivots", 0),
    }


def generate_curve_kernels(chart: Chart) -> Kernels:
    """Errors and gradients of the task, xi with its gradient, and the condition of the domain, if it has one."""
    q, x, own, domain = ca.MX.sym("q", chart.n), ca.MX.sym("x", chart.m), chart.coordinates.functions, chart.domain
    functions = [
        dense_function("task", [q, x], chart.parts.tracer.equations.call([q, x])),
        dense_function("xi", [q], [chart.parts.runnable(own["xi"])(q)]),
        dense_function("gradient", [q], [chart.parts.runnable(own["jacobian"])(q)]),
    ]
    if domain.condition is not None:
        functions.append(dense_function("pivots", [q], [domain.condition.pivots(q)]))
    return generate_kernels(functions, "kernel")
