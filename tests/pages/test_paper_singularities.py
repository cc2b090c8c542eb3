"""Singular points of a task, and how grown coordinates jump there."""

import casadi as ca
import numpy as np
import pytest
from charts import planar_2r
from paper.singularities import jumps, singular_points

import orthocas as oc
from orthocas import problems
from orthocas.errors import GrowError


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_planar_2r_has_the_four_singular_points_of_the_paper(metric: str) -> None:
    found = singular_points(planar_2r(metric))
    wanted = {(0.0, 0.0): ("maximum", 2.0), (0.0, 1.0): ("saddle", 0.0), (1.0, 0.0): ("minimum", -2.0)}
    wanted[1.0, 1.0] = ("saddle", 0.0)
    assert {tuple(np.abs(np.round(s.point / np.pi, 8))): (s.kind, round(s.task_value, 9)) for s in found} == wanted


def test_units_of_the_task_do_not_matter() -> None:
    robot = problems.get("planar_2r").robot
    task = oc.Task.custom(robot, "x", lambda q: 1e6 * (ca.cos(q[0]) + ca.cos(q[0] + q[1])))
    assert len(singular_points(oc.Problem(robot, task, "euclidean", oc.Torus(2)))) == 4


def test_planar_3r_has_eight() -> None:
    arm = problems.get("planar_3r_x").robot
    found = singular_points(oc.Problem(arm, oc.Task.position(arm, "x"), "euclidean", oc.Torus(3)))
    assert sorted(s.kind for s in found) == ["maximum", "minimum"] + ["saddle"] * 6
    assert sorted(round(s.task_value) for s in found) == [-3, -1, -1, -1, 1, 1, 1, 3]


def test_none_in_a_regular_box() -> None:
    assert singular_points(problems.get("planar_3r_x")) == ()


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_coordinates_jump_by_half_a_turn_at_the_saddles(metric: str) -> None:
    """By symmetry about the origin, the two sides of a saddle reach opposite points of the circle x = 1."""
    chart = oc.grow(planar_2r(metric), 1.0, origin=[np.pi / 3, 0])
    found = {jump.singular_point.kind: jump for jump in jumps(chart)}
    np.testing.assert_allclose(found["saddle"].size, np.pi, atol=1e-6)
    assert found["maximum"].size == pytest.approx(2 * np.pi)
    low, high = found["maximum"].values
    assert high - low > 2.0  # values from nearly everywhere meet


def test_other_charts_and_tasks_are_refused() -> None:
    with pytest.raises(GrowError, match="m = 1"):
        singular_points(problems.get("planar_3r_xy"))
    with pytest.raises(GrowError, match="circle"):
        jumps(oc.grow(problems.get("planar_3r_x"), leaf="linear"))
