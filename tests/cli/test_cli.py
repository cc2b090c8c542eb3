"""The command line: outputs, exit codes, one-line errors, nothing half-written."""

import inspect
import json
import os
import pty
import re
import signal
import subprocess
import sys
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from conftest import robot_data
from programs import Run, nightly, output_of
from solid_arms import BALL, build_arm

import orthocas as oc
from orthocas import problems
from orthocas.cli.options import FORMER
from orthocas.fitting.fit import Fit
from orthocas.tools.files import LIST


@pytest.fixture
def saved(iiwa_fit: Fit, tmp_path: Path) -> str:
    path = tmp_path / "arm.orthocas"
    iiwa_fit.chart.save(path)
    return str(path)


@pytest.mark.slow
def test_fit_writes_a_chart_and_prints_its_quality(run: Run, tmp_path: Path) -> None:
    code, out, err = run("fit", "planar_3r_x", "--param", "polynomial:3", "--out", "a.orthocas")
    assert (code, err) == (0, "")
    assert "task angle" in out
    assert "conditioning" in out
    assert oc.load(tmp_path / "a.orthocas").r == 2


@pytest.mark.slow
def test_fit_json_is_one_object(run: Run) -> None:
    code, out, err = run("fit", "planar_3r_xy", "--param", "linear", "--json")
    data = json.loads(out)
    assert (code, err) == (0, "")
    assert data["chart"] == "planar_3r_xy.orthocas"
    assert data["parametrisation"] == "linear"
    assert data["task_angle_deg"]["std"] > 0


@pytest.mark.slow
def test_evaluate_json_has_the_promised_keys(run: Run, saved: str) -> None:
    code, out, err = run("evaluate", saved, "--samples", "500", "--json")
    data = json.loads(out)
    assert (code, err) == (0, "")
    assert {"n", "m", "r", "samples", "seed", "metric", "task_angle_deg", "mutual_angle_deg", "conditioning"} <= set(
        data
    )
    assert (data["n"], data["m"], data["r"], data["samples"], data["seed"]) == (7, 3, 4, 500, 1)
    assert set(data["task_angle_deg"]) == {"mean", "std", "max"}
    assert set(data["conditioning"]) == {"min", "p01", "mean"}
    want = oc.evaluate(oc.load(saved), 500, 1).as_dict()
    assert {name: value for name, value in data.items() if name in want} == json.loads(json.dumps(want))
    assert set(data) - set(want) == {"xi_range", "xi_stops"}


@pytest.mark.slow
def test_info_shows_charts_problems_and_robots(run: Run, saved: str) -> None:
    assert "polynomial:3" in run("info", saved)[1]
    chart, told = oc.load(saved), json.loads(run("info", saved, "--json")[1])
    reach = chart.xi_range(chart.problem.domain.centre)
    assert told["xi_range"]["xi1"] == [reach.low[0], reach.high[0]]
    assert told["xi_stops"]["xi1"][0] == str(reach["xi1"].low_stop)
    assert json.loads(run("info", "planar_2r", "--json")[1])["domain"] == "torus"
    path = str(robot_data("panda_description/urdf/panda.urdf"))
    code, out, _ = run("info", path, "--tip", "panda_hand", "--json")
    assert code == 0
    assert json.loads(out)["joints"][0] == "panda_joint1"


@pytest.mark.slow
def test_urdf_with_every_option(run: Run) -> None:
    path = str(robot_data("ur_description/urdf/ur5_robot.urdf"))
    words = ["--tip", "tool0", "--task", "orientation", "--metric", "inertia", "--param", "fourier:1"]
    words += [
        "--centre",
        "0,-1,1,0.1,0.5,0",
        "--half-width",
        "0.3",
        "--samples",
        "200",
        "--seed",
        "3",
        "--weights",
        "1000,10",
    ]
    code, out, err = run("fit", path, *words, "--solver", "lbfgs", "--json", "--out", "x.orthocas")
    data = json.loads(out)
    assert (code, err) == (0, "")
    assert (data["n"], data["m"], data["metric"], data["seed"]) == (6, 3, "inertia", 4)
    assert data["tips"] == ["tool0"]
    info = json.loads(run("info", "x.orthocas", "--json")[1])
    assert info["centre"] == [0, -1, 1, 0.1, 0.5, 0]
    assert info["notes"]["solver"] == "lbfgs"
    assert info["notes"]["lambda2"] == 10
    assert info["notes"]["lambda3"] == 0


@pytest.mark.slow
def test_urdf_with_locked_joint_tool_home_and_half_widths(run: Run) -> None:
    path = str(robot_data("panda_description/urdf/panda.urdf"))
    words = [
        "--tip",
        "panda_hand",
        "--lock",
        "panda_joint3=0.1",
        "--lock",
        "panda_joint1=0",
        "--tool",
        "0,0,0.1,0,0,0.5",
    ]
    words += ["--home", "default", "--half-width", "0.4,0.1,0.2,0.3,0.4", "--task", "axis:z", "--param", "linear"]
    code, _, err = run("fit", path, *words, "--out", "x.orthocas")
    assert (code, err) == (0, "")
    problem = oc.load("x.orthocas").problem
    assert problem.robot.joint_names == tuple(f"panda_joint{k}" for k in (2, 4, 5, 6, 7))
    np.testing.assert_allclose(problem.domain.centre, [-0.785398, -2.35619, 0, 1.5707, 0.785398])
    np.testing.assert_array_equal(problem.domain.half_width, [0.4, 0.1, 0.2, 0.3, 0.4])
    assert (problem.task.name, problem.task.m) == ("axis:z", 2)
    np.testing.assert_allclose(np.array(problem.task.function(problem.domain.centre)), 0, atol=1e-12)
    q = problem.domain.centre
    hand = oc.Robot.from_urdf(path, "panda_hand", {"panda_joint3": 0.1, "panda_joint1": 0.0})
    want = hand.tip_position(q) + 0.1 * hand.tip_rotation(q)[:, 2]
    np.testing.assert_allclose(problem.robot.tip_position(q), want, atol=1e-12)


def test_info_tells_limits_and_homes_of_a_robot_file(run: Run) -> None:
    path = str(robot_data("panda_description/urdf/panda.urdf"))
    code, out, _ = run("info", path, "--tip", "panda_rightfinger", "--lock", "panda_finger_joint1=0.02", "--json")
    data = json.loads(out)
    assert code == 0
    assert (len(data["joints"]), data["homes"], data["effort_limits"][6]) == (7, ["default"], 12)


@pytest.mark.slow
def test_urdf_of_a_stretched_arm_fits_about_a_bent_posture(run: Run) -> None:
    """A command of the README: about the middle of the limits 9 % of the samples fold."""
    path = str(Path(problems.__file__).parent / "data" / "iiwa7_r800.urdf")
    words = [
        "--tip",
        "link_ee",
        "--task",
        "pose",
        "--metric",
        "inertia",
        "--param",
        "polynomial:2",
        "--out",
        "p.orthocas",
    ]
    code, out, err = run("fit", path, *words)
    assert (code, err) == (0, "")
    assert "DEGENERATE" not in out
    assert "folded" not in out


@pytest.mark.slow
def test_named_problem_with_overrides(run: Run) -> None:
    code, out, _ = run("fit", "iiwa", "--param", "linear", "--metric", "inertia", "--task", "position:xy", "--json")
    assert code == 0
    assert (json.loads(out)["m"], json.loads(out)["metric"]) == (2, "inertia")
    code, out, _ = run("fit", "planar_3r_x", "--param", "linear", "--centre", "0.5,0.5,0.5", "--half-width", "0.1")
    assert code == 0


PANDA = str(robot_data("panda_description/urdf/panda.urdf"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["fit", "spot"],
            "unknown problem or robot 'spot', known: ",
        ),
        (["fit", "nowhere.urdf"], "cannot read URDF file nowhere.urdf: No such file or directory"),
        (["fit", PANDA, "--tip", "hand"], "unknown frame 'hand'"),
        (["fit", PANDA, "--tip", "panda_hand", "--task", "grasp"], "unknown task 'grasp', known: position"),
        (["fit", PANDA, "--tip", "panda_hand", "--metric", "mass"], "unknown metric 'mass', known: euclidean, inertia"),
        (["fit", PANDA, "--tip", "panda_hand", "--half-width", "9"], "inside its limits"),
        (
            ["fit", PANDA, "--tip", "panda_hand", "--half-width", "-1"],
            "half_width is -1, expected numbers above 1e-09, up to 1e+06",
        ),
        (["fit", PANDA, "--tip", "panda_hand", "--centre", "0,a"], "--centre is"),
        (["fit", PANDA, "--tip", "panda_hand", "--centre", "0,1"], "centre has shape (2,), expected (7,)"),
        (["fit", "iiwa", "--tip", "link_3"], "has its own robot: leave out --tip"),
        (["fit", "planar_2r", "--task", "position:xy"], "m = 2 components and the robot n = 2 joints"),
        (["fit", "planar_3r_x", "--task", "position:z"], "'z' does not depend on any joint"),
        (["fit", "iiwa", "--param", "spline"], "unknown parametrisation 'spline', known: linear, polynomial"),
        (["fit", "iiwa", "--param", "polynomial:0"], "degree is 0, expected a whole number >= 1"),
        (["fit", "iiwa", "--param", "polynomial:25"], "GiB"),
        (["fit", "iiwa", "--solver", "sgd"], "unknown solver 'sgd', known: gauss_newton, quasi_newton"),
        (["fit", "iiwa", "--param", "mlp:100000x100000"], "GiB"),
        (["fit", "iiwa", "--half-width", "1e300"], "half_width is 1e+300"),
        (["fit", "iiwa", "--metric", ""], "unknown metric ''"),
        (["fit", "iiwa", "--out", "x" * 300], "File name too long"),
        (["fit", "x\n" * 300], "unknown problem or robot 'x"),
        (["info", PANDA, "--tip", "panda"], "panda_hand"),
        (["fit", "iiwa", "--samples", "0"], "samples is 0"),
        (["fit", "iiwa", "--samples", "many"], "received 'many', expected a whole number"),
        (["fit", "iiwa", "--half-width", "wide"], "--half-width is ['wide'], expected an array of numbers"),
        (["fit", "iiwa", "--half-width", "0.4,0.1"], "half_width has shape (2,), expected (7,)"),
        (["fit", "iiwa", "--lock", "joint_3=0"], "the named problem 'iiwa' has its own robot: leave out --lock"),
        (["info", "planar_2r", "--tip", "tip"], "has its own robot: leave out --tip"),
        (
            ["info", PANDA, "--gravity", "0,0,0"],
            "no such option: --gravity; the gravity of a robot is an option of fit",
        ),
        (["fit", "iiwa", "--home", "up"], "unknown home 'up', known: none, the robot's files name no posture"),
        (["fit", PANDA, "--tip", "panda_hand", "--home", "ready"], "unknown home 'ready', known: default"),
        (
            ["fit", PANDA, "--tip", "panda_hand", "--home", "default", "--centre", "0,0"],
            "--home and --centre both give the centre",
        ),
        (
            ["fit", PANDA, "--tip", "panda_hand", "--lock", "panda_joint3"],
            "--lock is panda_joint3, expected JOINT=VALUE",
        ),
        (["fit", PANDA, "--tip", "panda_hand", "--lock", "panda_joint3=x"], "--lock panda_joint3 is ['x']"),
        (
            ["fit", PANDA, "--tip", "panda_hand", "--lock", "panda_joint=0"],
            "unknown joint 'panda_joint', known: panda_joint",
        ),
        (
            ["fit", PANDA, "--tip", "panda_hand", "--tool", "0,1"],
            "shape of tool is (2,), expected (3,), (6,) or (4, 4)",
        ),
        (["fit", "iiwa", "--precision", "single"], "no such option: --precision; the precision is set in Python"),
        (["fit", "iiwa", "--seed", "-1"], "seed is -1, expected a whole number >= 0"),
        (["fit", "iiwa", "--weights", "1000,nan"], "lambda2 is nan"),
        (["fit", "iiwa", "--weights", "1000"], "two to five numbers"),
        (["fit", "iiwa", "--weights", "0,1"], "lambda1 is 0.0"),
        (["fit", "iiwa", "--weights", "calm=3"], "unknown loss term 'calm'"),
        (["fit", "iiwa", "--weights", "1000,30,calm=much"], "--weights calm is ['much']"),
        (["fit", "iiwa", "--out", "no/such/folder/x.orthocas"], "folder no/such/folder does not exist"),
        (["fit", "iiwa", "--out", "/proc/x.orthocas"], "cannot write /proc/x.orthocas"),
        (["fit"], "Missing argument"),
        (["fit", "iiwa", "--colour"], "No such option"),
        (["fly"], "No such command"),
        (["evaluate", "nothing.orthocas"], "chart file nothing.orthocas does not exist"),
        (["evaluate", PANDA], "expected a chart file"),
        (["info", "nothing"], "unknown problem or robot 'nothing', known: "),
        (["info", "nothing.orthocas"], "does not exist"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_two(run: Run, tmp_path: Path, words: list[str], message: str) -> None:
    code, out, err = run(*words)
    assert code == 2
    assert message in err
    assert err.count("\n") == 1
    assert out == ""
    assert list(tmp_path.iterdir()) == []


def test_version_is_that_of_the_package(run: Run) -> None:
    assert run("--version") == (0, f"orthocas {oc.__version__}\n", "")


def test_no_words_show_help(run: Run) -> None:
    code, out, err = run()
    assert (code, out) == (2, "")
    assert err.startswith("Usage: ")
    assert "orthocas" in err.partition("\n")[0]
    assert "\n  --help" in err


@pytest.mark.slow
def test_help_names_the_commands() -> None:
    shown = output_of(sys.executable, "-m", "orthocas", "--help", folder=Path("/"))
    for command in ("fit", "evaluate", "info"):
        assert command in shown


def test_output_folder_is_checked_before_the_long_work(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*args: object) -> None:
        raise AssertionError("the fit was started")

    monkeypatch.setattr("orthocas.cli.fit.fit_chart", never)  # commands are imported when they run
    code, _, err = run("fit", "iiwa", "--out", "no/x.orthocas")
    assert code == 2
    assert "folder no does not exist" in err


def _read_terminal(descriptor: int) -> bytes:
    """What the other side wrote; nothing once it is closed."""
    try:
        return os.read(descriptor, 4096)
    except OSError:
        return b""


@pytest.mark.slow
def test_ctrl_c_saves_the_best_chart_so_far(tmp_path: Path) -> None:
    """The signal is sent when the progress bar, on a pseudo-terminal, shows the third degree of six."""
    command = [sys.executable, "-m", "orthocas", "fit", "iiwa", "--param", "polynomial:6", "--out", "c.orthocas"]
    ours, theirs = pty.openpty()
    process = subprocess.Popen(command, cwd=tmp_path, stderr=theirs, stdout=subprocess.DEVNULL)
    os.close(theirs)
    seen, stop_sent = b"", False
    while chunk := _read_terminal(ours):
        seen += chunk
        if b"polynomial:4" in seen and not stop_sent:
            os.kill(process.pid, signal.SIGINT)
            stop_sent = True
    process.wait(timeout=60)
    err = seen.decode(errors="replace")
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "best coordinates found so far" in err
    chart = oc.load(tmp_path / "c.orthocas")
    assert chart.notes["status"] == "interrupted"


@pytest.mark.slow
def test_compare_writes_tables_pictures_and_charts(run: Run, tmp_path: Path) -> None:
    words = ("compare", "planar_3r_x", "--samples", "100", "--param", "linear")
    code, out, err = run(
        *words, "--param", "mlp:3", "--solver", "gauss_newton", "--solver", "lbfgs", "--jobs", "1", "--out", "grid"
    )
    assert code == 0
    assert "linear" in out
    assert "failed: InvalidValueError" in out
    assert err == "note: 1 of 3 fits failed, see comparison.csv\n"
    names = {path.name for path in (tmp_path / "grid").iterdir()}
    assert names == {LIST, "charts", "comparison.csv", "comparison.json", "front.png", "convergence.png"}
    assert oc.load(tmp_path / "grid" / "charts" / "mlp-3_lbfgs_0.orthocas").r == 2
    chart = "grid/charts/mlp-3_lbfgs_0.orthocas"  # the problem of a chart is compared on too
    code, out, err = run(words[0], chart, *words[2:], "--jobs", "1", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["summaries"][0]["solver"] == "closed form"


@pytest.mark.slow
def test_wide_fits_leave_postures_in_self_collision_aside(run: Run, tmp_path: Path) -> None:
    """A planar arm whose last links fold back: regular on the free part, which the facts name."""
    build_arm(tmp_path, [BALL, '<box size="0.6 0.2 0.1"/>', '<box size="0.6 0.2 0.1"/>', BALL])
    words = ("fit", "arm.urdf", "--task", "position:xy", "--domain", "branch", "--param", "polynomial:3")
    code, _, err = run(*words, "--samples", "800", "--collisions", "arm.urdf", "--out", "free.orthocas")
    assert code == 0, err
    notes = oc.load(tmp_path / "free.orthocas").notes
    assert any("found in 10,000 postures" in str(value) for value in notes.values())
    assert run("fit", "arm.urdf", "--collisions", "arm.urdf")[::2] == (
        2,
        "orthocas: --collisions requires --domain branch\n",
    )


@pytest.mark.slow
def test_compare_shows_the_front_of_wide_fits(run: Run, tmp_path: Path) -> None:
    fits = (
        "--domain",
        "branch",
        "--param",
        "polynomial:3",
        "--samples",
        "1000",
        "--weights",
        "4,0",
        "--weights",
        "400,0",
    )
    code, out, err = run("compare", "planar_3r_xy", *fits, "--jobs", "1", "--out", "front")
    assert (code, err) == (0, "")
    assert re.search(r"parametrisation +solver +weights .* regular share", out)
    assert re.search(r"polynomial:3 +wide +400,0 .* [0-9.]+%", out)
    data = json.loads((tmp_path / "front" / "comparison.json").read_text())["fits"]
    assert data[1]["leak_rms_deg"] < data[0]["leak_rms_deg"] - 5.0
    chart = oc.load(tmp_path / "front" / "charts" / "polynomial-3_wide_0_400-0.orthocas")
    assert chart.notes["share of the branch"] == data[1]["regular_share"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("compare", "iiwa", "--param", "spline:2"), "unknown parametrisation 'spline'"),
        (("compare", "iiwa", "--solver", "sgd"), "unknown solver 'sgd'"),
        (("compare", "iiwa", "--seeds", "0"), "seeds is 0"),
        (("compare", "iiwa", "--domain", "auto"), "--domain is 'auto', expected branch or branch:NAME"),
        (("compare", "iiwa", "--weights", "1000"), "two to five numbers"),
        (("compare", "iiwa", "--out", "file"), "--out is file, expected a folder"),
    ],
)
def test_bad_grids_are_refused_before_any_work(run: Run, tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    (tmp_path / "file").write_text("in the way")
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    assert message in err


@pytest.mark.slow
@pytest.mark.parametrize(("words", "code"), [("--version", 0), ("info nothing", 2), *nightly(("info planar_2r", 0))])
def test_closed_standard_streams_lead_nowhere(words: str, code: int, tmp_path: Path) -> None:
    """Also all of them: a file that is opened next must not become standard output."""
    for streams in (">&-", "<&- >&-", "<&- >&- 2>&-"):
        command = ["sh", "-c", f'exec "$0" -m orthocas {words} {streams}', sys.executable]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
        assert done.returncode == code, done.stderr
        assert done.stdout == ""
        assert len(done.stderr.splitlines()) == (1 if code and "2>" not in streams else 0), done.stderr


@pytest.mark.slow
def test_what_libraries_print_to_a_closed_standard_output_goes_into_no_file(tmp_path: Path) -> None:
    """The first file that is opened would get the number of standard output."""
    code = """
import os, sys
from orthocas.cli.entry import open_closed_streams
open_closed_streams()
with open("file", "w") as stream:
    stream.write("mine")
    stream.flush()
    os.write(1, b"printed by a library")
    print("printed")
"""
    command = ["sh", "-c", 'exec "$0" -c "$1" >&-', sys.executable, code]
    subprocess.run(command, check=True, cwd=tmp_path)
    assert (tmp_path / "file").read_text() == "mine"


CALLS = [call for hint in FORMER.values() for call in re.findall(r"\boc\.([\w.]+)\(([^)]*)\)", hint)]


@pytest.mark.parametrize(("name", "arguments"), CALLS)
def test_what_says_the_same_in_python_exists(name: str, arguments: str) -> None:
    """The keywords of the calls that hints for former options name."""
    words = re.findall(r"(\w+)=", arguments)
    assert words
    assert set(words) <= set(inspect.signature(attrgetter(name)(oc)).parameters)
