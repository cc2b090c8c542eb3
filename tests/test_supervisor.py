"""The supervised law in C: starts without a jump, catches at the border, holds, returns, and survives bad input."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from programs import built, needs_c

import orthocas as oc
from orthocas.checks import Array
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.codegen.generated import GeneratedC
from orthocas.control import Controller, ControlStatus, Impedance, Kinematic, PDPlus, Projector, Reference, Safety
from orthocas.errors import InvalidValueError, ShapeError

pytestmark = needs_c

TICK = 1e-3


@pytest.fixture(scope="module")
def chart(planar_for_control: oc.Chart) -> oc.Chart:
    return planar_for_control


@pytest.fixture(scope="module")
def law(chart: oc.Chart) -> Controller:
    return PDPlus.on_chart(chart, limit=120.0)


@pytest.fixture(scope="module")
def generated(chart: oc.Chart, law: Controller, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    return oc.generate_c(chart, tmp_path_factory.mktemp("supervised"), law, "arm")


@pytest.fixture(scope="module")
def library(generated: GeneratedC) -> CompiledLibrary:
    return CompiledLibrary(compile_shared(generated, generated.folder), "arm", 3)


@pytest.fixture
def supervisor(library: CompiledLibrary, law: Controller) -> Supervisor:
    return Supervisor(library, law)


def at_rest(chart: oc.Chart, q: Array) -> Array:
    return np.concatenate([chart.phi(q), np.zeros(2 * chart.n)])


class Arm:
    """The rigid body dynamics, integrated in small steps."""

    def __init__(self, robot: oc.Robot, q: Array, dq: Array | None = None) -> None:
        self.robot, self.q, self.dq = robot, q.copy(), np.zeros(robot.n) if dq is None else dq.copy()

    def move(self, torque: Array, seconds: float = TICK, steps: int = 2) -> None:
        h = seconds / steps
        for _ in range(steps):
            middle = self.q + h / 2 * self.dq
            ddq = self.robot.forward_dynamics(middle, self.dq, torque)
            self.dq = self.dq + h * ddq
            self.q = self.q + h * self.dq


def run(
    supervisor: Supervisor,
    arm: Arm,
    reference: Array,
    seconds: float,
    load: Callable[[float], Array] | None = None,
) -> tuple[list[ControlStatus], Array, Array]:
    """Statuses, commands and speeds of a run."""
    statuses, commands, speeds = [], [], []
    for k in range(round(seconds / TICK)):
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command + (0 if load is None else load(k * TICK)))
        statuses.append(status)
        commands.append(command)
        speeds.append(np.abs(arm.dq).max())
    return statuses, np.array(commands), np.array(speeds)


def test_starts_anywhere_inside_without_a_jump(supervisor: Supervisor, chart: oc.Chart, law: Controller) -> None:
    q = chart.problem.domain.centre + 0.5 * chart.problem.domain.half_width
    arm = Arm(chart.problem.robot, q)
    supervisor.start(q)
    before = chart.problem.robot.gravity(q)
    statuses, commands, speeds = run(supervisor, arm, np.zeros(9), 0.5)  # the reference is far away
    assert statuses[0] in (ControlStatus.OK, ControlStatus.SATURATED)
    steps = np.abs(np.diff(np.vstack([before, commands]), axis=0))
    assert steps.max() <= 1.0 + 1e-9  # N m per millisecond
    assert steps[0].max() < 0.2
    assert speeds.max() < 2.0


def test_after_the_start_the_law_commands(supervisor: Supervisor, chart: oc.Chart, law: Controller) -> None:
    q = chart.problem.domain.centre
    supervisor.start(q)
    arm = Arm(chart.problem.robot, q)
    run(supervisor, arm, at_rest(chart, q), 0.3)
    reference = at_rest(chart, q + 1e-5)
    command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
    want, _ = law.function(arm.q, arm.dq, *np.split(reference, 3), *law.gains.values())
    assert status is ControlStatus.OK
    assert supervisor.weight == 1.0
    np.testing.assert_allclose(command, want.full().ravel(), atol=1e-9)


@pytest.mark.slow
def test_pushed_out_it_is_caught_holds_and_returns_when_asked(supervisor: Supervisor, chart: oc.Chart) -> None:
    domain = chart.problem.domain
    q = domain.centre + 0.9 * domain.half_width
    arm, reference = Arm(chart.problem.robot, q), at_rest(chart, q)
    supervisor.start(domain.centre)  # then the arm is led to the border
    supervisor.take_over(q, chart.problem.robot.gravity(q))
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
    assert statuses[-1] in (ControlStatus.OK, ControlStatus.NEAR_BORDER)
    assert domain.contains(arm.q)
    assert not np.allclose(held, arm.q, atol=0.01)
    assert speeds.max() < 0.8


@pytest.mark.slow
def test_the_catcher_takes_energy_and_never_adds_any(supervisor: Supervisor, chart: oc.Chart) -> None:
    """Kinetic energy plus the spring of the catcher does not rise, but for the errors of ticks and integration."""
    domain, robot = chart.problem.domain, chart.problem.robot
    supervisor.start(domain.centre)
    q = domain.centre + 0.85 * domain.half_width
    supervisor.take_over(q, robot.gravity(q))
    arm, reference = Arm(robot, q, np.full(3, 1.2)), at_rest(chart, q)
    stiffness, law = Safety.of(PDPlus.on_chart(chart)).brake_stiffness.reshape(3, 3), []
    for _ in range(3000):
        command, _ = supervisor.step(arm.q, arm.dq, reference, TICK)
        if supervisor.mode == 1 and supervisor.weight == 0.0:
            e = arm.q - supervisor.anchor
            law.append(0.5 * arm.dq @ robot.mass_matrix(arm.q) @ arm.dq + 0.5 * e @ stiffness @ e)
        arm.move(command, steps=20)
    energy = np.array(law)
    assert len(energy) > 2000
    assert energy[0] > 0.05
    assert (energy - np.minimum.accumulate(energy)).max() < 0.02 * energy[0]
    assert energy[-1] < 1e-6


def test_a_start_outside_is_caught_and_brought_back_only_when_asked(supervisor: Supervisor, chart: oc.Chart) -> None:
    domain = chart.problem.domain
    q = domain.centre + 1.3 * domain.half_width
    arm = Arm(chart.problem.robot, q)
    supervisor.start(q)
    statuses, _, _ = run(supervisor, arm, at_rest(chart, domain.centre), 1.0)
    assert set(statuses) == {ControlStatus.CAUGHT}
    np.testing.assert_allclose(arm.q, q, atol=1e-3)
    supervisor.resume()
    statuses, _, speeds = run(supervisor, arm, at_rest(chart, domain.centre), 3.0)
    assert ControlStatus.RETURNING in statuses
    assert statuses[-1] is ControlStatus.OK
    assert domain.contains(arm.q)
    assert speeds.max() < 1.5


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_bad_measurements_hold_the_command_then_the_catcher_takes_over(
    supervisor: Supervisor, chart: oc.Chart, bad: float
) -> None:
    q = chart.problem.domain.centre
    reference = at_rest(chart, q)
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
    np.testing.assert_allclose(command, chart.problem.robot.gravity(q), atol=1e-6)


def test_speeds_that_cannot_be_true_are_bad_measurements(supervisor: Supervisor, chart: oc.Chart) -> None:
    q = chart.problem.domain.centre
    supervisor.start(q)
    for _ in range(300):
        before, _ = supervisor.step(q, np.zeros(3), at_rest(chart, q), TICK)
    command, status = supervisor.step(q, np.array([0.0, 0.0, 1e6]), at_rest(chart, q), TICK)
    assert status is ControlStatus.BAD_INPUT
    np.testing.assert_array_equal(command, before)


def test_a_bad_reference_is_held(supervisor: Supervisor, chart: oc.Chart) -> None:
    q = chart.problem.domain.centre
    supervisor.start(q)
    good, bad = at_rest(chart, q), at_rest(chart, q)
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
    supervisor: Supervisor, library: CompiledLibrary, chart: oc.Chart
) -> None:
    """The low pass approaches its target for ever, but its value stops where the last bit stops changing."""
    q = chart.problem.domain.centre
    supervisor.start(q)
    reference = at_rest(chart, q)
    target = reference[:3] + np.array([1e-3, 0.0, 0.0])
    for _ in range(15_000):
        library.low_pass(reference, target, 3.0, 0.7, TICK)
        _, status = supervisor.step(q, np.zeros(3), reference, TICK)
        assert status is not ControlStatus.BAD_INPUT
    assert np.abs(reference[3:6]).max() > 0


def test_a_late_tick_calls_the_catcher(supervisor: Supervisor, chart: oc.Chart) -> None:
    q = chart.problem.domain.centre
    supervisor.start(q)
    run(supervisor, Arm(chart.problem.robot, q), at_rest(chart, q), 0.3)
    assert supervisor.step(q, np.zeros(3), at_rest(chart, q), 0.3)[1] is ControlStatus.CAUGHT
    assert supervisor.cause == ControlStatus.LATE
    for period in (0.0, -1.0, np.nan, np.inf):
        assert supervisor.step(q, np.zeros(3), at_rest(chart, q), period)[1] is ControlStatus.BAD_INPUT


@pytest.mark.slow
def test_integral_action_removes_sag_and_does_not_wind_up(
    library: CompiledLibrary, law: Controller, chart: oc.Chart
) -> None:
    q, heavier = chart.problem.domain.centre, chart.problem.robot.with_scaled_masses(1.2)
    sag = {}
    for rate in (0.0, 3.0):
        supervisor = Supervisor(library, law, Safety.of(law, integral_rate=rate))
        supervisor.start(q)
        arm = Arm(heavier, q)
        run(supervisor, arm, at_rest(chart, q), 5.0)
        sag[rate] = np.abs(arm.q - q).max()
        assert (np.abs(supervisor.integral) <= Safety.of(law).integral_limit + 1e-15).all()
    assert sag[3.0] < 0.01 * sag[0.0]
    assert sag[0.0] > 1e-3


def test_springs_and_dampers_keep_away_from_joint_limits(
    library: CompiledLibrary, law: Controller, chart: oc.Chart
) -> None:
    q, speed = chart.problem.domain.centre, np.array([0.0, 0.1, 0.0])
    upper = q + np.array([1.0, 0.02, 1.0])
    settings, commands = Safety.of(law), []
    for safety in (settings, Safety.of(law, upper=upper, stop_zone=0.05)):
        supervisor = Supervisor(library, law, safety)
        supervisor.take_over(q, chart.problem.robot.gravity(q))
        for _ in range(400):  # until the limit of change is no matter any more
            towards, _ = supervisor.step(q, speed, at_rest(chart, q), TICK)
        for _ in range(400):
            away, _ = supervisor.step(q, -speed, at_rest(chart, q), TICK)
        commands += [towards, away]
    spring, damper = settings.stop_stiffness[1] * 0.03, settings.stop_damping[1] * 0.1
    np.testing.assert_allclose(commands[0] - commands[2], [0.0, spring + damper, 0.0], atol=1e-9)
    np.testing.assert_allclose(commands[1] - commands[3], [0.0, spring, 0.0], atol=1e-9)


def test_another_chart_takes_over_while_the_arm_moves(
    supervisor: Supervisor, chart: oc.Chart, law: Controller, tmp_path: Path
) -> None:
    """The next reference is that of the posture asked for now, so that the torque hardly changes."""
    other = oc.fit(chart.problem, oc.Polynomial(4), weights=(1000, 30, 150, 0.1, 1000), samples=1500, seed=5).chart
    next_law = PDPlus.on_chart(other, limit=120.0)
    generated = oc.generate_c(other, tmp_path, next_law, "arm")
    after = Supervisor(CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3), next_law)
    q = chart.problem.domain.centre
    wanted = np.array([0.2, -0.1, 0.15])  # joint velocity
    arm = Arm(chart.problem.robot, q, wanted)
    supervisor.take_over(q, chart.problem.robot.gravity(q))
    for k in range(200):
        command, _ = supervisor.step(arm.q, arm.dq, moving(chart, q + k * TICK * wanted, wanted), TICK)
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


def moving(chart: oc.Chart, q: Array, dq: Array) -> Array:
    """The reference of a joint motion without acceleration."""
    curvature = chart.function("second_derivative")(q, dq, dq).full().ravel()
    return np.concatenate([chart.phi(q), chart.jacobian(q) @ dq, curvature])


def test_references_equal_those_of_python(library: CompiledLibrary, chart: oc.Chart) -> None:
    start, target = chart.phi(chart.problem.domain.centre), np.array([0.3, -0.1, 0.2])
    for zeta in (0.4, 1.0, 1.6):
        reference = np.concatenate([start, np.zeros(6)])
        wanted = Reference.steps(
            chart.labels, start, [(0.0, dict(zip(chart.labels, target, strict=True)))], 1.0, 6.0, zeta
        )
        for _ in range(500):
            library.low_pass(reference, target, 6.0, zeta, TICK)
        np.testing.assert_allclose(reference, np.hstack(wanted.sample([0.5])).ravel(), atol=1e-9)
    moving = np.array([0.1, 0.2, 0.3, 1.0, -1.0, 0.5, 2.0, 0.0, -3.0])
    for time, want in ((0.0, moving), (0.8, np.concatenate([target, np.zeros(6)]))):
        np.testing.assert_allclose(library.spline(moving, target, 0.8, time), want, atol=1e-12)
    h = 1e-5
    low, middle, high = (library.spline(moving, target, 0.8, 0.3 + t) for t in (-h, 0.0, h))
    np.testing.assert_allclose((high - low)[:6] / (2 * h), middle[3:], rtol=1e-6)


@pytest.mark.parametrize("make", [Impedance.on_chart, Kinematic.on_chart, Projector.on_chart])
def test_every_law_can_be_supervised(chart: oc.Chart, tmp_path: Path, make: Callable[..., Controller]) -> None:
    other = make(chart)
    generated = oc.generate_c(chart, tmp_path, other, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path, ("-O1", "-Wconversion", "-Wshadow")), "arm", 3)
    supervisor, q = Supervisor(library, other), chart.problem.domain.centre
    k = len(other.labels)
    value = np.asarray(other.measured(q)).ravel()
    reference = np.concatenate([value, np.zeros(2 * k)])
    supervisor.start(q)
    for _ in range(300):
        command, status = supervisor.step(q, np.zeros(3), reference, TICK)
    assert status is ControlStatus.OK
    want = other.fallback(q, *other.gains.values()).full().ravel()
    np.testing.assert_allclose(command, want, atol=1e-9)


def test_settings_are_checked(law: Controller, chart: oc.Chart, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="setting is 'speed'"):
        Safety.of(law, speed=1.0)
    with pytest.raises(ShapeError, match="error_limit has shape"):
        Safety.of(law, error_limit=[1.0, 2.0])
    with pytest.raises(InvalidValueError, match="catch_margin < near_margin"):
        Safety.of(law, near_margin=0.5)
    with pytest.raises(InvalidValueError, match="fade_in is nan"):
        Safety.of(law, fade_in=np.nan)
    with pytest.raises(ShapeError, match="error_limit"):
        oc.generate_c(chart, tmp_path, law, "arm", safety=Safety.of(Projector.on_chart(chart)))


def test_settings_in_c_are_those_of_python(generated: GeneratedC, law: Controller, library: CompiledLibrary) -> None:
    ours, theirs = Supervisor(library, law), Supervisor(library, law, Safety.of(law))
    rng = np.random.default_rng(3)
    q = law.problem.domain.centre
    for supervisor in (ours, theirs):
        supervisor.start(q)
    for _ in range(200):
        state = (q + 0.1 * rng.normal(size=3) * 0.01, 0.1 * rng.normal(size=3), 0.1 * rng.normal(size=9))
        first, second = ours.step(*state), theirs.step(*state)
        np.testing.assert_array_equal(first[0], second[0])
        assert first[1] == second[1]


@pytest.mark.slow
def test_a_million_hostile_ticks_stay_bounded_with_the_right_status(generated: GeneratedC, tmp_path: Path) -> None:
    """Under the address and undefined-behaviour sanitizers; the program itself checks commands, states and statuses."""
    flags = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = built(generated, "supervised_ticks.c", tmp_path, "-DTICKS=1000000L", "-DLIMIT=120.0", *flags)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.returncode}: {done.stderr}"
    counts = [int(word) for word in done.stdout.split()]
    assert sum(counts) == 1_000_000
    for status in ("OK", "SATURATED", "NEAR_BORDER", "CAUGHT", "RETURNING", "BAD_INPUT"):
        assert counts[ControlStatus[status]] > 50, (status, counts)  # each is met


@pytest.mark.slow
def test_the_bound_on_singular_values_is_a_border_with_a_zone_before_it(tmp_path: Path) -> None:
    """Led slowly towards a straight arm: damped, caught before the bound, brought back; torques change smoothly."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    box = oc.Box([0.6, 0.8, 0.8], [0.8, 1.2, 1.2])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=box, least_singular_value=0.2)
    clear = problem.domain
    assert isinstance(clear, oc.ClearBox)
    chart = oc.fit(problem, oc.Polynomial(3)).chart
    law = PDPlus.on_chart(chart)
    generated = oc.generate_c(chart, tmp_path, law, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3)
    supervisor = Supervisor(library, law, Safety.of(law, command_rate=np.inf))
    arm, straight = Arm(robot, box.centre), np.array([0.6, 0.0, 0.1])
    supervisor.start(box.centre)
    run(supervisor, arm, at_rest(chart, box.centre), 0.5)
    statuses, commands, sizes = [], [], []
    for k in range(4000):
        wanted = box.centre + k / 4000 * (straight - box.centre)
        command, status = supervisor.step(arm.q, arm.dq, moving(chart, wanted, (straight - box.centre) / 4.0), TICK)
        arm.move(command)
        statuses.append(status)
        commands.append(command)
        sizes.append(clear.singular_values(arm.q))
    first = [statuses.index(status) for status in (ControlStatus.NEAR_BORDER, ControlStatus.CAUGHT)]
    assert [set(part) for part in np.split(np.array(statuses), first)] == [
        {ControlStatus.OK},
        {ControlStatus.NEAR_BORDER},
        {ControlStatus.CAUGHT},
    ]
    assert first[1] - first[0] > 10
    span = clear.singular_values(box.centre) - 0.2
    assert sizes[first[0]] == pytest.approx(0.2 + 0.06 * span, abs=0.01 * span)
    assert min(sizes[: first[1] + 1]) > 0.2
    changes = np.abs(np.diff(commands, axis=0)).max(axis=1)
    assert max(changes[k - 1] for k in first) < 0.5  # [N m] where the status changes
    assert changes[first[0] - 100 :].max() < 2.0  # the law hands over in the 30 ticks of fade_out
    assert np.abs(arm.dq).max() < 1e-3
    supervisor.resume()
    statuses, _, _ = run(supervisor, arm, at_rest(chart, box.centre), 4.0)
    assert statuses[0] is ControlStatus.RETURNING
    assert statuses[-1] is ControlStatus.OK


def test_margins_at_run_time_decide_where_the_law_starts(
    library: CompiledLibrary, law: Controller, chart: oc.Chart
) -> None:
    domain = chart.problem.domain
    q = domain.centre + 0.8 * domain.half_width
    for margin, wanted in ((0.1, 0), (0.3, 1)):
        supervisor = Supervisor(library, law, Safety.of(law, return_margin=margin))
        supervisor.start(q)
        supervisor.step(q, np.zeros(3), at_rest(chart, q), TICK)
        assert supervisor.mode == wanted  # the law, the catcher
        np.testing.assert_allclose(np.abs(supervisor.safe - domain.centre) <= (1 - margin) * domain.half_width, True)
    assert np.abs(supervisor.safe - domain.centre).max() < np.abs(q - domain.centre).max()


def test_a_start_without_a_measurement_waits_for_the_first_one(supervisor: Supervisor, chart: oc.Chart) -> None:
    """Where the arm is decides whether the law may begin, not where an unreadable sensor was taken to be."""
    domain = chart.problem.domain
    outside, nowhere = domain.centre + 1.3 * domain.half_width, np.full(3, np.nan)
    supervisor.start(domain.centre)
    supervisor.step(nowhere, np.zeros(3), np.zeros(9), TICK)
    for _ in range(50):
        _, status = supervisor.step(outside, np.zeros(3), at_rest(chart, domain.centre), TICK)
    assert status is ControlStatus.CAUGHT


def test_velocity_laws_carry_no_settings_of_torques(chart: oc.Chart, tmp_path: Path) -> None:
    law = Kinematic.on_chart(chart)
    generated = oc.generate_c(chart, tmp_path, law, "arm")
    header = (tmp_path / "arm.h").read_text()
    for name in ("brake_stiffness", "brake_yield", "stop_zone", "stop_damping"):
        assert name not in header
    library, q = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3), chart.problem.domain.centre
    commands = []
    for safety in (None, Safety.of(law), Safety.of(law, return_speed=0.1, damping=1.0)):
        supervisor = Supervisor(library, law, safety)
        supervisor.take_over(q, np.zeros(3))
        for k in range(60):  # the catcher after speeds beyond the limit
            command, _ = supervisor.step(q + 1e-4 * k, np.full(3, 20.0 * (k == 30)), at_rest(chart, q), TICK)
        assert supervisor.mode == 1  # the catcher
        commands.append(command)
    np.testing.assert_array_equal(commands[0], commands[1])
    assert np.abs(commands[2] - commands[0]).max() > 1e-4
