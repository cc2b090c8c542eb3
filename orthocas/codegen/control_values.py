"""What generated C says about a control law: its quantities, gains and fallback."""

from orthocas.codegen.numbers import numbers
from orthocas.codegen.words import words
from orthocas.control import Controller

_IN_DOMAIN = "OUTSIDE_DOMAIN: q lies outside the domain of the chart."
_EVERYWHERE = "This law uses no chart, so the status is never OUTSIDE_DOMAIN."


def control_values(controller: Controller) -> dict[str, str]:
    """Values of the placeholders that describe the law."""
    gains = controller.gains
    torque = controller.command == "torque"
    return {
        "k": str(len(controller.labels)),
        "reference_labels": ", ".join(words(controller.labels)),
        "gain_fields": "\n".join(f"  double {gain}[{len(gains[gain])}];{_remark(controller, gain)}" for gain in gains),
        "gain_values": ",\n".join(f"  {{{numbers(value)}}}" for value in gains.values()),
        "gain_table": "\n".join(f"| `{gain}` | {numbers(value)} |" for gain, value in gains.items()),
        "gain_arguments": "\n".join(f"  arg[{5 + i}] = gains->{gain};" for i, gain in enumerate(gains)),
        "commands_torque": str(int(torque)),
        "law": controller.formula,
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
