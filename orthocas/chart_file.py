"""What a chart file holds: robot numbers, task, metric, domain, parametrisation and parameters."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from orthocas.archive import read_archive, write_archive
from orthocas.checks import Array
from orthocas.coordinates import Coordinates, joint_space
from orthocas.domains import Box, Domain, Torus
from orthocas.errors import ChartFileError, OrthocasError
from orthocas.expression_tape import from_tape
from orthocas.metrics import Metric
from orthocas.parametrisations import parse_parametrisation
from orthocas.problem import Problem
from orthocas.robots import KinematicTree, Robot
from orthocas.tasks import Task

Notes = Mapping[str, str | float]


def write_chart(path: str | Path, problem: Problem, coordinates: Coordinates, notes: Notes) -> None:
    """Write a chart; see `orthocas.archive` for the container.

    Raises:
        ChartFileError: if the file cannot be written.
    """
    tree = problem.robot.tree
    numbers = {f.name: getattr(tree, f.name) for f in fields(tree)}
    arrays = {f"robot_{name}": value for name, value in numbers.items() if isinstance(value, np.ndarray)}
    arrays |= {
        "theta": coordinates.theta,
        "offset": coordinates.offset,
        "scale": coordinates.scale,
        "domain_centre": problem.domain.centre,
        "domain_half_width": problem.domain.half_width,
    }
    header = {
        "robot": {name: value for name, value in numbers.items() if not isinstance(value, np.ndarray)},
        "problem": {
            "name": problem.name,
            "task": problem.task.recipe,
            "metric": problem.metric.recipe,
            "domain": problem.domain.name,
        },
        "coordinates": {"parametrisation": coordinates.parametrisation.label, "idle": list(coordinates.idle)},
        "notes": dict(notes),
    }
    write_archive(path, header, arrays)


def read_chart(path: str | Path) -> tuple[Problem, Coordinates, Notes]:
    """Read a chart back.

    Raises:
        ChartFileError: if the file is missing, truncated, foreign, edited, or from a newer version.
    """
    header, arrays = read_archive(path)
    try:
        robot = Robot(_tree(header["robot"], arrays))
        problem = _problem(robot, header["problem"], arrays)
        coordinates = Coordinates(
            parse_parametrisation(header["coordinates"]["parametrisation"]),
            joint_space(problem),
            tuple(header["coordinates"]["idle"]),
            arrays["theta"],
            arrays["offset"],
            arrays["scale"],
        )
        if coordinates.r != problem.r:
            raise ChartFileError(f"{path} has {coordinates.r} coordinates, expected r = {problem.r}")
        return problem, coordinates, dict(header["notes"])
    except ChartFileError:
        raise
    except OrthocasError as error:
        raise ChartFileError(f"{path} is inconsistent: {error}") from None
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ChartFileError(f"{path} is incomplete: {type(error).__name__} {error}") from None


def _tree(data: Mapping[str, Any], arrays: Mapping[str, Array]) -> KinematicTree:
    numbers: dict[str, Any] = {
        name.removeprefix("robot_"): array for name, array in arrays.items() if name.startswith("robot_")
    }
    texts: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in data.items()}
    return KinematicTree(**texts, **numbers)


def _problem(robot: Robot, data: Mapping[str, Any], arrays: Mapping[str, Array]) -> Problem:
    domain: Domain = (
        Torus(robot.n) if data["domain"] == "torus" else Box(arrays["domain_centre"], arrays["domain_half_width"])
    )
    return Problem(robot, _task(robot, data["task"]), _metric(robot, data["metric"]), domain, data["name"])


def _task(robot: Robot, recipe: Mapping[str, Any]) -> Task:
    if recipe["kind"] == "custom":
        return Task.custom(robot, recipe["name"], lambda q: from_tape(recipe["tape"], q), recipe["labels"])
    if recipe["kind"] in ("orientation", "pose"):
        build = Task.pose if recipe["kind"] == "pose" else Task.orientation
        return build(robot, recipe["reference"])
    return Task.named(robot, recipe["kind"])


def _metric(robot: Robot, recipe: Mapping[str, Any]) -> Metric:
    if recipe["kind"] == "custom":
        return Metric.from_spec(robot, lambda q: from_tape(recipe["tape"], q))
    return Metric.from_spec(robot, recipe["matrix"] if recipe["kind"] == "constant" else recipe["kind"])
