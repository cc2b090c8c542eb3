"""The contents of the generated files: names, sizes, tables and comments."""

from collections.abc import Mapping
from importlib.resources import files
from string import Template

import casadi as ca
import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.codegen.check import check_values
from orthocas.codegen.control_values import control_values
from orthocas.codegen.description import description_values
from orthocas.codegen.kernels import Kernels
from orthocas.codegen.numbers import numbers
from orthocas.codegen.precision import Precision, bounds_inside
from orthocas.codegen.supervision import supervision_values
from orthocas.codegen.words import words
from orthocas.control import Controller, Safety
from orthocas.domains import Conditioned, Domain, contains, reach
from orthocas.version import VERSION

_MAX_EVALUATIONS = 100  # largest number of chart evaluations in one call of the inverse map


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
    problem = chart.problem
    domain = problem.domain
    lowest, highest = bounds_inside(domain, precision)
    somewhere = precision.rounded(_somewhere(domain))
    joints = words(problem.robot.joint_names)
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
        "domain_lower": numbers(lowest),
        "domain_upper": numbers(highest),
        "domain_centre": numbers(domain.centre),
        "domain_reach": numbers(reach(domain)),
        "phi_sizes": numbers(chart.phi_sizes),
        "max_evaluations": str(_MAX_EVALUATIONS),
        "stack_bytes": str(stack_bytes),
        "check_q": numbers(somewhere),
        **check_values(chart, controller, somewhere, precision),
        "kernels": kernels.code,
    }
    for kernel, sizes in kernels.work.items():
        for word, size in zip(("arg", "res", "iw", "w"), sizes, strict=True):
            values[f"{kernel}_{word}"] = str(max(1, size))
    if controller is not None and safety is not None:
        values |= control_values(controller) | supervision_values(controller, safety)
        values["clearance_c"] = filled("clearance.c", values) if "clear_span" in values else ""
        values["compose"] = filled(f"compose_{controller.command}.c", values)
    values |= _clear_values(domain, values)
    for template in ("control.h", "control.c", "check_control.c", "control.md", "supervisor.h", "supervisor.c"):
        values[template.replace(".", "_")] = "" if controller is None else filled(template, values)
    return values


def _sizes(chart: Chart) -> dict[str, str]:
    sizes = {"n": chart.n, "m": chart.m, "r": chart.r, "nn": chart.n**2}
    return {name: str(size) for name, size in sizes.items()}


def _title(chart: Chart, controller: Controller | None) -> str:
    what = "chart" if controller is None else f"{controller.name} controller"
    problem, label = chart.problem, chart.coordinates.label
    title = f"{what} of {problem.name}: {label}, task {problem.task.name}, metric {problem.metric.name}"
    return words([title])[0]


def _clear_values(domain: Domain, values: Mapping[str, str]) -> dict[str, str]:
    """The test of a condition of the domain, and its call; for other domains there is none."""
    if not isinstance(domain, Conditioned):
        return {"is_clear": "1", "clear_c": ""}
    condition = {
        "pivots": str(domain.pivots.size1_out(0)),
        "condition": "\n * ".join(words([domain.heading])),
    }
    return {"is_clear": "is_clear(q)", "clear_c": filled("clear.c", {**values, **condition})}


def _somewhere(domain: Domain) -> Array:
    """A joint position of the domain between its centre and a corner, (n,)."""
    shares = [0.5**k for k in range(1, 20) if contains(domain, domain.centre + 0.5**k * domain.half_width)]
    return np.round(domain.centre + (shares[0] if shares else 0.0) * domain.half_width, 3)


def filled(template: str, values: Mapping[str, str]) -> str:
    """A template of `templates/` with its placeholders filled in."""
    return Template((files("orthocas.codegen") / "templates" / f"{template}.in").read_text()).substitute(values)
