"""Certificates of wide polynomial charts of poses: what is proved of a branch, boxes, and CPU seconds."""

import time

from benchmark import run, table
from wide_charts import robot_of

import orthocas as oc
from orthocas.certificates import check_certificate
from orthocas.tools.display import percent

HEADER = (
    "| arm, task | proved of what is clear | proved of the box | boxes judged | parts | find [s] | check [s] |\n|"
    + " --- |" * 7
)
# Of networks, which `fit_wide` takes by itself, next to nothing is proved.
ARMS = {
    "iiwa": oc.Polynomial(6, ["A1"], without=["A7"]),
    "panda": oc.Polynomial(6, ["panda_joint1"], without=["panda_joint7"]),
    "xarm7": oc.Polynomial(6, ["joint1", "joint7"]),
}


def row(name: str, quick: bool) -> str:
    """Fit, prove and check."""
    robot = robot_of(name)
    polynomial = oc.Polynomial(3, ["A1", "A7"]) if quick else ARMS[name]
    task = oc.Task.pose(robot)
    chart = oc.fit_wide(robot, task, parametrisation=polynomial, samples=3000 if quick else None).chart
    start = time.process_time()
    found = oc.certify(chart, time_limit=2 if quick else None)
    middle = time.process_time()
    assert check_certificate(chart, found)
    end = time.process_time()
    return (
        f"| {name}, pose | {percent(found.clear_share, 3)} | {percent(found.share, 3)} | {found.boxes:,} "
        f"| {found.regular.proved_count:,} | {middle - start:.1f} | {end - middle:.1f} |"
    )


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes one arm, cubic coordinates and two seconds."""
    return table(HEADER, (row(name, quick) for name in (list(ARMS)[:1] if quick else ARMS)))


if __name__ == "__main__":
    run(main, __doc__)
