"""Problems and charts that several test files use."""

from dataclasses import replace

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.tasks.corridor import Corridor
from orthocas.tasks.samples import sample_uniform


def with_metric(problem: oc.Problem, metric: str) -> oc.Problem:
    """The same robot, task and domain under another metric."""
    return oc.Problem(problem.robot, problem.task, metric, problem.domain)


def planar_2r(metric: str) -> oc.Problem:
    return with_metric(problems.get("planar_2r"), metric)


def linear_on_the_torus() -> oc.Chart:
    """Linear coordinates on all joint positions: the stretched arm (0, 0, 0) is singular, and there is no outside."""
    robot = oc.Robot.planar([1, 1, 1], [3, 3, 3])
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), "inertia", oc.Torus(3))
    return oc.fit(problem, oc.Linear(base=(0.6, 0.8, 0.8))).chart


def with_upper_limit(robot: oc.Robot, joint: int, upper: float, effort: float = np.inf) -> oc.Robot:
    """The robot with another upper limit of one joint, and equal limits of effort."""
    limits = robot.tree.upper.copy()
    limits[joint] = upper
    return oc.Robot(replace(robot.tree, upper=limits, effort_limits=np.full(robot.n, effort)))


def beyond_domain(chart: oc.Chart, count: int, share: float) -> np.ndarray:
    """Joint positions of a domain that is wider by a share."""
    domain = chart.problem.domain
    points: np.ndarray = domain.centre + share * (sample_uniform(domain, count, 3) - domain.centre)
    return points


def in_a_corridor() -> oc.Chart:
    """A chart of the surroundings of a bent path; the distance of the first joint does not count."""
    known = problems.get("planar_3r_x")
    centre, width = known.domain.centre, known.domain.half_width
    path = centre + width * np.array([[0.0, -0.6, -0.6], [0.0, 0.0, -0.4], [0.0, 0.5, 0.5]])
    domain = Corridor(known.domain, path, [np.inf, *(0.4 * width[1:])])
    return oc.fit(oc.Problem(known.robot, known.task, "inertia", domain), oc.Polynomial(3), samples=500).chart
