"""What robot files give, limits included, and what is refused in them."""

import dataclasses
import re
import shutil
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import ROBOTS, arm, one_joint, robot_data

import orthocas as oc
from orthocas.errors import InvalidValueError, OrthocasError, RobotError, ShapeError, TipWarning, UnknownNameError
from orthocas.robots import urdf
from orthocas.robots.pinocchio_model import build_planar

XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


def test_continuous_joints_are_one_angle_without_limits() -> None:
    robot = oc.Robot.from_urdf(robot_data(ROBOTS["double pendulum, continuous"][0]))
    assert robot.n == 2
    assert np.isinf(robot.upper).all()


def test_misspelled_tip_gets_the_similar_names_first() -> None:
    with pytest.raises(UnknownNameError, match="unknown frame 'panda_hnd', known: panda_hand, "):
        oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hnd")


@pytest.mark.parametrize(
    ("joint", "kind"),
    [
        (pin.JointModelSpherical(), "Spherical"),
        (pin.JointModelFreeFlyer(), "FreeFlyer"),
        (pin.JointModelPlanar(), "Planar"),
    ],
)
def test_joints_with_several_freedoms_are_refused_by_name(joint: object, kind: str) -> None:
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Identity(), "odd_joint")
    model.addFrame(pin.Frame("tip", 1, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    with pytest.raises(RobotError, match=f"odd_joint.*{kind}"):
        oc.Robot.from_model(model, "tip")


def test_helical_joint_is_refused_by_name() -> None:
    model = pin.Model()
    model.addJoint(0, pin.JointModelHZ(0.1), pin.SE3.Identity(), "screw")
    model.addFrame(pin.Frame("tip", 1, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    with pytest.raises(RobotError, match="screw.*helical"):
        oc.Robot.from_model(model, "tip")


def test_robot_without_joints_is_refused() -> None:
    path = robot_data("ur_description/urdf/ur5_robot.urdf")
    names = oc.Robot.from_urdf(path, "tool0").joint_names
    with pytest.raises(RobotError, match="no movable joint"):
        oc.Robot.from_urdf(path, "tool0", dict.fromkeys(names, 0.0))


def test_unknown_frame_and_joint_list_what_exists() -> None:
    path = robot_data("ur_description/urdf/ur5_robot.urdf")
    with pytest.raises(UnknownNameError, match="unknown frame 'hand'.*tool0"):
        oc.Robot.from_urdf(path, "hand")
    with pytest.raises(UnknownNameError, match="unknown joint 'elbow'.*elbow_joint"):
        oc.Robot.from_urdf(path, "tool0", {"elbow": 0.0})
    with pytest.raises(InvalidValueError, match="elbow_joint.*nan"):
        oc.Robot.from_urdf(path, "tool0", {"elbow_joint": float("nan")})


@pytest.mark.parametrize(
    ("name", "tip", "joints", "others"),
    [
        # The fingers of a hand are neither moved nor counted; of two arms it is the first.
        ("tiago", "hand_tool_link", 8, "wheel_left_link"),
        ("g1_29dof_with_hand_rev_1_0", "left_hand_palm_link", 10, "right_hand_palm_link"),
        ("talos_full_v2", "wrist_left_ft_tool_link", 9, "wrist_right_ft_tool_link"),
        ("b1-z1", "gripperStator", 6, "FL_foot"),
    ],
)
def test_longest_arm_of_a_branching_robot_is_taken(name: str, tip: str, joints: int, others: str) -> None:
    told = rf"taken is tip='{tip}', with {joints} joints.*Other tips to name: .*{others}"
    with pytest.warns(TipWarning, match=told) as seen:
        robot = oc.Robot.from_name(name)
    assert seen[0].filename == __file__  # the caller's line, not one inside the package
    assert (robot.tips, robot.n) == ((tip,), joints)


def test_robots_by_name() -> None:
    panda = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"))
    assert oc.Robot.from_name("panda").joint_names == panda.joint_names
    assert oc.Robot.from_name("ur5").tips == ("tool0",)
    with pytest.raises(UnknownNameError, match=r"unknown robot 'pandaa', known: panda, "):
        oc.Robot.from_name("pandaa")


ARM_XACRO = f"""<robot name="a" {XACRO}><xacro:property name="reach" value="${{0.1 + 0.2}}"/>
<xacro:macro name="part" params="name parent"><link name="${{name}}"/><joint name="${{name}}_joint" type="continuous">
<parent link="${{parent}}"/><child link="${{name}}"/>
<origin xyz="${{reach}} 0 0"/><axis xyz="0 0 1"/></joint></xacro:macro>
<link name="base"/><xacro:part name="b" parent="base"/><xacro:part name="c" parent="b"/></robot>"""


def test_xacro_files_are_expanded_if_their_name_says_so(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(ARM_XACRO)
    robot = oc.Robot.from_file(path)
    assert robot.joint_names == ("b_joint", "c_joint")
    np.testing.assert_allclose(robot.tip_position([0.0, 0.0]), [0.6, 0, 0], atol=1e-15)
    path.write_text(ARM_XACRO.replace("${0.1 + 0.2}", "${1 / 0}"))
    with pytest.raises(RobotError, match=r"xacro cannot expand .*arm\.urdf\.xacro: .*division by zero"):
        oc.Robot.from_file(path)


def test_xacro_files_find_the_packages_beside_their_own_and_name_those_that_are_missing(tmp_path: Path) -> None:
    """As in a workspace of ROS: one package has the arm, another one its parts."""
    for name in ("arm_test_package", "parts_test_package"):
        (tmp_path / name / "urdf").mkdir(parents=True)
        (tmp_path / name / "package.xml").write_text(f"<package><name>{name}</name></package>")
    include = '<xacro:include filename="$(find parts_test_package)/urdf/part.xacro"/>'
    path = tmp_path / "arm_test_package" / "urdf" / "arm.urdf.xacro"
    path.write_text(f'<robot name="a" {XACRO}>{include}</robot>')
    (tmp_path / "parts_test_package" / "urdf" / "part.xacro").write_text(ARM_XACRO)
    assert oc.Robot.from_file(path).joint_names == ("b_joint", "c_joint")
    # another workspace has other parts in a package of the same name
    other = tmp_path / "other"
    for name in ("arm_test_package", "parts_test_package"):
        shutil.copytree(tmp_path / name, other / name)
    (other / "parts_test_package" / "urdf" / "part.xacro").write_text(ARM_XACRO.replace("_joint", "_axis"))
    assert oc.Robot.from_file(other / path.relative_to(tmp_path)).joint_names == ("b_axis", "c_axis")
    path.write_text(f'<robot name="a" {XACRO}><link name="$(arg side)"/></robot>')
    with pytest.raises(RobotError, match=r"argument side; give it its arguments yourself: xacro FILE NAME:=VALUE >"):
        oc.Robot.from_file(path)
    path.write_text(f'<robot name="a" {XACRO}>{include.replace("parts_test", "lost_test")}</robot>')
    with pytest.raises(RobotError, match=r"xacro needs the ROS package 'lost_test_package', expected beside"):
        oc.Robot.from_file(path)


def test_xacro_files_without_xacro_say_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "arm.xacro"
    path.write_text(ARM_XACRO)
    monkeypatch.setattr("orthocas.robots.urdf.find_spec", lambda name: None)
    with pytest.raises(RobotError, match=r"arm\.xacro is a xacro file, .*pip install 'orthocas\[xacro\]'"):
        oc.Robot.from_file(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "not a URDF file"),
        ("<robot><lin", "not a URDF file"),
        ("<sdf/>", "root element is <sdf>"),
        ('<robot name="a"><link name="b"/><joint name="j" type="revolute"/></robot>', "joint 'j' has no parent link"),
        ('<robot name="a"/>', "is not a usable URDF model: No link elements found in urdf file$"),
        (
            f'<robot name="a" {XACRO}><xacro:include filename="b"/></robot>',
            "is a xacro file, expected URDF: if you trust it, rename it to .xacro",
        ),
        (
            '<robot name="a"><link name="${prefix}b"/></robot>',
            "is a xacro file, expected URDF: if you trust it, rename it to .xacro",
        ),
        (f'<robot name="a" {XACRO}><link name="b"/><xacro:arm/></robot>', "no movable joint"),
    ],
)
def test_malformed_urdf_gets_one_clear_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    path = tmp_path / "bad.urdf"
    path.write_text(text)
    with pytest.raises(RobotError, match=message):
        oc.Robot.from_urdf(path)
    assert capfd.readouterr().err == ""  # the C++ parser's own lines are part of the message instead


@pytest.mark.parametrize(
    ("mass", "message"),
    [
        ("nan", r"inertial element for Link \[a\]: Inertial: mass \[nan\] is not a float$"),
        ("abc", r"inertial element for Link \[a\]: Inertial: mass \[abc\] is not a float$"),
        ("-1", "link 'a' has mass -1 kg, expected >= 0"),
    ],
)
def test_broken_inertias_are_not_swallowed(tmp_path: Path, mass: str, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        oc.Robot.from_urdf(one_joint(tmp_path, mass=mass), "a")


@pytest.mark.parametrize(
    ("ixx", "message"),
    [
        ("-1", r"moved by joint 'j' \(a\) has the principal moment of inertia -1 kg m\^2, expected >= 0"),
        ("1e40", r"largest entry of inertias at joint 'j' is 1e\+40"),
    ],
)
def test_inertias_that_no_body_has_are_refused_by_link_and_joint(tmp_path: Path, ixx: str, message: str) -> None:
    path = one_joint(tmp_path)
    path.write_text(path.read_text().replace('ixx="1"', f'ixx="{ixx}"'))
    with pytest.raises(OrthocasError, match=message):
        oc.Robot.from_urdf(path, "a")


def test_names_may_be_in_any_encoding_of_xml(tmp_path: Path) -> None:
    text = one_joint(tmp_path, joint="é").read_text()
    for encoding in ("utf-8", "iso-8859-1", "windows-1252", "utf-16"):
        path = tmp_path / f"{encoding}.urdf"
        path.write_text(f'<?xml version="1.0" encoding="{encoding}"?>{text}', encoding=encoding)
        assert oc.Robot.from_urdf(path, "a").joint_names == ("é",)


@pytest.mark.parametrize("number", ["1e200", "1e155", "1e21", "-1e308"])
def test_axes_whose_squares_overflow_are_refused(tmp_path: Path, number: str) -> None:
    path = one_joint(tmp_path)
    path.write_text(re.sub('<axis xyz="[^"]*"', f'<axis xyz="{number} 0 1"', path.read_text()))
    with pytest.raises(RobotError, match=r"expected 3 numbers up to 1e\+20"):
        oc.Robot.from_urdf(path, "a")


def test_link_and_joint_may_share_a_name(tmp_path: Path) -> None:
    robot = oc.Robot.from_urdf(one_joint(tmp_path, joint="a"), "a")
    assert robot.joint_names == ("a",)


def test_limits_the_wrong_way_round_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="joint 'j' has limits"):
        oc.Robot.from_urdf(one_joint(tmp_path, lower="2"), "a")


def test_joints_of_any_type_off_the_chain_are_locked_unless_a_model_is_taken_whole(tmp_path: Path) -> None:
    path = one_joint(tmp_path)
    floating = (
        """<link name="b"/><joint name="free" type="floating"><parent link="base"/><child link="b"/></joint></robot>"""
    )
    path.write_text(path.read_text().replace("</robot>", floating))
    assert oc.Robot.from_urdf(path, "a").joint_names == ("j",)
    with pytest.raises(RobotError, match="'free' .*--lock free=0"):
        oc.Robot.from_model(urdf.read_urdf(path)[0], "a")


def test_locked_must_be_a_mapping_to_numbers() -> None:
    path = robot_data("ur_description/urdf/ur5_robot.urdf")
    with pytest.raises(InvalidValueError, match="mapping"):
        oc.Robot.from_urdf(path, "tool0", ["elbow_joint"])  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="elbow_joint"):
        oc.Robot.from_urdf(path, "tool0", {"elbow_joint": "x"})  # type: ignore[dict-item]


def test_long_lists_of_names_are_cut_to_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="gripper_left_base_link.*and .* more") as caught:
        oc.Robot.from_urdf(robot_data("talos_data/robots/talos_reduced.urdf"), "gripper_left_base_lin")
    assert len(str(caught.value)) < 1000  # the robot has 170 frames


def test_missing_urdf_names_the_path(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"nowhere\.urdf: No such file"):
        oc.Robot.from_urdf(tmp_path / "nowhere.urdf")


def test_wrong_shapes_and_nan_are_refused() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    with pytest.raises(ShapeError, match=r"q has shape \(3,\), expected \(2,\)"):
        robot.mass_matrix(np.zeros(3))
    with pytest.raises(InvalidValueError, match="finite"):
        robot.mass_matrix(np.array([0.0, np.nan]))
    with pytest.raises(ShapeError):
        robot.mass_matrix(ca.SX.sym("q", 3))
    with pytest.raises(ShapeError):
        robot.bias(np.zeros((2, 2)), np.zeros((3, 2)))
    with pytest.raises(InvalidValueError, match="array of numbers"):
        robot.mass_matrix("abc")


def test_bad_planar_arms_are_refused() -> None:
    with pytest.raises(ShapeError, match="masses"):
        build_planar([1.0, 1.0], [1.0])
    with pytest.raises(InvalidValueError, match="lengths"):
        build_planar([1.0, -1.0], [1.0, 1.0])


def test_effort_and_velocity_limits_come_from_the_file() -> None:
    robot = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
    np.testing.assert_array_equal(robot.effort_limits, [87, 87, 87, 87, 12, 12, 12])
    np.testing.assert_array_equal(robot.velocity_limits, [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
    wrist = oc.Robot.from_urdf(
        robot_data("panda_description/urdf/panda.urdf"), "panda_hand", dict.fromkeys(robot.joint_names[:4], -0.5)
    )
    np.testing.assert_array_equal(wrist.effort_limits, [12, 12, 12])  # locking joints keeps the others' limits
    assert np.isinf(oc.Robot.planar([1.0, 1.0], [1.0, 1.0]).velocity_limits).all()


@pytest.mark.parametrize("name", [name for name in ROBOTS if "continuous" not in name])  # its file has no limits
def test_limits_of_effort_and_velocity_of_real_files_are_pinocchios(name: str) -> None:
    model, tip = arm(name)
    robot = oc.Robot.from_model(model, tip)
    np.testing.assert_array_equal(robot.effort_limits, model.effortLimit)
    np.testing.assert_array_equal(robot.velocity_limits, model.velocityLimit)
    assert np.isfinite(robot.effort_limits).all()
    for changed in (robot.with_scaled_masses(2.0), robot.with_tool([0, 0, 0.1])):
        np.testing.assert_array_equal(changed.effort_limits, robot.effort_limits)
        np.testing.assert_array_equal(changed.velocity_limits, robot.velocity_limits)


def test_limits_of_the_iiwa_are_those_of_its_data_sheet(iiwa: oc.Problem) -> None:
    np.testing.assert_array_equal(iiwa.robot.effort_limits, [176, 176, 110, 110, 110, 40, 40])
    np.testing.assert_allclose(np.degrees(iiwa.robot.velocity_limits), [98, 98, 100, 130, 140, 180, 180])
    facts = iiwa.robot.facts()
    assert (facts["effort"], facts["velocity"][:11]) == ("176, 176, 110, 110, 110, 40, 40", "1.71, 1.71,")
    assert "effort" not in oc.Robot.planar([1.0], [1.0]).facts()


@pytest.mark.parametrize("what", ["effort", "velocity"])
def test_negative_limits_are_refused_by_name(tmp_path: Path, what: str) -> None:
    path = one_joint(tmp_path)
    path.write_text(path.read_text().replace(f'{what}="1"', f'{what}="-7"'))
    with pytest.raises(RobotError, match=rf"arm\.urdf: {what} of <limit> of joint 'j' is '-7', expected a number >= 0"):
        oc.Robot.from_urdf(path, "a")


def test_limits_of_a_model_are_not_nan() -> None:
    model = build_planar([1.0, 1.0], [1.0, 1.0])
    model.effortLimit = np.array([1.0, np.nan])
    with pytest.raises(RobotError, match="joint 'q2' has the effort limit nan, expected a number >= 0"):
        oc.Robot.from_model(model, "tip")


@pytest.mark.parametrize(
    ("written", "effort", "velocity"),
    [
        ('effort="0" velocity="0"', np.inf, np.inf),
        ('effort="7" velocity="0"', 7, np.inf),
        ('effort="1e300" velocity="3"', np.inf, 3),
    ],
)
def test_limits_of_nothing_are_unknown(tmp_path: Path, written: str, effort: float, velocity: float) -> None:
    path = one_joint(tmp_path)
    path.write_text(path.read_text().replace('effort="1" velocity="1"', written))
    robot = oc.Robot.from_urdf(path, "a")
    assert (robot.effort_limits[0], robot.velocity_limits[0]) == (effort, velocity)


def test_effort_limits_must_be_positive() -> None:
    tree = oc.Robot.planar([1.0, 1.0], [1.0, 1.0]).tree
    for bad in (-1.0, 0.0, np.nan):
        with pytest.raises(RobotError, match="joint 'q2' has the effort limit"):
            dataclasses.replace(tree, effort_limits=np.array([1.0, bad]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint_names": ("a", "b", 3)}, r"joint_names\[2\] is 3, expected printable text"),
        ({"joint_names": ("a", "b", "a")}, "two joints are called 'a'"),
        ({"joint_names": ("a", "b", "c\x1b[2J")}, r"joint_names\[2\] is .*, expected printable text"),
        ({"parents": (-1, 0, 1.0)}, r"parents\[2\] is 1.0, expected an index from -1 to 1"),
        ({"parents": (-1, 0, True)}, r"parents\[2\] is True, expected an index"),
        ({"joint_kinds": ("revolute", "revolute", [])}, "unknown joint kind"),
        ({"lower": np.array([1j, 0, 0])}, "lower is .*, expected an array of numbers"),
    ],
)
def test_names_and_numbers_that_no_robot_has_are_refused(change: dict[str, object], message: str) -> None:
    tree = oc.Robot.planar([1.0] * 3, [1.0] * 3).tree
    with pytest.raises(OrthocasError, match=message):
        dataclasses.replace(tree, **change)
