"""Brakes: what the supervised law commands while they hold the arm, and what happens when they open."""

import numpy as np
import pytest
from programs import needs_c
from supervised import TICK, Arm, at_rest, run

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor
from orthocas.control import Controller, ControlStatus, Safety

pytestmark = needs_c


@pytest.mark.slow
def test_nothing_jumps_when_brakes_open(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """The program goes on with its reference while brakes hold. Without `hold`, the law pushes against them."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    target, fastest = chart.phi(q + np.array([0.1, -0.1, 0.1])), {}
    for told in (True, False):
        supervisor = Supervisor(supervised_library, supervised_law)
        arm, reference = Arm(chart.problem.robot, q), at_rest(chart, q)
        supervisor.start(q)
        run(supervisor, arm, reference, 0.2)
        if told:
            supervisor.hold(arm.q)
        for k in range(2000):  # noise of sensors: the arm is not taken for one whose sensors stand still
            supervisor.stream(reference, target, 6.0, TICK)
            command, status = supervisor.step(arm.q + 1e-9 * (k % 2), np.zeros(3), reference, TICK)
            assert (status is ControlStatus.CAUGHT) == told
        if told:
            assert supervisor.cause == ControlStatus.HELD
            np.testing.assert_allclose(command, chart.problem.robot.gravity(q), atol=1e-6)
            supervisor.release(arm.q)
        _, _, speeds = run(supervisor, arm, reference, 0.5)
        fastest[told] = speeds.max()
    assert fastest[True] < 1e-3
    assert fastest[False] > 0.3


@pytest.mark.slow
def test_after_a_release_the_law_takes_over_where_the_arm_is_when_asked(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    chart, domain = planar_for_control, planar_for_control.problem.domain
    arm, moved = Arm(chart.problem.robot, domain.centre), domain.centre + 0.2 * domain.half_width
    supervisor.start(arm.q)
    run(supervisor, arm, at_rest(chart, arm.q), 0.2)
    supervisor.hold(arm.q)
    supervisor.resume()  # brakes still hold
    assert run(supervisor, arm, at_rest(chart, arm.q), 0.05)[0][-1] is ControlStatus.CAUGHT
    arm = Arm(chart.problem.robot, moved)  # somebody moved the arm by hand
    for _ in range(100):
        supervisor.step(moved, np.zeros(3), at_rest(chart, moved), TICK)
    supervisor.release(moved)
    statuses, _, speeds = run(supervisor, arm, at_rest(chart, domain.centre), 0.3)
    assert set(statuses) == {ControlStatus.CAUGHT}
    assert speeds.max() < 1e-3
    supervisor.resume()
    statuses, _, speeds = run(supervisor, arm, at_rest(chart, moved), 1.0)
    assert statuses[-1] is ControlStatus.OK
    assert speeds.max() < 0.05


def test_commands_go_on_from_the_torque_that_the_motors_report(
    supervisor: Supervisor, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """Motors that were off while brakes held begin at 0, and get 1 N m more in each millisecond."""
    q, still = planar_for_control.problem.domain.centre, np.zeros(3)
    gravity = planar_for_control.problem.robot.gravity(q)
    supervisor.start(q)
    supervisor.step(q, still, at_rest(planar_for_control, q), TICK)
    supervisor.hold(q, still)
    for k in range(100):
        command, status = supervisor.step(q, still, at_rest(planar_for_control, q), TICK)
        assert status is ControlStatus.CAUGHT  # also if measurements are the same, bit by bit
        np.testing.assert_allclose(command, np.clip(gravity, -1.0 - k, 1.0 + k), atol=1e-9)
    assert (Safety.of(supervised_law).command_rate == 1000.0).all()
    supervisor.release(q, gravity + 0.5)
    command, _ = supervisor.step(q, still, at_rest(planar_for_control, q), TICK)
    np.testing.assert_allclose(command, gravity, atol=1e-9)
