"""The interface of generated C: functions, supervised laws, and the text of the header."""

from collections.abc import Mapping
from string import Template

import casadi as ca
import numpy as np

from orthocas.charts.chart import Chart
from orthocas.codegen.boundary import (
    BoundaryCondition,
    bound_values,
    boundary_condition,
    domain_values,
    position_within,
)
from orthocas.codegen.description import control_values, description_values, filled, flags, numbers, words
from orthocas.codegen.kernels import Kernels
from orthocas.codegen.precision import Precision, check_values
from orthocas.control.controller import Controller
from orthocas.control.memory import memory_of
from orthocas.control.safety import SIGNED, UNBOUNDED, Safety
from orthocas.tasks.relative import Relative
from orthocas.tools.expressions import wrap_shortest
from orthocas.version import VERSION

_TORQUE = """It compensates gravity and the load that it has felt, damps
 * with the mass matrix, holds the arm with a spring that gives way under too much force."""
_VELOCITY = """It stops the arm and holds it."""
_INERTIA = "  double inertia[{n}];       /* mass matrix of the catcher's spring, row by row */\n"
_OF_TORQUE = {  # code of torque laws for load and velocity observer, by its place in these templates
    "or_observed": ", or the observer's estimate",
    "state_load": "  double load[$n];           /* torque that the model lacks, as it is felt; the catcher adds it */\n"
    "  double drive[$n];          /* what the last command had beyond fallback and Coriolis torque */\n"
    "  double speed[$n];          /* dq at that command */\n",
    "add_load": "    add_load(state, 1.0, command);\n",
    "state_observer": "  double expected[$n];       /* accelerations that the velocity observer expects */\n"
    "  double unexplained[$n];    /* accelerations that torques do not explain */\n",
    "observed": "  double speed[N], M[N * N], bias[N], gravity[N];\n",
    "foresee": "  foresee(state, since);\n",
    "observe": "  memcpy(speed, dq, sizeof speed);\n  observe(state, here, speed, since);\n  dq = speed;\n",
    "stand_still": "  set_zero(state->expected, N);\n  set_zero(state->unexplained, N);\n  set_zero(state->load, N);\n",
    "moving": ", M, bias, gravity",
    "inertia_now": "  double M[N * N];\n  memcpy(M, state->inertia, sizeof M);\n",
    "by_inertia": "  if (!solve(M, speed, 1)) set_zero(speed, N);\n",
    "expect": "  expect(state, $command, fallback, M, bias, gravity);\n",
}
_OF_MEMORY = {  # code of laws that remember, by its place in the templates of the supervised law
    "memory_type": "",
    "state_memory": "  ${name}_memory memory;\n",
    "memory_c": "",
    "forget": "  state->memory = nothing_remembered;\n",
    "given_gains": "  const ${name}_gains *given = gains;\n",
    "use_memory": "",
    "remember": "  remember(state, &shifted, given, cut ? 0.0 : state->weight, known ? since : 0.0);\n",
}
_OF_CORRECTION = {  # and of those whose memory is a torque
    "learn_blind": "    if (state->fresh == 2) learn_from_start(state, gains);\n",
    "learn_from_start": "  if (command != 0 && all_finite(command, N)) state->fresh = 2;\n",
}
_TURNS = """ * Joints that turn without end count from the centre of the domain, so q and q + 2 pi give the same
 * command. The law under supervision counts them from the last measurement, so nothing jumps at half a turn.
"""
_ORDER = "{0}catch_margin < {0}near_margin && {0}near_margin < {0}return_margin && {0}return_margin < 1.0".format(
    "safety->"
)
_UNIT = 1.001  # squared length of a quaternion, to rounding
_DAMPED = 1e-6  # of least squares: joint motions of single quantities, and of more quantities than joints
_MAX_EVALUATIONS = 100  # largest number of chart evaluations in one call of the inverse map


def supervision_kernels(controller: Controller, condition: BoundaryCondition | None) -> list[ca.Function]:
    """What the supervised law and its references compute besides the law itself.

    - fallback(q, gains) -> command;
    - deviation(q, reference) -> quantities, reference - quantities;
    - gap(reference with two derivatives, value) -> value - reference, rates of the reference as errors count;
    - memory(q, dq, reference with two derivatives, gains, command, active, period, fields) -> fields, if it has one;
    - implied(q, dq, reference with two derivatives, change) -> A (n, n) row by row and B (n, 3), such that A^-1 B are
      the change, velocity and acceleration of the joints that follow; dq is about that velocity.
    """
    n, k = controller.problem.n, len(controller.labels)
    fallback, q, reference = controller.fallback, ca.MX.sym("q", n), ca.MX.sym("reference", k)
    inputs = fallback.mx_in()
    measured, relative = controller.measured(q), Relative(controller.problem.task)
    start, velocity, acceleration, end = (ca.MX.sym(name, k) for name in ("start", "velocity", "acceleration", "end"))
    m, gap = controller.problem.m, _apart(controller, relative, end, start)
    turned = relative.convert_rates(start[:m], velocity[:m], acceleration[:m])
    rates = [ca.vertcat(*parts) for parts in zip(turned, (velocity[m:], acceleration[m:]), strict=True)]
    found = [
        ca.Function("fallback", inputs, fallback.call(inputs)),
        ca.Function(
            "deviation", [q, reference], [ca.densify(measured), _apart(controller, relative, reference, measured)]
        ),
        ca.Function("gap", [start, velocity, acceleration, end], [gap, *map(ca.densify, rates)]),
        _implied(controller, relative),
    ]
    if relative.turned:
        found += [relative.moved, relative.turned_by]
    if (memory := memory_of(controller)) is not None:
        inputs = memory.step.mx_in()
        found.append(ca.Function("memory", inputs, [ca.densify(out) for out in memory.step.call(inputs)]))
    return found if condition is None else [*found, *condition.kernels]


def _apart(controller: Controller, relative: Relative, end: ca.MX, start: ca.MX) -> ca.MX:
    """The difference of two values of the controlled quantities, (k, 1), by the shorter turns. NaN: end is no value."""
    m = controller.problem.m
    difference = ca.vertcat(relative.difference(end[:m], start[:m]), end[m:] - start[m:])
    if relative.turned:  # sines of half an angle
        unit = ca.sumsqr(relative.task.quaternion_function(end[:m])) < _UNIT
        difference = ca.if_else(unit, difference, ca.MX.nan(len(controller.labels)))
    if controller.chart is not None and controller.labels == controller.chart.labels:
        difference = wrap_shortest(difference, controller.chart.turns)
    return ca.densify(difference)


def _implied(controller: Controller, relative: Relative) -> ca.Function:
    """A and B of the joint motions that a reference implies; of damped least squares where k is not n."""
    n, m, k = controller.problem.n, controller.problem.m, len(controller.labels)
    names = ("value", "velocity", "acceleration", "change")
    q, dq, value, *rates, change = (
        *(ca.MX.sym(name, n) for name in ("q", "dq")),
        *(ca.MX.sym(name, k) for name in names),
    )
    slope = relative.error(q, value[:m])[1]
    if controller.chart is not None and controller.labels == controller.chart.labels:
        own = controller.chart.coordinates.functions
        J, bend = ca.vertcat(slope, own["jacobian"](q)), own["second_derivative"](q, dq, dq)
    else:
        J_2 = ca.jacobian(controller.measured(q)[m:], q)
        J, bend = ca.vertcat(slope, J_2), ca.jtimes(J_2 @ dq, q, dq)
    bend = ca.vertcat(controller.problem.task.rates_derivative_function(q, dq, dq), bend)
    turned = relative.convert_rates(value[:m], rates[0][:m], rates[1][:m])
    velocity, acceleration = (ca.vertcat(a, b[m:]) for a, b in zip(turned, rates, strict=True))
    B = ca.horzcat(change, velocity, acceleration - bend)
    if k != n:
        J, B = J.T @ J + _DAMPED * ca.trace(J.T @ J) * ca.MX.eye(n), J.T @ B
    return ca.Function("implied", [q, dq, value, *rates, change], [ca.densify(J.T), ca.densify(B)])


def supervision_values(
    controller: Controller, safety: Safety, condition: BoundaryCondition | None, known: Mapping[str, str]
) -> dict[str, str]:
    """Values of the placeholders in the templates of the supervised law.

    Args:
        controller: the law.
        safety: its settings.
        condition: the condition of the law's domain, if it has one.
        known: values of other placeholders.
    """
    robot = controller.problem.robot
    endless = np.isinf(robot.lower) & np.isinf(robot.upper) & ~np.array(robot.tree.prismatic)
    torque, settings = controller.command == "torque", safety.in_c(controller.command)
    return {
        "catcher": _TORQUE if torque else _VELOCITY,
        "turning": flags(endless),
        "state_inertia": _INERTIA.format(n=robot.n**2) if torque else "",
        **{
            place: Template(text).safe_substitute(n=robot.n, command=controller.command) if torque else ""
            for place, text in _OF_TORQUE.items()
        },
        "safety_fields": "\n".join(_field(name, value) for name, value in settings.items()),
        "safety_values": ",\n".join(f"  {_literal(value)}" for value in settings.values()),
        "safety_meant": "\n        && ".join([*(_meant(name, value) for name, value in settings.items()), _ORDER]),
        **_clearance_values(condition),
        **_turning(controller, known),
        **_memory_values(controller, known),
        "fallback_arguments": "\n".join(f"  arg[{1 + i}] = gains->{gain};" for i, gain in enumerate(controller.gains)),
    }


def _turning(controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
    """Code for references with an orientation."""
    relative, m = Relative(controller.problem.task), controller.problem.m
    places = ("turn_reference", "turn_step")
    found = {place: filled(f"{place}.c", known) if relative.turned else "" for place in places}
    return {"turned_first": str(relative.first), "turned_end": str(m), **found}


def _counted_turns(controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
    """Code of the law without supervision: it counts turns from the centre, see `count_turns_from_centre`."""
    turning = controller.problem.turning
    if not turning:
        return {"count_turns": "", "turns_declared": "", "turns_counted": "", "q_of_law": "q", "turns_told": ""}
    turn = np.zeros(controller.problem.n)
    turn[list(turning)] = 2 * np.pi
    centre = numbers(controller.problem.domain.centre)
    code = filled("count_turns.c", {**known, "turn_of_joint": numbers(turn), "turns_from": centre})
    return {
        "count_turns": code,
        "turns_declared": ", counted[N]",
        "turns_counted": "  count_turns(q, counted);\n",
        "q_of_law": "counted",
        "turns_told": _TURNS,
    }


def _memory_values(controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
    """Code of a law that remembers, for `_OF_MEMORY`; empty for others."""
    memory = memory_of(controller)
    if memory is None:
        return dict.fromkeys([*_OF_MEMORY, *_OF_CORRECTION], "")
    first = 5 + len(controller.gains)
    pointers = [
        f"  arg[{first + 3 + i}] = last.{field};\n  res[{i}] = state->memory.{field};"
        for i, field in enumerate(memory.start)
    ]
    kept = [
        f"  keep_numbers(state->memory.{field}, last.{field}, {len(value)});" for field, value in memory.start.items()
    ]
    values = {
        **known,
        **control_values(controller),
        "fields": "\n".join(f"  double {field}[{len(value)}];" for field, value in memory.start.items()),
        "start": ",\n".join(f"  {{{numbers(value)}}}" for value in memory.start.values()),
        "pointers": "\n".join(pointers),
        "kept": "\n".join(kept),
        "corrections": "",
        "start_meaning": "",
    }
    of_torque, learned = dict.fromkeys(_OF_CORRECTION, ""), ""
    if memory.torque is not None:
        of_torque, learned = _OF_CORRECTION, "  if (state->fresh == 2) learn_from_start(state, given);\n"
        values["corrections"] = filled("corrections.c", {**known, "torque": memory.torque})
        values["start_meaning"] = (
            f"\n * The command of {known['name']}_start must hold the arm: it shows what torque the model lacks."
        )
    added = (
        f"  for (i = 0; i < {len(controller.gains[gain])}; ++i) used.{gain}[i] += state->memory.{field}[i];\n"
        for gain, field in memory.adds.items()
    )
    pieces = {place: Template(text).substitute(known) for place, text in _OF_MEMORY.items()}
    return (
        pieces
        | of_torque
        | {
            "memory_type": filled("memory.h", values),
            "memory_c": filled("memory.c", values),
            "use_memory": learned + "".join(added),
        }
    )


def _clearance_values(condition: BoundaryCondition | None) -> dict[str, str]:
    """The condition of the domain as a part of the boundary."""
    if condition is None:
        return {"nearest": "1.0", "clearance_too": " in half-widths", "boundary_told": "", "inwards": ""}
    return {
        "nearest": "clearance_ahead(q, dq, time)",
        "clearance_too": " in half-widths, or the clearance",
        "boundary_told": f" {condition.meaning}",
        "inwards": condition.inwards,
        **condition.values,
    }


def _field(name: str, value: object) -> str:
    size = f"[{value.size}]" if isinstance(value, np.ndarray) else ""
    kind = "int" if isinstance(value, int) else "double"
    return f"  {kind} {name}{size}; /* {Safety.meaning(name)} */"


def _meant(name: str, value: object) -> str:
    """What `Safety` requires of a setting, in C."""
    place = f"safety->{name}"
    if not isinstance(value, np.ndarray):
        return f"{place} >= 0" if isinstance(value, int) else f"{place} > 0.0 && {place} <= LARGEST"
    least = "-INFINITY" if name in SIGNED else "0.0"
    found = f"all_from({least}, {place}, {value.size})"
    return found if name in UNBOUNDED else f"{found} && all_within({place}, {value.size}, LARGEST)"


def _literal(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{{{numbers(value)}}}"
    return str(value) if isinstance(value, int) else repr(float(value))  # type: ignore[arg-type]


def template_values(
    chart: Chart,
    controller: Controller | None,
    safety: Safety | None,
    name: str,
    kernels: Kernels,
    stack_bytes: int,
    precision: Precision,
) -> dict[str, str]:
    """The values of all placeholders in the templates."""
    somewhere = precision.rounded(position_within(chart.problem.domain))
    joints = words(chart.problem.robot.joint_names)
    values = {
        "name": name,
        "NAME": name.upper(),
        "title": _title(chart, controller),
        "version": VERSION,
        "casadi_version": ca.CasadiMeta.version(),
        **_sizes(chart),
        **precision.words(),
        "joint_list": ", ".join(joints),
        **description_values(chart),
        "phi_sizes": numbers(chart.phi_sizes),
        **_shortest_way(chart),
        "max_evaluations": str(_MAX_EVALUATIONS),
        "stack_bytes": str(stack_bytes),
        "check_q": numbers(somewhere),
        **check_values(chart, controller, somewhere, precision),
        "kernels": kernels.code,
        **kernels.sizes(),
    }
    values |= domain_values(chart, values, precision)
    values["difference"] = filled("turned.c", values) if chart.relative.turned else ""
    if controller is not None and safety is not None:
        condition = boundary_condition(controller)
        values |= control_values(controller) | _counted_turns(controller, values)
        values |= supervision_values(controller, safety, condition, values)
        values["clearance_c"] = "" if condition is None else _clearance(condition, values)
        values |= bound_values(controller)
        values["compose"] = filled(f"compose_{controller.command}.c", values)
    for template in ("control.h", "control.c", "check_control.c", "control.md", "supervisor.h", "supervisor.c"):
        values[template.replace(".", "_")] = "" if controller is None else filled(template, values)
    return values


def _clearance(condition: BoundaryCondition, values: dict[str, str]) -> str:
    """Code for how far a position is inside the condition of the domain, here and after a time."""
    code = "".join(filled(template, values) for template in condition.templates)
    return filled("clearance.c", {**values, "condition_boundary": code})


def _sizes(chart: Chart) -> dict[str, str]:
    sizes = {"n": chart.n, "m": chart.m, "r": chart.r, "nn": chart.n**2}
    return {name: str(size) for name, size in sizes.items()}


def _shortest_way(chart: Chart) -> dict[str, str]:
    """The difference of two phi in C; angles and orientations take the shorter way around."""
    plain = "(wanted[i] - phi[i])"
    table = ""
    if chart.turns.any():
        rounds = np.where(chart.turns > 0, 1 / np.where(chart.turns > 0, chart.turns, 1.0), 0.0)
        table = f"\n  static const double turn[N] = {{{numbers(chart.turns)}}}, rounds[N] = {{{numbers(rounds)}}};"
        plain = "(wanted[i] - phi[i] - turn[i] * floor((wanted[i] - phi[i]) * rounds[i] + 0.5))"
    if chart.relative.turned:
        return {
            "turn_table": f"{table}\n  double turn_left[{chart.m}];",
            "shortest": f"(i < {chart.m} ? turn_left[i] : {plain})",
        }
    return {"turn_table": table, "shortest": plain}


def _title(chart: Chart, controller: Controller | None) -> str:
    what = "chart" if controller is None else f"{controller.name} controller"
    problem, label = chart.problem, chart.coordinates.label
    title = f"{what} of {problem.name}: {label}, task {problem.task.name}, metric {problem.metric.name}"
    return words([title])[0]
