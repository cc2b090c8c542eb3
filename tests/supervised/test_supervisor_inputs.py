"""The supervised law with inputs that cannot be used: measurements, references, periods."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from programs import built, needs_c, nightly
from supervised import TICK, Arm, at_rest, moving, run

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, Supervisor, compile_shared
from orthocas.control import Controller, ControlStatus, PDPlus, Safety
from orthocas.simulation import Friction, MuJoCoPlant, StickingPlant
from orthocas.tools.checks import Array

pytestmark = needs_c


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_bad_measurements_hold_the_command_then_the_catcher_takes_over(
    supervisor: Supervisor, planar_for_control: oc.Chart, bad: float
) -> None:
    q = planar_for_control.problem.domain.centre
    reference = at_rest(planar_for_control, q)
    supervisor.start(q)
    for _ in range(400):
        before, _ = supervisor.step(q, np.zeros(3), reference, TICK)
    command, status = supervisor.step(np.array([q[0], bad, q[2]]), np.zeros(3), reference, TICK)
    assert status is ControlStatus.BAD_INPUT
    np.testing.assert_array_equal(command, before)
    assert supervisor.step(q, np.zeros(3), reference, TICK)[1] is ControlStatus.OK  # one bad tick does no harm
    for k in range(30):
        command, status = supervisor.step(q, np.array([0.0, bad, 0.0]), reference, TICK)
        assert status is ControlStatus.BAD_INPUT
        if k < 10:
            np.testing.assert_array_equal(command, before)
    command, status = supervisor.step(q, np.zeros(3), reference, TICK)
    assert status is ControlStatus.CAUGHT
    assert supervisor.cause == ControlStatus.BAD_INPUT
    np.testing.assert_allclose(command, planar_for_control.problem.robot.gravity(q), atol=1e-6)


def test_speeds_that_cannot_be_true_are_bad_measurements(supervisor: Supervisor, planar_for_control: oc.Chart) -> None:
    q = planar_for_control.problem.domain.centre
    supervisor.start(q)
    for _ in range(300):
        before, _ = supervisor.step(q, np.zeros(3), at_rest(planar_for_control, q), TICK)
    command, status = supervisor.step(q, np.array([0.0, 0.0, 1e6]), at_rest(planar_for_control, q), TICK)
    assert status is ControlStatus.BAD_INPUT
    np.testing.assert_array_equal(command, before)


@pytest.mark.slow
def test_a_great_speed_that_positions_agree_with_goes_to_the_catcher(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """After a blow the wrist turns at 33 times its limit. Single ticks are doubtful; the catcher brakes it."""
    chart, robot = planar_for_control, planar_for_control.problem.robot
    q, slow = chart.problem.domain.centre, Safety.of(supervised_law, speed_limit=0.3)
    supervisor, arm = Supervisor(supervised_library, supervised_law, slow), Arm(robot, q, np.array([0.0, 0.0, 9.9]))
    supervisor.start(q)
    for _ in range(100):
        supervisor.step(q, np.zeros(3), at_rest(chart, q), TICK)
    statuses, causes = [], []
    for _ in range(1500):
        command, status = supervisor.step(arm.q, arm.dq, at_rest(chart, q), TICK)
        arm.move(command, steps=20)
        statuses.append(status)
        causes.append(supervisor.cause)
    bad = np.flatnonzero(np.array(statuses) == ControlStatus.BAD_INPUT)
    assert len(bad) <= 5
    assert (np.diff(bad) > 1).all()
    assert set(statuses[10:]) <= {ControlStatus.CAUGHT, ControlStatus.BAD_INPUT}
    assert causes[10] in (ControlStatus.TOO_FAST, ControlStatus.OUTSIDE_DOMAIN)
    assert np.abs(arm.dq).max() < 0.5


def test_a_joint_that_swings_faster_than_its_limit_is_caught_though_it_turns_back_in_between(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """Up to 1.5 times the limit at 100 Hz: never faster than it for 5 ms without a break, but most of the time."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    slow = Safety.of(supervised_law, speed_limit=0.3)
    for peak, wanted in ((0.32, 0), (0.45, 1)):
        supervisor = Supervisor(supervised_library, supervised_law, slow)
        supervisor.start(q)
        for k in range(200):
            # from rest, so that the law takes over
            phase = 2 * np.pi * 100 * k * TICK
            swing = peak * np.array([0.0, 0.0, 1.0])
            place = q - swing * (np.cos(phase) - 1) / (2 * np.pi * 100)
            supervisor.step(place, swing * np.sin(phase), at_rest(chart, q), TICK)
        assert supervisor.mode == wanted  # the law, the catcher
        assert (supervisor.cause == ControlStatus.TOO_FAST) == bool(wanted)


@pytest.mark.slow
def test_a_spike_of_an_encoder_and_the_speed_made_from_it_are_bad_measurements(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    """Differences of q always agree with q: but a spike goes there and back."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    settled(supervisor, chart, q)
    spike = np.array([0.0, 1.0, 0.0])
    statuses = [
        supervisor.step(*state, at_rest(chart, q), TICK)[1]
        for state in ((q + spike, spike / TICK), (q, -spike / TICK), (q, 0 * q))
    ]
    assert statuses[:2] == [ControlStatus.BAD_INPUT] * 2
    assert statuses[2] in (ControlStatus.OK, ControlStatus.SATURATED)


def settled(supervisor: Supervisor, chart: oc.Chart, q: Array) -> Array:
    """The command at rest, after as many ticks with one measurement as one likes: nothing is wrong with that."""
    supervisor.start(q)
    for _ in range(2000):
        command, status = supervisor.step(q, np.zeros(3), at_rest(chart, q), TICK)
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
    return command


@pytest.mark.slow
def test_the_same_measurement_of_a_moving_arm_is_missing_after_five_ticks(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    for dq in (np.array([0.0, 1e-3, 0.0]), np.array([-0.5, 0.0, 0.0])):
        held = settled(supervisor, chart, q)
        for k in range(17):
            command, status = supervisor.step(q, dq, at_rest(chart, q), TICK)
            assert (status is ControlStatus.BAD_INPUT) == (k >= 5)
            # Back to what was commanded when they changed last, at the usual rate.
            if 10 <= k < 15:
                np.testing.assert_array_equal(command, held)
        assert supervisor.mode == 1  # the catcher, after hold_ticks
        assert supervisor.step(q, dq + 1e-9, at_rest(chart, q), TICK)[1] is ControlStatus.CAUGHT
        assert supervisor.cause == ControlStatus.BAD_INPUT


def test_sensors_that_freeze_in_motion_and_report_no_speed_do_not_make_the_arm_fast(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """A law that sees no speed pushes on. Friction could have stopped the arm later, but not so soon."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    dq, found = np.array([0.3, -0.3, 0.3]), {}
    for friction in (2.0, 1e3):  # as it is, and as if the arm could stop at once
        arm = Arm(chart.problem.robot, q, dq)
        supervisor = Supervisor(supervised_library, supervised_law, Safety.of(supervised_law, friction=friction))
        supervisor.take_over(q, chart.problem.robot.gravity(q))
        statuses, fastest = [], 0.0
        for k in range(300):
            if k <= 100:
                seen = arm.q, arm.dq if k < 100 else 0 * dq
            command, status = supervisor.step(*seen, moving(chart, q + k * TICK * dq, dq), TICK)
            arm.move(command)
            assert (supervisor.mode == 0) or k > 100
            if k >= 100:
                statuses.append(status)
                fastest = max(fastest, float(np.abs(arm.dq).max()))
        bad = np.array(statuses) == ControlStatus.BAD_INPUT
        found[friction] = fastest, int(bad.argmax()) if bad.any() else 200
    assert found[2.0][1] == 5
    assert found[2.0][0] < 1.0
    assert found[1e3][0] > 3.0
    assert found[1e3][1] > 10


@pytest.mark.parametrize(("which", "most"), [("positions", 1.0), ("speeds", 6.0), ("no speeds", 2.5), ("both", 1.0)])
def test_positions_that_freeze_alone_and_speeds_that_do_are_found(
    supervised_library: CompiledLibrary,
    supervised_law: Controller,
    planar_for_control: oc.Chart,
    which: str,
    most: float,
) -> None:
    """Of one joint, while the others go on. What is left of it damps the arm, which comes to rest.

    Speeds that freeze make a law push before they are found. Where both freeze, the model is right for some tenths of a
    second.
    """
    chart, q, joint = planar_for_control, planar_for_control.problem.domain.centre, 1
    dq = np.array([0.3, -0.3, 0.3])
    arm, supervisor = Arm(chart.problem.robot, q, dq), Supervisor(supervised_library, supervised_law)
    supervisor.take_over(q, chart.problem.robot.gravity(q))
    statuses, fastest = [], 0.0
    for k in range(400 if which == "both" else 1500):
        place, speed = arm.q.copy(), arm.dq.copy()
        if k == 100:
            frozen = place[joint]
        if k >= 100 and which in ("positions", "both"):
            place[joint] = frozen
        if k >= 100 and which != "positions":
            speed[joint] = 0.0 if which == "no speeds" else dq[joint]
        # Speeds that freeze show as the reference goes back.
        back = k > 150 and which == "speeds"
        wanted = moving(chart, q + TICK * (300 - k if back else k) * dq, -dq if back else dq)
        command, status = supervisor.step(place, speed, wanted if k < 400 else at_rest(chart, q), TICK)
        arm.move(command)
        statuses.append(status)
        fastest = max(fastest, np.abs(arm.dq).max())
    assert 100 < statuses.index(ControlStatus.BAD_INPUT) < 300
    assert supervisor.mode == 1
    assert supervisor.cause == ControlStatus.BAD_INPUT
    assert fastest < most
    assert np.abs(arm.dq).max() < 0.1


@pytest.mark.parametrize("lag", [0.0, 0.01])
def test_slow_sensors_and_speeds_that_lag_are_not_taken_for_frozen_ones(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart, lag: float
) -> None:
    """Encoders of 12 bits, read at 100 Hz, and speeds that a filter delays and rounds; a swing of 1 rad/s."""
    chart, q, count = planar_for_control, planar_for_control.problem.domain.centre, 2 * np.pi / 2**12
    safety = Safety.of(supervised_law, stale_ticks=20)
    supervisor = Supervisor(supervised_library, supervised_law, safety)
    supervisor.take_over(q, chart.problem.robot.gravity(q))
    slow, way = np.zeros(3), 0.1 * np.array([1.0, -1.0, 1.0])
    for k in range(1000):
        phase = 10 * TICK * k
        place, speed = q + way * (1 - np.cos(phase)), 10 * way * np.sin(phase)
        slow += (speed - slow) * (TICK / lag if lag else 1.0)
        if k % 10 == 0:
            seen = count * np.round(place / count), np.round(slow, 3)
        _, status = supervisor.step(*seen, moving(chart, place, speed), TICK)
        assert status is not ControlStatus.BAD_INPUT, k


def test_an_arm_that_friction_stops_measures_the_same_without_a_fault(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """Joints with the friction that the settings state stop within some ticks, and stick."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    friction = Safety.of(supervised_law).friction
    plant = StickingPlant(chart.problem.robot, friction=Friction(coulomb=0.9 * friction, breakaway=friction))
    for speed in (0.02, 0.05, 0.1):
        supervisor = Supervisor(supervised_library, supervised_law)
        plant.reset(q, np.array([speed, -speed, speed]))
        supervisor.take_over(q, chart.problem.robot.gravity(q))
        for k in range(150):
            command, status = supervisor.step(plant.q, plant.dq, at_rest(chart, q), TICK)
            assert status is not ControlStatus.BAD_INPUT, (speed, k)
            plant.step(command, TICK)
        assert supervisor.same_ticks > 20


@pytest.mark.slow
def test_a_measurement_now_and_then_is_enough(supervisor: Supervisor, planar_for_control: oc.Chart) -> None:
    """Sensors that are five times slower than the law, and equal measurements between others."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    settled(supervisor, chart, q)
    for k in range(1000):
        time, dq = TICK * 5 * (k // 5), np.array([0.1, 0.0, 1e-4 * (k // 5)])
        place = q + time * dq * np.array([1.0, 1.0, 0.5])
        assert supervisor.step(place, dq, moving(chart, place, dq), TICK)[1] is not ControlStatus.BAD_INPUT


@pytest.mark.slow
def test_spoiled_ticks_between_do_not_hide_that_sensors_stand_still(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    settled(supervisor, chart, q)
    dq, nowhere = np.array([0.3, 0.0, 0.0]), np.full(3, np.nan)
    for k in range(40):
        _, status = supervisor.step(nowhere if k % 4 == 3 else q, dq, at_rest(chart, q), TICK)
    assert status is ControlStatus.BAD_INPUT
    assert supervisor.mode == 1


@pytest.mark.slow
def test_a_simulated_arm_that_rests_starts_and_rests_again_is_not_taken_for_a_fault(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    """Without noise, an arm comes to rest at one double; dq may stay at 1e-18, where q + dt dq is q."""
    chart, domain = planar_for_control, planar_for_control.problem.domain
    arm, wanted = Arm(chart.problem.robot, domain.centre), domain.centre + 0.1 * domain.half_width
    supervisor.start(arm.q)
    reference, rested = at_rest(chart, domain.centre), []
    for k in range(2200):
        goal = wanted if 600 <= k < 1600 else domain.centre
        supervisor.stream(reference, chart.phi(goal), 5.0, TICK)
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command)
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
        rested.append(supervisor.same_ticks)
    assert rested[599] > 100  # it did come to rest, with a dq that is not 0
    assert np.abs(arm.dq).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 2.0])
def test_sensors_that_stand_still_at_rest_are_found_once_torques_must_have_moved_the_arm(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart, friction: float
) -> None:
    """dq is 0, and the reference asks for 0.5 rad/s of all joints; the arm itself would start, unseen."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    safety = Safety.of(supervised_law, friction=friction)
    supervisor = Supervisor(supervised_library, supervised_law, safety)
    held = settled(supervisor, chart, q)
    dq = np.array([0.5, -0.5, 0.5])
    statuses, impulse = [], np.zeros(3)
    for k in range(300):
        command, status = supervisor.step(q, np.zeros(3), moving(chart, q + k * TICK * dq, dq), TICK)
        statuses.append(status)
        if ControlStatus.BAD_INPUT not in statuses:
            # Friction may hold as much.
            before, moved = impulse, command - held
            impulse = before + TICK * (moved - np.clip(moved, -friction, friction))
            np.testing.assert_allclose(supervisor.impulse, impulse, atol=1e-12)
    first = statuses.index(ControlStatus.BAD_INPUT)
    M = chart.problem.robot.mass_matrix(q)
    assert (np.abs(np.linalg.solve(M, before)) <= safety.stuck_speed).all()
    assert (np.abs(np.linalg.solve(M, impulse)) > safety.stuck_speed).any()
    assert 5 <= first <= 100
    assert supervisor.mode == 1
    assert statuses[-1] is ControlStatus.BAD_INPUT  # until measurements change
    assert supervisor.step(q + 1e-9, np.zeros(3), at_rest(chart, q), TICK)[1] is ControlStatus.CAUGHT
    assert supervisor.cause == ControlStatus.BAD_INPUT


@pytest.mark.slow
def test_sensors_that_stand_still_on_the_way_back_are_found(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    """The catcher's anchor moves on at 0.3 rad/s, and its spring pulls at an arm that is said to stand."""
    chart, domain = planar_for_control, planar_for_control.problem.domain
    q = domain.centre + 1.3 * domain.half_width
    supervisor.start(q)
    for _ in range(1000):
        assert supervisor.step(q, np.zeros(3), at_rest(chart, q), TICK)[1] is ControlStatus.CAUGHT
    supervisor.resume()
    statuses = [supervisor.step(q, np.zeros(3), at_rest(chart, q), TICK)[1] for _ in range(300)]
    assert 5 < statuses.index(ControlStatus.BAD_INPUT) < 200
    assert set(statuses) == {ControlStatus.RETURNING, ControlStatus.BAD_INPUT}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-position", *nightly("iiwa7-position")])
def test_an_arm_in_mujoco_does_not_run_away_from_sensors_that_stand_still(name: str, tmp_path: Path) -> None:
    """It moves at 0.5 rad/s when its measurements freeze; 200 ms later it must not be faster than 3 rad/s."""
    pytest.importorskip("mujoco", minversion="4")
    chart = oc.charts.load(name)
    law, robot, domain = PDPlus.on_chart(chart), chart.problem.robot, chart.problem.domain
    library = CompiledLibrary(compile_shared(oc.generate_c(chart, tmp_path, law, "arm"), tmp_path), "arm", robot.n)
    size = 0.3 * np.minimum(domain.half_width, 1.0)
    speeds = {}
    for stale_ticks in (5, 10**6):  # as it is, and without the rule
        supervisor, plant = (
            Supervisor(library, law, Safety.of(law, stale_ticks=stale_ticks)),
            MuJoCoPlant(robot, stops=False),
        )
        plant.reset(domain.centre, np.full(robot.n, 0.5))
        supervisor.take_over(domain.centre, robot.gravity(domain.centre))
        for k in range(600):
            angle = 0.5 / size * k * TICK
            wanted = moving(chart, domain.centre + size * np.sin(angle), 0.5 * np.cos(angle))
            if k <= 400:
                seen = plant.q, plant.dq
            plant.step(supervisor.step(*seen, wanted, TICK)[0], TICK)
            if k == 400:
                assert supervisor.mode == 0
                assert np.abs(plant.dq).max() > 0.1
        speeds[stale_ticks] = np.abs(plant.dq).max()
    assert speeds[5] < 3.0
    assert speeds[10**6] > 10.0


BAD = (np.nan, np.inf, -np.inf, 1e300)


@pytest.mark.parametrize("bad", BAD)
def test_the_spline_stops_at_its_last_good_value(supervised_library: CompiledLibrary, bad: float) -> None:
    start, target = np.arange(9.0) / 10, np.array([0.3, -0.2, 0.1])
    good = supervised_library.spline(start, target, 1.0, 0.4)
    spoiled = target.copy()
    spoiled[1] = bad
    calls = [(spoiled, 1.0, 0.5), (target, bad, 0.5), (target, 1.0, bad)]
    for where, duration, time in calls:
        held = supervised_library.spline(start, where, duration, time, good)
        np.testing.assert_array_equal(held, np.concatenate([good[:3], np.zeros(6)]))
        np.testing.assert_array_equal(supervised_library.spline(start, target, 1.0, 0.4, held), good)


@pytest.mark.slow
def test_the_arm_follows_good_targets_again_after_a_bad_one(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    chart, domain = planar_for_control, planar_for_control.problem.domain
    arm, wanted = Arm(chart.problem.robot, domain.centre), domain.centre + 0.1 * domain.half_width
    supervisor.start(arm.q)
    reference, bad = at_rest(chart, domain.centre), np.full(3, np.nan)
    for k in range(3000):
        target = bad if 200 <= k < 600 else chart.phi(wanted if k >= 600 else domain.centre)
        supervisor.stream(reference, target, 5.0, TICK)
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
        arm.move(command)
    np.testing.assert_allclose(arm.q, wanted, atol=2e-3)


def test_a_bad_reference_is_held(supervisor: Supervisor, planar_for_control: oc.Chart) -> None:
    q = planar_for_control.problem.domain.centre
    supervisor.start(q)
    good, bad = at_rest(planar_for_control, q), at_rest(planar_for_control, q)
    bad[1] = np.nan
    for _ in range(300):
        before, _ = supervisor.step(q, np.zeros(3), good, TICK)
    command, status = supervisor.step(q, np.zeros(3), bad, TICK)
    assert status is ControlStatus.BAD_INPUT
    np.testing.assert_allclose(command, before, atol=1e-9)
    stale = good.copy()
    stale[3] = 0.1  # claims a velocity, stands still
    statuses = [supervisor.step(q, np.zeros(3), stale, TICK)[1] for _ in range(40)]
    assert statuses[5] is not ControlStatus.BAD_INPUT
    assert statuses[-1] is ControlStatus.BAD_INPUT


@pytest.mark.slow
def test_a_reference_that_comes_to_rest_is_never_stale(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """The stream approaches its target for ever, but its value stops where the last bit stops changing."""
    stands = Safety.of(supervised_law, stuck_speed=np.inf)  # the arm of this test, whatever it is asked for
    supervisor, q = Supervisor(supervised_library, supervised_law, stands), planar_for_control.problem.domain.centre
    supervisor.start(q)
    reference = at_rest(planar_for_control, q)
    target = reference[:3] + np.array([1e-3, 0.0, 0.0])
    for _ in range(15_000):
        supervisor.stream(reference, target, 3.0, TICK)
        _, status = supervisor.step(q, np.zeros(3), reference, TICK)
        assert status is not ControlStatus.BAD_INPUT
    assert np.abs(reference[3:6]).max() > 0


def test_a_late_tick_calls_the_catcher(supervisor: Supervisor, planar_for_control: oc.Chart) -> None:
    q = planar_for_control.problem.domain.centre
    supervisor.start(q)
    run(supervisor, Arm(planar_for_control.problem.robot, q), at_rest(planar_for_control, q), 0.3)
    assert supervisor.step(q, np.zeros(3), at_rest(planar_for_control, q), 0.3)[1] is ControlStatus.CAUGHT
    assert supervisor.cause == ControlStatus.LATE
    for period in (0.0, -1.0, np.nan, np.inf):
        assert supervisor.step(q, np.zeros(3), at_rest(planar_for_control, q), period)[1] is ControlStatus.BAD_INPUT


def test_a_start_without_a_measurement_waits_for_the_first_one(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    """Where the arm is decides whether the law may begin, not where an unreadable sensor was taken to be."""
    domain = planar_for_control.problem.domain
    outside, nowhere = domain.centre + 1.3 * domain.half_width, np.full(3, np.nan)
    supervisor.start(domain.centre)
    supervisor.step(nowhere, np.zeros(3), np.zeros(9), TICK)
    for _ in range(50):
        _, status = supervisor.step(outside, np.zeros(3), at_rest(planar_for_control, domain.centre), TICK)
    assert status is ControlStatus.CAUGHT


@pytest.mark.slow
def test_hostile_ticks_stay_bounded_with_the_right_status(supervised_c: GeneratedC, tmp_path: Path) -> None:
    """Under the address and undefined-behaviour sanitizers; the program itself checks commands, states and statuses."""
    flags = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = built(supervised_c, "supervised_ticks.c", tmp_path, "-DTICKS=300000L", "-DLIMIT=120.0", *flags)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.returncode}: {done.stderr}"
    counts = [int(word) for word in done.stdout.split()]
    assert sum(counts) == 300_000
    for status in ("OK", "SATURATED", "NEAR_BOUNDARY", "CAUGHT", "RETURNING", "BAD_INPUT"):
        assert counts[ControlStatus[status]] > 50, (status, counts)  # each is met


def test_joints_that_turn_without_end_may_report_any_number_of_whole_turns(
    supervised_library: CompiledLibrary, supervised_law: Controller
) -> None:
    """The joints of the planar arm have no limits; a sensor that starts at another turn changes nothing."""
    domain, commands = supervised_law.problem.domain, []
    q, wanted = domain.centre + 0.5 * domain.half_width, at_rest(supervised_law.chart, domain.centre)
    for turns in (np.zeros(3), 2 * np.pi * np.array([1.0, -3.0, 2.0])):
        supervisor = Supervisor(supervised_library, supervised_law, Safety.of(supervised_law, stuck_speed=np.inf))
        supervisor.start(q + turns)
        ticks = [supervisor.step(q + turns, np.zeros(3), wanted, TICK) for _ in range(100)]
        assert {status for _, status in ticks} <= {ControlStatus.OK, ControlStatus.SATURATED}
        commands.append(np.array([command for command, _ in ticks]))
    np.testing.assert_allclose(commands[1], commands[0], atol=1e-9)
    assert np.abs(commands[0] - supervised_law.problem.robot.gravity(q)).max() > 1.0


@pytest.mark.parametrize("period", [0.01, 0.02])
def test_slow_programs_may_lose_one_measurement_and_not_two(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart, period: float
) -> None:
    """A tick of 10 or 20 ms is as long as measurements may be missing at 1 kHz."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre - np.array([0.0, 0.0, 0.15])
    supervisor = Supervisor(supervised_library, supervised_law, Safety.of(supervised_law))
    supervisor.take_over(q, chart.problem.robot.gravity(q))
    target, at_place, lost = at_rest(chart, q), (q, np.zeros(3)), (np.full(3, np.nan), np.zeros(3))
    for measured, mode in [(at_place, 0), (lost, 0), (at_place, 0), (at_place, 0), (lost, 0), (lost, 1), (at_place, 1)]:
        _, status = supervisor.step(*measured, target, period)
        assert (status == ControlStatus.BAD_INPUT) == (measured is lost)
        assert supervisor.mode == mode


def test_slow_programs_see_no_more_acceleration_than_there_is(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """At 50 Hz, 1.5 rad/s^2 up to two thirds of the limit, with motors that take their time."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre - np.array([0.0, 0.0, 0.15])
    settings = Safety.of(supervised_law, speed_limit=1.2, command_rate=100.0)
    supervisor, way, period = Supervisor(supervised_library, supervised_law, settings), np.array([0.0, 0.0, 1.0]), 0.02
    supervisor.take_over(q, chart.problem.robot.gravity(q))
    for time in period * np.arange(27):
        place = q + 0.75 * time**2 * way
        supervisor.step(place, 1.5 * time * way, at_rest(chart, place + 0.05 * way), period)
        assert supervisor.mode == 0
