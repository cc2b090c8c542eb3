"""The supervised law with inputs that cannot be used: measurements, references, periods."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from programs import built, needs_c
from supervised import TICK, Arm, at_rest, run

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor
from orthocas.codegen.generated import GeneratedC
from orthocas.control import ControlStatus

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


def test_a_reference_that_comes_to_rest_is_never_stale(
    supervisor: Supervisor, supervised_library: CompiledLibrary, planar_for_control: oc.Chart
) -> None:
    """The low pass approaches its target for ever, but its value stops where the last bit stops changing."""
    q = planar_for_control.problem.domain.centre
    supervisor.start(q)
    reference = at_rest(planar_for_control, q)
    target = reference[:3] + np.array([1e-3, 0.0, 0.0])
    for _ in range(15_000):
        supervised_library.low_pass(reference, target, 3.0, 0.7, TICK)
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
def test_a_million_hostile_ticks_stay_bounded_with_the_right_status(supervised_c: GeneratedC, tmp_path: Path) -> None:
    """Under the address and undefined-behaviour sanitizers; the program itself checks commands, states and statuses."""
    flags = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = built(supervised_c, "supervised_ticks.c", tmp_path, "-DTICKS=1000000L", "-DLIMIT=120.0", *flags)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.returncode}: {done.stderr}"
    counts = [int(word) for word in done.stdout.split()]
    assert sum(counts) == 1_000_000
    for status in ("OK", "SATURATED", "NEAR_BORDER", "CAUGHT", "RETURNING", "BAD_INPUT"):
        assert counts[ControlStatus[status]] > 50, (status, counts)  # each is met
