"""Calls of control laws that several test files use."""

from typing import Any

from orthocas.control.controller import Controller
from orthocas.tools.checks import Array


def torque(controller: Controller, *state: Array, **gains: Any) -> tuple[Array, int]:
    values = {**controller.gains, **gains}
    command, status = controller.function(*state, *values.values())
    return command.full().ravel(), int(status)
