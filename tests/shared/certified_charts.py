"""Charts that tests of certificates share."""

from functools import cache

from public_objects import planar

import orthocas as oc
from orthocas import problems
from orthocas.charts.certificate import Certificate


@cache
def chart(width: float = 0.2) -> oc.Chart:
    """The 7-DoF arm on a small cube."""
    known = problems.get("iiwa")
    problem = oc.Problem(known.robot, known.task, domain=oc.Box(known.domain.centre, width))
    return oc.fit(problem, oc.Polynomial(2), samples=300).chart


@cache
def certified(width: float = 0.2) -> Certificate:
    return oc.certify(chart(width), time_limit=20)


def fourier() -> oc.Chart:
    return oc.fit(planar("euclidean"), oc.Fourier(2), samples=300).chart
