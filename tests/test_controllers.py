"""Control laws against formulas written out with NumPy and Pinocchio's matrices, and what they do in bad states."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from charts import linear_on_the_torus, with_metric
from scipy.linalg import block_diag, eigvalsh, sqrtm

import orthocas as oc
from orthocas.casadi_tools.batch import Batched
from orthocas.checks import Array
from orthocas.control import (
    ControlStatus,
    Impedance,
    Kinematic,
    KinematicProjector,
    PDPlus,
    Projector,
    Reference,
    matched_posture_stiffness,
    matched_stiffness,
)
from orthocas.control.controller import Controller
from orthocas.control.status import FROM_THE_LAW
from orthocas.domains import sample_uniform
from orthocas.errors import (
    InvalidValueError,
    NoExpressionError,
    ShapeError,
    UnknownNameError,
    UnreachableReferenceError,
)
from orthocas.problems.iiwa import urdf_path

RNG = np.random.default_rng(21)


@pytest.fixture(scope="module")
def arm_chart() -> oc.Chart:
    """The 7-DoF arm with A = M, roughly fitted: laws have to be right for any regular chart."""
    problem = oc.problems.get("iiwa")
    inertial = with_metric(problem, "inertia")
    return oc.fit(inertial, oc.Polynomial(2)).chart


@dataclass
class State:
    """A state in the inner half of the domain, a reference, and Pinocchio's matrices there."""

    q: Array
    dq: Array
    phi_d: Array
    dphi_d: Array
    ddphi_d: Array
    M: Array
    C: Array  #: Christoffel form
    g: Array

    @classmethod
    def random(cls, chart: oc.Chart, model: pin.Model) -> "State":
        n, domain = chart.n, chart.problem.domain
        q = domain.centre + RNG.uniform(-0.5, 0.5, n) * domain.half_width
        dq, dphi_d, ddphi_d = RNG.normal(size=(3, n))
        data = model.createData()
        M = pin.crba(model, data, q)
        C = pin.computeCoriolisMatrix(model, data, q, dq)
        phi_d = chart.phi(q) + 0.1 * RNG.normal(size=n)
        return cls(
            q, dq, phi_d, dphi_d, ddphi_d, np.array(M), np.array(C), np.array(pin.rnea(model, data, q, 0 * q, 0 * q))
        )


@pytest.fixture(scope="module")
def model() -> pin.Model:
    with urdf_path() as path:
        return pin.buildModelFromUrdf(str(path))


def torque(controller: Controller, *state: Array, **gains: Any) -> tuple[Array, int]:
    values = {**controller.gains, **gains}
    command, status = controller.function(*state, *values.values())
    return command.full().ravel(), int(status)


def called(controller: Controller, s: State) -> Array:
    unlimited = np.full(controller.problem.n, np.inf)
    command, status = torque(controller, s.q, s.dq, s.phi_d, s.dphi_d, s.ddphi_d, limit=unlimited)
    assert status == ControlStatus.OK
    return command


def jacobian_rate(chart: oc.Chart, q: Array, dq: Array) -> Array:
    """dJ/dt by central differences, error about 1e-9."""
    h = 1e-6
    return np.asarray((chart.jacobian(q + h * dq) - chart.jacobian(q - h * dq)) / (2 * h))


def by_hand(chart: oc.Chart, s: State, K: Array, Z: Array, blocks: list[slice], feed_forward: bool) -> Array:
    """Equations (28) to (35) with dense matrices, each block of coordinates with its own inertia."""
    J, dJ = chart.jacobian(s.q), jacobian_rate(chart, s.q, s.dq)
    G = J @ np.linalg.solve(s.M, J.T)
    M_phi = block_diag(*(np.linalg.inv(G[b, b]) for b in blocks))
    halves = [sqrtm(M_phi[b, b]).real @ np.diag(Z[b] * np.sqrt(K[b])) for b in blocks]
    D = block_diag(*(half + half.T for half in halves))
    force = -K * (chart.phi(s.q) - s.phi_d) - D @ (J @ s.dq)
    if feed_forward:
        w = np.linalg.solve(s.M, J.T) @ M_phi @ s.dphi_d
        if len(blocks) == 1:
            np.testing.assert_allclose(w, np.linalg.solve(J, s.dphi_d), rtol=1e-6)
        force += M_phi @ (s.ddphi_d + J @ np.linalg.solve(s.M, s.C @ w) - dJ @ w) + D @ s.dphi_d
    return np.asarray(J.T @ force + s.g)


@pytest.mark.parametrize("coupling", ["coupled", "decoupled"])
@pytest.mark.parametrize("law", [Impedance, PDPlus])
def test_laws_equal_the_paper_written_out(arm_chart: oc.Chart, model: pin.Model, law: Any, coupling: Any) -> None:
    K, Z = np.linspace(10, 200, 7), np.linspace(0.3, 1.0, 7)
    controller = law(arm_chart, K, Z, coupling, "square_root")
    blocks = [slice(0, 7)] if coupling == "coupled" else [slice(0, 3), slice(3, 7)]
    for _ in range(5):
        s = State.random(arm_chart, model)
        want = by_hand(arm_chart, s, K, Z, blocks, law is PDPlus)
        np.testing.assert_allclose(called(controller, s), want, rtol=2e-7, atol=1e-6 * np.abs(want).max())


@pytest.mark.slow
def test_coupled_pd_plus_gives_the_wanted_acceleration(arm_chart: oc.Chart, model: pin.Model) -> None:
    """On the reference (no error) dd_phi = dd_phi_d whatever the chart: forward dynamics by Pinocchio."""
    for _ in range(5):
        s = State.random(arm_chart, model)
        J = arm_chart.jacobian(s.q)
        s.phi_d, s.dphi_d = arm_chart.phi(s.q), J @ s.dq
        ddq = pin.aba(model, model.createData(), s.q, s.dq, called(PDPlus(arm_chart, 50.0), s))
        np.testing.assert_allclose(J @ ddq + jacobian_rate(arm_chart, s.q, s.dq) @ s.dq, s.ddphi_d, atol=1e-6)


def test_decoupled_law_relies_on_orthogonal_coordinates(planar_chart: oc.Chart, planar_x: oc.Problem) -> None:
    """At rest, with only dd_xi1 wanted: J_x ddq is 0 when coupled, and as small as the chart is good when decoupled."""

    def disturbance(chart: oc.Chart, coupling: Any) -> float:
        law, worst = PDPlus(chart, 50.0, coupling=coupling), 0.0
        for q in sample_uniform(planar_x.domain, 30, 3):
            tau, _ = torque(law, q, np.zeros(3), chart.phi(q), np.zeros(3), np.array([0.0, 1.0, 0.0]))
            acceleration = chart.jacobian(q) @ planar_x.robot.forward_dynamics(q, np.zeros(3), tau)
            worst = max(worst, float(np.abs(acceleration[0] / acceleration[1])))
        return worst

    linear = oc.fit(planar_x, oc.Linear()).chart
    assert disturbance(linear, "coupled") < 1e-10
    assert disturbance(planar_chart, "decoupled") < 0.02
    assert disturbance(linear, "decoupled") > 0.3


def test_double_diagonal_damping_is_used(planar_chart: oc.Chart) -> None:
    """With unequal stiffness the designs differ, and only (29) may be indefinite."""
    K = np.array([1.0, 1e4, 1.0])
    square, double = (Impedance(planar_chart, K, 0.7, damping=d) for d in ("square_root", "double_diagonal"))
    state = [planar_chart.problem.domain.centre, np.ones(3), np.zeros(3), np.zeros(3), np.zeros(3)]
    assert np.abs(torque(square, *state)[0] - torque(double, *state)[0]).max() > 0.1
    assert double.check_damping(200).smallest_eigenvalue > 0


def test_damping_check_finds_indefinite_designs(planar_xy: oc.Problem) -> None:
    chart = oc.fit(planar_xy, oc.Linear()).chart
    found = Impedance(chart, [1.0, 1e4, 1.0], 0.7, damping="square_root").check_damping(500)
    assert found.smallest_eigenvalue < -1e-3
    assert 0 < found.indefinite_share <= 1
    assert oc.contains(planar_xy.domain, found.worst_point)
    assert Impedance(chart, [1.0, 1e4, 1.0], 0.7).check_damping(500).indefinite_share == 0


def test_kinematic_control_inverts_the_jacobian(arm_chart: oc.Chart, model: pin.Model) -> None:
    feedback = np.linspace(0, 3, 7)
    for _ in range(5):
        s = State.random(arm_chart, model)
        rate = s.dphi_d + feedback * (s.phi_d - arm_chart.phi(s.q))
        want = np.linalg.solve(arm_chart.jacobian(s.q), rate)
        np.testing.assert_allclose(called(Kinematic(arm_chart, feedback), s), want, rtol=1e-8)


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_projector_equals_equations_2_and_3(model: pin.Model, metric: str) -> None:
    base = oc.problems.get("iiwa")
    problem = with_metric(base, metric)
    controller = Projector(problem, 300.0, np.linspace(5, 20, 7), 0.6)
    chart = oc.Chart(problem, oc.fit(base, oc.Polynomial(2)).chart.coordinates)
    s = State.random(chart, model)
    A = np.eye(7) if metric == "euclidean" else s.M
    J = chart.jacobian(s.q)[:3]
    x_d, q_d = chart.task(s.q) + 0.05, s.q + 0.1 * RNG.normal(size=7)
    M_x = np.linalg.inv(J @ np.linalg.solve(s.M, J.T))
    D_x = 2 * 0.6 * np.sqrt(300.0) * sqrtm(M_x).real
    half = sqrtm(s.M).real @ np.diag(0.6 * np.sqrt(np.linspace(5, 20, 7)))
    f_x = -300.0 * (chart.task(s.q) - x_d) - D_x @ J @ s.dq
    posture = -np.linspace(5, 20, 7) * (s.q - q_d) - (half + half.T) @ s.dq
    sharp = np.linalg.solve(A, J.T) @ np.linalg.inv(J @ np.linalg.solve(A, J.T))
    P = np.eye(7) - sharp @ J
    reference = np.concatenate([x_d, q_d])
    found, status = torque(controller, s.q, s.dq, reference, np.zeros(10), np.zeros(10))
    assert status == ControlStatus.OK
    np.testing.assert_allclose(found, J.T @ f_x + P.T @ posture + s.g, rtol=1e-8)


def test_energy_of_the_projector_counts_all_springs_and_what_the_dampers_take(planar_xy: oc.Problem) -> None:
    """dV/dt = -P + power that the projector leaks: with the posture spring at rest only the damping acts."""
    law = Projector(planar_xy, 60.0, 20.0, 0.5)
    q, dq = planar_xy.domain.centre + 0.05, np.array([0.3, -0.2, 0.5])
    here = law.measured(q).full().ravel()
    x_d, q_d = here[:2] + np.array([0.1, -0.05]), q.copy()
    inputs = (np.concatenate([x_d, q_d]), np.zeros(5), np.zeros(5), *law.gains.values())
    storage, power = (float(out) for out in law.energy(q, dq, *inputs))
    M = planar_xy.robot.mass_matrix(q)
    assert storage == pytest.approx(dq @ M @ dq / 2 + 60 * np.sum((here[:2] - x_d) ** 2) / 2, rel=1e-12)
    ddq = planar_xy.robot.forward_dynamics(q, dq, law.function(q, dq, *inputs)[0].full().ravel())
    h = 1e-6
    after, before = (float(law.energy(q + s * h * dq + h**2 / 2 * ddq, dq + s * h * ddq, *inputs)[0]) for s in (1, -1))
    J = planar_xy.task.jacobian_function(q).full()
    sharp = np.linalg.solve(M, J.T) @ np.linalg.inv(J @ np.linalg.solve(M, J.T))
    assert (after - before) / (2 * h) == pytest.approx(-power, rel=1e-5)
    assert power > 0
    assert np.abs(sharp @ J @ dq).max() > 0.01  # the projector matters here


def test_feedback_of_the_kinematic_projector_pulls_towards_the_reference() -> None:
    problem = oc.problems.get("iiwa")
    q = problem.domain.centre + 0.1
    ahead = np.array([0.01, 0.0, -0.02])
    reference = np.concatenate([problem.task.function(q).full().ravel() + ahead, q + 0.1])
    found, _ = torque(KinematicProjector(problem, 2.0, 3.0), q, np.zeros(7), reference, *np.zeros((2, 10)))
    J = problem.task.jacobian_function(q).full()
    sharp = np.linalg.pinv(J)
    want = sharp @ (2.0 * ahead) + (np.eye(7) - sharp @ J) @ (3.0 * np.full(7, 0.1))
    np.testing.assert_allclose(found, want, rtol=1e-9)


def test_pseudo_inverse_control_moves_the_tool_and_nothing_else() -> None:
    problem = oc.problems.get("iiwa")
    q = problem.domain.centre + 0.1
    J = problem.task.jacobian_function(q).full()
    rate = np.concatenate([[0.1, -0.2, 0.3], np.linspace(-1, 1, 7)])
    reference = np.concatenate([problem.task.function(q).full().ravel(), q])
    found, _ = torque(KinematicProjector(problem), q, np.zeros(7), reference, rate, np.zeros(10))
    sharp = np.linalg.pinv(J)
    np.testing.assert_allclose(found, sharp @ rate[:3] + (np.eye(7) - sharp @ J) @ rate[3:], rtol=1e-10)
    np.testing.assert_allclose(J @ found, rate[:3], rtol=1e-10)


@pytest.fixture(scope="module")
def laws(planar_chart: oc.Chart) -> list[Controller]:
    problem = planar_chart.problem
    limit = 30.0
    return [
        Impedance(planar_chart, 50.0, limit=limit),
        PDPlus(planar_chart, 50.0, coupling="decoupled", limit=limit),
        Kinematic(planar_chart, 1.0, limit=limit),
        Projector(problem, 50.0, 10.0, limit=limit),
        KinematicProjector(problem, 1.0, 1.0, limit=limit),
    ]


class TestGuard:
    """Bad states give a status and a finite, bounded command."""

    @staticmethod
    def run(law: Controller, q: Any, dq: Any = 0.0, reference: Any = 0.0) -> tuple[Array, int]:
        n, k = law.problem.n, len(law.labels)
        value = np.broadcast_to(reference, (k,))
        return torque(law, np.broadcast_to(q, (n,)), np.broadcast_to(dq, (n,)), value, np.zeros(k), np.zeros(k))

    def test_outside_the_domain_is_gravity_or_rest(self, laws: list[Controller], planar_x: oc.Problem) -> None:
        q = planar_x.domain.centre + 1.01 * planar_x.domain.half_width
        gravity = np.clip(planar_x.robot.gravity(q), -30, 30)
        for law in laws[:3]:
            command, status = self.run(law, q, 1.0)
            assert status == ControlStatus.OUTSIDE_DOMAIN
            np.testing.assert_allclose(command, gravity if law.command == "torque" else 0.0, atol=1e-12)
        for law in laws[3:]:
            assert self.run(law, q, 1.0)[1] in FROM_THE_LAW  # projectors have no domain

    def test_singular_task_is_told(self, laws: list[Controller]) -> None:
        for law in laws[3:]:
            command, status = self.run(law, [0.0, 0.0, 0.0], 1.0)  # stretched along x: dx/dq = 0
            assert status == ControlStatus.SINGULAR
            assert np.isfinite(command).all()

    def test_singular_chart_is_told(self) -> None:
        chart = linear_on_the_torus()
        for law in (Impedance(chart, 50.0), PDPlus(chart, 50.0), Kinematic(chart)):
            command, status = self.run(law, [0.0, 0.0, 0.0], 1.0)
            assert status == ControlStatus.SINGULAR
            want = chart.problem.robot.gravity(np.zeros(3)) if law.command == "torque" else np.zeros(3)
            np.testing.assert_allclose(command, want, atol=1e-12)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
    def test_not_finite_input_is_told_wherever_it_comes(self, laws: list[Controller], bad: float) -> None:
        for law in laws:
            centre, n = law.problem.domain.centre, law.problem.n
            for q, dq, reference in (([0, bad, 0], 0.0, 0.0), (centre, [bad, 0, 0], 0.0), (centre, 0.0, bad)):
                command, status = self.run(law, q, dq, reference)
                assert status == ControlStatus.NOT_FINITE
                assert np.isfinite(command).all()
                assert np.abs(command).max() <= 30
            gains = {name: np.full(len(value), bad) for name, value in law.gains.items() if name != "limit"}
            k = len(law.labels)
            command, status = torque(law, centre, np.zeros(n), *np.zeros((3, k)), **gains)
            assert status == ControlStatus.NOT_FINITE

    def test_random_states_of_any_size_give_finite_bounded_commands(self, laws: list[Controller]) -> None:
        count = 2000
        for law in laws:
            n, k = law.problem.n, len(law.labels)
            scale = 10.0 ** RNG.uniform(-3, 120, (count, 1))
            arrays = [RNG.normal(size=(count, size)) * scale for size in (n, n, k, k, k)]
            arrays[0][::2] = sample_uniform(law.problem.domain, count // 2, 4)
            command, status = Batched(law.function)(*arrays, *(np.tile(g, (count, 1)) for g in law.gains.values()))
            assert np.isfinite(command).all()
            assert np.abs(command).max() <= 30
            assert set(np.unique(status)) <= {s.value for s in ControlStatus}
            assert len(np.unique(status)) >= 2

    @pytest.mark.parametrize("bad", [np.nan, -5.0, 0.0])
    def test_limit_that_is_none_stops_the_robot(self, laws: list[Controller], bad: float) -> None:
        for law in laws:
            n, k = law.problem.n, len(law.labels)
            command, status = torque(
                law,
                law.problem.domain.centre,
                *np.zeros((1, n)),
                np.full(k, 5.0),
                *np.zeros((2, k)),
                limit=np.full(n, bad),
            )
            assert status == ControlStatus.NOT_FINITE
            np.testing.assert_array_equal(command, 0.0)

    def test_limit_cuts_the_command(self, planar_chart: oc.Chart) -> None:
        q, far = planar_chart.problem.domain.centre, np.full(3, 10.0)
        free, ok = torque(Impedance(planar_chart, 50.0), q, *np.zeros((1, 3)), far, *np.zeros((2, 3)))
        law = Impedance(planar_chart, 50.0, limit=[5, 6, 7])
        cut, status = torque(law, q, *np.zeros((1, 3)), far, *np.zeros((2, 3)))
        np.testing.assert_allclose(cut, np.clip(free, [-5, -6, -7], [5, 6, 7]))
        assert np.abs(free).max() > 7
        assert (ok, status) == (ControlStatus.OK, ControlStatus.SATURATED)

    @pytest.mark.parametrize("limit", [0.3, [0.2, 1.0, 0.4]])
    def test_limit_of_velocities_keeps_their_direction(self, planar_chart: oc.Chart, limit: Any) -> None:
        problem, wanted = planar_chart.problem, np.array([0.5, -0.3, 0.2])
        q = problem.domain.centre
        for law, of in ((Kinematic, planar_chart), (KinematicProjector, problem)):
            k = len(law(of).labels)
            rate = np.resize(wanted, k)
            free, _ = torque(law(of), q, np.zeros(3), np.zeros(k), rate, np.zeros(k))
            cut, status = torque(law(of, limit=limit), q, np.zeros(3), np.zeros(k), rate, np.zeros(k))
            share = (np.broadcast_to(limit, 3) / np.abs(free)).min()
            assert share < 1
            np.testing.assert_allclose(cut, share * free, rtol=1e-12)
            assert status == ControlStatus.SATURATED

    def test_fallback_is_gravity_or_rest(self, laws: list[Controller]) -> None:
        for law in laws:
            q = law.problem.domain.centre
            command = law.fallback(q, *law.gains.values()).full().ravel()
            want = law.problem.robot.gravity(q) if law.command == "torque" else 0 * q
            np.testing.assert_allclose(command, want, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda c: Impedance(c, 0.0), InvalidValueError, r"stiffness\[0\] is 0.0, expected positive"),
        (lambda c: Impedance(c, [1, 2]), ShapeError, r"stiffness has shape \(2,\), expected \(3,\)"),
        (lambda c: PDPlus(c, [1, np.nan, 1]), InvalidValueError, r"stiffness\[1\] is nan"),
        (lambda c: PDPlus(c, 1.0, -0.1), InvalidValueError, r"damping_ratio\[0\] is -0.1"),
        (lambda c: PDPlus(c, 1.0, coupling="loose"), UnknownNameError, "unknown coupling 'loose'"),
        (lambda c: PDPlus(c, 1.0, damping="none"), UnknownNameError, "unknown damping 'none'"),
        (lambda c: PDPlus(c, 1.0, limit=-1.0), InvalidValueError, r"limit\[0\] is -1.0"),
        (lambda c: PDPlus(c, "stiff"), InvalidValueError, "stiffness is 'stiff'"),
        (lambda c: Kinematic(c, -1.0), InvalidValueError, r"feedback\[0\] is -1.0"),
        (lambda c: Projector(c.problem, 1.0, 0.0), InvalidValueError, r"posture_stiffness\[0\] is 0.0"),
        (lambda c: Projector(c.problem, [1, 1], 1.0), ShapeError, r"stiffness has shape \(2,\)"),
        (lambda c: KinematicProjector(c.problem, 0.0, [1, 1]), ShapeError, "posture_feedback"),
    ],
)
def test_bad_gains_are_refused(planar_chart: oc.Chart, make: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        make(planar_chart)


def test_grown_charts_are_refused_with_a_way_out(planar_x: oc.Problem) -> None:
    grown = oc.grow(planar_x, leaf="linear")
    for law in (lambda: Impedance(grown, 1.0), lambda: Kinematic(grown)):
        with pytest.raises(NoExpressionError, match="distil"):
            law()


def test_networks_can_be_controlled_too(planar_xy: oc.Problem) -> None:
    """Their functions hold matrices, and stay as they are."""
    chart = oc.fit(planar_xy, oc.MLP((6, 6)), samples=300).chart
    law = PDPlus(chart, 50.0)
    q, dq, acceleration = planar_xy.domain.centre, np.full(3, 0.3), np.full(3, -0.2)
    found, status = torque(law, q, dq, chart.phi(q), chart.jacobian(q) @ dq, acceleration)
    ddq = planar_xy.robot.forward_dynamics(q, dq, found)
    assert not law.function.is_a("SXFunction")  # a thousand neurons written out would take minutes to build
    assert status == ControlStatus.OK
    np.testing.assert_allclose(chart.jacobian(q) @ ddq + jacobian_rate(chart, q, dq) @ dq, acceleration, atol=1e-6)


def test_posture_beyond_joint_limits_is_reported() -> None:
    problem = oc.problems.get("iiwa")
    law = Projector(problem, 100.0, 10.0)
    start = law.measured(problem.domain.centre).full().ravel()
    name = problem.robot.joint_names[1]
    reference = Reference.steps(law.labels, start, [(1.0, {name: 3.0})], 3.0)
    with pytest.raises(UnreachableReferenceError, match=rf"joint '{name}' at 2\.\d+ at t = 1\.\d+ s, expected within"):
        law.require_reachable(reference, problem.domain.centre)


def test_matched_stiffness_has_its_modes_around_the_frequency(planar_chart: oc.Chart, arm_chart: oc.Chart) -> None:
    """The geometric mean of the generalised eigenvalues of (K, M_phi) is omega^2, and no other K has less spread."""
    for chart in (planar_chart, arm_chart):
        inertias = _inertias(chart)
        K = matched_stiffness(chart, 3.0)
        logs = np.array([np.log(eigvalsh(np.diag(K), inertia) / 9.0) for inertia in inertias])
        assert abs(logs.mean()) < 1e-5
        least = (logs**2).sum(axis=1).mean()
        rng = np.random.default_rng(3)
        for factors in np.exp(0.05 * rng.normal(size=(10, chart.n))):
            others = [np.log(eigvalsh(np.diag(K * factors), inertia) / 9.0) for inertia in inertias]
            assert (np.square(others)).sum(axis=1).mean() > least


def test_matched_stiffness_is_exact_where_the_inertia_is_constant_and_diagonal() -> None:
    """Two sliding joints at right angles: x and xi move 3 kg and 2 kg, whatever the posture."""
    model = pin.Model()
    body = pin.SE3.Identity()
    outer = model.addJoint(0, pin.JointModelPX(), body, "px")
    inner = model.addJoint(outer, pin.JointModelPY(), body, "py")
    for joint, mass in ((outer, 1.0), (inner, 2.0)):
        model.appendBodyToJoint(joint, pin.Inertia(mass, np.zeros(3), np.eye(3)), body)
    model.addFrame(pin.Frame("tip", inner, 0, body, pin.FrameType.OP_FRAME))
    robot = oc.Robot.from_model(model, "tip")
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), "inertia", oc.Box(np.zeros(2), 1.0))
    chart = oc.fit(problem, oc.Linear()).chart
    np.testing.assert_allclose(matched_stiffness(chart, 5.0), [75.0, 50.0 / chart.jacobian(np.zeros(2))[1, 1] ** 2])
    np.testing.assert_allclose(matched_posture_stiffness(problem, 5.0), [75.0, 50.0])
    with pytest.raises(InvalidValueError, match="frequency"):
        matched_stiffness(chart, 0.0)
    with pytest.raises(InvalidValueError, match="fastest"):
        matched_stiffness(chart, 5.0, 0.0)
    slower = matched_stiffness(chart, 5.0, 3.0) / matched_stiffness(chart, 5.0)  # 3 rad/s, not 5
    np.testing.assert_allclose(slower, (3 / 5) ** 2, rtol=1e-3)


@pytest.mark.slow
def test_default_gains_of_a_pose_bear_5_ms_of_delay_although_the_flange_has_hardly_any_inertia() -> None:
    """Joint 7 moves 3e-4 kg m^2. Springs that ignore delay give it modes beyond 23 Hz, which 5 ms make unstable."""
    arm = oc.problems.get("iiwa")
    problem = oc.Problem(arm.robot, oc.Task.named(arm.robot, "pose", arm.domain.centre), "euclidean", arm.domain)
    chart = oc.fit(problem, oc.Polynomial(2), weights=(1000, 30, 150, 1)).chart
    others = sample_uniform(arm.domain, 1000, 7)
    assert PDPlus.on_chart(chart).modes(others).delays.min() > 5e-3
    assert PDPlus(chart, matched_stiffness(chart, fastest=np.inf)).modes(others).delays.min() < 3e-3


@pytest.mark.parametrize(("coupling", "damping"), [("coupled", "square_root"), ("decoupled", "double_diagonal")])
def test_modes_are_those_of_the_simulated_dynamics(arm_chart: oc.Chart, coupling: Any, damping: Any) -> None:
    """Stiffness and damping of the loop, from finite differences of the robot's acceleration under the law at rest."""
    law = Impedance(arm_chart, matched_stiffness(arm_chart), 0.4, coupling, damping)
    q, n = arm_chart.problem.domain.centre, arm_chart.n
    phi, zero = arm_chart.phi(q), np.zeros(n)

    def acceleration(state: Array) -> Array:
        tau, _ = torque(law, state[:n], state[n:], phi, zero, zero)
        return arm_chart.problem.robot.forward_dynamics(state[:n], state[n:], tau)

    state, h = np.concatenate([q, zero]), 1e-5
    columns = [(acceleration(state + h * unit) - acceleration(state - h * unit)) / (2 * h) for unit in np.eye(2 * n)]
    slopes = np.array(columns).T
    modes = law.modes(q)
    np.testing.assert_allclose(
        np.sort(np.sqrt(np.linalg.eigvals(-slopes[:, :n]).real)) / (2 * np.pi), modes.frequencies, 1e-5
    )
    rates = 2 * modes.damping_ratios * 2 * np.pi * modes.frequencies
    assert rates.sum() == pytest.approx(-np.trace(slopes[:, n:]), rel=1e-6)
    if damping == "double_diagonal" and coupling == "coupled":
        np.testing.assert_allclose(modes.damping_ratios, 0.4, rtol=1e-6)


def test_a_mode_is_unstable_beyond_its_delay(planar_chart: oc.Chart) -> None:
    """A root of s^2 + (2 zeta omega s + omega^2) e^(-sT) crosses the imaginary axis at the longest delay T."""
    modes = PDPlus(planar_chart, matched_stiffness(planar_chart), 0.7).modes(planar_chart.problem.domain.centre)
    for frequency, ratio, delay in zip(modes.frequencies, modes.damping_ratios, modes.delays, strict=True):
        omega = 2 * np.pi * frequency

        def largest_real_part(T: float, omega: float = omega, ratio: float = ratio) -> float:
            s = 1j * omega * 1.5
            for _ in range(50):  # Newton
                late = np.exp(-s * T)
                value = s**2 + (2 * ratio * omega * s + omega**2) * late
                slope = 2 * s + (2 * ratio * omega - T * (2 * ratio * omega * s + omega**2)) * late
                s -= value / slope
            return float(s.real)

        assert largest_real_part(0.98 * delay) < 0 < largest_real_part(1.02 * delay)


def test_default_gains_hold_an_arm_whose_masses_are_off() -> None:
    """Static solution of J^T K e = 0.2 g on the plant with 1.2 times the mass: sag up to 20 mm, inside the domain."""
    problem = oc.problems.get("iiwa")
    chart = oc.fit(problem, oc.Polynomial(3), weights=(1000, 30, 150, 1)).chart
    law, plant = PDPlus.on_chart(chart), problem.robot.with_scaled_masses(1.2)
    rng = np.random.default_rng(5)
    for start in problem.domain.centre + 0.6 * problem.domain.half_width * rng.uniform(-1, 1, (5, 7)):
        q = start
        for _ in range(30):
            wrong = plant.gravity(q) - problem.robot.gravity(q)
            e = -np.linalg.solve(chart.jacobian(q).T, wrong) / law.stiffness
            q = chart.inverse(chart.phi(start) + e, q)
        assert oc.contains(problem.domain, q)
        sag = np.linalg.norm(problem.robot.tip_position(q) - problem.robot.tip_position(start))
        assert 1e-3 < sag < 0.02


def _inertias(chart: oc.Chart) -> Array:
    points = sample_uniform(chart.problem.domain, 512, 0)
    J, M = chart.jacobian(points), chart.problem.robot.mass_matrix(points)
    half = np.linalg.inv(J)
    return np.asarray(half.transpose(0, 2, 1) @ M @ half)
