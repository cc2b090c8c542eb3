"""The contents of the generated files: names, sizes, tables and comments."""

import casadi as ca
import numpy as np

from orthocas.chart import Chart
from orthocas.codegen.border_condition import BorderCondition, border_condition
from orthocas.codegen.check import check_values
from orthocas.codegen.control_values import control_values
from orthocas.codegen.description import description_values
from orthocas.codegen.filling import filled
from orthocas.codegen.kernels import Kernels
from orthocas.codegen.numbers import numbers
from orthocas.codegen.precision import Precision
from orthocas.codegen.source import Source
from orthocas.codegen.supervision import supervision_values
from orthocas.codegen.words import words
from orthocas.control import Controller, Safety
from orthocas.version import VERSION

_MAX_EVALUATIONS = 100  # largest number of chart evaluations in one call of the inverse map


def template_values(
    source: Source,
    controller: Controller | None,
    safety: Safety | None,
    name: str,
    kernels: Kernels,
    stack_bytes: int,
    precision: Precision,
) -> dict[str, str]:
    """The values of all placeholders in the templates."""
    chart = source.chart
    somewhere = precision.rounded(source.somewhere)
    joints = words(chart.problem.robot.joint_names)
    values = {
        "name": name,
        "NAME": name.upper(),
        "title": _title(source, controller),
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
    values |= source.values(values, precision)
    if controller is not None and safety is not None:
        condition = border_condition(source, controller)
        values |= control_values(controller) | supervision_values(controller, safety, condition)
        values["clearance_c"] = "" if condition is None else _clearance(condition, values)
        values |= source.law_values(controller, values)
        values["compose"] = filled(f"compose_{controller.command}.c", values)
    for template in ("control.h", "control.c", "check_control.c", "control.md", "supervisor.h", "supervisor.c"):
        values[template.replace(".", "_")] = "" if controller is None else filled(template, values)
    return values


def _clearance(condition: BorderCondition, values: dict[str, str]) -> str:
    """Code that tells how far a position is inside the condition of the domain, here and after a time."""
    return filled("clearance.c", {**values, "condition_border": filled(condition.template, values)})


def _sizes(chart: Chart) -> dict[str, str]:
    sizes = {"n": chart.n, "m": chart.m, "r": chart.r, "nn": chart.n**2}
    return {name: str(size) for name, size in sizes.items()}


def _shortest_way(chart: Chart) -> dict[str, str]:
    """The difference of two phi in C; angles of circle-valued coordinates take the shorter way around."""
    if not chart.turns.any():
        return {"turn_table": "", "shortest": "(wanted[i] - phi[i])"}
    rounds = np.where(chart.turns > 0, 1 / np.where(chart.turns > 0, chart.turns, 1.0), 0.0)
    table = f"\n  static const double turn[N] = {{{numbers(chart.turns)}}}, rounds[N] = {{{numbers(rounds)}}};"
    whole = "turn[i] * floor((wanted[i] - phi[i]) * rounds[i] + 0.5)"
    return {"turn_table": table, "shortest": f"(wanted[i] - phi[i] - {whole})"}


def _title(source: Source, controller: Controller | None) -> str:
    what = source.title if controller is None else f"{controller.name} controller"
    problem, label = source.chart.problem, source.chart.coordinates.label
    title = f"{what} of {problem.name}: {label}, task {problem.task.name}, metric {problem.metric.name}"
    return words([title])[0]
