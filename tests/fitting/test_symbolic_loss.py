"""The loss as one CasADi function, as oracle of the fast objectives: value, gradient and Hessian to rounding."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import orthocas as oc
from orthocas.bases import JointSpace, Parametrisation
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.loss import loss
from orthocas.fitting.network_objective import GraphObjective
from orthocas.tasks.samples import evaluate_samples, sample_evenly

EVERY_TERM = oc.Weights(length=3.0, angles="paper")
CASES = [
    ("planar_x", oc.Polynomial(2)),
    ("planar_xy", oc.Fourier(1)),
    ("iiwa", oc.Polynomial(1)),
    ("planar_x", oc.MLP((8,))),
    ("iiwa", oc.MLP((4, 3))),
]


@pytest.mark.parametrize("angles", ["paper", "metric"])
@pytest.mark.parametrize(("name", "parametrisation"), CASES, ids=lambda case: getattr(case, "label", case))
def test_fast_objectives_have_its_value_and_gradient(
    request: pytest.FixtureRequest, name: str, parametrisation: Parametrisation, angles: str
) -> None:
    weights = replace(EVERY_TERM, angles=angles)
    problem = request.getfixturevalue(name)
    points = sample_evenly(problem.domain, 40, 1)
    family = parametrisation.family(JointSpace.of(problem), problem.r)
    theta = family.initial(3)
    fast = BasisObjective if parametrisation.linear else GraphObjective
    value, gradient = fast(family, evaluate_samples(problem, points), weights, theta, None).value_and_gradient(theta)
    L = loss(problem, parametrisation, weights=weights, samples=points, start=theta)
    x = ca.MX.sym("x", family.size)
    slope = ca.Function("slope", [x], [ca.gradient(L(x), x)])
    np.testing.assert_allclose(float(L(theta)), value, rtol=1e-12)
    np.testing.assert_allclose(slope(theta).full().ravel(), gradient, atol=1e-11 * np.abs(gradient).max())


def test_hessian_of_a_basis_is_the_fast_one(planar_x: oc.Problem) -> None:
    points = sample_evenly(planar_x.domain, 40, 1)
    family = oc.Polynomial(2).family(JointSpace.of(planar_x), 2)
    theta = family.initial(3)
    L = loss(planar_x, oc.Polynomial(2), weights=EVERY_TERM, samples=points, start=theta)
    x = ca.MX.sym("x", family.size)
    H = ca.Function("H", [x], [ca.hessian(L(x), x)[0]])(theta).full()
    fast = BasisObjective(family, evaluate_samples(planar_x, points), EVERY_TERM, theta, None).hessian(theta)
    np.testing.assert_allclose(H, fast, atol=1e-12 * np.abs(fast).max())


def test_hessian_of_a_network_is_that_of_differences_and_ipopt_takes_it(planar_xy: oc.Problem) -> None:
    """A network of 22 parameters: second derivatives by CasADi, taken by Ipopt."""
    L = loss(planar_xy, oc.MLP((3,)), samples=60, seed=2)
    theta = np.random.default_rng(5).normal(size=L.size1_in(0))
    x = ca.MX.sym("x", theta.size)
    slope, H = ca.Function("s", [x], [ca.gradient(L(x), x)]), ca.Function("H", [x], [ca.hessian(L(x), x)[0]])
    direction = 1e-5 * np.random.default_rng(6).normal(size=theta.size)
    ahead, behind = (slope(theta + sign * direction).full().ravel() for sign in (1, -1))
    want = H(theta).full() @ direction
    np.testing.assert_allclose((ahead - behind) / 2, want, atol=1e-6 * np.abs(want).max())
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 40}
    solver = ca.nlpsol("solver", "ipopt", {"x": x, "f": L(x)}, options)
    found = solver(x0=theta)
    assert solver.stats()["n_call_nlp_hess_l"] > 10  # not the limited-memory approximation
    assert float(found["f"]) < 0.1 * float(L(theta))


def test_drawn_samples_are_seeded_and_bad_settings_are_refused(planar_x: oc.Problem) -> None:
    theta = np.random.default_rng(0).normal(size=18)
    values = [float(loss(planar_x, oc.Polynomial(2), samples=30, seed=seed)(theta)) for seed in (1, 1, 2)]
    assert values[0] == values[1] != values[2]
    with pytest.raises(InvalidValueError, match="parametrisation"):
        loss(planar_x, "polynomial:2")  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="start"):
        loss(planar_x, oc.Polynomial(2), start=np.zeros(3))
    with pytest.raises(ShapeError, match="samples"):
        loss(planar_x, oc.Polynomial(2), samples=np.zeros((4, 2)))
