"""Logged joint positions: read, refused by line, and drawn as Fig. 28."""

from pathlib import Path

import numpy as np
import pytest
from paper.joint_log import read_joint_log
from programs import Run

import orthocas as oc
from orthocas import problems
from orthocas.errors import PathFileError


@pytest.fixture(scope="module")
def chart() -> oc.Chart:
    return oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart


def test_log_is_read_by_the_names_of_its_columns(chart: oc.Chart, tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("q2,time_s,desired_xi1,q1,q3,d_q1\n0.8,0.0,0.1,0.6,0.7,9\n0.9,0.5,0.2,0.5,0.6,9\n")
    log = read_joint_log(file, chart)
    assert log.times.tolist() == [0.0, 0.5]
    assert log.q.tolist() == [[0.6, 0.8, 0.7], [0.5, 0.9, 0.6]]
    assert np.isnan(log.desired[:, :2]).all()
    assert log.desired[:, 2].tolist() == [0.1, 0.2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_s,q1,q2\n0,1,1\n1,1,1\n", r"line 1: column 'q3' is missing, expected time_s, q1, q2, q3"),
        ("time_s,q1,q2,q3,A7\n0,1,1,1,1\n1,1,1,1,1\n", r"line 1: unknown column 'A7', expected time_s, q1"),
        ("time_s,q1,q2,q3\n0,1,1,1\n0,1,1,1\n", r"time_s is 0 after 0, expected it to rise"),
        ("time_s,q1,q2,q3\n0,1,1,1\n1,1,nan,1\n", r"line 3: q2 is 'nan', expected a number"),
        ("time_s,q1,q2,q3\n0,1,1,1\n", r"it has 1 instants after the header, expected 2 to 1000000"),
        ("0,1,1,1\n0.1,1,1,1\n", r"it has 1 instants after its first line, which should name the columns"),
    ],
)
def test_broken_logs_name_file_and_line(text: str, message: str, chart: oc.Chart, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(PathFileError, match=rf"joint log .*log\.csv: {message}"):
        read_joint_log(tmp_path / "log.csv", chart)


@pytest.mark.slow
def test_what_follow_writes_is_drawn_as_a_log(chart: oc.Chart, run_paper: Run) -> None:
    """The chart's coordinates of the log are those that were held, and the tool comes back."""
    start = chart.x(chart.problem.domain.centre)
    angle = np.linspace(0, 2 * np.pi, 30)
    circle = start + 0.05 * np.column_stack([np.cos(angle) - 1, np.sin(angle)])
    oc.follow(chart, circle, velocity_limits=1.0).save_csv("joints.csv")
    chart.save("arm.orthocas")
    code, out, err = run_paper("fig28", "--log", "joints.csv", "--chart", "arm.orthocas", "--out", "new")
    # a slow machine notes every ten seconds how far it is
    assert (code, [line for line in err.splitlines() if not line.startswith("note: ")]) == (0, [])
    numbers = {line.split()[0]: float(line.split()[1]) for line in out.splitlines() if line.startswith("  ")}
    assert numbers["difference_of_end_and_start_xi1"] < 1e-9
    assert numbers["joint_difference_of_end_and_start_rad"] < 1e-8
    assert numbers["largest_joint_excursion_rad"] > 0.01
    assert numbers["share_outside_the_domain"] == 0
    assert {path.name for path in Path("new").glob("fig28*")} == {"fig28.png", "fig28.pdf", "fig28.json"}
