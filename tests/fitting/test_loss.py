"""The loss against a plain NumPy reading of (24), its gradients by Taylor slopes, and its rank trap."""

from itertools import product

import casadi as ca
import numpy as np
import pytest

import orthocas as oc
from orthocas.bases import JointSpace
from orthocas.cli.options import parse_weights
from orthocas.errors import InvalidValueError
from orthocas.fitting import network_objective
from orthocas.fitting.basis_objective import (
    BasisGradients,
    BasisObjective,
    ObjectiveRules,
    ProductGradients,
    SparseGradients,
    build_gradients,
)
from orthocas.fitting.network_objective import ArrayObjective, GraphObjective
from orthocas.fitting.sample_loss import (
    Loss,
    build_loss_columns,
    build_loss_with_slopes,
    build_residual_columns,
    build_sample_loss,
    build_value_columns,
)
from orthocas.fitting.starts import find_spectral_start
from orthocas.fitting.terms import (
    RULES,
    MutualTerm,
    Sizes,
    TaskTerm,
    UnitGradients,
    Weights,
    gradient_volume,
    pairs,
    volume_hinges,
)
from orthocas.tasks.metric import MetricSpec
from orthocas.tasks.samples import Draw, Samples, evaluate_samples, sample_problem
from orthocas.tools import columns
from orthocas.tools.expressions import compute_determinant

WEIGHTS = Weights.of((1000.0, 30.0))
REGULAR = Weights(1000.0, 30.0, 120.0)
EVEN = Weights(1000.0, 30.0, 120.0, 3.0)


def loss_by_hand(J_x: np.ndarray, J_xi: np.ndarray, B: np.ndarray, weights: Weights, sign: float) -> float:
    """Equation (24) at one sample, written out, and the regularity term in coordinates where the metric is I."""
    m, r = len(J_x), len(J_xi)
    total = 0.0
    for i, j in product(range(m), range(r)):
        cosine = J_x[i] @ B @ J_xi[j] / (np.linalg.norm(B @ J_x[i]) * np.linalg.norm(J_xi[j]))
        total += weights.task / (2 * m * r) * cosine**2
    for i, j in product(range(r), range(r)):
        if i > j:
            cosine = J_xi[i] @ B @ J_xi[j] / (np.linalg.norm(B @ J_xi[i]) * np.linalg.norm(J_xi[j]))
            total += weights.mutual / (2 * (r * (r - 1) / 2)) * cosine**2
    L = np.linalg.cholesky(B)
    white_task, white = J_x @ L, J_xi @ L
    white /= np.linalg.norm(white, axis=1, keepdims=True)
    across = np.linalg.svd(white_task)[2][m:]  # orthonormal complement of the task gradients
    across[-1] *= np.sign(np.linalg.det(np.vstack([white_task, across])))
    volume = sign * np.linalg.det(white @ across.T)
    total += weights.length / (2 * r) * (np.log(np.linalg.norm(J_xi, axis=1)) ** 2).sum()
    return float(total + weights.regularity / 2 * max(RULES.regular_volume - volume, 0) ** 2)


def draw_from(problem: oc.Problem) -> Draw:
    return lambda count, seed: sample_problem(problem, count, seed)


def objectives(
    problem: oc.Problem, parametrisation: oc.Polynomial, weights: Weights = WEIGHTS
) -> tuple[BasisObjective, GraphObjective, Samples]:
    samples = sample_problem(problem, 60, 9)
    family = parametrisation.family(JointSpace.of(problem), problem.r)
    theta = family.initial(3)
    settings = (family, samples, weights, theta, draw_from(problem))
    return BasisObjective(*settings), GraphObjective(*settings), samples


@pytest.fixture(params=["planar_x", "planar_xy", "iiwa"])
def problem(request: pytest.FixtureRequest) -> oc.Problem:
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("weights", [WEIGHTS, REGULAR, EVEN], ids=["paper", "regular", "even"])
def test_both_objectives_equal_the_formula_written_out(problem: oc.Problem, weights: Weights) -> None:
    linear, graph, samples = objectives(problem, oc.Polynomial(2), weights)
    theta = linear.family.initial(3)
    inverse = samples.metric_inverse
    B = np.broadcast_to(np.eye(problem.n), (len(samples), problem.n, problem.n)) if inverse is None else inverse
    J_xi = linear.coordinate_jacobians(theta)
    sign = np.sign(np.median(np.linalg.det(J_xi @ samples.null_basis)))
    want = np.mean([loss_by_hand(*row, weights, sign) for row in zip(samples.task_jacobian, J_xi, B, strict=True)])
    np.testing.assert_allclose(linear.value(theta), want, rtol=1e-12)
    np.testing.assert_allclose(graph.value(theta), want, rtol=1e-12)


def test_gradients_of_both_objectives_agree(problem: oc.Problem) -> None:
    linear, graph, _ = objectives(problem, oc.Polynomial(2), EVEN)
    theta = linear.family.initial(3)
    np.testing.assert_allclose(linear.value_and_gradient(theta)[1], graph.value_and_gradient(theta)[1], atol=1e-9)
    np.testing.assert_allclose(linear.normal_equations(theta)[1], graph.value_and_gradient(theta)[1], atol=1e-9)


@pytest.mark.slow
def test_hessian_is_the_derivative_of_the_gradient(problem: oc.Problem) -> None:
    linear, _, _ = objectives(problem, oc.Polynomial(2), REGULAR)
    theta = linear.family.initial(3)
    direction = 1e-6 * np.random.default_rng(8).normal(size=theta.size)
    ahead, behind = (linear.value_and_gradient(theta + sign * direction)[1] for sign in (1, -1))
    H = linear.hessian(theta)
    np.testing.assert_allclose(H @ direction, (ahead - behind) / 2, atol=1e-8 * np.abs(H @ direction).max())
    np.testing.assert_allclose(H, H.T, atol=1e-12 * np.abs(H).max())


def test_weights_split_the_loss_into_its_terms(problem: oc.Problem) -> None:
    linear, _, _ = objectives(problem, oc.Polynomial(2), REGULAR)
    theta = linear.family.initial(3)
    terms = [linear.reweigh(Weights(*w)) for w in ((1000.0, 0.0, 0.0), (0.0, 30.0, 0.0), (1000.0, 0.0, 120.0))]
    task, mutual, regular = (term.value(theta) for term in terms)
    np.testing.assert_allclose(regular + mutual, linear.value(theta), rtol=1e-12)
    assert task < regular


@pytest.mark.slow
def test_fresh_batches_are_new_samples_of_the_same_loss(problem: oc.Problem) -> None:
    for objective in objectives(problem, oc.Polynomial(2), REGULAR)[:2]:
        theta = oc.Polynomial(2).family(JointSpace.of(problem), problem.r).initial(3)
        first, second = ([part.value(theta) for part in objective.batches(400, 3, (seed,))] for seed in (0, 1))
        assert len(first) == 3
        assert len({*first, *second}) == 6
        assert first == [part.value(theta) for part in objective.batches(400, 3, (0,))]
        many = np.mean([part.value(theta) for part in objective.batches(400, 10, (2,))])
        whole = next(iter(objective.batches(4000, 1, (3,)))).value(theta)
        np.testing.assert_allclose(many, whole, rtol=0.1)  # both means over thousands of samples


def test_graph_cut_into_blocks_gives_the_same_loss(planar_x: oc.Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    family = oc.MLP((6, 5)).family(JointSpace.of(planar_x), 2)
    settings = (family, sample_problem(planar_x, 50, 2), REGULAR, family.initial(1), draw_from(planar_x))
    value, gradient = GraphObjective(*settings).value_and_gradient(family.initial(1))
    monkeypatch.setattr(
        network_objective, "RULES", ObjectiveRules(graph=7 * 2 * family.width)
    )  # blocks of 7, 1 left over
    blocked = GraphObjective(*settings)
    assert len(blocked._blocks) == 8
    np.testing.assert_allclose(blocked.value_and_gradient(family.initial(1))[0], value, rtol=1e-13)
    np.testing.assert_allclose(blocked.value_and_gradient(family.initial(1))[1], gradient, atol=1e-11)


NETWORKS = [oc.MLP((7,)), oc.MLP((6, 5, 4)), oc.MLP((6, 5, 4), raw=True, activation="isru")]


@pytest.mark.parametrize("network", NETWORKS, ids=lambda p: p.label)
def test_arrays_of_a_network_agree_with_its_graph(problem: oc.Problem, network: oc.MLP) -> None:
    """Derivatives by hand against CasADi's, for 40 samples and for 260 in pieces of 130; single precision to 1e-5."""
    family = network.family(JointSpace.of(problem), problem.r)
    theta = family.initial(1)
    for count in (40, 260):
        settings = (family, sample_problem(problem, count, 2), EVEN, theta, draw_from(problem))
        value, gradient = GraphObjective(*settings).value_and_gradient(theta)
        for single, error in ((False, 1e-12), (True, 1e-5)):
            ours = ArrayObjective(*settings, single)
            found, slopes = ours.value_and_gradient(theta)
            np.testing.assert_allclose([found, ours.value(theta)], value, rtol=error)
            np.testing.assert_allclose(slopes, gradient, rtol=0, atol=error * np.abs(gradient).max())


@pytest.mark.parametrize("rest", [{}, {"cyclic": ["a", "c"]}, {"without": ["b"]}, {"cyclic": ["c"], "without": ["a"]}])
def test_arrays_of_other_joints_agree_with_their_graph(rest: dict[str, list[str]]) -> None:
    """A prismatic joint, joints that enter linearly, and joints that do not enter; combinations of outputs, too."""
    space = JointSpace(np.zeros(3), np.ones(3), (False, True, False), ("a", "b", "c"))
    family, rng = oc.MLP((5, 4), **rest).family(space, 2), np.random.default_rng(1)  # type: ignore[arg-type]
    theta, points, weights = rng.normal(size=family.size), rng.normal(size=(6, 3)), rng.normal(size=(6, 2, 3))
    q, p = ca.MX.sym("q", 3, 6), ca.MX.sym("theta", family.size)
    gradients = family.jacobian(q, p)
    weighted = sum(ca.dot(ca.DM(weights[:, j].T), gradients[j]) for j in range(2))
    wanted, slopes = (np.array(part) for part in _split(q, p, gradients, ca.gradient(weighted, p))(points.T, theta))
    J, back = family.pullback(points, theta)
    np.testing.assert_allclose(J, wanted.reshape(2, 3, 6).transpose(2, 0, 1), atol=1e-14)
    np.testing.assert_allclose(back(weights, np.empty(family.size)), slopes[:, 0], atol=1e-12)
    B = rng.normal(size=(2, 2))
    mixed = family.pullback(points, family.combined(theta, B))[0]
    np.testing.assert_allclose(mixed, B @ J, atol=1e-13)


def _split(q: ca.MX, p: ca.MX, gradients: list[ca.MX], slopes: ca.MX) -> ca.Function:
    return ca.Function("both", [q, p], [ca.vertcat(*gradients), slopes])


def test_single_precision_of_a_basis_changes_the_last_digits(problem: oc.Problem) -> None:
    family = oc.Polynomial(3).family(JointSpace.of(problem), problem.r)
    theta, gradients = family.initial(3), build_gradients(family, problem.n, np.float32)
    settings = (family, sample_problem(problem, 300, 9), EVEN, theta, draw_from(problem))
    double, single = BasisObjective(*settings), BasisObjective(*settings, gradients=gradients)
    assert 2 * single.X.nbytes == double.X.nbytes
    value, gradient, H = double.normal_equations(theta)
    found, slopes, matrix = single.normal_equations(theta)
    assert 0 < abs(found / value - 1) < 1e-5
    np.testing.assert_allclose(slopes, gradient, rtol=0, atol=1e-5 * np.abs(gradient).max())
    np.testing.assert_allclose(matrix, H, rtol=0, atol=1e-4 * np.abs(H).max())


@pytest.mark.parametrize("parametrisation", [oc.Polynomial(2), oc.Fourier(1), oc.MLP((6,))], ids=lambda p: p.label)
def test_taylor_remainder_falls_with_the_square_of_the_step(planar_x: oc.Problem, parametrisation: object) -> None:
    family = parametrisation.family(JointSpace.of(planar_x), planar_x.r)
    objective = GraphObjective(family, sample_problem(planar_x, 40, 2), REGULAR, family.initial(1), draw_from(planar_x))
    theta = family.initial(1)
    direction = np.random.default_rng(2).normal(size=family.size)
    value, gradient = objective.value_and_gradient(theta)
    steps = np.array([1e-3, 1e-4, 1e-5]) / np.linalg.norm(direction)
    remainders = [abs(objective.value(theta + s * direction) - value - s * gradient @ direction) for s in steps]
    slopes = np.diff(np.log(remainders)) / np.diff(np.log(steps))
    np.testing.assert_allclose(slopes, 2.0, atol=0.15)


def test_gauss_newton_matrix_is_that_of_the_residuals(planar_x: oc.Problem) -> None:
    # every second is used
    twice = evaluate_samples(planar_x, np.repeat(sample_problem(planar_x, 40, 9).points, 2, axis=0))
    family = oc.Polynomial(2).family(JointSpace.of(planar_x), 2)
    theta = family.initial(3)
    objective = BasisObjective(family, twice, REGULAR, theta, draw_from(planar_x))
    loss = Loss.of(Sizes(n=3, m=1, r=2, identity_metric=False), REGULAR.by_name)
    J, data = loss.arguments()
    rho = ca.Function("rho", [J, *data], [loss.residuals(J, data)])
    parts = twice.collect_data(loss.data, twice.orientation(objective.coordinate_jacobians(theta)))

    def residuals(theta: np.ndarray) -> np.ndarray:
        rows = zip(objective.coordinate_jacobians(theta), *parts, strict=True)
        return np.array([rho(*row).full() for row in rows]).ravel()

    assert (residuals(theta).reshape(80, -1)[:, -1] > 0).any()  # the regularity residual takes part
    step = 1e-6
    jacobian = np.array(
        [(residuals(theta + step * e) - residuals(theta - step * e)) / (2 * step) for e in np.eye(len(theta))]
    )
    want = jacobian @ jacobian.T / objective.N
    _, _, H = objective.normal_equations(theta)
    np.testing.assert_allclose(H, want, atol=2e-6 * np.abs(want).max())  # products are in single precision


def test_loss_does_not_see_the_scale_of_coordinates(planar_x: oc.Problem) -> None:
    objective, _, _ = objectives(planar_x, oc.Polynomial(2))
    theta = objective.family.initial(3)
    scaled = (theta.reshape(2, -1) * np.array([[5.0], [0.1]])).ravel()
    np.testing.assert_allclose(objective.value(scaled), objective.value(theta), rtol=1e-12)


def test_cosines_vanish_for_hand_derived_coordinate_of_planar_2r() -> None:
    """At q1 = pi/2, x = cos q1 + cos(q1 + q2) has J_x = -(1 + cos q2, cos q2): orthogonal to (cos q2, -1 - cos q2)."""
    c = np.cos(0.7)
    task = ca.SX(ca.DM([[-(1 + c), -c]]) / np.hypot(1 + c, c))
    data, sizes = {"unit_task_gradients": task}, Sizes(2, 1, 1, True)
    cosines = TaskTerm().residuals(ca.SX(ca.DM([[c, -(1 + c)]])), data, sizes)
    np.testing.assert_allclose(float(ca.evalf(cosines)), 0, atol=1e-15)
    np.testing.assert_allclose(float(ca.evalf(TaskTerm().residuals(task * 3, data, sizes))), 1.0)


def test_pairs_are_ordered_like_the_paper_sum() -> None:
    assert pairs(1) == []
    assert pairs(3) == [(1, 0), (2, 0), (2, 1)]


def test_single_coordinate_has_no_mutual_cosine() -> None:
    assert MutualTerm().residuals(ca.SX.ones(1, 3), {}, Sizes(3, 2, 1, True)).shape == (0, 1)


def test_bad_weights_are_refused(planar_x: oc.Problem) -> None:
    for weights in ((0.0, 1.0), (-1.0, 1.0), (1.0, float("nan")), (1.0, -2.0)):
        with pytest.raises(InvalidValueError, match="lambda"):
            oc.fit(planar_x, oc.Polynomial(1), weights=weights)


@pytest.mark.slow
def test_rank_trap_at_the_papers_weights_is_reported(iiwa: oc.Problem) -> None:
    """With lambda2 / lambda1 = 1/1000 two coordinates become nearly parallel: good task angles, no chart."""
    good = oc.evaluate(oc.fit(iiwa, oc.Polynomial(3)).chart, samples=5000)
    trapped = oc.evaluate(oc.fit(iiwa, oc.Polynomial(3), weights=(1000.0, 1.0)).chart, samples=5000)
    assert trapped.task_angle.std < good.task_angle.std
    assert trapped.mutual_angle.std > 3 * good.mutual_angle.std
    assert trapped.conditioning.p01 < 0.1 < good.conditioning.p01
    assert trapped.degenerate
    assert not good.degenerate


def test_spectral_start_finds_an_exact_linear_coordinate() -> None:
    """Task q1 + 2 q2 with A = I: the plane direction (2, -1) is orthogonal to it everywhere."""
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "sum", lambda q: q[0] + 2 * q[1])
    problem = oc.Problem(robot, task, domain=oc.Box([0.0, 0.0], 1.0))
    family = oc.Polynomial(2).family(JointSpace.of(problem), 1)
    theta = find_spectral_start(family, sample_problem(problem, 100, 0))
    objective = BasisObjective(family, sample_problem(problem, 100, 1), WEIGHTS, theta, draw_from(problem))
    directions = objective.coordinate_jacobians(theta)[:, 0]
    np.testing.assert_allclose(directions @ np.array([1.0, 2.0]), 0, atol=1e-6 * np.abs(directions).max())


def test_batches_share_out_what_is_left_of_dropped_samples() -> None:
    """The task gradient vanishes on half of the box: fewer samples, but as many parts, on the same graph."""
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "half", lambda q: ca.fmax(q[0], 0) ** 2)
    problem = oc.Problem(robot, task, domain=oc.Box([0.0, 0.0], 1.0))
    family = oc.MLP((3,)).family(JointSpace.of(problem), 1)
    theta = family.initial(0)
    objective = GraphObjective(family, sample_problem(problem, 64, 1), WEIGHTS, theta, draw_from(problem))
    for seed in range(5):
        parts = list(objective.batches(20, 4, (seed,)))
        assert len(parts) == 4
        assert all(np.isfinite(part.value(theta)) for part in parts)
    assert {columns for _, columns in objective._graphs} <= {20, len(sample_problem(problem, 64, 1))}


def test_weights_of_a_command_line_have_terms_by_name() -> None:
    """Numbers stand for the terms in order; without any, those of the package keep their defaults."""
    assert parse_weights("1000,30, calm=3", None) == Weights(1000, 30, 0, 0, 0, {"calm": 3.0})
    assert parse_weights("calm=5", "metric") == Weights(extra={"calm": 5.0}, angles="metric")


@pytest.mark.parametrize("rows", [1, 2, 5, 6, 7, 8])
def test_determinants_and_their_gradients_are_those_of_numpy(rows: int) -> None:
    """The gradient is det A times the transposed inverse."""
    A = ca.SX.sym("A", rows, rows)
    value = compute_determinant(A)
    function = ca.Function("det", [A], [value, ca.gradient(value, A)])
    given = np.random.default_rng(7).normal(size=(rows, rows))
    found, gradient = function(given)
    wanted = np.linalg.det(given)
    assert float(found) == pytest.approx(wanted, rel=1e-12)
    np.testing.assert_allclose(np.asarray(gradient), wanted * np.linalg.inv(given).T, rtol=1e-9, atol=1e-12)
    assert function.n_instructions() < 100 + 60 * rows * 2 ** (rows - 1)  # CasADi's own: 10^7 for 10 rows


def many_joints(n: int, metric: MetricSpec = "euclidean") -> oc.Problem:
    robot = oc.Robot.planar([1.0] * n, [1.0] * n)
    return oc.Problem(robot, oc.Task.position(robot, "xy"), metric, oc.Box([0.1, *[0.4] * (n - 1)], 0.2))


@pytest.mark.slow
def test_eleven_joints_are_fitted() -> None:
    """Nine coordinates: with r! terms in the determinant of the regularity, this did not end."""
    fit = oc.fit(many_joints(11), oc.Polynomial(1), samples=200)
    assert fit.chart.r == 9
    assert fit.worst is not None
    assert fit.worst.least > 0.1


@pytest.mark.parametrize("form", [ProductGradients, SparseGradients])
@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_blocks_by_arrays_are_those_of_the_whole_matrix(form: type[BasisGradients], metric: MetricSpec) -> None:
    """Squares of residuals by arrays, and small sums of them, against expressions of all residuals.

    Matrices are computed in single precision.
    """
    problem = many_joints(10, metric)
    family = oc.Polynomial(2).family(JointSpace.of(problem), problem.r)
    samples, weights = sample_problem(problem, 200, 0), oc.Weights().for_problem(problem)
    theta = np.random.default_rng(1).normal(size=family.size)
    gradients = form(family, problem.n)
    objective = BasisObjective(family, samples, weights, theta, draw_from(problem), gradients=gradients)
    whole, blocks = objective._build_matrix(theta, 1), objective._build_by_arrays(theta, 1)
    assert len(blocks) == problem.r
    for j, block in enumerate(blocks):
        place = slice(j * family.width, (j + 1) * family.width)
        np.testing.assert_allclose(block, whole[place, place], rtol=0, atol=1e-5 * np.abs(whole[place, place]).max())


@pytest.mark.slow
def test_thirteen_coordinates_are_fitted() -> None:
    fit = oc.fit(many_joints(15), oc.Polynomial(1), samples=200)
    assert fit.chart.r == 13
    assert fit.worst is not None
    assert fit.worst.least > 0.1


def test_expressions_of_too_many_coordinates_name_the_size() -> None:
    loss = Loss.of(Sizes(15, 2, 13, True), {"regularity": 1.0})
    with pytest.raises(
        InvalidValueError, match="number of extra coordinates r is 13, expected at most 12 with the terms"
    ):
        build_sample_loss(loss)


@pytest.mark.parametrize("identity", [True, False])
def test_volumes_by_lapack_are_those_of_the_expression(identity: bool) -> None:
    """Values and slopes of hinges at regular, folded and exactly singular samples."""
    N, n, r = 12, 6, 4
    rng = np.random.default_rng(3)
    J, Z = rng.normal(size=(N, r, n)), np.linalg.qr(rng.normal(size=(N, n, r)))[0]
    J[0, 1] = J[0, 0]  # no volume at all
    J[1] = Z[1].T  # the largest one: no hinge for A = I
    J[2, 1] = J[2, 0] + 1e-6  # next to a fold
    root = rng.normal(size=(N, n, n))
    A = None if identity else root @ root.transpose(0, 2, 1) + np.eye(n)
    units = UnitGradients.of(J, A)
    hinges, slopes = volume_hinges(units, Z, 0.9)
    slopes = units.pull_back(slopes)
    symbol = ca.SX.sym("J", r, n)
    for k in range(N):
        volume = gradient_volume(symbol, ca.DM(Z[k]), None if A is None else ca.DM(A[k]))
        hinge = ca.fmax(0.9 - volume, 0)
        function = ca.Function("hinge", [symbol], [hinge, ca.gradient(hinge, symbol)])
        value, slope = function(J[k])
        assert hinges[k] == pytest.approx(float(value), abs=1e-12)
        np.testing.assert_allclose(slopes[k], np.asarray(slope), atol=1e-10)
    assert hinges[0] == pytest.approx(0.9)
    assert hinges[1] == 0 or not identity


@pytest.mark.slow
@pytest.mark.parametrize(("angles", "identity", "by_arrays"), [("", False, 2), ("metric ", False, 4), ("", True, 4)])
def test_loss_by_arrays_is_the_loss(angles: str, identity: bool, by_arrays: int) -> None:
    """The parts written out and by arrays together, with exchanged components, against one expression."""
    sizes, N = Sizes(11, 3, 8, identity), 300
    weights = {f"{angles}task": 10.0, f"{angles}mutual": 3.0, "regularity": 5.0, "folds": 7.0}
    loss = Loss.of(sizes, weights, ((1, 4),))
    assert len(loss.volume_terms) == 2
    assert len(loss.array_terms) == by_arrays
    rng = np.random.default_rng(0)
    data = [rng.normal(size=(N, *symbol.shape)) for symbol in loss.arguments()[1]]
    if not identity:
        place = loss.data.index("metric_inverse")
        data[place] = data[place] @ data[place].transpose(0, 2, 1) + np.eye(sizes.n)
    inputs = [columns.arrange_blocks(rng.normal(size=(N, sizes.r, sizes.n))), *map(columns.arrange_blocks, data)]
    value, slopes = build_loss_with_slopes(loss)(*inputs)
    for found, wanted in zip(build_loss_columns(loss)(*inputs), (value, slopes), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-13 * np.abs(wanted).max())
    np.testing.assert_allclose(build_value_columns(loss)(*inputs)[0], value, rtol=1e-11)
    *rows, first, _, second, _ = build_residual_columns(loss)(*inputs)
    assert len(rows) == sizes.r
    only = Loss.of(sizes, {"regularity": 5.0, "folds": 7.0}, ((1, 4),))
    (volumes,) = build_value_columns(only)(inputs[0], *(inputs[1 + loss.data.index(name)] for name in only.data))
    np.testing.assert_allclose((first**2 + second**2) / 2, volumes, rtol=1e-12)
    assert volumes.max() > 0
