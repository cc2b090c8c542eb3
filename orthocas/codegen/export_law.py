"""Impedance and PD+ laws in an exported module: the matrices of the robot as code, the law as lines on batches."""

import casadi as ca
import numpy as np

from orthocas.codegen.export_forms import Form, function_code
from orthocas.control.controller import LARGEST, SMALLEST_VOLUME, ControlStatus
from orthocas.control.linear_algebra import ROUNDS, SOFTEST
from orthocas.control.operational_space import Impedance, PDPlus
from orthocas.errors import InvalidValueError
from orthocas.tools.batch import dense_function
from orthocas.tools.expressions import wrap_shortest

TORQUE_LAWS = (Impedance, PDPlus)  #: that can be exported
_STATUSES = ("OK", "OUTSIDE_DOMAIN", "SINGULAR", "NOT_FINITE", "SATURATED")
_FOLLOWING = """\
    drift = _task_drift(np.concatenate([q, wanted[: len(UNITS)], wanted[n : n + len(UNITS)]]))
    drift = np.concatenate([drift, wanted[n + len(UNITS) : 2 * n]])
    w = _times(mobility, _times(_in_blocks(inertia), drift))
    pushed = _times(np.swapaxes(mobility, -1, -2), _coriolis_torque(np.concatenate([q, dq, w])))
    force = _times(_in_blocks(inertia), pushed - _bend(q, dq, w, wanted))
    force = force - _table("stiffness", q) * e - _times(damping, _times(J, dq) - drift)
"""
_STAYING = '    force = -_table("stiffness", q) * e - _times(damping, _times(J, dq))\n'
_DAMPING = {
    "square_root": """\
    half = _square_root(inertia) * np.swapaxes(ratio * np.sqrt(stiffness), 0, 1)
    return half + np.swapaxes(half, -1, -2)""",
    "double_diagonal": """\
    mass = (inertia * _identity(inertia)).sum(-1)[:, :, None]
    fastest = np.amax(stiffness / mass, 1)[:, :, None]
    floor = mass * np.where(fastest > @least@, @softest@ * fastest, @softest@ * @least@ + np.zeros_like(fastest))
    stiffness = np.where(stiffness < floor, floor, stiffness + np.zeros_like(floor))
    root, scale = np.sqrt(stiffness), np.sqrt(stiffness * ratio)
    mean = _square_root(inertia / (root @ np.swapaxes(root, -1, -2)))
    return 2 * scale @ np.swapaxes(scale, -1, -2) * mean""",
}


def law_form(law: Impedance | PDPlus) -> Form:
    """The function `command`, and what it calls beside the functions of phi and of the inverse.

    Raises:
        InvalidValueError: if the law takes inputs at run time, such as a payload or a given mass matrix.
    """
    model = law.model
    if model.gains(law.problem, law.feed_forward):
        raise InvalidValueError("model of the law", ", ".join(model.gains(law.problem, law.feed_forward)), "its own")
    bound, domain = law.problem.domain.reach, law.problem.domain
    stiffness = law.stiffness if law.damping_stiffness is None else law.damping_stiffness
    turn = np.zeros(law.problem.n)
    turn[list(law.problem.turning)] = 2 * np.pi
    columns = {
        "turn": turn,
        "stiffness": law.stiffness,
        "damping_stiffness": stiffness,
        "damping_ratio": law.damping_ratio,
        "limit": law.limit,
    }
    tables = {name: value[:, None] for name, value in columns.items()}
    tables["reach"] = np.array([domain.centre - bound, domain.centre + bound])[:, :, None]
    damping = _DAMPING[law.damping].replace("@softest@", repr(SOFTEST)).replace("@least@", repr(SOFTEST))
    values = {
        "formula": law.formula,
        "blocks": _blocks(law),
        "statuses": ", ".join(_STATUSES),
        "numbers": ", ".join(str(int(ControlStatus[name])) for name in _STATUSES),
        "largest": repr(LARGEST),
        "smallest_volume": repr(SMALLEST_VOLUME**2 * law.median_volume),
        "motion": _FOLLOWING if law.feed_forward else _STAYING,
        "damping": damping,
        "rounds": str(ROUNDS),
    }
    return Form("law", values, "\n\n".join(_functions(law)), tables, {})


def _functions(law: Impedance | PDPlus) -> list[str]:
    """Code of the errors, and of the robot's matrices and torques."""
    chart, n, m = law.chart, law.chart.n, law.chart.m
    q, dq, w = (ca.MX.sym(name, n) for name in ("q", "dq", "w"))
    x_d, dx_d, ddx_d = (ca.MX.sym(name, m) for name in ("x_d", "dx_d", "ddx_d"))
    inputs, robot = {"q": q, "dq": dq}, law.problem.robot
    error, slope = chart.relative.error(q, x_d)
    e = ca.SX.sym("e", n)
    found = [
        _code("_task_errors", "e, then de/dq row by row, of q, x_d.", [q, x_d], [error, ca.vec(slope.T)]),
        function_code(
            "_shortest",
            "Errors by the shorter way around for coordinates that are angles, (n, N).",
            dense_function("f", [e], [wrap_shortest(e, chart.turns)]),
        ),
        _code(
            "_mass_matrix", "Entries of M row by row, (n n, N).", [q], [ca.vec(law.model.mass_matrix(robot, inputs))]
        ),
        _code("_gravity", "Gravity torque, (n, N).", [q], [law.model.gravity_torque(robot, inputs)]),
    ]
    if law.feed_forward:
        drift = chart.relative.compute_drift(q, x_d, dx_d)
        bend = chart.relative.compute_bias(q, dq, w, (x_d, dx_d, ddx_d))
        coriolis = law.model.coriolis_torque(robot, inputs, w)
        states = [q, dq, w, x_d, dx_d, ddx_d]
        found += [
            _code(
                "_task_drift",
                "Rate of the errors of a robot at rest, less its sign, of q, x_d, dx_d.",
                [q, x_d, dx_d],
                [drift],
            ),
            _code(
                "_task_bend",
                "How the rates of the errors change, of q, dq, w, x_d and its derivatives.",
                states,
                [bend],
            ),
            _code("_coriolis_torque", "C(q, dq) w, of q, dq, w.", [q, dq, w], [coriolis]),
            _BEND,
        ]
    return found


_BEND = '''def _bend(q, dq, w, wanted):
    """d/dt (J w - drift) for a constant w, (n, N)."""
    m, n = len(UNITS), len(JOINTS)
    targets = [wanted[k * n : k * n + m] for k in range(3)]
    change = (_along(_xi_jacobian, q, dq) * w).sum(1) - wanted[2 * n + m :]
    return np.concatenate([_task_bend(np.concatenate([q, dq, w, *targets])), change])
'''


def _blocks(law: Impedance | PDPlus) -> str:
    """First and last + 1 of the rows of each block, as Python."""
    n, m = law.chart.n, law.chart.m
    return f"((0, {n}),)" if law.coupling == "coupled" else f"((0, {m}), ({m}, {n}))"


def _code(name: str, summary: str, inputs: list[ca.MX], outputs: list[ca.MX]) -> str:
    """A Python function of columns of the inputs, one below the other."""
    graph = ca.Function("graph", inputs, [ca.densify(ca.vertcat(*outputs))])
    symbols = [ca.SX.sym("s", part.numel()) for part in inputs]
    return function_code(name, summary, dense_function("f", [ca.vertcat(*symbols)], [graph(*symbols)]))
