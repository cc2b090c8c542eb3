"""Atlases on the way: inverse, hand-overs, and orientation tasks."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import atlas_loops
import numpy as np
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.atlas.chart_along import follow_in_atlas
from orthocas.atlas.view_session import AtlasSession
from orthocas.errors import DomainError, InvalidValueError, ShapeError
from orthocas.tools.checks import Array
from orthocas.viewer import export_page


def test_posture_is_asked_for_without_a_jump_where_charts_change(planar_atlas: oc.Atlas) -> None:
    start = np.array([0.3, 0.5, 1.4])
    number = planar_atlas.chart_at(start)
    x = planar_atlas.problem.task.batched(start[None])[0][0]
    turn = np.linspace(0, 2 * np.pi, 100)
    path = x + 0.4 * (np.outer(np.cos(turn) - 1, x) + np.outer(np.sin(turn), [-x[1], x[0]])) / np.linalg.norm(x)
    motion = follow_in_atlas(planar_atlas, path, start)
    assert motion.hand_overs >= 2
    assert motion.charts[0] == number
    tool = planar_atlas.problem.task.batched(motion.q)[0]
    assert np.abs(tool - path).max() < 1e-9
    changes = np.flatnonzero(np.diff(motion.charts))
    for k in changes:  # the posture found last is the one asked for in the next chart
        assert np.abs(planar_atlas.xi(motion.q[k], motion.charts[k + 1]) - motion.xi[k + 1]).max() < 1e-12
    assert np.abs(np.diff(motion.q, axis=0)).max() < 0.2


def test_hand_over_maps_velocity_and_acceleration(planar_atlas: oc.Atlas, covered: Array) -> None:
    q, number, h = covered[0], int(planar_atlas.chart_at(covered[0])), 1e-4
    dq, ddq = np.array([0.3, -0.2, 0.5]), np.array([1.0, 0.4, -2.0])
    phi, dphi, ddphi = planar_atlas.handed_over(q, dq, ddq, number)
    chart = planar_atlas.chart(number, near=q)
    before, after = (chart.phi(q + s * h * dq + 0.5 * h**2 * ddq) for s in (-1, 1))
    assert np.abs((after - before) / (2 * h) - dphi).max() < 1e-6
    assert np.abs((after - 2 * phi + before) / h**2 - ddphi).max() < 1e-5


def test_inverse_in_charts_finds_what_phi_came_from(planar_atlas: oc.Atlas, covered: Array) -> None:
    numbers = planar_atlas.chart_at(covered)
    x, xi = planar_atlas.problem.task.batched(covered)[0], planar_atlas.xi(covered)
    starts = covered + np.random.default_rng(8).uniform(-0.02, 0.02, covered.shape)
    found = planar_atlas.inverse(x, xi, numbers, starts)
    assert np.isfinite(found).all(axis=1).mean() > 0.95  # the others leave the box of their chart on the way
    assert np.nanmax(np.abs(found - covered)) < 1e-8
    assert np.isnan(planar_atlas.inverse(x[0] + 9.0, xi[0], numbers[0], covered[0])).all()
    assert np.isnan(planar_atlas.inverse(x[0], xi[0], -1, covered[0])).all()
    with pytest.raises(ShapeError, match="xi has shape"):
        planar_atlas.inverse(x[0], xi[:2], numbers[0], covered[0])


@pytest.fixture(scope="module")
def wrist(tmp_path_factory: pytest.TempPathFactory) -> oc.Atlas:
    """Four joints that turn a hand, between limits that reach beyond half a turn."""
    locked = {"panda_joint1": 0.0, "panda_joint2": 0.3, "panda_joint3": 0.2}
    robot = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand", locked)
    problem = oc.Problem(robot, oc.Task.named(robot, "orientation"))
    path = tmp_path_factory.mktemp("atlas") / "wrist.orthocas-atlas"
    with ThreadPoolExecutor(1) as executor:
        return oc.build_atlas(problem, path, oc.AtlasSettings(2, 10.0, half_width=0.8), executor=executor)


@pytest.mark.slow
def test_first_and_last_joint_of_an_orientation_task_are_not_divided(wrist: oc.Atlas) -> None:
    assert [wrist.problem.robot.joint_names[i] for i in wrist.plan.cyclic] == ["panda_joint4", "panda_joint7"]
    assert oc.cyclic_joints(wrist.problem) == ()  # its coordinates are singular half a turn away
    assert oc.evaluate_atlas(wrist, 3000).share == 1.0
    q = wrist.problem.domain.centre + wrist.problem.domain.half_width * np.random.default_rng(7).uniform(-1, 1, (20, 4))
    J = wrist.jacobian(q)[:, 0]
    for point, gradient in zip(q, J, strict=True):  # against the motion that keeps the orientation
        rotation = wrist.problem.robot.tip_rotation
        turns = [rotation(point + 1e-6 * e) @ rotation(point).T for e in np.eye(4)]
        still = np.linalg.svd(np.column_stack([(R - R.T)[[2, 0, 1], [1, 2, 0]] / 2e-6 for R in turns]))[2][-1]
        assert abs(gradient @ still) > np.cos(np.radians(20)) * np.linalg.norm(gradient)


@pytest.mark.slow
def test_charts_of_orientations_hold_for_every_reference(wrist: oc.Atlas) -> None:
    q = np.array([-1.5, 0.4, 3.5, 1.0])
    number = wrist.chart_at(q)
    chart = wrist.with_reference(q).chart(number, near=q)
    assert chart.problem.domain.contains(q)
    assert np.abs(chart.task(q)).max() < 1e-12
    assert np.abs(chart.xi(q) - wrist.xi(q)).max() < 1e-12
    assert oc.evaluate(chart, 500).leak.rms < 10.5
    away = chart.problem.domain.centre + np.pi * np.eye(4)[3]  # half a turn
    with pytest.raises(DomainError, match="centre of the domain"):
        wrist.with_reference(away).chart(number, near=q)


def test_orientation_is_held_from_chart_to_chart(wrist: oc.Atlas) -> None:
    start = np.array([-1.5, 0.4, 1.0, 0.5])
    turned = np.outer(np.sin(np.linspace(0, np.pi, 60)), [0.0, -0.7, 0.0])
    motion = follow_in_atlas(wrist.with_reference(start), turned, start)
    assert motion.hand_overs >= 2
    found = wrist.with_reference(start).problem.task.batched(motion.q)[0]
    assert np.abs(found - turned).max() < 1e-9


def test_proofs_are_refused_for_orientation_tasks(wrist: oc.Atlas, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="certify_seconds is 5"):
        oc.build_atlas(wrist.problem, tmp_path / "a", oc.AtlasSettings(certify_seconds=5.0))


def test_charts_beyond_the_limits_are_named(wrist: oc.Atlas) -> None:
    low, high = wrist.problem.robot.lower, wrist.problem.robot.upper
    numbers = np.unique(wrist.chart_at(np.random.default_rng(3).uniform(low, high, (3000, 4))))
    beyond = sorted(set(range(len(wrist))) - set(numbers.tolist()))
    with pytest.raises(DomainError, match="beyond the limits of joint 'panda_joint"):
        wrist.box(beyond[0])


def test_tasks_without_orientation_have_no_reference(planar_atlas: oc.Atlas) -> None:
    assert planar_atlas.with_reference([0.3, 0.5, 1.4]) is planar_atlas


def test_a_session_goes_on_in_the_next_chart(planar_atlas: oc.Atlas) -> None:
    session = AtlasSession(planar_atlas, np.array([0.3, 0.5, 1.4]))
    first, x = session.number, session.readings.x
    session.remember()
    session.wish({"y": float(x[1]) - 1.0})
    assert session.follow()
    assert session.number != first
    assert session.place == f"chart {session.number} of {len(planar_atlas)}"
    assert np.abs(session.readings.x - x - [0.0, -1.0]).max() < 1e-9
    assert np.abs(session.readings.xi - planar_atlas.xi(session.q, session.number)).max() < 1e-12
    session.undo()
    assert session.q.tolist() == [0.3, 0.5, 1.4]
    assert planar_atlas.box(session.number).contains(session.q)
    session.wish({"y": 5.0})  # beyond the reach of the arm
    session.follow()
    assert "near singular" in session.stop
    with pytest.raises(InvalidValueError, match="a point of the domain"):
        AtlasSession(planar_atlas, np.zeros(3))


def test_sessions_begin_in_the_middle_of_the_joint_range(planar_atlas: oc.Atlas) -> None:
    session = AtlasSession(planar_atlas)
    assert session.number == planar_atlas.chart_at(session.q)
    with pytest.raises(InvalidValueError, match="`view` shows atlases"):
        export_page(planar_atlas, planar_atlas.path.with_name("page.html"))


@pytest.mark.slow
def test_one_chart_along_a_motion_closes_loops_that_cross_charts() -> None:
    found = atlas_loops.main(quick=True)
    assert found["hand_overs"] >= 2
    assert found["pseudo_inverse_rad"] > 1e-3
    assert found["worst_ratio"] < 1e-6  # 1/100 is asked for
