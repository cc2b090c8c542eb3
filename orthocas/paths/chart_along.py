"""One chart for a whole path of postures: the corridor around the path, and the chart fitted in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocas.bases.cyclic import cyclic_joints, widen_over_cyclic_joints
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.errors import DomainError, InvalidValueError
from orthocas.fitting.fit import fit
from orthocas.tasks.corridor import RADIUS, Corridor
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.samples import find_idle_joints, sample_problem
from orthocas.tools.checks import Array, as_number, as_point_set, require_kind


@dataclass(frozen=True, slots=True)
class CorridorRules:
    """Numbers of charts along paths."""

    degree: int = 3  #: degree of the polynomial, with an angle for each cyclic joint; higher degrees gain little there
    spacing: float = 0.5  #: spacing of the postures that are kept, in radii
    prismatic: float = 0.25  #: [m], displacement that counts like 1 rad
    samples: int = 200  #: samples for finding idle joints


RULES = CorridorRules()


def chart_along(problem: Problem, postures: ArrayLike, radius: float = RADIUS) -> Chart:
    """Fit one chart to the neighbourhood of a path of postures.

    The domain is the corridor of `corridor_problem`. The coordinates are polynomials of degree 3 with an angle for each
    cyclic joint. With constant xi, a closed path of the tool gives a closed path of the joints if that path can be
    shrunk to a point in the corridor. The postures may come from `follow` in a less orthogonal chart, such as a wide
    one, from a planner, or from a log.

    Args:
        problem: robot, task and metric; its domain is ignored.
        postures: the path with steps small compared to the radius, (N, n) [rad] or [m].
        radius: largest distance from the path [rad]; see `corridor_problem`.

    Raises:
        ShapeError, InvalidValueError, DomainError: as in `corridor_problem`.
        SingularTaskError: if the task is singular in the corridor.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> problem, q = problems.get("planar_3r_xy"), np.array([0.6, 0.8, 0.8])
        >>> first = oc.fit(problem, oc.Polynomial(2), samples=300).chart
        >>> turn = np.linspace(0, 2 * np.pi, 50)[:, None]
        >>> circle = first.task(q) + 0.1 * np.hstack([np.cos(turn) - 1, np.sin(turn)])
        >>> chart = oc.chart_along(problem, oc.follow(first, circle, q_start=q, velocity_limits=1.0).q)
        >>> motion = oc.follow(chart, circle, q_start=q, velocity_limits=1.0)
        >>> bool(np.abs(motion.q[-1] - q).max() < 1e-6)
        True
    """
    return fit(corridor_problem(problem, postures, radius), Polynomial(RULES.degree, "auto")).chart


def corridor_problem(problem: Problem, postures: ArrayLike, radius: float = RADIUS, margin_deg: float = 0.0) -> Problem:
    """The same robot, task and metric on a `Corridor` around a path of postures.

    Fit it with `Polynomial(3, "auto")`. Joints that do not move the task, and joints that only turn the whole task, may
    take all positions between their limits. The others must stay, taken together, within the radius of the path.

    Args:
        problem: robot, task and metric; its domain is ignored.
        postures: the path with steps small compared to the radius, (N, n) [rad] or [m].
        radius: largest distance from the path [rad]; 0.25 m of a prismatic joint count like 1 rad.
        margin_deg: margin to the joint limits [deg].

    Raises:
        ShapeError, InvalidValueError, DomainError: if the postures have a wrong shape, or none is within the limits.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> from orthocas.paths import corridor_problem
        >>> postures = np.linspace([0.0, 0.6, 0.8], [0.8, 1.6, 0.8], 20)
        >>> problem = corridor_problem(problems.get("planar_3r_xy"), postures)
        >>> chart = oc.fit(problem, oc.Polynomial(3), samples=500).chart
        >>> bool(oc.evaluate(chart, samples=500).conditioning.min > 0.5)
        True
    """
    require_kind("problem", problem, Problem)
    path = as_point_set("postures", postures, problem.n)[0]
    size = as_number("radius", radius)
    if not 0 < size < np.pi:
        raise InvalidValueError("radius", radius, "a positive number below pi")
    prismatic = np.array(problem.robot.tree.prismatic)
    sizes = np.where(prismatic, RULES.prismatic * size, size)
    whole = find_joint_range(problem.robot, margin_deg)
    # Keep postures that are far enough apart, and the last one.
    scaled, kept = path / sizes, [0]
    for k in range(1, len(path)):
        if np.linalg.norm(scaled[k] - scaled[kept[-1]]) >= RULES.spacing or k == len(path) - 1:
            kept.append(k)
    path = path[kept]

    # Find idle and cyclic joints in the narrow corridor.
    narrow = Problem(problem.robot, problem.task, problem.metric, _build_corridor(whole, path, sizes), problem.name)
    names = problem.robot.joint_names
    cyclic = cyclic_joints(narrow)
    idle = find_idle_joints(narrow, sample_problem(narrow, RULES.samples, 0))
    # These joints may take their whole range.
    for k in {*idle, *map(names.index, cyclic)}:
        sizes[k] = np.inf
    free = Problem(problem.robot, problem.task, problem.metric, _build_corridor(whole, path, sizes), problem.name)
    return widen_over_cyclic_joints(free, cyclic)


def _build_corridor(whole: Box, path: Array, sizes: Array) -> Corridor:
    """The corridor in its bounding box, with the whole range for joints of infinite size."""
    low = np.maximum(path.min(axis=0) - sizes, whole.centre - whole.half_width)
    high = np.minimum(path.max(axis=0) + sizes, whole.centre + whole.half_width)
    empty = np.flatnonzero(low >= high)
    if empty.size:
        raise DomainError(f"the path leaves the range of joint {empty[0] + 1}, expected postures within the limits")
    unbounded = [i for i in whole.unbounded if np.isinf(sizes[i])]
    return Corridor(Box((low + high) / 2, (high - low) / 2, unbounded), path, sizes)
