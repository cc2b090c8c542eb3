"""Fits without folds: mirror symmetry, the search for the worst points, and the fold term."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import orthocas as oc
from orthocas import problems
from orthocas.bases import JointSpace
from orthocas.charts.point_quality import Judged, WorstPoints, least_in_domain, worst_points
from orthocas.fitting import stages
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.fit import Fit
from orthocas.fitting.sample_loss import Loss, build_sample_loss
from orthocas.fitting.stages import FoldSearch
from orthocas.fitting.starts import Mirror, find_mirror
from orthocas.fitting.terms import RULES, Sizes, Weights
from orthocas.tasks.samples import sample_boundary_weighted, sample_problem

ACTIVE = list(range(6))
SPACE = JointSpace(np.zeros(2), np.ones(2), (False, False), ("a", "b"))
SIGNS = (-1, 1, -1, 1, -1, 1)  # joints that turn about the arm's plane turn round in the mirror


def shifted(problem: oc.Problem, joint: int, angle: float) -> oc.Problem:
    centre = problem.domain.centre.copy()
    centre[joint] += angle
    return replace(problem, domain=oc.Box(centre, problem.domain.half_width))


def test_the_mirror_of_the_iiwa_is_found(iiwa: oc.Problem) -> None:
    mirror = find_mirror(iiwa, ACTIVE)
    assert mirror is not None
    assert tuple(mirror.signs) == SIGNS
    assert tuple(mirror.parities) == (-1, -1, 1)


def test_a_turned_base_keeps_the_mirror_and_a_turned_elbow_breaks_it(iiwa: oc.Problem) -> None:
    assert find_mirror(shifted(iiwa, 0, 0.3), ACTIVE) is not None
    assert find_mirror(shifted(iiwa, 2, 0.3), ACTIVE) is None


def test_a_planar_arm_out_of_line_has_no_mirror(planar_xy: oc.Problem) -> None:
    assert find_mirror(planar_xy, [0, 1, 2]) is None


def test_fitted_coordinates_keep_their_size_or_change_places_in_the_mirror(iiwa_fit: Fit) -> None:
    """xi(S q) = T xi(q) with a signed permutation T. Two odd components and an even one give the trace -1."""
    chart = iiwa_fit.chart
    u = np.random.default_rng(1).uniform(-0.7, 0.7, (50, 7))
    here, there = (chart.xi(chart.problem.domain.centre + side)[:, :3] for side in (u, np.array([*SIGNS, 1]) * u))
    T = np.linalg.lstsq(here, there, rcond=None)[0].T
    np.testing.assert_allclose(there, here @ T.T, atol=1e-6)  # a linear relation, up to the scales of coordinates
    assert (np.abs(T) > 1e-6).sum() == 3
    assert np.linalg.det(T) == pytest.approx(1, abs=1e-6)
    assert np.trace(T) == pytest.approx(-1, abs=1e-6)


def test_coordinates_that_change_places_come_from_components_and_back() -> None:
    theta = np.arange(6.0)
    mirror = Mirror(SPACE, np.ones(2), np.array([-1.0, -1.0, 1.0]), exchanged=((1, 2),))
    C = mirror.coordinates(theta).reshape(3, 2)
    np.testing.assert_allclose(C, [[0, 1], [6 / 2**0.5, 8 / 2**0.5], [2 / 2**0.5, 2 / 2**0.5]])
    np.testing.assert_allclose(mirror.components(C.ravel()), theta, atol=1e-15)


def test_choices_are_parities_alone_or_pairs_of_an_odd_and_an_even_component() -> None:
    mirror = Mirror(SPACE, np.ones(2), np.array([-1.0, -1.0, 1.0]))
    assert [choice.exchanged for choice in mirror.list_choices()] == [(), ((0, 2),), ((1, 2),)]


def test_the_loss_of_components_is_that_of_the_coordinates_made_of_them() -> None:
    sizes, rng = Sizes(n=4, m=1, r=3, identity_metric=True), np.random.default_rng(2)
    coordinates, components = (Loss.of(sizes, Weights().by_name, pairs) for pairs in ((), ((0, 2),)))
    J = rng.normal(size=(3, 4))
    turned = np.array([(J[0] + J[2]) / 2**0.5, J[1], (J[2] - J[0]) / 2**0.5])
    data = [rng.normal(size=symbol.shape) for symbol in coordinates.arguments()[1]]
    assert float(build_sample_loss(components)(J, *data)) == pytest.approx(
        float(build_sample_loss(coordinates)(turned, *data))
    )


@pytest.mark.slow
def test_no_fold_is_left_where_other_samples_look_for_one(iiwa_fit: Fit) -> None:
    """200,000 samples near corners and faces with another seed, and a search with another seed."""
    chart = iiwa_fit.chart
    assert iiwa_fit.worst is not None
    found = []
    for part in np.array_split(sample_boundary_weighted(chart.problem.domain, 200_000, 77), 20):
        judged = Judged.at(chart.problem, chart.coordinates, part)
        found.append(judged.signs * judged.conditioning)
    values = np.concatenate(found)
    values *= np.sign(np.median(values))
    assert values.min() > 0.1
    assert worst_points(chart.problem, chart.coordinates, seed=5).least == pytest.approx(iiwa_fit.worst.least, abs=0.05)


def test_exact_coordinates_are_straight() -> None:
    """With xi, xi^2 is orthogonal to the task as well, and folds."""
    robot = oc.Robot.planar([1, 1, 1], [1, 1, 1])
    task = oc.Task.custom(robot, "sum", lambda q: q[:2] + ca.vertcat(q[2], 0))
    fit = oc.fit(oc.Problem(robot, task, domain=oc.Box([0, 0.4, 0.3], 0.4)), oc.Polynomial(2), samples=300)
    gradient = fit.chart.jacobian(fit.chart.problem.domain.centre)[2]
    np.testing.assert_allclose(np.abs(gradient), [0.5**0.5, 0, 0.5**0.5], atol=1e-9)
    assert fit.worst is not None
    assert fit.worst.least > 0.999


@pytest.mark.slow
def test_without_the_fold_term_the_same_fit_folds(iiwa: oc.Problem) -> None:
    fit = oc.fit(iiwa, oc.Polynomial(3), weights=Weights(folds=0))
    assert fit.worst is None
    assert worst_points(iiwa, fit.chart.coordinates).least < 0


def test_no_rounds_on_a_domain_that_holds_singular_positions() -> None:
    """Its folds belong to the domain; the fit offers the clear part at once."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.6, 0.8, 0.4], 1.2))
    fit = oc.fit(problem, oc.Polynomial(3))
    assert fit.problem_check.singular_samples > 0
    assert [stage.label for stage in fit.stages] == ["polynomial:2", "polynomial:3", "polynomial:3, with folds"]
    assert fit.clear_part is not None


@pytest.mark.parametrize(
    ("found", "rounds", "least"),
    [
        ((-0.3, 0.1, 0.15, -0.2, -0.1), 3, 0.15),  # the best one without a fold, not the last
        ((-0.3, -0.2, 0.1, 0.105), 4, 0.105),  # settled
        ((0.005, 0.1, 0.3), 3, 0.3),  # a first round is not settled
    ],
)
def test_rounds_that_fold_again_are_left_out(
    monkeypatch: pytest.MonkeyPatch, found: tuple[float, ...], rounds: int, least: float
) -> None:
    """With searches that find these values."""
    values = iter(found)

    def search(problem: oc.Problem, *_: object) -> WorstPoints:
        return WorstPoints(problem.domain.centre[None], np.array([next(values)]))

    monkeypatch.setattr(stages, "worst_points", search)
    fit = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(2), samples=300)
    assert fit.worst is not None
    assert fit.worst.least == least
    assert len(fit.stages) == rounds
    assert not list(values)


@pytest.mark.slow
def test_fold_term_acts_at_collected_points_with_its_exact_gradient(iiwa: oc.Problem) -> None:
    """Against central differences; and the value is weight / 2 mean(max(0.32 - det D, 0)^2) more."""
    unsafe = oc.fit(iiwa, oc.Polynomial(2), weights=Weights(folds=0))
    folds = FoldSearch(iiwa, ACTIVE, 1000.0, singular=False)
    folds.search(unsafe.stages[-1], oc.Polynomial(2), 0, lambda progress: None)
    assert folds.least < RULES.least_conditioning
    family = unsafe.chart.coordinates.family
    theta = unsafe.stages[-1].result.theta
    samples = sample_problem(iiwa, 300, 4).restricted_to(ACTIVE)
    plain = BasisObjective(family, samples, Weights(), theta, lambda count, seed: samples)
    both = folds.add_to(plain)
    assert both.value(theta) > plain.value(theta)
    direction = np.random.default_rng(0).normal(size=theta.size)
    slope = both.value_and_gradient(theta)[1] @ direction
    step = 1e-6
    central = (both.value(theta + step * direction) - both.value(theta - step * direction)) / (2 * step)
    assert slope == pytest.approx(central, rel=1e-5)
    folds.give_up()
    assert folds.add_to(plain) is plain


@pytest.mark.slow
def test_domains_that_force_folds_are_fitted_without_the_term(planar_xy: oc.Problem) -> None:
    """The box around the stretched arm holds singular positions of the task: folds stay, and the fit says so."""
    wide = replace(planar_xy, domain=oc.Box([0.6, 0.0, 0.0], 1.2))
    fit = oc.fit(wide, oc.Polynomial(3), samples=600)
    assert fit.worst is not None
    assert fit.worst.least < 0
    assert fit.stages[-1].label == "polynomial:3, with folds"
    assert "FOLDS" in fit.facts()["least conditioning"]


@pytest.mark.slow
def test_the_search_finds_what_samples_and_short_descents_miss() -> None:
    """L-BFGS-B with differences, from 60 starts, found 0.298 on the PR2's chart, whose card said 0.336."""
    chart = oc.charts.load("pr2-left-position")
    least = worst_points(chart.problem, chart.coordinates, 1).least
    assert 0.29 < least < 0.2985
    assert oc.charts.card("pr2-left-position").quality["conditioning"]["min"] == pytest.approx(least, abs=1e-3)


def test_a_search_among_thousands_of_valleys_ends_in_the_deepest() -> None:
    """Rastrigin's function of 16 joints: each joint alone has five valleys or so; that around u = c is the deepest."""
    n = 16
    c = np.random.default_rng(5).uniform(-0.8, 0.8, n)
    box = oc.Box(np.zeros(n), np.full(n, 2.0))

    def value(q: np.ndarray) -> np.ndarray:
        z = q / 2 - c
        return np.asarray((z**2 + 0.02 * (1 - np.cos(5 * np.pi * z))).sum(axis=1))

    np.testing.assert_allclose(least_in_domain(value, box) / 2, c, atol=0.02)


def test_a_search_of_the_domain_ends_where_a_function_is_least() -> None:
    """A narrow valley to a corner, and a part without values where it would be less."""
    box = oc.Box([1.0, 2.0, 3.0], [0.5, 1.0, 2.0])

    def value(q: np.ndarray) -> np.ndarray:
        u = (q - box.centre) / box.half_width
        found = 100 * (u[:, 0] - u[:, 1]) ** 2 - u[:, 0] + u[:, 2]
        return np.where(u[:, 0] > 0.8, np.nan, found)

    found = least_in_domain(value, box)
    np.testing.assert_allclose((found - box.centre) / box.half_width, [0.8, 0.805, -1.0], atol=2e-2)
