"""Settings of the supervised law, integral action, stops, and references in C."""

import ctypes
from pathlib import Path

import numpy as np
import pytest
from baselines import Projector
from programs import needs_c
from supervised import TICK, Arm, at_rest, run

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, Supervisor, compile_shared
from orthocas.control import Controller, ControlStatus, Kinematic, Safety
from orthocas.errors import InvalidValueError, ShapeError

pytestmark = needs_c


def test_settings_are_checked(supervised_law: Controller, planar_for_control: oc.Chart, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="setting is 'speed'"):
        Safety.of(supervised_law, speed=1.0)
    with pytest.raises(ShapeError, match="error_limit has shape"):
        Safety.of(supervised_law, error_limit=[1.0, 2.0])
    with pytest.raises(InvalidValueError, match="catch_margin < near_margin"):
        Safety.of(supervised_law, near_margin=0.5)
    with pytest.raises(InvalidValueError, match="fade_in is nan"):
        Safety.of(supervised_law, fade_in=np.nan)
    with pytest.raises(ShapeError, match="error_limit"):
        oc.generate_c(
            planar_for_control,
            tmp_path,
            supervised_law,
            "arm",
            safety=Safety.of(Projector(planar_for_control.problem, 100.0, 10.0)),
        )


def test_settings_in_c_are_those_of_python(
    supervised_c: GeneratedC, supervised_law: Controller, supervised_library: CompiledLibrary
) -> None:
    ours, theirs = (
        Supervisor(supervised_library, supervised_law),
        Supervisor(supervised_library, supervised_law, Safety.of(supervised_law)),
    )
    rng = np.random.default_rng(3)
    q = supervised_law.problem.domain.centre
    for supervisor in (ours, theirs):
        supervisor.start(q)
    for _ in range(200):
        state = (q + 0.1 * rng.normal(size=3) * 0.01, 0.1 * rng.normal(size=3), 0.1 * rng.normal(size=9))
        first, second = ours.step(*state), theirs.step(*state)
        np.testing.assert_array_equal(first[0], second[0])
        assert first[1] == second[1]


def test_margins_at_run_time_decide_where_the_law_starts(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    domain = planar_for_control.problem.domain
    q = domain.centre + 0.8 * domain.half_width
    for margin, wanted in ((0.1, 0), (0.3, 1)):
        supervisor = Supervisor(supervised_library, supervised_law, Safety.of(supervised_law, return_margin=margin))
        supervisor.start(q)
        supervisor.step(q, np.zeros(3), at_rest(planar_for_control, q), TICK)
        assert supervisor.mode == wanted  # the law, the catcher
        np.testing.assert_allclose(np.abs(supervisor.safe - domain.centre) <= (1 - margin) * domain.half_width, True)
    assert np.abs(supervisor.safe - domain.centre).max() < np.abs(q - domain.centre).max()


@pytest.mark.slow
def test_velocity_laws_carry_no_settings_of_torques(planar_for_control: oc.Chart, tmp_path: Path) -> None:
    law = Kinematic.on_chart(planar_for_control)
    generated = oc.generate_c(planar_for_control, tmp_path, law, "arm")
    header = (tmp_path / "arm.h").read_text()
    for name in ("brake_stiffness", "brake_yield", "stop_zone", "stop_damping"):
        assert name not in header
    library, q = (
        CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3),
        planar_for_control.problem.domain.centre,
    )
    commands = []
    for safety in (None, Safety.of(law), Safety.of(law, return_speed=0.1, damping=1.0)):
        supervisor = Supervisor(library, law, safety)
        supervisor.take_over(q, np.zeros(3))
        for k in range(60):  # the catcher after speeds beyond the limit
            command, _ = supervisor.step(
                q + 1e-4 * k, np.full(3, 20.0 * (30 <= k < 37)), at_rest(planar_for_control, q), TICK
            )
        assert supervisor.mode == 1  # the catcher
        commands.append(command)
    np.testing.assert_array_equal(commands[0], commands[1])
    assert np.abs(commands[2] - commands[0]).max() > 1e-4


@pytest.mark.slow
def test_integral_action_removes_sag_and_does_not_wind_up(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    q, heavier = planar_for_control.problem.domain.centre, planar_for_control.problem.robot.with_scaled_masses(1.2)
    sag = {}
    for rate in (0.0, 3.0):
        supervisor = Supervisor(supervised_library, supervised_law, Safety.of(supervised_law, integral_rate=rate))
        supervisor.start(q)
        arm = Arm(heavier, q)
        run(supervisor, arm, at_rest(planar_for_control, q), 5.0)
        sag[rate] = np.abs(arm.q - q).max()
        assert (np.abs(supervisor.integral) <= Safety.of(supervised_law).integral_limit + 1e-15).all()
    assert sag[3.0] < 0.01 * sag[0.0]
    assert sag[0.0] > 1e-3


@pytest.mark.slow
def test_springs_and_dampers_keep_away_from_joint_limits(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    q, speed = planar_for_control.problem.domain.centre, np.array([0.0, 0.02, 0.0])
    upper = q + np.array([1.0, 0.02, 1.0])
    settings, commands = Safety.of(supervised_law, stale_ticks=1000), []
    for safety in (settings, Safety.of(supervised_law, stale_ticks=1000, upper=upper, stop_zone=0.025)):
        supervisor = Supervisor(supervised_library, supervised_law, safety)
        supervisor.take_over(q, planar_for_control.problem.robot.gravity(q))
        for _ in range(400):  # until the limit of change is no matter any more
            towards, _ = supervisor.step(q, speed, at_rest(planar_for_control, q), TICK)
        for _ in range(400):
            away, _ = supervisor.step(q, -speed, at_rest(planar_for_control, q), TICK)
        commands += [towards, away]
    inertia = planar_for_control.problem.robot.mass_matrix(q)[1]  # an acceleration of joint 1 alone, in [N m]
    spring, damper = settings.stop_stiffness[1] * 0.005, settings.stop_damping[1] * 0.02
    np.testing.assert_allclose(commands[0] - commands[2], inertia * (spring + damper), atol=1e-9)
    np.testing.assert_allclose(commands[1] - commands[3], inertia * spring, atol=1e-9)


def test_references_equal_those_of_python(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """Without limits, a stream has three equal poles; the spline ends in its target."""
    chart = planar_for_control
    free = Safety.of(supervised_law, reference_speed=np.inf, reference_acceleration=np.inf)
    supervisor, q = Supervisor(supervised_library, supervised_law, free), chart.problem.domain.centre
    start = chart.phi(q)
    supervisor.start(q)
    supervisor.step(q, np.zeros(3), at_rest(chart, q), TICK)
    target = start + np.array([0.1, -0.1, 0.05])
    reference, t = at_rest(chart, q), 6.0 * 0.5
    for _ in range(500):
        supervisor.stream(reference, target, 6.0, TICK)
    left, rate, change = 1 + t + t**2 / 2, 6.0 * t**2 / 2, 36.0 * (t - t**2 / 2)  # times exp(-t)
    shares = np.array([1 - left * np.exp(-t), rate * np.exp(-t), change * np.exp(-t)])
    wanted = np.concatenate([start, np.zeros(6)]) + np.outer(shares, target - start).ravel()
    np.testing.assert_allclose(reference, wanted, atol=1e-9)
    moving = np.array([0.1, 0.2, 0.3, 1.0, -1.0, 0.5, 2.0, 0.0, -3.0])
    for time, want in ((0.0, moving), (0.8, np.concatenate([target, np.zeros(6)]))):
        np.testing.assert_allclose(supervised_library.spline(moving, target, 0.8, time), want, atol=1e-12)
    h = 1e-5
    low, middle, high = (supervised_library.spline(moving, target, 0.8, 0.3 + t) for t in (-h, 0.0, h))
    np.testing.assert_allclose((high - low)[:6] / (2 * h), middle[3:], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        *(("command_rate", bad) for bad in (np.nan, -np.inf, -1.0)),
        *(
            ("error_limit", np.nan),
            ("integral_limit", np.inf),
            ("brake_stiffness", np.inf),
            ("reference_speed", np.nan),
            ("upper", np.nan),
        ),
        *(("fade_in", 0.0), ("damping", np.inf), ("near_margin", 0.5), ("hold_ticks", -1)),
    ],
)
def test_settings_that_cannot_be_used_at_run_time_leave_the_last_good_ones(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart, name: str, bad: float
) -> None:
    """A supervisor whose settings go bad commands what one with good settings commands, and says so."""
    settings = Safety.of(supervised_law, command_rate=300.0)
    good, spoiled = (Supervisor(supervised_library, supervised_law, settings) for _ in range(2))
    q = planar_for_control.problem.domain.centre
    wanted = at_rest(planar_for_control, q)
    far = wanted + 0.3 * np.eye(9)[0]
    for supervisor in (good, spoiled):
        supervisor.start(q)
        for _ in range(50):
            assert supervisor.step(q, np.zeros(3), wanted, TICK)[1] is ControlStatus.OK
    struct = spoiled._safety.contents
    value = getattr(struct, name)
    if isinstance(value, ctypes.Array):
        value[0] = bad
    else:
        setattr(struct, name, bad)
    for k in range(100):
        expected, status = good.step(q + 1e-9 * (k % 2), np.zeros(3), far, TICK)
        command, told = spoiled.step(q + 1e-9 * (k % 2), np.zeros(3), far, TICK)
        np.testing.assert_array_equal(command, expected)
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
        assert told is ControlStatus.BAD_INPUT


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0, -np.inf])
def test_a_limit_that_cannot_be_used_leaves_the_last_good_one(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart, bad: float
) -> None:
    """The arm stays held: a limit of 0 was none of the torque against gravity before."""
    supervisor = Supervisor(supervised_library, supervised_law)
    q = planar_for_control.problem.domain.centre
    wanted = at_rest(planar_for_control, q)
    supervisor.start(q)
    limit = np.array([55.0, 50.0, 45.0])
    supervisor.gains = np.concatenate([supervisor.gains[:-3], limit])
    for _ in range(100):
        held, status = supervisor.step(q, np.zeros(3), wanted, TICK)
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
    supervisor.gains = np.concatenate([supervisor.gains[:-3], [limit[0], bad, limit[2]]])
    for _ in range(100):
        command, status = supervisor.step(q, np.zeros(3), wanted, TICK)
        assert status is ControlStatus.BAD_INPUT
    np.testing.assert_allclose(command, held, atol=1e-9)
    assert np.abs(command).max() > 1.0
    assert supervisor.mode == 0
    np.testing.assert_array_equal(supervisor.limit, limit)
