"""phi of many joint positions in C: loops for vector instructions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.bases.family import LinearFamily
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.codegen.kernels import write_power
from orthocas.codegen.rendering import Precision, render, write_number
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array
from orthocas.tools.expressions import ARITHMETIC, expand_scalars, write_tape


@dataclass(frozen=True, slots=True)
class RowRules:
    """Numbers of rows of phi."""

    lanes: int = 8  #: rows side by side: a line of the cache for each number
    locals_bytes: int = 4096  #: of stack for other variables
    most_operations: int = 20_000  #: beyond, compilers take minutes
    far: str = "1e5"  #: sine and cosine of larger numbers are left to the library of C [rad]


RULES = RowRules()

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


def render_rows(chart: Chart, values: Mapping[str, Any], precision: Precision) -> dict[str, str]:
    """NAME_rows.h and NAME_rows.c, with the values of other templates of the library.

    Raises:
        InvalidValueError: if phi consists of too many operations, as that of large networks.
    """
    direct, places, basis, C, shift = _split_phi(chart)
    q = direct.sx_in()[0]
    together = ca.Function("rows", [q], [ca.cse(ca.densify(ca.vertcat(direct(q), basis(q))))])
    if together.n_instructions() > RULES.most_operations:
        most = f"at most {RULES.most_operations} for rows of it"
        raise InvalidValueError("operations of phi", together.n_instructions(), most)
    operations, slots = _write_operations(together)
    # Numbers on the stack for each lane: q, entries of phi and the basis, sums, and slots.
    arrays = chart.n + len(places) + C.shape[1] + 1 + len(C) + slots
    values = {
        **values,
        "lanes": RULES.lanes,
        "direct_count": len(places),
        "basis_count": C.shape[1],
        "sum_count": len(C),
        "far": RULES.far,
        "sines": any("lane_" in line for line in operations),
        "powers": any(" power(" in line for line in operations),
        "power": write_power("power"),
        "slots": slots,
        "operations": operations,
        "places": [*places, *(k for k in range(chart.n) if k not in places)],
        "table": C.T,
        "shift": shift,
        "rows_stack": RULES.lanes * precision.size * arrays + RULES.locals_bytes,
    }
    files = {f"{values['name']}_rows.{kind}": render(f"rows.{kind}", values) for kind in ("h", "c")}
    return {file: precision.translate(text) for file, text in files.items()}


def _split_phi(chart: Chart) -> tuple[ca.Function, list[int], ca.Function, Array, Array]:
    """Entries of phi, their places, a basis psi, and coefficients: the other entries are C psi - shift."""
    # Coordinates that are sums of basis functions: these functions once, then a table.
    q, coordinates = ca.SX.sym("q", chart.n), chart.coordinates
    task = chart.problem.task.function(q)
    fitted = coordinates if isinstance(coordinates, Coordinates) and len(coordinates.offset) else None
    if fitted is not None and not fitted.as_matrices and isinstance(family := fitted.family, LinearFamily):
        r, idle = len(fitted.offset), list(fitted.idle)
        direct = ca.vertcat(task, q[idle] - ca.DM(fitted.space.centre[idle]))
        places = [*range(chart.m), *range(chart.m + r, chart.n)]
        C = fitted.scale[:, None] * fitted.theta.reshape(r, -1)
        basis = ca.Function("basis", [q], [ca.densify(family.basis(q[fitted.active]))])
        return ca.Function("direct", [q], [direct]), places, basis, C, fitted.scale * fitted.offset
    # All others entry by entry.
    phi = expand_scalars(chart.function("phi"))
    empty = ca.Function("basis", [q], [ca.SX(0, 1)])
    return ca.Function("direct", [q], [phi(q)]), list(range(chart.n)), empty, np.zeros((0, 0)), np.zeros(0)


def _write_operations(function: ca.Function) -> tuple[list[str], int]:
    """The operations of a function as C, and how many variables they need."""
    lines, slots = [], 0
    for name, into, *of in write_tape(function)["steps"]:
        if name == "output":
            lines.append(f"out[{into} * LANES + l] = w{of[0]};")
            continue
        slots = max(slots, into + 1)
        if name == "const":
            value = write_number(float(of[0]))
        elif name == "input":
            value = f"q[{of[0]} * LANES + l]"
        else:
            value = _OPERATIONS[name].format(*(f"w{place}" for place in of))
        # Each lane counts arguments that are too large for its own sine.
        if name in ("sin", "cos"):
            lines.append(f"far += fabs(w{of[0]}) <= FAR ? 0.0 : 1.0;")
        lines.append(f"w{into} = {value};")
    return lines, slots
