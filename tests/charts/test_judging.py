"""Leaks against a second computation, figures without idle joints, and the quality of a chart at points."""

import json

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from charts import with_metric
from programs import Run

import orthocas as oc
from orthocas.charts.point_quality import judge_by_columns, judge_by_lapack, measure_held_speeds
from orthocas.errors import InvalidValueError, ShapeError, SingularTaskError
from orthocas.fitting.fit import Fit
from orthocas.tasks.samples import evaluate_samples, sample_uniform


def leaks_by_hand(chart: oc.Chart, q: np.ndarray) -> np.ndarray:
    """Angle of each coordinate gradient to the task's null space, where the Cholesky factor makes A the identity."""
    n, m = chart.n, chart.m
    A = np.eye(n) if chart.problem.metric.is_identity else np.asarray(chart.problem.metric.function(q))
    white = scipy.linalg.solve_triangular(np.linalg.cholesky(A), chart.jacobian(q).T, lower=True)
    task, coordinates = white[:, :m], white[:, m:]
    within = task @ np.linalg.lstsq(task, coordinates, rcond=None)[0]
    return np.degrees(np.arcsin(np.linalg.norm(within, axis=0) / np.linalg.norm(coordinates, axis=0)))


@pytest.fixture(scope="module")
def charts(iiwa_fit: Fit, planar_fit: Fit, planar_xy: oc.Problem) -> dict[str, oc.Chart]:
    in_metric = oc.fit(with_metric(iiwa_fit.chart.problem, "inertia"), oc.Polynomial(2), samples=500).chart
    plane = oc.fit(planar_xy, oc.Polynomial(3), samples=500).chart
    return {"iiwa": iiwa_fit.chart, "iiwa, A = M": in_metric, "planar_x": planar_fit.chart, "planar_xy": plane}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["iiwa", "iiwa, A = M", "planar_x", "planar_xy"])
def test_leaks_are_those_of_a_least_squares_projection(charts: dict[str, oc.Chart], name: str) -> None:
    chart = charts[name]
    points = sample_uniform(chart.problem.domain, 60, 5)
    want = np.array([leaks_by_hand(chart, q) for q in points])
    assert want.max() > 1
    np.testing.assert_allclose(chart.quality(points).leak_deg, want, atol=1e-5)
    leak = oc.evaluate(chart, points=points).leak
    np.testing.assert_allclose(leak.mean, want.mean(), atol=1e-5)
    np.testing.assert_allclose(leak.rms, np.sqrt((want**2).mean()), atol=1e-5)
    np.testing.assert_allclose(leak.rms_of_each, np.sqrt((want**2).mean(axis=0)), atol=1e-5)
    np.testing.assert_allclose(leak.max, want.max(), atol=1e-5)
    assert leak.histogram.sum() == want.size
    assert leak.histogram[round(10 * want.max())] >= 1


def held_speed_by_hand(chart: oc.Chart, q: np.ndarray, u: np.ndarray) -> float:
    """|dq|_A of the motion with xi held, over the least |dq|_A, by the optimality conditions of the latter."""
    n, m = chart.n, chart.m
    A = np.eye(n) if chart.problem.metric.is_identity else np.asarray(chart.problem.metric.function(q))
    J = chart.jacobian(q)
    conditions = np.block([[A, J[:m].T], [J[:m], np.zeros((m, m))]])
    least = np.linalg.solve(conditions, np.concatenate([np.zeros(n), u]))[:n]
    held = np.linalg.solve(J, np.concatenate([u, np.zeros(n - m)]))
    if chart.r == 1:  # the formula for one coordinate
        z = scipy.linalg.null_space(J[:m])[:, 0]
        leaning = (J[m] @ least) ** 2 / ((J[m] @ z) ** 2 / (z @ A @ z)) / (least @ A @ least)
        np.testing.assert_allclose(held @ A @ held / (least @ A @ least), 1 + leaning, rtol=1e-9)
    return float(np.sqrt(held @ A @ held / (least @ A @ least)))


def test_speed_with_xi_held_is_that_of_the_optimality_conditions(charts: dict[str, oc.Chart]) -> None:
    """For m = 1 it is the same for all velocities of the task."""
    chart = charts["planar_x"]
    assert (chart.m, chart.r) == (1, 2)
    points = sample_uniform(chart.problem.domain, 200, 5)
    want = np.array([held_speed_by_hand(chart, q, np.array([-0.3])) for q in points])
    assert want.max() > 1.001
    found = measure_held_speeds(chart.problem, points, chart.coordinates.jacobian(points), 0)
    np.testing.assert_allclose(found, want, rtol=1e-9)
    assert oc.evaluate(chart, points=points).held_speed == pytest.approx(np.quantile(want, 0.9), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planar_xy", "iiwa, A = M"])
def test_speed_with_xi_held_is_a_quantile_over_velocities_of_the_task(charts: dict[str, oc.Chart], name: str) -> None:
    """For r = 1 no velocity takes more than 1 / cos(leak), and some take nearly that."""
    chart, rng = charts[name], np.random.default_rng(3)
    points = sample_uniform(chart.problem.domain, 3000, 5)
    velocities = rng.normal(size=(len(points), chart.m))
    want = np.array([held_speed_by_hand(chart, q, u) for q, u in zip(points, velocities, strict=True)])
    report = oc.evaluate(chart, points=points)
    assert report.held_speed - 1 == pytest.approx(np.quantile(want, 0.9) - 1, rel=0.1)  # sampling: 3 to 4 %
    assert report.as_dict()["held_speed"] == report.held_speed
    assert f"at most {report.held_speed:.3g} times as fast as with least norm" in report.facts()["xi held"]
    if chart.r == 1:
        q = points[np.argmax(chart.quality(points).leak_deg[:, 0])]
        many = measure_held_speeds(chart.problem, np.tile(q, (500, 1)), np.tile(chart.jacobian(q)[2:], (500, 1, 1)), 0)
        most = 1 / np.cos(np.radians(chart.quality(q).leak_deg[0]))
        assert most * (1 - 1e-3) < many.max() < most * (1 + 1e-9)


def test_nothing_holds_coordinates_that_are_functions_of_the_task(planar_xy: oc.Problem) -> None:
    """Exactly singular Jacobians give inf, no error."""
    task = planar_xy.task.evaluate_jacobian(points := sample_uniform(planar_xy.domain, 4, 0))
    regular = np.array([0.0, 0.0, 1.0])
    J = np.stack([task[0, :1], task[1, :1], regular[None], regular[None]])
    speeds = measure_held_speeds(planar_xy, points, J, 0)
    assert (speeds[:2] > 1e9).all()
    assert np.isfinite(speeds[2:]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["iiwa", "iiwa, A = M", "planar_x", "planar_xy"])
def test_formulas_of_one_sample_agree_with_lapack(charts: dict[str, oc.Chart], name: str) -> None:
    chart = charts[name]
    points = sample_uniform(chart.problem.domain, 300, 5)
    samples, J = evaluate_samples(chart.problem, points), chart.coordinates.jacobian(points)
    found, wanted = judge_by_columns(samples, J), judge_by_lapack(samples, J)
    for key, values in found.items():
        np.testing.assert_allclose(values, wanted[key], rtol=0, atol=1e-11, err_msg=key)


@pytest.mark.slow
def test_leak_does_not_depend_on_task_coordinates_but_the_papers_angle_does(planar_xy: oc.Problem) -> None:
    robot, chart = planar_xy.robot, oc.fit(planar_xy, oc.Polynomial(2), samples=300).chart
    mixed = oc.Task.custom(robot, "mixed", lambda q: ca.DM([[1.0, 0.9], [0.0, 0.1]]) @ robot.tip_position(q)[:2])
    others = [mixed, oc.Task.polar(robot)]
    first, *more = (
        oc.evaluate(oc.Chart(oc.Problem(robot, task, "inertia", planar_xy.domain), chart.coordinates), 500)
        for task in (planar_xy.task, *others)
    )
    for report in more:
        np.testing.assert_allclose(report.leak.rms_of_each, first.leak.rms_of_each, rtol=1e-9)
        assert abs(report.task_angle.std - first.task_angle.std) > 0.1


@pytest.mark.slow
def test_for_one_task_component_and_identity_metric_the_leak_is_the_papers_angle(planar_x: oc.Problem) -> None:
    chart = oc.fit(with_metric(planar_x, "euclidean"), oc.Linear()).chart
    report = oc.evaluate(chart, 500)
    np.testing.assert_allclose(report.leak.max, report.task_angle.max, rtol=1e-9)
    np.testing.assert_allclose(
        report.leak.rms**2, report.task_angle.std**2 + (report.task_angle.mean - 90) ** 2, rtol=1e-9
    )


@pytest.mark.slow
def test_the_papers_angle_hides_the_leak_for_the_inertia_metric(charts: dict[str, oc.Chart]) -> None:
    hidden, shown = (oc.evaluate(charts[name], 5000) for name in ("iiwa, A = M", "planar_x"))
    assert hidden.leak.rms > 3 * hidden.task_angle.std
    assert shown.leak.rms < 3 * shown.task_angle.std  # m = 1


@pytest.mark.slow
def test_idle_joints_are_left_out_of_the_second_set_of_figures(iiwa_fit: Fit, planar_fit: Fit) -> None:
    report = oc.evaluate(iiwa_fit.chart, 2000)
    others = report.without_idle
    assert report.idle_joints == ("A7",)
    assert report.leak.rms_of_each[3] < 1e-5
    np.testing.assert_allclose(others.leak.rms_of_each, report.leak.rms_of_each[:3])
    np.testing.assert_allclose(others.leak.rms**2 * 3, report.leak.rms**2 * 4, rtol=1e-9)  # coordinates
    for all_of, some, pairs, active in (
        (report.task_angle, others.task_angle, 12, 9),
        (report.mutual_angle, others.mutual_angle, 6, 3),
    ):
        whole, part = (a.std**2 + (a.mean - 90) ** 2 for a in (all_of, some))
        np.testing.assert_allclose(part * active, whole * pairs, rtol=1e-9)
    assert "A7" in report.facts()["without idle"]
    assert json.loads(json.dumps(report.as_dict()))["without_idle"]["leak_deg"]["rms"] == others.leak.rms
    planar = oc.evaluate(planar_fit.chart, 200)
    assert planar.idle_joints == ()
    assert planar.without_idle is None


def test_points_take_the_place_of_samples(planar_fit: Fit) -> None:
    chart = planar_fit.chart
    drawn = oc.evaluate(chart, 300, seed=5)
    given = oc.evaluate(chart, points=sample_uniform(chart.problem.domain, 300, 5))
    searched = {"seed", "conditioning", "worst_point", "least_conditioning_searched"}
    want, found = ({k: v for k, v in part.as_dict().items() if k not in searched} for part in (drawn, given))
    assert found == want
    assert given.facts()["samples"] == "300 given"
    assert oc.evaluate(chart, points=chart.problem.domain.centre).samples == 1


def test_points_of_another_shape_or_beside_samples_are_refused(planar_fit: Fit) -> None:
    chart = planar_fit.chart
    with pytest.raises(ShapeError, match="points has shape"):
        oc.evaluate(chart, points=np.zeros((4, 2)))
    with pytest.raises(InvalidValueError, match="points is given with samples or a seed"):
        oc.evaluate(chart, 100, points=np.zeros((4, 3)))
    with pytest.raises(InvalidValueError, match="samples is 0"):
        oc.evaluate(chart, points=np.zeros((0, 3)))
    with pytest.raises(ShapeError, match="q has shape"):
        chart.quality([0.0, 1.0])
    with pytest.raises(InvalidValueError, match="q"):
        chart.quality([0.0, 1.0, np.nan])


def test_quality_of_a_point_is_that_of_the_set(planar_fit: Fit) -> None:
    chart = planar_fit.chart
    path = np.linspace(chart.problem.domain.centre, chart.problem.domain.centre + 0.5, 7)
    along = chart.quality(path)
    assert along.leak_deg.shape == (7, 2)
    assert along.conditioning.shape == along.boundary_distance.shape == (7,)
    for k, q in enumerate(path):
        here = chart.quality(q)
        np.testing.assert_allclose(here.leak_deg, along.leak_deg[k], rtol=1e-12)
        assert here.conditioning.shape == here.boundary_distance.shape == ()
        np.testing.assert_allclose(here.conditioning, along.conditioning[k], rtol=1e-9)
        np.testing.assert_allclose(oc.evaluate(chart, points=q).conditioning.min, here.conditioning, rtol=1e-9)
    np.testing.assert_allclose(along.boundary_distance, np.pi / 8 - np.linspace(0, 0.5, 7), atol=1e-12)
    assert "at most" in along.facts()["leak"]
    assert json.loads(json.dumps(along.as_dict()))["conditioning"] == along.conditioning.tolist()


def test_quality_is_nan_where_the_task_is_flat_and_a_torus_has_no_boundary() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "half flat", lambda q: ca.fmax(q[0], 0) ** 2)
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([0.5, 0.0], 0.4)), oc.Linear()).chart
    found = chart.quality([[0.5, 0.0], [-0.5, 0.0], [0.6, 0.3]])
    assert np.isnan(found.conditioning).tolist() == [False, True, False]
    assert np.isnan(found.leak_deg).any(axis=1).tolist() == [False, True, False]
    np.testing.assert_allclose(found.boundary_distance, [0.4, -0.6, 0.1], atol=1e-12)
    assert found.facts()["left out"].startswith("1,")
    with pytest.raises(SingularTaskError, match="all 1 given points"):
        oc.evaluate(chart, points=[-0.5, 0.0])
    everywhere = oc.Chart(oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Torus(2)), chart.coordinates)
    assert everywhere.quality([0.3, 9.0]).boundary_distance == np.inf


def test_the_search_leaves_out_faces_where_the_task_has_no_finite_gradient() -> None:
    """h = q1 + sqrt(q2), on a box that begins at q2 = 0."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    task = oc.Task.custom(robot, "root", lambda q: q[0] + ca.sqrt(q[1]))
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([0.0, 0.5, 0.0], 0.5)), oc.Linear()).chart
    assert 0 < oc.evaluate(chart, 500).conditioning.min < 1


def test_quality_is_nan_where_gradients_overflow(planar_fit: Fit) -> None:
    for far in (1e120, 1e300):
        quality = planar_fit.chart.quality([0.3, far, 0.5])
        assert np.isnan(quality.conditioning)
        assert np.isnan(quality.leak_deg).all()
        assert quality.boundary_distance < -0.9 * far


@pytest.mark.slow
def test_prediction_of_info_and_report_of_evaluate_agree_on_small_boxes(planar_xy: oc.Problem) -> None:
    """To first order in the size of the box: what is left shrinks with it, and the paper's angle does not agree."""
    ratios = []
    for half_width in (0.3, 0.1, 0.03):
        problem = oc.Problem(planar_xy.robot, planar_xy.task, "inertia", oc.Box(planar_xy.domain.centre, half_width))
        report = oc.evaluate(oc.fit(problem, oc.Polynomial(2)).chart, 5000)
        expected = oc.involutivity(problem).expected_leak_deg
        ratios.append(report.leak.rms / expected)
        assert report.task_angle.std < 0.8 * expected
    assert abs(ratios[0] - 1) > abs(ratios[1] - 1)
    np.testing.assert_allclose(ratios[1:], 1, atol=0.015)


@pytest.mark.slow
def test_commands_print_the_papers_angle_and_the_leak_by_name(run: Run, planar_fit: Fit) -> None:
    planar_fit.chart.save("a.orthocas")
    _, out, _ = run("evaluate", "a.orthocas", "--samples", "500")
    task, leak = (next(line for line in out.splitlines() if line.startswith(name)) for name in ("task angle", "leak"))
    assert "the paper's cosines" in task
    assert "in the metric" in leak
    report = oc.evaluate(planar_fit.chart, 500)
    assert f"rms {report.leak.rms:.2f}" in leak
    data = json.loads(run("evaluate", "a.orthocas", "--samples", "500", "--json")[1])
    assert data["leak_deg"] == report.leak.as_dict()
    assert {"task_angle_deg", "mutual_angle_deg", "metric_mutual_angle_deg", "without_idle", "idle_joints"} <= set(data)
