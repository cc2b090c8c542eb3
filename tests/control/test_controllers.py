"""Control laws against formulas written out with NumPy and Pinocchio's matrices."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from baselines import KinematicProjector, Projector
from charts import with_metric
from laws import torque
from programs import needs_c
from scipy.linalg import block_diag, sqrtm

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared, gain_numbers
from orthocas.control import ControlStatus, Impedance, Kinematic, PDPlus, Reference
from orthocas.control.controller import Controller
from orthocas.errors import (
    NoExpressionError,
    UnreachableReferenceError,
)
from orthocas.problems import urdf_path
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

RNG = np.random.default_rng(21)


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


@pytest.mark.slow
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


@pytest.mark.slow
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
    assert planar_xy.domain.contains(found.worst_point)
    assert Impedance(chart, [1.0, 1e4, 1.0], 0.7).check_damping(500).indefinite_share == 0


@pytest.mark.slow
def test_kinematic_control_inverts_the_jacobian(arm_chart: oc.Chart, model: pin.Model) -> None:
    feedback = np.linspace(0, 3, 7)
    for _ in range(5):
        s = State.random(arm_chart, model)
        rate = s.dphi_d + feedback * (s.phi_d - arm_chart.phi(s.q))
        want = np.linalg.solve(arm_chart.jacobian(s.q), rate)
        np.testing.assert_allclose(called(Kinematic(arm_chart, feedback), s), want, rtol=1e-8)


def ends_on_its_reference(
    command_from: Callable[[Array], Callable[[Array, Array], Array]],
    chart: oc.Chart,
    rate: float,
    delay: float,
    seconds: float = 3.0,
) -> bool:
    """Whether x and xi of an ideal plant end within 1e-6 of a reference at rest, from starts 0.3 rad beside it."""
    for start in np.random.default_rng(5).uniform(-0.3, 0.3, (4, chart.n)):
        q, reference = chart.problem.domain.centre + start, chart.phi(chart.problem.domain.centre)
        command = command_from(q)
        on_the_way = [np.zeros(chart.n)] * round(delay * rate)
        for _ in range(round(seconds * rate)):
            on_the_way.append(command(q, reference))
            q = q + on_the_way.pop(0) / rate
        if not np.abs(chart.phi(q) - reference).max() < 1e-6:
            return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "delay"), [(1000.0, 0.0), (500.0, 0.0), (1000.0, 5e-3), (500.0, 6e-3)])
def test_velocity_law_ends_on_its_reference_by_default(planar_arm: oc.Chart, rate: float, delay: float) -> None:
    rest = np.zeros(3)

    def ends(law: Kinematic) -> bool:
        return ends_on_its_reference(
            lambda start: lambda q, phi_d: torque(law, q, rest, phi_d, rest, rest)[0], planar_arm, rate, delay
        )

    assert ends(Kinematic(planar_arm))
    assert not ends(Kinematic(planar_arm, 0.0))


@pytest.mark.slow
@needs_c
def test_velocity_law_in_c_ends_on_its_reference_by_default(planar_arm: oc.Chart, tmp_path: Path) -> None:
    law, rest = Kinematic(planar_arm), np.zeros(3)
    library = CompiledLibrary(compile_shared(oc.generate_c(planar_arm, tmp_path, law, "arm"), tmp_path), "arm", 3)
    gains = library.default_gains(len(gain_numbers(law)))

    def alone(start: Array) -> Callable[[Array, Array], Array]:
        return lambda q, phi_d: library.control(q, rest, np.concatenate([phi_d, rest, rest]), gains)[0]

    def supervised(start: Array) -> Callable[[Array, Array], Array]:
        supervisor = Supervisor(library, law)
        supervisor.start(start)
        return lambda q, phi_d: supervisor.step(q, rest, np.concatenate([phi_d, rest, rest]), 2e-3)[0]

    assert ends_on_its_reference(alone, planar_arm, 500.0, 6e-3)
    assert ends_on_its_reference(supervised, planar_arm, 500.0, 6e-3, seconds=16.0)  # its offset fades with 0.5 s


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_projector_equals_equations_2_and_3(model: pin.Model, metric: str) -> None:
    base = oc.problems.get("iiwa")
    problem = with_metric(base, metric)
    controller = Projector(problem, 300.0, np.linspace(5, 20, 7), 0.6)
    chart = oc.Chart(problem, oc.fit(base, oc.Polynomial(2)).chart.coordinates)
    s = State.random(chart, model)
    A = np.eye(7) if metric == "euclidean" else s.M
    J = chart.jacobian(s.q)[:3]
    x_d, q_d = chart.x(s.q) + 0.05, s.q + 0.1 * RNG.normal(size=7)
    M_x = np.linalg.inv(J @ np.linalg.solve(s.M, J.T))
    D_x = 2 * 0.6 * np.sqrt(300.0) * sqrtm(M_x).real
    half = sqrtm(s.M).real @ np.diag(0.6 * np.sqrt(np.linspace(5, 20, 7)))
    f_x = -300.0 * (chart.x(s.q) - x_d) - D_x @ J @ s.dq
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


def test_grown_charts_are_refused_with_a_way_out(planar_x: oc.Problem) -> None:
    grown = oc.grow(planar_x, leaf="linear")
    for law in (lambda: Impedance(grown, 1.0), lambda: Kinematic(grown)):
        with pytest.raises(NoExpressionError, match="distil"):
            law()


@pytest.mark.slow
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
