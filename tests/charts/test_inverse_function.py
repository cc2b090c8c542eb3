"""The inverse map as a CasADi function."""

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

import orthocas as oc


def test_inverse_function_has_first_and_second_derivatives(planar_arm: oc.Chart) -> None:
    """J^-1 for the first; differences of it for the second; the start does not matter."""
    n, inverse = planar_arm.n, planar_arm.function("inverse")
    q = planar_arm.problem.domain.centre + 0.2
    phi, start, weights = planar_arm.phi(q), planar_arm.problem.domain.centre, np.arange(1.0, n + 1)
    np.testing.assert_allclose(inverse(phi, start).full()[:, 0], q, atol=1e-10)
    p, s = ca.MX.sym("p", n), ca.MX.sym("s", n)
    value = inverse(p, s)
    first = ca.Function("first", [p, s], [ca.jacobian(value, p), ca.jacobian(value, s)])
    second = ca.Function("second", [p, s], [ca.hessian(ca.dot(weights, value), p)[0]])
    by_phi, by_start = (part.full() for part in first(phi, start))
    np.testing.assert_allclose(by_phi, np.linalg.inv(planar_arm.jacobian(q)), atol=1e-12)
    assert not by_start.any()

    def gradient(at: np.ndarray) -> np.ndarray:
        return weights @ np.linalg.inv(planar_arm.jacobian(planar_arm.inverse(at, q)))

    step = 1e-5
    differences = np.array([(gradient(phi + step * e) - gradient(phi - step * e)) / (2 * step) for e in np.eye(n)])
    np.testing.assert_allclose(second(phi, start).full(), differences, atol=1e-6)


def test_inverse_function_is_nan_where_it_finds_nothing(
    planar_arm: oc.Chart, capfd: pytest.CaptureFixture[str]
) -> None:
    inverse, centre = planar_arm.function("inverse"), planar_arm.problem.domain.centre
    assert np.isnan(inverse(planar_arm.phi(centre) + np.array([9.0, 0.0, 0.0]), centre).full()).all()
    assert capfd.readouterr() == ("", "")


def test_inverse_and_phi_give_the_same_optimum(planar_arm: oc.Chart) -> None:
    """The shortest joint path while the tool moves on a line: over xi with the inverse, and over q with phi."""
    start, knots = planar_arm.problem.domain.centre, 6
    line = planar_arm.x(start) + np.linspace(0, 1, knots)[:, None] * [0.05, -0.1]
    by_inverse, over_q = ca.Opti(), ca.Opti()
    xi = by_inverse.variable(knots)
    inverse, guess = planar_arm.function("inverse"), ca.DM(start)
    q = [inverse(ca.vertcat(line[k], xi[k]), guess) for k in range(knots)]
    by_inverse.minimize(sum(ca.sumsqr(b - a) for a, b in pairwise(q)))
    by_inverse.subject_to(xi[0] == planar_arm.xi(start)[0])
    by_inverse.set_initial(xi, planar_arm.xi(start)[0])
    Q = over_q.variable(3, knots)
    over_q.minimize(ca.sumsqr(Q[:, 1:] - Q[:, :-1]))
    for k in range(1, knots):
        over_q.subject_to(planar_arm.x(Q[:, k]) == line[k])
    over_q.subject_to(Q[:, 0] == start)
    over_q.set_initial(Q, np.tile(start[:, None], knots))
    lengths = []
    for problem in (by_inverse, over_q):
        problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
        lengths.append(problem.solve().value(problem.f))
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-7)
