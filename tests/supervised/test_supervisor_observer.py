"""The observer of velocities in the supervised law: its formula, and where it begins anew."""

import numpy as np
import pytest
from programs import needs_c
from supervised import TICK, at_rest

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor
from orthocas.control import Controller, ControlStatus, Safety

pytestmark = needs_c

RATES = np.array([40.0, 60.0, 80.0])


@pytest.fixture
def observed(supervised_library: CompiledLibrary, supervised_law: Controller) -> Supervisor:
    return Supervisor(supervised_library, supervised_law, Safety.of(supervised_law, observer_rate=RATES))


def test_the_observer_is_a_filter_with_three_equal_poles_around_the_model(
    observed: Supervisor, planar_for_control: oc.Chart
) -> None:
    """Its polynomial, from Pinocchio's forward dynamics: what is left of an error obeys (z - p)^3."""
    chart, robot = planar_for_control, planar_for_control.problem.robot
    q, rng = chart.problem.domain.centre, np.random.default_rng(3)
    observed.start(q)
    command, _ = observed.step(q, np.zeros(3), at_rest(chart, q), TICK)
    state, p = np.array([q, 0 * q, 0 * q]), np.exp(-RATES * TICK)  # position, velocity, unexplained acceleration
    gains = np.array([1 - p**3, 1.5 * (1 - p) ** 2 * (1 + p) / TICK, (1 - p) ** 3 / TICK**2])
    step = np.array([[1, TICK, TICK**2 / 2], [0, 1, TICK], [0, 0, 1]])
    for i in range(3):
        left = step - np.outer(gains[:, i], step[0])
        np.testing.assert_allclose(np.poly(left), np.poly([p[i]] * 3), atol=1e-12)
    for k in range(200):
        ddq = robot.forward_dynamics(state[0], state[1], command)
        state[0], state[1] = (
            state[0] + TICK * state[1] + TICK**2 / 2 * (ddq + state[2]),
            state[1] + TICK * (ddq + state[2]),
        )
        measured = q + 1e-3 * np.sin(0.05 * k) + 1e-3 * rng.normal(size=3)
        command, _ = observed.step(measured, rng.normal(size=3), at_rest(chart, q), TICK)
        state = state + gains * (measured - state[0])
        np.testing.assert_allclose(observed.q, state[0], rtol=1e-12)
        np.testing.assert_allclose(observed.dq, state[1], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(observed.unexplained, state[2], rtol=1e-9, atol=1e-10)


def test_it_begins_anew_after_starts_brakes_missing_measurements_and_jumps(
    observed: Supervisor, planar_for_control: oc.Chart
) -> None:
    """There it takes what is measured, and knows of no acceleration."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    slow, reference = np.array([0.1, -0.2, 0.3]), at_rest(planar_for_control, q)
    wrong = np.full(3, np.nan)

    def settled() -> None:
        observed.start(q)
        for k in range(100):
            observed.step(q + 1e-3 * (k % 7), 0 * q, reference, TICK)
        assert np.abs(observed.dq).max() > 1e-3
        assert np.abs(observed.unexplained).max() > 1e-3

    def is_new(moved: float = 0.0) -> bool:
        observed.step(q + moved, slow, reference, TICK)
        return bool((observed.dq == slow).all() and not observed.unexplained.any())

    settled()
    assert not is_new()
    settled()
    observed.start(q)
    assert is_new()
    settled()
    observed.take_over(q, chart.problem.robot.gravity(q))
    assert is_new()
    settled()
    observed.hold(q)
    assert is_new()
    observed.release(q)
    assert not observed.expected.any()
    settled()
    assert is_new(0.2)
    for missing in (9, 11):
        settled()
        for _ in range(missing):
            observed.step(wrong, 0 * q, reference, TICK)
        assert is_new() == (missing == 11)
    settled()
    for _ in range(9):  # it goes on with what it expected
        before = observed.q, observed.dq
        observed.step(wrong, 0 * q, reference, TICK)
        np.testing.assert_allclose(observed.dq - before[1], TICK * observed.expected, rtol=1e-9)
        np.testing.assert_allclose(observed.q - before[0], TICK * (before[1] + observed.dq) / 2, rtol=1e-6)


def test_the_catcher_of_a_fast_arm_damps_what_is_observed(observed: Supervisor, planar_for_control: oc.Chart) -> None:
    """Joints pass 1 rad/s, and counts of 2 mrad claim 0 or 2 rad/s: the estimate is within a quarter of the truth, and
    the catcher's torque changes by less than its limit of 1 N m a tick. Before, the law held against the motion with
    all of its 120 N m, which takes a quarter of a second to go."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    reference, speed, commands = at_rest(chart, q), np.array([1.0, -1.0, 1.0]), []
    observed.start(q)
    seen = q
    for k in range(900):
        counted = q + 0.002 * np.round(k * TICK * speed / 0.002)
        period = 1.0 if k == 0 else TICK
        command, status = observed.step(counted, (counted - seen) / TICK, reference, period)
        commands.append(command)
        seen = counted
    assert status is ControlStatus.CAUGHT
    np.testing.assert_allclose(observed.dq, speed, atol=0.25)
    assert np.abs(np.diff(commands[700:], axis=0)).max() < 1.0


def test_of_an_arm_that_nobody_sees_it_foresees_what_torques_do_once(
    observed: Supervisor, planar_for_control: oc.Chart
) -> None:
    """Sensors stand still as joints speed up: the speeds that the catcher brakes are those of the arm, within 10 %."""
    chart, robot, dq = planar_for_control, planar_for_control.problem.robot, np.zeros(3)
    q = chart.problem.domain.centre
    observed.start(q)
    reference, seen = at_rest(chart, q), (q, dq)
    for k in range(60):
        reference[0] += 0.1 * (k == 40)
        if k < 44:
            seen = q, dq
        command, status = observed.step(*seen, reference, TICK)
        if observed.mode == 1 and k > 44:
            break
        dq = dq + TICK * robot.forward_dynamics(q, dq, command)
        q = q + TICK * dq
    assert status is ControlStatus.BAD_INPUT
    assert np.abs(dq).max() > 0.05
    np.testing.assert_allclose(observed.dq, dq, atol=0.1 * np.abs(dq).max())
