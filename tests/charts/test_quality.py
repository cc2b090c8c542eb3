"""Figures of merit against closed forms and a second computation."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

import orthocas as oc
from orthocas.bases import JointSpace
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.quality import AngleStatistics
from orthocas.errors import InvalidValueError, MemoryNeedError, SingularTaskError
from orthocas.fitting.fit import Fit
from orthocas.tasks.samples import sample_uniform


def chart_with_normals(normals: list[list[float]], metric: object = "euclidean") -> Chart:
    """Task q1 of a three-joint arm, with linear coordinates of given normals."""
    robot = oc.Robot.planar([1.0] * 3, [1.0] * 3)
    problem = oc.Problem(robot, oc.Task.custom(robot, "q1", lambda q: q[0]), metric)
    coordinates = Coordinates(oc.Linear(), JointSpace.of(problem), (), np.ravel(normals), np.zeros(2), np.ones(2))
    return Chart(problem, coordinates)


@pytest.mark.slow
def test_perfect_coordinates_have_right_angles_and_conditioning_one() -> None:
    report = oc.evaluate(chart_with_normals([[0, 1, 0], [0, 0, 2]]), 100)
    assert report.task_angle.mean == report.mutual_angle.mean == 90
    assert report.task_angle.std == report.task_angle.max == 0
    assert report.conditioning.min == pytest.approx(1, abs=1e-7)  # through a Gram matrix: half the digits
    assert not report.degenerate


def test_known_angles_are_reported() -> None:
    lean = np.radians(10)
    report = oc.evaluate(chart_with_normals([[np.sin(lean), np.cos(lean), 0], [0, 1, 1]]), 100)
    np.testing.assert_allclose(report.task_angle.mean, (80 + 90) / 2)
    np.testing.assert_allclose(report.task_angle.std, 5)
    np.testing.assert_allclose(report.task_angle.max, 10)
    np.testing.assert_allclose(report.mutual_angle.mean, np.degrees(np.arccos(np.cos(lean) / np.sqrt(2))))
    assert report.task_angle.histogram.sum() == 200


@pytest.mark.slow
def test_parallel_coordinates_are_reported_as_degenerate() -> None:
    report = oc.evaluate(chart_with_normals([[0, 1, 0], [0, 1, 0.01]]), 100)
    assert report.conditioning.mean < 0.01
    assert report.degenerate
    assert report.as_dict()["degenerate"] is True


@pytest.mark.slow
def test_conditioning_ignores_how_the_task_is_scaled_but_not_the_metric() -> None:
    normals = [[0, 1, 0], [0.2, 0.3, 1]]
    plain = oc.evaluate(chart_with_normals(normals), 100)
    robot = plain_robot = oc.Robot.planar([1.0] * 3, [1.0] * 3)
    task = oc.Task.custom(plain_robot, "1000 q1", lambda q: 1000 * q[0])
    problem = oc.Problem(robot, task)
    coordinates = Coordinates(oc.Linear(), JointSpace.of(problem), (), np.ravel(normals), np.zeros(2), np.ones(2))
    assert oc.evaluate(Chart(problem, coordinates), 100).conditioning == plain.conditioning
    other = oc.evaluate(chart_with_normals(normals, np.diag([1.0, 4.0, 9.0])), 100)
    assert abs(other.conditioning.mean - plain.conditioning.mean) > 0.01


@pytest.mark.slow
def test_conditioning_matches_a_direct_computation_in_whitened_coordinates(planar_fit: Fit) -> None:
    chart = planar_fit.chart
    report = oc.evaluate(chart, samples=200, seed=5)
    smallest = []
    for q in sample_uniform(chart.problem.domain, 200, 5):
        L = np.linalg.cholesky(chart.problem.robot.mass_matrix(q))
        white = scipy.linalg.solve_triangular(L, chart.jacobian(q).T, lower=True).T  # covectors where A is the identity
        task = scipy.linalg.orth(white[:1].T).T
        units = white[1:] / np.linalg.norm(white[1:], axis=1, keepdims=True)
        smallest.append(np.linalg.svd(np.vstack([task, units]), compute_uv=False)[-1])
    np.testing.assert_allclose(report.conditioning.mean, np.mean(smallest), atol=1e-9)
    given = oc.evaluate(chart, points=sample_uniform(chart.problem.domain, 200, 5))  # no search beside these points
    np.testing.assert_allclose(given.conditioning.min, np.min(smallest), atol=1e-7)
    worst = sample_uniform(chart.problem.domain, 200, 5)[int(np.argmin(smallest))]
    np.testing.assert_allclose(given.worst_point, worst)


@pytest.mark.slow
def test_search_finds_less_than_samples_and_says_where(planar_fit: Fit) -> None:
    chart = planar_fit.chart
    report = oc.evaluate(chart, samples=200, seed=5)
    assert report.worst is not None
    assert report.conditioning.min == report.worst.least < oc.evaluate(chart, samples=200_000, seed=6).conditioning.p01
    np.testing.assert_array_equal(report.worst_point, report.worst.points[0])
    assert oc.evaluate(chart, points=[report.worst_point]).conditioning.min == pytest.approx(report.worst.least)


def test_folded_samples_are_counted() -> None:
    """xi = q2^2 - 1.2 q2 folds at q2 = 0.6: on |q2| <= pi/4 that is the part above, 11.8 % of the box."""
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    problem = oc.Problem(robot, oc.Task.custom(robot, "q1", lambda q: q[0]))
    family = oc.Polynomial(2).family(JointSpace.of(problem), 1)
    half = np.pi / 4
    C = {(0, 2): half**2 * 2 / 3 / np.sqrt(5), (0, 1): -1.2 * half / np.sqrt(3)}  # Legendre coefficients
    theta = np.array([C.get(term, 0.0) for term in family.terms])
    chart = Chart(problem, Coordinates(oc.Polynomial(2), JointSpace.of(problem), (), theta, np.zeros(1), np.ones(1)))
    np.testing.assert_allclose(chart.jacobian([0.0, 0.3])[1], [0, 2 * 0.3 - 1.2], atol=1e-12)
    report = oc.evaluate(chart, 20_000)
    assert report.folded_samples / report.samples == pytest.approx((half - 0.6) / (2 * half), abs=0.01)


def test_nothing_left_to_evaluate_is_an_error() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    problem = oc.Problem(robot, oc.Task.custom(robot, "flat", lambda q: ca.fmax(q[0], 0) ** 2))
    chart = oc.fit(problem, oc.Polynomial(1)).chart
    flat = Chart(oc.Problem(robot, problem.task, domain=oc.Box([-0.5, 0], 0.4)), chart.coordinates)
    with pytest.raises(SingularTaskError, match="all 10 samples"):
        oc.evaluate(flat, 10)


@pytest.mark.slow
def test_held_out_samples_depend_on_the_seed(planar_fit: Fit) -> None:
    first, again, other = (oc.evaluate(planar_fit.chart, 500, seed) for seed in (1, 1, 2))
    assert first.as_dict() == again.as_dict()
    assert first.task_angle.std != other.task_angle.std


def test_report_as_plain_data_has_the_promised_keys(planar_fit: Fit) -> None:
    data = oc.evaluate(planar_fit.chart, 100).as_dict()
    assert set(data["task_angle_deg"]) == set(data["mutual_angle_deg"]) == {"mean", "std", "max"}
    assert set(data["conditioning"]) == {"min", "p01", "mean"}
    assert {"n", "m", "r", "samples", "seed", "metric"} <= set(data)


def test_no_pairs_give_nan_and_json_null(planar_xy: oc.Problem) -> None:
    report = oc.evaluate(oc.fit(planar_xy, oc.Linear()).chart, 100)
    assert np.isnan(report.mutual_angle.std)
    assert report.as_dict()["mutual_angle_deg"] == {"mean": None, "std": None, "max": None}


def test_histogram_counts_degrees() -> None:
    counts = AngleStatistics.of_cosines(np.cos(np.radians([60.02, 59.98, 120.03]))).histogram
    assert counts[600] == 2
    assert counts[1200] == 1


def test_samples_must_be_positive(planar_fit: Fit) -> None:
    with pytest.raises(InvalidValueError, match="samples is 0"):
        oc.evaluate(planar_fit.chart, samples=0)
    with pytest.raises(MemoryNeedError, match="GiB"):
        oc.evaluate(planar_fit.chart, samples=10**14)


def test_length_ratio_is_that_of_the_quantiles(planar_x: oc.Problem) -> None:
    """Xi = q1 + 2 q1^2 on |q1 - 0.6| <= pi/8: its gradient 1 + 4 q1 is uniform between its ends."""
    quadratic = oc.Given.from_function("quadratic", 3, lambda q: ca.vertcat(q[0] + 2 * q[0] ** 2, q[1] - q[2]))
    report = oc.evaluate(oc.fit(planar_x, quadratic).chart, 20_000)
    ends = 1 + 4 * (0.6 + np.pi / 8 * np.array([-0.98, 0.98]))
    assert report.length_ratio == pytest.approx(ends[1] / ends[0], rel=0.01)
