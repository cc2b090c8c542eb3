"""Certificates of the 7-DoF arm: boxes, seconds to find and to check, and the part that is one-to-one."""

import time

import numpy as np
from benchmark import run, table

import orthocas as oc

HEADER = (
    "| degree | half-width [rad] | boxes judged | parts | proved | find [s] | check [s] | one-to-one, half-width |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)
CASES = ((3, 0.2), (3, 0.4), (4, 0.4), (3, 0.55), (5, np.pi / 4))


def row(degree: int, half_width: float) -> str:
    """Fit, prove, and check."""
    arm = oc.problems.get("iiwa")
    problem = oc.Problem(arm.robot, arm.task, domain=oc.Box(arm.domain.centre, half_width))
    chart = oc.fit(problem, oc.Polynomial(degree)).chart
    start = time.perf_counter()
    found = oc.certify(chart)
    middle = time.perf_counter()
    assert oc.check_certificate(chart, found)
    end = time.perf_counter()
    one = found.injective
    width = "none" if one is None else f"{(one.high[0] - one.low[0]) / 2:.2f}"
    return (
        f"| {degree} | {half_width:.3g} | {found.boxes} | {found.regular.proved_count} | {found.share:.0%} "
        f"| {middle - start:.1f} | {end - middle:.2f} | {width} |"
    )


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes the smallest box."""
    return table(HEADER, (row(*case) for case in (CASES[:1] if quick else CASES)))


if __name__ == "__main__":
    run(main, __doc__)
