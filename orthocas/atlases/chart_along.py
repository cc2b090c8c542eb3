"""One chart for a motion that crosses charts of an atlas, so that closed paths close (ours)."""

from numpy.typing import ArrayLike

from orthocas.atlases.atlas import Atlas
from orthocas.atlases.corridor_problem import RADIUS, corridor_problem
from orthocas.atlases.follow import follow_in_atlas
from orthocas.chart import Chart
from orthocas.fitting.fit import fit
from orthocas.parametrisations import Polynomial

_DEGREE = 3


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
