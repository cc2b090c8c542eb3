"""Default gains: modes of the closed loop, the delay that they bear, and what they hold."""

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from laws import torque
from scipy.linalg import eigvalsh

import orthocas as oc
from orthocas.charts import point_quality
from orthocas.control import Impedance, PDPlus, Safety, matched_stiffness, operational_space
from orthocas.control.gains import compute_mobility, limit_stiffness
from orthocas.errors import (
    InvalidValueError,
)
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array


@pytest.mark.slow
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
    with pytest.raises(InvalidValueError, match="frequency"):
        matched_stiffness(chart, 0.0)
    with pytest.raises(InvalidValueError, match="fastest"):
        matched_stiffness(chart, 5.0, 0.0)
    slower = matched_stiffness(chart, 5.0, 3.0) / matched_stiffness(chart, 5.0)  # 3 rad/s, not 5
    np.testing.assert_allclose(slower, (3 / 5) ** 2, rtol=1e-3)


@pytest.mark.slow
def test_stiffness_for_a_delay_leaves_30_degrees_to_the_fastest_mode_of_the_whole_domain(
    planar_chart: oc.Chart,
) -> None:
    """On 20^3 points with all corners, from the open loop (2 zeta omega s + omega^2) exp(-s T) / s^2."""
    domain, zeta, delay = planar_chart.problem.domain, 0.5, 20e-3
    K = matched_stiffness(planar_chart, 60.0, np.inf, delay, zeta)
    steps = np.linspace(-1, 1, 20)
    q = domain.centre + domain.half_width * np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    J, M = planar_chart.jacobian(q), planar_chart.problem.robot.mass_matrix(q)
    omega = np.sqrt(np.linalg.eigvals(J @ np.linalg.solve(M, J.transpose(0, 2, 1)) * K).real.max())
    s = 1j * np.linspace(0.5, 4, 50_001) * omega
    loop = (2 * zeta * omega * s + omega**2) * np.exp(-s * delay) / s**2
    crossing = int(np.argmin(np.abs(np.abs(loop) - 1)))
    margin = np.degrees(np.angle(-loop[crossing]))
    assert 30 - 1e-2 < margin < 33  # not less anywhere, and no spring is softer than it must be


def test_a_delay_that_cannot_be_borne_or_is_of_no_use_is_refused(planar_chart: oc.Chart) -> None:
    for delay in (-1e-3, np.nan, np.inf):
        with pytest.raises(InvalidValueError, match="delay"):
            matched_stiffness(planar_chart, delay=delay)
    with pytest.raises(InvalidValueError, match="damping_ratio"):
        matched_stiffness(planar_chart, delay=1e-3, damping_ratio=0.2)
    with pytest.raises(InvalidValueError, match="none with a given stiffness"):
        PDPlus.on_chart(planar_chart, stiffness=10.0, delay=1e-3)


@pytest.mark.slow
def test_default_gains_of_a_pose_bear_5_ms_of_delay_although_the_flange_has_hardly_any_inertia() -> None:
    """Joint 7 moves 3e-4 kg m^2, about an axis of the tip: its spring is a thirtieth of those of the tilts."""
    arm = oc.problems.get("iiwa")
    problem = oc.Problem(arm.robot, oc.Task.named(arm.robot, "pose", arm.domain.centre), "euclidean", arm.domain)
    chart = oc.fit(problem, oc.Polynomial(2), weights=(1000, 30, 150, 1)).chart
    others = sample_uniform(arm.domain, 1000, 7)
    assert PDPlus.on_chart(chart).modes(others).delays.min() > 5e-3
    stiffness = matched_stiffness(chart)
    assert 30 * stiffness[5] < stiffness[3:5].min()


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


@pytest.mark.parametrize("coupling", ["coupled", "decoupled"])
def test_no_mode_is_faster_than_the_bound_and_all_have_the_damping_ratio(arm_chart: oc.Chart, coupling: Any) -> None:
    """K(q) and D(q) from finite differences of the robot's acceleration under the law at rest, at the centre."""
    law = PDPlus(arm_chart, damping_ratio=0.4, coupling=coupling)
    q, n = arm_chart.problem.domain.centre, arm_chart.n
    phi, zero = arm_chart.phi(q), np.zeros(n)

    def acceleration(state: Array) -> Array:
        tau, _ = torque(law, state[:n], state[n:], phi, zero, zero)
        return arm_chart.problem.robot.forward_dynamics(state[:n], state[n:], tau)

    state, h = np.concatenate([q, zero]), 1e-5
    columns = [(acceleration(state + h * unit) - acceleration(state - h * unit)) / (2 * h) for unit in np.eye(2 * n)]
    slopes = np.array(columns).T
    frequencies = np.sort(np.sqrt(np.linalg.eigvals(-slopes[:, :n]).real)) / (2 * np.pi)
    modes = law.modes(q)
    rates = 2 * modes.damping_ratios * 2 * np.pi * modes.frequencies
    assert rates.sum() == pytest.approx(-np.trace(slopes[:, n:]), rel=1e-6)
    if coupling == "coupled":
        np.testing.assert_allclose(frequencies, modes.frequencies, rtol=1e-5)
        np.testing.assert_allclose(modes.damping_ratios, 0.4, rtol=1e-6)
        assert 6.5 < frequencies.min() < frequencies.max() < 18.0


def test_springs_in_series_with_the_inertia_add_their_compliances(planar_chart: oc.Chart) -> None:
    """K(q)^-1 = K^-1 + W / omega^2 + J c J^T; without c, s becomes s omega^2 / (s + omega^2); infinity gives K."""
    q = sample_uniform(planar_chart.problem.domain, 20, 3)
    J, M = planar_chart.jacobian(q), planar_chart.problem.robot.mass_matrix(q)
    W, K = J @ np.linalg.solve(M, J.transpose(0, 2, 1)), np.array([200.0, 30.0, 5.0])
    limited = limit_stiffness(W, J, K, 20.0, np.zeros(3), (3,))
    np.testing.assert_allclose(np.linalg.inv(limited), np.diag(1 / K) + W / 400.0, rtol=1e-9)
    c = np.array([1e-3, 0.0, 2e-2])
    softer = np.linalg.inv(limit_stiffness(W, J, K, 20.0, c, (3,)))
    np.testing.assert_allclose(softer, np.diag(1 / K) + W / 400.0 + J @ np.diag(c) @ J.transpose(0, 2, 1), rtol=1e-9)
    plain = np.sort(np.linalg.eigvals(W * K).real)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(W @ limited).real), plain * 400 / (plain + 400), rtol=1e-9)
    law = PDPlus(planar_chart, K, fastest=20.0)
    np.testing.assert_allclose(law.modes(q).frequencies, np.sqrt(plain * 400 / (plain + 400)) / (2 * np.pi), rtol=1e-9)
    assert "fastest" not in PDPlus(planar_chart, K, fastest=np.inf).gains
    assert PDPlus.on_chart(planar_chart).gains["fastest"] == pytest.approx(36 * np.pi)
    assert PDPlus.on_chart(planar_chart, delay=0.03).gains["fastest"] < 8 * np.pi
    with pytest.raises(InvalidValueError, match="compliance"):
        PDPlus(planar_chart, K, compliance=1e-3)
    with pytest.raises(InvalidValueError, match="fastest"):
        PDPlus(planar_chart, K, fastest=0.0)
    with pytest.raises(InvalidValueError, match="infinity with damping_stiffness"):
        PDPlus(planar_chart, K, damping_stiffness=K, fastest=20.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-wide", "xarm7-wide", "iiwa7-wide", "pr2-left-wide"])
@pytest.mark.filterwarnings("ignore::orthocas.errors.LawWarning")
def test_default_gains_let_every_mode_of_a_wide_chart_settle_within_a_second(name: str) -> None:
    """exp(-zeta omega t) falls to 1 % in 4.6 / (zeta omega); what a constant K leaves takes 13 s on the xarm7.

    Motors follow: springs of joints are not stiffer than what changes by 4 N m in a millisecond at 0.5 rad/s.
    """
    law = PDPlus.on_chart(oc.charts.load(name))
    modes = law.modes()
    rates = 2 * np.pi * modes.frequencies * modes.damping_ratios
    assert np.quantile(4.6 / rates.min(axis=1), 0.95) < 1.0
    assert modes.frequencies.max() <= 18.0 + 1e-6
    points = sample_uniform(law.problem.domain, 64, 1)
    J = law.chart.jacobian(points)
    K = limit_stiffness(
        compute_mobility(law.chart, points, law.problem.robot),
        J,
        law.stiffness,
        law.fastest,
        law.compliance,
        (law.chart.n,),
    )
    most = 4000.0 / np.minimum(0.5, law.problem.robot.velocity_limits)
    assert (np.einsum("kai,kab,kbi->ki", J, K, J) < most).all()


def test_integral_action_is_bounded_by_the_slowest_mode(planar_chart: oc.Chart) -> None:
    """Poles of M de'' + D de' + K (e + z) = 0, z' = L e: stable below the bound with 2 M, lost at twice the bound."""
    law, domain, n = PDPlus(planar_chart, [200.0, 30.0, 5.0]), planar_chart.problem.domain, planar_chart.n
    points = sample_uniform(domain, 2000, 4)
    modes = law.modes(points)
    decays = (2 * np.pi * modes.frequencies * modes.damping_ratios).min(axis=1)
    worst = points[np.argmin(decays)]
    assert 0.5 * decays.min() < law.integral_bound <= decays.min()

    def largest_real_part(rate: float, heavier: float) -> float:
        J, M = planar_chart.jacobian(worst), heavier * planar_chart.problem.robot.mass_matrix(worst)
        W = J @ np.linalg.solve(M, J.T)
        D = law.damping_matrix(worst, *(law.gains[name] for name in law.damping_matrix.name_in()[1:])).full()
        K, none, one = np.diag(law.stiffness), np.zeros((n, n)), np.eye(n)
        states = np.block([[none, one, none], [-W @ K, -W @ D, -W @ K], [rate * one, none, none]])
        return float(np.linalg.eigvals(states).real.max())

    assert largest_real_part(0.99 * decays.min(), 2.0) < 0 < largest_real_part(2.02 * decays.min(), 1.0)
    assert Safety.of(law, integral_rate=0.9 * law.integral_bound).integral_rate.max() > 0
    with pytest.raises(InvalidValueError, match="integral_rate.*the slowest mode bears"):
        Safety.of(law, integral_rate=1.1 * law.integral_bound)
    assert Safety.of(oc.control.Kinematic(planar_chart), integral_rate=100.0).integral_rate.max() == 100.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["position", "pose:z"])
def test_default_gains_hold_an_arm_whose_masses_are_off(kind: str) -> None:
    """Static solution of J^T K(q) e = 0.2 g on the plant with 1.2 times the mass: sag up to 4 mm, inside the domain."""
    arm = oc.problems.get("iiwa")
    problem = oc.Problem(arm.robot, oc.Task.named(arm.robot, kind), "euclidean", arm.domain)
    chart = oc.fit(problem, oc.Polynomial(3), weights=(1000, 30, 150, 1)).chart
    law, plant = PDPlus.on_chart(chart), problem.robot.with_scaled_masses(1.2)
    rng = np.random.default_rng(5)
    for start in problem.domain.centre + 0.6 * problem.domain.half_width * rng.uniform(-1, 1, (5, 7)):
        q = start
        for _ in range(30):
            wrong = plant.gravity(q) - problem.robot.gravity(q)
            # K(q)^-1 = K^-1 + J M^-1 J^T / omega^2.
            J, force = chart.jacobian(q), -np.linalg.solve(chart.jacobian(q).T, wrong)
            e = force / law.stiffness + J @ np.linalg.solve(problem.robot.mass_matrix(q), J.T @ force) / law.fastest**2
            e += J @ (law.compliance * (J.T @ force))
            q = chart.inverse(chart.phi(start) + e, q)
        assert problem.domain.contains(q)
        sag = np.linalg.norm(problem.robot.tip_position(q) - problem.robot.tip_position(start))
        assert 1e-4 < sag < 0.004


def _inertias(chart: oc.Chart) -> Array:
    points = sample_uniform(chart.problem.domain, 512, 0)
    J, M = chart.jacobian(points), chart.problem.robot.mass_matrix(points)
    half = np.linalg.inv(J)
    return np.asarray(half.transpose(0, 2, 1) @ M @ half)


@pytest.mark.slow
def test_the_fastest_mode_of_a_law_is_the_fastest_on_a_grid_of_its_domain(planar_chart: oc.Chart) -> None:
    """The modes are omega^2 = eig(J M^-1 J^T K), by a solver for any matrix, on 40^3 points with all corners."""
    law, domain = Impedance.on_chart(planar_chart), planar_chart.problem.domain
    steps = np.linspace(-1, 1, 40)
    q = domain.centre + domain.half_width * np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    J, M = planar_chart.jacobian(q), planar_chart.problem.robot.mass_matrix(q)
    squares = np.linalg.eigvals(J @ np.linalg.solve(M, J.transpose(0, 2, 1)) * law.stiffness).real
    modes = law.modes()
    fastest = modes.frequencies[-1, -1]  # the last posture is that of the search
    assert fastest == modes.frequencies.max()
    assert fastest >= (1 - 1e-6) * np.sqrt(squares.max()) / (2 * np.pi)
    assert fastest > 1.02 * modes.frequencies[:-1].max()  # samples alone do not find it


@pytest.mark.nightly
def test_users_search_for_modes_ends_where_the_brief_one_of_tests_does(
    planar_chart: oc.Chart, monkeypatch: pytest.MonkeyPatch
) -> None:
    """tests/conftest.py has laws search from a twentieth of the postures."""
    brief = PDPlus(planar_chart, [200.0, 30.0, 5.0]).integral_bound
    monkeypatch.setattr(operational_space, "least_in_domain", point_quality.least_in_domain)
    assert PDPlus(planar_chart, [200.0, 30.0, 5.0]).integral_bound == pytest.approx(brief, rel=1e-3)
