"""The search along self-motion curves in compiled C."""

import ctypes
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.charts.curve_tracer import RULES
from orthocas.charts.curves import Nearest, SelfMotionCurves
from orthocas.codegen.compiled import template
from orthocas.codegen.kernels import generate_kernels
from orthocas.codegen.rendering import write_numbers
from orthocas.tools.batch import dense_function, run_in_threads
from orthocas.tools.checks import Array

_PIECE = 64  # rows that a thread takes at once
_STARTS = 1 + RULES.near_phi + RULES.near_x + RULES.more


@dataclass(frozen=True, eq=False)
class CompiledCurves:
    """`SelfMotionCurves.search` in compiled C."""

    curves: SelfMotionCurves
    library: Callable[[], Any]  #: the library with the code of `curve_source`

    def search(self, targets: Array, own: Array, tolerance: float) -> Nearest:
        """The nearest points for targets (N, n) of phi, from stored starts and one of the caller's (N, n)."""
        best, between = Nearest.empty(own), np.zeros(len(own), dtype=np.int8)
        library = self.library()
        library.curve_room.restype, library.curve_rows.restype = ctypes.c_ulong, None
        room = library.curve_room()

        def search_piece(first: int) -> None:
            rows = slice(first, first + _PIECE)
            stages = self.curves.stages(targets[rows], own[rows])
            starts = np.concatenate(stages).transpose(1, 0, 2)
            given = (np.ascontiguousarray(array) for array in (targets[rows], starts))
            arrays = (*given, np.empty(room, dtype=np.uint8), best.q[rows], best.distance[rows], between[rows])
            phi, q_start, *others = (ctypes.c_void_p(array.ctypes.data) for array in arrays)
            counts = ctypes.c_long(len(stages[0])), ctypes.c_long(starts.shape[1])
            library.curve_rows(ctypes.c_long(len(starts)), phi, q_start, *counts, ctypes.c_double(tolerance), *others)

        run_in_threads(search_piece, range(0, len(own), _PIECE))
        best.between[:] = between
        return best


def curve_source(chart: Chart, curves: SelfMotionCurves) -> str:
    """C of the search: kernels, the numbers of the chart and of `CurveRules`, and templates/curve_rows.c.

    Raises:
        DomainError: if the domain has a condition, but no expression of it.
    """
    q, domain = ca.MX.sym("q", chart.n), chart.problem.domain
    x, own = ca.MX.sym("x", chart.m), chart.coordinates.functions
    functions = [
        dense_function("curve_task", [q, x], curves.tracer.equations.call([q, x])),
        *(
            dense_function(f"curve_{name}", [q], [chart.parts.runnable(own[which])(q)])
            for name, which in (("xi", "xi"), ("gradient", "jacobian"))
        ),
    ]
    sizes: dict[str, Any] = {"M": chart.m, "STARTS": _STARTS}
    if domain.condition is not None:
        functions.append(dense_function("curve_pivots", [q], [domain.condition.pivots(q)]))
        sizes["CONDITION"] = functions[-1].numel_out(0)
    kernels, turn = generate_kernels(functions, "kernel"), float(chart.parts.turns[chart.m])
    sizes |= {f"{name}_{word}": size for name, work in kernels.sizes().items() for word, size in work.items()}
    sizes |= {name.upper(): repr(value) for name, value in asdict(RULES).items()}
    sizes["XI_SIZE"] = repr(float(chart.parts.phi_sizes[chart.m]))
    sizes["PERIOD"] = repr(turn) if turn > 0 else "INFINITY"
    low, high = domain.bounds
    arrays = {"low": low, "high": high, "centre": domain.centre, "half_width": domain.half_width}
    lines = [f"#define {name} {value}" for name, value in sizes.items()]
    lines += [f"static const double {name}[N] = {{{write_numbers(values)}}};" for name, values in arrays.items()]
    kinds = {"turning": curves.tracer.turning, "bounded": np.isfinite(low), "winding": curves.boxed.winding}
    lines += [f"static const int {name}[N] = {{{write_numbers(values)}}};" for name, values in kinds.items()]
    head = "#include <math.h>\n#include <stddef.h>\n#include <string.h>"
    return "\n".join([head, kernels.code, *lines, template("curve_rows.c")])
