"""The supervised law in generated C: its kernels, and the values of its templates."""

import casadi as ca
import numpy as np

from orthocas.codegen.border_condition import BorderCondition
from orthocas.codegen.numbers import flags, numbers
from orthocas.control import Controller
from orthocas.control.safety import Safety
from orthocas.control.turns import without_turns


def supervision_kernels(controller: Controller, condition: BorderCondition | None) -> list[ca.Function]:
    """Fallback(q, gains) -> command, and deviation(q, reference) -> quantities, reference - quantities."""
    n, k = controller.problem.n, len(controller.labels)
    fallback, q, reference = controller.fallback, ca.MX.sym("q", n), ca.MX.sym("reference", k)
    inputs = fallback.mx_in()
    measured = controller.measured(q)
    error = reference - measured
    if controller.chart is not None and controller.labels == controller.chart.labels:
        error = without_turns(controller.chart, error)
    found = [
        ca.Function("fallback", inputs, fallback.call(inputs)),
        ca.Function("deviation", [q, reference], [ca.densify(measured), ca.densify(error)]),
    ]
    return found if condition is None else [*found, *condition.kernels]


def supervision_values(controller: Controller, safety: Safety, condition: BorderCondition | None) -> dict[str, str]:
    """Values of the placeholders in the templates of the supervised law.

    Args:
        controller: the law.
        safety: its settings.
        condition: the condition of the law's domain, if it has one.
    """
    robot = controller.problem.robot
    endless = np.isinf(robot.lower) & np.isinf(robot.upper) & ~np.array(robot.tree.prismatic)
    torque, settings = controller.command == "torque", safety.in_c(controller.command)
    return {
        "catcher": _TORQUE if torque else _VELOCITY,
        "turning": flags(endless),
        "safety_fields": "\n".join(_field(name, value) for name, value in settings.items()),
        "safety_values": ",\n".join(f"  {_literal(value)}" for value in settings.values()),
        **_clearance_values(condition),
        "fallback_arguments": "\n".join(f"  arg[{1 + i}] = gains->{gain};" for i, gain in enumerate(controller.gains)),
    }


def _clearance_values(condition: BorderCondition | None) -> dict[str, str]:
    """The condition of the domain as a part of the border."""
    if condition is None:
        return {"nearest": "1.0", "clearance_too": " in half-widths", "border_told": "", "inwards": ""}
    return {
        "nearest": "clearance_ahead(q, dq, time)",
        "clearance_too": " in half-widths, or the clearance",
        "border_told": f" {condition.meaning}",
        "inwards": condition.inwards,
        **condition.values,
    }


_TORQUE = """It compensates gravity, damps with the mass matrix,
 * holds the arm with a spring that gives way under too much force."""
_VELOCITY = """It stops the arm and holds it."""


def _field(name: str, value: object) -> str:
    size = f"[{value.size}]" if isinstance(value, np.ndarray) else ""
    kind = "int" if isinstance(value, int) else "double"
    return f"  {kind} {name}{size}; /* {Safety.meaning(name)} */"


def _literal(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{{{numbers(value)}}}"
    return str(value) if isinstance(value, int) else repr(float(value))  # type: ignore[arg-type]
