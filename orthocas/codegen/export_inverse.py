"""The inverse of an exported module: errors of phi, how fast phi moves, and where solutions count as found."""

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.charts.inverse import InverseStatus
from orthocas.codegen.export_forms import Form, write_function
from orthocas.tasks.domains import Domain, FoldBound, PathBound, SingularBound
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array

STATUSES = (
    "FOUND",
    "NEAREST",
    "OUTSIDE_DOMAIN",
    "LIMIT",
    "NOT_FOUND",
    "BAD_INPUT",
)  #: those of `InverseStatus` in modules
_SLACK = 1e-9  # of the half-widths: rounding at boundaries and joint limits
_PARALLEL, _POINTS = 1e-12, 8  # gradients that differ by less count as the same; where they are compared


def statuses() -> str:
    """Their numbers, as Python."""
    return ", ".join(str(int(InverseStatus[name])) for name in STATUSES)


def build_inverse_forms(chart: Chart) -> list[Form]:
    """The functions `_inverse` of columns phi and q_start (2 n, N), and `_nearest` of columns q_wish and x (n + m, N).

    And what they call beside the functions of phi.
    """
    return [_newton(chart), *_condition(chart), _nearest(chart)]


def _newton(chart: Chart) -> Form:
    """Newton's method, with errors and rates as `chart.solve` has them."""
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
    rates = "_task_and_slopes"
    if chart.parts.relative.turned:
        summary = "Task values, then how fast they move, angular velocities in the tip's axes, (m + m n, N)."
        rates = "_task_and_rates"
        functions.append(write_function(rates, summary, problem.task.function, chart.parts.relative.rates))
    tables = {"centre": domain.centre[:, None], "sizes": chart.parts.phi_sizes[:, None], "bounds": bounds[:, :, None]}
    return Form("inverse", {"rates": rates}, "\n\n".join(functions), tables, {})


def _nearest(chart: Chart) -> Form:
    """Steps to the nearest xi, with the box of the domain."""
    domain = chart.problem.domain
    tables = {
        "range": np.array(domain.bounds)[:, :, None],
        "half_width": domain.half_width[:, None],
        "identity": np.eye(chart.n + _rooms(domain)),
    }
    return Form("nearest", {"rooms": _rooms(domain)}, "", tables, {})


def _rooms(domain: Domain) -> int:
    """How many numbers are positive inside a domain, beside the bounds of joints."""
    if domain.singular_bound is not None:
        return 1 if domain.fold_bound is None else 2
    if domain.path_bound is not None:
        return 1
    return 0 if domain.condition is None else int(domain.condition.pivots.size1_out(0))


def _condition(chart: Chart) -> list[Form]:
    """The function `_room` of columns q (n, N) -> (rooms, N), for what a domain asks beside its box."""
    domain = chart.problem.domain
    if domain.singular_bound is not None:
        fold = domain.fold_bound
        return [_clear(chart, domain.singular_bound, fold), *([] if fold is None else [_unfolded(chart, fold)])]
    if domain.path_bound is not None:
        return [_near_path(domain.path_bound)]
    if domain.condition is None:
        return [Form("room", {"kind": "box"}, "", {}, {})]
    summary = "Numbers (k, N) that are positive at columns q that meet the condition of the domain."
    return [Form("room", {"kind": "condition"}, write_function("_pivots", summary, domain.condition.pivots), {}, {})]


def _clear(chart: Chart, clear: SingularBound, fold: FoldBound | None) -> Form:
    own = clear.jacobian_function
    code = write_function("_frame_rows", "Rows that must not be singular, one by one, (m n, N).", own)
    values = {
        "kind": "clear",
        "squared_bound": clear.least_singular_value**2,
        "folds": fold is not None,
    }
    tables = {"row_scale": clear.scale[:, None], "unit": np.eye(chart.m)}
    return Form("room", values, code, tables, {})


def _unfolded(chart: Chart, fold: FoldBound) -> Form:
    same = _same_directions(chart, fold)
    values = {
        "kind": "fold",
        "least_volume": fold.least_volume,
        "orientation": fold.orientation,
        "own_gradients": not same,
    }
    if same:
        return Form("room", values, "", {}, {})
    code = write_function("_own_gradients", "Gradients of the domain's coordinates, (r n, N).", fold.gradients)
    return Form("room", values, code, {}, {})


def _same_directions(chart: Chart, fold: FoldBound) -> bool:
    """Whether the domain's coordinates have the gradients of the chart, up to positive factors."""
    points = sample_uniform(chart.problem.domain, _POINTS, 0)
    theirs = np.array([np.array(fold.gradients(q)) for q in points])
    return bool(np.abs(_unit(theirs) - _unit(chart.coordinates.jacobian(points))).max() < _PARALLEL)


def _unit(rows: Array) -> Array:
    return np.asarray(rows / np.linalg.norm(rows, axis=2, keepdims=True))


def _near_path(corridor: PathBound) -> Form:
    starts, axes, squares = corridor.lines
    tables = {
        "path_radius": corridor.radius[corridor.counted][:, None],
        "path_starts": starts[:, :, None],
        "path_axes": axes[:, :, None],
        "path_lengths": np.sqrt(squares)[:, None],
    }
    return Form("room", {"kind": "path"}, "", tables, {"path_joints": corridor.counted.tolist()})
