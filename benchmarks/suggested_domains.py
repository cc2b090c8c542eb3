"""Suggested domains of real arms from their URDFs, without tuning: what ends them, and quality at many samples.

Then those of long planar arms and of two hands, with the time of a core, and a search for folds with another seed.
"""

import time
from collections.abc import Iterator
from importlib.metadata import files
from pathlib import Path

import many_joints
import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas import problems
from orthocas.charts.point_quality import worst_points
from orthocas.errors import DomainError
from orthocas.fitting.probe import evaluate_chart
from orthocas.tools.checks import Array

CASES = (  # robot, task, metric
    ("iiwa", "position", "euclidean"),
    ("panda", "position", "euclidean"),
    ("panda", "pose", "euclidean"),
    ("xarm7", "position", "euclidean"),
    ("kinova j2s6", "position", "euclidean"),
    ("ur10", "position", "euclidean"),
    ("tiago with its torso", "position", "euclidean"),
    ("iiwa", "position", "inertia"),
    ("panda", "position", "inertia"),
    ("panda", "pose", "inertia"),
    ("xarm7", "position", "inertia"),
    ("kinova j2s6", "position", "inertia"),
    ("ur5", "position", "inertia"),
    ("ur10", "position", "inertia"),
    ("tiago with its torso", "position", "inertia"),
)
ROBOTS = {  # of the package example-robot-data: file and tip
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link_eef"),
    "kinova j2s6": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "tiago with its torso": ("tiago_description/robots/tiago.urdf", "arm_tool_link"),
}
HEADER = (
    "| robot, task, metric | home | half-widths [rad or m] | leak [deg] | least conditioning |\n"
    "| --- | --- | --- | --- | --- |"
)
MANY = (
    "| many joints | n, m, r | time of a core [s] | mean half-width [rad] | leak [deg] | at samples | by descent |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)
OTHER_SEED = 100
MARKS = {"leak": "L", "conditioning": "C", "singularity": "S", "joint limit": "J", "half a turn": "H"}


def robot_of(name: str) -> oc.Robot:
    """The arm of a named problem, or a robot of example-robot-data."""
    if name in problems.names():
        return problems.get(name).robot
    file, tip = ROBOTS[name]
    path = next(Path(str(f.locate())).resolve() for f in files("example-robot-data") or [] if str(f).endswith(file))
    return oc.Robot.from_file(path, tip)


def row(name: str, task: str, metric: str, degree: int, samples: int) -> str:
    """One row of the table, with the quality at `samples` points, two thirds of them near faces and corners."""
    robot = robot_of(name)
    parametrisation = oc.Polynomial(degree, cyclic="auto")
    try:
        found = oc.suggest_domain(robot, oc.Task.named(robot, task), metric=metric, parametrisation=parametrisation)
    except DomainError as error:
        return f"| {name}, {task}, {metric} | refused: {error} | | | |"
    widths = ", ".join(f"{joint.half_width:.2f} {MARKS.get(joint.reason, joint.reason)}" for joint in found.joints)
    verdicts = [evaluate_chart(found.fit.chart, 50_000, seed=100 + k) for k in range(samples // 50_000)]
    least = min(verdict.conditioning for verdict in verdicts)
    home = "bent" if found.home_source.startswith("bent") else found.home_source
    shown = f"{least:.3f}" if least > 0 else "folds"
    return f"| {name}, {task}, {metric} | {home} | {widths} | {verdicts[0].leak_deg:.2f} | {shown} |"


def long_arms() -> Iterator[tuple[str, oc.Robot, oc.Task, Array]]:
    """Names, robots, tasks and homes of robots with many joints."""
    for n in (12, 16, 20):
        arm = oc.Robot.planar([3.0 / n] * n, [1.0] * n)
        yield f"planar, {n} joints", arm, oc.Task.position(arm, "xy"), np.full(n, many_joints.HALF_WIDTH)
    for case in many_joints.cases(quick=False):
        if case.name == "talos, both hands":
            yield case.name, case.problem.robot, case.problem.task, case.problem.domain.centre


def row_of_many(name: str, robot: oc.Robot, task: oc.Task, home: Array) -> str:
    """One row of the table of many joints; the mean is the geometric one of joints that are neither idle nor cyclic."""
    began = time.process_time()
    found = oc.suggest_domain(robot, task, home)
    seconds = time.process_time() - began
    chart = found.fit.chart
    widths = [joint.half_width for joint in found.joints if joint.reason not in ("idle", "cyclic")]
    verdict = evaluate_chart(chart, 100_000, OTHER_SEED)
    least = worst_points(chart.problem, chart.coordinates, OTHER_SEED).least
    return (
        f"| {name} | {chart.n}, {chart.m}, {chart.r} | {seconds:.0f} | {np.exp(np.mean(np.log(widths))):.2f} "
        f"| {verdict.leak_deg:.1f} | {verdict.conditioning:.2f} | {least:.2f} |"
    )


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes one arm, quadratic coordinates and few samples."""
    cases = [("ur10", "position", "euclidean")] if quick else CASES
    size = (2, 50_000) if quick else (4, 1_000_000)
    rows = table(HEADER, (row(*case, *size) for case in cases))
    return rows if quick else rows + table(MANY, (row_of_many(*case) for case in long_arms()))


if __name__ == "__main__":
    run(main, __doc__)
