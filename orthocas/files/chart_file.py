"""What a chart file holds: robot numbers, task, metric, domain, and the fitted or grown coordinates."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.tape import from_tape, to_tape
from orthocas.checks import require_count, require_known
from orthocas.coordinates.fitted import Coordinates
from orthocas.coordinates.map import CoordinateMap
from orthocas.domains import Box, Domain, Torus
from orthocas.errors import ChartFileError, OrthocasError
from orthocas.files.archive import Kind, Stored, read_archive, write_archive
from orthocas.growing import GrownCoordinates, leaf_from_arrays
from orthocas.metrics import Metric
from orthocas.parametrisations import JointSpace, parametrisation_from_data, parametrisation_to_data
from orthocas.problem import Problem
from orthocas.robots import KinematicTree, Robot
from orthocas.tasks import Task

CHART = Kind("chart", 1, ChartFileError)
Notes = Mapping[str, str | float]
_LEAF = "leaf_"  # of the names of arrays that belong to a base leaf


def write_chart(
    path: str | Path, problem: Problem, coordinates: CoordinateMap, notes: Notes, force: bool = False
) -> None:
    """Write a chart; see `orthocas.files.archive` for the container.

    Raises:
        ChartFileError: if the file cannot be written, or would replace something other than a chart without `force`.
    """
    tree = problem.robot.tree
    numbers = {f.name: getattr(tree, f.name) for f in fields(tree)}
    arrays = {f"robot_{name}": value for name, value in numbers.items() if isinstance(value, np.ndarray)}
    arrays |= {"domain_centre": problem.domain.centre, "domain_half_width": problem.domain.half_width}
    description, numbers_of_coordinates = _coordinates_to_data(coordinates)
    arrays |= numbers_of_coordinates
    header = {
        "robot": {name: value for name, value in numbers.items() if not isinstance(value, np.ndarray)},
        "problem": {
            "name": problem.name,
            "task": _with_tape(problem.task.recipe, problem.task.function),
            "metric": _with_tape(problem.metric.recipe, problem.metric.function),
            "domain": problem.domain.name,
        },
        "coordinates": description,
        "notes": dict(notes),
    }
    write_archive(path, CHART, header, arrays, force)


def read_chart(path: str | Path) -> tuple[Problem, CoordinateMap, Notes]:
    """Read a chart back.

    Raises:
        ChartFileError: if the file is missing, truncated, foreign, edited, or from a newer version.
    """
    header, arrays = read_archive(path, CHART)
    try:
        robot = Robot(_tree(header["robot"], arrays))
        problem = _problem(robot, header["problem"], arrays)
        coordinates = _coordinates(problem, header["coordinates"], arrays)
        if coordinates.r != problem.r:
            raise ChartFileError(f"{path} has {coordinates.r} coordinates, expected r = {problem.r}")
        return problem, coordinates, dict(header["notes"])
    except ChartFileError:
        raise
    except OrthocasError as error:
        raise ChartFileError(f"{path} is inconsistent: {error}") from None
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, MemoryError) as error:
        raise ChartFileError(f"{path} is incomplete: {type(error).__name__} {error}") from None


def _coordinates_to_data(coordinates: CoordinateMap) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Coordinates as plain data and arrays."""
    if isinstance(coordinates, GrownCoordinates):
        arrays = {f"{_LEAF}{name}": array for name, array in coordinates.leaf.to_arrays().items()}
        return {"leaf": coordinates.leaf.kind}, arrays
    assert isinstance(coordinates, Coordinates)
    data = {**parametrisation_to_data(coordinates.parametrisation), "idle": list(coordinates.idle)}
    return data, {"theta": coordinates.theta, "offset": coordinates.offset, "scale": coordinates.scale}


def _coordinates(problem: Problem, data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> CoordinateMap:
    if "leaf" in data:
        own = {name.removeprefix(_LEAF): array for name, array in arrays.items() if name.startswith(_LEAF)}
        return GrownCoordinates(problem, leaf_from_arrays(problem, data["leaf"], own))
    return Coordinates(
        parametrisation_from_data(data),
        JointSpace.of(problem),
        _idle(data["idle"], problem.n),
        arrays["theta"],
        arrays["offset"],
        arrays["scale"],
    )


def _with_tape(recipe: Mapping[str, Any], function: ca.Function) -> dict[str, Any]:
    """A task or metric as plain data; a custom one with its expression."""
    return {**recipe, "tape": to_tape(function)} if recipe["kind"] == "custom" else dict(recipe)


def _idle(joints: list[int], n: int) -> tuple[int, ...]:
    """Idle joints, checked."""
    idle = tuple(require_count("idle joint", k, least=0) for k in joints)
    if len(set(idle)) != len(idle) or any(k >= n for k in idle):
        raise ChartFileError(f"idle joints {list(idle)} do not fit {n} joints")
    return idle


def _tree(data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> KinematicTree:
    numbers: dict[str, Any] = {
        name.removeprefix("robot_"): array for name, array in arrays.items() if name.startswith("robot_")
    }
    for name in ("effort_limits", "velocity_limits"):  # unknown to older files
        numbers.setdefault(name, np.full(len(data["joint_names"]), np.inf))
    texts: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in data.items()}
    return KinematicTree(**texts, **numbers)


def _problem(robot: Robot, data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> Problem:
    require_known("domain", data["domain"], ("box", "torus"))
    box = Box(arrays["domain_centre"], arrays["domain_half_width"])
    domain: Domain = Torus(robot.n) if data["domain"] == "torus" else box
    return Problem(robot, _task(robot, data["task"]), _metric(robot, data["metric"]), domain, data["name"])


def _task(robot: Robot, recipe: Mapping[str, Any]) -> Task:
    if recipe["kind"] == "custom":
        labels, units = recipe["labels"], recipe.get("units", ())  # older files have no units
        return Task.custom(robot, recipe["name"], lambda q: from_tape(recipe["tape"], q), labels, units)
    return Task.from_recipe(robot, recipe)


def _metric(robot: Robot, recipe: Mapping[str, Any]) -> Metric:
    if recipe["kind"] == "custom":
        name = recipe.get("name", "custom")  # older files have no name
        return Metric.custom(robot, name, lambda q: from_tape(recipe["tape"], q))
    return Metric.from_spec(robot, recipe["matrix"] if recipe["kind"] == "constant" else recipe["kind"])
