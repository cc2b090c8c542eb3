"""phi of many joint positions in C: loops for vector instructions."""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from orthocas.bases.family import LinearFamily
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.codegen.description import filled, numbers
from orthocas.codegen.kernels import POWER
from orthocas.codegen.precision import DOUBLE, Precision
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array
from orthocas.tools.expressions import ARITHMETIC, expand_scalars, write_tape

_LANES = 8  # rows side by side: a line of the cache for each number
_LOCALS = 4096  # bytes of stack for other variables
_MOST = 20_000  # operations; beyond, compilers take minutes
_OF_THE_LIBRARY = """#define lane_sin(x) sin(x)
#define lane_cos(x) cos(x)"""


_OPERATIONS = {
    **ARITHMETIC,
    "constpow": "power({0}, {1})",
    "pow": "power({0}, {1})",
    "lt": "{0} < {1} ? 1.0 : 0.0",
    "le": "{0} <= {1} ? 1.0 : 0.0",
    "eq": "{0} == {1} ? 1.0 : 0.0",
    "ne": "{0} != {1} ? 1.0 : 0.0",
    "if_else_zero": "{0} != 0.0 ? {1} : 0.0",
    "not": "{0} == 0.0 ? 1.0 : 0.0",
    "and": "{0} != 0.0 && {1} != 0.0 ? 1.0 : 0.0",
    "or": "{0} != 0.0 || {1} != 0.0 ? 1.0 : 0.0",
    "sign": "{0} > 0.0 ? 1.0 : ({0} < 0.0 ? -1.0 : {0})",
    **{name: f"lane_{name}({{0}})" for name in ("sin", "cos")},
    **{name: f"{name}({{0}})" for name in ("sqrt", "exp", "log", "tan", "asin", "acos", "atan", "sinh", "cosh")},
    **{name: f"{name}({{0}})" for name in ("tanh", "fabs", "floor", "ceil", "log1p", "expm1", "erf")},
    **{name: f"{name}({{0}})" for name in ("asinh", "acosh", "atanh")},
    **{name: f"{name}({{0}}, {{1}})" for name in ("atan2", "hypot", "fmod", "copysign", "fmin", "fmax")},
}


def names_of_files(name: str, rows: bool) -> dict[str, str]:
    """Sources and headers of a library, for CMake."""
    names = [name, f"{name}_rows"] if rows else [name]
    return {"sources": " ".join(f"{file}.c" for file in names), "headers": ";".join(f"{file}.h" for file in names)}


def rows_files(chart: Chart, name: str, values: Mapping[str, str], precision: Precision) -> dict[str, str]:
    """NAME_rows.h and NAME_rows.c, with the values of other templates of the library.

    Raises:
        InvalidValueError: if phi consists of too many operations, as that of large networks.
    """
    direct, places, basis, C, shift = _parts(chart)
    q = direct.sx_in()[0]
    together = ca.Function("rows", [q], [ca.cse(ca.densify(ca.vertcat(direct(q), basis(q))))])
    if together.n_instructions() > _MOST:
        raise InvalidValueError("operations of phi", together.n_instructions(), f"at most {_MOST} for rows of it")
    lines, slots = _written(together)
    sums = len(C)
    arrays = chart.n + len(places) + C.shape[1] + 1 + sums + slots
    others = [k for k in range(chart.n) if k not in places]
    mine = {
        **values,
        "lanes": str(_LANES),
        "direct_count": str(len(places)),
        "basis_count": str(C.shape[1]),
        "sum_count": str(sums),
        "far": "1e5",
        "sines": _sines(lines, precision) + _powers(lines),
        "slots": f"    double {', '.join(f'w{k}' for k in range(slots))};",
        "operations": "\n".join(lines),
        "places": ", ".join(map(str, [*places, *others])),
        "rows_stack": str(_LANES * precision.size * arrays + _LOCALS),
        **_sums(C, shift),
    }
    return {f"{name}_rows.{kind}": precision.code(filled(f"rows.{kind}", mine)) for kind in ("h", "c")}


def _parts(chart: Chart) -> tuple[ca.Function, list[int], ca.Function, Array, Array]:
    """Entries of phi, their places, a basis psi, and coefficients: the other entries are C psi - shift."""
    q, coordinates = ca.SX.sym("q", chart.n), chart.coordinates
    task = chart.problem.task.function(q)
    if isinstance(coordinates, Coordinates) and isinstance(family := _family(coordinates), LinearFamily):
        r, idle = len(coordinates.offset), list(coordinates.idle)
        direct = ca.vertcat(task, q[idle] - ca.DM(coordinates.space.centre[idle]))
        places = [*range(chart.m), *range(chart.m + r, chart.n)]
        C = coordinates.scale[:, None] * coordinates.theta.reshape(r, -1)
        basis = ca.Function("basis", [q], [ca.densify(family.basis(q[coordinates.active]))])
        return ca.Function("direct", [q], [direct]), places, basis, C, coordinates.scale * coordinates.offset
    phi = expand_scalars(chart.function("phi"))
    empty = ca.Function("basis", [q], [ca.SX(0, 1)])
    return ca.Function("direct", [q], [phi(q)]), list(range(chart.n)), empty, np.zeros((0, 0)), np.zeros(0)


def _family(coordinates: Coordinates) -> Any:
    """The fitted family, if there is one that consists of products of tables and not of networks."""
    return None if coordinates.as_matrices or not len(coordinates.offset) else coordinates.family


def _written(function: ca.Function) -> tuple[list[str], int]:
    """The operations of a function as C, and how many variables they need."""
    lines, slots = [], 0
    for name, into, *of in write_tape(function)["steps"]:
        if name == "output":
            lines.append(f"    out[{into} * LANES + l] = w{of[0]};")
            continue
        slots = max(slots, into + 1)
        if name == "const":
            value = numbers(np.array([of[0]]))
        elif name == "input":
            value = f"q[{of[0]} * LANES + l]"
        else:
            value = _OPERATIONS[name].format(*(f"w{place}" for place in of))
        if name in ("sin", "cos"):
            lines.append(f"    far += fabs(w{of[0]}) <= FAR ? 0.0 : 1.0;")
        lines.append(f"    w{into} = {value};")
    return lines, slots


def _sums(C: Array, shift: Array) -> dict[str, str]:
    """The values of the templates that add up C psi - shift."""
    if not len(C):
        return dict.fromkeys(("sums", "sum_array", "add_up", "store_sums"), "")
    table = filled("rows_sums.c", {"table": numbers(C.T.ravel()), "shift": numbers(shift)})
    return {
        "sums": f"\n{table}",
        "sum_array": ", sums[SUMS * LANES]",
        "add_up": "add_up(out + DIRECT * LANES, sums);",
        "store_sums": "for (i = 0; i < SUMS; ++i) row[places[DIRECT + i]] = sums[i * LANES + l];",
    }


def _powers(lines: list[str]) -> str:
    """What stands for `pow`, if it is needed."""
    return f"\n{POWER.replace('NAME', 'power')}" if any(" power(" in line for line in lines) else ""


def _sines(lines: list[str], precision: Precision) -> str:
    """Sine and cosine without branches, if any are needed; in single precision those of the library of C."""
    if not any("lane_" in line for line in lines):
        return ""
    return filled("rows_sines.c", {}) if precision is DOUBLE else _OF_THE_LIBRARY
