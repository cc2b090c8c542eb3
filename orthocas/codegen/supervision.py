"""The supervised law in generated C: its kernels, and the values of its templates."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.codegen.rendering import clean_word, clean_words
from orthocas.control.controller import Controller
from orthocas.control.memory import find_memory
from orthocas.control.safety import TORQUE_ONLY, Safety
from orthocas.native.kernels import write_number, write_numbers
from orthocas.tasks.domains import Domain
from orthocas.tasks.relative import Relative
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.expressions import expand_scalars, wrap_shortest


@dataclass(frozen=True, slots=True)
class SupervisionRules:
    """Numbers of the kernels of the supervised law."""

    unit: float = 1.001  #: largest squared length of a unit quaternion with rounding
    #: relative damping of least squares, for joint motions of fewer or more quantities than joints
    damping: float = 1e-6
    samples: int = 256  #: samples of a domain that determine its median distance to a fold


RULES = SupervisionRules()


def build_supervision_kernels(controller: Controller) -> list[ca.Function]:
    """The kernels that the supervised law and its references need in addition to the law.

    - fallback(q, gains) -> command;
    - deviation(q, reference) -> quantities, reference - quantities;
    - gap(reference with two derivatives, value) -> value - reference, and rates of the reference as rates of the error;
    - implied(q, dq, reference with two derivatives, change) -> A (n, n) row by row and B (n, 3), such that A^-1 B is
      the change, velocity and acceleration of joints that follow the reference, with dq near that velocity;
    - memory(q, dq, reference with two derivatives, gains, command, active, period, fields) -> fields, if the law has
      one;
    - gram(q) and room(q), which measure the distance to singular positions and to folds, if they bound the domain.
    """
    n, m, k = controller.problem.n, controller.problem.m, len(controller.labels)
    fallback, q, reference = controller.fallback, ca.MX.sym("q", n), ca.MX.sym("reference", k)
    inputs = fallback.mx_in()
    measured, relative = controller.measured(q), Relative(controller.problem.task)
    start, velocity, acceleration, end = (ca.MX.sym(name, k) for name in ("start", "velocity", "acceleration", "end"))
    # The task has its own errors and rates; other quantities use differences.
    turned = relative.convert_rates(start[:m], velocity[:m], acceleration[:m])
    rates = [ca.vertcat(*parts) for parts in zip(turned, (velocity[m:], acceleration[m:]), strict=True)]
    deviation = [ca.densify(measured), _subtract(controller, relative, reference, measured)]
    gap = [_subtract(controller, relative, end, start), *map(ca.densify, rates)]
    kernels = [
        ca.Function("fallback", inputs, fallback.call(inputs)),
        ca.Function("deviation", [q, reference], deviation),
        ca.Function("gap", [start, velocity, acceleration, end], gap),
        _build_implied(controller, relative),
    ]
    # Additional kernels: for orientations, for laws with memory, and for domains with bounds.
    if relative.turned:
        kernels += [relative.moved, relative.turned_by]
    if (memory := find_memory(controller)) is not None:
        inputs = memory.step.mx_in()
        kernels.append(ca.Function("memory", inputs, [ca.densify(out) for out in memory.step.call(inputs)]))
    domain = None if controller.chart is None else find_condition(controller.chart)
    if domain is not None and (bound := domain.singular_bound) is not None:
        kernels.append(expand_scalars(ca.Function("gram", [q], [bound.gram(q)])))
        if (room := domain.room_to_fold) is not None:
            kernels.append(expand_scalars(ca.Function("room", [q], [room(q)])))
    return kernels


def _subtract(controller: Controller, relative: Relative, end: ca.MX, start: ca.MX) -> ca.MX:
    """Difference of two values of the controlled quantities, (k, 1), by shorter turns; NaN if `end` is invalid."""
    m = controller.problem.m
    difference = ca.vertcat(relative.difference(end[:m], start[:m]), end[m:] - start[m:])
    # Orientations differ by sines of half an angle.
    if relative.turned:
        unit = ca.sumsqr(relative.task.quaternion_function(end[:m])) < RULES.unit
        difference = ca.if_else(unit, difference, ca.MX.nan(len(controller.labels)))
    if controller.chart is not None and controller.labels == controller.chart.labels:
        difference = wrap_shortest(difference, controller.chart.parts.turns)
    return ca.densify(difference)


def _build_implied(controller: Controller, relative: Relative) -> ca.Function:
    """A and B of the joint motions that a reference implies, by damped least squares if k is not n."""
    n, m, k = controller.problem.n, controller.problem.m, len(controller.labels)
    names = ("value", "velocity", "acceleration", "change")
    q, dq = (ca.MX.sym(name, n) for name in ("q", "dq"))
    value, *rates, change = (ca.MX.sym(name, k) for name in names)

    # J and dJ/dt dq of the quantities, with orientations relative to the reference.
    slope = relative.error(q, value[:m])[1]
    if controller.chart is not None and controller.labels == controller.chart.labels:
        own = controller.chart.coordinates.functions
        J, bias = ca.vertcat(slope, own["jacobian"](q)), own["second_derivative"](q, dq, dq)
    else:
        J_2 = ca.jacobian(controller.measured(q)[m:], q)
        J, bias = ca.vertcat(slope, J_2), ca.jtimes(J_2 @ dq, q, dq)
    bias = ca.vertcat(controller.problem.task.rates_derivative_function(q, dq, dq), bias)

    # Rates of the reference as rates of the error; damped least squares if k is not n.
    turned = relative.convert_rates(value[:m], rates[0][:m], rates[1][:m])
    velocity, acceleration = (ca.vertcat(a, b[m:]) for a, b in zip(turned, rates, strict=True))
    B = ca.horzcat(change, velocity, acceleration - bias)
    if k != n:
        J, B = J.T @ J + RULES.damping * ca.trace(J.T @ J) * ca.MX.eye(n), J.T @ B
    return ca.Function("implied", [q, dq, value, *rates, change], [ca.densify(J.T), ca.densify(B)])


def find_condition(chart: Chart) -> Domain | None:
    """The domain of a chart, if it has a condition in addition to its box; otherwise None.

    Raises:
        DomainError: if C does not support this condition.
    """
    domain = chart.problem.domain
    domain.require_bounds("form in C")
    return None if domain.is_box else domain


def describe_law(controller: Controller) -> dict[str, Any]:
    """Values of the templates about the law: gains, kind of command, and joints whose turns are counted."""
    problem, torque = controller.problem, controller.command == "torque"
    # Endless joints have a period; some robots compensate gravity themselves.
    turns = np.zeros(problem.n)
    turns[list(problem.turning)] = 2 * np.pi
    if controller.settings.get("gravity") == "robot":
        fallback = "zero torque, because the robot compensates gravity"
    else:
        fallback = "the gravity torque, or zero where it is not finite"
    return {
        "law": controller.formula,
        "k": len(controller.labels),
        "reference_labels": ", ".join(clean_words(controller.labels)),
        "reference_names": clean_words(controller.labels),
        "gains": [
            {
                "name": name,
                "size": len(values),
                "numbers": values,
                "unit": clean_word(unit) if (unit := controller.gain_units.get(name)) else "",
            }
            for name, values in controller.gains.items()
        ],
        "gain_arguments": [f"gains->{name}" for name in controller.gains],
        "command": controller.command,
        "torque": torque,
        "fallback": fallback if torque else "zero velocity",
        "has_chart": controller.chart is not None,
        "remarks": clean_words(controller.remarks()),
        "turns": turns.tolist() if turns.any() else None,
    }


def describe_supervision(controller: Controller, safety: Safety) -> dict[str, Any]:
    """Values of the templates for the supervised law: settings, boundary, memory and orientations."""
    problem, robot, domain = controller.problem, controller.problem.robot, controller.problem.domain
    lower, upper = domain.bounds
    path, relative = domain.path_bound, Relative(problem.task)
    return {
        "settings": [_describe_setting(name, value) for name, value in safety.in_c(controller.command).items()],
        "integral_bound": write_number(float(getattr(controller, "integral_bound", np.inf))),
        "unused_settings": () if controller.command == "torque" else TORQUE_ONLY,
        "turning": np.isinf(robot.lower) & np.isinf(robot.upper) & ~np.array(robot.tree.prismatic),
        "bounded": np.isfinite(lower) & np.isfinite(upper) & (controller.chart is not None),
        # The path of a corridor ends one radius before the boundary of its box, which may be many radii wide.
        "boundary_unit": domain.half_width if path is None else np.minimum(domain.half_width, path.radius),
        "boundary": _describe_boundary(controller),
        "turned_first": relative.first,
        "turned_end": problem.m,
        "memory": _describe_memory(controller),
    }


def _describe_setting(name: str, value: Any) -> dict[str, Any]:
    """A setting of `Safety` as a field of a struct, and its value."""
    meaning = Safety.meaning(name)
    if isinstance(value, np.ndarray):
        literal = f"{{{write_numbers(value)}}}"
        return {"name": name, "kind": "double", "size": value.size, "meaning": meaning, "literal": literal}
    # A count, or a single number.
    whole = isinstance(value, int)
    literal = write_number(value if whole else float(value))
    return {"name": name, "kind": "int" if whole else "double", "size": 0, "meaning": meaning, "literal": literal}


def _describe_boundary(controller: Controller) -> dict[str, Any] | None:
    """The condition of the law's domain as a part of its boundary; None without a condition."""
    domain = None if controller.chart is None else find_condition(controller.chart)
    if domain is None:
        return None
    if (path := domain.path_bound) is not None:
        starts, axes, squares = path.lines
        return {
            "meaning": "The distance to the path of postures is a part of the boundary; it counts in radii.",
            "path": {"starts": starts, "axes": axes, "lengths": np.sqrt(squares)},
            "joints": list(path.counted),
            "radii": path.radius[path.counted],
            "fold_span": None,
        }
    if (bound := domain.singular_bound) is None:
        return None
    meaning = (
        "The bound on the relative singular value of the task is a part of the boundary; its\n"
        " * distance counts in shares of that from the domain's home."
    )
    fold_span = None
    if (room := domain.room_to_fold) is not None:
        meaning += " So is\n * the bound on the volume of the coordinates, in shares of the median."
        # Use the median position, because the centre may be near the bound.
        fold_span = float(np.median(Batched(room)(sample_uniform(domain, RULES.samples, 0))[0]))
    return {
        "meaning": meaning,
        "path": None,
        "bound": bound.least_singular_value,
        # Use the home, because the centre may be singular.
        "span": float(bound.singular_values(domain.home)) - bound.least_singular_value,
        "fold_span": fold_span,
    }


def _describe_memory(controller: Controller) -> dict[str, Any] | None:
    """The fields of a law's memory, and the gains that they are added to; None without memory."""
    memory = find_memory(controller)
    if memory is None:
        return None
    # C stores the fields consecutively.
    first = dict(zip(memory.start, np.cumsum([0, *map(len, memory.start.values())]).tolist(), strict=False))
    return {
        "torque": memory.torque,
        "first_torque": -1 if memory.torque is None else first[memory.torque],
        "size": sum(map(len, memory.start.values())),
        "start": np.concatenate([np.ravel(values) for values in memory.start.values()]),
        "last": [f"last + {place}" for place in first.values()],
        "kept": [f"memory + {place}" for place in first.values()],
        "fields": [{"name": name, "size": len(values)} for name, values in memory.start.items()],
        "adds": [
            {"name": gain, "size": len(controller.gains[gain]), "first": first[name]}
            for gain, name in memory.adds.items()
        ],
    }
