"""A problem in a file: robot model, task, metric and domain as a JSON header and arrays."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import casadi as ca
import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree
from orthocas.tasks.clear_box import CLEAR_BOX, ClearBox
from orthocas.tasks.corridor import CORRIDOR, Corridor
from orthocas.tasks.domains import Box, Domain, Torus, require_within_limits
from orthocas.tasks.metric import Metric
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.archive import Stored
from orthocas.tools.checks import require_known
from orthocas.tools.expressions import from_tape, require_tape, to_tape
from orthocas.tools.json import part

#: what reading a header that may be anything raises, beside errors of our own
FOREIGN = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, MemoryError)


def problem_to_data(problem: Problem) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Parts 'robot' and 'problem' of a header, and arrays whose names begin with robot_ and domain_."""
    tree = problem.robot.tree
    numbers = {f.name: getattr(tree, f.name) for f in fields(tree)}
    arrays = {f"robot_{name}": value for name, value in numbers.items() if isinstance(value, np.ndarray)}
    domain = problem.domain
    arrays |= {"domain_centre": domain.centre, "domain_half_width": domain.half_width}
    arrays |= {"domain_row_scale": domain.scale} if isinstance(domain, ClearBox) else {}
    if isinstance(domain, Corridor):
        arrays |= {"domain_postures": domain.postures, "domain_radius": domain.radius}
    header = {
        "robot": {name: value for name, value in numbers.items() if not isinstance(value, np.ndarray)},
        "problem": {
            "name": problem.name,
            "task": _with_tape(problem.task.recipe, problem.task.function),
            "metric": _with_tape(problem.metric.recipe, problem.metric.function),
            "domain": domain.name,
            **({"unbounded": list(domain.unbounded)} if isinstance(domain, Box) else {}),
            **(_condition(domain) if isinstance(domain, ClearBox) else {}),
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


def _condition(domain: ClearBox) -> dict[str, Any]:
    """The bound, and the rows that count if they are not J_x: older files, which do not name them, mean J_x."""
    of_x = domain.jacobian_function is domain.task.jacobian_function
    return {"least_singular_value": domain.least_singular_value, **({} if of_x else {"judged_rows": domain.rows})}


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
    if wanted != found:
        odd = f"with {sorted(found - wanted)} and without {sorted(wanted - found)}"
        raise InvalidValueError("robot", odd, "the fields of a KinematicTree")
    for name in ("joint_kinds", "parents"):
        part(data, name, list)
    return KinematicTree(**texts | numbers)


def _problem(robot: Robot, data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> Problem:
    domain = _domain(robot.n, data, arrays)
    task, metric = _task(robot, part(data, "task", dict)), _metric(robot, part(data, "metric", dict))
    if data["domain"] == CLEAR_BOX and isinstance(domain, Box):
        require_within_limits(robot, domain)  # before the task is evaluated there
        scale = part(arrays, "domain_row_scale", np.ndarray)
        rows = part(data, "judged_rows", str) if "judged_rows" in data else "frame" if task.turn is None else "x"
        domain = ClearBox(domain, task, part(data, "least_singular_value", float), scale, rows)
    if data["domain"] == CORRIDOR and isinstance(domain, Box):
        domain = Corridor(domain, *(part(arrays, f"domain_{name}", np.ndarray) for name in ("postures", "radius")))
    return Problem(robot, task, metric, domain, part(data, "name", str))


def _domain(n: int, data: Mapping[str, Any], arrays: Mapping[str, Stored]) -> Domain:
    """The box or torus of a file; for a ClearBox or a Corridor its box."""
    kind = part(data, "domain", str)
    require_known("domain", kind, ("box", "torus", CLEAR_BOX, CORRIDOR))
    if kind == "torus":
        return Torus(n)
    unbounded = part(data, "unbounded", list) if "unbounded" in data else ()  # missing in older files
    return Box(part(arrays, "domain_centre", np.ndarray), part(arrays, "domain_half_width", np.ndarray), unbounded)


def _task(robot: Robot, recipe: Mapping[str, Any]) -> Task:
    if part(recipe, "kind", str) == "custom":
        labels = part(recipe, "labels", list)
        units = part(recipe, "units", list) if "units" in recipe else ()  # older files have none
        require_tape(part(recipe, "tape", dict), robot.n)
        return Task.custom(robot, part(recipe, "name", str), lambda q: from_tape(recipe["tape"], q), labels, units)
    return Task.from_recipe(robot, recipe)


def _metric(robot: Robot, recipe: Mapping[str, Any]) -> Metric:
    if part(recipe, "kind", str) == "custom":
        require_tape(part(recipe, "tape", dict), robot.n)
        name = recipe.get("name", "custom")  # older files have no name
        return Metric.custom(robot, name, lambda q: from_tape(recipe["tape"], q))
    return Metric.from_spec(robot, recipe["matrix"] if recipe["kind"] == "constant" else recipe["kind"])
