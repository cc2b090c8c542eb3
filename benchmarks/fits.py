"""Quality and time of fits on the named problems and on two arms directly from their URDFs."""

import time
from importlib.metadata import files
from pathlib import Path
from statistics import median

from benchmark import run, table

import orthocas as oc
from orthocas import bases, problems

CASES = (
    ("iiwa", "polynomial:3"),
    ("iiwa", "polynomial:4"),
    ("iiwa", "polynomial:5"),
    ("iiwa", "polynomial:6"),
    ("iiwa", "polynomial:4:cyclic"),
    ("iiwa", "polynomial:5:cyclic"),
    ("iiwa", "polynomial:6:cyclic"),
    ("planar_3r_x", "polynomial:8"),
    ("planar_3r_xy", "polynomial:6"),
    ("panda", "polynomial:4"),
    ("ur10", "polynomial:4"),
)
ROBOTS = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
}
HEADER = (
    "| problem | parametrisation | fit, CPU [s] | task std [deg] | mutual std [deg] | conditioning mean / 1 % / min |\n"
    "| --- | --- | --- | --- | --- | --- |"
)


def build(name: str) -> oc.Problem:
    """A named problem, or a robot of example-robot-data with its hand position as the task and the default box."""
    if name in problems.names():
        return problems.get(name)
    file, tip = ROBOTS[name]
    path = next(Path(str(f.locate())).resolve() for f in files("example-robot-data") or [] if str(f).endswith(file))
    robot = oc.Robot.from_file(path, tip)
    return oc.Problem(robot, oc.Task.position(robot), name=name)


def row(name: str, label: str, runs: int, samples: int) -> str:
    """One row of the table: median CPU time of fits, quality on held-out samples."""
    problem, parametrisation = build(name), bases.parse_parametrisation(label)
    seconds = []
    for _ in range(runs):
        start = time.process_time()
        fit = oc.fit(problem, parametrisation)
        seconds.append(time.process_time() - start)
    report = oc.evaluate(fit.chart, samples)
    conditioning = report.conditioning
    return (
        f"| {name} | {label} | {median(seconds):.2f} | {report.task_angle.std:.3f} "
        f"| {report.mutual_angle.std:.3f} | {conditioning.mean:.3f} / {conditioning.p01:.3f} / {conditioning.min:.3f} |"
    )


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` uses low degrees, one run and few samples."""
    cases = [("iiwa", "polynomial:2"), ("planar_3r_xy", "polynomial:2")] if quick else CASES
    size = (1, 2_000) if quick else (3, 100_000)
    return table(HEADER, (row(*case, *size) for case in cases))


if __name__ == "__main__":
    run(main, __doc__)
