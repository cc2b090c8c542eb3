"""Angles of both losses, of charts of a whole turn of the base, and what the defect predicts of small boxes.

The task angle and the mutual angle are the paper's. Leak and conditioning are measured in the metric.
"""

from collections.abc import Iterator

from benchmark import run, table

import orthocas as oc
from orthocas import problems

LOSSES = (
    "| problem | loss | task angle, std | mutual angle, std | leak, rms | conditioning, 1 % |\n"
    "| --- | --- | --- | --- | --- | --- |"
)
TURN = "| degree | parameters | task std [deg] | mutual std [deg] |\n| --- | --- | --- | --- |"
CASES = (
    ("planar_3r_xy", 6, "inertia"),
    ("iiwa", 4, "inertia"),
    ("iiwa", 4, "euclidean"),
    ("iiwa, pose", 4, "euclidean"),
)
NAMES = {
    "planar_3r_xy": "`planar_3r_xy`",
    "iiwa": "7-DoF arm",
    "iiwa, pose": "7-DoF arm, pose",
    "inertia": "A = M",
    "euclidean": "A = I",
}
SMALL = 0.03  # half-width [rad] of the box on which the defect is compared


def problem_of(name: str, metric: str) -> oc.Problem:
    """A named problem with another metric; its pose as task, if its name says so."""
    arm, _, kind = name.partition(", ")
    known = problems.get(arm)
    task = oc.Task.named(known.robot, kind, known.domain.centre) if kind else known.task
    return oc.Problem(known.robot, task, metric, known.domain, name)


def losses(samples: int, cases: tuple[tuple[str, int, str], ...]) -> Iterator[str]:
    """A row for each problem and loss."""
    for name, degree, metric in cases:
        for loss, words in (("paper", "paper's"), ("metric", "in the metric")):
            chart = oc.fit(problem_of(name, metric), oc.Polynomial(degree), weights=oc.Weights(angles=loss)).chart
            report = oc.evaluate(chart, samples)
            first = f"{NAMES[name]}, degree {degree}, {NAMES[metric]}" if loss == "paper" else ""
            mutual = "" if chart.problem.r == 1 else f"{report.mutual_angle.std:.2f}"
            yield (
                f"| {first} | {words} | {report.task_angle.std:.2f} "
                f"| {mutual} | {report.leak.rms:.1f} | {report.conditioning.p01:.2f} |"
            )


def turns(samples: int, degrees: tuple[int, ...]) -> Iterator[str]:
    """A row for each degree: polynomials that are linear in A1, over all A1 between its limits."""
    known = problems.get("iiwa")
    robot, centre, half = known.robot, known.domain.centre.copy(), known.domain.half_width.copy()
    centre[0], half[0] = (robot.lower[0] + robot.upper[0]) / 2, (robot.upper[0] - robot.lower[0]) / 2
    problem = oc.Problem(robot, known.task, domain=oc.Box(centre, half))
    for degree in degrees:
        chart = oc.fit(problem, oc.Polynomial(degree, cyclic="auto")).chart
        report = oc.evaluate(chart, samples)
        angles = f"{report.task_angle.std:.2f} | {report.mutual_angle.std:.2f}"
        yield f"| {degree} | {chart.coordinates.size} | {angles} |"


def main(quick: bool = False) -> dict[str, float]:
    """Print both tables; `quick` takes the planar arm, low degrees and few samples.

    Returns:
        The leak that `evaluate` measures on a small box, over the one that the defect predicts; and the angles of the
        7-DoF arm's fit of degree 5 with its idle joint and without.
    """
    samples = 2_000 if quick else 100_000
    table(LOSSES, losses(samples, CASES[:1] if quick else CASES))
    print()
    table(TURN, turns(samples, (2,) if quick else (4, 5, 6)))
    known = problems.get("planar_3r_xy")
    small = oc.Problem(known.robot, known.task, known.metric, oc.Box(known.domain.centre, SMALL))
    leak = oc.evaluate(oc.fit(small, oc.Polynomial(3)).chart, samples).leak.rms
    report = oc.evaluate(oc.fit(problems.get("iiwa"), oc.Polynomial(2 if quick else 5)).chart, samples)
    assert report.without_idle is not None
    kinds = {"": report, " without idle": report.without_idle}
    angles = {
        f"{name}{kind}": getattr(of, f"{name}_angle").std for kind, of in kinds.items() for name in ("task", "mutual")
    }
    return {"leak of its prediction": leak / oc.involutivity(small).expected_leak_deg} | angles


if __name__ == "__main__":
    run(main, __doc__)
