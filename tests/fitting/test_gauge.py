"""What the loss leaves free is chosen the same way every time: offset, scale, order and sign of coordinates."""

from dataclasses import replace

import numpy as np
import pytest

import orthocas as oc
from orthocas.bases import JointSpace
from orthocas.errors import InvalidValueError
from orthocas.fitting.fit import Fit, align, fix_gauge
from orthocas.tasks.samples import sample_problem
from orthocas.tools.checks import Array


def parallel(a: oc.Chart, b: oc.Chart) -> Array:
    """Mean cosines between the gradients of two charts, (r, r)."""
    points = sample_problem(a.problem, 500, 5).points
    J, K = (c.coordinates.jacobian(points) for c in (a, b))
    J, K = (g / np.linalg.norm(g, axis=2, keepdims=True) for g in (J, K))
    return np.einsum("sin,sjn->ij", J, K) / len(points)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "degree", "least"), [("planar_x", 4, 0.99), ("planar_xy", 3, 0.99)])
def test_seeds_lead_to_the_same_coordinates_in_the_same_order_and_sign(
    request: pytest.FixtureRequest, name: str, degree: int, least: float
) -> None:
    problem = request.getfixturevalue(name)
    first, *others = (oc.fit(problem, oc.Polynomial(degree), seed=seed).chart for seed in range(3))
    for other in others:
        assert np.diag(parallel(first, other)).min() > least


@pytest.mark.nightly
def test_seeds_lead_to_the_same_coordinates_of_the_iiwa(iiwa: oc.Problem) -> None:
    """In any order: at the centre, the mean joints by which they are sorted differ by 0.001 to 0.06 only."""
    first, *others = (oc.fit(iiwa, oc.Polynomial(3), seed=seed).chart for seed in range(3))
    for other in others:
        assert np.abs(parallel(first, other)).max(axis=1).min() > 0.97


def test_order_and_sign_follow_the_gradients_at_the_centre(iiwa_fit: Fit, iiwa: oc.Problem) -> None:
    g = iiwa_fit.chart.coordinates.jacobian(iiwa.domain.centre[None])[0][:3]  # the fourth is the idle joint
    moved = (g**2 @ np.arange(7)) / (g**2).sum(axis=1)
    assert (np.diff(moved) > -1e-6).all()  # coordinates that change places in the mirror have the same mean
    assert (np.take_along_axis(g, np.abs(g).argmax(axis=1)[:, None], axis=1) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("parametrisation", [oc.Polynomial(2), oc.MLP((5, 4))], ids=lambda p: p.label)
def test_gauge_does_not_depend_on_how_coordinates_came(planar_x: oc.Problem, parametrisation: object) -> None:
    fit = oc.fit(planar_x, parametrisation, samples=200)
    found = fit.chart.coordinates
    family = found.family
    turned = type(found)(
        found.parametrisation,
        JointSpace.of(planar_x),
        (),
        family.reordered(found.theta, [1, 0]),
        found.offset[::-1],
        found.scale[::-1] * [-1, 1],
    )
    points = sample_problem(planar_x, 20, 1).points
    np.testing.assert_allclose(turned.xi(points), found.xi(points)[:, ::-1] * [-1, 1], atol=1e-12)
    again = fix_gauge(turned, planar_x.domain.centre)
    np.testing.assert_allclose(again.xi(points), found.xi(points), atol=1e-12)
    back = align(turned, fit.chart, sample_problem(planar_x, 20, 1))
    np.testing.assert_allclose(back.xi(points), found.xi(points), atol=1e-12)


def test_refit_is_aligned_to_a_chart(planar_x: oc.Problem) -> None:
    linear = oc.fit(planar_x, oc.Linear()).chart
    refit = oc.fit(planar_x, oc.Polynomial(3), align_to=linear).chart
    cosines = parallel(refit, linear)
    assert cosines[0, 0] > abs(cosines[1, 0]) - 1e-12 or cosines[1, 1] > abs(cosines[0, 1])
    assert (np.diag(cosines) > 0).all()


@pytest.mark.slow
def test_chart_of_another_size_is_refused(planar_x: oc.Problem, planar_xy: oc.Problem) -> None:
    other = oc.fit(planar_xy, oc.Polynomial(1)).chart
    with pytest.raises(InvalidValueError, match="align_to is a chart with n = 3, r = 1"):
        oc.fit(planar_x, oc.Polynomial(1), align_to=other)


def test_coordinates_vanish_at_the_centre_and_have_mean_gradients_of_length_one(planar_x: oc.Problem) -> None:
    chart = oc.fit(planar_x, oc.Polynomial(3)).chart
    np.testing.assert_allclose(chart.xi(planar_x.domain.centre), 0, atol=1e-12)
    lengths = np.linalg.norm(chart.coordinates.jacobian(sample_problem(planar_x, 4000, 9).points), axis=2).mean(axis=0)
    np.testing.assert_allclose(lengths, 1, rtol=0.15)  # the fit took the mean over 200 samples


def test_a_coordinate_that_folds_at_the_centre_keeps_its_values(planar_x: oc.Problem) -> None:
    found, centre = oc.fit(planar_x, oc.Polynomial(2), samples=200).chart.coordinates, planar_x.domain.centre
    points = sample_problem(planar_x, 20, 1).points
    units = (replace(found, theta=theta) for theta in np.eye(found.theta.size).reshape(-1, *found.theta.shape))
    folded = [c for c in units if not c.jacobian(centre[None]).any() and np.ptp(c.xi(points), axis=0).any()]
    assert folded  # squares of a joint
    for coordinates in folded:
        again = fix_gauge(coordinates, centre).xi(points)
        np.testing.assert_allclose(np.sort(np.abs(again)), np.sort(np.abs(coordinates.xi(points))), atol=1e-12)
