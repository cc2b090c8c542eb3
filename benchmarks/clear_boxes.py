"""What a bound on the relative singular value of the task does to folds, angles and the size of the domain."""

from benchmark import run, table
from folds import least
from suggested_domains import robot_of

import orthocas as oc
from orthocas.tasks.regular_box import regular_box
from orthocas.tools.display import percent

HEADER = (
    "| robot, half-width [rad] | least singular value | share of the box | task / mutual std [deg] "
    "| leak [deg] | least conditioning | folds |\n| --- | --- | --- | --- | --- | --- | --- |"
)
CASES = (  # around the default posture, with the default degree
    ("iiwa", 0.785, (None, 0.1, 0.2)),
    ("iiwa", 1.044, (None, 0.1, 0.2)),
    ("kinova j2s6", 0.785, (None, 0.2)),
    ("kinova j2s6", 1.1, (None, 0.15, 0.2)),
)


def row(name: str, half_width: float, bound: float | None, degree: int, samples: int) -> str:
    """One fit, and its quality at samples of which two thirds lie near faces and corners."""
    robot = robot_of(name)
    task = oc.Task.position(robot)
    centre = oc.problems.get(name).domain.centre if name in oc.problems.names() else regular_box(robot, task).centre
    problem = oc.Problem(robot, task, domain=oc.Box(centre, half_width), least_singular_value=bound)
    fit = oc.fit(problem, oc.Polynomial(degree))
    report = oc.evaluate(fit.chart, min(samples, 100_000))
    smallest, folds = least(fit.chart, samples, heavy=True)
    share = problem.domain.share if isinstance(problem.domain, oc.ClearBox) else 1.0
    return (
        f"| {name}, {half_width:g} | {bound or 'none'} | {percent(share)} "
        f"| {report.task_angle.std:.2f} / {report.mutual_angle.std:.2f} | {report.leak.rms:.2f} "
        f"| {min(smallest, report.conditioning.min):.3f} | {folds} |"
    )


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes one of degree 2 and few samples."""
    cases = [(name, width, bound, 5, 1_000_000) for name, width, bounds in CASES for bound in bounds]
    return table(HEADER, (row(*case) for case in ([("iiwa", 0.785, 0.2, 2, 20_000)] if quick else cases)))


if __name__ == "__main__":
    run(main, __doc__)
