"""Growing of a chart: choose a base leaf, chart it, and carry its coordinates along the task gradients."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import GrownChart
from orthocas.errors import GrowError, InvalidValueError, NotInvolutiveError
from orthocas.exact.flow import GrownCoordinates, TaskFlow
from orthocas.exact.involutivity import involutivity
from orthocas.exact.leaves import (
    CELLS,
    LEAVES,
    CircleLeaf,
    Leaf,
    LeafChart,
    build_disk_leaf,
    build_linear_leaf,
    find_turning_joints,
    trace_circle_leaf,
)
from orthocas.robots.tree import require_driven
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem, check
from orthocas.tasks.samples import sample_evenly
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_point,
    freeze_array,
    require_count,
    require_kind,
    require_known,
    require_shape,
)

_PROBES = 1000  # samples of the domain that are pulled to the leaf to find the part of it that must be charted
_FEWEST_CELLS = 10  # smallest number of mesh cells along the longest edge of a region
_MARGIN = 1.15  # size of the default region, relative to the box of the pulled samples


def grow(
    problem: Problem,
    level: ArrayLike | None = None,
    leaf: Leaf | None = None,
    origin: ArrayLike | None = None,
    region: Box | None = None,
    cells: int | None = None,
) -> GrownChart:
    """Grow exact coordinates, J_x A^-1 J_xi^T = 0, from a base leaf along the task gradients ([AS2023] Sec. 5).

    A leaf is a set of joint positions with the same task value. The flow along the task gradients pulls every joint
    position to a point of the base leaf, and gives it the coordinates of that point.

    Args:
        problem: a problem with m = 1, or with task gradients that are involutive in the metric.
        level: task value x0 of the base leaf, a number or (m,); default: the task value of `origin`, or of the centre
            of the domain.
        leaf: how to chart the base leaf. "linear": xi0 = N^T (q - origin), for any n. "circle": by arc length, scaled
            to (-pi, pi], for a closed leaf with r = 1. "disk": by a harmonic map of a triangle mesh onto the unit disk,
            for n = 3, m = 1. Default: "circle" for r = 1 on a torus, "disk" for n = 3 and m = 1, otherwise "linear".
        origin: joint position (n,) that is pulled to the origin of a "linear" or "circle" leaf; default: the centre of
            the domain, or another point of the domain if the flow from the centre is singular.
        region: for "disk" only: the box that bounds the charted part of the leaf. Default: a box around the points to
            which the domain is pulled, with a whole turn for a joint that turns fully in the domain.
        cells: for "disk" only: number of mesh cells along the longest edge of the region; default 60.

    Returns:
        The chart. Its values are NaN where the flow meets a singularity or ends outside the chart of the leaf;
        `chart.coordinates.pull(points).status` says where.

    Raises:
        NotInvolutiveError: if m >= 2 and the task gradients are not involutive, so that the result would depend on
            the path.
        NotADiskError: if the part of the leaf in the region is not a disk; the message says what it is.
        GrowError: if the flow does not reach the leaf, or the leaf does not close or cannot be charted.
        MetricError: if the metric is not symmetric positive definite on the domain.
        InvalidValueError: if an argument has the wrong type, or applies to another kind of leaf.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
        >>> problem = oc.Problem(robot, oc.Task.position(robot, "x"), "inertia", oc.Box([0.6, 0.8], 0.3))
        >>> chart = oc.grow(problem)
        >>> task_row, xi_row = chart.jacobian([0.7, 0.9])
        >>> bool(abs(task_row @ np.linalg.solve(robot.mass_matrix([0.7, 0.9]), xi_row)) < 1e-9)
        True
    """
    require_kind("problem", problem, Problem)
    require_driven("growing", problem.robot.tree)
    if leaf is None:
        closed = problem.r == 1 and problem.domain.full_turns
        leaf = "circle" if closed else "disk" if (problem.n, problem.m) == (3, 1) else "linear"
    if not isinstance(leaf, str):
        raise InvalidValueError("leaf", repr(leaf), f"one of {', '.join(LEAVES)}")
    require_known("leaf", leaf, LEAVES)
    # options that apply to another kind of leaf, or have the wrong type
    for name, value in (("region", region), ("cells", cells)):
        if leaf != "disk" and value is not None:
            raise InvalidValueError(name, value, f"None for a {leaf} leaf, because {name} applies to disk leaves only")
    if region is not None and not isinstance(region, Box):
        raise InvalidValueError("region", repr(region), "a Box")
    if cells is not None:
        require_count("cells", cells, least=_FEWEST_CELLS)
    check(problem)
    require_involutive(problem)
    origin = None if origin is None else as_point("origin", origin, problem.n)
    if level is None:
        q = problem.domain.centre if origin is None else origin
        x0 = np.asarray(problem.task.batched(q[None])[0][0])
    else:
        values = np.atleast_1d(as_float_array("level", level))
        require_shape("level", values.shape, (problem.m,))
        x0 = freeze_array("level", values, (problem.m,))
    coordinates = GrownCoordinates(problem, _leaf_chart(problem, leaf, x0, origin, region, cells or CELLS))
    reached = np.isfinite(coordinates.xi(sample_evenly(problem.domain, _PROBES, 1))).all(axis=1)
    if not reached.any():
        raise GrowError(f"no sample of the domain reaches the charted part of the leaf h(q) = {x0.tolist()}")
    notes: dict[str, str | float] = {
        "level": ", ".join(f"{value:.6g}" for value in x0),
        "share of the domain": float(reached.mean()),
    }
    if isinstance(coordinates.leaf, CircleLeaf):
        notes["cut"] = ", ".join(f"{value:.6g}" for value in coordinates.leaf.cut)
    return GrownChart(problem, coordinates, notes)


def require_involutive(problem: Problem) -> None:
    """Raise NotInvolutiveError unless the task gradients are involutive."""
    if problem.m == 1:
        return
    found = involutivity(problem, samples=300)
    if not found.exact:
        raise NotInvolutiveError(
            f"the gradients of task '{problem.task.name}' are not involutive (defect mean {found.mean:.3g}, "
            f"max {found.max:.3g}): grown coordinates would depend on the path, so use orthocas.fit instead"
        )


def _leaf_chart(
    problem: Problem, leaf: str, x0: Array, origin: Array | None, region: Box | None, cells: int
) -> LeafChart:
    """Chart the base leaf h(q) = x0; raises GrowError if it cannot be reached or charted."""
    if leaf == "disk":
        return build_disk_leaf(problem, x0, _region(problem, x0) if region is None else region, cells)
    # the point of the leaf to which the origin, or another point of the domain, is pulled
    if origin is not None:
        candidates = origin[None]
    else:
        candidates = np.vstack([problem.domain.centre, sample_evenly(problem.domain, _PROBES, 0)])
    pulled = TaskFlow(problem).pull(candidates, x0, 1e-13)
    reached = np.flatnonzero(pulled.reached)
    if reached.size == 0:
        where = "the origin" if origin is not None else "any sample of the domain"
        raise GrowError(f"the leaf h(q) = {x0.tolist()} cannot be reached from {where}")
    start = np.asarray(pulled.points[reached[0]])
    if leaf == "linear":
        if problem.domain.full_turns:
            raise GrowError("a linear leaf is not periodic and the domain is a torus: use a Box domain or another leaf")
        return build_linear_leaf(problem, start)
    if problem.r != 1:
        raise GrowError(f"the problem has r = {problem.r} extra coordinates, expected r = 1 for a circle leaf")
    return trace_circle_leaf(problem, x0, start)


def _region(problem: Problem, x0: Array) -> Box:
    """The default region of a disk leaf: a box around the points of the leaf to which the domain is pulled."""
    domain = problem.domain
    whole = (domain.half_width >= np.pi - 1e-9) & find_turning_joints(problem)
    # with several joints that turn fully, the domain itself is the region, cut open as in [AS2023] Sec. 5.2
    if whole.sum() > 1:
        return Box(domain.centre, domain.half_width)
    pulled = TaskFlow(problem).pull(sample_evenly(domain, _PROBES, 0), x0)
    if not pulled.reached.any():
        raise InvalidValueError("level", x0.tolist(), "a task value that the flow from the domain reaches")
    low, high = pulled.points[pulled.reached].min(axis=0), pulled.points[pulled.reached].max(axis=0)
    centre = np.where(whole, domain.centre, (low + high) / 2)
    return Box(centre, np.where(whole, np.pi, (high - low) / 2 * _MARGIN))
