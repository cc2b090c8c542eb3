"""Building a problem from command-line words: a named problem or a robot file, with overrides."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from orthocas import problems
from orthocas.checks import Array
from orthocas.cli.output import number
from orthocas.domains import default_box
from orthocas.errors import InvalidValueError, UnknownNameError
from orthocas.problem import Problem
from orthocas.robots import Robot
from orthocas.tasks import Task

ProblemName = Annotated[str, typer.Argument(metavar="PROBLEM|FILE.urdf", help="A named problem, or a URDF file.")]
TipName = Annotated[str | None, typer.Option("--tip", help="Tip frame of a URDF file; default the end of its chain.")]
TaskName = Annotated[str | None, typer.Option("--task", help="position, position:xy, polar, orientation or pose.")]
MetricName = Annotated[str | None, typer.Option("--metric", help="euclidean or inertia.")]
CentreText = Annotated[str | None, typer.Option("--centre", help='Centre of the domain, "0,0.5,..." [rad or m].')]
HalfWidth = Annotated[
    float | None, typer.Option("--half-width", parser=number, help="Half-width of the domain [rad or m].")
]


@dataclass(frozen=True)
class ProblemOptions:
    """The words of a command line that describe a problem."""

    tip: str | None = None
    task: str | None = None
    metric: str | None = None
    centre: str | None = None
    half_width: float | None = None

    def given(self) -> bool:
        """Whether any was given."""
        return any(value is not None for value in (self.tip, self.task, self.metric, self.centre, self.half_width))


def is_robot_file(name: str) -> bool:
    """Whether a PROBLEM argument means a robot file."""
    return Path(name).suffix.lower() in (".urdf", ".xml")


def build_problem(name: str, options: ProblemOptions) -> Problem:
    """Build the problem that a command line describes.

    Joints of a robot file that do not move the tip are locked.

    Raises:
        UnknownNameError: if it is neither a named problem nor a robot file.
        OrthocasError: if anything does not fit together.
    """
    if is_robot_file(name):
        return _from_file(Path(name), options)
    if name not in problems.names():
        raise UnknownNameError("problem", name, (*problems.names(), "or a FILE.urdf"))
    base = problems.get(name)
    if not options.given():
        return base
    if options.tip is not None:
        raise InvalidValueError("--tip", options.tip, f"no tip for the named problem '{name}', it has its own")
    centre = base.domain.centre if options.centre is None else parse_numbers("--centre", options.centre)
    kept = options.centre is None and options.half_width is None
    domain = base.domain if kept else default_box(base.robot, centre, options.half_width)
    task = base.task if options.task is None else Task.named(base.robot, options.task, domain.centre)
    return Problem(base.robot, task, base.metric if options.metric is None else options.metric, domain, name)


def parse_numbers(option: str, text: str) -> Array:
    """Read "0,0.5,..."."""
    words = [part.strip() for part in text.split(",")]
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        raise InvalidValueError(option, words, "an array of numbers") from None


def _from_file(path: Path, options: ProblemOptions) -> Problem:
    robot = Robot.chain_from_file(path, options.tip)
    centre = None if options.centre is None else parse_numbers("--centre", options.centre)
    domain = default_box(robot, centre, options.half_width)
    task = Task.named(robot, "position" if options.task is None else options.task, domain.centre)
    return Problem(robot, task, "euclidean" if options.metric is None else options.metric, domain, path.stem)
