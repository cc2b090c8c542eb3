"""Pushes at links and joint stops as CVODES sees them, against formulas by hand."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from charts import with_upper_limit

import orthocas as oc
from orthocas.control import Kinematic, PDPlus, Reference
from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.robots.kinematics import build_point_jacobian
from orthocas.simulation import Push, Stops, simulate
from orthocas.simulation.disturbances import Loads


def test_stops_push_back_in_proportion_and_never_pull(planar_x: oc.Problem) -> None:
    tree = with_upper_limit(planar_x.robot, 1, 0.5).tree
    q, dq = ca.SX.sym("q", 3), ca.SX.sym("dq", 3)
    torque = ca.Function("stops", [q, dq], [Stops(1000.0, [0.0, 2.0, 0.0]).torque(tree, q, dq)])
    for position, speed, want in (
        (0.4, 3.0, 0),
        (0.51, 0.0, -10),
        (0.51, 0.5, -20),
        (0.51, -0.25, -5),
        (0.51, -9.0, 0),
    ):
        got = np.asarray(torque([9.0, position, 9.0], [0.0, speed, 0.0])).ravel()
        np.testing.assert_allclose(got, [0, want, 0], atol=1e-9)
    lower = replace(tree, lower=np.array([-0.1, -np.inf, -np.inf]))
    below = ca.Function("stops", [q, dq], [Stops(1000.0, 1.0).torque(lower, q, dq)])
    assert float(below([-0.12, 0, 0], [-1.0, 0, 0])[0]) == pytest.approx(40.0)
    assert float(below([-0.12, 0, 0], [2.0, 0, 0])[0]) == 0.0


@pytest.mark.parametrize("link", ["q2", 1])
def test_push_at_a_link_is_a_torque_through_the_jacobian_of_its_point(
    planar_chart: oc.Chart, planar_x: oc.Problem, link: str | int
) -> None:
    """CVODES: to first order in time, joints move by M^-1 J^T f t^2 / 2, with J by hand for the planar arm."""
    law, q0 = PDPlus(planar_chart, 60.0), planar_x.domain.centre
    robot, force = planar_chart.problem.robot, np.array([30.0, 50.0, 0.0])
    rest = Reference.steps(planar_chart.labels, planar_chart.phi(q0), [], 1e-3)
    push = Push(0.0, 1.0, force, link=link, point=[0.4, 0.2, 0.0])
    run = simulate(law, rest, q0, control_rate=1000, pushes=[push], tolerance=1e-12)
    elbow = np.array([np.cos(q0[0]), np.sin(q0[0])])
    angle = q0[0] + q0[1]
    arm = np.array([0.4 * np.cos(angle) - 0.2 * np.sin(angle), 0.4 * np.sin(angle) + 0.2 * np.cos(angle)])
    moments = [np.cross([*(elbow + arm), 0.0], force)[2], np.cross([*arm, 0.0], force)[2], 0.0]
    want = np.linalg.solve(robot.mass_matrix(q0), moments)
    np.testing.assert_allclose(run.dq[-1] / 1e-3, want, rtol=1e-3, atol=1e-3 * np.abs(want).max())


@pytest.mark.parametrize("link", [-1, True, 1.5, [0]])
def test_links_that_are_none_are_refused(link: object) -> None:
    with pytest.raises(InvalidValueError, match="link is .*, expected the name of a joint, or the index of one"):
        Push(0.0, 0.1, [1.0, 0, 0], link=link)  # type: ignore[arg-type]


def test_jacobian_of_the_tips_point_is_the_tips(iiwa: oc.Problem) -> None:
    robot = iiwa.robot
    tree, q = robot.tree, ca.SX.sym("q", 7)
    point = tree.tip_translation + tree.tip_rotation @ np.array([0.1, 0.2, 0.3])
    J = ca.Function("J", [q], [build_point_jacobian(tree, q, tree.tip_parent, point)])
    at = iiwa.domain.centre + 0.1
    np.testing.assert_allclose(J(at), robot.with_tool([0.1, 0.2, 0.3]).tip_jacobian(at)[:3], atol=1e-12)
    np.testing.assert_array_equal(build_point_jacobian(tree, q, -1, point).is_zero(), True)


def test_rows_of_loads_add_up_by_place_and_time(planar_x: oc.Problem) -> None:
    """Two pushes at one place, one at another, and a torque; the first tick of 0.1 s has half of the first one."""
    pushes = [
        Push(0.05, 0.1, [2, 0, 0], link=1),
        Push(0.0, 1.0, [0, 3, 0], link="q2"),
        Push(0.1, 0.1, [0, 0, 7], [1, 2, 3]),
    ]
    loads = Loads(planar_x.robot.tree, pushes)
    assert (len(loads.places), loads.size) == (2, 9)
    np.testing.assert_allclose(loads.mean(np.array([0.0]), 0.1), [[1, 3, 0, 0, 0, 0, 0, 0, 0]])
    np.testing.assert_allclose(loads.at(np.array([0.06, 0.16])), [[2, 3, 0, *[0] * 6], [0, 3, 0, 0, 0, 7, 1, 2, 3]])
    assert Loads(planar_x.robot.tree).mean(np.zeros(4), 0.1).shape == (4, 3)


def test_loads_of_other_robots_are_refused_by_name(planar_chart: oc.Chart, planar_x: oc.Problem) -> None:
    with pytest.raises(
        UnknownNameError, match="unknown link, named by the joint that moves it, 'elbow', known: q1, q2"
    ):
        Loads(planar_x.robot.tree, [Push(0.0, 0.1, link="elbow")])
    with pytest.raises(InvalidValueError, match="link is 3, expected the name of a joint, or the index of one from 0"):
        Loads(planar_x.robot.tree, [Push(0.0, 0.1, link=3)])
    with pytest.raises(ShapeError, match="torque of a push"):
        Loads(planar_x.robot.tree, [Push(0.0, 0.1, torque=[1.0, 2.0])])
    q0 = planar_x.domain.centre
    rest = Reference.steps(planar_chart.labels, planar_chart.phi(q0), [], 0.1)
    with pytest.raises(InvalidValueError, match="pushes, friction, stops or plant is given"):
        simulate(Kinematic(planar_chart), rest, q0, stops=Stops())
    with pytest.raises(InvalidValueError, match=r"stiffness of stops\[0\] is -1"):
        simulate(PDPlus(planar_chart, 60.0), rest, q0, stops=Stops(-1.0))
    with pytest.raises(InvalidValueError, match="stops is 1, expected a Stops"):
        simulate(PDPlus(planar_chart, 60.0), rest, q0, stops=1)  # type: ignore[arg-type]


def test_stops_hold_a_joint_in_continuous_time(planar_chart: oc.Chart, planar_x: oc.Problem) -> None:
    """60 N m, less what the controller opposes, press a joint against its stop of 2e4 N m/rad."""
    q0 = planar_x.domain.centre
    tight = with_upper_limit(planar_x.robot, 1, float(q0[1]) + 0.1)
    rest = Reference.steps(planar_chart.labels, planar_chart.phi(q0), [], 1.0)
    push = Push(0.0, 1.0, torque=[0.0, 60.0, 0.0])
    run = simulate(PDPlus(planar_chart, 60.0), rest, q0, plant=tight, stops=Stops(), pushes=[push])
    beyond = run.q[:, 1] - float(q0[1]) - 0.1
    assert 0 < beyond[-1] < 60 / 2e4
    assert beyond.max() < 0.02
