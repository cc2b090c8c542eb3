"""Certificates: boxes, CPU seconds to find and to check, and the part that is one-to-one.

The 7-DoF arm of the paper (position) on cubes around q0, and the Panda (pose) on cubes around its default centre.
"""

import time
from importlib.metadata import files
from pathlib import Path

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas.certificates import check_certificate
from orthocas.tasks.regular_box import regular_box
from orthocas.tools.display import percent

HEADER = (
    "| task | degree | half-width [rad] | boxes judged | parts | proved | find [s] | check [s] | one-to-one [rad] |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
CASES = (
    ("iiwa, position", 3, 0.2),
    ("iiwa, position", 3, 0.4),
    ("iiwa, position", 4, 0.4),
    ("iiwa, position", 3, 0.55),
    ("iiwa, position", 5, np.pi / 4),
    ("panda, pose", 3, 0.45),
    ("panda, pose", 3, 0.6),
)


def problem_of(name: str, half_width: float) -> oc.Problem:
    """A problem on a cube."""
    if name.startswith("iiwa"):
        arm = oc.problems.get("iiwa")
        return oc.Problem(arm.robot, arm.task, domain=oc.Box(arm.domain.centre, half_width))
    path = next(Path(str(f.locate())) for f in files("example-robot-data") or [] if str(f).endswith("urdf/panda.urdf"))
    robot = oc.Robot.from_urdf(path.resolve(), "panda_hand")
    task = oc.Task.pose(robot)
    return oc.Problem(robot, task, domain=oc.Box(regular_box(robot, task).centre, half_width))


def row(name: str, degree: int, half_width: float) -> str:
    """Fit, prove, and check."""
    chart = oc.fit(problem_of(name, half_width), oc.Polynomial(degree)).chart
    start = time.process_time()
    found = oc.certify(chart)
    middle = time.process_time()
    assert check_certificate(chart, found)
    end = time.process_time()
    one = found.injective
    width = "none" if one is None else f"{(one.high[1] - one.low[1]) / 2:.2f}"
    parts = found.regular.proved_count
    return (
        f"| {name} | {degree} | {half_width:.3g} | {found.boxes:,} | {parts:,} | {percent(found.share, 0)} "
        f"| {middle - start:.1f} | {end - middle:.2f} | {width} |"
    )


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes the smallest box."""
    return table(HEADER, (row(*case) for case in (CASES[:1] if quick else CASES)))


if __name__ == "__main__":
    run(main, __doc__)
