"""Commands that are held between ticks, and noise."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loops import K, resting, torque_at
from scipy.integrate import solve_ivp

import orthocas as oc
from orthocas.control import Impedance, PDPlus, Reference
from orthocas.errors import InvalidValueError
from orthocas.simulation import (
    Noise,
    Push,
    simulate,
)
from orthocas.tools.checks import Array


@pytest.mark.slow
def test_sampled_control_approaches_continuous_control(
    planar_chart: oc.Chart, planar_steps: Reference, planar_q0: Array
) -> None:
    """Held commands are late by half a tick: the difference falls with the rate, first order."""
    law = PDPlus(planar_chart, K)
    short = replace(
        planar_steps,
        times=np.array([0.0, 0.3, 1.5]),
        parameters=planar_steps.parameters[:2],
        targets=planar_steps.targets[:2],
    )
    end = simulate(law, short, planar_q0, tolerance=1e-10).q[-1]
    gaps = [
        np.abs(simulate(law, short, planar_q0, control_rate=rate).q[-1] - end).max() for rate in (100.0, 200.0, 400.0)
    ]
    assert gaps[0] / gaps[1] == pytest.approx(2.0, rel=0.3)
    assert gaps[1] / gaps[2] == pytest.approx(2.0, rel=0.3)


def test_sampled_run_holds_commands_between_ticks(
    planar_chart: oc.Chart, planar_steps: Reference, planar_q0: Array
) -> None:
    law = Impedance(planar_chart, K)
    run = simulate(law, planar_steps, planar_q0, control_rate=130.0)  # 1040 ticks, not a multiple of what one call runs
    assert len(run.times) == 1041
    np.testing.assert_allclose(np.diff(run.times), 1 / 130)
    k = 200
    held = torque_at(law, planar_steps, float(run.times[k]), run.q[k], run.dq[k])
    np.testing.assert_allclose(run.command[k], held, rtol=1e-10)
    solution = solve_ivp(
        lambda _, s: np.concatenate([s[3:], planar_chart.problem.robot.forward_dynamics(s[:3], s[3:], held)]),
        (0, 1 / 130),
        np.concatenate([run.q[k], run.dq[k]]),
        rtol=1e-10,
        atol=1e-12,
    )
    np.testing.assert_allclose(solution.y[:3, -1], run.q[k + 1], atol=1e-8)


def test_short_push_keeps_its_impulse_between_ticks(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """Sampled control: loads are averaged over ticks, so 0.8 ms move the arm as in continuous time."""
    law, still = Impedance(planar_chart, K), resting(planar_chart, planar_q0, 0.5)
    pushes = [Push(0.1001, 0.0008, (10.0, 0.0, 0.0)), Push(0.1003, 0.0004, (0.0, 5.0, 0.0))]
    exact, sampled = (simulate(law, still, planar_q0, control_rate=rate, pushes=pushes) for rate in (None, 1000.0))
    peaks = [np.abs(run.q - planar_q0).max() for run in (exact, sampled)]
    assert peaks[1] == pytest.approx(peaks[0], rel=0.05)
    alone = simulate(law, still, planar_q0, pushes=pushes[:1])
    assert np.abs(alone.q - exact.q[: len(alone.q)]).max() > 0.05 * peaks[0]  # overlapping pushes add up


def test_noise_is_seeded_and_needs_ticks(planar_chart: oc.Chart, planar_q0: Array) -> None:
    law, still = Impedance(planar_chart, K), resting(planar_chart, planar_q0, 0.5)
    runs = [simulate(law, still, planar_q0, control_rate=200.0, noise=Noise(1e-3, 1e-2, seed)).q for seed in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert 1e-6 < np.abs(runs[0] - runs[2]).max() < 1e-2
    with pytest.raises(InvalidValueError, match="white noise needs control ticks"):
        simulate(law, still, planar_q0, noise=Noise(1e-3))


def test_noise_is_on_what_it_says(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """With position noise only, held commands scatter as the stiffness says; the record shows what was sent."""
    law, still = Impedance(planar_chart, 400.0), resting(planar_chart, planar_q0, 0.2)
    for noise, gain in ((Noise(1e-4, 0.0, 3), "q"), (Noise(0.0, 1e-4, 3), "dq")):
        run = simulate(law, still, planar_q0, control_rate=1000.0, noise=noise)
        errors = noise.sample(200, 3)
        k = 57
        measured = {"q": run.q[k] + errors[k, :3], "dq": run.dq[k] + errors[k, 3:]}
        quiet, noisy = (errors[:, 3:], errors[:, :3]) if gain == "q" else (errors[:, :3], errors[:, 3:])
        assert np.abs(quiet).max() == 0
        assert np.abs(noisy).max() > 0
        sent = torque_at(law, still, float(run.times[k]), measured["q"], measured["dq"])
        np.testing.assert_allclose(run.command[k], sent, rtol=1e-9)


def test_run_ends_with_its_reference(planar_chart: oc.Chart, planar_q0: Array) -> None:
    run = simulate(Impedance(planar_chart, K), resting(planar_chart, planar_q0, 1.0), planar_q0, control_rate=3.3)
    assert run.times[-1] <= 1.0
    with pytest.raises(InvalidValueError, match="at least one tick"):
        simulate(Impedance(planar_chart, K), resting(planar_chart, planar_q0, 0.1), planar_q0, control_rate=5.0)
