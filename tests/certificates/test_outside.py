"""Proofs next to singular positions: boxes that are said to lie outside a clear box do, and few are needed."""

import importlib

import numpy as np
import pytest

import orthocas as oc
from orthocas.certificates.outside import OutsideCheck, choose_check
from orthocas.certificates.rows import build_chart_rows
from orthocas.certificates.search import Limits, Search

certifying = importlib.import_module("orthocas.certificates.certify")  # a function has the name of the module
BOUND = 0.1


@pytest.fixture(scope="module")
def pose_chart(iiwa: oc.Problem) -> oc.Chart:
    """Of the tool's pose, around half a turn from its reference, where rows of x would leave everything out."""
    box = oc.Box([0.0, 0.6, 0.2, -0.4, 0.2, 0.5, 0.0], [0.3, 0.3, 0.3, 0.4, 0.3, 0.3, 0.3])
    task = oc.Task.pose(iiwa.robot, iiwa.robot.tip_rotation(box.centre + 3.0 * np.eye(7)[6]))
    problem = oc.Problem(iiwa.robot, task, iiwa.metric, box, least_singular_value=BOUND / 2)
    return oc.fit(problem, oc.Linear()).chart


@pytest.mark.slow
def test_boxes_that_lie_outside_for_a_pose_hold_no_position_that_is_clear_for_the_frame(pose_chart: oc.Chart) -> None:
    domain, bound, rng = pose_chart.problem.domain, BOUND / 2, np.random.default_rng(0)
    middle = domain.centre + domain.half_width * rng.uniform(-1, 1, (2000, 7))
    half = rng.uniform(0.001, 0.05, (2000, 1)) * np.ones(7)
    judge = choose_check(pose_chart, build_chart_rows(pose_chart), 0.0)
    assert isinstance(judge, OutsideCheck)
    outside = judge.check_outside(middle - half, middle + half)[0]
    assert outside.sum() > 50
    points = middle[outside, None] + half[outside, None] * rng.uniform(-1, 1, (int(outside.sum()), 100, 7))
    assert domain.singular_values(points.reshape(-1, 7)).max() <= bound
    clear = domain.singular_values(middle) > bound
    assert not (outside & clear).any()
    assert clear.mean() > 0.3


@pytest.fixture(scope="module")
def chart(iiwa: oc.Problem) -> oc.Chart:
    """Of a part of the 7-DoF arm's range at whose boundary the elbow is stretched."""
    box = oc.Box([0.0, 0.6, 0.2, -0.4, 0.2, 0.5, 0.0], [0.3, 0.3, 0.3, 0.4, 0.3, 0.3, 0.3])
    problem = oc.Problem(iiwa.robot, iiwa.task, iiwa.metric, box, least_singular_value=BOUND)
    return oc.fit(problem, oc.Polynomial(3), samples=2000).chart


@pytest.mark.slow
def test_boxes_without_a_proof_of_their_own_hold_no_clear_position(chart: oc.Chart) -> None:
    domain, rng = chart.problem.domain, np.random.default_rng(0)
    middle = domain.centre + domain.half_width * rng.uniform(-1, 1, (3000, 7))
    half = rng.uniform(0.01, 0.2, (3000, 1)) * np.ones(7)
    judge = choose_check(chart, build_chart_rows(chart), 0.0)
    assert isinstance(judge, OutsideCheck)
    found, outside = judge(middle - half, middle + half), judge.check_outside(middle - half, middle + half)[0]
    assert outside.sum() > 50
    points = middle[outside, None] + half[outside, None] * rng.uniform(-1, 1, (int(outside.sum()), 400, 7))
    assert domain.singular_values(points.reshape(-1, 7)).max() <= BOUND
    singular = domain.singular_values(middle) < BOUND / 2
    assert found.proved[singular & (half[:, 0] < 0.05)].mean() > 0.9


@pytest.mark.slow
def test_a_chart_next_to_singular_positions_needs_few_boxes(chart: oc.Chart) -> None:
    base = certifying.cover_domain(chart.problem.domain)
    search = Search(choose_check(chart, build_chart_rows(chart), 0.0), base, Limits())
    search.run(lambda _: None)
    assert search.finished
    assert search.evaluated < 400  # 165; with singular vectors that stay and boxes halved by linear terms alone 2,421
