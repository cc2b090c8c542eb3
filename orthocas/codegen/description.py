"""Texts of generated C: templates, numbers, names, and what a header says of its chart."""

import re
from collections.abc import Iterable, Mapping
from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.chart_file import fingerprint
from orthocas.control.controller import Controller
from orthocas.robots.kinematics import TipTurn
from orthocas.tasks.domains import Domain
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

_ORIENTATION = (
    "2 sin(angle / 2) axis of the rotation from the reference to the tip, in world axes: near the reference, the\n"
    " *   rotation vector [rad]. The reference, row by row: "
)
_TILT = (
    "tilt of the tip's {axis} axis from the reference direction, near it in [rad]. The frame of that direction in the\n"
    " *   world, row by row: "
)
_TURN = (
    "tilt of the tip's {axis} axis from that of the reference, near it in [rad], and turn about it [rad].\n"
    " *   The reference, row by row: "
)
_ANGLE = (
    "\n *   {label} is an angle [rad] from -pi to pi. The inverse map and the laws take the shorter way around, so"
    "\n *   targets and references may have whole turns more or less."
)
_IN_DOMAIN = "OUTSIDE_DOMAIN: q lies outside the domain of the chart."
_EVERYWHERE = "This law uses no chart, so the status is never OUTSIDE_DOMAIN."


def numbers(values: Array) -> str:
    """C literals that convert back to exactly the same numbers."""
    words = {np.inf: "INFINITY", -np.inf: "-INFINITY"}
    return ", ".join(words.get(float(value), repr(float(value))) for value in values)


def flags(values: NDArray[np.bool_]) -> str:
    """Truth values as C has them."""
    return ", ".join(str(int(value)) for value in values)


def words(names: Iterable[str]) -> list[str]:
    """Names on one printable line each, safe in C comments (also with trigraphs) and in CMake templates."""
    return [re.sub(r"[@\\]+|/(?=\*)|\*(?=/)|\?(?=\?)", " ", _printable(name)) for name in names]


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)


def filled(template: str, values: Mapping[str, str]) -> str:
    """A template of `templates/` with its placeholders filled in."""
    return Template((files(__package__) / "templates" / f"{template}.in").read_text()).substitute(values)


def description_values(chart: Chart) -> dict[str, str]:
    """Values of the placeholders that describe robot, frames and coordinates."""
    tree = chart.problem.robot.tree
    limits = [f"{low:.6g} to {high:.6g}" for low, high in zip(tree.lower, tree.upper, strict=True)]
    slides = ["m" if sliding else "rad" for sliding in tree.prismatic]
    joints = zip(words(tree.joint_names), slides, limits, tree.velocity_limits, tree.effort_limits, strict=True)
    return {
        "joint_lines": "\n".join(
            f" *   {i} {name} [{unit}]: {limit}, at most {_or_unknown(speed)} {unit}/s, "
            f"{_or_unknown(effort)} {'N' if unit == 'm' else 'N m'}"
            for i, (name, unit, limit, speed, effort) in enumerate(joints)
        ),
        "task_labels": ", ".join(_with_units(chart.problem.task)),
        "orientation": _orientation(chart.problem.task),
        "extra_labels": ", ".join(words(chart.named_coordinates)),
        "angles": _angles(chart),
        "tip": words([tree.tip_name])[0],
        "gravity": _row(tree.gravity),
    }


def chart_values(chart: Chart) -> dict[str, str]:
    """Values of the placeholders that describe the domain of one chart, and what is proved of it."""
    return {
        "domain_lines": domain_lines(chart.problem.domain, words(chart.problem.robot.joint_names)),
        "certificate": _certificate(chart),
        "fingerprint": fingerprint(chart.problem, chart.coordinates),
    }


def domain_lines(domain: Domain, names: list[str]) -> str:
    """The boundaries of a domain, joint by joint, and its condition on singular values."""
    return _boundary_lines(names, *domain.bounds) + clear_line(domain)


def _angles(chart: Chart) -> str:
    """Which extra coordinates are circle-valued."""
    found = [label for label, turn in zip(words(chart.labels), chart.turns, strict=True) if turn]
    return "".join(_ANGLE.format(label=label) for label in found)


def _with_units(task: Task) -> list[str]:
    units = [f" [{unit}]" if unit else "" for unit in task.units]
    return [label + unit for label, unit in zip(words(task.labels), words(units), strict=True)]


def _orientation(task: Task) -> str:
    """The convention of orientation components, and their reference rotation."""
    turn = TipTurn.from_kind(task.recipe["kind"])
    if turn is None or "reference" not in task.recipe:
        return ""
    first = turn.labels[3 if turn.with_position else 0]
    convention = _ORIENTATION if turn.axis is None else (_TURN if turn.whole else _TILT).format(axis=turn.axis)
    return f"\n *   {first}, ...: {convention}{_row(np.ravel(task.recipe['reference']))}"


def _or_unknown(limit: float) -> str:
    return f"{limit:.6g}" if np.isfinite(limit) else "unknown"


def _row(values: Array) -> str:
    return ", ".join(f"{value:.9g}" for value in values)


def _certificate(chart: Chart) -> str:
    """What is proved of the chart in exact arithmetic; the code itself is compared with it on samples."""
    known = chart.certificate
    return "none" if known is None else f"{known.heading} ({known.method}, chart {known.fingerprint[:16]})"


def _boundary_lines(names: list[str], lower: Array, upper: Array) -> str:
    if np.isinf(lower).all():
        return " *   all joint positions"
    ranges = [
        "all positions" if np.isinf(low) else f"{low:.6g} to {high:.6g}" for low, high in zip(lower, upper, strict=True)
    ]
    return "\n".join(f" *   {name}: {range_}" for name, range_ in zip(names, ranges, strict=True))


def clear_line(domain: Domain) -> str:
    """The condition of a domain that has one."""
    condition = domain.condition
    if condition is None:
        return ""
    return f"\n *   and the {condition.heading},\n *   or else the status is OUTSIDE_DOMAIN"


def control_values(controller: Controller) -> dict[str, str]:
    """Values of the placeholders that describe the law."""
    gains = controller.gains
    torque, remarks = controller.command == "torque", words(controller.remarks())
    return {
        "k": str(len(controller.labels)),
        "reference_labels": ", ".join(words(controller.labels)),
        "gain_fields": "\n".join(f"  double {gain}[{len(gains[gain])}];{_remark(controller, gain)}" for gain in gains),
        "gain_values": ",\n".join(f"  {{{numbers(value)}}}" for value in gains.values()),
        "gain_table": "\n".join(f"| `{gain}` | {numbers(value)} |" for gain, value in gains.items()),
        "gain_arguments": "\n".join(f"  arg[{5 + i}] = gains->{gain};" for i, gain in enumerate(gains)),
        "after_gains": str(5 + len(gains)),
        "commands_torque": str(int(torque)),
        "law": controller.formula,
        "law_remarks": "".join(f"\n * Note: {remark}." for remark in remarks),
        "law_remarks_md": "".join(f"\n- Note: {remark}." for remark in remarks),
        "fallback": _fallback(controller),
        "where": _EVERYWHERE if controller.chart is None else _IN_DOMAIN,
        "command": controller.command,
    }


def _fallback(controller: Controller) -> str:
    if controller.command == "velocity":
        return "zero velocity"
    if controller.settings.get("gravity") == "robot":
        return "zero torque, because the robot compensates gravity"
    return "the gravity torque, or zero where it is not finite"


def _remark(controller: Controller, gain: str) -> str:
    units = controller.gain_units.get(gain)
    return "" if units is None else f" /* {words([units])[0]} */"
