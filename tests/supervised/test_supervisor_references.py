"""References of the supervised law in C: limits in joint space, streams of targets, the pace along a path."""

from pathlib import Path

import numpy as np
import pytest
from baselines import Projector
from programs import needs_c
from supervised import TICK, Arm, at_rest, moving

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import Controller, ControlStatus, Safety
from orthocas.tools.checks import Array

pytestmark = needs_c


def begun(supervisor: Supervisor, chart: oc.Chart, q: Array) -> Array:
    """A reference at rest at q, where the law commands."""
    supervisor.start(q)
    for _ in range(100):
        supervisor.step(q, np.zeros(chart.n), at_rest(chart, q), TICK)
    assert supervisor.mode == 0
    return at_rest(chart, q)


def fastest_joints(chart: oc.Chart, q: Array, rates: Array) -> Array:
    """Of the joint rates that make rates (N, n) of phi at joint positions (N, n), (N,)."""
    return np.asarray(np.abs(np.linalg.solve(chart.jacobian(q), rates[:, :, None])).max(axis=(1, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["far", "jumps", "fast", "claimed"])
def test_no_reference_moves_a_joint_faster_than_its_limit(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart, kind: str
) -> None:
    """Targets of 1e6, jumps, 5 a second, and such velocities without a motion: each joint stays below 1 rad/s."""
    chart, domain, rng = planar_for_control, planar_for_control.problem.domain, np.random.default_rng(7)
    supervisor = Supervisor(
        supervised_library,
        supervised_law,
        Safety.of(supervised_law, speed_limit=1.0, reference_speed=0.7, reference_acceleration=2.0),
    )
    reference, arm = begun(supervisor, chart, domain.centre), Arm(chart.problem.robot, domain.centre)
    home, signs, fastest = reference[:3].copy(), np.array([1.0, -1.0, 1.0]), 0.0
    for k in range(1500):
        if kind == "far":
            reference[:3] = home + 1e6 * signs
        if kind == "jumps" and k % 200 == 0:
            reference[:3] = chart.phi(domain.centre + 0.8 * domain.half_width * rng.uniform(-1, 1, 3))
        if kind == "fast":
            reference[:3] += 5 * TICK * signs
        if kind in ("fast", "claimed"):
            reference[3:6] = 5 * signs
        if kind == "claimed":
            reference[:3] = home + 1e-6 * (k % 2)
        command, _ = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command)
        fastest = max(fastest, np.abs(arm.dq).max())
        assert supervisor.mode != 0 or (supervisor.led <= 0.7 + 1e-9).all()
    assert fastest < 1.0
    if kind != "claimed":
        assert fastest > 0.05


@pytest.mark.slow
def test_a_reference_within_the_limits_reaches_the_law_as_it_is(
    supervisor: Supervisor, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    chart, q0 = planar_for_control, planar_for_control.problem.domain.centre
    begun(supervisor, chart, q0)
    for k in range(500):
        angle = 4 * k * TICK
        q, dq = q0 + 0.05 * (1 - np.cos(angle)), np.full(3, 0.2 * np.sin(angle))
        reference = moving(chart, q, dq)
        reference[6:] += chart.jacobian(q) @ np.full(3, 0.8 * np.cos(angle))
        command, status = supervisor.step(q, dq, reference, TICK)
        want, _ = supervised_law.function(q, dq, *np.split(reference, 3), *supervised_law.gains.values())
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
        if status is ControlStatus.OK:
            np.testing.assert_allclose(command, want.full().ravel(), atol=1e-7)
    assert status is ControlStatus.OK
    assert np.abs(supervisor.offset).max() < 1e-12


@pytest.mark.slow
def test_a_stream_keeps_its_limits_and_its_line_and_does_not_overshoot(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """A step of 0.3 rad that a free filter would follow at 0.5 rad/s: limits of 0.2 rad/s and 3 rad/s^2 hold."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    limits = Safety.of(supervised_law, reference_speed=0.2, reference_acceleration=3.0)
    supervisor = Supervisor(supervised_library, supervised_law, limits)
    reference, arm = begun(supervisor, chart, q), Arm(chart.problem.robot, q)
    start, target = reference[:3].copy(), chart.phi(q + np.array([0.3, -0.1, 0.2]))
    references, positions = np.empty((8000, 9)), np.empty((8000, 3))
    for k in range(8000):
        supervisor.stream(reference, target, 6.0, TICK)
        command, _ = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command)
        references[k], positions[k] = reference, arm.q
    way, gone = target - start, references[:, :3] - start
    shares = gone @ way / (way @ way)
    np.testing.assert_allclose(gone, shares[:, None] * way, atol=1e-9)
    assert (np.diff(shares) >= -1e-12).all()
    assert shares.max() <= 1 + 1e-9
    assert shares[-1] > 0.999
    speeds, accelerations = (fastest_joints(chart, positions, part) for part in np.split(references, 3, axis=1)[1:])
    assert 0.19 < speeds.max() < 0.2 * 1.2  # the filter remembers half a second of a J that changes
    assert accelerations.max() <= 3.0 * 1.05  # J is that of the arm


@pytest.mark.slow
def test_a_stream_towards_a_place_outside_ends_inside_the_boundary(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    chart, domain = planar_for_control, planar_for_control.problem.domain
    limits = Safety.of(supervised_law, reference_speed=0.3, reference_acceleration=0.5)
    supervisor = Supervisor(supervised_library, supervised_law, limits)
    reference, arm = begun(supervisor, chart, domain.centre), Arm(chart.problem.robot, domain.centre)
    target = reference[:3] + 3.0 * chart.jacobian(domain.centre) @ (domain.half_width * np.array([1.0, 0.2, -0.3]))
    for _ in range(5000):
        assert supervisor.stream(reference, target, 4.0, TICK) is ControlStatus.NEAR_BOUNDARY  # it stops before
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command)
        assert status in (ControlStatus.OK, ControlStatus.SATURATED, ControlStatus.NEAR_BOUNDARY)
    room = 1 - (np.abs(arm.q - domain.centre) / domain.half_width).max()
    assert 0.08 < room < 0.12  # return_margin is 0.1
    home = chart.phi(domain.centre)
    for _ in range(9000):  # and comes back
        assert supervisor.stream(reference, home, 4.0, TICK) is ControlStatus.OK
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command)
    np.testing.assert_allclose(arm.q, domain.centre, atol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_a_stream_comes_to_rest_at_a_bad_target_and_goes_on_at_the_next_good_one(
    supervisor: Supervisor, planar_for_control: oc.Chart, bad: float
) -> None:
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    reference = begun(supervisor, chart, q)
    target = reference[:3] + np.array([0.05, -0.02, 0.03])
    for _ in range(100):
        assert supervisor.stream(reference, target, 6.0, TICK) is ControlStatus.OK
    spoiled, before = target.copy(), reference.copy()
    spoiled[1] = bad
    for _ in range(2000):
        assert supervisor.stream(reference, spoiled, 6.0, TICK) is ControlStatus.NOT_FINITE
    rest = before[:3] + 2 * before[3:6] / 6.0 + before[6:] / 36.0
    np.testing.assert_allclose(reference, np.concatenate([rest, np.zeros(6)]), atol=1e-4)
    for _ in range(3000):
        assert supervisor.stream(reference, target, 6.0, TICK) is ControlStatus.OK
    np.testing.assert_allclose(reference[:3], target, atol=1e-5)


@pytest.mark.parametrize("setting", [(np.nan, TICK), (0.0, TICK), (np.inf, TICK), (3.0, np.nan)])
def test_a_stream_refuses_settings_that_are_no_numbers(
    supervisor: Supervisor, planar_for_control: oc.Chart, setting: tuple[float, float]
) -> None:
    reference = begun(supervisor, planar_for_control, planar_for_control.problem.domain.centre)
    before = reference.copy()
    assert supervisor.stream(reference, reference[:3] + 0.1, *setting) is ControlStatus.NOT_FINITE
    np.testing.assert_array_equal(reference, before)


@pytest.mark.slow
def test_pace_keeps_a_path_that_is_asked_for_too_fast(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """A line and back in the joints, at up to 3 rad/s: at the pace of 0.3 rad/s, the joints follow it all the same."""
    chart, q0 = planar_for_control, planar_for_control.problem.domain.centre
    limits = Safety.of(supervised_law, reference_speed=0.3, reference_acceleration=1.0)
    supervisor = Supervisor(supervised_library, supervised_law, limits)
    begun(supervisor, chart, q0)
    arm, time, ticks, away, fastest = Arm(chart.problem.robot, q0), 0.0, 0, 0.0, 0.0
    size, rate = np.array([0.3, -0.2, 0.25]), 10.0
    while time < 2 * np.pi / rate and ticks < 10_000:
        q, dq = q0 + size / 2 * (1 - np.cos(rate * time)), size / 2 * rate * np.sin(rate * time)
        reference = moving(chart, q, dq)
        reference[6:] += chart.jacobian(q) @ (size / 2 * rate**2 * np.cos(rate * time))
        pace = supervisor.pace(reference, TICK)
        command, _ = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command)
        time, ticks = time + pace * TICK, ticks + 1
        away = max(away, np.linalg.norm(arm.q - q0 - (arm.q - q0) @ size / (size @ size) * size))
        fastest = max(fastest, np.abs(arm.dq).max())
    assert time >= 2 * np.pi / rate  # it ended
    assert ticks * TICK > 2 * 2 * np.pi / rate  # later than it asked for
    assert away < 0.005
    assert 0.25 < fastest < 0.4


@pytest.mark.slow
def test_a_stream_of_poses_turns_the_shorter_way(tmp_path: Path) -> None:
    """From 2.8 rad about x on one side of the reference orientation to 2.8 rad on the other side: 0.68 rad, not 5.6."""
    chart = oc.charts.load("panda-pose")
    law, task = Projector(chart.problem, 100.0, 10.0), chart.problem.task  # without a domain
    free = Safety.of(law, reference_speed=np.inf, reference_acceleration=np.inf)
    generated = oc.generate_c(chart, tmp_path, law, "arm", safety=free)
    supervisor = Supervisor(CompiledLibrary(compile_shared(generated, tmp_path), "arm", 7), law, free)
    q = chart.problem.domain.centre
    value = np.asarray(law.measured(q)).ravel()
    supervisor.start(q)
    supervisor.step(q, np.zeros(7), np.concatenate([value, np.zeros(26)]), TICK)

    def turned(angle: float) -> Array:
        return np.concatenate([value[:3], [2 * np.sin(angle / 2), 0.0, 0.0], value[6:]])

    def angle_of(x: Array) -> float:
        R = task.orientation_of(turned(2.8)[:6]).T @ task.orientation_of(x[:6])
        return float(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))

    reference = np.concatenate([turned(2.8), np.zeros(26)])
    target, angles = turned(-2.8), [angle_of(reference[:6])]
    for _ in range(3000):
        assert supervisor.stream(reference, target, 4.0, TICK) is ControlStatus.OK
        angles.append(angle_of(reference[:6]))
    assert np.diff(angles).max() / TICK < 1.0
    assert max(angles) == pytest.approx(2 * np.pi - 5.6, abs=1e-3)
    np.testing.assert_allclose(task.orientation_of(reference[:6]), task.orientation_of(target[:6]), atol=2e-3)
