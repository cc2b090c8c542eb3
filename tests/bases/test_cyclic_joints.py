"""Cyclic joints: found where the task only turns or shifts, and charts that hold at all their positions."""

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import ROBOTS, robot_data
from programs import Run

import orthocas as oc
from orthocas import bases, problems
from orthocas.bases import cyclic_joints, parse_parametrisation
from orthocas.charts.chart_file import CHART
from orthocas.codegen.check import check_c
from orthocas.control import ControlStatus, Kinematic, PDPlus
from orthocas.errors import DomainError, InvalidValueError
from orthocas.fitting.fit import Fit
from orthocas.fitting.probe import compute_leak_and_conditioning, evaluate_chart
from orthocas.tasks.samples import evaluate_samples, sample_boundary_weighted, sample_uniform
from orthocas.tools.archive import read_archive
from orthocas.tools.batch import Batched

FULL_TURN = np.linspace(-2.96, 2.96, 60)  # inside the limits of A1 [rad]


@pytest.fixture(scope="module")
def cyclic_fit() -> Fit:
    return oc.fit(problems.get("iiwa"), oc.Polynomial(4, cyclic="auto"))


@pytest.fixture(scope="module")
def endless() -> oc.Chart:
    """A chart of an arm whose first joint turns without end."""
    return oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(3, cyclic="auto")).chart


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_base_rotation_of_a_position_task_is_cyclic(metric: str) -> None:
    known = problems.get("iiwa")
    assert cyclic_joints(oc.Problem(known.robot, known.task, metric, known.domain)) == ("A1",)


@pytest.mark.parametrize(
    ("task", "metric", "wanted"),
    [
        (lambda robot: oc.Task.custom(robot, "half", lambda q: ca.fmax(q[0], 0)), "euclidean", ()),
        (lambda robot: oc.Task.position(robot, "xy"), "euclidean", ("q1",)),
        (oc.Task.polar, "inertia", ("q1",)),
        (lambda robot: oc.Task.position(robot, "x"), "euclidean", ()),  # one direction of the plane is not the plane
        (lambda robot: oc.Task.position(robot, "xy"), lambda q: ca.diag(2 + ca.cos(q)), ()),
        (lambda robot: oc.Task.custom(robot, "wave", lambda q: q[0] + ca.sin(q[1])), "euclidean", ("q1",)),
        (lambda robot: oc.Task.custom(robot, "scaled", lambda q: ca.exp(q[0]) * ca.sin(q[1])), "euclidean", ()),
    ],
    ids=["loses rank", "xy", "polar", "x", "metric that feels the joint", "shift", "no isometry"],
)
def test_a_joint_is_cyclic_if_and_only_if_task_and_metric_stay_alike(
    task: object, metric: object, wanted: tuple[str, ...]
) -> None:
    known = problems.get("planar_3r_xy")
    assert cyclic_joints(oc.Problem(known.robot, task(known.robot), metric, known.domain)) == wanted


@pytest.mark.slow
def test_lifting_torso_is_cyclic_for_a_pose() -> None:
    file, tip = ROBOTS["tiago with its prismatic torso"]
    robot = oc.Robot.from_urdf(robot_data(file), tip)
    assert cyclic_joints(oc.Problem(robot, oc.Task.position(robot))) == ("torso_lift_joint", "arm_1_joint")
    assert cyclic_joints(oc.Problem(robot, oc.Task.pose(robot))) == ("torso_lift_joint",)


def test_basis_keeps_one_term_of_a_cyclic_joint() -> None:
    known = problems.get("iiwa")
    reduced = oc.Polynomial(5, cyclic="auto").for_problem(known)
    assert (reduced.cyclic, 3 * reduced.term_count(6), 3 * oc.Polynomial(5).term_count(6)) == (("A1",), 756, 1383)
    for kind in (oc.Polynomial(3, ["A1"]), oc.Fourier(2, ["A1"])):
        terms = np.array(kind.family(_space(known), 1).terms)
        assert (terms[:, 0] > 0).sum() == 1
        assert len(terms) == kind.term_count(7)


def _space(problem: oc.Problem) -> bases.JointSpace:
    return bases.JointSpace.of(problem)


@pytest.mark.slow
def test_chart_holds_over_the_full_turn_of_the_first_axis(cyclic_fit: Fit) -> None:
    """Leaks and conditioning at held-out points do not change when A1 moves, and the angles are the issue's."""
    chart = cyclic_fit.chart
    assert cyclic_fit.cyclic_joints == ("A1",)
    np.testing.assert_allclose(chart.problem.domain.half_width[0], np.radians(170), atol=1e-6)
    here = sample_boundary_weighted(problems.get("iiwa").domain, 60, seed=8)
    there = here.copy()
    there[:, 0] = FULL_TURN
    found = [
        compute_leak_and_conditioning(evaluate_samples(chart.problem, q), chart.coordinates.jacobian(q))
        for q in (here, there)
    ]
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)
    report = oc.evaluate(chart, 20_000, seed=5)
    assert report.task_angle.std < 3.0  # without the fold term 2.38
    assert report.mutual_angle.std < 5.0  # without the fold term 3.24
    assert report.conditioning.min > 0.1


@pytest.mark.slow
def test_free_fit_leaks_more_at_other_angles(cyclic_fit: Fit, iiwa_fit: Fit) -> None:
    """The reason for the option: a chart of the cube does not know other angles of A1."""
    cube = iiwa_fit.chart
    outside = oc.Chart(cyclic_fit.chart.problem, cube.coordinates)
    assert evaluate_chart(outside, 5000, 1).leak_deg > 1.5 * evaluate_chart(cyclic_fit.chart, 5000, 1).leak_deg


def test_joint_without_limits_becomes_unbounded(endless: oc.Chart) -> None:
    domain = endless.problem.domain
    assert (domain.unbounded, domain.half_width[0]) == ((0,), np.pi)
    lower, upper = domain.bounds
    assert (lower[0], upper[0]) == (-np.inf, np.inf)
    q = np.tile(domain.centre, (3, 1))
    q[:, 0] = (0.1, 0.1 + 2 * np.pi, -40.0)
    assert domain.contains(q).all()
    np.testing.assert_allclose(endless.jacobian(q)[0], endless.jacobian(q)[1], atol=1e-9)
    q[:, 1] += 2.0
    assert not domain.contains(q).any()


def test_guard_of_controllers_follows_the_unbounded_joint(endless: oc.Chart) -> None:
    law = PDPlus(endless, 20.0)
    q = np.tile(endless.problem.domain.centre, (3, 1))
    q[1, 0], q[2, 1] = 100.0, 3.0
    phi, zero = endless.phi(q), np.zeros((3, 3))
    gains = [np.tile(value, (3, 1)) for value in law.gains.values()]
    status = Batched(law.function)(q, zero, phi, zero, zero, *gains)[1].ravel()
    assert status.tolist() == [ControlStatus.OK, ControlStatus.OK, ControlStatus.OUTSIDE_DOMAIN]


@pytest.mark.parametrize("law", [lambda chart: PDPlus(chart, 20.0), lambda chart: Kinematic(chart, 3.0)])
def test_commands_do_not_depend_on_whole_turns_of_the_unbounded_joint(endless: oc.Chart, law: object) -> None:
    """An angle that a sensor wraps from pi to -pi must not make the springs jump."""
    built = law(endless)
    q = np.tile(endless.problem.domain.centre + 0.1, (4, 1))
    q[:, 0] += 2 * np.pi * np.array([0, 1, -1, 3])
    wanted = np.tile(endless.phi(endless.problem.domain.centre), (4, 1))
    gains = [np.tile(value, (4, 1)) for value in built.gains.values()]
    command, status = Batched(built.function)(q, np.zeros((4, 3)), wanted, *np.zeros((2, 4, 3)), *gains)
    assert not status.any()
    assert np.abs(command[0]).max() > 0.1
    np.testing.assert_allclose(command, command[:1].repeat(4, axis=0), atol=1e-8)
    xi = endless.xi(q)
    assert np.abs(xi[1] - xi[0]).max() > 1  # the coordinates themselves do count turns


@pytest.mark.slow
def test_generated_c_agrees_on_the_unbounded_joint(endless: oc.Chart, tmp_path: Path) -> None:
    law = PDPlus(endless, 20.0, limit=90.0)
    generated = oc.generate_c(endless, tmp_path / "c", law, "arm")
    assert "q1: all positions" in "".join(path.read_text() for path in (tmp_path / "c").glob("*.h"))
    proof = check_c(generated, endless, law, states=60)
    assert max(proof.differences.values()) < 1e-10


def test_chart_file_keeps_cyclic_and_unbounded_joints(endless: oc.Chart, tmp_path: Path) -> None:
    endless.save(tmp_path / "a.orthocas")
    again = oc.load(tmp_path / "a.orthocas")
    assert again.problem.domain.unbounded == (0,)
    assert again.coordinates.label == "polynomial:3:cyclic=q1"
    q = sample_uniform(endless.problem.domain, 5, 0)
    np.testing.assert_array_equal(again.phi(q), endless.phi(q))
    assert read_archive(tmp_path / "a.orthocas", CHART)[0]["problem"]["unbounded"] == [0]


@pytest.mark.slow
def test_prismatic_cyclic_joint_covers_its_limits() -> None:
    file, tip = ROBOTS["tiago with its prismatic torso"]
    robot = oc.Robot.from_urdf(robot_data(file), tip)
    chart = oc.fit(oc.Problem(robot, oc.Task.position(robot)), oc.Polynomial(1, cyclic="auto"), samples=200).chart
    low, high = chart.problem.domain.bounds
    np.testing.assert_allclose([low[:2], high[:2]], [robot.lower[:2], robot.upper[:2]])
    assert np.isfinite(high).all()


def test_torus_keeps_its_full_turns() -> None:
    robot = oc.Robot.planar([1, 1, 1], [3, 3, 3])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Torus(3))
    chart = oc.fit(problem, oc.Fourier(1, cyclic="auto"), samples=300).chart
    assert isinstance(chart.problem.domain, oc.Torus)
    q = np.array([[0.3, 1.0, 0.5]])
    turned = q + 2 * np.pi * np.array([1, -1, 2])
    np.testing.assert_allclose(chart.jacobian(q), chart.jacobian(turned), atol=1e-9)


@pytest.mark.parametrize(
    ("label", "wanted"),
    [
        ("polynomial:3:cyclic", oc.Polynomial(3, "auto")),
        ("polynomial:3:cyclic=A1,A2", oc.Polynomial(3, ["A1", "A2"])),
        ("fourier:2:cyclic=A1", oc.Fourier(2, ["A1"])),
        ("polynomial:3", oc.Polynomial(3)),
    ],
)
def test_labels_name_cyclic_joints(label: str, wanted: bases.Parametrisation) -> None:
    assert parse_parametrisation(label) == wanted
    assert wanted.label == label


@pytest.mark.parametrize("label", ["polynomial:3:cyc", "polynomial:3:", "polynomial:3:cyclic=", "polynomial:x:cyclic"])
def test_other_words_after_the_degree_are_refused(label: str) -> None:
    if label.endswith("3:"):
        assert parse_parametrisation(label) == oc.Polynomial(3)
        return
    with pytest.raises(InvalidValueError, match="parametrisation"):
        parse_parametrisation(label)


def test_joints_that_are_not_cyclic_are_refused() -> None:
    known = problems.get("iiwa")
    with pytest.raises(InvalidValueError, match="cyclic is 'A2', expected one of the cyclic joints: A1"):
        oc.fit(known, oc.Polynomial(2, ["A2"]), samples=100)
    with pytest.raises(InvalidValueError, match="cyclic is 'A1', expected one of the joints A2, A3"):
        oc.Polynomial(2, ["A1"]).family(_space(known).restricted_to([1, 2]), 1)
    with pytest.raises(InvalidValueError, match="for_problem"):
        oc.Polynomial(2, "auto").family(_space(known), 1)
    for wrong in ("A1", ["A1", "A1"], [1], 3, np.array(["A1", 0], dtype=object)):
        with pytest.raises(InvalidValueError, match="a list of different joint names, or 'auto'"):
            oc.Polynomial(2, wrong)


def test_problem_without_cyclic_joints_is_fitted_as_it_is() -> None:
    known = problems.get("planar_3r_x")
    fit = oc.fit(known, oc.Polynomial(2, cyclic="auto"), samples=200)
    assert fit.cyclic_joints == ()
    assert fit.chart.coordinates.label == "polynomial:2"
    assert fit.chart.problem is known


def test_unbounded_joints_of_boxes_are_checked() -> None:
    box = oc.Box([0.0, 1.0], 0.5, [1])
    assert box.contains([[0.2, 99.0], [0.6, 1.0]]).tolist() == [True, False]
    for wrong in ([2], [-1], [0.5], "x", 1):
        with pytest.raises(InvalidValueError, match="unbounded"):
            oc.Box([0.0, 1.0], 0.5, wrong)
    limited = problems.get("iiwa")
    with pytest.raises(DomainError, match="joint 'A1' is \\[-inf, inf\\]"):
        oc.Problem(limited.robot, limited.task, domain=oc.Box(limited.domain.centre, 0.3, [0]))


@pytest.mark.slow
def test_info_and_fit_name_the_cyclic_joints(run: Run) -> None:
    words = ("planar_3r_xy", "--param", "polynomial:2:cyclic", "--samples", "300", "--json", "--out", "a.orthocas")
    assert json.loads(run("fit", *words)[1])["cyclic_joints"] == ["q1"]
    data = json.loads(run("info", "a.orthocas", "--json")[1])
    assert (data["cyclic_joints"], data["unbounded_joints"]) == (["q1"], ["q1"])
    assert data["parametrisation"] == "polynomial:2:cyclic=q1"
