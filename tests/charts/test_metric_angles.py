"""The loss in the metric against a formula by hand, its invariance, and where it is the default."""

from itertools import combinations
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from charts import with_metric
from programs import Run

import orthocas as oc
from orthocas import problems, solvers
from orthocas.bases import JointSpace, Parametrisation
from orthocas.errors import UnknownNameError
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.loss import loss
from orthocas.fitting.network_objective import GraphObjective
from orthocas.fitting.terms import Weights
from orthocas.tasks.samples import Samples, sample_evenly, sample_problem

IN_METRIC = Weights(1000.0, 30.0, 0.0, angles="metric")


def loss_by_hand(samples: Samples, J_xi: np.ndarray, weights: Weights) -> float:
    """Mean of sin^2 of angles in coordinates where the metric is the identity, over samples (N, r, n)."""
    total = 0.0
    for k, gradients in enumerate(J_xi):
        B = np.eye(J_xi.shape[2]) if samples.metric_inverse is None else samples.metric_inverse[k]
        L = np.linalg.cholesky(B)
        unit = gradients @ L / np.linalg.norm(gradients @ L, axis=1, keepdims=True)
        Q = np.linalg.qr((samples.task_jacobian[k] @ L).T)[0]  # (n, m)
        m, r = Q.shape[1], len(unit)
        total += weights.task / (2 * m * r) * ((unit @ Q) ** 2).sum()
        pairs = list(combinations(range(r), 2))
        total += weights.mutual / 2 * sum((unit[i] @ unit[j]) ** 2 for i, j in pairs) / max(1, len(pairs))
    return total / len(J_xi)


@pytest.mark.parametrize("name", ["planar_x", "planar_xy", "iiwa"])
def test_both_objectives_equal_the_formula_written_out(request: pytest.FixtureRequest, name: str) -> None:
    problem = request.getfixturevalue(name)
    samples, family = sample_problem(problem, 60, 9), oc.Polynomial(2).family(JointSpace.of(problem), problem.r)
    theta = family.initial(3)
    linear, graph = (kind(family, samples, IN_METRIC, theta, None) for kind in (BasisObjective, GraphObjective))
    want = loss_by_hand(samples, linear.coordinate_jacobians(theta), IN_METRIC)
    np.testing.assert_allclose(linear.value(theta), want, rtol=1e-12)
    np.testing.assert_allclose(graph.value(theta), want, rtol=1e-12)


def mixed(problem: oc.Problem) -> oc.Problem:
    """The same task in other coordinates: a shear and another unit."""
    shear, robot = ca.DM([[1.0, 0.8], [0.0, 0.1]]), problem.robot
    task = oc.Task.custom(robot, "mixed", lambda q: shear @ robot.tip_position(q)[:2])
    return oc.Problem(robot, task, "inertia", problem.domain, "mixed")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parametrisation", "solver"),
    [(oc.Polynomial(3), None), (oc.MLP((5,)), solvers.LBFGS(max_iterations=30))],
    ids=["polynomial", "network"],
)
def test_fit_does_not_depend_on_task_coordinates(
    planar_xy: oc.Problem, parametrisation: Parametrisation, solver: object
) -> None:
    points = sample_evenly(planar_xy.domain, 50, 2)

    def gradients(angles: str) -> list[np.ndarray]:
        weights = Weights(angles=angles)
        fits = [oc.fit(p, parametrisation, solver, weights=weights, samples=300) for p in (planar_xy, mixed(planar_xy))]
        return [fit.chart.coordinates.jacobian(points) for fit in fits]

    first, second = gradients("metric")
    np.testing.assert_allclose(second, first, atol=1e-5)
    first, second = gradients("paper")
    assert np.abs(second - first).max() > 1e-2


@pytest.mark.slow
def test_it_lowers_the_leak_and_the_paper_s_loss_the_paper_s_angle(planar_xy: oc.Problem) -> None:
    paper, metric = (
        oc.evaluate(oc.fit(planar_xy, oc.Polynomial(4), weights=Weights(angles=angles)).chart, 5000)
        for angles in ("paper", "metric")
    )
    assert metric.leak.rms < 0.7 * paper.leak.rms
    assert paper.task_angle.std < 0.7 * metric.task_angle.std


@pytest.mark.slow
def test_default_is_the_metric_for_the_mass_matrix_and_orientations(planar_x: oc.Problem) -> None:
    custom = lambda q: ca.diag(2 + ca.cos(q))  # noqa: E731
    for metric, angles in (
        ("inertia", "metric"),
        ("euclidean", "paper"),
        (np.diag([1.0, 2.0, 3.0]), "paper"),
        (custom, "paper"),
    ):
        problem = with_metric(planar_x, metric)
        assert oc.fit(problem, oc.Polynomial(1), samples=50).chart.notes["angles"] == angles
        assert Weights().for_problem(problem).angles == angles
        assert Weights(angles="paper").for_problem(problem).angles == "paper"
    arm = problems.get("iiwa").robot
    for kind, angles in (("position", "paper"), ("pose", "metric"), ("axis:x", "metric")):
        problem = oc.Problem(arm, oc.Task.named(arm, kind, np.full(7, 0.4)), domain=oc.Box(np.full(7, 0.4), 0.1))
        assert Weights().for_problem(problem).angles == angles
    theta = np.random.default_rng(0).normal(size=18)
    by_default, in_metric, paper = (
        float(loss(planar_x, oc.Polynomial(2), samples=30, weights=weights, start=theta)(theta))
        for weights in (Weights(), Weights(angles="metric"), Weights(angles="paper"))
    )
    assert by_default == in_metric != paper


@pytest.mark.slow
def test_bound_on_mutual_angles_is_one_in_the_metric(planar_x: oc.Problem) -> None:
    fit = oc.fit(planar_x, oc.Polynomial(2), samples=400, max_mutual_deg=1.0, weights=Weights(angles="metric"))
    angle = oc.evaluate(fit.chart, 5000).metric_mutual_angle
    assert np.hypot(angle.std, angle.mean - 90) == pytest.approx(1.0, rel=0.1)


def test_unknown_angles_are_refused_in_python_and_on_the_command_line(run: Run) -> None:
    with pytest.raises(UnknownNameError, match="angles"):
        Weights(angles="euclidean")
    code, out, err = run("fit", "planar_3r_x", "--angles", "euclidean", "--out", "a.orthocas")
    assert (code, out) == (2, "")
    assert "paper, metric" in err or "metric, paper" in err
    assert not Path("a.orthocas").exists()


@pytest.mark.slow
def test_command_line_fits_with_the_paper_s_angles(run: Run) -> None:
    words = ("fit", "planar_3r_x", "--param", "polynomial:2", "--samples", "100", "--force", "--out", "a.orthocas")
    for more, angles in (((), "metric"), (("--angles", "paper"), "paper")):
        code, _, err = run(*words, *more)
        assert code == 0, err
        assert oc.load("a.orthocas").notes["angles"] == angles
