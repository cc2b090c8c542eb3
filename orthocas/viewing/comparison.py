"""One closed tool path, followed twice: with constant coordinates, and by the pseudo-inverse, which drifts."""

from collections.abc import Callable

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array, as_point_set, require_count, require_kind
from orthocas.errors import InvalidValueError, PathError
from orthocas.inverting import TrackerStatus
from orthocas.viewing.motion import Motion

_PERIOD = 5.0  # [s] of a cycle
_POINTS = 250  # of a cycle
_SHARE, _SMALLEST = 0.6, 1e-3  # radius of the default circle, as a share of how far the task moves over the domain
_MOST_CYCLES = 20
_CORRECTIONS = 2
_CLOSED = 1e-9

Place = Callable[[Array], Array]  #: shares of a cycle (N,) -> task values (N, m)


def cyclic_motions(chart: Chart, path: Array | None = None, cycles: int = 3) -> tuple[Motion, Motion]:
    """The joints along a closed tool path with constant xi, and along the same path by the pseudo-inverse.

    The second takes the shortest step of the joints in each interval, q' = q + J_x^+ (x' - h(q)), corrected until the
    tool is on the path. Both begin at the centre of the domain.

    Args:
        chart: a fitted chart.
        path: task values of waypoints of a closed path (N, m), joined by straight lines; its first point should be near
            the task value at the centre. Default: the largest of some circles there that the chart can follow.
        cycles: how often.

    Raises:
        PathError: if the path is not closed, or leaves the domain with constant xi.
        NoExpressionError: for grown charts.
    """
    require_kind("chart", chart, Chart)
    require_count("cycles", cycles, most=_MOST_CYCLES)
    times, shares = _timing(cycles)
    start = chart.problem.domain.centre
    if path is None:
        along, q = _largest_circle(chart, start, shares)
    else:
        along = _polygon(chart, path)
        q = _with_constant_xi(chart, along(shares), start)
    x = along(shares)
    ends = tuple(_PERIOD * (k + 1) for k in range(cycles))
    other = _by_pseudo_inverse(chart, x, q[0])
    labels = chart.labels[: chart.m]
    return (
        Motion("constant ξ", times, q, labels, x, cycles=ends),
        Motion("pseudo-inverse", times, other, labels, chart.task(other), cycles=ends),
    )


def _timing(cycles: int) -> tuple[Array, Array]:
    """Instants [s], and the share of a cycle that is done: from rest to rest in each cycle."""
    t = np.linspace(0.0, 1.0, _POINTS + 1)
    share = t**3 * (10 - 15 * t + 6 * t**2)
    times = _PERIOD * np.concatenate([[0.0], *(k + t[1:] for k in range(cycles))])
    return times, np.concatenate([[0.0], *(share[1:] for _ in range(cycles))])


def _largest_circle(chart: Chart, start: Array, shares: Array) -> tuple[Place, Array]:
    """A circle in the first two components of the task, or a line in one, as large as the chart can follow."""
    x0, m = chart.task(start), min(chart.m, 2)
    radius = _SHARE * float(chart.phi_sizes[:m].min())
    while True:

        def along(share: Array, radius: float = radius) -> Array:
            angle = 2 * np.pi * share
            across = radius * np.stack([np.cos(angle) - 1, np.sin(angle)], axis=-1)
            return x0 + np.pad(across[..., 2 - m :], ((0, 0), (0, chart.m - m)))

        try:
            return along, _with_constant_xi(chart, along(shares), start)
        except PathError:
            radius /= 1.3
            if radius < _SMALLEST * float(chart.phi_sizes[:m].min()):
                raise


def _polygon(chart: Chart, path: Array) -> Place:
    """Straight lines between waypoints."""
    points, _ = as_point_set("path", path, chart.m)
    sizes = chart.phi_sizes[: chart.m]
    if len(points) < 3 or np.abs((points[-1] - points[0]) / sizes).max() > _CLOSED:
        raise PathError(f"the path of {len(points)} waypoints is not closed, expected its last to be its first")
    lengths = np.linalg.norm(np.diff(points, axis=0) / sizes, axis=1)
    if not lengths.sum() > 0:
        raise InvalidValueError("path", "one point", "waypoints at different places")
    place = np.append(0.0, np.cumsum(lengths)) / lengths.sum()
    return lambda share: np.column_stack([np.interp(share, place, column) for column in points.T])


def _with_constant_xi(chart: Chart, x: Array, start: Array) -> Array:
    """Joint positions (N, n) with task values x (N, m) and the coordinates of the start."""
    xi = chart.xi(start)
    q = chart.solve(np.concatenate([x[0], xi]), start).require(inside=True).q[0]
    tracker = chart.tracker(q)
    found = np.empty((len(x), chart.n))
    for k, value in enumerate(x):
        found[k] = tracker.step(np.concatenate([value, xi]))
        if tracker.status is not TrackerStatus.OK:
            raise PathError(
                f"the path cannot be followed with constant xi from point {k} of {len(x)}: {tracker.status.name}"
            )
    return found


def _by_pseudo_inverse(chart: Chart, x: Array, start: Array) -> Array:
    """Joint positions (N, n) with task values x (N, m), each by the shortest step from the one before."""
    task, q = chart.problem.task, start
    found = np.empty((len(x), chart.n))
    for k, value in enumerate(x):
        for _ in range(_CORRECTIONS + 1):
            J = task.batched_jacobian(q[None])[0].reshape(chart.m, chart.n)
            q = q + np.linalg.lstsq(J, value - chart.task(q), rcond=None)[0]
        found[k] = q
    return found
