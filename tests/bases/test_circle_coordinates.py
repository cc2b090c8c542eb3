"""The parts of examples/circle_coordinates.py: pairs with the symmetries of the arm, and their leak."""

import circle_coordinates
import numpy as np
import pytest
from paper.planar_flow import deviations, planar_problem

import orthocas as oc
from orthocas.tools.expressions import wrap_shortest


@pytest.fixture(scope="module")
def pairs() -> circle_coordinates.SymmetricPairs:
    return circle_coordinates.SymmetricPairs(planar_problem("inertia"), 3)


@pytest.fixture(scope="module")
def theta(pairs: circle_coordinates.SymmetricPairs) -> np.ndarray:
    return np.random.default_rng(2).normal(size=pairs.count)


@pytest.fixture(scope="module")
def chart(pairs: circle_coordinates.SymmetricPairs, theta: np.ndarray) -> oc.Chart:
    return pairs.chart(theta)


POINTS = np.random.default_rng(1).uniform(-np.pi, np.pi, (50, 2))
TURN = np.full(1, 2 * np.pi)


def test_angle_is_even_and_changes_its_sign_half_a_turn_away(chart: oc.Chart) -> None:
    xi = chart.xi(POINTS)
    assert np.abs(wrap_shortest(chart.xi(-POINTS) - xi, TURN)).max() < 1e-9
    assert np.abs(wrap_shortest(chart.xi(POINTS + np.array([np.pi, 0.0])) + xi, TURN)).max() < 1e-9


def test_leak_is_that_of_the_chart_and_its_gradient_is_right(
    pairs: circle_coordinates.SymmetricPairs, theta: np.ndarray, chart: oc.Chart
) -> None:
    leak = circle_coordinates.Leak(pairs, POINTS)
    angles = deviations(chart.problem, POINTS, chart.jacobian(POINTS)[:, 1])
    assert leak.value(theta) == pytest.approx((np.sin(np.radians(angles)) ** 2).mean() / 2, rel=1e-9)
    value, gradient, H = leak.normal_equations(theta)
    way = np.random.default_rng(3).normal(size=len(theta))
    slope = (leak.value(theta + 1e-6 * way) - leak.value(theta - 1e-6 * way)) / 2e-6
    assert (value, gradient @ way) == pytest.approx((leak.value(theta), slope), rel=1e-6)
    assert np.linalg.eigvalsh(H).min() > -1e-12


def test_higher_degrees_start_where_lower_ones_end(
    pairs: circle_coordinates.SymmetricPairs, theta: np.ndarray, chart: oc.Chart
) -> None:
    finer = circle_coordinates.SymmetricPairs(pairs.problem, 5)
    assert finer.chart(finer.embedded(theta, pairs)).xi(POINTS) == pytest.approx(chart.xi(POINTS))


@pytest.mark.slow
def test_grown_start_winds_twice_around_the_maximum(pairs: circle_coordinates.SymmetricPairs) -> None:
    """The angle turns by 4 pi on a circle around the maximum, where the pair has a double zero."""
    problem = planar_problem("euclidean")
    own = circle_coordinates.SymmetricPairs(problem, 4)
    start = own.chart(own.started(circle_coordinates.half_of_torus(problem, 24, 0.0), 1.0))
    turn = np.linspace(0, 2 * np.pi, 400)
    around = 1.2 * np.column_stack([np.cos(turn), np.sin(turn)])
    assert abs(np.ptp(np.unwrap(start.xi(around)[:, 0]))) > 3.5 * np.pi
