"""Quantities that are coordinates themselves: swivels, joints and functions, from the fit to files, trackers and C."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import robot_data
from numpy.typing import NDArray
from programs import Run, needs_c, nightly

import orthocas as oc
from orthocas import control
from orthocas.bases.given import SEW_KINDS, SEWKind, find_periods, sew_angle
from orthocas.charts.trackers import TrackerStatus
from orthocas.codegen import check_c
from orthocas.errors import DomainError, InvalidValueError, ShapeError
from orthocas.fitting.wide import WideFit
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import dense_function
from orthocas.tools.expressions import write_tape

Numbers = NDArray[np.float64]
BENT = oc.Box([0.0, 1.3, 1.3], [3.0, 1.2, 1.2])  # of the planar arm, which has no branches
# robot file, tip, locked joints; shares of the branch on which the conventional and the stereographic angle are regular
ARMS = {
    "iiwa": (None, "", {}, (0.97, 0.97)),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand", {"panda_finger_joint1": 0.0}, (0.95, 0.92)),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link_eef", {}, (0.95, 0.91)),
    "baxter": ("baxter_description/urdf/baxter.urdf", "left_gripper", {}, (0.94, 0.94)),
}
# three joints place the wrist, four turn it, with axes through one point
GIMBAL = (
    ("yaw0", "0 0 1", "0 0 0.2", -1.2, 0.8),
    ("lift", "0 1 0", "0 0 0", -0.7, 0.7),
    ("elbow", "0 1 0", "0.28 0 0", 0.4, 1.6),
    ("platform", "1 0 0", "0.3 0 0", -1, 4.2),
    ("pitch", "0 1 0", "0 0 0", 0.2, 3),
    ("yaw", "0 0 1", "0 0 0", -0.78, 0.78),
    ("roll", "1 0 0", "0 0 0", -4.7, 4.7),
)


@cache
def robot_of(name: str) -> oc.Robot:
    file, tip, locked, _ = ARMS[name]
    return oc.problems.get("iiwa").robot if file is None else oc.Robot.from_urdf(robot_data(file), tip, locked)


@cache
def swivel_fit(name: str, kind: SEWKind) -> WideFit:
    robot = robot_of(name)
    task = oc.Task.pose(robot)
    if kind == "conventional":
        return oc.fit_wide(robot, task, like="swivel", exact=True)
    return oc.fit_wide(robot, task, parametrisation=oc.SEW(kind))


def swivels(robot: oc.Robot, kind: str, q: Numbers) -> Numbers:
    return np.array(sew_angle(robot, kind).map(len(q))(q.T))[0]


def wrapped(angles: Numbers) -> Numbers:
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *tuple(zip(ARMS, SEW_KINDS * 2, strict=True))[1:3],
        *nightly(*zip(ARMS, SEW_KINDS[::-1] * 2, strict=True), *tuple(zip(ARMS, SEW_KINDS * 2, strict=True))[::3]),
    ],
)
def test_xi_is_the_swivel_and_moves_it_by_what_is_asked(name: str, kind: SEWKind) -> None:
    fit, robot = swivel_fit(name, kind), robot_of(name)
    chart, domain, least = fit.chart, fit.chart.problem.domain, ARMS[name][3][SEW_KINDS.index(kind)]
    assert fit.regular_share > least
    assert chart.parts.named_coordinates == (
        f"xi1: {'swivel' if kind == 'conventional' else 'sew:stereographic'} [rad]",
    )
    q = sample_uniform(domain, 3000, 5)
    psi = swivels(robot, kind, q)
    np.testing.assert_allclose(chart.xi(q)[:, 0], psi, atol=1e-12, rtol=0)
    assert np.ptp(psi) > 5  # nearly a whole turn
    assert fit.meaning is not None
    assert fit.meaning.rms < 1e-12
    assert fit.meaning.against == 0
    arrived = 0
    for start, angle in zip(q[:20], psi[:20], strict=True):
        tracker, phi = chart.tracker(start), chart.phi(start)
        for k in range(1, 7):
            tracker.step(phi + np.append(np.zeros(6), 0.05 * k))
        if tracker.status is TrackerStatus.OK:
            arrived += 1
            moved = wrapped(swivels(robot, kind, tracker.q[None]) - angle)
            assert moved == pytest.approx(0.3, abs=1e-9)
            np.testing.assert_allclose(robot.tip_position(tracker.q), robot.tip_position(start), atol=1e-9)
    assert arrived >= 12


@pytest.mark.slow
def test_values_of_angles_count_up_to_whole_turns() -> None:
    """A swivel of pi - 0.01 and a change by 0.02: xi passes its jump, in solve and in a tracker."""
    fit, robot = swivel_fit("panda", "conventional"), robot_of("panda")
    chart = fit.chart
    assert chart.parts.turns.tolist() == [0.0] * 6 + [2 * np.pi]
    q = sample_uniform(chart.problem.domain, 20_000, 6)
    near = q[np.pi - np.abs(swivels(robot, "conventional", q)) < 0.02][:10]
    assert len(near) == 10
    for start in near:
        phi = chart.phi(start)
        beyond = phi - np.append(np.zeros(6), 2 * np.pi * np.sign(phi[-1]))
        found = chart.solve(beyond[None])
        assert found.status[0] == oc.InverseStatus.FOUND
        # a pose may have several postures with this swivel
        np.testing.assert_allclose(robot.tip_position(found.q[0]), robot.tip_position(start), atol=1e-9)
        np.testing.assert_allclose(robot.tip_rotation(found.q[0]), robot.tip_rotation(start), atol=1e-9)
        angles = swivels(robot, "conventional", np.array([found.q[0], start]))
        assert wrapped(angles[0] - angles[1]) == pytest.approx(0.0, abs=1e-9)
        tracker = chart.tracker(start)
        for k in range(1, 6):
            tracker.step(phi + np.append(np.zeros(6), 0.02 * k * np.sign(phi[-1])))
        if tracker.status is TrackerStatus.OK:
            now = swivels(robot, "conventional", tracker.q[None])
            assert wrapped(now - phi[-1]) == pytest.approx(0.1 * np.sign(phi[-1]), abs=1e-9)
            assert np.abs(tracker.q - start).max() < 1


@pytest.mark.slow
@needs_c
def test_files_solutions_and_c_of_a_swivel(tmp_path: Path) -> None:
    chart = swivel_fit("panda", "conventional").chart
    q = sample_uniform(chart.problem.domain, 500, 8)
    chart.save(tmp_path / "swivel")
    again = oc.load(tmp_path / "swivel")
    np.testing.assert_array_equal(again.phi(q), chart.phi(q))
    np.testing.assert_array_equal(again.problem.domain.contains(2 * q), chart.problem.domain.contains(2 * q))
    assert again.parts.turns.tolist() == chart.parts.turns.tolist()
    assert again.parts.named_coordinates == ("xi1: swivel [rad]",)
    found = again.solve(chart.phi(q))
    assert (found.status == oc.InverseStatus.FOUND).all()
    np.testing.assert_allclose(chart.x(found.q), chart.x(q), atol=1e-8)
    law = control.PDPlus.on_chart(chart)
    checked = check_c(oc.generate_c(chart, tmp_path / "c", law, "arm"), chart, law, 200)
    assert max(checked.differences.values()) < 1e-12


@cache
def gimbal(folder: Path) -> oc.Robot:
    text, last = '<robot name="master"><link name="base"/>', "base"
    inertia = '<inertia ixx=".01" ixy="0" ixz="0" iyy=".01" iyz="0" izz=".01"/>'
    for name, axis, origin, low, high in GIMBAL:
        text += (
            f'<link name="{name}_link"><inertial><mass value="0.4"/>{inertia}</inertial></link><joint name="{name}" '
            f'type="revolute"><parent link="{last}"/><child link="{name}_link"/><origin xyz="{origin}"/>'
            f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="50" velocity="5"/></joint>'
        )
        last = f"{name}_link"
    (folder / "gimbal.urdf").write_text(f"{text}</robot>")
    return oc.Robot.from_urdf(folder / "gimbal.urdf", "roll_link")


@pytest.mark.slow
def test_a_joint_that_is_regular_nearly_everywhere_is_the_coordinate_by_itself(tmp_path: Path) -> None:
    """The hand of a master arm rolls by 90 degrees with xi held: its platform rests."""
    robot = gimbal(tmp_path)
    fit = oc.fit_wide(robot, oc.Task.pose(robot), like="platform")
    chart, domain = fit.chart, fit.chart.problem.domain
    assert fit.regular_share > 0.995
    assert chart.parts.named_coordinates == ("xi1: platform [rad]",)
    assert chart.parts.turns[-1] == 0  # a joint is no angle that jumps
    q = sample_uniform(domain, 400, 1)
    np.testing.assert_array_equal(chart.xi(q)[:, 0], q[:, 3])
    rolled = 0
    for start in q[:60]:
        start[6] = -0.8
        R, p, tracker, inside = robot.tip_rotation(start), robot.tip_position(start), chart.tracker(start), True
        for a in np.linspace(0, np.pi / 2, 60):
            turn = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
            tracker.step(np.append(chart.problem.task.value(p, R @ turn), start[3]))
            inside = inside and tracker.status is TrackerStatus.OK
        if inside:
            rolled += 1
            assert abs(tracker.q[3] - start[3]) < 1e-9
    assert rolled > 30
    near = oc.fit_wide(robot, oc.Task.pose(robot), like="platform", exact=False, samples=2000)
    assert near.chart.parts.named_coordinates == ("xi1: like platform [rad]",)


@pytest.mark.slow
def test_coordinates_are_fitted_where_a_quantity_folds() -> None:
    """Joints of a planar arm: self-motions change the first one steadily, and turn the second one back."""
    known = oc.problems.get("planar_3r_xy")
    fits = [oc.fit_wide(known.robot, known.task, BENT, like=like) for like in ("q1", "q2")]
    assert [fit.chart.parts.named_coordinates[0] for fit in fits] == ["xi1: q1 [rad]", "xi1: like q2 [rad]"]
    assert fits[1].meaning is not None
    assert fits[1].meaning.against > 0.03
    whole = oc.fit_wide(known.robot, known.task, BENT, like="q2", exact=True)
    assert 0.9 < whole.regular_share < 0.95
    q = sample_uniform(whole.chart.problem.domain, 1000, 1)
    np.testing.assert_array_equal(whole.chart.xi(q)[:, 0], q[:, 1])
    # along self-motions, a cross product of the task's rows, with more than the least of its length in the second joint
    z = np.cross(*known.task.batched_frame_jacobian(q)[0].reshape(len(q), 2, 3).transpose(1, 0, 2))
    cosines = z[:, 1] / np.linalg.norm(z, axis=1)
    assert (np.sign(cosines) == np.sign(cosines[0])).all()
    assert np.abs(cosines).min() > 0.05


def mixed(q: ca.SX) -> ca.SX:
    return q[0] + ca.sin(q[1] - 0.8)


def test_several_quantities_are_coordinates_if_there_are_enough_of_them() -> None:
    robot = oc.Robot.planar([1.0] * 4, [1.0] * 4)
    task, box = oc.Task.position(robot, "xy"), oc.Box([0.3, 0.8, 0.8, 0.8], [0.8, 0.4, 0.4, 0.4])
    fit = oc.fit_wide(robot, task, box, like=["q1", mixed])
    assert fit.chart.parts.named_coordinates == ("xi1: q1 [rad]", "xi2: mixed")
    q = sample_uniform(fit.chart.problem.domain, 500, 1)
    values = np.column_stack([q[:, 0], q[:, 0] + np.sin(q[:, 1] - 0.8)])
    np.testing.assert_allclose(fit.chart.xi(q), values, atol=1e-12)
    assert np.ptp(np.sign(np.linalg.det(fit.chart.jacobian(q)))) == 0
    given = oc.Given.from_function("both", 4, lambda q: ca.vertcat(q[0], mixed(q)))
    same = oc.fit_wide(robot, task, box, parametrisation=given)
    np.testing.assert_array_equal(same.chart.xi(q), fit.chart.xi(q))
    assert same.chart.parts.named_coordinates == ("xi1: both 1", "xi2: both 2")
    with pytest.raises(InvalidValueError, match="exact is given with 1 quantity, expected 2 of them"):
        oc.fit_wide(robot, task, box, like="q1", exact=True)
    with pytest.raises(InvalidValueError, match="like is quantities that self-motions cannot change independently"):
        oc.fit_wide(robot, task, box, like=["q1", lambda q: 2 * q[0]], exact=True)


@pytest.mark.slow
def test_what_cannot_be_exact_is_refused() -> None:
    known = oc.problems.get("planar_3r_xy")
    robot, task = known.robot, known.task
    with pytest.raises(InvalidValueError, match="exact is given without like"):
        oc.fit_wide(robot, task, BENT, exact=True)
    with pytest.raises(InvalidValueError, match="exact is .*yes"):
        oc.fit_wide(robot, task, BENT, like="q1", exact="yes")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="exact is given with a parametrisation to fit"):
        oc.fit_wide(robot, task, BENT, like="q1", exact=True, parametrisation=oc.Polynomial(2))
    given = oc.Given.from_function("first", 3, lambda q: q[0])
    with pytest.raises(InvalidValueError, match="like is given with first"):
        oc.fit_wide(robot, task, BENT, like="q1", parametrisation=given)
    with pytest.raises(InvalidValueError, match="exact is given with first"):
        oc.fit_wide(robot, task, BENT, exact=False, parametrisation=given)
    with pytest.raises(ShapeError, match="coordinates 'two'"):
        oc.fit_wide(robot, task, BENT, parametrisation=oc.Given.from_function("two", 3, lambda q: q[:2]))
    with pytest.raises(InvalidValueError, match="like is quantities that self-motions cannot change independently"):
        oc.fit_wide(
            robot, task, BENT, like=lambda q: ca.cos(q[0]) + ca.cos(q[0] + q[1]) + ca.cos(ca.sum1(q)), exact=True
        )
    with pytest.raises(DomainError, match="at the centre of branch 'box', self-motions do not change a function of q"):
        oc.fit_wide(robot, task, BENT, like=lambda q: q[0] ** 2, exact=True)


def test_angles_are_components_that_are_arctangents_themselves() -> None:
    q = ca.SX.sym("q", 3)
    angle = ca.atan2(q[1], q[0])
    values = ca.vertcat(angle, ca.sin(angle), q[2] + ca.atan2(q[2], q[1]), ca.atan2(q[0], 2.0), q[1])
    periods = find_periods(write_tape(dense_function("xi", [q], [values])))
    np.testing.assert_array_equal(periods, [2 * np.pi, 0, 0, 2 * np.pi, 0])


@pytest.mark.slow
def test_the_command_takes_quantities_as_they_are(run: Run) -> None:
    words = ("fit", "iiwa", "--task", "pose", "--out", "a", "--like", "swivel", "--exact")
    code, out, err = run(*words, "--domain", "branch", "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["meaning"]["like"] == "swivel [rad]"
    assert found["meaning"]["rms"] < 1e-12
    assert found["regular_share"] > 0.97
    code, out, _ = run("info", "a")
    assert code == 0
    assert "swivel [rad]" in out
    assert run(*words, "--force")[::2] == (2, "orthocas: --exact requires --domain branch and --like\n")


@pytest.mark.slow
def test_a_swivel_of_joints_without_boundaries() -> None:
    """Whole turns of base and tool change nothing. The search for one solution did not end: its start was 5e17 rad."""
    known = robot_of("panda")
    lower, upper = known.lower.copy(), known.upper.copy()
    lower[[0, 6]], upper[[0, 6]] = -np.inf, np.inf
    robot = oc.Robot(replace(known.tree, lower=lower, upper=upper))
    chart = oc.fit_wide(robot, oc.Task.pose(robot), like="swivel", exact=True).chart
    q = sample_uniform(chart.problem.domain, 200, 1)
    turned = q + 2 * np.pi * np.array([2, 0, 0, 0, 0, 0, -1])
    assert chart.problem.domain.contains(turned).all()
    np.testing.assert_allclose(chart.xi(turned), chart.xi(q), atol=1e-12)
    found = chart.solve(chart.phi(q))
    assert (found.status == oc.InverseStatus.FOUND).all()
