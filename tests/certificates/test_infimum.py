"""The spline solution of the variational problem (examples/infimum.py): its parts against independent ones."""

import infimum
import numpy as np
import pytest

import orthocas as oc
from orthocas import problems

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(infimum, "POINTS", 8)


def test_splines_differentiate_and_integrate_cubic_polynomials_exactly() -> None:
    box = oc.Box([0.1, 0.2, 0.3], [0.5, 0.4, 0.3])
    splines = infimum.Splines(box, 2)
    x, y, z = splines.points.T
    C = splines.interpolated((x**3 * y - z**2)[:, None])
    for slope, exact in zip(splines.slopes, (3 * x**2 * y, x**3, -2 * z), strict=True):
        np.testing.assert_allclose(slope @ C[0], exact, atol=1e-12)
    assert splines.shares @ x**4 == pytest.approx((0.6**5 + 0.4**5) / 5)  # over a length of 1


def test_loss_of_splines_is_that_of_the_fit_and_its_gradient_is_right() -> None:
    problem = problems.get("planar_3r_xy")
    chart = oc.fit(problem, oc.Polynomial(2), weights=infimum.WEIGHTS, samples=300).chart
    splines = infimum.Splines(problem.domain, 2)
    theta = splines.interpolated(chart.xi(splines.points))
    loss = infimum.SplineLoss(splines, problem, theta)
    assert loss.value(theta.ravel()) == pytest.approx(infimum.judged(problem, chart, splines), rel=1e-10)
    leak = np.radians(oc.evaluate(chart, 20_000).leak.rms)  # for r = 1 the loss is that of the leak, but for sin
    assert infimum.as_angle(loss.value(theta.ravel()) * problem.m) == pytest.approx(np.degrees(leak), rel=0.02)
    direction = np.random.default_rng(2).normal(size=theta.size)
    _, gradient, H = loss.normal_equations(theta.ravel())
    step = 1e-5
    change = loss.value(theta.ravel() + step * direction) - loss.value(theta.ravel() - step * direction)
    assert gradient @ direction == pytest.approx(change / (2 * step), rel=1e-6)
    assert np.linalg.eigvalsh(H).min() > -1e-9 * np.abs(H).max()


def test_no_fit_is_better_than_the_splines() -> None:
    problem = infimum.cases()["planar_3r_xy, A = I"]
    chart = oc.fit(problem, oc.Polynomial(3), weights=infimum.WEIGHTS, samples=500).chart
    assert isinstance(problem.domain, oc.Box)
    coarse, fine = infimum.refined(problem, chart, (1, 2))
    assert fine < coarse < infimum.judged(problem, chart, infimum.Splines(problem.domain, 2))


def test_limit_of_a_geometric_sequence() -> None:
    limit, error = infimum.extrapolated([5 + 8.0, 5 + 4.0, 5 + 2.0])
    assert limit == pytest.approx(5)
    assert error == pytest.approx(2)


def test_limit_over_the_degree_is_that_of_a_geometric_sequence() -> None:
    degrees = np.arange(2.0, 6.0)
    limit, error = infimum.limit_over_degree(degrees, np.asarray(0.7 + 3 * 0.5**degrees, dtype=float))
    assert limit == pytest.approx(0.7, abs=0.01)
    assert error < 0.05


def test_staircase_leaks_less_than_any_even_coordinate_and_does_not_fold() -> None:
    """The loss sees directions of gradients only, so steep layers between cells let the leak fall to any value."""
    problem = problems.get("planar_3r_xy")
    chart, box = infimum.staircase(problem, 2), problem.domain
    assert oc.evaluate(chart, 20_000).leak.rms < 6.2  # polynomials of degree 8 end at 9.3
    inside = box.centre + box.half_width * np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    layer = np.where(np.random.default_rng(1).uniform(size=inside.shape) < 0.5, box.centre, inside)
    layer = layer + 2 * infimum.WIDTH * box.half_width * np.random.default_rng(2).normal(size=inside.shape)
    signs = np.sign(np.linalg.det(chart.jacobian(np.vstack([inside, layer]))))
    assert (signs == signs[0]).all()
