"""How robots look in a view: poses of bodies, meshes, rods and solids."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.errors import RobotError
from orthocas.robots.pinocchio_model import lock_off_chain
from orthocas.robots.urdf import read_urdf
from orthocas.viewer.looks import (
    RULES,
    BodyPoses,
    build_ball,
    build_block,
    build_capsule,
    build_drum,
    build_shape,
    build_stick_arm,
    decimate,
    read_urdf_look,
)


def test_body_poses_are_those_of_pinocchio() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(path, "panda_hand")
    q = np.linspace(-0.6, 0.3, 7)
    positions, quaternions = BodyPoses(robot.tree)(np.array([q, 0 * q]))
    np.testing.assert_allclose(positions[0, 1:], robot.joint_points(q)[1:], atol=1e-12)
    expected = pin.Quaternion(robot.tip_rotation(q)).coeffs()[[3, 0, 1, 2]]
    np.testing.assert_allclose(quaternions[0, -1] * np.sign(quaternions[0, -1] @ expected), expected, atol=1e-12)
    np.testing.assert_allclose(quaternions[:, 0], [[1, 0, 0, 0]] * 2)


@pytest.mark.slow
def test_meshes_are_where_pinocchio_places_them() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(path, "panda_hand")
    found = read_urdf_look(path, robot.tree)
    assert found.missing == ()
    q = np.array([0.3, -0.4, 0.5, -1.2, 0.2, 1.0, -0.7])
    positions, quaternions = BodyPoses(robot.tree)(q[None])
    model = lock_off_chain(read_urdf(path)[0], "panda_hand")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pinocchio imports what it deprecates itself
        geometry = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.VISUAL, str(path.parents[4]))
    data, placed = model.createData(), geometry.createData()
    pin.updateGeometryPlacements(model, data, geometry, placed, q)
    lows = []
    for pose, thing in zip(placed.oMg, geometry.geometryObjects, strict=True):
        corners = np.array(thing.geometry.vertices()) @ pose.rotation.T + pose.translation
        lows.append(np.concatenate([corners.min(axis=0), corners.max(axis=0)]))
    ours = []
    for i, solids in enumerate(found.look):
        turn = pin.Quaternion(*quaternions[0, i]).matrix()
        for solid in solids:
            corners = solid.vertices @ turn.T + positions[0, i]
            ours.append(np.concatenate([corners.min(axis=0), corners.max(axis=0)]))
    assert len(ours) == len(lows) > 8
    for box in ours:
        assert np.abs(np.array(lows) - box).max(axis=1).min() < 1e-6


@pytest.mark.slow
def test_decimated_meshes_keep_their_surface() -> None:
    """A seventh of the triangles; 99 of 100 corners are within 4 mm of the whole mesh, and the other way around."""
    pytest.importorskip("fast_simplification")
    path = robot_data("panda_description/urdf/panda.urdf")
    whole = read_urdf_look(path, oc.Robot.from_urdf(path, "panda_hand").tree).look
    fewer = decimate(whole, 20_000)
    before, after = ([solid for solids in look for solid in solids] for look in (whole, fewer))
    assert sum(len(solid.faces) for solid in before) > 130_000
    assert sum(len(solid.faces) for solid in after) < 21_000
    for a, b in zip(before, after, strict=True):
        for corners, surface in ((a.vertices, b), (b.vertices, a)):
            distances = igl.point_mesh_squared_distance(corners, surface.vertices, surface.faces)[0]
            assert np.sqrt(np.percentile(distances, 99)) < 4e-3
    assert decimate(whole, 10**6) is whole


def test_all_tips_are_drawn() -> None:
    """Each of two hands carries a ball of the tool's colour where Pinocchio has its frame."""
    path = robot_data("baxter_description/urdf/baxter.urdf")
    tips = ["left_gripper", "right_gripper"]
    robot = oc.Robot.from_urdf(path, tips=tips)
    q = robot.tree.centre_posture
    positions, quaternions = BodyPoses(robot.tree)(q[None])
    balls = []
    for i, solids in enumerate(build_stick_arm(robot.tree)):
        turn = pin.Quaternion(*quaternions[0, i]).matrix()
        balls += [(s.vertices @ turn.T + positions[0, i]).mean(axis=0) for s in solids if s.colour == RULES.tool]
    model = lock_off_chain(read_urdf(path)[0], *tips)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    places = [data.oMf[model.getFrameId(tip)].translation for tip in tips]
    assert len(balls) == 2
    for place in places:
        assert min(np.linalg.norm(ball - place) for ball in balls) < 1e-3


def test_rods_stand_for_links_whose_meshes_are_missing(tmp_path: Path) -> None:
    whole = robot_data("panda_description/urdf/panda.urdf")
    lonely = tmp_path / "panda.urdf"
    shutil.copy(whole, lonely)
    robot = oc.Robot.from_urdf(lonely, "panda_hand")
    shape = build_shape(robot, lonely, None)
    assert len(shape.missing) > 8
    assert shape.missing[0].endswith(".dae")
    assert [len(part) for part in shape.look] == [len(part) for part in build_stick_arm(robot.tree)]


def test_shapes_of_urdf_are_drawn_at_their_origins(tmp_path: Path) -> None:
    text = """<robot name="r"><material name="blue"><color rgba="0 0 1 1"/></material><link name="a"><visual>
    <geometry><box size="1 2 3"/></geometry></visual></link>
    <link name="b"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="1 0 0" rpy="0 0 0"/><geometry><sphere radius="0.5"/></geometry><material name="blue"/></visual>
    <visual><geometry><cylinder radius="0.1" length="2"/></geometry><material name="nothing"/></visual></link>
    <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
    path = tmp_path / "r.urdf"
    path.write_text(text)
    robot = oc.Robot.from_urdf(path)
    look = read_urdf_look(path, robot.tree).look
    np.testing.assert_allclose(np.ptp(look[0][0].vertices, axis=0), [1, 2, 3])
    sphere, cylinder = look[1]
    assert sphere.colour == (0, 0, 255)
    turn = BodyPoses(robot.tree)(np.zeros((1, 1)))[1][0, 1]
    R = pin.Quaternion(*turn).matrix()
    np.testing.assert_allclose((sphere.vertices @ R.T).mean(axis=0), [1, 0, 0], atol=0.02)
    np.testing.assert_allclose(np.ptp(cylinder.vertices @ R.T, axis=0), [0.2, 0.2, 2], atol=1e-3)
    other = oc.Robot.planar([1, 1], [1, 1])
    with pytest.raises(RobotError, match=r"has the joints j, expected q1, q2 among them"):
        read_urdf_look(path, replace(other.tree, tip_name="b"))


@pytest.mark.parametrize(
    "solid", [build_drum(0.3, 0.2, (0, 0, 0)), build_ball(0.5, (0, 0, 0)), build_block([1, 2, 3], (0, 0, 0)),
              build_capsule(np.ones(3), np.array([1.0, 2, 0]), (0.2, 0.1), (0, 0, 0))]
)  # fmt: skip
def test_solids_are_closed_and_seen_from_outside(solid: object) -> None:
    """The volume that the triangles enclose is positive, and close to that of the shape."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))  # type: ignore[attr-defined]
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    middle = (a + b + c).mean(axis=0) / 3
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - middle)
    assert volume > 0
    assert (outward > -1e-9).all()
