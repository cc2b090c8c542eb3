"""Building a controller from command-line words, and refusing words that another controller takes."""

from dataclasses import dataclass
from typing import Annotated, cast

import numpy as np
import typer

from orthocas.chart import Chart
from orthocas.checks import Array, require_known
from orthocas.cli.problem_argument import parse_numbers
from orthocas.control import (
    Controller,
    Impedance,
    Kinematic,
    KinematicProjector,
    PDPlus,
    Projector,
    matched_posture_stiffness,
    matched_stiffness,
)
from orthocas.control.damping import DampingDesign
from orthocas.control.operational_space import Coupling
from orthocas.errors import InvalidValueError

_SPRINGS, _BY_TORQUE = ("stiffness", "damping_ratio"), ("mass_factor", "friction")
_OPTIONS = {  #: which options each controller takes, by the names of fields
    "impedance": (*_SPRINGS, "coupling", "damping", *_BY_TORQUE),
    "pd_plus": (*_SPRINGS, "coupling", "damping", *_BY_TORQUE),
    "kinematic": ("feedback",),
    "projector": (*_SPRINGS, "posture_stiffness", *_BY_TORQUE),
    "kinematic_projector": ("feedback",),
}
CONTROLLERS = tuple(_OPTIONS)


Stiffness = Annotated[
    str | None, typer.Option("--stiffness", help='"100" or one for each; default 2 Hz with the median inertia.')
]
DampingRatio = Annotated[str | None, typer.Option("--damping-ratio", help="One number, or one for each; default 0.7.")]
CouplingName = Annotated[
    str | None, typer.Option("--coupling", help="coupled or decoupled, default coupled; impedance and pd_plus.")
]
DampingName = Annotated[
    str | None, typer.Option("--damping", help="square_root (default) or double_diagonal; impedance and pd_plus.")
]
PostureStiffness = Annotated[
    str | None, typer.Option("--posture-stiffness", help="Of the joint springs of projector; default 2 Hz.")
]
Feedback = Annotated[
    str | None, typer.Option("--feedback", help="[1/s], of kinematic and kinematic_projector; default 0.")
]
Limit = Annotated[
    str | None, typer.Option("--limit", help="Largest torque or speed of all joints, or of each; default none.")
]


@dataclass(frozen=True)
class ControllerOptions:
    """The words of a command line that only some controllers take."""

    stiffness: str | None = None
    damping_ratio: str | None = None
    coupling: str | None = None
    posture_stiffness: str | None = None
    feedback: str | None = None
    mass_factor: float | None = None
    friction: str | None = None
    damping: str | None = None


def require_options(name: str, options: ControllerOptions) -> None:
    """Check the name of a controller, and that it takes all options that were given.

    Raises:
        UnknownNameError: if there is no such controller.
        InvalidValueError: for an option that it would ignore.
    """
    require_known("controller", name, CONTROLLERS)
    for field, value in vars(options).items():
        if value is not None and field not in _OPTIONS[name]:
            takers = ", ".join(other for other, fields in _OPTIONS.items() if field in fields)
            raise InvalidValueError(
                f"--{field.replace('_', '-')}", value, f"no such option with {name}: it belongs to {takers}"
            )


def build_controller(name: str, chart: Chart, options: ControllerOptions, limit: str | None) -> Controller:
    """The controller that a command line describes, see `require_options`.

    Raises:
        OrthocasError: if anything does not fit together.
    """
    bounds = None if limit is None else _one_or_all("--limit", limit)
    if name == "kinematic":
        return Kinematic(chart, _one_or_all("--feedback", options.feedback or "0"), bounds)
    if name == "kinematic_projector":
        m, n = chart.m, chart.n
        feedback = _one_or_all("--feedback", options.feedback or "0")
        if feedback.ndim and len(feedback) != m + n:
            raise InvalidValueError("--feedback", options.feedback, f"one number, or {m + n}: for task, then joints")
        spread = np.broadcast_to(feedback, m + n)
        return KinematicProjector(chart.problem, spread[:m], spread[m:], bounds)
    ratio = _one_or_all("--damping-ratio", options.damping_ratio or "0.7")
    given = None if options.stiffness is None else _one_or_all("--stiffness", options.stiffness)
    if name == "projector":
        posture = options.posture_stiffness
        joints = (
            matched_posture_stiffness(chart.problem) if posture is None else _one_or_all("--posture-stiffness", posture)
        )
        stiffness = matched_stiffness(chart)[: chart.m] if given is None else given
        return Projector(chart.problem, stiffness, joints, ratio, bounds)
    law = Impedance if name == "impedance" else PDPlus
    coupling = cast(Coupling, "coupled" if options.coupling is None else options.coupling)  # the law checks it
    design = cast(DampingDesign, "square_root" if options.damping is None else options.damping)
    return law(chart, matched_stiffness(chart) if given is None else given, ratio, coupling, design, bounds)


def _one_or_all(option: str, text: str) -> Array:
    """Read "100" as a number, "100,50" as an array."""
    numbers = parse_numbers(option, text)
    return numbers.reshape(()) if len(numbers) == 1 else numbers
