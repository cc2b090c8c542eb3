"""Pushes, friction and wrong masses in closed loops."""

import numpy as np
import pytest
from closed_loops import K, resting

import orthocas as oc
from orthocas.control import Impedance, PDPlus, Reference
from orthocas.errors import InvalidValueError
from orthocas.simulation import (
    Friction,
    Push,
    simulate,
)
from orthocas.tools.checks import Array


@pytest.mark.slow
def test_push_displaces_as_far_as_the_stiffness_lets_it(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """At rest under a constant force F at the tip: J^T K (phi - phi_d) = J_tip^T F."""
    robot = planar_chart.problem.robot
    push = Push(0.1, 60.0, force=(4.0, 2.0, 0.0), torque=(0.1, 0.0, -0.1))
    run = simulate(Impedance(planar_chart, 400.0), resting(planar_chart, planar_q0, 30.0), planar_q0, pushes=[push])
    q = run.q[-1]
    assert np.abs(run.dq[-1]).max() < 1e-5
    spring = planar_chart.jacobian(q).T @ (400.0 * (planar_chart.phi(q) - planar_chart.phi(planar_q0)))
    np.testing.assert_allclose(spring, robot.tip_jacobian(q)[:3].T @ push.force + push.torque, atol=1e-3)
    assert np.abs(q - planar_q0).max() > 1e-3
    before = run.times <= 0.1
    assert np.abs(run.q[before] - planar_q0).max() < 1e-9


def test_push_ends(planar_chart: oc.Chart, planar_q0: Array) -> None:
    run = simulate(
        Impedance(planar_chart, 400.0),
        resting(planar_chart, planar_q0, 20.0),
        planar_q0,
        pushes=[Push(0.1, 0.2, (20.0, 0.0, 0.0))],
    )
    assert np.abs(run.q - planar_q0).max() > 5e-3
    assert np.abs(run.q[-1] - planar_q0).max() < 1e-4


def test_events_that_differ_by_rounding_are_one(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """0.1 + 0.2 is not 0.3 in binary numbers."""
    phi = planar_chart.phi(planar_q0)
    reference = Reference.steps(planar_chart.labels, phi, [(0.3, {"xi1": 0.02})], 1.0)
    run = simulate(Impedance(planar_chart, K), reference, planar_q0, pushes=[Push(0.1, 0.2, (5.0, 0.0, 0.0))])
    assert (np.diff(run.times) > 0).all()
    assert np.isfinite(run.energy_balance).all()


@pytest.mark.slow
def test_friction_takes_its_energy(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """V falls by what damping and friction take, the integral of dq . tau_f."""
    friction = Friction(viscous=0.3, coulomb=[0.2, 0.1, 0.0])
    run = simulate(
        Impedance(planar_chart, K),
        resting(planar_chart, planar_q0, 1.0),
        planar_q0 + 0.1,
        step=1e-3,
        friction=friction,
        tolerance=1e-10,
    )
    torque = 0.3 * run.dq + np.array([0.2, 0.1, 0.0]) * np.tanh(run.dq / 0.01)
    taken = np.trapezoid((run.dq * torque).sum(axis=1), run.times)
    assert run.energy_balance[-1] == pytest.approx(-taken, rel=1e-4)
    assert taken > 0.01


@pytest.mark.slow
def test_wrong_masses_are_felt(planar_chart: oc.Chart, planar_steps: Reference, planar_q0: Array) -> None:
    heavy = planar_chart.problem.robot.with_scaled_masses([1.1, 1.2, 1.3])
    np.testing.assert_allclose(heavy.tree.masses, 3 * np.array([1.1, 1.2, 1.3]))
    law = PDPlus(planar_chart, K)
    right, wrong = (
        simulate(law, planar_steps, planar_q0, plant=plant, must_be_reachable=False) for plant in (None, heavy)
    )
    assert wrong.tracking_error[0] > 100 * right.tracking_error[0]
    double = planar_chart.problem.robot.with_scaled_masses(2.0)
    np.testing.assert_allclose(
        double.mass_matrix(planar_q0), 2 * planar_chart.problem.robot.mass_matrix(planar_q0), rtol=1e-12
    )
    with pytest.raises(InvalidValueError, match="factor is -1"):
        double.with_scaled_masses([1, -1, 1])
