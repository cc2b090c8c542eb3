"""What a newcomer meets first: advice in errors and warnings, progress without a terminal, the demo."""

from pathlib import Path

import numpy as np
import pytest
from conftest import robot_data
from programs import Run, python

import orthocas as oc
from orthocas.cli import compare as comparing
from orthocas.cli.output import lines_of_progress
from orthocas.control import PDPlus, Reference
from orthocas.errors import (
    DomainError,
    InvalidValueError,
    InverseError,
    LawWarning,
    NotRedundantError,
    UnknownNameError,
    UnreachableReferenceError,
)
from orthocas.fitting.fit import Fit
from orthocas.tasks.task import TASK_KINDS
from orthocas.tools.progress import Progress

HOME_DEG = [0.0, 30.0, 0.0, -60.0, 0.0, 45.0, 0.0]


def test_joint_positions_in_degrees_get_a_hint(iiwa: oc.Problem) -> None:
    for box in (oc.Box(HOME_DEG, 10.0), oc.Box(np.radians(HOME_DEG), 10.0)):
        with pytest.raises(DomainError, match=r"are these degrees\? Joint positions are in radians"):
            oc.Problem(iiwa.robot, iiwa.task, domain=box)
    with pytest.raises(DomainError, match="are these degrees"):
        oc.suggest_domain(iiwa.robot, iiwa.task, home=HOME_DEG)
    chart = oc.charts.load("panda-position")
    for call in (chart.xi_range, chart.self_motion, chart.tracker):
        with pytest.raises(InvalidValueError, match="are these degrees"):
            call(HOME_DEG)
    with pytest.raises(DomainError) as far:
        oc.Problem(iiwa.robot, iiwa.task, domain=oc.Box(np.radians(HOME_DEG), 3.0))
    assert "degrees" not in str(far.value)


def test_locked_angles_tools_and_targets_in_other_units_get_a_hint(iiwa: oc.Problem) -> None:
    panda = robot_data("panda_description/urdf/panda.urdf")
    with pytest.raises(InvalidValueError, match="locked position of joint 'panda_joint3' is 45, .*are these degrees"):
        oc.Robot.from_urdf(panda, locked={"panda_joint3": 45})
    for tool, hint in (([0, 0, 120], "millimetres"), ([0, 0, 0.12, 90, 0, 0], "degrees")):
        with pytest.raises(InvalidValueError, match=f"tool is .*are these {hint}"):
            iiwa.robot.with_tool(tool)
    assert iiwa.robot.with_tool([0, 0, 1.2, 3.1, 0, 0]).n == 7
    chart = oc.charts.load("panda-pose")
    q = chart.problem.domain.centre
    for part, factor, hint in ((slice(0, 3), 1000.0, "millimetres"), (slice(3, 6), 1.0, "degrees"), (0, 2.0, None)):
        phi = chart.phi(q)
        phi[part] = phi[part] * factor + (30.0 if hint == "degrees" else 0.0)
        with pytest.raises(InverseError) as caught:
            chart.inverse(phi, q)
        assert ("are these" in str(caught.value)) == (hint is not None)
        assert f"are these {hint}" in str(caught.value) or hint is None


def test_fits_in_place_of_charts_are_told_apart(planar_fit: Fit) -> None:
    calls = (oc.evaluate, oc.certify, oc.view, lambda fit: oc.generate_c(fit, "nowhere"), lambda fit: PDPlus(fit, 1.0))
    for call in calls:
        with pytest.raises(InvalidValueError, match="is a Fit, expected .*: use its attribute 'chart'$"):
            call(planar_fit)  # type: ignore[operator]


def test_builders_that_fail_on_their_words_are_named(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orthocas.tasks.task._REGISTERED", {})  # what is registered here stays here

    def deep(robot: oc.Robot, words: str) -> oc.Task:
        return oc.Task.position(robot, "xyz"[int(words)])

    oc.register_task("deep", deep)
    assert run("info", "iiwa")[0] == 0
    code, _, err = run("fit", "iiwa", "--task", "deep:z", "--samples", "50")
    assert (code, err.count("\n")) == (2, 1)
    assert "task 'deep:z' is failing (invalid literal" in err
    oc.register_task("none", lambda robot, words: None)  # type: ignore[arg-type,return-value]
    with pytest.raises(InvalidValueError, match="what the builder of task 'none' returns is None, expected a Task"):
        oc.Task.named(oc.problems.get("iiwa").robot, "none")
    with pytest.raises(UnknownNameError, match="unknown task 'depe', known: deep, position"):
        oc.Task.named(oc.problems.get("iiwa").robot, "depe")


@pytest.mark.slow
def test_help_of_fit_lists_every_task(tmp_path: Path) -> None:
    program = """import sys, orthocas as oc
oc.register_task("height", lambda robot, words: oc.Task.position(robot, "z"))
from orthocas.cli.entry import main
sys.argv = ["orthocas", "fit", "--help"]
main()"""
    shown = "".join(python(program, tmp_path).split())
    for kind in (*TASK_KINDS, "height"):
        assert f"{kind}," in shown or f"{kind};" in shown


@pytest.mark.slow
def test_targets_of_references_are_said_to_be_values(planar_chart: oc.Chart) -> None:
    """As changes, these would be small."""
    q = planar_chart.problem.domain.centre
    reference = Reference.steps(planar_chart.labels, planar_chart.phi(q), [(0.1, {"x": -5.0})], 1.0)
    with pytest.raises(UnreachableReferenceError, match="targets of a Reference are values of phi, not changes"):
        oc.simulate(PDPlus(planar_chart, 50.0), reference, q)


def test_a_task_without_freedom_names_redundant_ones(iiwa: oc.Problem) -> None:
    robot = oc.charts.load("ur5-position").problem.robot
    with pytest.raises(
        NotRedundantError, match=r"redundant tasks are, for example, position\+axis:z \(m = 5\), position"
    ):
        oc.Problem(robot, oc.Task.pose(robot))


def test_laws_that_are_hardly_meant_warn() -> None:
    chart = oc.charts.load("ur5-position")  # A = I
    with pytest.warns(LawWarning, match="decoupled law relies on A = M"):
        law = oc.control.PDPlus(chart, 50.0, coupling="decoupled")
    assert any("decoupled only for A = M" in remark for remark in law.remarks())
    with pytest.warns(LawWarning, match="damping_ratio = 70 is far above"):
        law = oc.control.Impedance(chart, 50.0, damping_ratio=70)
    assert any("damping_ratio = 70" in remark for remark in law.remarks())


def test_long_computations_print_a_line_now_and_then_also_within_a_step(capsys: pytest.CaptureFixture[str]) -> None:
    with lines_of_progress(10.0) as show:
        show(Progress("degree 4", 0.5, "loss 1"))
    assert capsys.readouterr() == ("", "")
    printed = ""
    with lines_of_progress(0.01) as show:
        show(Progress("degree 4", 0.5, "loss 1"))
        while printed.count("degree 4") < 3:  # one report, several lines
            printed += capsys.readouterr().err
    assert "note: 0 s, degree 4, 50%: loss 1\n" in printed


@pytest.mark.slow
def test_commands_print_how_far_coordinates_reach(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    fit = oc.fit(oc.problems.get("planar_3r_xy"), oc.Polynomial(1), samples=50)
    fit.chart.save("arm.orthocas")
    assert "\nxi reach      xi1 -" in run("evaluate", "arm.orthocas", "--samples", "100")[1]
    numbers = dict.fromkeys(
        ("task_std_deg", "mutual_std_deg", "conditioning_mean", "conditioning_min", "conditioning_p01", "seconds"), 1.0
    )
    monkeypatch.setattr(
        comparing, "fit_demo", lambda out, force: (fit, numbers)
    )  # tests/pages/test_examples.py makes it
    code, printed, _ = run("demo", "--out", "shown")
    assert code == 0
    assert "task angles    std 1.00 deg" in printed
    assert "xi reach       xi1 -" in printed
