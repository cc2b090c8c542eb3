"""Cost of a fit against the number of joints, the degree and the number of samples: planar arms and the 7-DoF arm.

Without the fold term, whose rounds depend on the domain more than on its size.
"""

import resource

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas import problems

HEADER = (
    "| problem | n, m, r | degree | parameters | samples | fit [s] | task std [deg] | peak memory so far [MiB] |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)


def row(problem: oc.Problem, degree: int, samples: int | None = None) -> str:
    """Fit once, and print the cost."""
    fit = oc.fit(problem, oc.Polynomial(degree), samples=samples, weights=oc.Weights(folds=0))
    report = oc.evaluate(fit.chart, 10_000)
    last = fit.stages[-1]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (
        f"| {problem.name} | {problem.n}, {problem.m}, {problem.r} | {degree} | {last.parameters} | {last.samples} "
        f"| {fit.seconds:.2f} | {report.task_angle.std:.2f} | {peak:.0f} |"
    )


def planar(n: int) -> oc.Problem:
    """A planar arm with n joints, tip position and A = I, bent so that the task is regular."""
    robot = oc.Robot.planar([1.0] * n, [1.0] * n)
    box = oc.Box(np.concatenate([[0.6], np.full(n - 1, 2.0 / n)]), np.pi / 8)
    return oc.Problem(robot, oc.Task.position(robot, "xy"), domain=box, name=f"planar_{n}r")


def main(quick: bool = False) -> list[str]:
    """Rows for n, then degree, then samples."""
    iiwa = problems.get("iiwa")
    cases: list[tuple[oc.Problem, int, int | None]] = [(planar(n), 3, None) for n in (3, 4, 5, 6, 7, 8)]
    cases += [(iiwa, degree, None) for degree in (1, 2, 3, 4, 5)]
    cases += [(iiwa, 4, samples) for samples in (2_000, 4_000, 8_000, 16_000)]
    return table(HEADER, (row(*case) for case in ([(planar(3), 2, None), (iiwa, 2, 500)] if quick else cases)))


if __name__ == "__main__":
    run(main, __doc__)
