"""det J as one polynomial: waves, cofactors, Bernstein forms, and proofs of charts whose domain keeps folds out."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from public_objects import planar

import orthocas as oc
from orthocas.bases.family import JointSpace
from orthocas.certificates import check_certificate
from orthocas.certificates.box_checks import NEVER
from orthocas.certificates.determinant import (
    SERIES_DEGREE,
    CofactorCheck,
    Determinant,
    Waves,
    bound_polynomial,
    compute_cofactors,
    expand_waves,
    list_indices,
)
from orthocas.certificates.outside import OutsideCheck, choose_check, choose_inside_check
from orthocas.certificates.rows import build_chart_rows
from orthocas.charts.certificate import COFACTORS, ELIMINATION, OPEN, PROVED, Subdivision, halve_interval
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import CertifyError
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array
from orthocas.tools.expressions import write_tape

ROUNDING = 1e-12  # of plain evaluations that bounds are compared with


def values_at(coefficients: Array, t: Array) -> Array:
    """Polynomials (monomials, boxes) at t (boxes, n)."""
    terms = [t[:, list(m)].prod(axis=1) for m in list_indices(t.shape[1], SERIES_DEGREE)]
    return np.asarray((coefficients * np.array(terms)).sum(axis=0))


def cubic(chart: oc.Chart) -> Coordinates:
    """The chart's linear coordinate with small quadratic and cubic terms."""
    linear, family = chart.coordinates, oc.Polynomial(3).family(JointSpace.of(chart.problem), 1)
    assert isinstance(linear, Coordinates)
    gradient = linear.jacobian(chart.problem.domain.centre[None])[0, 0] * family.space.half_width / np.sqrt(3)
    theta = 0.02 * family.initial(3)
    for k, term in enumerate(family.terms):
        theta[k] = gradient[term.index(1)] if sum(term) == 1 else theta[k]
    return Coordinates(oc.Polynomial(3), family.space, (), theta, np.zeros(1), np.ones(1))


@cache
def folding() -> oc.Chart:
    """A chart of the planar arm whose coordinates fold in a part of the clear box."""
    known = oc.problems.get("planar_3r_xy")
    box = oc.Box([0.0, 0.8, 0.8], [3.0, 2.3, 2.3])
    problem = oc.Problem(known.robot, known.task, domain=box, least_singular_value=0.1)
    chart = oc.fit(problem, oc.Linear()).chart
    domain = RegularPart(chart.problem.domain, cubic(chart), 0.05)
    return oc.Chart(oc.Problem(known.robot, known.task, domain=domain), cubic(chart))


@cache
def of_poses() -> oc.Chart:
    """Coordinates of the 7-DoF arm's pose, half a turn of the tool from its reference."""
    robot = oc.problems.get("iiwa").robot
    box = oc.Box([0.0, 0.6, 0.2, -1.2, 0.2, 0.9, 0.0], 0.4)
    task = oc.Task.pose(robot, robot.tip_rotation(box.centre + 3.1 * np.eye(7)[6]))
    chart = oc.fit(oc.Problem(robot, task, domain=box), oc.Linear()).chart
    return oc.Chart(chart.problem, cubic(chart))


def determinants(chart: oc.Chart, q: Array) -> Array:
    """det of the frame Jacobian and the gradient, by NumPy, (N,)."""
    J = chart.problem.task.batched_frame_jacobian(q)[0].reshape(len(q), chart.m, chart.n)
    return np.asarray(np.linalg.det(np.concatenate([J, chart.coordinates.jacobian(q)], axis=1)))


def test_sums_of_waves_are_what_they_stand_for() -> None:
    s, c = Waves.sine(0, 2), Waves.cosine(1, 2)
    q = np.random.default_rng(1).uniform(-3, 3, (50, 2))
    sine, cosine = np.sin(q[:, 0]), np.cos(q[:, 1])
    mixed = (s * c + Waves.constant(0.3, 2)) * (s - c)
    np.testing.assert_allclose(mixed(q), (sine * cosine + 0.3) * (sine - cosine), atol=ROUNDING)
    slope = np.cos(q[:, 0]) * (cosine * (sine - cosine) + sine * cosine + 0.3)
    np.testing.assert_allclose(mixed.differentiate(0)(q), slope, atol=ROUNDING)
    assert 0 < mixed.error < 1e-13
    assert 1.0 <= (s * s + Waves.cosine(0, 2) * Waves.cosine(0, 2)).trim().size < 1 + 1e-12  # one wave is left


def test_errors_of_waves_are_carried() -> None:
    wrong = Waves.constant(2.0, 1, 0.1)
    assert (wrong * wrong).error >= 0.41  # (2 + 0.1)^2 - 2^2
    assert (wrong + wrong).error >= 0.2
    assert wrong.differentiate(0).error == 0  # of a constant


@pytest.mark.parametrize("expression", ["exp", "slide", "double"])
def test_what_makes_no_waves_is_refused(expression: str) -> None:
    import casadi as ca

    q = ca.SX.sym("q", 2)
    value = {"exp": ca.exp(ca.sin(q[0])), "slide": q[0] * ca.cos(q[1]), "double": ca.sin(3 * q[0])}[expression]
    with pytest.raises(CertifyError, match="the task uses"):
        expand_waves(write_tape(ca.Function("h", [q], [value])), 2)


def test_cofactors_are_those_of_numbers() -> None:
    numbers = np.random.default_rng(2).normal(size=(3, 4))
    found = compute_cofactors([[Waves.constant(x, 1) for x in row] for row in numbers])
    z = np.array([each(np.zeros((1, 1)))[0] for each in found])
    g = np.random.default_rng(3).normal(size=4)
    assert z @ g == pytest.approx(np.linalg.det(np.vstack([numbers, g])), abs=1e-13)


@pytest.mark.parametrize("name", ["planar", pytest.param("poses", marks=pytest.mark.slow)])
def test_expansions_contain_det_j(name: str) -> None:
    chart = folding() if name == "planar" else of_poses()
    found, rng = Determinant.build(chart), np.random.default_rng(4)
    assert found is not None
    domain, count = chart.problem.domain, 100
    middle = domain.centre + 0.8 * domain.half_width * rng.uniform(-1, 1, (count, chart.n))
    half = 0.2 * domain.half_width * rng.uniform(size=(count, 1))
    coefficients, rest = found(middle - half, middle + half)
    for k in range(6):
        t = rng.uniform(-1, 1, (count, chart.n)) if k % 2 else rng.choice([-1.0, 1.0], (count, chart.n))
        coordinates = chart.coordinates
        assert isinstance(coordinates, Coordinates)
        truth = determinants(chart, middle + half * t) / coordinates.scale[0]
        missed = np.abs(values_at(coefficients, t[:, list(found.joints)]) - truth)
        assert (missed <= rest + ROUNDING * np.abs(coefficients).sum(axis=0)).all()
    assert np.median(rest / np.abs(coefficients[0])) < 0.05  # 0.004, 0.001


@pytest.mark.slow
def test_joints_on_which_self_motions_do_not_depend_do_not_count() -> None:
    known = oc.problems.get("iiwa")
    problem = oc.Problem(
        known.robot, oc.Task.pose(known.robot), domain=oc.Box([0.0, 0.6, 0.2, -1.2, 0.2, 0.9, 0.0], 0.4)
    )
    found = Determinant.build(oc.fit(problem, oc.Linear()).chart)
    assert found is not None
    assert found.joints == (1, 2, 3, 4, 5)


def test_least_values_are_below_all_values_and_exact_at_corners() -> None:
    rng = np.random.default_rng(5)
    for n in (1, 3, 5):
        size = np.array([0.3 ** len(m) for m in list_indices(n, SERIES_DEGREE)])
        coefficients = rng.normal(size=(len(size), 40)) * size[:, None]
        least = bound_polynomial(coefficients, n)
        corners = rng.choice([-1.0, 1.0], (40, n))
        for t in [*rng.uniform(-1, 1, (20, 40, n)), corners]:
            assert (values_at(coefficients, t) >= least).all()
    bilinear = np.zeros((len(list_indices(2, SERIES_DEGREE)), 1))
    bilinear[[0, 1, 2, 4], 0] = 1.0, 1.0, 1.0, 0.5  # 1 + x + y + x y / 2, least at (-1, -1); sizes alone give -1.5
    assert bound_polynomial(bilinear, 2)[0] == pytest.approx(-0.5, abs=1e-12)


@pytest.mark.slow
def test_the_fastest_judge_that_applies_is_taken() -> None:
    assert isinstance(choose_inside_check(folding(), build_chart_rows(folding()), 0.0), CofactorCheck)
    assert choose_inside_check(folding(), build_chart_rows(folding()), 0.1).method == ELIMINATION
    assert choose_inside_check(folding(), build_chart_rows(folding()), 0.0, ELIMINATION).method == ELIMINATION
    assert Determinant.build(oc.fit(planar("euclidean"), oc.Fourier(2), samples=300).chart) is None
    position = oc.problems.get("iiwa")
    four = oc.fit(oc.Problem(position.robot, position.task, domain=oc.Box(position.domain.centre, 0.2)), oc.Linear())
    with pytest.raises(CertifyError, match="no expansion"):
        choose_inside_check(four.chart, build_chart_rows(four.chart), 0.0, COFACTORS)


@pytest.mark.slow
def test_both_judges_see_the_same_signs() -> None:
    chart, rng = of_poses(), np.random.default_rng(6)
    domain = chart.problem.domain
    middle = domain.centre + 0.9 * domain.half_width * rng.uniform(-1, 1, (100, 7))
    low, high = middle - 0.02, middle + 0.02
    one, two = (
        choose_inside_check(chart, build_chart_rows(chart), 0.0, method)(low, high)
        for method in (COFACTORS, ELIMINATION)
    )
    both = one.proved & two.proved
    assert both.sum() > 50
    assert (one.sign == two.sign)[both].all()
    assert (one.sign == np.sign(determinants(chart, middle)))[one.proved].all()
    assert one.proved.sum() >= two.proved.sum()


@pytest.mark.slow
def test_the_domain_keeps_folds_out_of_what_is_not_proved(tmp_path: Path) -> None:
    chart = folding()
    found = oc.certify(chart, time_limit=0.5)
    assert found.method == COFACTORS
    assert not found.fold
    assert not found.proved
    box = sample_uniform(oc.Box(chart.problem.domain.centre, chart.problem.domain.half_width), 20_000, 1)
    regular = chart.problem.domain.contains(box).mean() / (chart.problem.domain.singular_values(box) > 0.1).mean()
    assert regular - 0.05 < found.clear_share < 1
    assert "guarded at run time" in found.facts()["the rest"]
    rounded_down = np.floor(1e5 * found.clear_share) / 1e3
    assert f"{rounded_down:.3f}% of what is clear" in found.heading
    low, high = found.regular.leaves(PROVED)
    rng = np.random.default_rng(8)
    points = rng.uniform(low, high, (200, *low.shape)).reshape(-1, 3)
    domain = chart.problem.domain
    assert isinstance(domain, RegularPart)
    clear = domain.singular_values(points) > domain.least_singular_value
    assert (domain.volumes(points[clear]) > 0).all()
    replace(chart, certificate=found).save(tmp_path / "a.chart")
    again = oc.load(tmp_path / "a.chart")
    assert again.certificate is not None
    assert again.certificate.as_dict() == found.as_dict()
    assert check_certificate(again)
    assert not check_certificate(chart, replace(found, clear_share=0.9999).seal())
    with pytest.raises(CertifyError, match="by another bound on the volume"):
        check_certificate(chart, replace(found, least_volume=0.2).seal())


def test_what_the_domain_keeps_out_is_not_halved() -> None:
    chart = folding()
    domain = chart.problem.domain
    assert isinstance(domain, RegularPart)
    points = sample_uniform(oc.Box(domain.centre, domain.half_width), 2000, 1)
    kept_out = points[(domain.volumes(points) < -0.1) & (domain.singular_values(points) > 0.2)][:20]
    assert len(kept_out) > 5
    judge = choose_check(chart, build_chart_rows(chart), 0.0)
    assert isinstance(judge, OutsideCheck)
    found = judge(kept_out - 1e-3, kept_out + 1e-3)
    assert not found.proved.any()
    assert not found.regular.any()  # no fold of the chart, whose domain ends before it
    assert (found.widest == NEVER).all()


def test_parts_are_found_in_order() -> None:
    codes = np.array([0, 1, PROVED, OPEN, 2, PROVED, 0, OPEN, PROVED], dtype=np.uint8)
    tree = Subdivision(np.zeros(3), np.array([1.0, 2.0, 3.0]), codes)

    def walked(k: int, low: Array, high: Array) -> tuple[int, list[tuple[int, list[float], list[float]]]]:
        code = int(codes[k])
        if code >= PROVED:
            return k + 1, [(code, low.tolist(), high.tolist())]
        top, bottom = high.copy(), low.copy()
        top[code] = bottom[code] = halve_interval(low[code], high[code])
        middle, first = walked(k + 1, low, top)
        end, second = walked(middle, bottom, high)
        return end, first + second

    _, parts = walked(0, tree.low, tree.high)
    for code in (OPEN, PROVED):
        low, high = tree.leaves(code)
        assert [(code, a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True)] == [
            part for part in parts if part[0] == code
        ]
