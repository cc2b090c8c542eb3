"""Parts of exported modules, as lines of code for NumPy, PyTorch or JAX.

Coordinates are tables of products, networks, or tapes. The inverse needs errors of phi, rates of phi, and numbers that
are positive at accepted solutions.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import casadi as ca
import numpy as np

from orthocas.bases.mlp import MLPFamily, split_layers
from orthocas.bases.products import ProductFamily, Term, split, with_parts
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.inverse import InverseStatus
from orthocas.tasks.domains import Domain, FoldBound
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array
from orthocas.tools.expressions import ARITHMETIC, Tape, write_tape

#: statuses in modules, as in `InverseStatus`
STATUSES = ("FOUND", "NEAREST", "OUTSIDE_DOMAIN", "LIMIT", "NOT_FOUND", "BAD_INPUT")
# Tolerance for rounding at boundaries and joint limits, in half-widths.
_SLACK = 1e-9
# Gradients are equal if they differ by less than this at this many points.
_PARALLEL, _POINTS = 1e-12, 8


@dataclass(frozen=True, eq=False)
class Form:
    """The functions `_xi` and `_xi_jacobian` of columns q (n, N), as a template with its values."""

    template: str  #: name of a file in templates/
    values: Mapping[str, Any]  #: values for the template
    functions: str  #: code of further functions
    tables: Mapping[str, Array]
    indices: Mapping[str, Sequence[int]]


def build_form(chart: Chart) -> Form:
    """The coordinates of a chart in the first form that fits.

    Raises:
        NoExpressionError: if the chart is grown.
    """
    coordinates = chart.coordinates
    if isinstance(coordinates, Coordinates) and len(coordinates.offset):
        # Tables replace many thousand lines of code.
        form = _build_network(coordinates) or _build_products(coordinates)
        if form is not None:
            return form
    # Otherwise, write xi and its Jacobian operation by operation.
    q, xi = ca.SX.sym("q", chart.n), chart.function("xi")
    slopes = dense_function("J_xi", [q], [chart.function("jacobian")(q)[chart.m :, :]])
    code = [
        write_function("_xi", "Coordinates, (r, N), of columns q (n, N).", xi),
        write_function("_xi_and_slopes", "Coordinates, then their Jacobian row by row, (r + r n, N).", xi, slopes),
    ]
    return Form("coordinates", {"kind": "expression"}, "\n\n".join(code), {}, {})


def _build_products(coordinates: Coordinates) -> Form | None:
    """xi = C psi + A q + c and J_xi = T psi' + D; None if the coordinates are not such products."""
    family = coordinates.family
    if not isinstance(family, ProductFamily):
        return None
    # Find the products that the coordinates or their derivatives need, level by level.
    slopes = coordinates.scale[:, None, None] * family.derivative_tables(coordinates.theta).transpose(1, 0, 2)
    used = np.flatnonzero(slopes[:, :, 1:].any(axis=(0, 1)))
    plan = TermLevels.of(family.terms, [family.terms[k] for k in used])
    rows = {term: k for k, term in enumerate(family.terms)}
    # The family may lack a term for a factor of its terms.
    if not set(plan.levels[0]) <= set(rows):
        return None
    q = ca.SX.sym("q", coordinates.space.n)
    functions = family.basis(q[coordinates.active])[[rows[term] for term in plan.levels[0]]]
    code = write_function("_one_joint", "Functions of one joint each, (k, N).", dense_function("f", [q], [functions]))

    # C (r, terms), A (r, n) and c (r, 1).
    r, n, fitted, active = coordinates.r, coordinates.space.n, len(coordinates.offset), coordinates.active
    A, c = _split_idle(coordinates)
    C, theta = np.zeros((r, len(plan.terms))), coordinates.theta.reshape(fitted, -1)
    for k, term in enumerate(plan.terms):
        if term in rows:
            C[:fitted, k] = coordinates.scale * theta[:, rows[term]]
    c[:fitted] = -coordinates.scale[:, None] * coordinates.offset[:, None]

    # T (r n, terms of derivatives) and D (r, n, 1), from the slopes (fitted, active, 1 + K).
    lower = [term for term in plan.terms if term in plan.lower]
    T, D = np.zeros((r, n, len(lower))), A.copy()
    for k, term in enumerate(lower):
        if term in rows:
            T[:fitted, active, k] = slopes[:, :, 1 + rows[term]]
    D[:fitted, active] = slopes[:, :, 0]
    tables = {"C": C, "A": A, "c": c, "T": T.reshape(r * n, -1), "D": D[:, :, None]}
    return Form("coordinates", {"kind": "products", **plan.counts}, code, tables, plan.indices)


@dataclass(frozen=True)
class TermLevels:
    """Terms by number of factors. Each is a term of the previous level times its last factor.

    In every level, the terms that derivatives need come first.
    """

    levels: list[list[Term]]
    lower: set[Term]  #: terms that derivatives need

    @classmethod
    def of(cls, terms: Iterable[Term], of_derivatives: Iterable[Term]) -> Self:
        """The levels of these terms and of the shorter products that they contain."""
        # A term is computed from its leading products, so collect these too.
        every, lower = with_parts(terms), with_parts(of_derivatives)
        every |= {_split_term(term)[1] for term in every}
        lower = lower or {min(term for term in every if np.count_nonzero(term) == 1)}
        ordered = sorted(every, key=lambda term: (term not in lower, term))
        most = max(np.count_nonzero(term) for term in every)
        return cls([[term for term in ordered if np.count_nonzero(term) == k + 1] for k in range(most)], lower)

    @property
    def terms(self) -> list[Term]:
        """All terms in the order of the code."""
        return [term for level in self.levels for term in level]

    @property
    def counts(self) -> dict[str, str]:
        """Number of terms of each level, and number of those that derivatives need, as Python code."""
        lower = [sum(term in self.lower for term in level) for level in self.levels]
        return {"all": _write_tuple(map(len, self.levels)), "lower": _write_tuple(count for count in lower if count)}

    @property
    def indices(self) -> dict[str, list[int]]:
        """For the terms of each level: rows of the previous level, and rows of one-joint functions."""
        result: dict[str, list[int]] = {}
        functions = {term: k for k, term in enumerate(self.levels[0])}
        for k, (before, level) in enumerate(pairwise(self.levels), start=1):
            rows = {term: row for row, term in enumerate(before)}
            split = [_split_term(term) for term in level]
            result[f"parents_{k}"] = [rows[rest] for rest, _ in split]
            result[f"factors_{k}"] = [functions[alone] for _, alone in split]
        return result


def _split_term(term: Term) -> tuple[Term, Term]:
    """A term without its last factor, and that factor as a term."""
    rest, joint, index = split(term)
    return rest, tuple(index if k == joint else 0 for k in range(len(term)))


def _split_idle(coordinates: Coordinates) -> tuple[Array, Array]:
    """A (r, n) and c (r, 1) with A q + c = q - centre for idle joints, and 0 for the other coordinates."""
    r, n, idle = coordinates.r, coordinates.space.n, list(coordinates.idle)
    A, c = np.zeros((r, n)), np.zeros((r, 1))
    A[r - len(idle) :] = np.eye(n)[idle]
    c[r - len(idle) :, 0] = -coordinates.space.centre[idle]
    return A, c


def _write_tuple(values: Iterable[int]) -> str:
    return f"({', '.join(map(str, values))},)"


def _build_network(coordinates: Coordinates) -> Form | None:
    """xi = W_out a(... a(W_0 u + b_0) ...) + A q + c; None if the coordinates are not a network."""
    family = coordinates.family
    if not isinstance(family, MLPFamily):
        return None
    # Include scale and offset of the coordinates in the last layer; idle joints are added separately.
    scale, fitted, depth = coordinates.scale[:, None], len(coordinates.offset), len(family.hidden)
    weights, biases = split_layers(coordinates.theta, family.widths)
    active = np.array(coordinates.active, dtype=int)
    A, c = _split_idle(coordinates)
    A[:fitted, active[list(family.linear)]] = scale * family.split_slopes(coordinates.theta)
    W_out = np.zeros((coordinates.r, family.hidden[-1]))
    W_out[:fitted] = scale * weights[depth].T
    c[:fitted] = scale * (biases[depth] - coordinates.offset)[:, None]
    turning, sliding = active[family.turning], active[family.direct]
    # Joints that are no inputs of the network.
    idle = np.setdiff1d(np.arange(coordinates.space.n), [*turning, *sliding])
    indices = {"turning": turning, "sliding": sliding, "idle": idle}
    indices["order"] = np.argsort(np.concatenate(list(indices.values())))
    tables = {"W_out": W_out, "A": A, "c": c}
    for k in range(depth):
        tables |= {f"W_{k}": weights[k].T, f"b_{k}": biases[k][:, None]}
    plain = {name: [int(k) for k in of] for name, of in indices.items()}
    return Form("coordinates", {"kind": "network", "depth": depth, "activation": family.activation}, "", tables, plain)


def write_statuses() -> str:
    """The numbers of the statuses as Python code."""
    return ", ".join(str(int(InverseStatus[name])) for name in STATUSES)


def build_inverse_forms(chart: Chart) -> list[Form]:
    """The functions `_inverse` of columns phi and q_start (2 n, N), and `_nearest` of columns q_wish and x (n + m, N).

    The list also has the functions that these call in addition to those of phi.
    """
    domain, rooms = chart.problem.domain, _count_rooms(chart.problem.domain)
    nearest = {
        "range": np.array(domain.bounds)[:, :, None],
        "half_width": domain.half_width[:, None],
        "identity": np.eye(chart.n + rooms),
    }
    return [_build_newton(chart), *_build_rooms(chart), Form("nearest", {"rooms": rooms}, "", nearest, {})]


def _build_newton(chart: Chart) -> Form:
    """Newton's method with errors and rates as in `chart.solve`."""
    problem, n = chart.problem, chart.n
    domain, robot = problem.domain, problem.robot
    slack = _SLACK * domain.half_width
    low, high = domain.bounds
    bounds = np.array([low - slack, high + slack, robot.lower - slack, robot.upper + slack])
    target, value = ca.SX.sym("target", n), ca.SX.sym("value", n)
    difference = chart.parts.phi_map.difference(target, value)
    functions = [
        write_function(
            "_difference",
            "Targets less values of phi by the shorter way around, (n, N), of both in columns (2 n, N).",
            dense_function("f", [ca.vertcat(target, value)], [difference]),
        )
    ]
    # For a whole orientation, use the angular velocity instead of derivatives of its components.
    rates = "_task_and_slopes"
    if chart.parts.relative.turned:
        summary = "Task values, then how fast they move, angular velocities in the tip's axes, (m + m n, N)."
        rates = "_task_and_rates"
        functions.append(write_function(rates, summary, problem.task.function, chart.parts.relative.rates))
    tables = {"centre": domain.centre[:, None], "sizes": chart.parts.phi_sizes[:, None], "bounds": bounds[:, :, None]}
    return Form("inverse", {"rates": rates, "turns": chart.parts.relative.turns}, "\n\n".join(functions), tables, {})


def _count_rooms(domain: Domain) -> int:
    """Number of conditions of a domain in addition to its box."""
    if domain.singular_bound is not None:
        return 1 if domain.fold_bound is None else 2
    if domain.path_bound is not None:
        return 1
    return 0 if domain.condition is None else int(domain.condition.pivots.size1_out(0))


def _build_rooms(chart: Chart) -> list[Form]:
    """The function `_room` of columns q (n, N) -> (rooms, N): positive where the domain's conditions hold."""
    domain = chart.problem.domain
    # Bounds on singular values and, if there are any, on folds.
    if (bound := domain.singular_bound) is not None:
        fold = domain.fold_bound
        summary = "Rows that must not be singular, one by one, (m n, N)."
        rows = write_function("_frame_rows", summary, bound.jacobian_function)
        values = {"kind": "clear", "squared_bound": bound.least_singular_value**2, "folds": fold is not None}
        tables = {"row_scale": bound.scale[:, None], "unit": np.eye(chart.m)}
        return [Form("room", values, rows, tables, {}), *([] if fold is None else [_build_room_to_fold(chart, fold)])]
    # Distance to the path of a corridor.
    if (path := domain.path_bound) is not None:
        starts, axes, squares = path.lines
        tables = {
            "path_radius": path.radius[path.counted][:, None],
            "path_starts": starts[:, :, None],
            "path_axes": axes[:, :, None],
            "path_lengths": np.sqrt(squares)[:, None],
        }
        return [Form("room", {"kind": "path"}, "", tables, {"path_joints": path.counted.tolist()})]
    # Other conditions use their expression; boxes have none.
    if domain.condition is None:
        return [Form("room", {"kind": "box"}, "", {}, {})]
    summary = "Numbers (k, N) that are positive at columns q that meet the condition of the domain."
    return [Form("room", {"kind": "condition"}, write_function("_pivots", summary, domain.condition.pivots), {}, {})]


def _build_room_to_fold(chart: Chart, fold: FoldBound) -> Form:
    """The volume of the domain's coordinates, from the chart's gradients if they agree."""
    # Gradients may differ by positive factors.
    points = sample_uniform(chart.problem.domain, _POINTS, 0)
    theirs = np.array([np.array(fold.gradients(q)) for q in points])
    own = chart.coordinates.jacobian(points)
    units = [rows / np.linalg.norm(rows, axis=2, keepdims=True) for rows in (theirs, own)]
    same = bool(np.abs(units[0] - units[1]).max() < _PARALLEL)
    # If the gradients agree, no further code is needed.
    values = {
        "kind": "fold",
        "least_volume": fold.least_volume,
        "orientation": fold.orientation,
        "own_gradients": not same,
    }
    summary = "Gradients of the domain's coordinates, (r n, N)."
    return Form("room", values, "" if same else write_function("_own_gradients", summary, fold.gradients), {}, {})


def write_function(name: str, summary: str, *functions: ca.Function) -> str:
    """A Python function of columns q (n, N) that returns the entries of dense SX functions, row by row, (k, N)."""
    # Use one tape for all functions, so that shared values are computed once.
    q = ca.SX.sym("q", functions[0].size_in(0)[0])
    rows = ca.vertcat(*(ca.vec(ca.densify(function(q)).T) for function in functions))
    lines = _write_tape(write_tape(ca.Function("rows", [q], [ca.cse(rows)])))
    body = "\n".join(f"    {line}" for line in lines)
    return f'def {name}(q):\n    """{summary}"""\n{body}\n'


def _write_tape(tape: Tape) -> list[str]:
    """The code lines that compute a tape's output from columns q (n, N), and return it as (k, N)."""
    steps, lines = tape["steps"], list[str]()
    # Count how often each result is an operand of later steps.
    uses, writer = [0] * len(steps), dict[int, int]()
    for k, (name, into, *of) in enumerate(steps):
        for slot in () if name in ("const", "input") else of:
            uses[writer[slot]] += 1
        if name != "output":
            writer[into] = k
    # Constants are written inline; results with several uses get a variable.
    constants: dict[int, str] = {}
    results: dict[int, str] = {}
    for (name, into, *of), count in zip(steps, uses, strict=True):
        if name == "const":
            # Write the number exactly, in brackets if it is negative.
            value = float(of[0])
            word = f'float("{value}")' if np.isinf(value) else repr(value)
            constants[into] = word if value >= 0 or np.isinf(value) else f"({word})"
        elif name == "output":
            results[into] = f"y{into}"
            lines.append(f"y{into} = {_write_array(of[0], constants)}")
        else:
            text = f"q[{of[0]}]" if name == "input" else _write_operation(name, of, constants)
            constants.pop(into, None)
            lines.append(f"w{into} = _shared({text}, q)" if count > 1 and name != "input" else f"w{into} = {text}")
    return [*lines, f"return np.stack([{', '.join(results[k] for k in range(len(results)))}])"]


_OPERATORS = {**ARITHMETIC, "pow": "{0} ** {1}", "constpow": "{0} ** {1}"}
_CONDITIONS = {
    "not": "{0} == 0",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
    "and": "({0} != 0) & ({1} != 0)",
    "or": "({0} != 0) | ({1} != 0)",
}

# Names of functions in NumPy, which PyTorch and JAX share.
_FUNCTIONS = {
    name: name
    for name in (
        *("exp", "log", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "floor", "ceil", "log1p", "expm1"),
        *("sign", "hypot", "fmod", "copysign", "fmin", "fmax"),
    )
} | {
    "asin": "arcsin",
    "acos": "arccos",
    "atan": "arctan",
    "asinh": "arcsinh",
    "acosh": "arccosh",
    "atanh": "arctanh",
    "atan2": "arctan2",
    "fabs": "abs",
}


def _write_operation(name: str, of: list[Any], constants: dict[int, str]) -> str:
    """Code of one operation on work slots."""
    if name in _OPERATORS:
        return _OPERATORS[name].format(*(constants.get(slot, f"w{slot}") for slot in of))
    words = [_write_array(slot, constants) for slot in of]
    if name in _CONDITIONS:
        return f"({_CONDITIONS[name].format(*words)}) * np.ones_like(q[0])"
    if name == "if_else_zero":
        return f"np.where({words[0]} != 0, {words[1]}, np.zeros_like(q[0]))"
    return f"_erf({words[0]})" if name == "erf" else f"np.{_FUNCTIONS[name]}({', '.join(words)})"


def _write_array(slot: int, constants: dict[int, str]) -> str:
    """The value in a work slot as an array, for functions that accept only arrays."""
    return f"np.full_like(q[0], {constants[slot]})" if slot in constants else f"w{slot}"
