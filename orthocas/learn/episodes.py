"""Recorded joint trajectories as trajectories of (x, xi), and back: `coordinates_of` and `joints_of`."""

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.solutions import TrackerStatus
from orthocas.errors import DomainError, InverseError
from orthocas.tools.checks import Array, as_point, as_point_set, require_kind


def coordinates_of(chart: Chart, q: ArrayLike) -> Array:
    """phi = (x, xi) of a trajectory q (T, n), such as the states or the actions of an episode; (T, n).

    It is `chart.phi` where `joints_of` finds the way back.

    Raises:
        DomainError: if a row lies outside the domain; the message names the first.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import learn, problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> q = np.linspace([0.6, 0.8, 0.8], [0.8, 0.7, 0.9], 50)
        >>> again = learn.joints_of(chart, learn.coordinates_of(chart, q), q[0])
        >>> bool(abs(again - q).max() < 1e-9)
        True
    """
    require_kind("chart", chart, Chart)
    points, _ = as_point_set("q", q, chart.n)
    outside = np.flatnonzero(~chart.problem.domain.contains(points))
    if outside.size:
        raise DomainError(f"row {outside[0]} of {len(points)} lies outside the domain, where phi may have no way back")
    return chart.phi(points)


def joints_of(chart: Chart, phi: ArrayLike, q_start: ArrayLike) -> Array:
    """The trajectory q (T, n) with phi(q) = phi (T, n) that begins next to q_start (n,), each row next to the last.

    phi alone does not tell which of several solutions was meant, so keep the first row of q with an episode.

    Raises:
        InverseError: if a row has no solution near the last one, inside the domain; the message names it.
        InvalidValueError: if q_start lies outside the domain.
    """
    require_kind("chart", chart, Chart)
    targets, _ = as_point_set("phi", phi, chart.n)
    tracker, q = chart.tracker(as_point("q_start", q_start, chart.n), largest_step=np.inf), np.empty(targets.shape)
    for k, target in enumerate(targets):
        q[k] = tracker.step(target)
        if tracker.status != TrackerStatus.OK:
            raise InverseError(f"row {k} of {len(targets)} has no q near the last one: {tracker.status.name}")
    return q
