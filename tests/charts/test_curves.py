"""The search along self-motion curves: what it finds, against random starts, and what its parts promise."""

from dataclasses import replace

import numpy as np
import pytest
from dense_search import STARTS, positions_at
from programs import needs_c, nightly
from public_objects import wide

import orthocas as oc
from orthocas.charts import curve_tracer
from orthocas.charts.curve_tracer import SearchKernel
from orthocas.charts.curves import SelfMotionCurves
from orthocas.tasks.samples import sample_uniform

FOUND, NEAREST = oc.InverseStatus.FOUND, oc.InverseStatus.NEAREST


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-wide", *nightly("xarm7-wide")])
def test_no_random_start_leads_to_a_nearer_xi(name: str) -> None:
    """A wish whose x is that of another posture: a search from near the wish missed the nearest xi in one of seven."""
    chart = oc.charts.load(name)
    domain = chart.problem.domain
    wishes, x = sample_uniform(domain, 24, 1), chart.x(sample_uniform(domain, 24, 2))
    near, pool = chart.nearest_xi(wishes, x), sample_uniform(domain, STARTS, 3)
    assert FOUND in near.statuses
    assert set(near.statuses) <= {FOUND, NEAREST}
    assert domain.contains(near.q).all()
    np.testing.assert_allclose(chart.parts.relative.difference(x, chart.x(near.q)), 0, atol=1e-8)
    xi = chart.xi(wishes)[:, 0]
    np.testing.assert_allclose(near.distance, np.abs(chart.xi(near.q)[:, 0] - xi), atol=1e-9)
    known = 0
    for k in range(len(x)):
        others = positions_at(chart, x[k], pool)
        known += len(others)
        assert near.distance[k] <= np.abs(chart.xi(others)[:, 0] - xi[k]).min() + 1e-6
    assert known > 20 * len(x)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-wide", "iiwa7-pose", "ur10-position", "panda-position"])
def test_all_solutions_are_those_that_random_starts_find(name: str) -> None:
    """Newton's method from 1,000 of them."""
    chart = oc.charts.load(name)
    starts = sample_uniform(chart.problem.domain, 1000, 9)
    for q in sample_uniform(chart.problem.domain, 4, 8):
        every = chart.solve(np.tile(chart.phi(q), (len(starts), 1)), starts)
        found, others = chart.solutions(chart.phi(q)), np.unique(every.q[every.found].round(7), axis=0)
        assert len(others) > 0
        assert all(np.abs(found - other).max(axis=1).min() < 1e-6 for other in others)
        assert all(np.abs(others - own).max(axis=1).min() < 1e-6 for own in found)
        np.testing.assert_allclose(chart.phi(found), np.tile(chart.phi(q), (len(found), 1)), atol=1e-8)


def test_points_of_all_curves_pass_by_every_posture() -> None:
    """Of a planar arm, also by those on the other side of a fold, with the same x and xi."""
    robot = oc.Robot.planar([1.0, 0.8, 0.6], [1.0, 1.0, 1.0])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), "euclidean", oc.Box([0.3, 0.6, 0.6], [2.0, 2.4, 2.4]))
    chart = oc.fit(problem, oc.Linear(), samples=300).chart
    curves, folded = chart.parts.inverse.curves, 0
    assert curves is not None
    for q in problem.domain.sample(12, 5):
        points = curves.list_points(chart.phi(q), 8)
        assert problem.domain.contains(points).all()
        np.testing.assert_allclose(chart.x(points), np.tile(chart.x(q), (len(points), 1)), atol=1e-9)
        # steps of curves are at most 0.4 rad long
        assert np.linalg.norm(points - q, axis=1).min() < 0.06
        solutions = chart.solutions(chart.phi(q))
        folded += len(solutions) > 1
        assert all(np.linalg.norm(points - other, axis=1).min() < 0.06 for other in solutions)
    assert folded > 3


@pytest.mark.slow
def test_few_random_starts_lead_to_a_nearer_xi_where_curves_fill_surfaces() -> None:
    """With r = 2, slices show most of the self-motions: of 800 wishes, 4,000 starts led nearer in one of a hundred."""
    chart = oc.charts.load("pr2-left-wide")
    domain = chart.problem.domain
    wishes, x = sample_uniform(domain, 16, 1), chart.task(sample_uniform(domain, 16, 2))
    near, pool = chart.nearest_xi(wishes, x), sample_uniform(domain, STARTS, 3)
    assert {FOUND, NEAREST} == set(near.statuses)
    assert domain.contains(near.q).all()
    np.testing.assert_allclose(chart.parts.relative.difference(x, chart.task(near.q)), 0, atol=1e-8)
    xi, nearer = chart.xi(wishes), 0
    for k in range(len(x)):
        others = positions_at(chart, x[k], pool)
        nearer += len(others) > 0 and near.distance[k] > np.linalg.norm(chart.xi(others) - xi[k], axis=1).min() + 1e-6
    assert nearer <= 1


@pytest.mark.slow
@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("name", ["pr2-left-wide", "panda-position"])
def test_where_nothing_leads_to_x_nothing_is_claimed(name: str, inside: bool) -> None:
    chart = oc.charts.load(name)
    phi = chart.phi(chart.problem.domain.centre)
    phi[0] += 9.0
    found = chart.solve(phi, inside=inside)
    assert found.statuses == (oc.InverseStatus.OUT_OF_REACH,)
    assert np.isfinite(found.q).all()


@pytest.mark.slow
@pytest.mark.parametrize("inside", [False, True])
def test_positions_near_boundaries_are_found_again(inside: bool) -> None:
    """Of 2,000, 12 were missed, and with `inside` said to lie nowhere in the domain."""
    chart = oc.charts.load("panda-wide")
    domain, rng = chart.problem.domain, np.random.default_rng(3)
    unit = rng.uniform(-1, 1, (12_000, chart.n))
    unit = np.sign(unit) * np.abs(unit) ** rng.choice([1, 0.5, 0.25, 0.05], (len(unit), 1))
    q = domain.centre + domain.half_width * unit
    q = q[domain.contains(q)][:1000]
    solutions = chart.solve(chart.phi(q), inside=inside)
    assert len(q) == 1000
    assert solutions.found.all()
    np.testing.assert_allclose(chart.parts.phi_map.residual(chart.phi(q), solutions.q), 0, atol=1e-9)


def test_curves_are_cut_by_the_limits_after_full_turns() -> None:
    """A joint with a range of two turns: both positions count, and the nearest xi is that of the right turn."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    domain = oc.Box([0.0, 0.8, 0.8], [2 * np.pi, 0.7, 0.7])
    chart = oc.fit(
        oc.Problem(robot, oc.Task.position(robot, "xy"), domain=domain), oc.Linear(base=(0.0, 0.8, 0.8))
    ).chart
    assert np.abs(chart.coordinates.jacobian(np.array([[0.0, 0.8, 0.8]]))[0, 0, 0]) > 0.05
    q = np.array([1.0, 0.9, 0.7])
    turn = np.array([2 * np.pi, 0.0, 0.0])
    apart = abs(chart.xi(q) - chart.xi(q - turn))[0]
    for own in (q, q - turn):
        found = chart.nearest_xi(own, chart.x(q))
        assert found.distance[0] < 1e-9 < apart
        np.testing.assert_allclose(chart.xi(found.q[0]), chart.xi(own), atol=1e-9)


def test_endless_joints_count_at_every_turn_near_the_wish() -> None:
    """A turn of the first joint changes xi. Eleven of 424 wishes near x got a posture of another turn."""
    chart = wide().chart
    domain, rng = chart.problem.domain, np.random.default_rng(4)
    wishes = sample_uniform(domain, 500, 3)
    others = wishes + 0.3 * domain.half_width * rng.uniform(-1, 1, wishes.shape)
    others = np.where(domain.contains(others)[:, None], others, wishes)
    x, xi = chart.x(others), chart.xi(wishes)
    found = chart.nearest_xi(wishes, x)
    assert (found.status <= NEAREST).all()
    assert (found.distance <= np.abs(chart.xi(others) - xi)[:, 0] + 1e-9).all()


def test_orientations_are_embedded_without_a_seam() -> None:
    """Numbers of orientations that differ little are as far apart as the error says, at half a turn too."""
    chart = oc.charts.load("iiwa7-wide")
    rng = np.random.default_rng(0)
    q = sample_uniform(chart.problem.domain, 300, 4)
    x, y = chart.x(q), chart.x(q + 1e-3 * rng.normal(size=q.shape))
    error = np.linalg.norm(chart.parts.relative.difference(x, y)[:, 3:], axis=1)
    apart = np.linalg.norm(chart.parts.relative.embed(x) - chart.parts.relative.embed(y), axis=1)
    np.testing.assert_allclose(apart, error, rtol=1e-4, atol=1e-12)


@needs_c
@pytest.mark.parametrize("name", ["panda-wide", "iiwa7-pose", *nightly("xarm7-wide", "baxter-left-wide")])
def test_without_a_compiler_answers_are_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy and C find as much: equal statuses, nearest xi and sets of all solutions, to 2e-10."""
    chart, rng = oc.load(name), np.random.default_rng(4)
    wishes = chart.domain.sample(60, 1)
    phi = chart.phi(chart.domain.sample(60, 2))
    phi[:, chart.m] += rng.normal(0.0, 0.7, 60)  # some beyond what the chart has there
    near, every = chart.solve(phi, wishes, inside=True), [chart.solutions(row) for row in phi[:20]]
    assert chart.parts.inverse.curves is not None
    assert chart.parts.inverse.curves.has_kernel
    monkeypatch.setattr(SelfMotionCurves, "has_kernel", False)
    other = chart.solve(phi, wishes, inside=True)
    np.testing.assert_array_equal(near.status, other.status)
    assert {oc.InverseStatus.FOUND, oc.InverseStatus.NEAREST} <= set(near.statuses)
    np.testing.assert_allclose(near.distance, other.distance, atol=2e-10)
    for row, found in zip(phi, every, strict=False):
        others = chart.solutions(row)
        assert len(found) == len(others)
        for q in found:
            assert np.abs(others - q).max(axis=1).min() < 2e-10


@needs_c
@pytest.mark.slow
def test_ends_and_turns_beyond_the_room_of_c_count_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """With room for one end of an arc and one combination of full turns, the nearest xi are the same."""
    chart = oc.load("xarm7-wide")
    phi, wishes = chart.phi(chart.domain.sample(60, 2)), chart.domain.sample(60, 1)
    phi[:, chart.m] += np.random.default_rng(4).normal(0.0, 0.7, 60)  # some beyond what the chart has there
    curves = chart.parts.inverse.curves
    assert curves is not None
    roomy = curves.search(phi, wishes, 1e-9)
    source = curve_tracer.get_source

    def get_narrow(name: str) -> str:
        text = source(name)
        for word, room in (("SHEETS", 256), ("ENDS", 64)) if name == "curve_rows.c" else ():
            assert f"#define {word} {room}\n" in text
            text = text.replace(f"#define {word} {room}\n", f"#define {word} 1\n")
        return text

    monkeypatch.setattr(curve_tracer, "get_source", get_narrow)
    narrow = replace(curves, kernel=SearchKernel(chart)).search(phi, wishes, 1e-9)
    assert np.unique(roomy.distance > 0).size == 2
    np.testing.assert_allclose(narrow.distance, roomy.distance, atol=2e-10)
