"""Charts that fold are never certified, and others are."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from certified_charts import certified, chart, fourier
from public_objects import fitted, given, network, partly_linear, planar

import orthocas as oc
from orthocas import problems
from orthocas.certificates import check_certificate
from orthocas.charts.certificate import PROVED
from orthocas.charts.point_quality import worst_points
from orthocas.errors import CertifyError, InvalidValueError


@pytest.mark.slow
@pytest.mark.parametrize("build", [chart, network, partly_linear, given, fourier, lambda: fitted().chart])
def test_regular_charts_are_certified_and_checked(build: Callable[[], oc.Chart]) -> None:
    known = build()
    certificate = oc.certify(known)
    assert certificate.proved
    assert certificate.share == 1.0
    assert check_certificate(known, certificate)


@pytest.mark.slow
@pytest.mark.parametrize(("build", "rounds"), [(lambda: fitted().chart, 10), (lambda: chart(0.4), 1)])
def test_a_million_points_near_the_worst_corners_do_not_refute_a_proof(
    build: Callable[[], oc.Chart], rounds: int
) -> None:
    known = build()
    certificate = certified(0.4) if known is chart(0.4) else oc.certify(known)
    assert certificate.proved
    rng = np.random.default_rng(5)
    low, high = certificate.regular.leaves(PROVED)
    ends = (parts[rng.integers(0, len(low), 5000)] for parts in (low, high))
    corners = np.where(rng.integers(0, 2, (5000, known.n)), *ends)
    sign = np.sign(np.linalg.det(known.jacobian(known.problem.domain.centre)))
    worst = corners[np.argsort(np.linalg.det(known.jacobian(corners)) * sign)[:1000]]
    domain = known.problem.domain
    for _ in range(rounds):
        near = np.repeat(worst, 100, axis=0) + rng.normal(size=(100_000, known.n)) * 0.01
        near = np.clip(near, domain.centre - domain.half_width, domain.centre + domain.half_width)
        assert (np.linalg.det(known.jacobian(near)) * sign > 0).all()


@pytest.mark.slow
def test_a_chart_of_the_arm_that_folds_is_never_certified() -> None:
    arm = problems.get("iiwa")
    wide = oc.Problem(arm.robot, arm.task, domain=oc.Box(arm.domain.centre, 1.04))
    folding = oc.fit(wide, oc.Polynomial(3)).chart
    assert worst_points(wide, folding.coordinates).least < 0
    certificate = oc.certify(folding, time_limit=5)
    assert not certificate.proved
    if certificate.fold:
        signs = np.sign(np.linalg.det(folding.jacobian(np.array(certificate.fold))))
        assert signs[0] != signs[1]
        assert certificate.share == 0


def dipped(depth: float, width: float = 1e-8) -> oc.Chart:
    """xi = q1 + q2 + q3 with a dip: its slope along q3 falls by `depth` on a part of the width of a hair."""
    arm = problems.get("planar_3r_xy")
    place = float(arm.domain.centre[2]) + 0.1234567

    def xi(q: ca.SX) -> ca.SX:
        return q[0] + q[1] + q[2] - depth * width * ca.tanh((q[2] - place) / width)

    return oc.fit(arm, oc.Given.from_function("dip", 3, xi)).chart


@pytest.mark.slow
def test_a_fold_smaller_than_any_sampling_sees_is_never_certified() -> None:
    folding = dipped(30.0)
    q = folding.problem.domain.centre + np.array([0, 0, 0.1234567])
    signs = np.sign(np.linalg.det(folding.jacobian(np.array([q, folding.problem.domain.centre]))))
    assert signs[0] != signs[1]  # it folds
    assert oc.evaluate(folding, samples=20_000).folded_samples == 0  # and nobody sees it
    assert not oc.certify(folding, time_limit=1).proved


@pytest.mark.slow
def test_a_dip_that_is_no_fold_is_certified() -> None:
    assert oc.certify(dipped(0.1, 0.1)).proved


@pytest.mark.slow
def test_a_chart_for_all_positions_of_a_cyclic_joint_is_certified() -> None:
    known = problems.get("iiwa")
    problem = oc.Problem(known.robot, known.task, domain=oc.Box(known.domain.centre, 0.15))
    cyclic = oc.fit(problem, oc.Polynomial(2, cyclic=["A1"]), samples=300).chart
    certificate = oc.certify(cyclic, time_limit=60)
    assert certificate.proved
    assert certificate.boxes < 500  # A1 is never halved: J does not depend on it


@pytest.mark.slow
def test_a_bound_of_the_conditioning_is_proved_below_the_sampled_minimum() -> None:
    certificate = oc.certify(chart(), 0.5)
    assert certificate.proved
    assert 0.5 <= certificate.conditioning <= oc.evaluate(chart(), samples=5000).conditioning.min
    assert check_certificate(chart(), certificate)
    with pytest.raises(InvalidValueError, match="bound is 1.5, expected a number from 0 to below 1"):
        oc.certify(chart(), 1.5)
    with pytest.raises(CertifyError, match="metric inertia"):
        oc.certify(oc.fit(planar(), oc.Linear()).chart, 0.1)


def test_two_points_of_the_one_to_one_box_never_share_phi() -> None:
    part = certified().injective
    assert part is not None
    rng = np.random.default_rng(5)
    J = np.linalg.inv(chart().jacobian(chart().problem.domain.centre))
    q = rng.uniform(part.low, part.high, (20_000, 7))
    p = rng.uniform(part.low, part.high, (20_000, 7))
    change = (chart().phi(q) - chart().phi(p)) @ J.T
    assert (((q - p) * change).sum(axis=1) > 0).all()


def test_what_cannot_be_certified_is_refused() -> None:
    grown = oc.grow(problems.get("planar_2r"), 1.0, origin=[np.pi / 3, 0.0])
    with pytest.raises(CertifyError, match="expected a fitted chart"):
        oc.certify(grown)
    arm = planar("euclidean")
    bent = oc.Task.custom(arm.robot, "kinked", lambda q: ca.fabs(q[0]) + q[1] ** 1.5)
    kinked = oc.fit(oc.Problem(arm.robot, bent, domain=oc.Box([0.6, 0.8, 0.8], 0.1)), oc.Linear()).chart
    with pytest.raises(CertifyError, match="cannot be certified"):
        oc.certify(kinked)
    with pytest.raises(CertifyError, match="no certificate"):
        check_certificate(chart())


def test_bounds_that_are_infinite_on_large_boxes_prove_nothing_and_warn_of_nothing() -> None:
    """On the first boxes of a ready wide chart, Taylor models of its network have infinite remainders."""
    found = oc.certify(oc.load("iiwa7-wide"), time_limit=0.1)
    assert found.boxes > 0
    assert found.regular.proved_count == 0
