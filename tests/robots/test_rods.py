"""Rods in place of solids lie between the joints of each link, and distances from them are those of a dense search."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas import problems
from orthocas.errors import InvalidValueError, RobotError
from orthocas.robots.obstacles import Capsule, Plane, Sphere
from orthocas.robots.tree import place_on_base
from orthocas.tools.checks import Array

RADIUS = 0.04


@pytest.mark.slow
def test_rods_lie_between_the_joints() -> None:
    robot, rng, shares = problems.get("iiwa").robot, np.random.default_rng(3), np.linspace(0, 1, 401)[:, None]
    post = Capsule(rng.normal(size=3), rng.normal(size=3), 0.1)
    around = robot.with_rods(RADIUS).collisions.with_scene(oc.Scene({"post": post}))
    assert around.pairs == tuple((f"link of {name}", "post") for name in robot.joint_names)
    line = post.start + shares * (post.end - post.start)
    for q in rng.uniform(-2, 2, (20, 7)):
        found = around.pair_distances(q)
        for value, (start, end) in zip(found, pairwise(robot.joint_points(q)[1:]), strict=True):
            link = start + shares * (end - start)
            dense = np.linalg.norm(line[:, None] - link[None], axis=2).min() - 0.1 - RADIUS
            if value > 0:
                assert dense - 5e-3 < value < dense + 1e-9


LEFT, RIGHT = "left_gripper", "right_gripper"


def test_links_of_two_arms_are_those_between_joints_of_pinocchio() -> None:
    """Every link of both arms once, none from the hand of one arm to the shoulder of the other."""
    path = robot_data("baxter_description/urdf/baxter.urdf")
    robot, model = oc.Robot.from_urdf(path, tips=[LEFT, RIGHT]), pin.buildModelFromUrdf(str(path))
    data, rng = model.createData(), np.random.default_rng(6)
    floor = Plane([0.3, 0.2, 1.0], [0.0, 0.0, -3.0])
    around = robot.with_rods(RADIUS).collisions.with_scene(oc.Scene({"floor": floor}))
    names = [first.removeprefix("link of ") for first, _ in around.pairs]
    assert sorted(names) == sorted(robot.joint_names)
    for q in rng.uniform(-1, 1, (5, robot.n)):
        whole = pin.neutral(model)
        for name, value in zip(robot.joint_names, q, strict=True):
            whole[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, whole)
        found = dict(zip(names, around.pair_distances(q), strict=True))
        for side, hand in (("left", LEFT), ("right", RIGHT)):
            arm = [name for name in robot.joint_names if name.startswith(side)]
            points = [data.oMi[model.getJointId(name)].translation for name in arm]
            points.append(data.oMf[model.getFrameId(hand)].translation)
            heights = (np.array(points) - floor.point) @ floor.normal
            for name, ends in zip(arm, pairwise(heights), strict=True):
                assert found[name] == pytest.approx(min(ends) - RADIUS, abs=1e-6)


def test_a_link_under_both_arms_counts_once() -> None:
    path = robot_data("pr2_description/urdf/pr2.urdf")
    robot = oc.Robot.from_urdf(path, tips=["l_gripper_tool_frame", "r_gripper_tool_frame"])
    around = robot.with_rods(RADIUS).collisions.with_scene(oc.Scene({"floor": Plane([0, 0, 1], [0, 0, 0])}))
    # From the lift to both shoulders.
    assert [part.name for part in around.parts].count("link of torso_lift_joint") == 2
    assert len(around.pairs) == robot.n


def test_nothing_solid_joins_the_world_and_a_moving_base() -> None:
    arm = problems.get("iiwa").robot
    robot = oc.Robot(place_on_base(arm.tree, "planar", 10.0, np.zeros(3), np.eye(3))).with_rods(0.01)
    q = np.array([3.0, 2.0, 0.5, *np.linspace(-0.5, 0.5, 7)])
    aside = oc.Scene({"one": Sphere([1.5, 0.0, 0.0], 0.2), "two": Sphere([3.0, 1.0, 0.0], 0.2)})
    around = robot.collisions.with_scene(aside)
    assert not any(name in first for first, _ in around.pairs for name in ("base_x", "base_y"))
    assert around.distance(q).distance > 0.7
    under = robot.collisions.with_scene(oc.Scene({"ball": Sphere([3.0, 2.0, 0.0], 0.1)}))
    assert under.distance(q).distance == pytest.approx(-0.11, abs=1e-6)


def test_the_interface_of_before_names_the_new_one() -> None:
    with pytest.raises(AttributeError, match="with_rods"):
        _ = oc.obstacles.LinkDistances
    with pytest.raises(RobotError, match="with_rods"):
        _ = problems.get("iiwa").robot.collisions


def rods(radius: float | Array) -> object:
    return problems.get("iiwa").robot.with_rods(radius)


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "radius of a sphere": (lambda: Sphere([0, 0, 0], 0.0), "radius is 0.0, expected a length above 0"),
    "centre": (lambda: Sphere([0, 0], 1.0), r"centre has shape \(2,\), expected \(3,\)"),
    "end of a capsule": (lambda: Capsule([0, 0, 0], [0, np.nan, 0], 1.0), r"end\[1\] is nan"),
    "normal": (lambda: Plane([0, 0, 0], [0, 0, 0]), "normal is .*, expected a vector longer"),
    "radii": (lambda: rods(np.ones(2)), "radius is an array of shape"),
    "negative radius": (lambda: rods(-1.0), "expected lengths above 0"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_solids_are_refused(name: str) -> None:
    call, message = WRONG[name]
    with pytest.raises((InvalidValueError, oc.errors.ShapeError), match=message):
        call()
