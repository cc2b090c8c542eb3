"""Charts of base leaves: arc length on closed curves, harmonic maps of disks, linear coordinates."""

import casadi as ca
import numpy as np
import pytest
from charts import planar_2r
from scipy.integrate import quad
from scipy.optimize import brentq

import orthocas as oc
from orthocas import problems
from orthocas.exact.flow import TaskFlow
from orthocas.exact.leaves import build_disk_leaf, build_linear_leaf, trace_circle_leaf

ARM = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
START = np.array([np.pi / 3, 0.0])


def test_length_of_the_circle_agrees_with_quadrature() -> None:
    """x = 1 of planar 2R: q1 + q2/2 = +-arccos(1 / (2 cos(q2/2))), integrated over q2."""
    leaf = trace_circle_leaf(problems.get("planar_2r"), np.ones(1), START)

    def speed(t: float) -> float:  # q2/2 = t, q2 = top sin(u) takes the ends' infinite slope away
        u = t
        half = np.pi / 3 * np.sin(u)
        dhalf = np.pi / 3 * np.cos(u)
        c = 1 / (2 * np.cos(half))
        dangle = -1 / np.sqrt(1 - c**2) * np.sin(half) / (2 * np.cos(half) ** 2) * dhalf
        return float(np.hypot(dangle - dhalf, 2 * dhalf))

    half_length = quad(speed, -np.pi / 2 + 1e-9, np.pi / 2 - 1e-9, limit=200)[0]
    # the curve has two branches, mirror images of each other
    np.testing.assert_allclose(leaf.length[0], 2 * half_length, rtol=1e-6)


def test_circle_values_and_points_are_inverse() -> None:
    leaf = trace_circle_leaf(problems.get("planar_2r"), np.ones(1), START)
    xi = np.linspace(-np.pi + 1e-3, np.pi, 300)[:, None]
    points = leaf.points(xi)
    found = leaf.values(points + 2 * np.pi * np.array([1, -2]))  # whole turns do not matter
    assert found.inside.all()
    np.testing.assert_allclose(found.xi, xi, atol=1e-9)
    np.testing.assert_allclose(leaf.problem.task.batched(points)[0], 1.0, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(found.gradients[:, 0], axis=1), 2 * np.pi / leaf.length[0], rtol=1e-9)
    assert np.isnan(leaf.points(np.array([[3.2]]))).all()
    assert not leaf.values(np.array([[0.0, 0.0]])).inside[0]  # not on the leaf


def test_the_cut_is_opposite_to_the_start() -> None:
    leaf = trace_circle_leaf(problems.get("planar_2r"), np.ones(1), START)
    np.testing.assert_allclose(leaf.cut, -START, atol=1e-7)  # x = 1 is symmetric about the origin
    beside = leaf.values(np.array([leaf.cut + 1e-7 * np.array([-0.5, 1]), leaf.cut - 1e-7 * np.array([-0.5, 1])])).xi
    assert np.ptp(beside) > 6.28


def test_a_leaf_that_winds_around_the_torus_closes() -> None:
    """h = q1 - sin(q2)/2 has leaves that go once around in q2."""
    arm = oc.Robot.planar(lengths=[1.0, 1.0], masses=[1.0, 1.0])
    task = oc.Task.custom(arm, "winding", lambda q: ca.sin(q[0] - ca.sin(q[1]) / 2))
    problem = oc.Problem(arm, task, "euclidean", oc.Torus(2))
    leaf = trace_circle_leaf(problem, np.zeros(1), np.zeros(2))
    length = quad(lambda t: np.hypot(np.cos(t) / 2, 1), 0, 2 * np.pi)[0]
    np.testing.assert_allclose(leaf.length[0], length, rtol=1e-9)
    np.testing.assert_allclose(np.abs(leaf.curve[-1] - leaf.curve[0]), [0, 2 * np.pi], atol=1e-8)
    xi = np.linspace(-3, 3, 50)[:, None]
    np.testing.assert_allclose(leaf.values(leaf.points(xi)).xi, xi, atol=1e-9)


def test_a_leaf_of_a_spatial_curve_closes() -> None:
    """r = 1 with n = 3: a self-motion manifold of the task (x, y)."""
    problem = oc.Problem(ARM, oc.Task.position(ARM, "xy"), "euclidean", oc.Torus(3))
    start = np.array([0.3, 0.5, brentq(lambda t: np.hypot(*_tip(0.3, 0.5, t)) - 2.0, 0, 3)])
    level = problem.task.batched(start[None])[0][0]
    leaf = trace_circle_leaf(problem, level, start)
    np.testing.assert_allclose(problem.task.batched(leaf.curve)[0], np.tile(level, (len(leaf.curve), 1)), atol=1e-8)
    spacing = np.linalg.norm(np.diff(leaf.curve, axis=0), axis=1)
    assert np.ptp(spacing) / spacing.mean() < 1e-4


def _tip(*q: float) -> np.ndarray:
    return np.asarray(ARM.tip_position(np.array(q)))[:2]


@pytest.mark.slow
def test_disk_values_and_points_are_inverse() -> None:
    cell = oc.Box([np.pi / 2, 0, 0], [np.pi / 2, np.pi, np.pi])
    problem = oc.Problem(ARM, oc.Task.position(ARM, "x"), "euclidean", cell)
    leaf = build_disk_leaf(problem, np.zeros(1), cell, 40)
    rng = np.random.default_rng(0)
    xi = rng.normal(size=(500, 2))
    xi *= (0.98 * np.sqrt(rng.uniform(size=500)) / np.linalg.norm(xi, axis=1))[:, None]
    points = leaf.points(xi)
    np.testing.assert_allclose(problem.task.batched(points)[0], 0.0, atol=1e-11)
    error = np.abs(leaf.values(points).xi - xi).max(axis=1)
    assert np.mean(error < 1e-9) > 0.98  # a point above an edge may belong to the neighbour: third order in the cell
    assert error.max() < 0.01
    assert np.isnan(leaf.points(np.array([[1.1, 0.0]]))).all()


def test_disk_gradients_agree_with_differences_within_a_triangle() -> None:
    cell = oc.Box([np.pi / 2, 0, 0], [np.pi / 2, np.pi, np.pi])
    leaf = build_disk_leaf(oc.Problem(ARM, oc.Task.position(ARM, "x"), "euclidean", cell), np.zeros(1), cell, 20)
    centres = leaf.vertices[leaf.faces].mean(axis=1)
    values = leaf.values(centres)
    corners, images = leaf.vertices[leaf.faces], leaf.disk[leaf.faces]
    for k in range(3):
        along = corners[:, k] - centres
        change = np.einsum("frn,fn->fr", values.gradients, along)
        np.testing.assert_allclose(values.xi + change, images[:, k], atol=1e-9)


@pytest.mark.slow
def test_linear_leaf_points_solve_both_conditions() -> None:
    arm = problems.get("iiwa")
    problem = oc.Problem(arm.robot, oc.Task.position(arm.robot, "z"), "inertia", oc.Box(arm.domain.centre, 0.3))
    leaf = build_linear_leaf(problem, problem.domain.centre)
    nearby = problem.domain.centre + np.random.default_rng(1).uniform(-0.2, 0.2, (20, 7))
    wanted = TaskFlow(problem).pull(nearby, leaf.level, 1e-13).points
    xi = leaf.values(wanted).xi
    points = leaf.points(xi)
    np.testing.assert_allclose(points, wanted, atol=1e-6)
    np.testing.assert_allclose(leaf.values(points).xi, xi, atol=1e-10)
    np.testing.assert_allclose(problem.task.batched(points)[0], leaf.level[None].repeat(20, 0), atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(leaf.normals, axis=0), 1.0)


def test_where_a_linear_leaf_has_no_point_there_is_nan() -> None:
    """At q = (0.5, -0.5) the gradient of x has no second part, so +-xi = q2 + 0.5; and x <= 2 |cos(q2 / 2)|."""
    leaf = build_linear_leaf(planar_2r("euclidean"), np.array([0.5, -0.5]))
    xi = np.array([[np.pi], [0.1], [-np.pi]])
    assert 2 * np.cos((np.pi - 0.5) / 2) < leaf.level[0]
    assert np.isnan(leaf.points(xi)).all(axis=1).tolist() == [True, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("cells", [20, 60])
def test_disk_topology_is_that_of_a_disk(cells: int) -> None:
    cell = oc.Box([np.pi / 2, 0, 0], [np.pi / 2, np.pi, np.pi])
    leaf = build_disk_leaf(oc.Problem(ARM, oc.Task.position(ARM, "x"), "euclidean", cell), np.zeros(1), cell, cells)
    mesh = leaf.mesh
    assert (mesh.components, mesh.boundary_loops, mesh.euler_characteristic) == (1, 1, 1)
    assert np.linalg.norm(leaf.disk, axis=1).max() <= 1 + 1e-12
