"""Chart files: complete, the same bytes for the same chart, and written whole or not at all."""

import dataclasses
import json
from pathlib import Path
from typing import Self

import casadi as ca
import numpy as np
import pytest
from chart_files import header_of, rewritten

import orthocas as oc
from orthocas.errors import InvalidValueError, NotSavableWarning, OrthocasError
from orthocas.fitting.fit import Fit

KINDS = {
    "polynomial, inertia": lambda r: (oc.Task.position(r, "x"), "inertia", oc.Polynomial(2, joints=1)),
    "mlp, constant metric": lambda r: (oc.Task.position(r, "xy"), np.diag([1.0, 2.0, 3.0]), oc.MLP((4,))),
    "fourier, polar": lambda r: (oc.Task.polar(r), "euclidean", oc.Fourier(1)),
    "linear, custom task": lambda r: (
        oc.Task.custom(r, "mine", lambda q: ca.vertcat(ca.sin(q[0]) + q[1], q[2] * ca.exp(q[0]))),
        "euclidean",
        oc.Linear(),
    ),
    "custom metric": lambda r: (
        oc.Task.position(r, "x"),
        lambda q: ca.diag(ca.vertcat(1 + q[0] ** 2, 1, 2)),
        oc.Polynomial(1),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["orientation", "pose:z", "axis:x", "position+axis:z"])
def test_tasks_with_a_reference_come_back_with_it(kind: str, iiwa: oc.Problem, tmp_path: Path) -> None:
    problem = oc.Problem(iiwa.robot, oc.Task.named(iiwa.robot, kind), domain=iiwa.domain)
    oc.fit(problem, oc.Linear()).chart.save(tmp_path / "turned")
    again = oc.load(tmp_path / "turned").problem.task
    q = iiwa.domain.centre + 0.1
    np.testing.assert_array_equal(np.array(again.function(q)), np.array(problem.task.function(q)))
    assert (again.name, again.labels, again.units) == (kind, problem.task.labels, problem.task.units)


def test_units_of_a_custom_task_come_back_and_older_files_have_none(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "t", lambda q: q[0] ** 2 + q[1], units=("rad^2",))
    path = tmp_path / "c.orthocas"
    oc.fit(oc.Problem(robot, task), oc.Polynomial(1)).chart.save(path)
    assert oc.load(path).problem.task.units == ("rad^2",)
    header = header_of(path)
    del header["problem"]["task"]["units"]  # type: ignore[attr-defined]
    assert oc.load(rewritten(path, {"header.json": json.dumps(header).encode()})).problem.task.units == ("",)


def test_limits_of_effort_come_back_and_are_unknown_to_older_files(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    robot = oc.Robot(dataclasses.replace(robot.tree, effort_limits=[3.0, np.inf], velocity_limits=[1.0, 2.0]))
    path = tmp_path / "c.orthocas"
    oc.fit(oc.Problem(robot, oc.Task.position(robot, "x")), oc.Polynomial(1)).chart.save(path)
    again = oc.load(path).problem.robot
    np.testing.assert_array_equal(again.effort_limits, [3.0, np.inf])
    np.testing.assert_array_equal(again.velocity_limits, [1.0, 2.0])
    names = ("robot_effort_limits", "robot_velocity_limits")
    header = header_of(path)
    header["sha256"] = {name: value for name, value in header["sha256"].items() if name.split(".")[0] not in names}
    rewritten(path, {"header.json": json.dumps(header).encode()}, without=[f"{name}.npy" for name in names])
    older = oc.load(path).problem.robot
    assert np.isinf([older.effort_limits, older.velocity_limits]).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_chart_comes_back_the_same(kind: str, tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 0.9, 0.8], [3.0, 2.0, 1.0])
    task, metric, parametrisation = KINDS[kind](robot)
    problem = oc.Problem(robot, task, metric, oc.Box([0.6, 0.8, 0.8], 0.3), "mine")
    chart = oc.fit(problem, parametrisation, samples=60).chart
    path = tmp_path / "chart.orthocas"
    chart.save(path)
    again = oc.load(path)
    q = np.random.default_rng(0).uniform(0.5, 0.9, (10, 3))
    np.testing.assert_array_equal(again.phi(q), chart.phi(q))
    np.testing.assert_array_equal(again.jacobian(q), chart.jacobian(q))
    assert oc.evaluate(again, 50).as_dict() == oc.evaluate(chart, 50).as_dict()
    assert again.notes == chart.notes
    np.testing.assert_allclose(again.problem.robot.mass_matrix(q), robot.mass_matrix(q))


def test_linear_keeps_its_base_and_normals(planar_x: oc.Problem, tmp_path: Path) -> None:
    base = (0.7, 0.75, 0.9)
    chart = oc.fit(planar_x, oc.Linear(base, "paper")).chart
    np.testing.assert_allclose(chart.xi(np.array(base)), 0, atol=1e-15)  # xi(q) = N^T (q - q0)
    chart.save(tmp_path / "linear")
    again = oc.load(tmp_path / "linear")
    assert again.coordinates.parametrisation == oc.Linear(base, "paper")
    np.testing.assert_array_equal(again.xi([0.1, 0.2, 0.3]), chart.xi([0.1, 0.2, 0.3]))


class Mine:
    """A user's own parametrisation."""

    label = "mine"
    linear = True
    closed_form = None

    def for_problem(self, problem: oc.Problem) -> Self:
        return self

    def family(self, space: object, outputs: int) -> object:
        return oc.Polynomial(1).family(space, outputs)  # type: ignore[arg-type]


@pytest.mark.slow
def test_parametrisation_that_could_not_be_read_back_is_not_written(planar_x: oc.Problem, tmp_path: Path) -> None:
    with pytest.warns(NotSavableWarning, match="parametrisation is Mine, expected a registered class"):
        chart = oc.fit(planar_x, Mine(), oc.solvers.LBFGS()).chart
    with pytest.raises(InvalidValueError, match="parametrisation is Mine, expected a registered class"):
        chart.save(tmp_path / "mine")
    assert list(tmp_path.iterdir()) == []


def test_numpy_numbers_in_settings_do_not_reach_the_file(planar_x: oc.Problem, tmp_path: Path) -> None:
    weights = tuple(np.array([1000, 30, 100], dtype=np.float32))
    chart = oc.fit(planar_x, oc.Polynomial(np.int64(2)), weights=weights, samples=np.int64(100), seed=np.int64(3)).chart
    chart.save(tmp_path / "numpy")
    assert oc.load(tmp_path / "numpy").notes["seed"] == 3


@pytest.mark.slow
def test_custom_operation_that_files_cannot_hold_fails_at_saving_only(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "odd", lambda q: ca.erf(q[0]) + ca.hypot(q[0], 3 + q[1]) + ca.log1p(q[0] ** 2))
    chart = oc.fit(oc.Problem(robot, task), oc.Polynomial(1)).chart
    chart.save(tmp_path / "odd")
    np.testing.assert_array_equal(oc.load(tmp_path / "odd").phi([0.1, 0.2]), chart.phi([0.1, 0.2]))
    task = oc.Task.custom(robot, "odder", lambda q: q[1] + ca.erfinv(q[0] / 10))
    chart = oc.fit(oc.Problem(robot, task), oc.Polynomial(1)).chart
    with pytest.raises(OrthocasError, match="chart files cannot store"):
        chart.save(tmp_path / "odder")


@pytest.mark.slow
def test_pose_and_torus_come_back(tmp_path: Path, iiwa: oc.Problem) -> None:
    task = oc.Task.named(iiwa.robot, "pose", iiwa.domain.centre)
    chart = oc.fit(oc.Problem(iiwa.robot, task, domain=iiwa.domain), oc.Polynomial(1), samples=100).chart
    chart.save(tmp_path / "pose.orthocas")
    q = iiwa.domain.centre + 0.1
    np.testing.assert_array_equal(oc.load(tmp_path / "pose.orthocas").phi(q), chart.phi(q))
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    turning = oc.fit(oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Torus(2)), oc.Fourier(1)).chart
    turning.save(tmp_path / "torus.orthocas")
    assert isinstance(oc.load(tmp_path / "torus.orthocas").problem.domain, oc.Torus)


def test_same_chart_gives_the_same_bytes(planar_fit: Fit, saved: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.orthocas"
    planar_fit.chart.save(other)
    assert other.read_bytes() == saved.read_bytes()


def test_charts_stored_without_compression_are_read(saved: Path, planar_fit: Fit) -> None:
    rewritten(saved, {})  # zipfile stores by default
    np.testing.assert_array_equal(oc.load(saved).phi([0.6, 0.8, 0.8]), planar_fit.chart.phi([0.6, 0.8, 0.8]))


def test_notes_that_could_not_be_read_back_are_not_written(planar_fit: Fit, tmp_path: Path) -> None:
    chart = dataclasses.replace(planar_fit.chart, notes={"loss": float("nan")})
    with pytest.raises(InvalidValueError, match="note 'loss' is nan, expected a finite number"):
        chart.save(tmp_path / "chart")
    assert list(tmp_path.iterdir()) == []


def test_robot_functions_are_built_when_they_are_used() -> None:
    robot = oc.Robot.planar([1.0] * 100, [1.0] * 100)
    assert robot.tip_position(np.zeros(100))[0] == pytest.approx(100)
    assert list(robot._functions._values) == [("tip_position",)]
    with pytest.raises(OrthocasError, match="200 movable joints, expected at most 150"):
        oc.Robot.planar([1.0] * 200, [1.0] * 200)
