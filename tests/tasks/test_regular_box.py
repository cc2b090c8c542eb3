"""Default domains of a problem: the middle of the limits where the task is regular, a bent posture elsewhere."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from conftest import robot_of
from random_arms import random_arm

import orthocas as oc
from orthocas.problems import iiwa_robot
from orthocas.tasks.domains import default_box, require_within_limits
from orthocas.tasks.regular_box import find_joint_range, regular_box


@pytest.mark.parametrize(("name", "kind"), [("panda", "position"), ("panda", "pose"), ("ur10", "position")])
def test_middle_of_the_limits_stays_where_the_task_is_regular(name: str, kind: str) -> None:
    robot = robot_of(name)
    box, middle = regular_box(robot, oc.Task.named(robot, kind)), default_box(robot)
    np.testing.assert_array_equal(box.centre, middle.centre)
    np.testing.assert_array_equal(box.half_width, middle.half_width)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("iiwa", "position"),
        ("iiwa", "pose"),
        ("ur10", "position+axis"),
        ("kinova", "position"),
        ("kinova", "position+axis"),
    ],
)
def test_singular_middle_is_left_for_a_bent_posture_inside_the_limits(name: str, kind: str) -> None:
    """The independent judge is `check`, on other samples than the choice used."""
    robot = iiwa_robot() if name == "iiwa" else robot_of(name)
    task = oc.Task.named(robot, kind)
    problem, middle = oc.Problem(robot, task), default_box(robot)
    require_within_limits(robot, problem.domain)
    stretched = oc.check(oc.Problem(robot, task, domain=middle), 5000, 3)
    bent = oc.check(problem, 5000, 3)
    assert bent.smallest_singular_value > 5 * stretched.smallest_singular_value
    assert bent.singular_samples == 0 < stretched.singular_samples
    assert problem.domain.centre[0] == middle.centre[0]  # a turn of the base changes nothing, so there is none
    np.testing.assert_array_equal(regular_box(robot, task).centre, problem.domain.centre)


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_pose_of_the_iiwa_fits_without_folds_on_its_default_domain(metric: str) -> None:
    robot = iiwa_robot()
    chart = oc.fit(oc.Problem(robot, oc.Task.pose(robot), metric), oc.Polynomial(2)).chart
    report = oc.evaluate(chart, 20_000, 1)
    assert not report.degenerate
    assert report.conditioning.p01 > 0.4
    assert report.folded_samples == 0


def test_hopeless_tasks_keep_the_default_box_for_check_to_judge() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    idle = oc.Task.position(robot, "z")
    undefined = oc.Task.custom(robot, "undefined", lambda q: ca.sqrt(-1 - q[0] ** 2))
    for task in (idle, undefined):
        np.testing.assert_array_equal(regular_box(robot, task).centre, default_box(robot).centre)


def test_planar_arm_bends_its_joints() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    centre = regular_box(robot, oc.Task.position(robot, "xy")).centre
    assert np.abs(centre[1:]).max() > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("name", ["so100", "so101"])
def test_arms_of_hobbyists_fit_without_folds_on_their_default_domain(name: str) -> None:
    """Their boxes hold near-singular positions, so the default is the clear part; judged at own samples."""
    robot = oc.Robot.from_name(name)
    problem = oc.Problem(robot, oc.Task.position(robot))
    box = regular_box(robot, problem.task)
    low, high = problem.domain.bounds
    points = np.random.default_rng(7).uniform(low, high, (20_000, robot.n))
    J = robot.jacobian(points)[:, :3]
    condition = np.linalg.svd(J, compute_uv=False)
    inside = problem.domain.contains(points)
    np.testing.assert_array_equal(problem.domain.centre, box.centre)
    assert 0.85 < inside.mean() < 1
    assert condition[inside, 2].min() > 3 * condition[:, 2].min()
    fit = oc.fit(problem)
    assert fit.worst is not None
    assert fit.worst.least > 0.3
    assert oc.evaluate(fit.chart, 20_000, 1).folded_samples == 0


@pytest.mark.parametrize(("low", "high"), [(0.0, 2 * np.pi), (-4.8, 2.9), (-9.0, -1.0), (0.5, np.inf), (-np.inf, 2.0)])
def test_full_turns_of_joint_ranges_lie_within_the_limits(low: float, high: float) -> None:
    tree = random_arm(np.random.default_rng(5), 7, slides=0.0).tree
    lower, upper = tree.lower.copy(), tree.upper.copy()
    lower[4], upper[4] = low, high
    robot = oc.Robot(dataclasses.replace(tree, lower=lower, upper=upper))
    whole = find_joint_range(robot, 0)
    require_within_limits(robot, whole)
    np.testing.assert_array_equal(whole.half_width, np.pi)
    for branch in oc.branches(robot, oc.Task.pose(robot)):
        require_within_limits(robot, branch.box)
