"""Tools move the tip, and homes come from the files of a robot."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import one_joint, robot_data

import orthocas as oc
from orthocas.errors import InvalidValueError, RobotError, UnknownNameError
from orthocas.problems import iiwa_robot


@pytest.mark.slow
def test_tool_moves_the_tip_as_a_transform_of_the_old_one() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    hand = oc.Robot.from_urdf(path, "panda_hand")
    q = np.random.default_rng(2).uniform(-1, 1, (20, 7))
    R, p = hand.tip_rotation(q), hand.tip_position(q)
    angles = np.array([0.3, -0.4, 1.2])
    turn = pin.rpy.rpyToMatrix(angles)
    offset = np.array([0.01, -0.02, 0.15])
    full = np.eye(4)
    full[:3, :3], full[:3, 3] = turn, offset
    for tool, rotation in ((offset, np.eye(3)), (np.concatenate([offset, angles]), turn), (full, turn)):
        for robot in (hand.with_tool(tool), oc.Robot.from_urdf(path, "panda_hand", tool=tool)):
            np.testing.assert_allclose(robot.tip_position(q), p + R @ offset, atol=1e-12)
            np.testing.assert_allclose(robot.tip_rotation(q), R @ rotation, atol=1e-12)
            np.testing.assert_array_equal(robot.mass_matrix(q), hand.mass_matrix(q))  # no mass
            assert robot.tree.tip_name == "panda_hand + tool"
    tcp = oc.Robot.from_urdf(path, "panda_hand_tcp")
    np.testing.assert_allclose(hand.with_tool((0, 0, 0.1034)).tip_position(q), tcp.tip_position(q), atol=1e-12)


def test_bad_tools_are_refused() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    with pytest.raises(InvalidValueError, match=r"shape of tool is \(2,\), expected \(3,\), \(6,\) or \(4, 4\)"):
        robot.with_tool([0.1, 0.2])
    with pytest.raises(InvalidValueError, match="rotation of tool"):
        robot.with_tool(2 * np.eye(4) - np.diag([0, 0, 0, 1]))
    with pytest.raises(InvalidValueError, match="last row of tool"):
        robot.with_tool(np.ones((4, 4)))
    with pytest.raises(InvalidValueError, match=r"tool\[1\] is nan"):
        robot.with_tool([0.0, np.nan, 0.0])


def test_homes_come_from_the_srdf_file_of_a_urdf() -> None:
    panda = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
    want = [0, -0.785398, 0, -2.35619, 0, 1.5707, 0.785398]
    np.testing.assert_allclose(panda.home("default"), want, atol=1e-6)
    xarm = oc.Robot.from_urdf(robot_data("xarm_description/urdf/xarm7.urdf"), "link_eef")
    assert set(xarm.homes) == {"home", "hold-up"}
    np.testing.assert_array_equal(xarm.home("hold-up"), [0, 0, 0, 0, 0, -1.5708, 0])
    kinova = oc.Robot.from_urdf(robot_data("kinova_description/robots/kinova.urdf"), "j2s6s200_end_effector")
    np.testing.assert_array_equal(kinova.home("arm_up"), [1.5707, 2.618, -1.5707, 3.1415, 2.618, 0])
    with pytest.raises(UnknownNameError, match="unknown home 'up', known: home, hold-up"):
        xarm.home("up")
    with pytest.raises(UnknownNameError, match="the robot's files name no posture"):
        iiwa_robot().home("up")
    assert set(panda.with_tool((0, 0, 0.1)).with_scaled_masses(2.0).homes) == {"default"}


def test_homes_leave_out_locked_joints_and_states_of_other_joints(tmp_path: Path) -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(path, "panda_hand", {"panda_joint3": 0.1})
    np.testing.assert_allclose(robot.home("default"), [0, -0.785398, -2.35619, 0, 1.5707, 0.785398], atol=1e-6)
    assert oc.Robot.from_urdf(path, "panda_hand").homes.keys() == {"default"}
    own = one_joint(tmp_path)
    (tmp_path / "arm.srdf").write_text(
        """<robot name="r"><group_state name="up" group="arm"><joint name="j" value="0.5"/></group_state>
        <group_state name="open" group="hand"><joint name="finger" value="0.5"/></group_state>
        <group_state name="odd" group="arm"><joint name="j" value="0 0 0"/></group_state></robot>"""
    )
    assert list(oc.Robot.from_urdf(own, "a").homes) == ["up"]
    (tmp_path / "arm.srdf").write_text("<robot")
    with pytest.raises(RobotError, match=r"arm\.srdf is not an SRDF file"):
        oc.Robot.from_urdf(own, "a")


def test_homes_come_from_the_keyframes_of_an_mjcf_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><worldbody><body name="trunk"><freejoint name="root"/><geom type="sphere" size="0.1" mass="5"/>
        <body name="a"><joint name="j1" type="hinge" axis="0 0 1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 1 0 0" mass="2"/>
        <body name="hand" pos="1 0 0"><joint name="j2" type="slide" axis="0 0 1"/>
        <geom type="sphere" size="0.1" mass="1"/></body></body></body></worldbody>
        <keyframe><key name="ready" qpos="0 0 1 1 0 0 0 0.5 0.2"/></keyframe></mujoco>"""
    )
    robot = oc.Robot.from_mjcf(path, "hand", {"root": 0.0})
    assert list(robot.homes) == ["ready"]
    np.testing.assert_allclose(robot.home("ready"), [0.5, 0.2])
