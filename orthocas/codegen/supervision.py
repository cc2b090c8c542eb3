"""The supervised law in generated C: its kernels, and the values of its templates."""

import casadi as ca
import numpy as np

from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.codegen.numbers import flags, numbers
from orthocas.codegen.source import Source
from orthocas.control import Controller
from orthocas.control.safety import Safety
from orthocas.control.turns import without_turns
from orthocas.postures.clear_box import ClearBox


def clear_border(source: Source, controller: Controller) -> ClearBox | None:
    """The domain of the law, if its border depends on the singular values of the task."""
    condition = source.condition
    return condition if controller.chart is not None and isinstance(condition, ClearBox) else None


def supervision_kernels(controller: Controller, clear: ClearBox | None) -> list[ca.Function]:
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
    return found if clear is None else [*found, scalar_code(ca.Function("gram", [q], [clear.gram(q)]))]


def supervision_values(controller: Controller, safety: Safety, clear: ClearBox | None) -> dict[str, str]:
    """Values of the placeholders in the templates of the supervised law.

    Args:
        controller: the law.
        safety: its settings.
        clear: the domain of the law, if its border depends on the singular values of the task.
    """
    robot = controller.problem.robot
    endless = np.isinf(robot.lower) & np.isinf(robot.upper) & ~np.array(robot.tree.prismatic)
    torque, settings = controller.command == "torque", safety.in_c(controller.command)
    return {
        "catcher": _TORQUE if torque else _VELOCITY,
        "turning": flags(endless),
        "safety_fields": "\n".join(_field(name, value) for name, value in settings.items()),
        "safety_values": ",\n".join(f"  {_literal(value)}" for value in settings.values()),
        **_clearance_values(clear),
        "fallback_arguments": "\n".join(f"  arg[{1 + i}] = gains->{gain};" for i, gain in enumerate(controller.gains)),
    }


def _clearance_values(clear: ClearBox | None) -> dict[str, str]:
    """The bound on the singular value of the task as a part of the border."""
    if clear is None:
        return {"nearest": "1.0", "clearance_too": " in half-widths", "clear_border": ""}
    return {
        "nearest": "clearance_ahead(q, dq, time)",
        "clearance_too": " in half-widths, or the clearance",
        "clear_border": _CLEAR_BORDER,
        "clear_bound": repr(clear.least_singular_value),
        "clear_span": repr(float(clear.singular_values(clear.centre)) - clear.least_singular_value),
    }


_CLEAR_BORDER = """ The bound on the relative singular value of the task is a part of the border; its
 * distance counts in shares of that from the centre."""
_TORQUE = """It compensates gravity, damps with the mass matrix,
 * holds the arm with a spring that gives way under too much force."""
_VELOCITY = """It stops the arm and holds it."""


def _field(name: str, value: object) -> str:
    size = f"[{value.size}]" if isinstance(value, np.ndarray) else ""
    kind = "int" if name == "hold_ticks" else "double"
    return f"  {kind} {name}{size}; /* {Safety.meaning(name)} */"


def _literal(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{{{numbers(value)}}}"
    return str(value) if isinstance(value, int) else repr(float(value))  # type: ignore[arg-type]
