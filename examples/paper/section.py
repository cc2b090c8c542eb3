"""The common part of Figs. 10 and 19: a box of joint space, task (x, y) of the planar arm with three joints, A = I."""

import numpy as np

from orthocas import problems
from orthocas.charts.chart import Chart
from orthocas.exact.mesh import TriangleMesh, build_level_surface
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .self_motion import trace


def section(low: Array, high: Array) -> Problem:
    """Planar arm with three joints, task (x, y), A = I, on a box: no exact coordinates exist ([AS2023] Sec. 6.2)."""
    robot = problems.get("planar_3r_xy").robot
    return Problem(robot, Task.position(robot, "xy"), "euclidean", Box((low + high) / 2, (high - low) / 2), "section")


def isosurface(chart: Chart, value: float, cells: int) -> TriangleMesh:
    """The leaf of a single coordinate at a value, as far as it lies in the domain."""
    domain, xi = chart.problem.domain, chart.coordinates
    low, high = domain.centre - domain.half_width, domain.centre + domain.half_width
    return build_level_surface(lambda q: xi.xi(q)[:, 0], lambda q: xi.jacobian(q)[:, 0], value, low, high, cells)


def curves_inside(problem: Problem, starts: Array, step: float) -> list[Array]:
    """The connected parts in the domain of self-motion curves through points of the domain, (P, 3) each."""
    curves = []
    for curve in trace(problem.task, starts, step):
        turns = curve[-1] - curve[0]  # whole turns of the joints
        line, at = np.concatenate([curve[:-1] - turns, curve]), len(curve) - 1
        inside = np.all(np.abs(line - problem.domain.centre) <= problem.domain.half_width, axis=1)
        before, after = np.append(inside[at::-1], False), np.append(inside[at:], False)
        curves.append(line[at - int(np.argmin(before)) + 1 : at + int(np.argmin(after))])
    return curves


def unit_gradients(problem: Problem, points: Array) -> Array:
    """Gradients of x and y scaled to unit length, (N, 2, 3)."""
    J = problem.task.batched_jacobian(points)[0]
    unit: Array = J / np.linalg.norm(J, axis=2, keepdims=True)
    return unit


def tilts(chart: Chart, points: Array) -> Array:
    """Angles between the plane of both task gradients and the leaf of the coordinate, (N,) [deg]."""
    J = chart.jacobian(points)
    normals = np.cross(J[:, 0], J[:, 1])
    cosines = np.abs(np.sum(normals * J[:, 2], axis=1)) / (
        np.linalg.norm(normals, axis=1) * np.linalg.norm(J[:, 2], axis=1)
    )
    angles: Array = np.degrees(np.arccos(np.minimum(cosines, 1)))
    return angles
