"""Domains: sampling, limits, default boxes, bad input."""

import dataclasses

import numpy as np
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.errors import DomainError, InvalidValueError, ShapeError
from orthocas.tasks.domains import Box, default_box, require_within_limits
from orthocas.tasks.samples import sample_evenly, sample_uniform


def panda() -> oc.Robot:
    return oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")


def test_samples_fill_the_box_uniformly_and_follow_the_seed() -> None:
    box = oc.Box([1.0, -2.0], [0.5, 2.0])
    points = sample_uniform(box, 20_000, seed=3)
    unit = (points - box.centre) / box.half_width
    assert np.abs(unit).max() <= 1
    np.testing.assert_allclose(unit.mean(axis=0), 0, atol=0.02)  # standard error 0.004
    np.testing.assert_allclose((unit**2).mean(axis=0), 1 / 3, atol=0.02)
    np.testing.assert_array_equal(points, sample_uniform(box, 20_000, seed=3))
    assert not np.array_equal(points, sample_uniform(box, 20_000, seed=4))


def test_even_samples_give_better_means_than_random_ones() -> None:
    box = oc.Box(np.full(6, 0.3), 0.5)
    errors = {}
    for draw in (sample_uniform, sample_evenly):
        means = [np.prod(np.cos(draw(box, 4000, seed)), axis=1).mean() for seed in range(20)]
        errors[draw.__name__] = np.std(means)
        assert np.abs(draw(box, 100, 0) - box.centre).max() <= 0.5
    assert errors["sample_evenly"] < 0.2 * errors["sample_uniform"]
    np.testing.assert_array_equal(sample_evenly(box, 10, 3), sample_evenly(box, 10, 3))


def test_torus_is_whole_turns() -> None:
    points = sample_uniform(oc.Torus(2), 5000, seed=0)
    assert points.min() < -3.1
    assert points.max() > 3.1
    assert oc.Torus(2).contains([100.0, -100.0])


def test_contains_is_true_inside_and_false_outside_a_box() -> None:
    box = oc.Box([0.0, 0.0], 1.0)
    np.testing.assert_array_equal(box.contains([[0.9, -0.9], [1.1, 0.0]]), [True, False])
    assert box.contains([1.0, 1.0])
    np.testing.assert_array_equal(box.contains([[0.9, -0.9], [1.1, 0.0]]), [True, False])
    assert box.contains([1.0, 1.0])
    assert not box.contains([1.0, 1.1])
    assert oc.Torus(2).contains([100.0, -100.0])
    with pytest.raises(ShapeError, match=r"q has shape \(3,\)"):
        box.contains([0.0, 0.0, 0.0])


def test_box_from_limits_reaches_from_one_to_the_other() -> None:
    box = oc.Box.from_limits([-1.0, 0.5], [2.0, 0.7])
    np.testing.assert_allclose(box.centre, [0.5, 0.6])
    np.testing.assert_allclose(box.half_width, [1.5, 0.1])
    assert box.contains([[-1.0, 0.5], [2.0, 0.7]]).all()
    assert not box.contains([[-1.001, 0.6], [0.0, 0.701]]).any()
    with pytest.raises(InvalidValueError, match=r"lower\[1\] is 0.7, expected a number below upper\[1\] = 0.5"):
        oc.Box.from_limits([0.0, 0.7], [1.0, 0.5])
    with pytest.raises(ShapeError, match="upper"):
        oc.Box.from_limits([0.0, 0.0], [1.0])
    with pytest.raises(InvalidValueError, match=r"upper\[0\] is inf"):
        oc.Box.from_limits([0.0], [np.inf])


def test_default_box_takes_a_half_width_per_joint() -> None:
    widths = np.array([0.4, 0.4, 0.4, 0.1, 0.4, 0.4, 0.2])
    np.testing.assert_array_equal(default_box(panda(), half_width=widths).half_width, widths)
    with pytest.raises(ShapeError, match="half_width"):
        default_box(panda(), half_width=[0.4, 0.1])


def test_default_box_respects_joint_limits() -> None:
    robot = panda()
    box = default_box(robot)
    require_within_limits(robot, box)
    np.testing.assert_allclose(box.centre[3], (-3.0718 - 0.0698) / 2, atol=1e-12)
    np.testing.assert_allclose(box.half_width[0], np.pi / 4)
    near = default_box(robot, centre=[0, 0, 0, -0.2, 0, 1, 0])
    np.testing.assert_allclose(near.half_width[3], 0.2 - 0.0698)  # shortened at the limit


def test_default_box_of_prismatic_joint_is_in_metres() -> None:
    robot = oc.Robot.from_urdf(robot_data("tiago_description/robots/tiago.urdf"), "arm_tool_link")
    np.testing.assert_allclose(default_box(robot).half_width[0], 0.35 / 2)


def test_default_box_with_a_limit_on_one_side_lies_inside_it() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    limits = {"lower": np.array([-np.inf, 0.5, -np.inf]), "upper": np.array([-1.0, np.inf, np.inf])}
    robot = oc.Robot(dataclasses.replace(robot.tree, **limits))
    np.testing.assert_allclose(default_box(robot).centre, [-1 - np.pi / 4, 0.5 + np.pi / 4, 0])
    require_within_limits(robot, default_box(robot))


def test_domain_outside_limits_names_the_joint() -> None:
    robot = panda()
    task = oc.Task.position(robot)
    with pytest.raises(DomainError, match="panda_joint4.*inside its limits"):
        oc.Problem(robot, task, domain=oc.Box(np.zeros(7), 0.5))
    with pytest.raises(DomainError, match="panda_joint1"):
        oc.Problem(robot, task, domain=oc.Torus(7))
    with pytest.raises(DomainError, match="panda_joint4"):
        default_box(robot, centre=np.zeros(7))


def test_torus_with_a_prismatic_joint_is_refused() -> None:
    robot = oc.Robot.from_urdf(robot_data("tiago_description/robots/tiago.urdf"), "arm_tool_link")
    with pytest.raises(DomainError, match="torso_lift_joint.*prismatic"):
        require_within_limits(robot, oc.Torus(robot.n))


@pytest.mark.parametrize("half_width", [0.0, -1.0, [1.0, 0.0], 1e-9, [1.0, 1e-12], 1e-320])
def test_half_width_must_be_positive(half_width: object) -> None:
    with pytest.raises(InvalidValueError, match="half_width"):
        oc.Box([0.0, 0.0], half_width)


def test_bad_boxes_are_refused() -> None:
    with pytest.raises(ShapeError):
        oc.Box([0.0, 0.0], [1.0, 1.0, 1.0])
    with pytest.raises(InvalidValueError, match=r"centre\[1\] is nan"):
        oc.Box([0.0, np.nan], 1.0)
    with pytest.raises(InvalidValueError, match="empty"):
        oc.Box([], 1.0)
    with pytest.raises(InvalidValueError, match="half_width"):
        oc.Box([0.0], 1e300)
    with pytest.raises(InvalidValueError, match="array of numbers"):
        oc.Box([0.0], "wide")
    with pytest.raises(ShapeError):
        oc.Box([0.0, 0.0], np.ones((2, 2)))
    with pytest.raises(InvalidValueError, match="seed is -1"):
        sample_uniform(oc.Torus(1), 1, -1)
    with pytest.raises(InvalidValueError):
        oc.Torus(0)
    with pytest.raises(InvalidValueError, match="samples"):
        sample_uniform(oc.Torus(1), 0, 0)
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    with pytest.raises(ShapeError, match="domain"):
        require_within_limits(robot, oc.Torus(3))


def test_boundaries_of_small_boxes_far_out_belong_to_them() -> None:
    rng = np.random.default_rng(0)
    for half_width in (1e-6, 1e-4, 1.0):
        for centre in rng.uniform(-3, 3, (200, 2)):
            box = Box(centre, half_width)
            assert box.contains(centre - half_width)
            assert box.contains(centre + half_width)
            assert not box.contains(centre + half_width * (1 + 1e-8))
