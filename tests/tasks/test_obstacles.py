"""Distances of links from spheres, capsules and planes are those of coal, and have the right gradients."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas import problems
from orthocas.errors import InvalidValueError
from orthocas.robots.obstacles import Capsule, LinkDistances, Obstacle, Plane, Sphere
from orthocas.robots.tree import place_on_base
from orthocas.tools.checks import Array

RADIUS = 0.04


def turned_to(direction: Array) -> Array:
    """A rotation that takes the z axis to a direction."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def coal_capsule(start: Array, end: Array, radius: float) -> tuple[Any, Any]:
    """Coal's capsule between two points, and its pose."""
    length = float(np.linalg.norm(end - start))
    rotation = turned_to(end - start) if length > 1e-9 else np.eye(3)
    return coal.Capsule(radius, length), coal.Transform3s(rotation, (start + end) / 2)


def in_coal(obstacle: Obstacle) -> tuple[Any, Any]:
    if isinstance(obstacle, Sphere):
        return coal.Sphere(obstacle.radius), coal.Transform3s(np.eye(3), obstacle.centre)
    if isinstance(obstacle, Capsule):
        return coal_capsule(obstacle.start, obstacle.end, obstacle.radius)
    assert isinstance(obstacle, Plane)
    return coal.Halfspace(obstacle.normal, float(obstacle.normal @ obstacle.point)), coal.Transform3s()


def distance_of_coal(start: Array, end: Array, obstacle: Obstacle) -> float:
    result = coal.DistanceResult()
    capsule, pose = coal_capsule(start, end, RADIUS)
    other, place = in_coal(obstacle)
    return float(coal.distance(capsule, pose, other, place, coal.DistanceRequest(), result))


def some(rng: np.random.Generator, kind: str) -> Obstacle:
    if kind == "sphere":
        return Sphere(rng.normal(size=3), rng.uniform(0.05, 0.2))
    if kind == "capsule":
        return Capsule(rng.normal(size=3), rng.normal(size=3), rng.uniform(0.05, 0.2))
    return Plane(rng.normal(size=3), rng.normal(size=3))


@pytest.mark.parametrize("kind", ["sphere", "capsule", "plane"])
def test_distances_are_those_of_coal(kind: str) -> None:
    """For separate solids: what coal says of solids that overlap depends on its algorithm."""
    robot, rng = problems.get("iiwa").robot, np.random.default_rng(3)
    obstacles = [some(rng, kind) for _ in range(5)]
    distances = LinkDistances(robot, obstacles, RADIUS)
    compared = 0
    for q in rng.uniform(-2, 2, (20, 7)):
        points, found = robot.joint_points(q), distances(q).reshape(-1, 5)
        ends = [*pairwise(points[1:])]
        assert len(ends) == len(found)
        for (start, end), row in zip(ends, found, strict=True):
            for obstacle, value in zip(obstacles, row, strict=True):
                if value > 1e-3:
                    assert value == pytest.approx(distance_of_coal(start, end, obstacle), abs=1e-6)
                    compared += 1
    assert compared > 100


def test_distance_of_segments_is_the_least_of_a_dense_search() -> None:
    """Random, parallel and crossing segments, and points."""
    rng, shares = np.random.default_rng(4), np.linspace(0, 1, 401)
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    for case in range(12):
        start, end = rng.uniform(-1, 1, (2, 3))
        if case % 3 == 1:
            start, end = np.array([0.2, 0.3, 0.1]), np.array([0.8, 0.3, 0.1])  # parallel to the stretched arm
        if case % 3 == 2:
            end = start
        value = LinkDistances(robot, [Capsule(start, end, 0.05)])([0.0, 0.0])
        line = start + shares[:, None] * (end - start)
        for k, found in enumerate(value):
            link = np.column_stack([k + shares, 0 * shares, 0 * shares])
            dense = np.linalg.norm(line[:, None] - link[None], axis=2).min() - 0.05
            assert dense - 5e-3 < found < dense + 1e-9


def test_gradients_are_finite_differences() -> None:
    robot = problems.get("iiwa").robot
    obstacles = [
        Sphere([0.5, 0.1, 0.6], 0.1),
        Capsule([0.3, 0.4, 0.0], [0.3, 0.4, 1.0], 0.1),
        Plane([0, 0.1, 1], [0, 0, 0]),
    ]
    distances, rng = LinkDistances(robot, obstacles, RADIUS), np.random.default_rng(5)
    q = rng.uniform(-1, 1, (4, 7))
    values, gradients = distances.evaluate_gradients(q)
    np.testing.assert_allclose(values, distances(q), atol=1e-12)
    for i in range(7):
        step = 1e-6 * np.eye(7)[i]
        np.testing.assert_allclose(gradients[:, :, i], (distances(q + step) - distances(q - step)) / 2e-6, atol=1e-6)


def test_links_that_do_not_move_are_left_out() -> None:
    """The base of the arm stands on the floor all the time."""
    robot = problems.get("iiwa").robot
    pairs = LinkDistances(robot, [Plane([0, 0, 1], [0, 0, 0.14])]).pairs
    assert [pair.split("'")[1] for pair in pairs] == list(robot.joint_names)
    assert LinkDistances(robot, []).pairs == ()
    assert LinkDistances(robot, [])(np.zeros((3, 7))).shape == (3, 0)


LEFT, RIGHT = "left_gripper", "right_gripper"


def test_links_of_two_arms_are_those_between_joints_of_pinocchio() -> None:
    """Every link of both arms once, none from the hand of one arm to the shoulder of the other."""
    path = robot_data("baxter_description/urdf/baxter.urdf")
    robot, model = oc.Robot.from_urdf(path, tips=[LEFT, RIGHT]), pin.buildModelFromUrdf(str(path))
    data, rng = model.createData(), np.random.default_rng(6)
    floor = Plane([0.3, 0.2, 1.0], [0.0, 0.0, -3.0])
    distances = LinkDistances(robot, [floor], RADIUS)
    names = [pair.split("'")[1] for pair in distances.pairs]
    assert sorted(names) == sorted(robot.joint_names)
    for q in rng.uniform(-1, 1, (5, robot.n)):
        whole = pin.neutral(model)
        for name, value in zip(robot.joint_names, q, strict=True):
            whole[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, whole)
        found = dict(zip(names, distances(q), strict=True))
        for side, hand in (("left", LEFT), ("right", RIGHT)):
            arm = [name for name in robot.joint_names if name.startswith(side)]
            points = [data.oMi[model.getJointId(name)].translation for name in arm]
            points.append(data.oMf[model.getFrameId(hand)].translation)
            for name, (start, end) in zip(arm, pairwise(points), strict=True):
                assert found[name] == pytest.approx(distance_of_coal(start, end, floor), abs=1e-6)


def test_a_link_under_both_arms_counts_once() -> None:
    path = robot_data("pr2_description/urdf/pr2.urdf")
    robot = oc.Robot.from_urdf(path, tips=["l_gripper_tool_frame", "r_gripper_tool_frame"])
    distances = LinkDistances(robot, [Plane([0, 0, 1], [0, 0, 0])])
    # the column under the lift, and from the lift to both shoulders
    assert [pair.split("'")[1] for pair in distances.pairs].count("torso_lift_joint") == 3
    assert len(distances.pairs) == robot.n + 2


def test_nothing_solid_joins_the_world_and_a_moving_base() -> None:
    arm = problems.get("iiwa").robot
    robot = oc.Robot(place_on_base(arm.tree, "planar", 10.0, np.zeros(3), np.eye(3)))
    q = np.array([3.0, 2.0, 0.5, *np.linspace(-0.5, 0.5, 7)])
    pairs = LinkDistances(robot, [Sphere([1.5, 0.0, 0.0], 0.2), Sphere([3.0, 1.0, 0.0], 0.2)])
    assert not any(name in pair for pair in pairs.pairs for name in ("base_x", "base_y"))
    assert pairs(q).min() > 0.7
    under = LinkDistances(robot, [Sphere([3.0, 2.0, 0.0], 0.1)])
    assert under(q).min() == pytest.approx(-0.1, abs=1e-6)


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "radius of a sphere": (lambda: Sphere([0, 0, 0], 0.0), "radius is 0.0, expected a length above 0"),
    "centre": (lambda: Sphere([0, 0], 1.0), r"centre has shape \(2,\), expected \(3,\)"),
    "end of a capsule": (lambda: Capsule([0, 0, 0], [0, np.nan, 0], 1.0), r"end\[1\] is nan"),
    "normal": (lambda: Plane([0, 0, 0], [0, 0, 0]), "normal is .*, expected a direction"),
    "obstacle": (lambda: LinkDistances(problems.get("iiwa").robot, ["ball"]), r"obstacles\[0\] is a str"),  # type: ignore[list-item]
    "links": (lambda: LinkDistances(problems.get("iiwa").robot, [], [1.0, 2.0]), "radius is an array of shape"),
    "negative radius": (lambda: LinkDistances(problems.get("iiwa").robot, [], -1.0), "expected lengths >= 0"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_solids_are_refused(name: str) -> None:
    call, message = WRONG[name]
    with pytest.raises((InvalidValueError, oc.errors.ShapeError), match=message):
        call()
