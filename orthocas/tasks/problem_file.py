"""A problem in a file: robot model, task, metric and domain as a JSON header and arrays."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import casadi as ca
import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.domains import domain_from_data
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.archive import Stored
from orthocas.tools.expressions import from_tape, require_tape, to_tape
from orthocas.tools.json import part

_OF_FRAMES = {"tips", "frame_names", "frame_parents", "frame_rotations", "frame_translations"}
#: what reading a header that may be anything raises, beside errors of our own
FOREIGN = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, MemoryError)


def problem_to_data(problem: Problem) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Parts 'robot' and 'problem' of a header, and arrays whose names begin with robot_ and domain_."""
    tree = problem.robot.tree
    numbers = {f.name: getattr(tree, f.name) for f in fields(tree)}
    if not tree.frame_names:  # as in older files
        numbers = {name: value for name, value in numbers.items() if name not in _OF_FRAMES}
    arrays = {f"robot_{name}": value for name, value in numbers.items() if isinstance(value, np.ndarray)}
    domain = problem.domain
    arrays |= {"domain_centre": domain.centre, "domain_half_width": domain.half_width}
    data, more = domain.to_data()
    arrays |= {f"domain_{name}": value for name, value in more.items()}
    header = {
        "robot": {name: value for name, value in numbers.items() if not isinstance(value, np.ndarray)},
        "problem": {
            "name": problem.name,
            "task": _task_data(problem.task),
            "metric": _with_tape(problem.metric.recipe, problem.metric.function),
            "domain": domain.name,
            **data,
        },
    }
    return header, arrays


def problem_from_data(header: Mapping[str, Any], arrays: Mapping[str, Stored]) -> Problem:
    """The problem of a header and arrays that may be anything.

    Raises:
        OrthocasError, and the errors that Python and NumPy have for damaged data: if they make no sense.
    """
    robot = Robot(_tree(part(header, "robot", dict), arrays))
    return _problem(robot, part(header, "problem", dict), arrays)


def _task_data(task: Task) -> dict[str, Any]:
    """A task as plain data, with the expressions of custom ones."""
    data = _with_tape(task.recipe, task.function)
    return data | {"parts": [_task_data(part) for part in task.parts]} if task.parts else data


def _with_tape(recipe: Mapping[str, Any], function: ca.Function) -> dict[str, Any]:
    """A task or metric as plain data. A custom one includes its expression."""
    return {**recipe, "tape": to_tape(function)} if recipe["kind"] == "custom" else dict(recipe)


def _tree(data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> KinematicTree:
    names = part(data, "joint_names", list)
    numbers: dict[str, Any] = {
        name.removeprefix("robot_"): array for name, array in arrays.items() if name.startswith("robot_")
    }
    for name in ("effort_limits", "velocity_limits"):  # missing in older files
        numbers.setdefault(name, np.full(len(names), np.inf))
    texts: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in data.items()}
    wanted, found = {field.name for field in fields(KinematicTree)}, {*texts, *numbers}
    if not found & _OF_FRAMES:
        wanted -= _OF_FRAMES
    if wanted != found:
        odd = f"with {sorted(found - wanted)} and without {sorted(wanted - found)}"
        raise InvalidValueError("robot", odd, "the fields of a KinematicTree")
    for name in ("joint_kinds", "parents", *sorted(_OF_FRAMES & {*data})):
        part(data, name, list)
    return KinematicTree(**texts | numbers)


def _problem(robot: Robot, data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> Problem:
    kind = part(data, "domain", str)
    task, metric = _task(robot, part(data, "task", dict)), _metric(robot, part(data, "metric", dict))
    own = {name.removeprefix("domain_"): array for name, array in arrays.items() if name.startswith("domain_")}
    return Problem(robot, task, metric, domain_from_data(kind, task, data, own), part(data, "name", str))


def _task(robot: Robot, recipe: Mapping[str, Any]) -> Task:
    if part(recipe, "kind", str) == "custom":
        labels = part(recipe, "labels", list)
        units = part(recipe, "units", list) if "units" in recipe else ()  # older files have none
        require_tape(part(recipe, "tape", dict), robot.n)
        return Task.custom(robot, part(recipe, "name", str), lambda q: from_tape(recipe["tape"], q), labels, units)
    if recipe["kind"] == "stack":
        return Task.stack(*(_task(robot, each) for each in part(recipe, "parts", list)))
    return Task.from_recipe(robot, recipe)


def _metric(robot: Robot, recipe: Mapping[str, Any]) -> Metric:
    if part(recipe, "kind", str) == "custom":
        require_tape(part(recipe, "tape", dict), robot.n)
        name = recipe.get("name", "custom")  # older files have no name
        return Metric.custom(robot, name, lambda q: from_tape(recipe["tape"], q))
    return Metric.from_spec(robot, recipe["matrix"] if recipe["kind"] == "constant" else recipe["kind"])
