"""The supervised law in C: starts without a jump, catches at the boundary, holds, returns, hands over."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from baselines import Projector
from programs import needs_c
from supervised import TICK, Arm, at_rest, moving, run

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import Controller, ControlStatus, Impedance, Kinematic, PDPlus, Safety

pytestmark = needs_c


@pytest.mark.slow
def test_starts_anywhere_inside_without_a_jump(
    supervisor: Supervisor, planar_for_control: oc.Chart, supervised_law: Controller
) -> None:
    q = planar_for_control.problem.domain.centre + 0.5 * planar_for_control.problem.domain.half_width
    arm = Arm(planar_for_control.problem.robot, q)
    supervisor.start(q)
    before = planar_for_control.problem.robot.gravity(q)
    statuses, commands, speeds = run(supervisor, arm, np.zeros(9), 0.5)  # the reference is far away
    assert statuses[0] in (ControlStatus.OK, ControlStatus.SATURATED)
    steps = np.abs(np.diff(np.vstack([before, commands]), axis=0))
    assert steps.max() <= 1.0 + 1e-9  # N m per millisecond
    assert steps[0].max() < 0.2
    assert speeds.max() < 2.0


@pytest.mark.slow
def test_after_the_start_the_law_commands(
    supervisor: Supervisor, planar_for_control: oc.Chart, supervised_law: Controller
) -> None:
    q = planar_for_control.problem.domain.centre
    supervisor.start(q)
    arm = Arm(planar_for_control.problem.robot, q)
    run(supervisor, arm, at_rest(planar_for_control, q), 0.3)
    reference = at_rest(planar_for_control, q + 1e-5)
    command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
    want, _ = supervised_law.function(arm.q, arm.dq, *np.split(reference, 3), *supervised_law.gains.values())
    assert status is ControlStatus.OK
    assert supervisor.weight == 1.0
    np.testing.assert_allclose(command, want.full().ravel(), atol=1e-9)


@pytest.mark.slow
def test_pushed_out_it_is_caught_holds_and_returns_when_asked(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    domain = planar_for_control.problem.domain
    q = domain.centre + 0.9 * domain.half_width
    arm, reference = Arm(planar_for_control.problem.robot, q), at_rest(planar_for_control, q)
    supervisor.start(domain.centre)  # then the arm is led to the boundary
    supervisor.take_over(q, planar_for_control.problem.robot.gravity(q))
    push = np.array([0.0, 60.0, 0.0])
    statuses, commands, _ = run(supervisor, arm, reference, 0.6, lambda t: push * (0.1 < t < 0.4))
    assert ControlStatus.CAUGHT in statuses
    assert not domain.contains(arm.q)
    assert np.abs(np.diff(commands, axis=0)).max() <= 1.0 + 1e-9
    statuses, commands, speeds = run(supervisor, arm, reference, 2.0)
    assert set(statuses) == {ControlStatus.CAUGHT}
    assert speeds[-500:].max() < 0.01
    assert supervisor.cause in (ControlStatus.OUTSIDE_DOMAIN, ControlStatus.TOO_FAST)
    held = arm.q.copy()
    supervisor.resume()
    statuses, commands, speeds = run(supervisor, arm, reference, 12.0)
    assert statuses[0] is ControlStatus.RETURNING
    assert statuses[-1] in (ControlStatus.OK, ControlStatus.NEAR_BOUNDARY)
    assert domain.contains(arm.q)
    assert not np.allclose(held, arm.q, atol=0.01)
    assert speeds.max() < 0.8


@pytest.mark.slow
def test_the_catcher_takes_energy_and_never_adds_any(supervisor: Supervisor, planar_for_control: oc.Chart) -> None:
    """Kinetic energy plus the spring of the catcher does not rise, but for the errors of ticks and integration."""
    domain, robot = planar_for_control.problem.domain, planar_for_control.problem.robot
    supervisor.start(domain.centre)
    q = domain.centre + 0.85 * domain.half_width
    supervisor.take_over(q, robot.gravity(q))
    arm, reference = Arm(robot, q, np.full(3, 1.2)), at_rest(planar_for_control, q)
    stiffness, law = Safety.of(PDPlus.on_chart(planar_for_control)).brake_stiffness, []
    for _ in range(1600):
        command, _ = supervisor.step(arm.q, arm.dq, reference, TICK)
        if supervisor.mode == 1 and supervisor.weight == 0.0:
            e = arm.q - supervisor.anchor
            law.append(
                0.5 * arm.dq @ robot.mass_matrix(arm.q) @ arm.dq
                + 0.5 * stiffness * e @ supervisor.inertia.reshape(3, 3) @ e
            )
        arm.move(command, steps=20)
    energy = np.array(law)
    assert len(energy) > 1000
    assert energy[0] > 0.05
    assert (energy - np.minimum.accumulate(energy)).max() < 0.02 * energy[0]
    assert energy[-1] < 1e-6


@pytest.mark.slow
def test_a_start_outside_is_caught_and_brought_back_only_when_asked(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    domain = planar_for_control.problem.domain
    q = domain.centre + 1.3 * domain.half_width
    arm = Arm(planar_for_control.problem.robot, q)
    supervisor.start(q)
    statuses, _, _ = run(supervisor, arm, at_rest(planar_for_control, domain.centre), 1.0)
    assert set(statuses) == {ControlStatus.CAUGHT}
    np.testing.assert_allclose(arm.q, q, atol=1e-3)
    supervisor.resume()
    statuses, _, speeds = run(supervisor, arm, at_rest(planar_for_control, supervisor.safe), 3.0)
    assert ControlStatus.RETURNING in statuses
    assert statuses[-1] is ControlStatus.OK
    assert domain.contains(arm.q)
    assert speeds.max() < 1.5


@pytest.mark.slow
def test_another_chart_takes_over_while_the_arm_moves(
    supervisor: Supervisor, planar_for_control: oc.Chart, supervised_law: Controller, tmp_path: Path
) -> None:
    """The next reference is that of the posture asked for now, so that the torque hardly changes."""
    other = oc.fit(
        planar_for_control.problem, oc.Polynomial(4), weights=(1000, 30, 150, 0.1, 1000), samples=1500, seed=5
    ).chart
    next_law = PDPlus.on_chart(other, limit=120.0)
    generated = oc.generate_c(other, tmp_path, next_law, "arm")
    after = Supervisor(CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3), next_law)
    q = planar_for_control.problem.domain.centre
    wanted = np.array([0.2, -0.1, 0.15])  # joint velocity
    arm = Arm(planar_for_control.problem.robot, q, wanted)
    supervisor.take_over(q, planar_for_control.problem.robot.gravity(q))
    for k in range(200):
        command, _ = supervisor.step(arm.q, arm.dq, moving(planar_for_control, q + k * TICK * wanted, wanted), TICK)
        arm.move(command)
    after.take_over(arm.q, command)
    statuses = []
    for k in range(200, 400):
        before = command
        command, status = after.step(arm.q, arm.dq, moving(other, q + k * TICK * wanted, wanted), TICK)
        assert np.abs(command - before).max() <= 1.0 + 1e-9
        arm.move(command)
        statuses.append(status)
    assert set(statuses) <= {ControlStatus.OK, ControlStatus.SATURATED}
    np.testing.assert_allclose(arm.q, q + 400 * TICK * wanted, atol=2e-3)


def without_a_chart(chart: oc.Chart) -> Controller:
    return Projector(chart.problem, 100.0, 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("make", [Impedance.on_chart, Kinematic.on_chart, without_a_chart])
def test_every_law_can_be_supervised(
    planar_for_control: oc.Chart, tmp_path: Path, make: Callable[..., Controller]
) -> None:
    other = make(planar_for_control)
    generated = oc.generate_c(planar_for_control, tmp_path, other, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path, ("-O1", "-Wconversion", "-Wshadow")), "arm", 3)
    supervisor, q = Supervisor(library, other), planar_for_control.problem.domain.centre
    k = len(other.labels)
    value = np.asarray(other.measured(q)).ravel()
    reference = np.concatenate([value, np.zeros(2 * k)])
    supervisor.start(q)
    for _ in range(300):
        command, status = supervisor.step(q, np.zeros(3), reference, TICK)
    assert status is ControlStatus.OK
    want = other.fallback(q, *other.gains.values()).full().ravel()
    np.testing.assert_allclose(command, want, atol=1e-9)
