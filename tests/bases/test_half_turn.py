"""Poses half a turn from the reference of their task: nothing happens there, and no result depends on the reference."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from baselines import KinematicProjector, Projector
from numpy.typing import NDArray
from programs import needs_c, nightly
from scipy.spatial.transform import Rotation

import orthocas as oc
from orthocas import control
from orthocas.charts.inverse import InverseStatus
from orthocas.charts.trackers import TrackerStatus
from orthocas.codegen.library import CompiledLibrary, Supervisor, compile_shared
from orthocas.control.controller import ControlStatus
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.tasks.relative import Relative

Numbers = NDArray[np.float64]
KINDS = ("pose", "pose:z", "orientation", "orientation:x")
AXES = {"x": [0, np.pi / 2, 0], "y": [-np.pi / 2, 0, 0], "z": [0, 0, 0]}  # roll, pitch, yaw of a tool: joint 7 along it


@cache
def arm(axis: str = "z") -> oc.Robot:
    """The 7-DoF arm without joint limits, with the axis of its last joint along one of the tip."""
    robot = oc.problems.get("iiwa").robot.with_tool([0, 0, 0, *AXES[axis]])
    return oc.Robot(dataclasses.replace(robot.tree, lower=np.full(7, -20.0), upper=np.full(7, 20.0)))


@cache
def chart(kind: str = "pose", axis: str = "z", turned_deg: float = 0.0) -> oc.Chart:
    """A chart for two full turns of the last joint to either side, with a reference turned from the tip's at home."""
    robot, home = arm(axis), oc.problems.get("iiwa").domain.centre
    box = oc.Box(home, [*[0.3] * 6, 4 * np.pi + 0.3])
    away = Rotation.from_rotvec(np.radians(turned_deg) * np.array([2, -1, 2]) / 3).as_matrix()
    task = oc.Task.named(robot, kind, home)
    task = oc.Task.from_recipe(robot, {**task.recipe, "reference": robot.tip_rotation(home) @ away})
    problem = oc.Problem(robot, task, domain=box)
    if turned_deg:
        return oc.Chart(problem, chart(kind, axis).coordinates)
    return oc.fit(problem, oc.Polynomial(2, cyclic=["A7"]), samples=1000).chart


def turning(turns: float, count: int) -> Numbers:
    """Joint positions while the last joint turns, and the others move a little, (count, 7)."""
    s = np.linspace(-turns, turns, count)[:, None]
    home = oc.problems.get("iiwa").domain.centre
    return np.asarray(home + 0.1 * np.sin(2.0 * s + np.arange(7)) + np.eye(7)[6] * 2 * np.pi * s)


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_orientations_are_those_of_scipy(kind: str) -> None:
    task = oc.Task.named(arm(), kind)
    q = np.random.default_rng(0).uniform(-3, 3, (300, 7))
    R, p = arm().tip_rotation(q), arm().tip_position(q)
    x = task.batched(q)[0]
    np.testing.assert_allclose(task.orientation_of(x), R, atol=1e-12)
    position = p if kind.startswith("pose") else None
    np.testing.assert_allclose(task.value(position, R), x, atol=1e-12)
    quaternions = np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=1)
    np.testing.assert_allclose(task.value(position, quaternions), x, atol=1e-12)
    one = task.value(None if position is None else p[3], -quaternions[3])
    np.testing.assert_allclose(one, x[3], atol=1e-12)
    assert task.orientation_of(x[3]).shape == (3, 3)


def test_values_lose_few_digits_next_to_half_a_turn() -> None:
    task = oc.Task.orientation(arm(), np.eye(3))
    axes = np.random.default_rng(1).normal(size=(200, 3))
    axes = np.vstack([axes / np.linalg.norm(axes, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    for left in (0.0, 1e-12, 1e-6, 1e-3, 0.5, 1.1):
        R = Rotation.from_rotvec((np.pi - left) * axes).as_matrix()
        x = task.value(None, R)
        np.testing.assert_allclose(np.linalg.norm(x, axis=1), 2 * np.cos(left / 2), rtol=1e-12)
        known = np.abs((x * axes).sum(axis=1))  # at half a turn the axis and its opposite are one
        np.testing.assert_allclose(known, 2 * np.cos(left / 2), rtol=1e-12)
        away = Rotation.from_matrix(R).inv() * Rotation.from_matrix(task.orientation_of(x))
        assert away.magnitude().max() < 1e-7, left


@pytest.mark.parametrize("left", [0.5, 1e-3, 1e-5])
@pytest.mark.parametrize("axis", AXES)
def test_tilts_and_turns_lose_few_digits_next_to_half_a_turn(axis: str, left: float) -> None:
    """R = S T: S tilts the axis by pi - left about a direction across it, and T turns about the axis itself."""
    task = oc.Task.orientation(arm(), np.eye(3), axis)
    rng, along = np.random.default_rng(2), np.eye(3)["xyz".index(axis)]
    direction = np.cross(along, rng.normal(size=(100, 3)))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    turn = rng.uniform(-3, 3, 100)
    S, T = Rotation.from_rotvec((np.pi - left) * direction), Rotation.from_rotvec(turn[:, None] * along)
    x = task.value(None, (S * T).as_matrix())
    allowed = 1e-15 / left
    np.testing.assert_allclose(x[:, 2], turn, atol=20 * allowed)
    tilted = 2 * np.cos(left / 2) * np.cross(direction, along)[:, [k for k in range(3) if not along[k]]]
    np.testing.assert_allclose(x[:, :2], tilted, atol=20 * allowed)


def test_poses_are_checked() -> None:
    task = oc.Task.pose(arm())
    for arguments, error, words in (
        (([0, 0, 0], [1, 1, 0, 0]), InvalidValueError, "a quaternion"),
        (([0, 0, 0], 2 * np.eye(3)), InvalidValueError, "a rotation matrix"),
        (([0, 0, 0], [1, 0, 0]), InvalidValueError, r"\(3, 3\), \(N, 3, 3\), \(4,\) or \(N, 4\)"),
        (([0, 0], np.eye(3)), ShapeError, "position"),
        ((None, np.eye(3)), ShapeError, "position"),
        (([0, 0, np.nan], np.eye(3)), InvalidValueError, "position"),
        (([0, 0, 0], [np.nan, 0, 0, 0]), InvalidValueError, "orientation"),
    ):
        with pytest.raises(error, match=words):
            task.value(*arguments)
    with pytest.raises(InvalidValueError, match="expected None"):
        oc.Task.orientation(arm()).value([0, 0, 0], np.eye(3))
    # Three rotation vectors, and a matrix that would be taken for such.
    task = oc.Task.orientation(arm())
    np.testing.assert_array_equal(task.target(np.diag([0.1, 0.2, 0.3])), np.diag([0.1, 0.2, 0.3]))
    with pytest.raises(InvalidValueError, match=r"task.value\(None, R\)"):
        task.target(Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix())
    for other in (oc.Task.position(arm()), oc.Task.axis(arm())):
        with pytest.raises(InvalidValueError, match="a whole orientation"):
            other.value([0, 0, 0], np.eye(3))
        with pytest.raises(InvalidValueError, match="a whole orientation"):
            other.orientation_of(np.zeros(other.m))


@pytest.mark.parametrize("kind", [*KINDS, "position", "position+axis"])
def test_derivatives_of_errors_are_finite_differences(kind: str) -> None:
    import casadi as ca

    task = oc.Task.named(arm(), kind)
    relative, m = Relative(task), task.m
    q, dq, w = np.random.default_rng(3).normal(size=(3, 7))
    rng = np.random.default_rng(4)
    x_d = np.array(task.function(q + 0.4 * rng.normal(size=7)))[:, 0]
    dx, ddx = 0.3 * rng.normal(size=(2, m))
    symbols = [ca.MX.sym(name, size) for name, size in (("q", 7), ("x_d", m), ("dx", m), ("ddx", m))]
    Q, X, V, A = symbols
    e, J = relative.error(Q, X)
    rate = J @ ca.DM(w) - relative.compute_drift(Q, X, V)
    bend = relative.compute_bias(Q, ca.DM(dq), ca.DM(w), (X, V, A))
    run = ca.Function("run", symbols, [e, J, relative.compute_drift(Q, X, V), rate, bend])

    def along(s: float, k: int, rest: bool = False, still: bool = False) -> Numbers:
        here = q if rest else q + s * dq
        there = (x_d, dx, ddx) if still else (x_d + s * dx + s**2 / 2 * ddx, dx + s * ddx, ddx)
        return np.array(run(here, *there)[k])

    def slope(k: int, **how: bool) -> Numbers:
        return np.asarray((along(1e-5, k, **how) - along(-1e-5, k, **how)) / 2e-5)

    np.testing.assert_allclose(slope(0, still=True), along(0, 1) @ dq[:, None], atol=1e-8)
    np.testing.assert_allclose(-slope(0, rest=True), along(0, 2), atol=1e-8)
    np.testing.assert_allclose(slope(3), along(0, 4), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "axis"),
    [("pose", "x"), ("pose:z", "z"), *nightly(("pose", "y"), ("pose", "z"), ("pose:z", "x"), ("pose:z", "y"))],
)
def test_trackers_follow_four_turns_about_each_axis(kind: str, axis: str) -> None:
    known, path = chart(kind, axis), turning(2.0, 4001)
    tracker = known.tracker(path[0])
    for wanted, phi in zip(path, known.phi(path), strict=True):
        q = tracker.step(phi)
        assert tracker.status == TrackerStatus.OK, (wanted, tracker.status)
        np.testing.assert_allclose(q, wanted, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "pose:z"])
def test_solvers_find_poses_half_a_turn_away(kind: str) -> None:
    known, q = chart(kind), turning(2.0, 801)
    half = np.abs(known.task(q)[:, -1]) > (1.99 if kind == "pose" else 3.0)
    assert half.sum() > 10
    found = known.solve(known.phi(q), q + 0.02)
    assert (found.status == InverseStatus.FOUND).all()
    np.testing.assert_allclose(found.q, q, atol=1e-6)
    inverse = known.function("inverse")
    for k in np.flatnonzero(half)[:20]:
        np.testing.assert_allclose(np.array(inverse(known.phi(q[k]), q[k] + 0.02))[:, 0], q[k], atol=1e-6)
    free = known.solve(known.phi(q[half]))  # from no start: some other turn of joint 7
    assert free.found.all()
    np.testing.assert_allclose(arm().tip_rotation(free.q), arm().tip_rotation(q[half]), atol=1e-7)


@pytest.mark.slow
def test_self_motions_do_not_depend_on_the_reference() -> None:
    q = oc.problems.get("iiwa").domain.centre + np.pi * np.eye(7)[6]
    assert np.linalg.norm(chart().x(q)[3:]) == pytest.approx(2, abs=1e-6)
    here, other = (known.xi_range(q)[0] for known in (chart(), chart(turned_deg=100.0)))
    assert [here.low, here.high] == pytest.approx([other.low, other.high], abs=1e-7)
    assert here.high - here.low > 0.1


def test_wishes_are_met_half_a_turn_away() -> None:
    q = oc.problems.get("iiwa").domain.centre + np.pi * np.eye(7)[6]
    wish = q + np.array([0.05, -0.1, 0.1, 0.05, 0, 0, 0])
    found = [known.nearest_xi(wish, known.task(q)).q for known in (chart(), chart(turned_deg=100.0))]
    R = [arm().tip_rotation(np.atleast_2d(each)[0]) for each in found]
    np.testing.assert_allclose(R[0], arm().tip_rotation(q), atol=1e-7)
    np.testing.assert_allclose(R[1], R[0], atol=1e-7)


@pytest.mark.slow
def test_paths_of_two_full_turns_are_followed() -> None:
    q = turning(1.0, 41)
    motions = [
        oc.follow(known, known.task(q), known.xi(q), q_start=q[0]) for known in (chart(), chart(turned_deg=100.0))
    ]
    for motion, known in zip(motions, (chart(), chart(turned_deg=100.0)), strict=True):
        np.testing.assert_allclose(
            known.parts.phi_map.difference(known.phi(motion.q), np.hstack([motion.x, motion.xi])), 0, atol=1e-9
        )
        speed = np.gradient(motion.q, motion.times, axis=0, edge_order=2)
        np.testing.assert_allclose(speed[2:-2], motion.dq[2:-2], atol=0.02 * np.abs(motion.dq).max())
        assert motion.q[-1, 6] - motion.q[0, 6] == pytest.approx(4 * np.pi, abs=0.3)
    count = min(len(motion.q) for motion in motions)
    assert abs(len(motions[0].q) - len(motions[1].q)) < 0.02 * count
    there = np.vstack([q, q[::-1][1:]])
    back = oc.follow(chart(), chart().x(there), chart().xi(there), q_start=q[0])
    assert back.closed
    assert np.abs(back.q[-1] - back.q[0]).max() < 1e-7
    home, s = oc.problems.get("iiwa").domain.centre, np.linspace(0.0, 1.0, 31)[:, None]
    around = home + 2 * np.pi * s * np.eye(7)[6]
    once = oc.follow(chart(), chart().x(around), chart().xi(around), q_start=home)
    np.testing.assert_allclose(once.q[-1] - once.q[0], 2 * np.pi * np.eye(7)[6], atol=1e-7)
    assert not once.closed  # the tool is back after a full turn, joint 7 is not


def references(known: oc.Chart, q: Numbers, dq: Numbers, ddq: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """phi of joint positions that move, and its two derivatives."""
    J = known.jacobian(q)
    bend = np.array(known.function("second_derivative")(q, dq, dq))[:, 0]
    return known.phi(q), J @ dq, J @ ddq + bend


def laws(kind: str, turned_deg: float) -> list[control.Controller]:
    known = chart(kind, turned_deg=turned_deg)
    K, damping = np.linspace(30.0, 90.0, 7), 0.7
    return [
        control.PDPlus(known, K, damping, limit=1e5),
        control.Impedance(known, K, damping, limit=1e5),
        control.Kinematic(known, 3.0, limit=1e5),
        KinematicProjector(known.problem, 3.0, 2.0, second=known, limit=1e5),
        Projector(known.problem, K[:6], 20.0, limit=1e5, feed_forward=True),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "pose:z"])
@pytest.mark.parametrize("number", range(5))
def test_laws_do_not_depend_on_the_reference(kind: str, number: int) -> None:
    """Commands with moving references, next to half a turn from the one reference and far from it for the other."""
    law, other = laws(kind, 0.0)[number], laws(kind, 100.0)[number]
    rng = np.random.default_rng(number)
    home, axis = oc.problems.get("iiwa").domain.centre, np.eye(7)[6]
    for turn in (0.4, np.pi - 0.02, np.pi + 0.02, -np.pi + 0.01):
        q_d, dq_d, ddq_d = home + turn * axis, *rng.normal(size=(2, 7))
        q, dq = q_d + 0.02 * rng.normal(size=7), rng.normal(size=7)
        commands = []
        for each in (law, other):
            known = chart(kind, turned_deg=0.0 if each is law else 100.0)
            wanted = references(known, q_d, dq_d, ddq_d)
            if "xi1" not in each.labels:
                wanted = tuple(
                    np.concatenate([part[:6], rest]) for part, rest in zip(wanted, (q_d, dq_d, ddq_d), strict=True)
                )
            command, status = each.function(q, dq, *wanted, *each.gains.values())
            assert int(status) == ControlStatus.OK
            commands.append(np.array(command)[:, 0])
        np.testing.assert_allclose(*commands, rtol=1e-7, atol=1e-6 * np.abs(commands[0]).max())


def test_springs_have_a_potential_half_a_turn_away() -> None:
    """The force of the springs is the gradient of 1/2 e^T K e at any distance, so the loop stays passive."""
    law = control.Impedance(chart(), np.linspace(30.0, 90.0, 7), 0.0, limit=1e5)
    rng = np.random.default_rng(2)
    zero = np.zeros(7)
    for turn in (0.3, 1.7, 3.0):
        q = oc.problems.get("iiwa").domain.centre + turn * np.eye(7)[6] + 0.05 * rng.normal(size=7)
        phi_d = chart().phi(oc.problems.get("iiwa").domain.centre)

        def energy(at: Numbers, wanted: Numbers = phi_d) -> float:
            return float(law.energy(at, zero, wanted, zero, zero, *law.gains.values())[0])

        steps = 1e-5 * np.eye(7)
        gradient = np.array([energy(q + step) - energy(q - step) for step in steps]) / 2e-5
        gravity = arm().gravity(q)
        torque = np.array(law.function(q, zero, phi_d, zero, zero, *law.gains.values())[0])[:, 0]
        np.testing.assert_allclose(torque - gravity, -gradient, rtol=1e-6, atol=1e-6)


@needs_c
@pytest.mark.slow
def test_c_does_not_depend_on_the_reference(tmp_path: Path) -> None:
    """Inverse and supervised law in C over two turns, with an offset that fades from the start on."""
    path, commands = turning(1.0, 2001), []
    rate, bend = np.gradient(path, 1e-3, axis=0), np.zeros(7)
    for turned_deg in (0.0, 100.0):
        known = chart(turned_deg=turned_deg)
        law = control.PDPlus(known, np.linspace(30.0, 90.0, 7), 0.7, limit=1e4)
        out = tmp_path / f"c{turned_deg:.0f}"
        generated = oc.generate_c(known, out, law, "arm")
        library = CompiledLibrary(compile_shared(generated, out), "arm", 7)
        assert library.check() < 1e-9
        q = path[0]
        for wanted, phi in zip(path[::10], known.phi(path[::10]), strict=True):
            q, status = library.inverse(phi, q)
            assert status == 0
            np.testing.assert_allclose(q, wanted, atol=1e-6)
        free = control.Safety.of(law, speed_limit=100.0, reference_speed=np.inf, reference_acceleration=np.inf)
        supervisor = Supervisor(library, law, free)
        arm_path = path + np.array([0.01, -0.02, 0.01, 0.02, 0, 0.01, 0.03])
        supervisor.take_over(arm_path[0], arm().gravity(arm_path[0]))
        given = []
        for k, q in enumerate(arm_path):
            reference = np.concatenate(references(known, path[k], 0.1 * rate[k], bend))
            command, status = supervisor.step(q, rate[k], reference)
            given.append(command.copy())
        assert status == ControlStatus.OK
        commands.append(np.array(given))
    scale = np.abs(commands[0]).max()
    np.testing.assert_allclose(commands[0], commands[1], atol=1e-4 * scale)  # error limits follow the range of x
    # It begins with gravity alone.
    jumps = np.abs(np.diff(commands[0][200:], axis=0)).max()
    assert jumps < 0.02 * scale


@needs_c
@pytest.mark.slow
def test_jumps_of_orientations_do_not_lead_the_law(tmp_path: Path) -> None:
    """Wanted orientations jump every tick. What leads the law, error and offset, stays: errors by their definition."""
    known = chart()
    law = control.PDPlus(known, np.linspace(30.0, 90.0, 7), 0.7, limit=1e4)
    generated = oc.generate_c(known, tmp_path / "c", law, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 7)
    still = control.Safety.of(law, stuck_speed=np.inf, stale_ticks=1000, offset_rate=1e-9, error_limit=100.0)
    supervisor = Supervisor(library, law, still)
    q = known.problem.domain.centre
    supervisor.start(q)
    supervisor.resume()
    home, task = known.phi(q), known.problem.task
    R, position = task.orientation_of(home[:6]), home[:3]

    def led(value: np.ndarray) -> np.ndarray:
        error = np.concatenate([known.parts.relative.difference(value[:6], home[:6]), value[6:] - home[6:]])
        return error + supervisor.offset

    for _ in range(300):  # the law takes over
        supervisor.step(q, np.zeros(7), np.concatenate([home, np.zeros(14)]))
    before = led(home)
    for k, axis in enumerate(np.random.default_rng(1).normal(size=(6, 3))):
        turn = Rotation.from_rotvec((0.4 + 0.2 * k) * axis / np.linalg.norm(axis)).as_matrix()
        value = np.concatenate([task.value(position, R @ turn), home[6:]])
        status = supervisor.step(q, np.zeros(7), np.concatenate([value, np.zeros(14)]))[1]
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
        np.testing.assert_allclose(led(value), before, atol=2e-3)
        before = led(value)


def test_poses_in_single_precision_or_of_a_few_decimals_are_taken() -> None:
    task, R = oc.Task.pose(arm()), Rotation.from_rotvec([0.3, 1.2, -0.5])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.as_matrix(), [0.4, 0.1, 0.5]
    x = task.target(pose)
    for rounded, error in ((pose.astype(np.float32), 1e-7), (pose.round(6), 1e-6), (pose.round(4), 1e-4)):
        np.testing.assert_allclose(task.target(rounded), x, atol=2 * error)
    # Off by more, it may be another thing.
    with pytest.raises(InvalidValueError, match="to 0.001"):
        task.target(pose.round(2))
    # A list of pairs is as many poses.
    pair = (pose[:3, 3], R.as_quat()[[3, 0, 1, 2]])
    np.testing.assert_allclose(task.target([pair, pair]), [x, x], atol=1e-12)
