"""Charts along paths: one for a corridor, or the charts of an atlas, one after the other."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocas.atlas.atlas import Atlas
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.errors import InverseError, PathError
from orthocas.fitting.corridor_problem import RADIUS, corridor_problem
from orthocas.fitting.fit import fit
from orthocas.tools.checks import Array, Indices, as_point, as_point_set, require_kind

_TOLERANCE = 1e-12  # of phi, relative to the sizes of its components
_HALVINGS = 8  # of a step along the path that Newton's method cannot take
_DEGREE = 3


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
    for does not jump. A chart is left only when its box is: boxes overlap, so charts do not alternate at a boundary.

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


def chart_along(atlas: Atlas, x: ArrayLike, q_start: ArrayLike, radius: float = RADIUS) -> Chart:
    """Plan a path of the tool through an atlas, with hand-overs, and fit one chart to the surroundings of the postures.

    The charts of an atlas have leaves of their own, so a closed path that crosses them leaves some posture over. One
    chart has one xi: with xi held in it, every closed path inside brings the posture back.

    Args:
        atlas: the atlas.
        x: task values in small steps, (N, m). The first is that of q_start.
        q_start: where the motion begins, (n,).
        radius: of the corridor around the postures [rad]; see `corridor_problem`.

    Raises:
        PathError: if the path leaves the charts of the atlas.
        InvalidValueError, ShapeError: if an argument is invalid.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> start, turn = np.array([0.6, 0.8, 0.8]), np.linspace(0, 2 * np.pi, 50)[:, None]
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "arm.orthocas-atlas"
        ...     atlas = oc.build_atlas(problems.get("planar_3r_xy"), path, region=[start], radius=0.2, jobs=1)
        ...     x = atlas.problem.task.batched(start[None])[0] + 0.1 * np.hstack([np.cos(turn) - 1, np.sin(turn)])
        ...     chart = oc.chart_along(atlas, x, start)
        >>> q, xi = start, chart.xi(start)
        >>> for wanted in x:
        ...     q = chart.inverse(np.concatenate([wanted, xi]), q_start=q)
        >>> bool(np.abs(q - start).max() < 1e-9)
        True
    """
    motion = follow_in_atlas(atlas, x, q_start)
    return fit(corridor_problem(atlas.problem, motion.q, radius), Polynomial(_DEGREE, "auto")).chart
