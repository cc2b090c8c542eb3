"""The loss of accuracy when closed expressions replace grown coordinates, for two metrics and several families (1 min).

The task is x of a planar arm with three joints, on the box of `planar_3r_x`. For A = I, almost nothing is lost. For
A = M, part of the box flows past saddles of the task on its way to the base leaf; exact coordinates are steep there.
"""

import argparse
from pathlib import Path

import orthocas as oc
from orthocas import problems
from orthocas.bases import Parametrisation
from orthocas.fitting.distil import Distilled


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Print a table and save the best chart.

    Args:
        out: folder for the chart.
        quick: fewer families.

    Returns:
        Task angle, std [deg] on held-out samples, by metric and family.
    """
    out.mkdir(parents=True, exist_ok=True)
    known = problems.get("planar_3r_x")
    families: list[Parametrisation] = [oc.Polynomial(2), oc.Polynomial(4)]
    families += [] if quick else [oc.Polynomial(6), oc.Polynomial(8), oc.MLP((16, 16))]
    found = {}
    print("| metric | family | value rms | gradient rms | task std [deg] | conditioning 1 %, grown / distilled |")
    print("| --- | --- | --- | --- | --- | --- |")
    for metric in ("euclidean", "inertia"):
        chart = oc.grow(oc.Problem(known.robot, known.task, metric, known.domain), leaf="linear")
        for family in families:
            lost = oc.distil(chart, family)
            print(_row(metric, family.label, lost), flush=True)
            found[f"{metric} {family.label}"] = lost.distilled.task_angle.std
            lost.chart.save(out / f"distilled_{metric}.orthocas")
    return found


def _row(metric: str, family: str, lost: Distilled) -> str:
    conditioning = f"{lost.grown.conditioning.p01:.3f} / {lost.distilled.conditioning.p01:.3f}"
    errors = f"{lost.value_rms.max():.1e} | {lost.gradient_rms.max():.1e}"
    return f"| {metric} | {family} | {errors} | {lost.distilled.task_angle.std:.3f} | {conditioning} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    main(arguments.out, arguments.quick)
