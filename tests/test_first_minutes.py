"""What a newcomer meets first: advice in errors and warnings, progress without a terminal, the demo."""

import numpy as np
import pytest
from programs import Run

import orthocas as oc
from orthocas.cli import demo
from orthocas.cli.output import lines_of_progress
from orthocas.errors import DomainError, InvalidValueError, LawWarning, NotRedundantError
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
    monkeypatch.setattr(demo, "made", lambda out, force: (fit, numbers))  # tests/test_examples.py makes it
    code, printed, _ = run("demo", "--out", "shown")
    assert code == 0
    assert "task angles    std 1.00 deg" in printed
    assert "xi reach       xi1 -" in printed
