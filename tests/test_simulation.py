"""Closed loops: against an independent integrator on Pinocchio's dynamics, energy books, and sampled control."""

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from charts import with_metric
from scipy.integrate import solve_ivp

import orthocas as oc
from orthocas.checks import Array
from orthocas.control import ControlStatus, Impedance, Kinematic, KinematicProjector, PDPlus, Projector, Reference
from orthocas.control.controller import Controller
from orthocas.errors import Interrupted, InvalidValueError, ShapeError, UnreachableReferenceError
from orthocas.minimising.watch import Progress
from orthocas.problems.iiwa import urdf_path
from orthocas.robots.planar import planar_model
from orthocas.simulation import (
    Friction,
    Noise,
    Outcome,
    Push,
    coupling_index,
    simulate,
    task_acceleration_breakdown,
)

K = 60.0


@pytest.fixture(scope="module")
def q0(planar_x: oc.Problem) -> Array:
    return planar_x.domain.centre


@pytest.fixture(scope="module")
def steps(planar_chart: oc.Chart, q0: Array) -> Reference:
    """Interleaved steps in x and xi1, as in Sec. 8.1."""
    phi = planar_chart.phi(q0)
    changes = [(0.3, {"x": phi[0] + 0.1}), (2.0, {"xi1": 0.05}), (4.0, {"x": phi[0]}), (6.0, {"xi1": 0.0})]
    return Reference.steps(planar_chart.labels, phi, changes, 8.0)


def resting(chart: oc.Chart, q: Array, duration: float) -> Reference:
    return Reference.steps(chart.labels, chart.phi(q), [], duration)


def torque_at(controller: Controller, reference: Reference, t: float, q: Array, dq: Array) -> Array:
    values = [part[0] for part in reference.sample([t])]
    return np.asarray(controller.function(q, dq, *values, *controller.gains.values())[0].full().ravel())


def test_run_agrees_with_another_integrator_on_pinocchios_dynamics(
    planar_chart: oc.Chart, steps: Reference, q0: Array
) -> None:
    """SciPy's DOP853 with Pinocchio's forward dynamics, segment by segment."""
    model = planar_model([1, 1, 1], [3, 3, 3])
    data, law = model.createData(), PDPlus(planar_chart, K, coupling="decoupled")
    short = replace(steps, times=np.array([0.0, 0.3, 1.5]), parameters=steps.parameters[:2], targets=steps.targets[:2])
    run = simulate(law, short, q0, step=0.05, tolerance=1e-11)
    state = np.concatenate([q0, np.zeros(3)])
    for begin, end in ((0.0, 0.3), (0.3, 1.5)):
        solution = solve_ivp(
            lambda t, s: np.concatenate(
                [s[3:], pin.aba(model, data, s[:3], s[3:], torque_at(law, short, t, s[:3], s[3:]))]
            ),
            (begin, end - 1e-12),
            state,
            method="DOP853",
            rtol=1e-11,
            atol=1e-12,
        )
        state = solution.y[:, -1]
    np.testing.assert_allclose(np.concatenate([run.q[-1], run.dq[-1]]), state, atol=1e-8)
    assert np.abs(run.q[-1] - q0).max() > 0.02


@pytest.mark.slow
def test_accelerations_along_a_run_are_pinocchios() -> None:
    """7-DoF arm: the plant's forward dynamics at every instant of a run, to 1e-8 of the largest acceleration."""
    base = oc.problems.get("iiwa")
    chart = oc.fit(with_metric(base, "inertia"), oc.Polynomial(2), weights=(1000, 30, 150)).chart
    q0 = base.domain.centre
    reference = Reference.steps(chart.labels, chart.phi(q0), [(0.0, {"x": chart.phi(q0)[0] + 0.05, "xi3": 0.03})], 1.0)
    run = simulate(PDPlus(chart, 50.0), reference, q0)
    with urdf_path() as path:
        model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    want = np.array([pin.aba(model, data, *row) for row in zip(run.q, run.dq, run.command, strict=True)])
    found = base.robot.forward_dynamics(run.q, run.dq, run.command)
    np.testing.assert_allclose(found, want, atol=1e-8 * np.abs(want).max())
    assert np.abs(want).max() > 1.0


def test_coupled_pd_plus_tracks_with_any_regular_chart(planar_x: oc.Problem, q0: Array) -> None:
    """Linear coordinates, far from orthogonal: what is left is the tolerance of the integrator."""
    chart = oc.fit(planar_x, oc.Linear()).chart
    phi = chart.phi(q0)
    reference = Reference.steps(chart.labels, phi, [(0.2, {"x": phi[0] + 0.1}), (1.5, {"xi1": 0.04})], 3.0)
    coupled = simulate(PDPlus(chart, K), reference, q0, tolerance=1e-10)
    decoupled = simulate(PDPlus(chart, K, coupling="decoupled"), reference, q0, tolerance=1e-10)
    assert coupled.tracking_error.max() < 1e-7
    assert decoupled.tracking_error.max() > 1e-3


def test_good_coordinates_hardly_couple(planar_chart: oc.Chart, steps: Reference, q0: Array) -> None:
    run = simulate(PDPlus(planar_chart, K, coupling="decoupled"), steps, q0)
    assert run.outcome is Outcome.COMPLETE
    assert (run.status == ControlStatus.OK).all()
    coupling = coupling_index(planar_chart, steps, run)
    assert coupling.of("x", "xi1") < 0.005
    assert coupling.of("xi1", "x") < 0.005
    assert np.isnan(coupling.of("x", "xi2"))  # never commanded
    np.testing.assert_allclose(run.q[-1], q0, atol=1e-4)  # all targets are back


def test_coupling_index_reads_the_worst_excursion(planar_chart: oc.Chart, q0: Array) -> None:
    """A made-up run: x strays by 0.01 while xi1 is commanded by 0.05."""
    phi = planar_chart.phi(q0)
    reference = Reference.steps(planar_chart.labels, phi, [(0.0, {"xi1": 0.05}), (2.0, {"x": 1.0, "xi2": 1.0})], 3.0)
    run = simulate(Kinematic(planar_chart), replace(reference, times=np.array([0.0, 2.0])), q0)
    wanted = reference.sample(run.times)[0]
    wanted[len(run.times) // 2, 0] += 0.01
    strayed = replace(run, q=planar_chart.inverse(wanted, run.q))
    coupling = coupling_index(planar_chart, reference, strayed)
    assert coupling.of("x", "xi1") == pytest.approx(0.2, rel=1e-6)
    assert coupling.of("xi2", "xi1") < 1e-6
    assert np.isnan(coupling.index[:, [0, 2]]).all()  # two targets at once are left out


def test_breakdown_adds_up_to_the_task_acceleration(planar_chart: oc.Chart, steps: Reference, q0: Array) -> None:
    run = simulate(Impedance(planar_chart, K), steps, q0, step=0.002, tolerance=1e-11)
    parts = task_acceleration_breakdown(planar_chart, run)
    inner = run.times < 0.29  # before the first step everything rests
    assert np.abs(parts.total[inner]).max() < 1e-8
    moving = (run.times > 0.4) & (run.times < 1.9)
    t, dx = run.times[moving], np.einsum("ij,ij->i", planar_chart.jacobian(run.q)[:, 0], run.dq)[moving]
    slope = (dx[2:] - dx[:-2]) / (t[2:] - t[:-2])
    np.testing.assert_allclose(parts.total[moving][1:-1, 0], slope, atol=2e-4)  # differences of second order
    assert np.abs(parts.error).max() < 0.1 * np.abs(parts.coriolis).max()
    with pytest.raises(InvalidValueError, match="'kinematic'"):
        task_acceleration_breakdown(planar_chart, simulate(Kinematic(planar_chart), resting(planar_chart, q0, 0.1), q0))


@pytest.mark.parametrize("law", [Impedance, PDPlus])
@pytest.mark.parametrize("damping", ["square_root", "double_diagonal"])
def test_energy_books_balance_and_storage_falls(planar_chart: oc.Chart, q0: Array, law: Any, damping: Any) -> None:
    """V(0) - V(t) is what the damping took: the closed loop is passive."""
    controller = law(planar_chart, K, 0.7, damping=damping)
    start, velocity = q0 + np.array([0.1, -0.1, 0.05]), np.array([0.5, -0.4, 0.3])
    run = simulate(controller, resting(planar_chart, q0, 3.0), start, dq_start=velocity, step=0.005, tolerance=1e-10)
    assert (run.status == ControlStatus.OK).all()
    assert np.abs(run.energy_balance).max() < 1e-5 * run.storage[0]  # Simpson's rule on 5 ms
    assert run.storage_rise < 1e-8 * run.storage[0]
    assert run.storage[-1] < 0.01 * run.storage[0]
    assert (run.dissipated_power >= 0).all()


def test_projectors_are_not_passive(planar_xy: oc.Problem) -> None:
    """Where task and posture disagree the task loads the posture's spring for free: the storage rises."""
    q0, rises = planar_xy.domain.centre, []
    law = Projector(planar_xy, K, 100.0)
    for offset in ([0.5, -0.5, 0.2], [-0.5, 0.5, 0.3], [0.2, 0.5, -0.5]):
        wanted = np.concatenate([law.measured(q0).full().ravel()[:2], q0 + offset])
        run = simulate(law, Reference.steps(law.labels, wanted, [], 3.0), q0 - 0.5 * np.array(offset))
        rises.append(run.storage_rise / run.storage[0])
    assert max(rises) > 0.01


def test_sampled_control_approaches_continuous_control(planar_chart: oc.Chart, steps: Reference, q0: Array) -> None:
    """Held commands are late by half a tick: the difference falls with the rate, first order."""
    law = PDPlus(planar_chart, K)
    short = replace(steps, times=np.array([0.0, 0.3, 1.5]), parameters=steps.parameters[:2], targets=steps.targets[:2])
    end = simulate(law, short, q0, tolerance=1e-10).q[-1]
    gaps = [np.abs(simulate(law, short, q0, control_rate=rate).q[-1] - end).max() for rate in (100.0, 200.0, 400.0)]
    assert gaps[0] / gaps[1] == pytest.approx(2.0, rel=0.3)
    assert gaps[1] / gaps[2] == pytest.approx(2.0, rel=0.3)


def test_sampled_run_holds_commands_between_ticks(planar_chart: oc.Chart, steps: Reference, q0: Array) -> None:
    law = Impedance(planar_chart, K)
    run = simulate(law, steps, q0, control_rate=130.0)  # 1040 ticks, not a multiple of what one call runs
    assert len(run.times) == 1041
    np.testing.assert_allclose(np.diff(run.times), 1 / 130)
    k = 200
    held = torque_at(law, steps, float(run.times[k]), run.q[k], run.dq[k])
    np.testing.assert_allclose(run.command[k], held, rtol=1e-10)
    solution = solve_ivp(
        lambda _, s: np.concatenate([s[3:], planar_chart.problem.robot.forward_dynamics(s[:3], s[3:], held)]),
        (0, 1 / 130),
        np.concatenate([run.q[k], run.dq[k]]),
        rtol=1e-10,
        atol=1e-12,
    )
    np.testing.assert_allclose(solution.y[:3, -1], run.q[k + 1], atol=1e-8)


def test_noise_is_seeded_and_needs_ticks(planar_chart: oc.Chart, q0: Array) -> None:
    law, still = Impedance(planar_chart, K), resting(planar_chart, q0, 0.5)
    runs = [simulate(law, still, q0, control_rate=200.0, noise=Noise(1e-3, 1e-2, seed)).q for seed in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert 1e-6 < np.abs(runs[0] - runs[2]).max() < 1e-2
    with pytest.raises(InvalidValueError, match="white noise needs control ticks"):
        simulate(law, still, q0, noise=Noise(1e-3))


def test_push_displaces_as_far_as_the_stiffness_lets_it(planar_chart: oc.Chart, q0: Array) -> None:
    """At rest under a constant force F at the tip: J^T K (phi - phi_d) = J_tip^T F."""
    robot = planar_chart.problem.robot
    push = Push(0.1, 60.0, force=(4.0, 2.0, 0.0), torque=(0.1, 0.0, -0.1))
    run = simulate(Impedance(planar_chart, 400.0), resting(planar_chart, q0, 30.0), q0, pushes=[push])
    q = run.q[-1]
    assert np.abs(run.dq[-1]).max() < 1e-5
    spring = planar_chart.jacobian(q).T @ (400.0 * (planar_chart.phi(q) - planar_chart.phi(q0)))
    np.testing.assert_allclose(spring, robot.tip_jacobian(q)[:3].T @ push.force + push.torque, atol=1e-3)
    assert np.abs(q - q0).max() > 1e-3
    before = run.times <= 0.1
    assert np.abs(run.q[before] - q0).max() < 1e-9


def test_short_push_keeps_its_impulse_between_ticks(planar_chart: oc.Chart, q0: Array) -> None:
    """Sampled control: loads are averaged over ticks, so 0.8 ms move the arm as in continuous time."""
    law, still = Impedance(planar_chart, K), resting(planar_chart, q0, 0.5)
    pushes = [Push(0.1001, 0.0008, (10.0, 0.0, 0.0)), Push(0.1003, 0.0004, (0.0, 5.0, 0.0))]
    exact, sampled = (simulate(law, still, q0, control_rate=rate, pushes=pushes) for rate in (None, 1000.0))
    peaks = [np.abs(run.q - q0).max() for run in (exact, sampled)]
    assert peaks[1] == pytest.approx(peaks[0], rel=0.05)
    alone = simulate(law, still, q0, pushes=pushes[:1])
    assert np.abs(alone.q - exact.q[: len(alone.q)]).max() > 0.05 * peaks[0]  # overlapping pushes add up


def test_push_ends(planar_chart: oc.Chart, q0: Array) -> None:
    run = simulate(
        Impedance(planar_chart, 400.0), resting(planar_chart, q0, 20.0), q0, pushes=[Push(0.1, 0.2, (20.0, 0.0, 0.0))]
    )
    assert np.abs(run.q - q0).max() > 5e-3
    assert np.abs(run.q[-1] - q0).max() < 1e-4


def test_events_that_differ_by_rounding_are_one(planar_chart: oc.Chart, q0: Array) -> None:
    """0.1 + 0.2 is not 0.3 in binary numbers."""
    phi = planar_chart.phi(q0)
    reference = Reference.steps(planar_chart.labels, phi, [(0.3, {"xi1": 0.02})], 1.0)
    run = simulate(Impedance(planar_chart, K), reference, q0, pushes=[Push(0.1, 0.2, (5.0, 0.0, 0.0))])
    assert (np.diff(run.times) > 0).all()
    assert np.isfinite(run.energy_balance).all()


def test_friction_takes_its_energy(planar_chart: oc.Chart, q0: Array) -> None:
    """V falls by what damping and friction take, the integral of dq . tau_f."""
    friction = Friction(viscous=0.3, coulomb=[0.2, 0.1, 0.0])
    run = simulate(
        Impedance(planar_chart, K),
        resting(planar_chart, q0, 1.0),
        q0 + 0.1,
        step=1e-3,
        friction=friction,
        tolerance=1e-10,
    )
    torque = 0.3 * run.dq + np.array([0.2, 0.1, 0.0]) * np.tanh(run.dq / 0.01)
    taken = np.trapezoid((run.dq * torque).sum(axis=1), run.times)
    assert run.energy_balance[-1] == pytest.approx(-taken, rel=1e-4)
    assert taken > 0.01


def test_noise_is_on_what_it_says(planar_chart: oc.Chart, q0: Array) -> None:
    """With position noise only, held commands scatter as the stiffness says; the record shows what was sent."""
    law, still = Impedance(planar_chart, 400.0), resting(planar_chart, q0, 0.2)
    for noise, gain in ((Noise(1e-4, 0.0, 3), "q"), (Noise(0.0, 1e-4, 3), "dq")):
        run = simulate(law, still, q0, control_rate=1000.0, noise=noise)
        errors = noise.sample(200, 3)
        k = 57
        measured = {"q": run.q[k] + errors[k, :3], "dq": run.dq[k] + errors[k, 3:]}
        quiet, noisy = (errors[:, 3:], errors[:, :3]) if gain == "q" else (errors[:, :3], errors[:, 3:])
        assert np.abs(quiet).max() == 0
        assert np.abs(noisy).max() > 0
        sent = torque_at(law, still, float(run.times[k]), measured["q"], measured["dq"])
        np.testing.assert_allclose(run.command[k], sent, rtol=1e-9)


def test_run_ends_with_its_reference(planar_chart: oc.Chart, q0: Array) -> None:
    run = simulate(Impedance(planar_chart, K), resting(planar_chart, q0, 1.0), q0, control_rate=3.3)
    assert run.times[-1] <= 1.0
    with pytest.raises(InvalidValueError, match="at least one tick"):
        simulate(Impedance(planar_chart, K), resting(planar_chart, q0, 0.1), q0, control_rate=5.0)


def test_wrong_masses_are_felt(planar_chart: oc.Chart, steps: Reference, q0: Array) -> None:
    heavy = planar_chart.problem.robot.with_scaled_masses([1.1, 1.2, 1.3])
    np.testing.assert_allclose(heavy.tree.masses, 3 * np.array([1.1, 1.2, 1.3]))
    law = PDPlus(planar_chart, K)
    right, wrong = (simulate(law, steps, q0, plant=plant, must_be_reachable=False) for plant in (None, heavy))
    assert wrong.tracking_error[0] > 100 * right.tracking_error[0]
    double = planar_chart.problem.robot.with_scaled_masses(2.0)
    np.testing.assert_allclose(double.mass_matrix(q0), 2 * planar_chart.problem.robot.mass_matrix(q0), rtol=1e-12)
    with pytest.raises(InvalidValueError, match="factor is -1"):
        double.with_scaled_masses([1, -1, 1])


def test_kinematic_feedback_pulls_errors_in(planar_chart: oc.Chart, q0: Array) -> None:
    """E(t) = exp(-Lambda t) e(0) in every coordinate."""
    law, start = Kinematic(planar_chart, [1.0, 2.0, 3.0]), q0 + np.array([0.05, -0.05, 0.03])
    run = simulate(law, resting(planar_chart, q0, 1.0), start)
    e = run.value - run.reference
    np.testing.assert_allclose(e, e[0] * np.exp(-run.times[:, None] * [1.0, 2.0, 3.0]), atol=1e-7)
    assert np.isnan(run.storage).all()
    np.testing.assert_array_equal(run.dq, run.command)


def test_unreachable_reference_is_reported_before_the_run(planar_chart: oc.Chart, q0: Array) -> None:
    away = Reference.steps(planar_chart.labels, planar_chart.phi(q0), [(1.0, {"xi1": -2.0})], 3.0)
    seen: list[Progress] = []
    with pytest.raises(UnreachableReferenceError, match="leaves the domain at t = 1"):
        simulate(Impedance(planar_chart, K), away, q0, monitor=seen.append)
    assert not seen
    run = simulate(Impedance(planar_chart, K, limit=20.0), away, q0, must_be_reachable=False)
    assert run.outcome is Outcome.COMPLETE
    first = np.flatnonzero(run.status == ControlStatus.OUTSIDE_DOMAIN)[0]
    assert not oc.contains(planar_chart.problem.domain, run.q[first])
    assert np.isfinite(run.command).all()


@pytest.mark.slow
def test_interrupt_keeps_what_was_simulated(planar_chart: oc.Chart, steps: Reference, q0: Array) -> None:
    for rate in (None, 500.0):

        def press(progress: Progress) -> None:
            if progress.fraction > 0.3:
                raise KeyboardInterrupt

        with pytest.raises(Interrupted) as stop:
            simulate(PDPlus(planar_chart, K), steps, q0, control_rate=rate, monitor=press)
        run = stop.value.result
        assert run.outcome is Outcome.INTERRUPTED
        assert 0.3 * 8 < run.times[-1] < 0.4 * 8
        assert len(run.q) == len(run.times) == len(run.command) == len(run.storage)


def test_run_that_blows_up_is_told(planar_chart: oc.Chart, q0: Array) -> None:
    """Damping that is far too strong for 20 ticks a second, without walls to stop it."""
    robot = planar_chart.problem.robot
    problem = oc.Problem(robot, planar_chart.problem.task, "inertia", oc.Torus(3))
    law = Projector(problem, 1e7, 1e7, 5.0)
    still = Reference.steps(law.labels, law.measured(q0).full().ravel(), [], 5.0)
    run = simulate(law, still, q0 + 0.1, control_rate=20.0)
    assert run.outcome is Outcome.DIVERGED
    assert run.times[-1] < 5.0
    assert np.isfinite(run.q).all()


def test_progress_is_told(planar_chart: oc.Chart, q0: Array) -> None:
    seen: list[Progress] = []
    simulate(Impedance(planar_chart, K), resting(planar_chart, q0, 2.0), q0, monitor=seen.append)
    fractions = [progress.fraction for progress in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1.0)
    assert seen[0].stage == "simulate impedance"


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"q_start": np.zeros(2)}, ShapeError, r"q_start has shape \(2,\)"),
        ({"q_start": [0.0, np.nan, 0.0]}, InvalidValueError, r"q_start\[1\] is nan"),
        ({"dq_start": np.zeros(4)}, ShapeError, "dq_start"),
        ({"step": 0.0}, InvalidValueError, "step is 0.0"),
        ({"control_rate": -1.0}, InvalidValueError, "control_rate is -1.0"),
        ({"tolerance": np.nan}, InvalidValueError, "tolerance is nan"),
        ({"plant": oc.Robot.planar([1, 1], [1, 1])}, InvalidValueError, "joints of the plant is 2"),
        ({"pushes": [Push(0.0, 1.0, torque=[1.0])]}, ShapeError, "torque of a push"),
        ({"friction": Friction(viscous=-1.0)}, InvalidValueError, "viscous"),
        ({"step": "a"}, InvalidValueError, "step is 'a'"),
        ({"pushes": [Push(0.5, 0.1)]}, InvalidValueError, "start of a push is 0.5, expected a time before the end"),
        ({"q_start": [2.0, 2.0, 2.0]}, UnreachableReferenceError, "the start lies outside the domain: joint 'q"),
    ],
)
def test_bad_arguments_are_refused(
    planar_chart: oc.Chart, q0: Array, change: dict[str, Any], error: type[Exception], words: str
) -> None:
    arguments = {"q_start": q0, **change}
    with pytest.raises(error, match=words):
        simulate(Impedance(planar_chart, K), resting(planar_chart, q0, 0.5), **arguments)


def test_what_would_be_ignored_is_refused(planar_chart: oc.Chart, q0: Array) -> None:
    still = resting(planar_chart, q0, 0.5)
    with pytest.raises(InvalidValueError, match="forces do not affect a velocity controller"):
        simulate(Kinematic(planar_chart), still, q0, pushes=[Push(0.0, 0.1)])
    heavy = planar_chart.problem.robot.with_scaled_masses(2.0)
    with pytest.raises(InvalidValueError, match="forces do not affect a velocity controller"):
        simulate(Kinematic(planar_chart), still, q0, plant=heavy)
    with pytest.raises(InvalidValueError, match="velocity is not a state"):
        simulate(Kinematic(planar_chart), still, q0, dq_start=np.zeros(3))
    with pytest.raises(InvalidValueError, match=r"labels of the reference is \('x', 'xi1', 'xi2'\)"):
        simulate(KinematicProjector(planar_chart.problem), still, q0)
    with pytest.raises(InvalidValueError, match="duration of a push"):
        Push(0.0, 0.0)
    with pytest.raises(InvalidValueError, match="position noise"):
        Noise(-1.0)
