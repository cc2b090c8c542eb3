"""Arguments of many kinds: columns and expressions are understood, text and objects of other classes are refused."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from fuzz.calls import Like
from fuzz.good_calls import good_calls
from public_objects import CHARTS, circle, fitted, impedance, planar, points_of, steps, trajectory

import orthocas as oc
from orthocas import control, problems, simulation, solvers
from orthocas.charts.figures import quality_figure
from orthocas.codegen import check_c
from orthocas.errors import InvalidValueError, NoExpressionError, OrthocasError, ShapeError, UnknownNameError
from orthocas.fitting.loss import loss
from orthocas.tasks.domains import default_box
from orthocas.tasks.metric import Metric
from orthocas.tools.checks import as_float_array, as_point, as_point_set

ELSEWHERE = (  # arguments that are checked later, refused for another reason first, or not used by this task
    *("Friction.viscous", "MLP.hidden", "Robot.from_mjcf.tool", "Robot.from_urdf.tool", "Task.named.q_reference"),
)
EVALUATIONS = ("xi", "task", "phi", "jacobian")


@pytest.mark.parametrize("name", EVALUATIONS)
def test_a_column_is_one_joint_position(name: str) -> None:
    chart = fitted().chart
    q = points_of(chart)[0]
    evaluate = getattr(chart, name)
    for column in (ca.DM(q), q[:, None]):
        np.testing.assert_array_equal(evaluate(column), evaluate(q))
    np.testing.assert_array_equal(chart.problem.robot.mass_matrix(ca.DM(q)), chart.problem.robot.mass_matrix(q))


def test_columns_are_taken_where_a_motion_starts() -> None:
    chart, q = fitted().chart, planar().domain.centre
    np.testing.assert_array_equal(chart.inverse(ca.DM(chart.phi(q)), ca.DM(q)), chart.inverse(chart.phi(q), q))
    run = oc.simulate(impedance(), steps(), ca.DM(q), dq_start=ca.DM.zeros(3), step=0.05)
    np.testing.assert_array_equal(run.q, trajectory().q)
    path = control.joint_path(chart, steps(), q)
    np.testing.assert_array_equal(control.joint_path(chart, steps(), ca.DM(q)), path)


def test_sets_stay_sets() -> None:
    """Three points of three joints are a set, and with one joint a column is a set of points."""
    square = np.arange(9.0).reshape(3, 3)
    assert not as_point_set("q", square, 3)[1]
    points, single = as_point_set("q", [[1.0], [2.0]], 1)
    assert points.shape == (2, 1)
    assert not single
    assert as_point_set("q", [[1.0]], 1)[1] is False
    with pytest.raises(ShapeError, match=r"q has shape \(3, 1\), expected \('any', 4\)"):
        as_point_set("q", np.zeros((3, 1)), 4)
    with pytest.raises(ShapeError, match=r"q has shape \(3, 3\), expected \(3,\)"):
        as_point("q", square, 3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("chart", ["polynomial chart", "network chart"])
@pytest.mark.parametrize("name", EVALUATIONS)
def test_symbols_give_expressions(name: str, chart: str, kind: Any) -> None:
    found = CHARTS[chart]()
    q = kind.sym("q", 3)
    expression = getattr(found, name)(q)
    assert isinstance(expression, kind)
    at = points_of(found)[0]
    value = np.asarray(ca.Function("f", [q], [expression])(at))
    wanted = getattr(found, name)(at)
    np.testing.assert_allclose(value.reshape(wanted.shape), wanted, rtol=1e-12, atol=1e-13)


def test_symbols_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"q has shape \(4, 1\), expected \(3, 1\)"):
        fitted().chart.phi(ca.SX.sym("q", 4))
    with pytest.raises(NoExpressionError, match="distil"):
        circle().phi(ca.MX.sym("q", 2))


NO_NUMBERS = {
    "text": "1.0",
    "texts": ["1", "2", "3"],
    "text as an object": np.array(["1"], dtype=object),
    "bytes": b"1",
    "complex": 1j,
    "complex array": np.array([1.0 + 0j]),
    "None": None,
    "None inside": [1.0, None],
    "date": np.datetime64("2020-01-01"),
    "mapping": {1: 2},
    "ragged": [[1], [1, 2]],
    "SX": ca.SX.sym("q", 3),
    "MX": ca.MX.sym("q", 3),
    "object": object(),
}


@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_only_real_numbers_are_numbers(value: Any) -> None:
    with pytest.raises(InvalidValueError, match="^q is .*, expected an array of numbers$"):
        as_float_array("q", value)


NOT_ONE = {"list": [1.0], "tuple": (1.0,), "array": np.ones(1), "tensor": Like(1.0), "nested": [np.array(1.0)]}


@pytest.mark.parametrize("value", NOT_ONE.values(), ids=NOT_ONE)
def test_one_number_is_no_list_and_no_tensor(value: Any) -> None:
    """What is checked as a number is computed with as it is."""
    for call in (lambda: oc.Weights(task=value), lambda: fitted().chart.inverse(np.zeros(3), tolerance=value)):
        with pytest.raises(InvalidValueError, match="expected a number"):
            call()


def test_numbers_of_any_class_are_taken() -> None:
    values = [1, True, 1.5, np.float32(2), np.int8(3), Fraction(1, 2), ca.DM(4.0)]
    for value, wanted in zip(values, [1, 1, 1.5, 2, 3, 0.5, 4], strict=True):
        assert float(as_float_array("q", value).squeeze()) == wanted


WRONG: dict[str, Callable[[], Any]] = {
    "problem of fit": lambda: oc.fit("iiwa"),  # type: ignore[arg-type]
    "problem of compare": lambda: oc.compare("iiwa", [oc.Linear()]),  # type: ignore[arg-type]
    "problem of check": lambda: oc.check(fitted().chart),  # type: ignore[arg-type]
    "problem of involutivity": lambda: oc.involutivity(fitted().chart),  # type: ignore[arg-type]
    "problem of grow": lambda: oc.grow(fitted().chart),  # type: ignore[arg-type]
    "problem of a chart": lambda: oc.Chart("iiwa", fitted().chart.coordinates),  # type: ignore[arg-type]
    "chart of evaluate": lambda: oc.evaluate(planar()),  # type: ignore[arg-type]
    "chart of distil": lambda: oc.distil(planar()),  # type: ignore[arg-type]
    "chart of generate_c": lambda: oc.generate_c(planar(), "unused"),  # type: ignore[arg-type]
    "chart of Impedance": lambda: control.Impedance(planar(), 1.0),  # type: ignore[arg-type]
    "chart of Kinematic": lambda: control.Kinematic(planar(), 1.0),  # type: ignore[arg-type]
    "chart of matched_stiffness": lambda: control.matched_stiffness(planar()),  # type: ignore[arg-type]
    "chart of joint_path": lambda: control.joint_path(planar(), steps(), [0, 0, 0]),  # type: ignore[arg-type]
    "chart of coupling_index": lambda: simulation.coupling_index(planar(), steps(), trajectory()),  # type: ignore[arg-type]
    "chart of a breakdown": lambda: simulation.task_acceleration_breakdown(planar(), trajectory()),  # type: ignore[arg-type]
    "robot of a task": lambda: oc.Task.position(planar()),  # type: ignore[arg-type]
    "controller of simulate": lambda: oc.simulate(fitted().chart, steps(), [0, 0, 0]),  # type: ignore[arg-type]
    "controller of generate_c": lambda: oc.generate_c(fitted().chart, "unused", "pd_plus"),  # type: ignore[arg-type]
    "reference of simulate": lambda: oc.simulate(impedance(), [1, 2], [0, 0, 0]),  # type: ignore[arg-type]
    "pushes of simulate": lambda: oc.simulate(impedance(), steps(), [0, 0, 0], pushes=[1]),  # type: ignore[list-item]
    "friction of simulate": lambda: oc.simulate(impedance(), steps(), [0, 0, 0], friction=1.0),  # type: ignore[arg-type]
    "plant of simulate": lambda: oc.simulate(impedance(), steps(), [0, 0, 0], plant=planar()),  # type: ignore[arg-type]
    "homes of a robot": lambda: oc.Robot(planar().robot.tree, np.eye(3)),  # type: ignore[arg-type]
    "axis of Task.axis": lambda: oc.Task.axis(planar().robot, None),  # type: ignore[arg-type]
    "axis of Task.position_and_axis": lambda: oc.Task.position_and_axis(planar().robot, None),  # type: ignore[arg-type]
    "robot of default_box": lambda: default_box(planar()),  # type: ignore[arg-type]
    "robot of a metric": lambda: Metric.from_spec(planar(), "inertia"),  # type: ignore[arg-type]
    "problem of loss": lambda: loss("iiwa", oc.Linear()),  # type: ignore[arg-type]
    "model of a robot": lambda: oc.Robot.from_model(planar(), "tip"),  # type: ignore[arg-type]
    "coordinates of a chart": lambda: oc.Chart(planar(), planar()),  # type: ignore[arg-type]
    "report of a figure": lambda: quality_figure(planar()),  # type: ignore[arg-type]
    "trajectory of a breakdown": lambda: simulation.task_acceleration_breakdown(fitted().chart, planar()),  # type: ignore[arg-type]
    "labels of a reference": lambda: control.Reference.through(planar(), [0, 1], [[0], [1]]),  # type: ignore[arg-type]
    "chart of check_c": lambda: check_c(None, planar()),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("name", WRONG)
def test_objects_of_another_class_are_refused_by_name(name: str) -> None:
    argument = name.partition(" ")[0]
    with pytest.raises(
        InvalidValueError, match=rf"{argument} is ('\w+'|1|1\.0|None|a \w+), expected (a|those) "
    ) as refusal:
        WRONG[name]()
    assert "\n" not in str(refusal.value)


def test_objects_in_errors_take_one_line() -> None:
    with pytest.raises(InvalidValueError, match="expected an object such as Polynomial") as refusal:
        oc.fit(planar(), fitted().chart)  # type: ignore[arg-type]
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("value", [3, None, b"chart", ["a"], 1.5, "a\0b"])
def test_only_texts_and_paths_name_files(value: Any) -> None:
    """Also numbers, which Python would take for open files."""
    readers = [oc.load, oc.Robot.from_urdf, oc.Robot.from_mjcf, oc.Robot.from_file, simulation.Trajectory.load]
    for call in (*readers, fitted().chart.save, trajectory().save, lambda path: oc.generate_c(fitted().chart, path)):
        with pytest.raises(InvalidValueError, match="expected a path"):
            call(value)


def test_names_of_another_class_are_unknown_names() -> None:
    for call in (solvers.get, problems.get, control.law_of, fitted().chart.function, planar().robot.function):
        for value in (3, None, ["a"], np.zeros(2)):
            with pytest.raises(UnknownNameError):
                call(value)  # type: ignore[arg-type]


def test_numbers_too_large_to_work_with_are_refused_at_once() -> None:
    calls = [
        lambda: oc.Torus(10**18),
        lambda: oc.Given.from_function("g", 10**18, lambda q: q),
        lambda: oc.simulate(impedance(), steps(), [0, 0, 0], control_rate=1e18),
        lambda: oc.simulate(impedance(), steps(), [0, 0, 0], step=np.full(3, np.nan)),  # type: ignore[arg-type]
        lambda: loss(planar(), oc.Linear(), samples=10**18),
        lambda: oc.Box([10**400], 1.0),
        lambda: oc.check(planar(), samples=10**9),
        lambda: impedance().check_damping(samples=10**60),
    ]
    for call in calls:
        with pytest.raises(OrthocasError):
            call()


@pytest.mark.slow
def test_masked_entries_are_refused_in_every_argument(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy would hand over whatever lies below the mask. Whole masked arrays are arrays."""
    monkeypatch.chdir(tmp_path)
    slots, taken = 0, []
    for name, (function, arguments) in good_calls().items():
        for argument, good in arguments.items():
            try:
                array = np.array(good, dtype=float)
            except (TypeError, ValueError, RuntimeError):
                continue
            if array.ndim and array.size and f"{name}.{argument}" not in ELSEWHERE:
                slots += 1
                masked = np.ma.array(array, mask=np.arange(array.size).reshape(array.shape) == 0)
                try:
                    function(**{**arguments, argument: masked})
                except OrthocasError as error:
                    if "masked" in str(error):
                        continue
                taken.append(f"{name}.{argument}")
    assert slots > 100
    assert taken == []
    q = planar().domain.centre
    np.testing.assert_array_equal(fitted().chart.phi(np.ma.array(q)), fitted().chart.phi(q))
    for value in ([np.ma.array(q, mask=True), q], np.ma.masked):
        with pytest.raises(InvalidValueError, match="masked entries"):
            fitted().chart.phi(value)
    with pytest.raises(InvalidValueError, match="viscous is an array with masked entries"):
        simulation.Friction(np.ma.array(q, mask=True)).numbers(3)
