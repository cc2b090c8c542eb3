"""URDF files that Pinocchio's parser accepts although they describe no robot, and those that it need not refuse."""

import logging
from pathlib import Path

import numpy as np
import pytest

import orthocas as oc
from orthocas.errors import RobotError, TipWarning

ARM = """<robot name="r"><link name="base"/><link name="a"/>
<joint name="j" type="{kind}"><parent link="base"/><child link="a"/>{axis}
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def write(folder: Path, kind: str, axis: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(ARM.format(kind=kind, axis=axis))
    return path


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
@pytest.mark.parametrize(
    ("axis", "message"),
    [
        ('<axis xyz="0 0 0"/>', "xyz of <axis> of joint 'j' is '0 0 0', expected a vector that is not zero"),
        ("<axis/>", "<axis> of joint 'j' has no attribute 'xyz'"),
        ('<axis xyz="0 1"/>', "xyz of <axis> of joint 'j' is '0 1', expected 3 numbers"),
        ('<axis xyz="0 x 0"/>', "xyz of <axis> of joint 'j' is '0 x 0', expected 3 numbers"),
    ],
)
def test_joints_along_no_axis_are_refused_by_name(tmp_path: Path, kind: str, axis: str, message: str) -> None:
    with pytest.raises(RobotError, match=rf"arm\.urdf: {message}"):
        oc.Robot.from_urdf(write(tmp_path, kind, axis), "a")


def test_joint_without_axis_element_moves_along_x_as_urdf_says(tmp_path: Path) -> None:
    robot = oc.Robot.from_urdf(write(tmp_path, "prismatic", ""), "a")
    assert robot.tip_position([0.3]).tolist() == [0.3, 0.0, 0.0]


def test_urdf_with_more_links_than_any_robot_is_refused(tmp_path: Path) -> None:
    joints = "".join(
        f'<link name="l{i}"/><joint name="j{i}" type="continuous"><parent link="l{i - 1}"/><child link="l{i}"/></joint>'
        for i in range(1, 5000)
    )
    path = tmp_path / "snake.urdf"
    path.write_text(f'<robot name="snake"><link name="l0"/>{joints}</robot>')
    with pytest.raises(RobotError, match=r"snake\.urdf has 5000 links, expected at most 1000"):
        oc.Robot.from_urdf(path)


JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""


def write_joints(folder: Path, *joints: tuple[str, str, str]) -> Path:
    links = sorted({link for _, *ends in joints for link in ends})
    path = folder / "arm.urdf"
    parts = [*(f'<link name="{link}"/>' for link in links), *(JOINT.format(*joint) for joint in joints)]
    path.write_text(f'<robot name="r">{"".join(parts)}</robot>')
    return path


def test_joint_that_hangs_from_its_own_child_is_named(tmp_path: Path) -> None:
    """Pinocchio's parser leaves such joints out, and all that they carry."""
    path = write_joints(tmp_path, ("j", "a", "b"), ("k", "c", "c"), ("l", "c", "d"))
    with pytest.raises(
        RobotError, match="joint 'k' hangs from link 'c' to link 'c' in a loop of joints, expected a tree"
    ):
        oc.Robot.from_urdf(path)
    path = write_joints(tmp_path, ("j", "a", "b"), ("k", "c", "d"), ("l", "d", "c"))
    with pytest.raises(RobotError, match="joint 'k' hangs from link 'c' to link 'd' in a loop"):
        oc.Robot.from_urdf(path)


ARM_OF_TWO = (("j", "a", "b"), ("k", "b", "c"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '<parent link="b"/>',
            '<parent link="pelvis"/>',
            "joint 'k' has the parent link 'pelvis', which the file does",
        ),
        ('<child link="c"/>', '<child link="hand"/>', "joint 'k' has the child link 'hand', which the file does not"),
        ('<parent link="b"/>', "", "joint 'k' has no parent link"),
        ('<link name="c"/>', '<link name="c"/><link name="c"/>', "two links are called 'c'"),
        ('<link name="c"/>', '<link name="c"/><link/>', "a link has no name"),
        ('<link name="c"/>', '<link name="c"/><link name="d"/>', "the links 'a' and 'd' hang on no joint"),
        ("</robot>", JOINT.format("l", "a", "c") + "</robot>", "link 'c' hangs on the joints 'k' and 'l', expected a"),
        ('<limit lower="-1"', '<limit lower="x"', r"limit element for joint \[j\]: .*lower value \(x\) is not a valid"),
    ],
)
def test_what_is_no_tree_of_joints_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write_joints(tmp_path, *ARM_OF_TWO)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(RobotError, match=rf"arm\.urdf.*{message}") as caught:
        oc.Robot.from_urdf(path)
    assert "/project/" not in str(caught.value)


SHAPE = '<link name="c"><visual>{}</visual><collision>{}</collision></link>'
BOX = '<geometry><box size="1 1 1"/></geometry>'


@pytest.mark.parametrize(
    "part",
    [
        SHAPE.format(f"{BOX}<material><color rgba='1 0 0 1'/></material>", BOX),
        SHAPE.format(BOX, '<geometry><capsule radius="1" length="1"/></geometry>'),
        SHAPE.format("<geometry><mesh/></geometry>", BOX),
        SHAPE.format(f"{BOX}<material name='m'><texture/></material>", BOX),
        SHAPE.format('<origin xyz="0 0 0"/>', BOX),
        SHAPE.format(BOX, '<geometry><box size="1 1"/></geometry>'),
        '<link name="c"/><material name="m"><color rgba="1 0 0 1"/></material><material name="m"/>',
    ],
)
def test_faults_in_what_kinematics_does_not_use_are_logged(
    tmp_path: Path, part: str, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """Unnamed and double materials, capsules, meshes and textures without files, and visuals without geometry."""
    path = write_joints(tmp_path, *ARM_OF_TWO)
    plain = oc.Robot.from_urdf(path)
    path.write_text(path.read_text().replace('<link name="c"/>', part))
    with caplog.at_level(logging.WARNING, "orthocas"):
        robot = oc.Robot.from_urdf(path)
    assert robot.joint_names == plain.joint_names
    np.testing.assert_array_equal(robot.tip_position([0.3, 0.4]), plain.tip_position([0.3, 0.4]))
    texture = "texture" in part  # of which the parser does not complain
    assert [record.getMessage() for record in caplog.records] == [] if texture else "left out" in caplog.text
    assert "/project/" not in caplog.text
    assert "Error" not in capfd.readouterr().err


@pytest.mark.parametrize("what", ["effort", "velocity"])
@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_missing_limits_of_effort_and_velocity_are_none(
    tmp_path: Path, what: str, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_joints(tmp_path, *ARM_OF_TWO)
    path.write_text(path.read_text().replace(f'{what}="1"', "", 1).replace("revolute", kind))
    with caplog.at_level(logging.WARNING, "orthocas"):
        robot = oc.Robot.from_urdf(path)
    limits = {"effort": robot.effort_limits, "velocity": robot.velocity_limits}
    np.testing.assert_array_equal(limits.pop(what), [np.inf, 1])
    np.testing.assert_array_equal(*limits.values(), [1, 1])
    assert caplog.messages == [
        f"{path}: limits are missing, or those of effort or velocity are -1, so there are none: j"
    ]


def test_limits_of_minus_one_are_none_and_a_lost_base_is_added(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_joints(tmp_path, *ARM_OF_TWO)
    plain = oc.Robot.from_urdf(path)
    path.write_text(path.read_text().replace('effort="1"', 'effort="-1.0"', 1).replace('<link name="a"/>', ""))
    with caplog.at_level(logging.WARNING, "orthocas"):
        robot = oc.Robot.from_urdf(path)
    assert robot.effort_limits.tolist() == [np.inf, 1]
    np.testing.assert_array_equal(robot.tip_position([0.3, 0.4]), plain.tip_position([0.3, 0.4]))
    assert "so there are none: j" in caplog.text
    assert "the link 'a' is missing, and taken as the base" in caplog.text


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_joints_without_any_limit_are_unlimited(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "arm.urdf"
    whole = ARM.format(kind=kind, axis="")
    path.write_text(whole.replace('<limit lower="-1" upper="1" effort="1" velocity="1"/>', ""))
    with caplog.at_level(logging.WARNING, "orthocas"):
        robot = oc.Robot.from_urdf(path)
    assert (robot.lower[0], robot.upper[0], robot.effort_limits[0]) == (-np.inf, np.inf, np.inf)
    assert "so there are none: j" in caplog.text


def test_calls_of_lost_macros_are_left_out_with_a_word(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_joints(tmp_path, *ARM_OF_TWO)
    text = path.read_text().replace('<robot name="r">', '<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro">')
    path.write_text(text.replace("</robot>", "<xacro:camera/></robot>"))
    with caplog.at_level(logging.WARNING, "orthocas"):
        assert oc.Robot.from_urdf(path).n == 2
    assert "calls xacro macros that it does not have, which are left out: camera" in caplog.text


def test_mimic_of_a_mimic_off_the_chain_is_locked_and_one_of_nothing_named(tmp_path: Path) -> None:
    """Of followers with multiplier 2 and offset 0.1 of one another, the second hangs at 0.1 + 2 * 0.1."""
    mimic = '<mimic joint="{}" multiplier="2" offset="0.1"/></joint>'
    path = write_joints(tmp_path, *ARM_OF_TWO, ("f", "c", "d"), ("g", "c", "e"), ("h", "c", "i"))
    parts = path.read_text().split("</joint>")
    path.write_text(
        "</joint>".join(parts[:3]) + "</joint>" + mimic.format("f").join(parts[3:5]) + mimic.format("g") + parts[5]
    )
    robot = oc.Robot.from_urdf(path, "c")
    assert robot.joint_names == ("j", "k")
    for frame, angle in (("e", 0.1), ("i", 0.3)):
        turn = robot.frame_rotation([0.0, 0.0], frame)
        np.testing.assert_allclose([turn[0, 0], turn[1, 0]], [np.cos(angle), np.sin(angle)], atol=1e-12)
    # On the way to the tip, f moves all three.
    robot = oc.Robot.from_urdf(path, "i")
    assert robot.joint_names == ("j", "k", "f")
    turn = robot.tip_rotation([0.0, 0.0, 0.2])
    np.testing.assert_allclose([turn[0, 0], turn[1, 0]], [np.cos(1.1), np.sin(1.1)], atol=1e-12)
    path.write_text(path.read_text().replace('mimic joint="g"', 'mimic joint="nowhere"'))
    with pytest.raises(RobotError, match="joint 'h' mimics joint 'nowhere', which the file does not have"):
        oc.Robot.from_urdf(path, "i")


def test_shapes_for_collision_checks_are_no_default_tips_and_lists_of_tips_have_every_end(tmp_path: Path) -> None:
    fixed = '<link name="{1}"/><joint name="to_{1}" type="fixed"><parent link="{0}"/><child link="{1}"/></joint>'
    path = write_joints(tmp_path, *ARM_OF_TWO)
    ends = [fixed.format("c", name) for name in ("flange", "c_sc", "flange_collision")]
    path.write_text(path.read_text().replace("</robot>", "".join(ends) + "</robot>"))
    assert oc.Robot.from_urdf(path).tips == ("flange",)
    more = [fixed.format("c", "grasp"), JOINT.format("l", "a", "d"), '<link name="d"/></robot>']
    path.write_text(path.read_text().replace("</robot>", "".join(more)))
    told = r"has 2 chains; taken is tip='grasp', with 2 joints, the longest. Other tips to name: d$"
    with pytest.warns(TipWarning, match=told):
        assert oc.Robot.from_urdf(path).tips == ("grasp",)


def test_joint_that_shares_its_name_with_a_link_can_be_locked(tmp_path: Path) -> None:
    """The same robot comes out as with names that differ."""
    shared = oc.Robot.from_urdf(write_joints(tmp_path, ("b", "a", "b"), ("c", "b", "c"), ("d", "c", "d")), "c")
    assert shared.joint_names == ("b", "c")
    shared = oc.Robot.from_urdf(write_joints(tmp_path, ("b", "a", "b"), ("universe!", "b", "c")), "c", {"b": 0.3})
    other = oc.Robot.from_urdf(write_joints(tmp_path, ("j", "a", "b"), ("universe!", "b", "c")), "c", {"j": 0.3})
    assert shared.tree.tip_name == other.tree.tip_name == "c"
    np.testing.assert_array_equal(shared.tip_rotation([0.1]), other.tip_rotation([0.1]))


def test_joint_with_the_name_of_the_world_cannot_be_locked(tmp_path: Path) -> None:
    path = write_joints(tmp_path, ("universe", "a", "b"), ("j", "b", "c"))
    assert oc.Robot.from_urdf(path).joint_names == ("universe", "j")
    with pytest.raises(RobotError, match="a joint is called 'universe'"):
        oc.Robot.from_urdf(path, locked={"j": 0.0})


@pytest.mark.parametrize("what", ["multiplier", "offset"])
@pytest.mark.parametrize("text", ["1,5", "nan", "1e999", "1e21", "0x1", ""])
def test_mimic_joints_follow_by_numbers(what: str, text: str, tmp_path: Path) -> None:
    """The follower comes before its leader, so Pinocchio's parser does not read how it follows."""
    mimic = f'<axis xyz="0 0 1"/><mimic joint="k" {what}="{text}"/>'
    path = write(tmp_path, "revolute", mimic)
    leader = '<link name="b"/><joint name="k" type="revolute"><parent link="base"/><child link="b"/></joint></robot>'
    path.write_text(path.read_text().replace("</robot>", leader))
    with pytest.raises(RobotError, match=f"{what} of <mimic> of joint 'j' is '{text}', expected a number up to 1e"):
        oc.Robot.from_urdf(path, "b")


@pytest.mark.parametrize(
    ("moments", "odd"), [((0.02, 0.03, 0.04), False), ((0.01, 0.02, 0.04), True), ((-0.001, 0.03, 0.03), True)]
)
def test_inertia_that_no_body_has_is_noted_with_its_link(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, moments: tuple[float, float, float], odd: bool
) -> None:
    """The largest principal moment is at most the sum of the others; products of inertia join them."""
    path = write_joints(tmp_path, *ARM_OF_TWO)
    xx, yy, zz = moments
    # Turned by 45 degrees about z, the same body.
    mean, half = (xx + yy) / 2, (yy - xx) / 2
    inertia = f'<inertia ixx="{mean}" iyy="{mean}" izz="{zz}" ixy="{half}" ixz="0" iyz="0"/>'
    text = path.read_text().replace(
        '<link name="c"/>', f'<link name="c"><inertial><mass value="2"/>{inertia}</inertial></link>'
    )
    path.write_text(text)
    oc.Robot.from_urdf(path)
    assert ("no body has the principal moments of inertia of these links: 'c'" in caplog.text) == odd
