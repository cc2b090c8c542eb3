"""Follow task values through the charts of an atlas with the posture held, and hand over where charts meet (ours)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocas.atlases.atlas import Atlas
from orthocas.chart import Chart
from orthocas.checks import Array, Indices, as_point, as_point_set, require_kind
from orthocas.errors import InverseError, PathError

_TOLERANCE = 1e-12  # of phi, relative to the sizes of its components
_HALVINGS = 8  # of a step along the path that Newton's method cannot take


@dataclass(frozen=True, eq=False)
class AtlasMotion:
    """Joint positions along a path, and the charts they were found in."""

    q: Array  #: (N, n)
    charts: Indices  #: chart of each row, (N,)
    xi: Array  #: coordinates asked for, in that chart, (N, r)

    @property
    def hand_overs(self) -> int:
        """How often the chart changed."""
        return int((np.diff(self.charts) != 0).sum())


def follow_in_atlas(atlas: Atlas, x: ArrayLike, q_start: ArrayLike) -> AtlasMotion:
    """Hold xi along a path of task values, and hand over to the next chart when q leaves the box of the current one.

    At a hand-over, the xi asked for becomes that of the current joint position in the next chart, so the posture asked
    for does not jump. A chart is left only when its box is: boxes overlap, so charts do not alternate at a border.

    Args:
        atlas: the atlas.
        x: task values in small steps, (N, m). The first is that of q_start.
        q_start: where the motion begins, (n,).

    Raises:
        PathError: if q leaves the charts, or a row of x cannot be reached.
    """
    require_kind("atlas", atlas, Atlas)
    targets = as_point_set("x", x, atlas.problem.m)[0]
    q = as_point("q_start", q_start, atlas.problem.n)
    number = _required(atlas, q, -1, 0)
    xi = atlas.xi(q, number)
    x_now = atlas.problem.task.batched(q[None])[0][0]
    rows: list[tuple[Array, int, Array]] = []
    for k, target in enumerate(targets):
        q = _stepped(atlas.chart(number, near=q), q, x_now, target, xi, _HALVINGS, k)
        x_now = target
        rows.append((q, number, xi))
        following = _required(atlas, q, number, k)
        if following != number:
            number, xi = following, atlas.xi(q, following)
    return AtlasMotion(
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows], dtype=np.int64),
        np.array([row[2] for row in rows]),
    )


def _required(atlas: Atlas, q: Array, current: int, k: int) -> int:
    number = int(atlas.chart_at(q, current))
    if number < 0:
        raise PathError(f"row {k} of x leads to q = {np.round(q, 3).tolist()}, where the atlas has no chart")
    return number


def _stepped(chart: Chart, q: Array, x_now: Array, target: Array, xi: Array, halvings: int, k: int) -> Array:
    """q with task value `target` and coordinates xi in a chart, by Newton's method, in halves if it fails."""
    try:
        phi = np.concatenate([target, xi])
        return chart.inverse(phi, q_start=q, outside=True, tolerance=_TOLERANCE)  # another chart may take over there
    except InverseError:
        if not halvings:
            raise PathError(f"row {k} of x cannot be reached with the posture held") from None
    middle = (x_now + target) / 2
    halfway = _stepped(chart, q, x_now, middle, xi, halvings - 1, k)
    return _stepped(chart, halfway, middle, target, xi, halvings - 1, k)
