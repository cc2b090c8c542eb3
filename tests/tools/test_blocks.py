"""Large sets of joint positions: blocks and threads change nothing but speed, and memory stays bounded."""

import tracemalloc

import casadi as ca
import numpy as np
import pytest
from public_objects import CHARTS

import orthocas as oc
from orthocas import problems
from orthocas.bases import JointSpace
from orthocas.charts.chart import GrownChart
from orthocas.charts.coordinates import Coordinates
from orthocas.tasks.samples import sample_uniform
from orthocas.tools import columns
from orthocas.tools.batch import Batched, dense_function, use_threads
from orthocas.tools.checks import Array
from orthocas.tools.columns import BlockedFunction

MANY = 700  # three blocks, the last one not full


def of_arm(parametrisation: oc.Polynomial | oc.MLP) -> Coordinates:
    """Random coordinates of the 7-joint arm, whose last joint is idle."""
    problem = problems.get("iiwa")
    space, rng = JointSpace.of(problem), np.random.default_rng(7)
    family = parametrisation.family(space.restricted_to(list(range(6))), 3)
    return Coordinates(parametrisation, space, (6,), rng.normal(size=family.size), rng.normal(size=3), np.ones(3))


def points_of(n: int, count: int) -> Array:
    return np.random.default_rng(5).uniform(-1, 1, (count, n))


@pytest.mark.parametrize("count", [0, 1, columns.MANY, 64, 65, 129, 256, 257, 5000])
def test_values_are_those_of_numpy(count: int) -> None:
    """Rows of a matrix in their order, into part of a larger array, and nothing beside it."""
    A, q = np.arange(6.0).reshape(2, 3), ca.SX.sym("q", 3)
    function = BlockedFunction(dense_function("f", [q], [ca.DM(A) * ca.repmat(q.T, 2, 1)]))
    points = points_of(3, count)
    whole = np.full((count, 4, 3), 9.0)
    function.into(whole[:, 1:3], points)
    np.testing.assert_allclose(whole[:, 1:3], A * points[:, None, :], rtol=1e-15)
    np.testing.assert_array_equal(whole[:, [0, 3]], 9.0)
    np.testing.assert_array_equal(function(points)[0], whole[:, 1:3])


@pytest.mark.parametrize("name", ["xi", "jacobian"])
@pytest.mark.parametrize("parametrisation", [oc.Polynomial(3), oc.MLP((5, 4))])
def test_threads_change_nothing(parametrisation: oc.Polynomial | oc.MLP, name: str) -> None:
    coordinates, points, found = of_arm(parametrisation), points_of(7, 9000), []
    for count in (1, 2, 5):
        with use_threads(count):
            found.append(getattr(coordinates, name)(points))
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.parametrize("name", [name for name in CHARTS if "circle" not in name and "disk" not in name])
def test_many_rows_are_those_of_the_expression(name: str) -> None:
    """Against the CasADi expression, joint position by joint position, for every family."""
    chart = CHARTS[name]()
    if isinstance(chart, GrownChart):
        return
    points = sample_uniform(chart.problem.domain, MANY, 3)
    for values, function in ((chart.phi(points), "phi"), (chart.jacobian(points), "jacobian")):
        single = Batched(chart.function(function))(points)[0]
        assert values.shape == single.shape
        np.testing.assert_allclose(values, single, rtol=0, atol=1e-13 * np.abs(single).max())
    np.testing.assert_array_equal(chart.xi(points), chart.phi(points)[:, chart.m :])
    np.testing.assert_array_equal(chart.x(points), chart.phi(points)[:, : chart.m])


def test_memory_does_not_grow_with_the_table_of_the_basis() -> None:
    coordinates, points = of_arm(oc.Polynomial(4)), points_of(7, 40_000)
    coordinates.xi(points[:300])
    tracemalloc.start()
    coordinates.xi(points)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    table = 8 * len(points) * coordinates.family.width  # bytes: 67 MB
    assert peak < 0.1 * table


def test_a_gradient_without_a_value_is_named_by_its_joint_position() -> None:
    problem = problems.get("planar_2r")
    polar = oc.Task.custom(problem.robot, "radius", lambda q: ca.sqrt(q[0] ** 2 + q[1] ** 2))
    points = points_of(2, 500)
    points[321] = 0.0
    chart = oc.fit(oc.Problem(problem.robot, polar, domain=oc.Box([1.0, 1.0], 0.5)), oc.Polynomial(1)).chart
    with pytest.raises(oc.errors.SingularTaskError, match=r"q = \[0.0, 0.0\]"):
        chart.jacobian(points)
