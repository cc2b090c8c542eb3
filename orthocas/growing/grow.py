"""Growing a chart: choose a base leaf, chart it, and carry its coordinates along the task gradients."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocas.chart import Chart
from orthocas.checks import Array, as_float_array, frozen_array, require_count, require_known, require_shape
from orthocas.domains import Box, Torus, sample_evenly
from orthocas.errors import GrowError, InvalidValueError, NotInvolutiveError
from orthocas.growing.circle_leaf import circle_leaf
from orthocas.growing.disk_leaf import CELLS, disk_leaf
from orthocas.growing.flow import TaskFlow
from orthocas.growing.grown import GrownCoordinates
from orthocas.growing.leaf import LeafChart, turning_joints
from orthocas.growing.leaves import LEAVES
from orthocas.growing.linear_leaf import linear_leaf
from orthocas.involutivity import involutivity
from orthocas.problem import Problem

_PROBES = 1000  # samples of the domain that are pulled to see where a leaf has to reach
_MARGIN = 1.15  # of that region


@dataclass(frozen=True, eq=False)
class GrownChart(Chart):
    """A chart with grown coordinates, apart from `function` with the interface of fitted ones.

    `coordinates` tells more: its base `leaf`, and where points meet it (`pull`), with a status for each.
    """

    coordinates: GrownCoordinates


def grow(
    problem: Problem,
    level: ArrayLike | None = None,
    leaf: str | None = None,
    origin: ArrayLike | None = None,
    region: Box | None = None,
    cells: int = CELLS,
) -> GrownChart:
    """Exact coordinates, J_x A^-1 J_xi^T = 0, carried from a base leaf along the task gradients ([AS2023] Sec. 5).

    Args:
        problem: with m = 1, or with a task whose gradients are involutive in the metric.
        level: task value x0 of the base leaf, a number or (m,); default that of the origin.
        leaf: how the base leaf is charted. "linear": xi0 = N^T (q - origin), any n. "circle": by arc length, scaled to
            (-pi, pi], for a closed leaf with r = 1. "disk": by a harmonic map of a triangle mesh onto the unit disk,
            for n = 3, m = 1. Default: "circle" for r = 1 on a torus, "disk" for n = 3 and m = 1, otherwise "linear".
        origin: joint position (n,) whose end on the leaf is the origin of "linear" and "circle"; default the centre of
            the domain, or, if the flow from there is singular, a point of the domain from where it is not.
        region: for "disk", the box whose part of the leaf is charted; default the domain if it spans whole turns,
            otherwise a box around all that the domain is pulled to.
        cells: for "disk", number of mesh cells along the longest edge of the region.

    Returns:
        The chart. Values are NaN where a flow runs into a singularity or ends outside the chart of the leaf:
        `chart.coordinates.pull(points).status` tells.

    Raises:
        NotInvolutiveError: if m >= 2 and the task gradients are not involutive, so that the result would depend on
            the path.
        NotADiskError: if that part of the leaf is no disk; says what it is.
        GrowError: if the leaf cannot be reached, closed or charted.
    """
    leaf = leaf or _default_leaf(problem)
    require_known("leaf", leaf, LEAVES)
    cells = require_count("cells", cells, least=2)
    require_involutive(problem)
    x0 = _level(problem, level, origin)
    chart = GrownChart(problem, GrownCoordinates(problem, _leaf_chart(problem, leaf, x0, origin, region, cells)))
    if not np.isfinite(chart.coordinates.xi(sample_evenly(problem.domain, 50, 0))).any():
        raise GrowError(f"no sample of the domain reaches the charted part of the leaf h(q) = {x0.tolist()}")
    return chart


def require_involutive(problem: Problem) -> None:
    """Raise NotInvolutiveError unless the task gradients are involutive."""
    if problem.m == 1:
        return
    found = involutivity(problem, samples=300)
    if not found.exact:
        raise NotInvolutiveError(
            f"the gradients of task '{problem.task.name}' are not involutive (defect mean {found.mean:.3g}, "
            f"max {found.max:.3g}): coordinates grown along them would depend on the path; fit them with orthocas.fit"
        )


def _default_leaf(problem: Problem) -> str:
    if problem.r == 1 and isinstance(problem.domain, Torus):
        return "circle"
    return "disk" if (problem.n, problem.m) == (3, 1) else "linear"


def _leaf_chart(
    problem: Problem, leaf: str, x0: Array, origin: ArrayLike | None, region: Box | None, cells: int
) -> LeafChart:
    if leaf == "disk":
        return disk_leaf(problem, x0, region or _region(problem, x0), cells)
    start = _start(problem, x0, origin)
    if leaf == "linear":
        return linear_leaf(problem, start)
    if problem.r != 1:
        raise GrowError(f"a circle chart is for r = 1, got r = {problem.r}")
    return circle_leaf(problem, x0, start)


def _level(problem: Problem, level: ArrayLike | None, origin: ArrayLike | None) -> Array:
    if level is None:
        q = problem.domain.centre if origin is None else frozen_array("origin", origin, (problem.n,))
        return np.asarray(problem.task.batched(q[None])[0][0])
    values = np.atleast_1d(as_float_array("level", level))
    require_shape("level", values.shape, (problem.m,))
    return frozen_array("level", values, (problem.m,))


def _start(problem: Problem, x0: Array, origin: ArrayLike | None) -> Array:
    """The point of the leaf that the origin is pulled to, (n,)."""
    if origin is not None:
        candidates = frozen_array("origin", origin, (problem.n,))[None]
    else:
        candidates = np.vstack([problem.domain.centre, sample_evenly(problem.domain, _PROBES, 0)])
    pulled = TaskFlow(problem).pull(candidates, x0, 1e-13)
    reached = np.flatnonzero(pulled.reached)
    if reached.size == 0:
        where = "the origin" if origin is not None else "any sample of the domain"
        raise GrowError(f"the leaf h(q) = {x0.tolist()} cannot be reached from {where}")
    return np.asarray(pulled.points[reached[0]])


def _region(problem: Problem, x0: Array) -> Box:
    """A box that holds the part of the leaf that the domain is pulled to."""
    domain = problem.domain
    whole = (domain.half_width >= np.pi - 1e-9) & turning_joints(problem)
    if whole.any():
        return Box(domain.centre, domain.half_width)
    pulled = TaskFlow(problem).pull(sample_evenly(domain, _PROBES, 0), x0)
    if not pulled.reached.any():
        raise InvalidValueError("level", x0.tolist(), "a task value that the flow from the domain reaches")
    low, high = pulled.points[pulled.reached].min(axis=0), pulled.points[pulled.reached].max(axis=0)
    return Box((low + high) / 2, (high - low) / 2 * _MARGIN)
