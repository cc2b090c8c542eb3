"""The way along the self-motion of a chart within its domain, r = 1, in compiled C."""

from __future__ import annotations

import ctypes
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from orthocas.charts.coordinates import Coordinates
from orthocas.errors import CompileError, InvalidValueError
from orthocas.native import curves
from orthocas.native.kernels import Kernels, generate_kernels
from orthocas.native.libraries import keep_library, load_library, pointer
from orthocas.native.rendering import get_source, render
from orthocas.tools.batch import dense_function
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


def find_kernel(chart: Chart) -> MotionKernel | None:
    """The kernel of a chart, compiled now or earlier; None without a C compiler, or for charts that C does not know.

    C knows fitted coordinates with r = 1, on domains whose condition, if there is one, has an expression.
    """
    domain = chart.problem.domain
    known = domain.is_box or domain.known_condition is not None
    if chart.r != 1 or not known or not isinstance(chart.coordinates, Coordinates):
        return None
    kernel = MotionKernel(chart)
    try:
        kernel._c  # noqa: B018
    except (CompileError, InvalidValueError):
        return None
    return kernel


def write_motion(chart: Chart) -> dict[str, str]:
    """Sources of `MotionKernel`, by the names of their files."""
    domain, kernels = chart.domain, generate_curve_kernels(chart)
    low, high = domain.bounds
    values = {
        "kernels": kernels.code,
        "arrays": kernels.declare_arrays,
        "call": kernels.write_call,
        "n": chart.n,
        "rules": asdict(curves.RULES),
        "divided": RULES.divided,
        "rounding": RULES.rounding,
        "low": low,
        "high": high,
        "half_width": domain.half_width,
        "turning": np.isinf(low) & ~np.array(chart.problem.robot.tree.prismatic),
        "pivots": kernels.numbers.get("pivots", 0),
    }
    included = {name: get_source(name) for name in ("self_motion.c", "curve_math.c")}
    return {"chart_motion.c": render("chart_motion.c", values, __package__), **included}


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
