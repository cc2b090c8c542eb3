"""What the header of generated C says about robot, frames, task and chart."""

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.codegen.words import words
from orthocas.domains import Conditioned, Domain, borders
from orthocas.files.chart_file import fingerprint
from orthocas.robots.tip_turn import TipTurn
from orthocas.tasks import Task

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
        "extra_labels": ", ".join(words(chart.labels[chart.m :])),
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
    """The borders of a domain, joint by joint, and its condition on singular values."""
    return _border_lines(names, *borders(domain)) + clear_line(domain)


def _angles(chart: Chart) -> str:
    """Which extra coordinates are circle-valued."""
    found = [label for label, turn in zip(words(chart.labels), chart.turns, strict=True) if turn]
    return "".join(_ANGLE.format(label=label) for label in found)


def _with_units(task: Task) -> list[str]:
    units = [f" [{unit}]" if unit else "" for unit in task.units]
    return [label + unit for label, unit in zip(words(task.labels), words(units), strict=True)]


def _orientation(task: Task) -> str:
    """The convention of orientation components, and their reference rotation."""
    turn = TipTurn.of_kind(task.recipe["kind"])
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


def _border_lines(names: list[str], lower: Array, upper: Array) -> str:
    if np.isinf(lower).all():
        return " *   all joint positions"
    ranges = [
        "all positions" if np.isinf(low) else f"{low:.6g} to {high:.6g}" for low, high in zip(lower, upper, strict=True)
    ]
    return "\n".join(f" *   {name}: {range_}" for name, range_ in zip(names, ranges, strict=True))


def clear_line(domain: Domain) -> str:
    """The condition of a domain that has one."""
    if not isinstance(domain, Conditioned):
        return ""
    return f"\n *   and the {domain.heading},\n *   or else the status is OUTSIDE_DOMAIN"
