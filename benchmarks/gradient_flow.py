"""The gradient flow beside L-BFGS: processor time, evaluations, and the loss that each ends with (2 min).

Both minimise the same objectives from the same starts. A ratio is that of the processor times of one run.
"""

import time

from benchmark import run

import orthocas as oc
from orthocas import problems, solvers

HEADER = (
    "| problem | coordinates | L-BFGS: seconds | evaluations | loss "
    "| flow: seconds | evaluations | loss | end | ratio |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
CASES: tuple[tuple[str, oc.Polynomial | oc.MLP], ...] = (
    ("planar_3r_xy", oc.Polynomial(4)),
    ("planar_3r_x", oc.Polynomial(4)),
    ("iiwa", oc.Polynomial(3)),
    ("planar_3r_xy", oc.MLP((16, 16))),
    ("planar_3r_xy", oc.MLP((32, 32))),
    ("planar_3r_x", oc.MLP((32, 32))),
)


def fitted(problem: oc.Problem, parametrisation: oc.Polynomial | oc.MLP, flow: bool) -> tuple[float, int, float, str]:
    """Processor time of a fit [s], evaluations of all its stages, loss and status of the last one."""
    start = time.process_time()
    stages = oc.fit(problem, parametrisation, solvers.GradientFlow() if flow else solvers.LBFGS()).stages
    seconds, last = time.process_time() - start, stages[-1].result
    return seconds, sum(stage.result.evaluations for stage in stages), last.value, last.status.name.lower()


def main(quick: bool = False) -> None:
    """Print the table row by row; `quick` takes the first case only."""
    print(HEADER)
    oc.fit(problems.get("planar_3r_x"), oc.Polynomial(2))  # so that nobody pays for what is built once
    for name, parametrisation in CASES[:1] if quick else CASES:
        problem = problems.get(name)
        ours, theirs = (fitted(problem, parametrisation, flow) for flow in (True, False))
        print(
            f"| {name} | {parametrisation.label} | {theirs[0]:.1f} | {theirs[1]} | {theirs[2]:.4g} | {ours[0]:.1f} "
            f"| {ours[1]} | {ours[2]:.4g} | {ours[3]} | {ours[0] / theirs[0]:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    run(main, __doc__)
