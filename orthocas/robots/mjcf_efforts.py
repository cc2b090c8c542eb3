"""Ranges of MJCF elements, and the largest joint forces that they leave to the actuators."""

from dataclasses import dataclass

import numpy as np

from orthocas.robots.mjcf_document import Document
from orthocas.robots.mjcf_schema import ACTUATORS
from orthocas.robots.xml import Attributes
from orthocas.tools.checks import Array


@dataclass(frozen=True, slots=True)
class Ranges:
    """Reads ranges. An element with a range is limited unless the file says otherwise."""

    autolimits: bool  #: the compiler's setting: whether a range alone limits

    def of(self, element: Attributes, name: str = "range", switch: str = "limited") -> Array:
        """Lower and upper end, (2,); infinite if the element is not limited.

        Raises:
            RobotError: if the range is empty, or unclear.
        """
        limited = element.keyword(switch, ("true", "false", "auto"), "auto")
        lower, upper = element.numbers(name, 2, (0, 0))
        if limited == "false" or (limited == "auto" and lower == upper == 0):
            return np.array([-np.inf, np.inf])
        if limited == "auto" and not self.autolimits:
            raise element.error(
                f"has {name} but not {switch}, expected both because the compiler's autolimits is 'false'"
            )
        if lower >= upper:
            raise element.error(f"has {name} [{lower:g}, {upper:g}], expected the first below the second")
        return np.array([lower, upper])

    def reach(self, element: Attributes, name: str, switch: str) -> float:
        """The largest value that both signs of a range reach; inf without a range or if it has only one sign."""
        lower, upper = self.of(element, name, switch)
        return float(min(-lower, upper)) if lower < 0 < upper else np.inf


def effort_of_actuators(document: Document, ranges: Ranges) -> dict[str, float]:
    """The largest force [N] or torque [N m] of the actuators of each joint, by name: sum of |gear| times forcerange.

    It is inf if one of them has no forcerange. Actuators of tendons, sites and bodies are not counted.
    """
    efforts: dict[str, float] = {}
    for section in document.sections("actuator"):
        for element in section:
            joint = element.get("joint", element.get("jointinparent"))
            if element.tag in ACTUATORS and joint is not None:
                actuator = document.attributes(element)
                gear, force = abs(_gear(actuator)), ranges.reach(actuator, "forcerange", "forcelimited")
                efforts[joint] = efforts.get(joint, 0.0) + (gear * force if gear > 0 else 0.0)
    return {joint: effort for joint, effort in efforts.items() if effort > 0}  # without gear nothing is known


def _gear(actuator: Attributes) -> float:
    """The first of up to six numbers; the others belong to joints with several degrees of freedom."""
    count = min(max(len(actuator.text("gear", "1").split()), 1), 6)
    return float(actuator.numbers("gear", count, (1.0,))[0])
