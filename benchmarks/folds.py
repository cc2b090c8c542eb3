"""Default fits look for folds: time and quality, and the least conditioning at millions of other samples."""

import numpy as np
from benchmark import run, table
from suggested_domains import robot_of

import orthocas as oc
from orthocas.charts.point_quality import Judged
from orthocas.tasks.domains import default_box
from orthocas.tasks.samples import sample_boundary_weighted, sample_uniform

HEADER = (
    "| problem | degree | task std [deg] | mutual std [deg] | least conditioning: the fit's search | uniform "
    "| near faces and corners | folds |\n| --- | --- | --- | --- | --- | --- | --- | --- |"
)
DEGREES = (4, 5, 6)  # of the 7-DoF arm, with 10 million samples each
ROBOTS = (  # with the default box around the default home, and 400,000 samples each
    ("panda", "position"),
    ("panda", "pose"),
    ("ur10", "position"),
    ("xarm7", "position"),
    ("kinova j2s6", "position"),
)
_CHUNK = 200_000


def least(chart: oc.Chart, samples: int, heavy: bool) -> tuple[float, int]:
    """Least conditioning and number of folds at samples of the domain."""
    draw = sample_boundary_weighted if heavy else sample_uniform
    smallest, positive, negative = 1.0, 0, 0
    for k in range(max(1, samples // _CHUNK)):
        points = draw(chart.problem.domain, min(samples, _CHUNK), (1000, k))
        judged = Judged.at(chart.problem, chart.coordinates, points)
        smallest = min(smallest, float(judged.conditioning.min()))
        positive, negative = positive + int((judged.signs > 0).sum()), negative + int((judged.signs <= 0).sum())
    return smallest, min(positive, negative)


def row(problem: oc.Problem, name: str, degree: int, samples: int) -> str:
    """Fit with the default weights, and judge at half of the samples each."""
    fit = oc.fit(problem, oc.Polynomial(degree))
    report = oc.evaluate(fit.chart, samples=min(samples, 100_000))
    (uniform, some), (heavy, others) = (least(fit.chart, samples // 2, near_faces) for near_faces in (False, True))
    worst = np.nan if fit.worst is None else fit.worst.least
    return (
        f"| {name} | {degree} | {report.task_angle.std:.2f} | {report.mutual_angle.std:.2f} "
        f"| {worst:.3f} | {uniform:.3f} | {heavy:.3f} | {some + others} |"
    )


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes degree 2 of the 7-DoF arm and few samples."""
    arm = oc.problems.get("iiwa")
    oc.fit(arm, oc.Polynomial(1))  # the first call loads libraries
    cases = [(arm, "iiwa", degree, 10_000_000) for degree in DEGREES]
    for name, task in ROBOTS:
        robot = robot_of(name)
        problem = oc.Problem(robot, oc.Task.named(robot, task), domain=default_box(robot))
        cases.append((problem, f"{name}, {task}", 5, 400_000))
    return table(HEADER, (row(*case) for case in ([(arm, "iiwa", 2, 20_000)] if quick else cases)))


if __name__ == "__main__":
    run(main, __doc__)
