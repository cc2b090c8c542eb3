"""Singular points of a task, where grown coordinates must break, and the behaviour of xi there."""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import scipy

from orthocas.charts.chart import Chart
from orthocas.errors import GrowError
from orthocas.exact.flow import GrownCoordinates
from orthocas.exact.leaves import find_turning_joints
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_evenly
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array, require_at_least, require_kind

_NEWTON_STEPS = 40
_FLAT = 1e-10  # largest |J_x| of a singular point, relative to its root mean square
_SAME = 1e-6  # singular points closer than this are one point
_STARTS = 500


@dataclass(frozen=True, eq=False)
class SingularPoint:
    """A joint position where the gradient of a one-dimensional task vanishes."""

    point: Array  #: (n,)
    kind: str  #: maximum, minimum or saddle
    task_value: float
    curvatures: Array  #: eigenvalues of A^-1 d^2h/dq^2 in ascending order, (n,)
    directions: Array = field(repr=False)  #: their eigenvectors as columns, A-orthonormal, (n, n)


@dataclass(frozen=True)
class Jump:
    """The jump of a grown coordinate on a circle at a singular point."""

    singular_point: SingularPoint
    values: tuple[float, float]  #: limits of xi on the two sides of a saddle, or smallest and largest at an extremum
    size: float  #: distance between them along the circle [rad]; a full turn at an extremum, where all values meet


def singular_points(problem: Problem, seed: int = 0) -> tuple[SingularPoint, ...]:
    """Isolated singular points in the domain of a task with m = 1, by Newton's method on grad h = 0 from 500 starts.

    Angles lie within half a turn of the domain's centre. Points that differ by whole turns count once.

    Args:
        problem: a problem with m = 1.
        seed: seed of the starts.

    Raises:
        GrowError: if m > 1.
    """
    require_kind("problem", problem, Problem)
    if problem.m != 1:
        raise GrowError(f"the task has m = {problem.m} components, expected m = 1 to find singular points")
    hessian = _hessian(problem)
    q = sample_evenly(problem.domain, _STARTS, seed)
    size = np.sqrt((problem.task.evaluate_jacobian(q) ** 2).sum(axis=(1, 2)).mean())
    for _ in range(_NEWTON_STEPS):
        J = problem.task.evaluate_jacobian(q)
        step = np.linalg.pinv(hessian(q)[0].reshape(-1, problem.n, problem.n)) @ J.transpose(0, 2, 1)
        q = q - step[:, :, 0]
    turns = np.floor((q - problem.domain.centre) / (2 * np.pi) + 0.5 - _SAME)  # an angle of half a turn becomes +pi
    q = q - 2 * np.pi * turns * find_turning_joints(problem)
    flat = np.abs(problem.task.evaluate_jacobian(q)).max(axis=(1, 2)) < _FLAT * size
    # one point from each group of equal points, sorted
    points = q[flat & problem.domain.contains(q)]
    kept: list[int] = []
    if len(points):
        groups = scipy.spatial.cKDTree(points).query_ball_point(points, _SAME)
        kept = sorted({min(group) for group in groups})
    chosen = points[kept]
    found = np.asarray(chosen[np.lexsort(np.round(chosen, 4).T[::-1])])
    return tuple(_classified(problem, point, hessian) for point in found)


def jumps(chart: Chart, radius: float = 0.02) -> tuple[Jump, ...]:
    """Discontinuities of a grown coordinate with r = 1 on a circle, at the singular points of its task.

    Flow lines that pass a saddle on its two sides reach the leaf at different points. Beyond the saddle, xi therefore
    jumps across the line that flows into it. At an extremum all flow lines meet, and with them all values of xi.

    Args:
        chart: a chart with n = 2 and m = 1, grown from a circle.
        radius: distance from a saddle at which xi is evaluated on its two sides [rad].

    Raises:
        GrowError: if the chart is not grown from a circle, or n is not 2.
    """
    require_kind("chart", chart, Chart)
    require_at_least("radius", radius, 1e-9)
    grown = chart.coordinates
    if not isinstance(grown, GrownCoordinates) or grown.leaf.kind != "circle" or chart.n != 2:
        raise GrowError("jumps are defined only for charts with n = 2 that are grown from a circle")
    return tuple(_jump(chart, singular, grown.leaf.level[0], radius) for singular in singular_points(chart.problem))


def _jump(chart: Chart, singular: SingularPoint, level: float, radius: float) -> Jump:
    if singular.kind != "saddle":
        around = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        ring = singular.point + radius * np.stack([np.cos(around), np.sin(around)], axis=1) @ singular.directions.T
        xi = chart.xi(ring)
        return Jump(singular, (float(np.nanmin(xi)), float(np.nanmax(xi))), 2 * np.pi)
    steepest = -1 if level > singular.task_value else 0  # the flow to the leaf moves away along this direction
    leaving = singular.directions[:, steepest]
    sides = chart.xi(singular.point + radius * np.stack([leaving, -leaving]))[:, 0]
    apart = abs(sides[1] - sides[0])
    return Jump(singular, (float(sides[0]), float(sides[1])), float(min(apart, 2 * np.pi - apart)))


def _hessian(problem: Problem) -> Batched:
    q = ca.SX.sym("q", problem.n)
    return Batched(dense_function("hessian", [q], [ca.hessian(problem.task.function(q), q)[0]]))


def _classified(problem: Problem, point: Array, hessian: Batched) -> SingularPoint:
    H = hessian(point[None])[0].reshape(problem.n, problem.n)
    factor = np.linalg.inv(np.linalg.cholesky(problem.metric.evaluate(point[None])[0]))
    curvatures, vectors = np.linalg.eigh(factor @ H @ factor.T)
    kind = "minimum" if curvatures[0] > 0 else "maximum" if curvatures[-1] < 0 else "saddle"
    value = float(problem.task.batched(point[None])[0][0, 0])
    return SingularPoint(point, kind, value, curvatures, factor.T @ vectors)
