"""Builds the problem of `--corridor`, whose domain is the surroundings of a path of postures."""

from pathlib import Path
from typing import Annotated

import typer

from orthocas.atlases.corridor_problem import RADIUS, corridor_problem
from orthocas.cli.output import number
from orthocas.cli.problem_argument import ProblemOptions, build_problem
from orthocas.errors import InvalidValueError
from orthocas.problem import Problem
from orthocas.robots.postures_file import read_postures

CorridorPath = Annotated[
    Path | None,
    typer.Option(
        "--corridor",
        metavar="POSTURES.csv",
        help="Domain: the surroundings of a path of postures, one a line, with the joint names in the first line.",
    ),
]
CorridorRadius = Annotated[
    float | None,
    typer.Option("--radius", parser=number, help=f"Of the corridor [rad]; default {RADIUS:g}."),
]


def corridor_or_box(name: str, options: ProblemOptions, path: Path | None, radius: float | None) -> Problem:
    """The problem of a command line, near the postures of a file if one is given.

    Raises:
        OrthocasError: if anything does not fit together.
    """
    if path is None:
        if radius is not None:
            raise InvalidValueError("--radius", radius, "--corridor with it")
        return build_problem(name, options)
    for option in ("centre", "home", "half_width", "least_singular_value"):
        value = getattr(options, option)
        if value is not None:
            raise InvalidValueError(f"--{option.replace('_', '-')}", value, "none with --corridor, which is the domain")
    known = build_problem(name, options)
    return corridor_problem(known, read_postures(path, known.robot), RADIUS if radius is None else radius)
