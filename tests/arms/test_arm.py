"""`oc.Arm`: task values in all forms, postures with x and xi, and files."""

import contextlib
import pickle
import zipfile
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from programs import nightly

import orthocas as oc
from orthocas.arms import Postures, chart_kernel
from orthocas.arms import arm as arm_module
from orthocas.charts.inverse import InverseStatus
from orthocas.errors import ChartFileError, InvalidValueError, NotRedundantError, OrthocasError, UnknownNameError
from orthocas.tools.checks import Array
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.progress import Progress


@cache
def panda() -> oc.Arm:
    chart = oc.load("panda-wide")
    return oc.Arm(chart.problem.task, (chart,))


@cache
def planar() -> oc.Arm:
    """A chart of two turning joints bent one way, made by a fit of one branch."""
    known = oc.problems.get("planar_3r_xy")
    bent = oc.Box([0.0, 1.3, 1.3], [3.0, 1.2, 1.2])
    fit = oc.fit_wide(known.robot, known.task, bent, parametrisation=oc.Polynomial(3, ["q1"]))
    return oc.Arm(known.task, (fit.chart,))


def inside(arm: oc.Arm, count: int, seed: int) -> Array:
    """Postures of the domain of the arm's chart."""
    return np.asarray(arm.charts[0].problem.domain.sample(count, seed))


@pytest.mark.slow
def test_forms_of_a_task_value_are_one() -> None:
    arm, q = panda(), inside(panda(), 1, 0)[0]
    p, R = arm.robot.tip_position(q), arm.robot.tip_rotation(q)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, p
    turn = pin.Quaternion(np.asarray(R))
    wxyz = np.array([turn.w, turn.x, turn.y, turn.z])
    for x in (matrix, (p, R), (p, wxyz), (p, -wxyz), pin.SE3(np.asarray(R), np.asarray(p))):
        assert arm.solve(x, start=q).q == pytest.approx(q, abs=1e-9)
    several = arm.solve([pin.SE3(matrix), pin.SE3(matrix)], start=q)
    assert several.q == pytest.approx(np.array([q, q]), abs=1e-9)


def test_batches_of_x_and_xi_are_solved_within_the_limits() -> None:
    arm, q = panda(), inside(panda(), 30, 1)
    x, xi = arm.x(q), arm.charts[0].xi(q)[:, 0]
    found = arm.solve(x, xi)
    assert found.found.all()
    assert np.abs(arm.x(found.q) - x).max() < 1e-8
    assert found.xi == pytest.approx(xi, abs=1e-8)
    assert set(found.branch) == set(arm.branch_names)
    assert ((found.q >= arm.robot.lower) & (found.q <= arm.robot.upper)).all()


def test_arrays_and_lists_of_task_values_are_one() -> None:
    arm, q = panda(), inside(panda(), 3, 8)
    x, xi = arm.x(q), arm.charts[0].xi(q)[:, 0]
    assert arm.solve(x.tolist(), xi, q).q == pytest.approx(arm.solve(x, xi, q).q, abs=1e-12)
    assert arm.solve(x[:, None][:, 0], xi, q).q == pytest.approx(q, abs=1e-8)
    one = arm.solve(x[0], xi[0], q[0])
    assert one.q == pytest.approx(q[0], abs=1e-8)
    assert isinstance(one.status, InverseStatus)


def test_xi_that_no_posture_has_gives_the_nearest() -> None:
    arm, q = panda(), inside(panda(), 1, 2)[0]
    found = arm.solve(arm.x(q), 50.0)
    assert found.status is InverseStatus.NEAREST
    assert arm.x(found.q) == pytest.approx(arm.x(q), abs=1e-9)
    dense = np.vstack([arc.at(np.linspace(0, arc.length, 500)) for arc in arm.self_motion(arm.x(q))])
    dense = dense[arm.charts[0].problem.domain.contains(dense)]
    assert found.xi >= arm.charts[0].xi(dense).max() - 0.05


def test_where_charts_hold_no_posture_x_is_met_all_the_same() -> None:
    arm = panda()
    x = arm.x(arm.robot.sample(40, seed=0))
    found = arm.solve(x, 0.2)
    assert {InverseStatus(k).name for k in found.status} == {"FOUND", "NEAREST", "OUTSIDE_DOMAIN"}
    assert np.abs(arm.x(found.q) - x).max() < 1e-8
    assert [name == "" for name in found.branch] == (found.status == InverseStatus.OUTSIDE_DOMAIN).tolist()


def test_without_xi_the_posture_is_the_nearest_to_the_start() -> None:
    arm, q = panda(), inside(panda(), 5, 3)
    found = arm.solve(arm.x(q), start=q + 0.05)
    for posture, x, near in zip(found.q, arm.x(q), q + 0.05, strict=True):
        dense = np.vstack([arc.at(np.linspace(0, arc.length, 500)) for arc in arm.self_motion(x)])
        assert np.linalg.norm(posture - near) <= np.linalg.norm(dense - near, axis=1).min() + 1e-9


def test_without_a_start_the_posture_is_far_from_limits() -> None:
    arm, q = panda(), inside(panda(), 1, 4)[0]
    found, (low, high) = arm.solve(arm.x(q)), (arm.robot.lower, arm.robot.upper)
    dense = np.vstack([arc.at(np.linspace(0, arc.length, 500)) for arc in arm.self_motion(arm.x(q))])
    room = (np.minimum(dense - low, high - dense) / (high - low)).min(axis=1)
    assert (np.minimum(found.q - low, high - found.q) / (high - low)).min() >= room.max() - 1e-6


@pytest.mark.slow
def test_solutions_with_xi_are_those_of_newtons_method() -> None:
    """Newton's method on x and xi from 300 starts in the domain finds no other."""
    arm, chart = panda(), panda().charts[0]
    for q in inside(arm, 2, 5):
        phi = chart.phi(q)
        found = arm.solve(phi[:6], float(phi[6]), all=True)
        assert isinstance(found, Postures)
        assert np.abs(chart.phi(found.q) - phi).max() < 1e-8
        again = chart.solve(np.tile(phi, (300, 1)), inside(arm, 300, 6))
        others = again.q[again.found]
        assert len(others) > 0
        gaps = np.linalg.norm(others[:, None] - found.q[None], axis=2).min(axis=1)
        assert gaps.max() < 1e-6


def test_a_branch_can_be_asked_for() -> None:
    arm, q = panda(), inside(panda(), 1, 7)[0]
    name = arm.branch_names[0]
    found = arm.solve(arm.x(q), start=q, branch=name)
    assert found.branch == name
    with pytest.raises(UnknownNameError, match="branch"):
        arm.solve(arm.x(q), branch="elbow?")


def test_no_posture_turns_beyond_half_a_turn() -> None:
    """x holds 2 sin(angle / 2) axis: 2 is half a turn, and longer ones are of no rotation."""
    arm, q = panda(), inside(panda(), 1, 7)[0]
    x = arm.x(q)
    x[3:] *= 2 / np.linalg.norm(x[3:])
    longer = np.concatenate([x[:3], 1.05 * x[3:]])
    for xi in (None, 0.5):
        found = arm.solve(np.array([x, longer]), xi)
        assert [InverseStatus(k).name for k in found.status] == ["FOUND", "OUT_OF_REACH"]
        np.testing.assert_allclose(abs(arm.x(found.q[0])[3:]), abs(x[3:]), atol=1e-6)
        assert np.isnan(found.q[1]).all()
    assert len(arm.self_motion(x)) > 0
    with pytest.raises(InvalidValueError, match="half a turn"):
        arm.self_motion(longer)
    with pytest.raises(InvalidValueError, match="half a turn"):
        arm.solve(longer, 0.5, all=True)


def test_rows_that_fail_do_not_disturb_others() -> None:
    arm, q = planar(), np.array([0.3, 0.9, 0.8])
    found = arm.solve([[np.nan, 0.0], arm.x(q), [9.0, 0.0]], start=q)
    assert [InverseStatus(k).name for k in found.status] == ["BAD_INPUT", "FOUND", "NOT_FOUND"]
    assert found.q[1] == pytest.approx(q, abs=1e-9)
    assert np.isnan(found.q[[0, 2]]).all()
    assert found.branch[1:] == (arm.branch_names[0], "")


def test_an_arm_comes_back_from_its_file(tmp_path: Path) -> None:
    arm, q = planar(), np.array([0.3, 0.9, 0.8])
    arm.save(tmp_path / "a.arm")
    for other in (oc.Arm.load(tmp_path / "a.arm"), pickle.loads(pickle.dumps(arm))):
        assert other.branch_names == arm.branch_names
        assert other.x(q) == pytest.approx(arm.x(q), abs=0)
        assert other.solve(arm.x(q), 0.2).q == pytest.approx(arm.solve(arm.x(q), 0.2).q, abs=1e-9)


def test_known_arms_load_by_name() -> None:
    arm, chart = oc.Arm.load("pr2-left"), oc.load("pr2-left-wide")
    assert arm.branch_names == (chart.notes["branch"],)
    assert arm.x(chart.domain.centre) == pytest.approx(chart.x(chart.domain.centre))
    with pytest.raises(UnknownNameError, match="iiwa7"):
        oc.Arm.load("iwa")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "branches"), [("panda", 4), ("baxter-left", 4), *nightly(("iiwa7", 8), ("xarm7", 8))])
def test_ready_arms_have_charts_of_all_branches(name: str, branches: int) -> None:
    """Held-out postures of each domain: xi rises along the self-motion, and x and xi lead back to the branch."""
    arm = oc.Arm.load(name)
    assert len(set(arm.branch_names)) == branches == len(arm.charts)
    for own, chart in zip(arm.branch_names, arm.charts, strict=True):
        q = chart.domain.sample(300, 99)
        assert (
            np.linalg.det(chart.jacobian(q)) * np.linalg.det(chart.jacobian(chart.domain.centre)) > 0
        ).mean() > 0.999
        found = arm.solve(arm.x(q), chart.xi(q)[:, 0], branch=own)
        assert found.found.all()
        assert set(found.branch) == {own}
    q = (arm.robot.sample(4000, seed=5) + np.pi) % (2 * np.pi) - np.pi  # charts hold one turn of each joint
    assert (arm.find_branches(q) >= 0).mean() > 0.5


def test_damaged_arm_files_are_refused(tmp_path: Path) -> None:
    file, damaged = tmp_path / "a.arm", tmp_path / "b.arm"
    planar().save(file)
    content = file.read_bytes()
    damaged.write_bytes(content[: len(content) // 2])
    with pytest.raises(ChartFileError, match=r"b\.arm"):
        oc.Arm.load(damaged)
    with zipfile.ZipFile(file) as whole, zipfile.ZipFile(damaged, "w") as copy:
        for name in whole.namelist():
            data = whole.read(name)
            copy.writestr(name, data if not name.endswith(".npy") else data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ChartFileError, match="edited"):
        oc.Arm.load(damaged)
    planar().charts[0].save(damaged, force=True)
    with pytest.raises(ChartFileError, match="expected 'orthocas-arm'"):
        oc.Arm.load(damaged)
    with pytest.raises(ChartFileError, match="did not write"):
        planar().save(damaged)


@pytest.mark.slow
def test_a_fit_has_a_chart_of_each_branch(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planar arm has one branch; the fit reports its progress under the branch's number. Cubic, to be quick."""
    cubic = partial(oc.fit_wide, parametrisation=oc.Polynomial(3), samples=1000)
    monkeypatch.setattr(arm_module, "fit_wide", cubic)
    known, stages = oc.problems.get("planar_3r_xy"), set[str]()

    def watch(progress: Progress) -> None:
        stages.add(progress.stage.partition(",")[0])

    arm = oc.Arm.fit(known.robot, known.task, monitor=watch)
    assert (len(arm.charts), stages) == (1, {"branch 1 of 1"})
    q = arm.charts[0].domain.home
    assert arm.solve(arm.x(q), start=q).branch == arm.branch_names[0]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: oc.Arm(oc.problems.get("iiwa").task).solve([0.1, 0.2, 0.3], start=np.zeros(7)), "n - m = 4"),
        (lambda: oc.Arm(3), "a Task"),  # type: ignore[arg-type]
        (lambda: oc.Arm(planar().task, (panda().charts[0],)), "charts"),
        (lambda: oc.Arm(panda().task).save("a.arm"), "without charts"),
        (lambda: oc.Arm(panda().task).solve(np.zeros(6), 0.1), "without charts"),
        (lambda: panda().self_motion([0.0, 1.0]), "shape"),
        (lambda: panda().self_motion(np.zeros((2, 6))), "one task value"),
        (lambda: panda().self_motion(np.full(6, np.nan)), "NaN"),
        (lambda: panda().solve(np.zeros(6), np.nan, all=True), "xi"),
        (lambda: panda().solve(np.diag([2.0, 2.0, 2.0, 1.0])), "rotation"),
        (lambda: panda().tracker(np.full(7, 9.0)), "within the joint limits"),
    ],
)
def test_bad_input_is_named(call: object, words: str) -> None:
    assert callable(call)
    with pytest.raises(OrthocasError, match=words):
        call()


def test_an_arm_needs_one_joint_more_than_its_task() -> None:
    robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[1.0, 1.0])
    with pytest.raises(NotRedundantError):
        oc.Arm(oc.Task.position(robot, "xy"))
    with pytest.raises(InvalidValueError, match="n - m = 2"):
        oc.Arm.fit(oc.problems.get("planar_3r_xy").robot, oc.Task.position(oc.problems.get("planar_3r_xy").robot, "x"))


@pytest.mark.slow
def test_full_turns_of_endless_joints_bring_postures_into_a_box() -> None:
    """Gen3's curves are traced on one sheet; a box about half a turn of its endless joints is met from both sides."""
    known = oc.load("gen3-wide")
    box = oc.Box([2.9, -1.0, 0.0, 1.4, -3.0, -1.0, 3.1], 0.5)
    chart = oc.fit(oc.Problem(known.robot, known.task, domain=box), oc.Polynomial(degree=2), samples=400).chart
    arm = oc.Arm(chart.task, (chart,))
    q = inside(arm, 20, 1)
    x, xi = chart.x(q), np.roll(chart.xi(q)[:, 0], 1)
    found = arm.solve(x, xi)
    assert found.status.tolist() == chart.solve(x=x, xi=xi[:, None], inside=True).status.tolist()
    assert box.contains(found.q).all()
    for k in range(5):
        assert len(arm.solve(x[k], chart.xi(q[k])[0], all=True)) >= 1
    # Without xi, in the chart's domain.
    near = arm.solve(x, start=q, branch=arm.branch_names[0])
    assert near.found.all()
    assert np.linalg.norm(near.q - q, axis=1).max() < 0.05


@pytest.mark.slow
def test_postures_at_which_a_closed_curve_begins_are_found() -> None:
    """Curves of these x begin at the postures themselves, which are stored, and there xi is met up to rounding."""
    known = oc.problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, domain=oc.Torus(3))
    chart = oc.fit(problem, oc.Polynomial(2), samples=300).chart
    arm, missed = oc.Arm(chart.task, (chart,)), 0
    for q in chart.domain.sample(25, 0):
        found = arm.solve(arm.x(q), float(chart.xi(q)[0]), all=True).q
        missed += bool(np.abs(np.exp(1j * found) - np.exp(1j * q)).max(axis=1).min() > 1e-5)
    assert missed == 0


@pytest.mark.slow
def test_where_full_turns_change_xi_an_arm_finds_as_many_as_its_chart() -> None:
    """All solutions within one and a half turns, as the chart's own search has them."""
    chart = oc.load("gen3-wide")
    arm = oc.Arm(chart.task, (chart,))
    q = inside(arm, 60, 21)
    phi = chart.phi(q)
    assert arm.solve(phi[:, :6], phi[:, 6]).found.all()
    turns = 2 * np.pi * np.isinf(chart.robot.lower)
    for row in phi[:3]:
        own, theirs = arm.solve(row[:6], row[6], all=True).q, chart.solutions(row)
        assert np.abs(chart.phi(own) - row).max() < 1e-8
        theirs = theirs[(np.abs(theirs[:, turns > 0]) < 3 * np.pi).all(axis=1)]
        apart = np.abs(wrap_shortest(theirs[:, None] - own, turns)).max(axis=2)
        assert len(theirs) > 3
        assert apart.min(axis=1).max() < 1e-4


def test_more_postures_than_there_is_room_for_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are not cut off in silence."""
    arm = oc.Arm.load("panda")
    q = arm.charts[0].domain.sample(20, 3)
    counts = [len(arm.solve(arm.x(row), arm.charts[0].xi(row)[0], all=True).q) for row in q]
    row = q[int(np.argmax(counts))]
    assert max(counts) > 1
    for room, fits in ((max(counts), True), (1, False)):
        monkeypatch.setattr(chart_kernel, "RULES", replace(chart_kernel.RULES, every=room))
        with contextlib.nullcontext() if fits else pytest.raises(InvalidValueError, match="more than 1 postures have"):
            assert len(arm.solve(arm.x(row), arm.charts[0].xi(row)[0], all=True).q) == max(counts)
