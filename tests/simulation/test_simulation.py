"""Closed loops: against an independent integrator on Pinocchio's dynamics, couplings and energy books."""

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from baselines import Projector
from charts import with_metric
from closed_loops import K, resting, torque_at
from scipy.integrate import solve_ivp

import orthocas as oc
from orthocas.control import ControlStatus, Impedance, Kinematic, PDPlus, Reference
from orthocas.errors import InvalidValueError
from orthocas.problems import urdf_path
from orthocas.robots.pinocchio_model import build_planar
from orthocas.simulation import (
    Outcome,
    coupling_index,
    simulate,
    task_acceleration_breakdown,
)
from orthocas.tools.checks import Array


@pytest.mark.slow
def test_run_agrees_with_another_integrator_on_pinocchios_dynamics(
    planar_chart: oc.Chart, planar_steps: Reference, planar_q0: Array
) -> None:
    """SciPy's DOP853 with Pinocchio's forward dynamics, segment by segment."""
    model = build_planar([1, 1, 1], [3, 3, 3])
    data, law = model.createData(), PDPlus(planar_chart, K, coupling="decoupled")
    short = replace(
        planar_steps,
        times=np.array([0.0, 0.3, 1.5]),
        parameters=planar_steps.parameters[:2],
        targets=planar_steps.targets[:2],
    )
    run = simulate(law, short, planar_q0, step=0.05, tolerance=1e-11)
    state = np.concatenate([planar_q0, np.zeros(3)])
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
    assert np.abs(run.q[-1] - planar_q0).max() > 0.02


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


def test_coupled_pd_plus_tracks_with_any_regular_chart(planar_x: oc.Problem, planar_q0: Array) -> None:
    """Linear coordinates, far from orthogonal: what is left is the tolerance of the integrator."""
    chart = oc.fit(planar_x, oc.Linear()).chart
    phi = chart.phi(planar_q0)
    reference = Reference.steps(chart.labels, phi, [(0.2, {"x": phi[0] + 0.1}), (1.5, {"xi1": 0.04})], 3.0)
    coupled = simulate(PDPlus(chart, K), reference, planar_q0, tolerance=1e-10)
    decoupled = simulate(PDPlus(chart, K, coupling="decoupled"), reference, planar_q0, tolerance=1e-10)
    assert coupled.tracking_error.max() < 1e-7
    assert decoupled.tracking_error.max() > 1e-3


def test_good_coordinates_hardly_couple(planar_chart: oc.Chart, planar_steps: Reference, planar_q0: Array) -> None:
    run = simulate(PDPlus(planar_chart, K, coupling="decoupled"), planar_steps, planar_q0)
    assert run.outcome is Outcome.COMPLETE
    assert (run.status == ControlStatus.OK).all()
    coupling = coupling_index(planar_chart, planar_steps, run)
    assert coupling.of("x", "xi1") < 0.005
    assert coupling.of("xi1", "x") < 0.005
    assert np.isnan(coupling.of("x", "xi2"))  # never commanded
    np.testing.assert_allclose(run.q[-1], planar_q0, atol=1e-4)  # all targets are back


def test_coupling_index_reads_the_worst_excursion(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """A made-up run: x strays by 0.01 while xi1 is commanded by 0.05."""
    phi = planar_chart.phi(planar_q0)
    reference = Reference.steps(planar_chart.labels, phi, [(0.0, {"xi1": 0.05}), (2.0, {"x": 1.0, "xi2": 1.0})], 3.0)
    run = simulate(Kinematic(planar_chart), replace(reference, times=np.array([0.0, 2.0])), planar_q0)
    wanted = reference.sample(run.times)[0]
    wanted[len(run.times) // 2, 0] += 0.01
    strayed = replace(run, q=planar_chart.inverse(wanted, run.q))
    coupling = coupling_index(planar_chart, reference, strayed)
    assert coupling.of("x", "xi1") == pytest.approx(0.2, rel=1e-6)
    assert coupling.of("xi2", "xi1") < 1e-6
    assert np.isnan(coupling.index[:, [0, 2]]).all()  # two targets at once are left out


@pytest.mark.slow
def test_breakdown_adds_up_to_the_task_acceleration(
    planar_chart: oc.Chart, planar_steps: Reference, planar_q0: Array
) -> None:
    run = simulate(Impedance(planar_chart, K), planar_steps, planar_q0, step=0.002, tolerance=1e-11)
    parts = task_acceleration_breakdown(planar_chart, run)
    inner = run.times < 0.29  # before the first step everything rests
    assert np.abs(parts.total[inner]).max() < 1e-8
    moving = (run.times > 0.4) & (run.times < 1.9)
    t, dx = run.times[moving], np.einsum("ij,ij->i", planar_chart.jacobian(run.q)[:, 0], run.dq)[moving]
    slope = (dx[2:] - dx[:-2]) / (t[2:] - t[:-2])
    np.testing.assert_allclose(parts.total[moving][1:-1, 0], slope, atol=2e-4)  # differences of second order
    assert np.abs(parts.error).max() < 0.1 * np.abs(parts.coriolis).max()
    with pytest.raises(InvalidValueError, match="'kinematic'"):
        task_acceleration_breakdown(
            planar_chart, simulate(Kinematic(planar_chart), resting(planar_chart, planar_q0, 0.1), planar_q0)
        )


@pytest.mark.parametrize("law", [Impedance, PDPlus])
@pytest.mark.parametrize("damping", ["square_root", "double_diagonal"])
def test_energy_books_balance_and_storage_falls(
    planar_chart: oc.Chart, planar_q0: Array, law: Any, damping: Any
) -> None:
    """V(0) - V(t) is what the damping took: the closed loop is passive."""
    controller = law(planar_chart, K, 0.7, damping=damping)
    start, velocity = planar_q0 + np.array([0.1, -0.1, 0.05]), np.array([0.5, -0.4, 0.3])
    run = simulate(
        controller, resting(planar_chart, planar_q0, 3.0), start, dq_start=velocity, step=0.005, tolerance=1e-10
    )
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


def test_kinematic_feedback_pulls_errors_in(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """E(t) = exp(-Lambda t) e(0) in every coordinate."""
    law, start = Kinematic(planar_chart, [1.0, 2.0, 3.0]), planar_q0 + np.array([0.05, -0.05, 0.03])
    run = simulate(law, resting(planar_chart, planar_q0, 1.0), start)
    e = run.value - run.reference
    np.testing.assert_allclose(e, e[0] * np.exp(-run.times[:, None] * [1.0, 2.0, 3.0]), atol=1e-7)
    assert np.isnan(run.storage).all()
    np.testing.assert_array_equal(run.dq, run.command)
