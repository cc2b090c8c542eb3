"""URDF files that Pinocchio's parser accepts although they describe no robot."""

from pathlib import Path

import numpy as np
import pytest

import orthocas as oc
from orthocas.errors import RobotError

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
