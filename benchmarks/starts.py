"""Dependence of the result on the start: 20 seeds of samples and random starts for every solver, 7-DoF arm.

The spread is (largest - smallest) / median of held-out figures over the seeds. All fits are evaluated on the same
samples.
"""

from collections.abc import Sequence

from benchmark import run

import orthocas as oc
from orthocas import problems, solvers
from orthocas.fitting.compare import Comparison
from orthocas.solvers.protocol import Solver

HEADER = (
    "| parametrisation | solver | task std [deg], smallest to largest | task spread "
    "| mutual std [deg], smallest to largest | mutual spread | seconds, median |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)
ADAM = solvers.Adam(epochs=40, learning_rate=5e-3)
CASES: tuple[tuple[oc.Polynomial | oc.MLP, Sequence[Solver]], ...] = (
    (oc.Polynomial(4), (solvers.QuasiNewton(), solvers.GaussNewton())),
    (oc.Polynomial(3), (solvers.GaussNewton(), solvers.LBFGS(), solvers.Ipopt(), ADAM)),
    (oc.Polynomial(2), (solvers.GradientFlow(),)),
    (oc.MLP((16, 16)), (solvers.LBFGS(), ADAM)),
)


def row(found: Comparison) -> str:
    """The row of one parametrisation and solver."""
    (summary,) = found.summaries()
    good = [result for result in found.results if not result.failed]
    task, mutual = sorted(r.task_std_deg for r in good), sorted(r.mutual_std_deg for r in good)
    return (
        f"| {summary.parametrisation} | {summary.solver} | {task[0]:.3f} to {task[-1]:.3f} "
        f"| {summary.task_spread:.1%} | {mutual[0]:.3f} to {mutual[-1]:.3f} | {summary.mutual_spread:.1%} "
        f"| {summary.seconds:.1f} |"
    )


def main(quick: bool = False) -> None:
    """Print the table row by row; `quick` uses two seeds of a small fit."""
    print(HEADER)
    problem = problems.get("iiwa")
    few = {"seeds": 2, "samples": 2000, "held_out": 2000, "jobs": 1}
    for parametrisation, minimisers in [(oc.Polynomial(2), [solvers.GaussNewton()])] if quick else CASES:
        for minimiser in minimisers:
            found = oc.compare(problem, [parametrisation], [minimiser], **(few if quick else {"seeds": 20}))
            print(row(found), flush=True)


if __name__ == "__main__":
    run(main, __doc__)
