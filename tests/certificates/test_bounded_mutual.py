"""The constrained form: Ipopt finds points of the front where the weighted loss has them, and says when it cannot."""

import numpy as np
import pytest
from charts import with_metric

import orthocas as oc
from orthocas import problems, solvers
from orthocas.bases import JointSpace
from orthocas.errors import InfeasibleError, InvalidValueError, SolveError
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.combined import BoundedMutual
from orthocas.fitting.terms import Weights
from orthocas.solvers.protocol import SolveResult, Status
from orthocas.tasks.samples import sample_problem


@pytest.fixture(scope="module")
def bounded() -> BoundedMutual:
    problem = problems.get("planar_3r_x")
    family = oc.Polynomial(2).family(JointSpace.of(problem), problem.r)
    samples = sample_problem(problem, 60, 3)
    weights = Weights(1000.0, 30.0, 100.0)
    return BoundedMutual(BasisObjective(family, samples, weights, family.initial(0), lambda n, s: samples), 0.05)


def theta_of(bounded: BoundedMutual) -> np.ndarray:
    return np.random.default_rng(4).normal(size=2 * 9)


def test_constraint_jacobian_matches_central_differences(bounded: BoundedMutual) -> None:
    theta, step = theta_of(bounded), 1e-6
    J = bounded.constraints(theta)[1]
    for k, e in enumerate(np.eye(len(theta))):
        ahead, behind = bounded.constraints(theta + step * e)[0], bounded.constraints(theta - step * e)[0]
        np.testing.assert_allclose(J[:, k], (ahead - behind) / (2 * step), atol=1e-6 * np.abs(J).max())


def test_hessian_of_the_lagrangian_matches_its_gradients(bounded: BoundedMutual) -> None:
    theta, multipliers, factor = theta_of(bounded), np.array([0.7, -1.3, 2.1]), 0.4

    def gradient(at: np.ndarray) -> np.ndarray:
        return factor * bounded.value_and_gradient(at)[1] + multipliers @ bounded.constraints(at)[1]

    direction = 1e-6 * np.random.default_rng(5).normal(size=theta.size)
    want = (gradient(theta + direction) - gradient(theta - direction)) / 2
    got = bounded.lagrangian_hessian(theta, factor, multipliers) @ direction
    np.testing.assert_allclose(got, want, atol=1e-7 * np.abs(want).max())


def test_gauge_makes_the_mean_squared_gradient_length_one(bounded: BoundedMutual) -> None:
    theta = bounded.normalise_gradients(theta_of(bounded))
    np.testing.assert_allclose(bounded.constraints(theta)[0][1:], 1.0, rtol=1e-12)
    J = bounded._task.coordinate_jacobians(theta)
    np.testing.assert_allclose((J**2).sum(axis=2).mean(axis=0), 1.0, rtol=1e-12)


@pytest.mark.slow
def test_bound_is_met_and_trades_against_the_task(iiwa: oc.Problem) -> None:
    fits = [oc.fit(iiwa, oc.Polynomial(2), samples=800, max_mutual_deg=bound) for bound in (1.0, 3.0)]
    reports = [oc.evaluate(fit.chart, 20_000) for fit in fits]
    for report, bound in zip(reports, (1.0, 3.0), strict=True):
        assert report.mutual_angle.std == pytest.approx(bound, rel=0.08)  # bound on training samples, held-out figure
    assert reports[0].task_angle.std > reports[1].task_angle.std


@pytest.mark.slow
def test_point_of_the_weighted_front_is_found_again(planar_x: oc.Problem) -> None:
    weighted = oc.evaluate(oc.fit(planar_x, oc.Polynomial(3), solvers.Ipopt()).chart, 20_000)
    angle = weighted.metric_mutual_angle  # what the bound is on for A = M
    deviation = np.hypot(angle.std, angle.mean - 90)  # root mean square
    fit = oc.fit(planar_x, oc.Polynomial(3), max_mutual_deg=deviation)
    constrained = oc.evaluate(fit.chart, 20_000)
    assert constrained.leak.rms <= 1.02 * weighted.leak.rms
    assert constrained.metric_mutual_angle.std <= 1.05 * angle.std


def test_bound_out_of_reach_is_reported_with_the_closest_value(planar_x: oc.Problem) -> None:
    """Two planes cannot stay orthogonal in the inertia metric, which turns with q."""
    few = solvers.Ipopt(max_iterations=60)
    with pytest.raises(SolveError, match=r"polynomial:1 .* within 0.01 deg .* the closest have \d.\d+ deg"):
        oc.fit(planar_x, oc.Polynomial(1), few, samples=200, max_mutual_deg=0.01)


def test_status_decides_between_infeasible_and_not_found(bounded: BoundedMutual) -> None:
    for status, error, words in (
        (Status.INFEASIBLE, InfeasibleError, "there are no"),
        (Status.ITERATION_LIMIT, SolveError, "found in 7 iterations"),
    ):
        result = SolveResult(theta_of(bounded), np.inf, status, 7, 7, 0.0)
        found = bounded.explain_missed_bound("polynomial:2", 0.05, result)
        assert type(found) is error
        assert words in str(found)
        assert "within 2.865 deg" in str(found)


@pytest.mark.slow
def test_degree_that_misses_the_bound_does_not_stop_the_next(planar_x: oc.Problem) -> None:
    """One iteration does not get degree 2 under the bound; degree 3 goes on from there."""

    class Hurried(solvers.Ipopt):
        def coarser(self) -> solvers.Ipopt:
            return solvers.Ipopt(max_iterations=1)

    # only with A = I are low degrees solved coarsely
    euclidean = with_metric(planar_x, "euclidean")
    fit = oc.fit(euclidean, oc.Polynomial(3), Hurried(), samples=300, max_mutual_deg=0.5)
    assert not np.isfinite(fit.stages[0].result.value)
    assert oc.evaluate(fit.chart, 5000).mutual_angle.std < 0.7


def test_bad_bounds_are_refused(planar_x: oc.Problem, planar_xy: oc.Problem) -> None:
    for bound in (0.0, 1e-320, -1.0, 90.0, float("nan")):
        with pytest.raises(InvalidValueError, match="max_mutual_deg"):
            oc.fit(planar_x, oc.Polynomial(1), max_mutual_deg=bound)
    with pytest.raises(InvalidValueError, match="two or more coordinates"):
        oc.fit(planar_xy, oc.Polynomial(1), max_mutual_deg=1.0)
    with pytest.raises(InvalidValueError, match="given with linear, expected a family with parameters to fit"):
        oc.fit(planar_x, oc.Linear(), max_mutual_deg=1.0)
    with pytest.raises(InvalidValueError, match="linear in its parameters"):
        oc.fit(planar_x, oc.MLP((4,)), max_mutual_deg=1.0)
    with pytest.raises(InvalidValueError, match="solver is lbfgs, expected ipopt"):
        oc.fit(planar_x, oc.Polynomial(2), solvers.LBFGS(), max_mutual_deg=1.0)
