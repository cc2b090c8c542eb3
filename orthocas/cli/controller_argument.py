"""Builds a controller from command-line options, and rejects options that belong to another controller."""

from dataclasses import dataclass
from typing import Annotated

import typer

from orthocas.charts.chart import Chart
from orthocas.cli.problem_argument import parse_numbers
from orthocas.control.controller import Controller, Law
from orthocas.control.registry import law_names, law_of
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array

CONTROLLERS = law_names()
_OF_THE_PLANT = ("mass_factor", "friction")  # options for laws that command torques
_CHOICES = ("coupling", "damping", "model", "gravity", "inputs", "second")  # options that are words

Stiffness = Annotated[
    str | None,
    typer.Option("--stiffness", help='"100", or "100,50,..." per quantity; default: modes around 6 Hz.'),
]
DampingRatio = Annotated[
    str | None, typer.Option("--damping-ratio", help='"0.7", or "0.7,1,..." per quantity; default: 0.7.')
]
CouplingName = Annotated[
    str | None, typer.Option("--coupling", help="coupled (default) or decoupled; for impedance and pd_plus.")
]
DampingName = Annotated[
    str | None, typer.Option("--damping", help="double_diagonal (default) or square_root; for impedance and pd_plus.")
]
DampingStiffness = Annotated[
    str | None,
    typer.Option(
        "--damping-stiffness", help="Design the damping for this stiffness, so that --stiffness may be 0 in places."
    ),
]
ModelName = Annotated[
    str | None, typer.Option("--model", help="own (default), or given: mass matrix and torques become inputs.")
]
GravityName = Annotated[
    str | None, typer.Option("--gravity", help="law (default) compensates gravity; robot: the robot does so itself.")
]
InputNames = Annotated[
    str | None, typer.Option("--inputs", help="Additional inputs: payload, wrench, extra_torque, with commas between.")
]
PostureStiffness = Annotated[
    str | None,
    typer.Option(
        "--posture-stiffness",
        help="Stiffness of the springs in the second task; for projector. Default: modes around 6 Hz.",
    ),
]
SecondName = Annotated[
    str | None,
    typer.Option("--second", help="joints (default) or xi, what the projector moves; for projector laws."),
]
Feedback = Annotated[
    str | None,
    typer.Option("--feedback", help="Feedback gain [1/s]; for kinematic and kinematic_projector. Default: 0."),
]
Limit = Annotated[
    str | None,
    typer.Option(
        "--limit", help='Largest torque or speed, "50" or "50,40,..." per joint; default: the limits of the robot.'
    ),
]


@dataclass(frozen=True)
class ControllerOptions:
    """The command-line options that only some controllers take."""

    stiffness: str | None = None
    damping_ratio: str | None = None
    coupling: str | None = None
    posture_stiffness: str | None = None
    feedback: str | None = None
    mass_factor: float | None = None
    friction: str | None = None
    damping: str | None = None
    damping_stiffness: str | None = None
    second: str | None = None
    model: str | None = None
    gravity: str | None = None
    inputs: str | None = None


def require_options(name: str, options: ControllerOptions) -> None:
    """Check that a controller exists and takes every option that was given.

    Raises:
        UnknownNameError: if there is no such controller.
        InvalidValueError: for an option that the controller would ignore.
    """
    taken = _taken(law_of(name))
    for field, value in vars(options).items():
        if value is not None and field not in taken:
            takers = ", ".join(other for other in CONTROLLERS if field in _taken(law_of(other)))
            option = f"--{field.replace('_', '-')}"
            raise InvalidValueError(option, value, f"no {option} with {name}, because it belongs to {takers}")


def build_controller(name: str, chart: Chart, options: ControllerOptions, limit: str | None) -> Controller:
    """Build the controller that a command line describes; `require_options` has checked the options.

    Raises:
        OrthocasError: if anything does not fit together.
    """
    law = law_of(name)
    words = {field: value for field in law.options if (value := getattr(options, field)) is not None}
    settings = {
        field: word if field in _CHOICES else _one_or_all(f"--{field.replace('_', '-')}", word)
        for field, word in words.items()
    }
    return law.on_chart(chart, None if limit is None else _one_or_all("--limit", limit), **settings)


def _taken(law: type[Law]) -> tuple[str, ...]:
    """Names of the options that a law takes."""
    return (*law.options, *(_OF_THE_PLANT if law.command == "torque" else ()))


def _one_or_all(option: str, text: str) -> Array:
    """Read "100" as a number, "100,50" as an array."""
    numbers = parse_numbers(option, text)
    return numbers.reshape(()) if len(numbers) == 1 else numbers
