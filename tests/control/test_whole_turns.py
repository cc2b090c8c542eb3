"""Joints that turn without end: sensors that wrap, targets inside the range of xi, and arms that turn for long."""

import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from programs import nightly

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import Impedance, Kinematic, PDPlus, Remembering, Safety, XiTask

ARM = Path(__file__).parents[1] / "data" / "robots" / "four_endless_joints.urdf"
HOME = np.array([0.0, 0.6, 0.0, 1.2, 0.0, 0.9, 0.0])
BENT = np.array([0.3, 0.6, 0.2, 1.2, -0.4, 0.9, 0.5])
ENDLESS = (0, 2, 4, 6)
FAR = (-1.9, 0.75, 0.9, 2.0)  # changes of xi1 from HOME, inside its range from -2.34 to 2.49
LAWS = (Kinematic, Impedance, PDPlus)


@pytest.fixture(scope="module")
def chart() -> oc.Chart:
    """A wide chart whose xi grows with every turn of joints 1 and 7."""
    robot = oc.Robot.from_urdf(ARM, tip="l7")
    turning = oc.Polynomial(6, ["j1", "j7"])
    return oc.fit_wide(robot, oc.Task.pose(robot), home=HOME, parametrisation=turning).chart


@pytest.fixture(scope="module")
def compiled(chart: oc.Chart, tmp_path_factory: pytest.TempPathFactory) -> tuple[CompiledLibrary, Kinematic]:
    law = Kinematic.on_chart(chart)
    library = oc.generate_c(chart, tmp_path_factory.mktemp("turns"), law, name="arm")
    return CompiledLibrary(compile_shared(library, library.folder), "arm", 7), law


def commanded(law: Any, q: np.ndarray, reference: np.ndarray) -> np.ndarray:
    rest = np.zeros(7)
    command, status = law.function(q, rest, reference, rest, rest, *law.gains.values())
    assert float(status) == 0.0
    return np.asarray(command).ravel()


def asked(chart: oc.Chart, q: np.ndarray, change: float) -> np.ndarray:
    """phi at q, with another xi1."""
    target = np.array(chart.phi(q))
    target[chart.m] += change
    return target


def near(chart: oc.Chart) -> np.ndarray:
    reference = chart.phi(BENT)
    reference[[0, 6]] += [0.001, 0.002]
    return np.asarray(reference)


def wrapped(k: int, turns: float = -1.0) -> np.ndarray:
    return BENT + turns * 2 * np.pi * np.eye(7)[k]


@pytest.mark.slow
def test_the_range_of_xi_is_longer_than_a_turn_of_a_joint_adds(chart: oc.Chart) -> None:
    """So a true error of xi cannot be told from a turn of the base: only q says which it is."""
    reach, here = chart.xi_range(HOME)[0], chart.xi(HOME)[0]
    added = abs(chart.xi(HOME + 2 * np.pi * np.eye(7)[0]) - chart.xi(HOME))[0]
    assert here + max(FAR) < reach.high
    assert here + min(FAR) > reach.low
    assert max(FAR) > added > 0.1


@pytest.mark.parametrize("change", FAR)
def test_velocity_control_goes_to_the_xi_that_is_asked_for(chart: oc.Chart, change: float) -> None:
    law = Kinematic.on_chart(chart, feedback=3.0)
    ticks, q, rest = Remembering(law), HOME.copy(), np.zeros(7)
    target = asked(chart, HOME, change)
    for _ in range(500):
        dq, status = ticks.tick(q, rest, [target, rest, rest], 0.01)
        assert status.name in ("OK", "SATURATED")
        q = q + 0.01 * dq
    assert abs(chart.phi(q) - target).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("change", [-1.9, 0.75])
def test_pd_plus_goes_to_the_xi_that_is_asked_for(chart: oc.Chart, change: float) -> None:
    law = PDPlus.on_chart(chart)
    start = chart.phi(HOME)
    reference = oc.control.Reference.steps(chart.labels, start, [(0.0, {"xi1": start[6] + change})], 4.0)
    run = oc.simulate(law, reference, HOME, control_rate=500.0, compiled=True)
    assert abs(run.value[-1, 6] - start[6] - change) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("change", [FAR[0], FAR[3], *nightly(*FAR[1:3])])
def test_the_stream_in_c_ends_at_the_xi_that_is_asked_for(
    chart: oc.Chart, compiled: tuple[CompiledLibrary, Kinematic], change: float
) -> None:
    library, law = compiled
    arm = Supervisor(library, law, Safety.of(law))
    q, dq = HOME.copy(), np.zeros(7)
    arm.start(q)
    reference, target = np.r_[chart.phi(q), np.zeros(14)], asked(chart, HOME, change)
    for _ in range(9000):
        arm.stream(reference, target, omega=4.5)
        dq, status = arm.step(q, dq, reference)
        q = q + 1e-3 * np.array(dq)
    assert status.name == "OK"
    assert abs(chart.phi(q) - target).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("k", ENDLESS)
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_a_sensor_that_wraps_changes_no_command(chart: oc.Chart, law: Any, k: int) -> None:
    made = law.on_chart(chart)
    assert chart.problem.domain.contains(wrapped(k))
    command = commanded(made, BENT, near(chart))
    for turns in (-1.0, 1.0, 3.0):
        assert commanded(made, wrapped(k, turns), near(chart)) == pytest.approx(command, abs=1e-6)


@pytest.mark.parametrize("k", ENDLESS)
def test_a_sensor_that_wraps_changes_no_command_in_c(
    chart: oc.Chart, compiled: tuple[CompiledLibrary, Kinematic], k: int
) -> None:
    library, _ = compiled
    reference, gains = np.r_[near(chart), np.zeros(14)], library.default_gains(14)
    command, _ = library.control(BENT, np.zeros(7), reference, gains)
    there, status = library.control(wrapped(k), np.zeros(7), reference, gains)
    assert status == 0
    assert there == pytest.approx(command, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("k", ENDLESS)
def test_a_sensor_that_wraps_in_motion_is_noticed_by_no_one(
    chart: oc.Chart, compiled: tuple[CompiledLibrary, Kinematic], k: int
) -> None:
    """An arm in C and one in Python, with a sensor that counts and with one that wraps: three turns."""
    library, law = compiled
    arms, ticks = [Supervisor(library, law, Safety.of(law)) for _ in range(2)], [Remembering(law) for _ in range(2)]
    q, dq = BENT.copy(), 0.9 * np.eye(7)[k]
    for arm in arms:
        arm.start(q)
    reference = np.r_[chart.phi(q), np.zeros(14)]
    for tick in range(2200):
        position = q + 0.01 * tick * dq
        measured = (position, np.arctan2(np.sin(position), np.cos(position)))
        in_c = [arm.step(at, dq, reference, 0.01) for arm, at in zip(arms, measured, strict=True)]
        rows = reference.reshape(3, 7)
        in_python = [arm.tick(at, dq, rows, 0.01) for arm, at in zip(ticks, measured, strict=True)]
        for (first, status), (second, same) in (in_c, in_python):
            assert status == same
            assert second == pytest.approx(first, abs=1e-6)


def test_an_exported_law_does_not_see_whole_turns(chart: oc.Chart, tmp_path: Path) -> None:
    law = PDPlus.on_chart(chart)
    module = oc.export(law, "jax", tmp_path / "arm.py").read_text()
    formula = module[module.index("def _counted") : module.index("def _force")]
    tables = {"turn": 2 * np.pi * np.eye(7)[list(ENDLESS)].sum(axis=0)[:, None], "centre": np.zeros((7, 1))}
    namespace: dict[str, Any] = {"jnp": np, "_table": lambda name, q: tables[name], "_constant": lambda q: q}
    exec(formula, namespace)
    for k in ENDLESS:
        assert namespace["_counted"](wrapped(k)[:, None])[:, 0] == pytest.approx(BENT, abs=1e-12)
    assert "wanted = _counted(columns[:n])" in module


def test_a_task_of_xi_counts_on_where_angles_are_stored_as_cosine_and_sine(chart: oc.Chart) -> None:
    """As pink's configurations do: the error must not jump where joint 7 passes half a turn."""
    model = SimpleNamespace(nv=7, names=chart.problem.robot.joint_names)
    model.existJointName = lambda name: True
    model.getJointId = chart.problem.robot.joint_names.index
    model.joints = [SimpleNamespace(idx_q=2 * k, nq=2, idx_v=k) for k in range(7)]
    task, last = XiTask(chart, cost=1.0), None
    task.set_target(chart.xi(HOME))
    for angle in np.linspace(0.0, 7.0, 71):
        q = HOME + angle * np.eye(7)[6]
        stored = np.column_stack([np.cos(q), np.sin(q)]).ravel()
        error = task.compute_error(SimpleNamespace(model=model, q=stored))
        assert error == pytest.approx(chart.xi(q) - chart.xi(HOME), abs=1e-9)
        last = error
    assert last is not None
    assert abs(last[0]) > 0.1


@pytest.mark.slow
def test_errors_of_a_shipped_chart_reach_the_law() -> None:
    """The ready chart of PR2's arm: 1.17 rad of xi to go is an error, and no turn of the forearm."""
    chart = oc.charts.load("pr2-left-wide")
    home = chart.problem.domain.centre
    law = Impedance(chart, 10.0, limit=1e6)
    rest = np.zeros(chart.n)
    forces = []
    for change in (0.0, 1.17):
        reference = asked(chart, home, change)
        tau, _ = law.function(home, rest, reference, rest, rest, *law.gains.values())
        forces.append(np.asarray(tau).ravel())
    pull = 10.0 * 1.17 * chart.jacobian(home)[chart.m]
    assert forces[1] - forces[0] == pytest.approx(pull, abs=1e-9)


def turned_about(axis: str, chart: oc.Chart, q: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Poses of the tool at q turned about its own axis, or with the hand around the base, (N, 6)."""
    robot, task = chart.problem.robot, chart.problem.task
    R, p, rows = robot.tip_rotation(q), robot.tip_position(q), []
    for a in angles:
        turn = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
        rows.append(task.value(p, R @ turn) if axis == "tool" else task.value(turn @ p, turn @ R))
    return np.array(rows)


@pytest.mark.parametrize("axis", ["tool", "base"])
def test_a_path_around_a_turn_says_what_it_leaves_over(chart: oc.Chart, axis: str) -> None:
    """The same joints as those of a tracker, which takes small steps of its own."""
    path, tracker = turned_about(axis, chart, HOME, np.linspace(0.0, 2 * np.pi, 200)), chart.tracker(HOME)
    motion = oc.follow(chart, path, q_start=HOME, velocity_limits=1.4)
    for x in path:
        tracker.step(np.r_[x, chart.xi(HOME)])
    apart = tracker.q - HOME
    apart -= 2 * np.pi * np.round(apart / (2 * np.pi)) * np.isin(np.arange(7), ENDLESS)
    assert np.abs(apart).max() > 0.1
    assert motion.left_over == pytest.approx(apart, abs=1e-6)
    assert not motion.closed
    assert motion.kind.startswith("path around a turn: x and xi end where they began, joint 'j")
    assert chart.parts.left_over(HOME, tracker.q) == pytest.approx(apart, abs=1e-6)
    assert tracker.left_over == pytest.approx(apart, abs=1e-6)
    assert pickle.loads(pickle.dumps(tracker)).left_over == pytest.approx(apart, abs=1e-6)
    tracker.step(np.r_[path[-2], chart.xi(HOME)])
    assert tracker.left_over is None


def test_a_loop_that_can_be_shrunk_closes_and_an_open_path_leaves_nothing_to_say(chart: oc.Chart) -> None:
    there = turned_about("tool", chart, HOME, np.linspace(0.0, 2.0, 40))
    back = oc.follow(chart, np.vstack([there, there[-2::-1]]), q_start=HOME, velocity_limits=1.4)
    assert back.closed
    assert back.kind == "closed path"
    assert back.left_over == pytest.approx(np.zeros(7), abs=1e-7)
    once = oc.follow(chart, there, q_start=HOME, velocity_limits=1.4)
    assert (once.closed, once.left_over, once.kind) == (False, None, "open path")


def test_what_a_turn_adds_to_xi_is_said(chart: oc.Chart) -> None:
    shifts = chart.xi_range(HOME).turn_shifts
    assert list(shifts) == ["j1", "j7"]
    for name, k in (("j1", 0), ("j7", 6)):
        q = BENT + 2 * np.pi * np.eye(7)[k]
        assert shifts[name] == pytest.approx(chart.xi(q) - chart.xi(BENT), abs=1e-9)
    assert "a turn of j1" in str(chart.xi_range(HOME))
