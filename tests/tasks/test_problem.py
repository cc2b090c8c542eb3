"""Problems check themselves: redundancy, rank of the task, metric."""

import casadi as ca
import numpy as np
import pytest

import orthocas as oc
from orthocas import problems
from orthocas.errors import InvalidValueError, NotRedundantError, SingularTaskError, UnknownNameError
from orthocas.tasks.samples import evaluate_samples, sample_problem


def arm(joints: int = 3) -> oc.Robot:
    return oc.Robot.planar([1.0] * joints, [3.0] * joints)


def test_task_without_redundancy_is_refused() -> None:
    robot = arm(2)
    with pytest.raises(NotRedundantError, match="m = 2 components and the robot n = 2 joints"):
        oc.Problem(robot, oc.Task.position(robot, "xy"))


def test_task_of_another_robot_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="another robot"):
        oc.Problem(arm(), oc.Task.position(arm(4), "x"))
    longer = oc.Robot.planar(lengths=[2.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
    with pytest.raises(InvalidValueError, match="another robot"):
        oc.Problem(arm(), oc.Task.position(longer, "x"))


def test_robot_may_be_built_twice() -> None:
    problem = oc.Problem(arm(), oc.Task.position(arm(), "xy"))
    assert (problem.n, problem.m) == (3, 2)
    assert oc.Task.stack(oc.Task.position(arm(), "x"), oc.Task.position(arm(), "y")).m == 2


def test_singular_samples_are_counted_and_located() -> None:
    robot = arm()
    stretched = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0, 0, 0], 0.5))
    found = oc.check(stretched)
    assert 0 < found.singular_samples < found.samples
    assert np.abs(found.most_singular_point[1:]).max() < 0.1  # straight arm: q2 = q3 = 0
    bent = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.6, 0.8, 0.8], 0.3))
    assert oc.check(bent).singular_samples == 0


def test_task_that_is_singular_everywhere_is_refused() -> None:
    robot = arm()
    doubled = oc.Task.custom(
        robot, "twice x", lambda q: ca.vertcat(robot.tip_position(q)[0], 2 * robot.tip_position(q)[0])
    )
    with pytest.raises(SingularTaskError, match="rank below m = 2 at all"):
        oc.check(oc.Problem(robot, doubled))
    with pytest.raises(SingularTaskError, match="rank below"):
        oc.fit(oc.Problem(robot, doubled))


def test_component_that_depends_on_no_joint_is_named() -> None:
    robot = arm()
    with pytest.raises(SingularTaskError, match="'z' does not depend"):
        oc.check(oc.Problem(robot, oc.Task.position(robot, "xz")))


def test_task_that_is_not_finite_is_located() -> None:
    robot = arm()
    root = oc.Task.custom(robot, "root", lambda q: ca.sqrt(q[0]))
    with pytest.raises(SingularTaskError, match="'root' is not finite at q"):
        oc.check(oc.Problem(robot, root, domain=oc.Box([0.0, 0, 0], 0.5)))


def test_samples_with_vanishing_gradient_are_dropped() -> None:
    robot = arm(2)
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Torus(2))
    samples = evaluate_samples(problem, np.array([[0.0, 0.0], [0.5, 0.5]]))
    np.testing.assert_array_equal(samples.points, [[0.5, 0.5]])


def test_task_basis_is_orthonormal_in_the_metric_and_spans_the_gradients(planar_xy: oc.Problem) -> None:
    samples = sample_problem(planar_xy, 50, 3)
    A = planar_xy.robot.mass_matrix(samples.points)
    E = samples.task_basis
    np.testing.assert_allclose(E @ A @ E.transpose(0, 2, 1), np.broadcast_to(np.eye(2), (50, 2, 2)), atol=1e-10)
    for basis, gradients in zip(E, samples.compute_metric_gradients(samples.task_jacobian), strict=True):
        assert np.linalg.matrix_rank(np.vstack([basis, gradients]), tol=1e-9) == 2


def test_named_problems_have_the_paper_dimensions() -> None:
    sizes = {name: (p.n, p.m, p.r) for name in problems.names() for p in [problems.get(name)]}
    own = sizes.pop("hexarotor")
    assert own == (6, 4, 2)
    assert sizes == {"planar_2r": (2, 1, 1), "planar_3r_x": (3, 1, 2), "planar_3r_xy": (3, 2, 1), "iiwa": (7, 3, 4)}
    with pytest.raises(UnknownNameError, match="unknown problem 'spot', known: planar_2r"):
        problems.get("spot")
