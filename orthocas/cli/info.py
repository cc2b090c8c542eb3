"""`orthocas info`: contents of a chart, a named problem or a robot file."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from orthocas import problems
from orthocas.bases.cyclic import cyclic_joints
from orthocas.cli.options import AsJson, ProblemName, ProblemOptions, SolidOptions, is_robot_file, spread
from orthocas.cli.output import build_reach_data, print_json, print_rows, print_table
from orthocas.errors import OptionError, RobotError, SingularTaskError
from orthocas.exact.involutivity import involutivity
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.tasks.branches import RULES as BRANCH_RULES
from orthocas.tasks.branches import branches as find_branches
from orthocas.tasks.problem import Problem, check
from orthocas.tasks.samples import NEGLIGIBLE
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array
from orthocas.tools.display import percent
from orthocas.tools.json import clean

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

_FAULTS = ("near_singular_share", "half_turn_share", "touching_share")
_SHARES = ("share", "clear_share", "share of the branch", "branches", *_FAULTS)  #: names of numbers to show in percent


@spread("words", ProblemOptions, "tip", "lock", "base")
@spread("solids", SolidOptions)
def info(
    target: ProblemName,
    words: ProblemOptions,
    branches: Annotated[
        bool, typer.Option("--branches", help="Of a robot: also the branches of its joint range, for wide charts.")
    ] = False,
    *,
    solids: SolidOptions,
    json: AsJson = False,
) -> None:
    """Show a chart, a named problem, or a robot."""
    # A robot has joints, and redundancy for usual tasks; problems and charts have a task and a domain.
    if is_robot_file(target):
        robot = words.build_robot(target)
        data = {
            **_describe_robot(robot),
            **_describe_redundancy(robot),
            **(_describe_branches(robot, None) if branches else {}),
            **_describe_collisions(solids.build_model(robot), robot.sample),
        }
    elif target in problems.names():
        problem = words.build_problem(target)
        data = {
            **_describe_problem(problem),
            **(_describe_branches(problem.robot, problem.task) if branches else {}),
            **_describe_collisions(solids.build_model(problem.robot), problem.domain.sample),
        }
    elif branches:
        raise OptionError(f"--branches requires a robot file or a named problem, not the chart {target}")
    else:
        words.require_no_robot(f"the chart {target}")
        chart = _load_chart(target)
        data = {
            **_describe_problem(chart.problem),
            "parametrisation": chart.coordinates.label,
            "parameters": chart.coordinates.size,
            **build_reach_data(chart),
            **_describe_collisions(solids.build_model(chart.problem.robot), chart.problem.domain.sample),
            "notes": dict(chart.notes),
            **({"certificate": chart.certificate.as_dict()} if chart.certificate else {}),
        }
    if json:
        print_json(data)
    else:
        then = f"orthocas {'view' if 'parametrisation' in data else 'fit'} {target}"
        # Print branches in a table of their own.
        tables = ("branches", "clearance_at_most", "postures") if branches else ()
        rows = {name: _format(value, name) for name, value in data.items() if name not in tables}
        print_rows(rows, "" if branches else then)
        if branches:
            # Columns: name, share, the clearance of wide charts where it is lower, and a posture.
            lower = data.get("clearance_at_most", {})
            table = [("branch", "share", *(("clearance at most",) if lower else ()), "a posture")]
            for name, share in data["branches"].items():
                posture = ", ".join(f"{value:.2f}" for value in data["postures"][name])
                clearance = (_format(lower.get(name, "default")),) if lower else ()
                table.append((name, percent(share), *clearance, posture))
            print_table(table, f"{then} --task pose --domain branch")


def _load_chart(target: str) -> "Chart":
    """Load a chart file or a ready chart. If a target looks like an unknown name, the error lists the known names."""
    # Takes long to import; problems and robots do not need it.
    from orthocas.charts.ready import load, names

    if target not in names() and not Path(target).exists() and not Path(target).suffix:
        ProblemOptions().build_problem(target)
    return load(target)


def _describe_robot(robot: Robot) -> dict[str, Any]:
    return {
        "joints": list(robot.joint_names),
        "kinds": list(robot.tree.joint_kinds),
        **({"mimics": list(robot.mimics)} if robot.mimics else {}),
        "lower": clean(robot.lower),
        "upper": clean(robot.upper),
        "effort_limits": clean(robot.effort_limits),
        "velocity_limits": clean(robot.velocity_limits),
        "homes": list(robot.homes),
        "tip": robot.tree.tip_name,
        **({"tips": list(robot.tips)} if robot.tree.tips else {}),
        "mass_kg": float(robot.tree.masses.sum()),
        "gravity": clean(robot.tree.gravity),
    }


def _describe_redundancy(robot: Robot) -> dict[str, Any]:
    """The number r = n - m of extra coordinates for each redundant usual task, and the joints that do not move it."""
    kinds = ("position", "pose", *(("relative_position", "relative_pose") if len(robot.tips) == 2 else ()))
    # A generic posture, in which no axes happen to be parallel.
    q = robot.tree.centre_posture + 0.1 * np.arange(1, robot.n + 1)
    coordinates, floating = {}, robot.tree.floating
    for kind in kinds:
        task = Task.named(robot, kind, q)
        J = task.batched_frame_jacobian(q[None])[0].reshape(task.m, robot.n)
        if np.linalg.matrix_rank(J) == task.m < robot.n - len(floating):
            columns = zip(robot.joint_names, J.T, strict=True)
            still = NEGLIGIBLE * np.abs(J).max()
            idle = [] if floating else [name for name, column in columns if np.abs(column).max() <= still]
            coordinates[kind] = f"r = {robot.n - len(floating) - task.m}" + (
                f", idle: {', '.join(idle)}" if idle else ""
            )
    return {"extra_coordinates": coordinates}


def _describe_branches(robot: Robot, task: Task | None) -> dict[str, Any]:
    """The branches of the joint range: their cuts, and the share of clear positions and a posture of each branch.

    A branch too singular for the default clearance of wide charts lists the largest clearance that it allows.
    """
    branching = find_branches(robot, task)
    lower = {item.name: item.clearance for item in branching if item.clearance < BRANCH_RULES.nonsingular}
    return {
        "cuts": [cut.explained for cut in branching.cuts],
        "branches": {item.name: item.share for item in branching},
        **({"clearance_at_most": lower} if lower else {}),
        "postures": {item.name: clean(item.posture) for item in branching},
    }


def _describe_collisions(collisions: Collisions | None, draw: Callable[[int, int], Array]) -> dict[str, Any]:
    """Pairs, unchecked links, and the fraction of touching postures, which `draw(count, seed)` samples."""
    # Slow to import, as in `_load_chart`.
    from orthocas.charts.quality import RULES, ContactShare

    if collisions is None:
        return {}
    found = ContactShare.of(collisions, draw(RULES.postures, RULES.seed))
    return {
        "collisions": {"pairs": len(collisions.pairs), "origin": collisions.origin},
        "unchecked": list(collisions.missing),
        "touching_share": found.fraction,
        "touching_pair" if found.touching else "nearest_pair": list(found.pair),
        "least_distance": found.deepest,
    }


def _describe_problem(problem: Problem) -> dict[str, Any]:
    checked = check(problem)
    try:
        result = involutivity(problem)
    except (SingularTaskError, RobotError) as error:
        exact: dict[str, Any] = {"verdict": f"unknown whether exact coordinates exist: {error}"}
    else:
        exact = {
            "involutivity_defect": {"mean": result.mean, "max": result.max},
            "expected_leak_deg": result.expected_leak_deg,
            "expected_angle_deg": result.expected_angle_deg,
            "verdict": result.verdict,
        }
    return {
        "problem": problem.name,
        "n": problem.n,
        "m": problem.m,
        "r": problem.r,
        "task": problem.task.name,
        "metric": problem.metric.name,
        "domain": problem.domain.name,
        "centre": problem.domain.centre.tolist(),
        "half_width": problem.domain.half_width.tolist(),
        "unbounded_joints": [problem.robot.joint_names[k] for k in problem.domain.unbounded],
        **problem.domain.report_condition(),
        "cyclic_joints": list(cyclic_joints(problem)),
        "near_singular_share": checked.singular_share,
        "half_turn_share": checked.half_turn_share,
        "most_singular_point": list(checked.most_singular_point),
        **exact,
        **_describe_robot(problem.robot),
    }


def _format(value: Any, name: str = "") -> str:
    if isinstance(value, list):
        return ("; " if name == "cuts" else ", ").join(_format(item) for item in value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_format(item, name if name in _SHARES else key)}" for key, item in value.items())
    if value is None:
        return "unlimited"
    if isinstance(value, float) and name in _SHARES:
        return percent(value, 3, fault=name in _FAULTS)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
