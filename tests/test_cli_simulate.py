"""`orthocas simulate`: files, numbers, refusals, interrupts; nothing written on bad input."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from charts import with_metric
from matplotlib.figure import Figure
from PIL import Image
from programs import Run, needs_c
from scipy.linalg import eigvalsh

import orthocas as oc
from orthocas.cli import simulate as command
from orthocas.cli.controller_argument import ControllerOptions, build_controller
from orthocas.control import ControlStatus, matched_posture_stiffness, matched_stiffness
from orthocas.domains import sample_uniform
from orthocas.files.atomic import published
from orthocas.files.ours import LIST
from orthocas.fitting.fit import Fit
from orthocas.minimising.watch import Monitor, Progress
from orthocas.simulation import Trajectory

EXAMPLES = Path(__file__).parent.parent / "examples"
SHORT = {"duration": 1, "steps": [{"time": 0.1, "move": {"x": 0.1}}, {"time": 0.6, "to": {"xi1": 0.05}}]}
FILES = {"trajectory.npz", "coordinates.png", "report.json"}


@pytest.fixture
def chart(planar_fit: Fit) -> oc.Chart:
    return planar_fit.chart


@pytest.fixture
def run(run: Run, chart: oc.Chart) -> Run:
    """Simulate in a folder with a.orthocas and short.json."""
    chart.save("a.orthocas")
    Path("short.json").write_text(json.dumps(SHORT))

    def call(
        controller: str, *words: str, steps: str = "short.json", chart: str = "a.orthocas"
    ) -> tuple[int, str, str]:
        return run("simulate", chart, "--controller", controller, "--steps", steps, "--out", "out", *words)

    return call


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    """Empty pictures, for tests of numbers: drawing takes longer than the runs."""
    monkeypatch.setattr(command, "trajectory_figure", lambda run, units: Figure())


def written() -> set[str]:
    """What is in the folder, apart from the list of it."""
    return {path.name for path in Path("out").iterdir()} - {LIST}


def report_of(run: Run, *words: str, **more: str) -> dict[str, Any]:
    code, out, err = run(*words, "--animation", "none", "--json", **more)
    assert (code, err) == (0, "")
    report: dict[str, Any] = json.loads(out)
    return report


@pytest.mark.slow
def test_example_of_the_docs_end_to_end(run: Run, chart: oc.Chart) -> None:
    code, out, err = run("pd_plus", "--json", steps=str(EXAMPLES / "steps_planar_3r_x.json"))
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert json.loads(Path("out/report.json").read_text()) == report
    assert written() == FILES | {"animation.gif"}
    assert (report["controller"], report["outcome"], report["duration"]) == ("pd_plus", "complete", 10)
    assert set(report["tracking_error"]) == {"x", "xi1", "xi2"}
    assert max(report["tracking_error"].values()) < 1e-6  # CVODES at 1e-8; the full M_phi tracks exactly
    assert set(report["coupling_index"]) == {"x", "xi1"}  # only these are commanded
    assert report["coupling_index"]["xi1"]["x"] < 1e-6
    assert report["fallback"] == {"share": 0, "since": None, "reason": None}
    assert report["share_inside_domain"] == 1
    assert report["energy"]["storage_largest"] < 1e-9
    trajectory = Trajectory.load("out/trajectory.npz")
    assert trajectory.times[-1] == 10
    np.testing.assert_allclose(trajectory.q[0], chart.problem.domain.centre)
    largest = np.abs(trajectory.command).max(axis=0)
    assert report["largest_command"] == dict(zip(["q1", "q2", "q3"], largest.tolist(), strict=True))
    with Image.open("out/coordinates.png") as picture:
        assert min(picture.size) > 500
    with Image.open("out/animation.gif") as film:
        assert film.n_frames > 150  # type: ignore[attr-defined]
    assert Path("out/animation.gif").stat().st_size < 3e6


@pytest.mark.slow
def test_rows_name_units_angles_and_the_folder(run: Run, chart: oc.Chart) -> None:
    code, out, err = run("impedance", "--animation", "none")
    assert (code, err) == (0, "")
    rows = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert rows["run"] == "impedance, 1 s: complete"
    assert " m, xi1 " in rows["largest"]
    assert "task <- extra" in rows["coupling"]
    assert rows["command"].endswith("N m, q1")
    leak = oc.evaluate(chart, points=Trajectory.load("out/trajectory.npz").q).leak
    assert rows["angles"].startswith(f"on path  leak rms {leak.rms:.2f}, largest {leak.max:.1f} deg (in the metric)")
    assert "J dissipated" in rows["energy"]
    assert rows["files"] == "out"


@pytest.mark.usefixtures("blank")
@pytest.mark.parametrize("name", ["kinematic", "projector", "kinematic_projector"])
def test_other_controllers_follow_the_same_file_and_are_judged_in_the_chart(run: Run, name: str) -> None:
    report = report_of(run, name)
    assert set(report["tracking_error"]) == {"x", "xi1", "xi2"}
    assert report["tracking_error"]["x"] < (0.05 if name == "projector" else 1e-3)
    assert (report["energy"] is None) == (name != "projector")
    trajectory = Trajectory.load("out/trajectory.npz")
    assert trajectory.labels == (("x", "xi1", "xi2") if name == "kinematic" else ("x", "q1", "q2", "q3"))
    assert trajectory.kind == ("torque" if name == "projector" else "velocity")


@pytest.mark.usefixtures("blank")
@pytest.mark.parametrize("name", ["projector", "kinematic_projector"])
def test_projectors_move_extra_coordinates_on_request(run: Run, chart: oc.Chart, name: str) -> None:
    """They follow the reference of the chart itself, with the stiffness of the chart's springs."""
    report = report_of(run, name, "--second", "xi")
    assert report["second"] == "xi"
    assert report["tracking_error"]["x"] < (0.05 if name == "projector" else 1e-6)
    assert Trajectory.load("out/trajectory.npz").labels == ("x", "xi1", "xi2")


def test_gains_of_projectors_of_extra_coordinates(chart: oc.Chart) -> None:
    options = ControllerOptions(second="xi")
    law = build_controller("projector", chart, options, None)
    direct = build_controller("impedance", chart, ControllerOptions(), None)
    np.testing.assert_array_equal(law.gains["stiffness"], direct.gains["stiffness"])
    options = ControllerOptions(second="xi", feedback="1,2,3")
    assert build_controller("kinematic_projector", chart, options, None).gains["feedback"].tolist() == [1, 2, 3]


def test_springs_that_are_not_given_are_matched(chart: oc.Chart) -> None:
    """In the chart's coordinates and in the joints, no mode is much faster than 18 Hz."""
    points = sample_uniform(chart.problem.domain, 256, 0)
    J, M = chart.jacobian(points), np.array([chart.problem.robot.mass_matrix(q) for q in points])
    half = np.linalg.inv(J)
    stiffness = build_controller("pd_plus", chart, ControllerOptions(), None).gains["stiffness"]
    projector = build_controller("projector", chart, ControllerOptions(), None).gains["stiffness"]
    np.testing.assert_array_equal(stiffness, matched_stiffness(chart))
    np.testing.assert_array_equal(projector[1:], matched_posture_stiffness(chart.problem))
    for K, inertias in ((stiffness, half.transpose(0, 2, 1) @ M @ half), (projector[1:], M)):
        frequencies = np.sqrt([eigvalsh(np.diag(K), inertia) for inertia in inertias]) / (2 * np.pi)
        assert 15 < frequencies.max() < 21
    assert projector[0] == stiffness[0]


@pytest.mark.usefixtures("blank")
def test_gains_and_limits_are_those_given(run: Run, chart: oc.Chart) -> None:
    words = ("--stiffness", "100,2000,3000", "--damping-ratio", "0.9", "--limit", "400", "--coupling", "decoupled")
    report = report_of(run, "impedance", *words)
    assert report["gains"] == {"stiffness": [100, 2000, 3000], "damping_ratio": [0.9] * 3, "limit": [400] * 3}
    assert report["coupling"] == "decoupled"
    options = ControllerOptions(stiffness="300", posture_stiffness="30,20,10")
    projector = build_controller("projector", chart, options, "50,60,70").gains
    assert projector["stiffness"].tolist() == [300, 30, 20, 10]
    assert projector["limit"].tolist() == [50, 60, 70]
    each, all_of_them = ControllerOptions(feedback="1,2,3,4"), ControllerOptions(feedback="5")
    assert build_controller("kinematic_projector", chart, each, None).gains["feedback"].tolist() == [1, 2, 3, 4]
    assert build_controller("kinematic", chart, all_of_them, None).gains["feedback"].tolist() == [5, 5, 5]


@pytest.mark.slow
@pytest.mark.usefixtures("blank")
def test_a_wrong_model_friction_and_noise_cost_accuracy(run: Run) -> None:
    exact = report_of(run, "pd_plus")["tracking_error"]["x"]
    for words in (("--mass-factor", "1.1"), ("--friction", "0.5,0.2")):
        assert report_of(run, "pd_plus", *words)["tracking_error"]["x"] > 1e3 * exact
    sampled = ("--rate", "100", "--noise", "1e-4,1e-3")
    first, other = (report_of(run, "pd_plus", *sampled, *seed)["tracking_error"]["x"] for seed in ((), ("--seed", "1")))
    assert first != other
    assert first > 1e3 * exact


@needs_c
@pytest.mark.slow
@pytest.mark.usefixtures("blank")
def test_compiled_runs_are_the_same(run: Run) -> None:
    plain, compiled = (report_of(run, "pd_plus", "--mass-factor", "1.1", *words) for words in ((), ("--compiled",)))
    for name in ("tracking_error", "largest_command"):
        assert compiled[name] == pytest.approx(plain[name], rel=1e-4)


@pytest.mark.usefixtures("blank")
def test_points_and_pushes(run: Run) -> None:
    points = {"points": [{"time": 1, "move": {"x": 0.1}}, {"time": 2, "move": {"xi1": 0.05}}]}
    Path("points.json").write_text(json.dumps(points))
    report = report_of(run, "pd_plus", steps="points.json")
    assert (report["duration"], report["coupling_index"]) == (2, None)
    assert report["tracking_error"]["x"] < 1e-6
    pushed = {**points, "pushes": [{"start": 0.5, "duration": 0.1, "force": [40, 0, 0]}]}
    Path("points.json").write_text(json.dumps(pushed))
    assert report_of(run, "pd_plus", steps="points.json")["tracking_error"]["x"] > 1e-2
    code, _, err = run("kinematic", steps="points.json")
    assert code == 2
    assert "forces do not affect a velocity controller" in err


@pytest.mark.slow
@pytest.mark.usefixtures("blank")
def test_mujoco_is_another_plant(run: Run) -> None:
    """The same run, up to the tolerance of CVODES, which adds up over 600 ticks; a push at a link reaches both."""
    pytest.importorskip("mujoco", reason="the extra orthocas[sim] is not installed")
    push = {"start": 0.1, "duration": 0.1, "force": [20, 0, 0], "link": "q2", "point": [0.5, 0, 0]}
    points = {"points": [{"time": 0.5, "move": {"x": 0.02}}], "pushes": [push]}
    Path("pushed.json").write_text(json.dumps(points))
    words = ("--rate", "1000", "--mass-factor", "1.1", "--friction", "0.5,0")
    cvodes, ours = (
        report_of(run, "pd_plus", *words, *more, steps="pushed.json") for more in ((), ("--plant", "mujoco"))
    )
    assert ours["tracking_error"]["x"] == pytest.approx(cvodes["tracking_error"]["x"], abs=1e-6)
    Path("pushed.json").write_text(json.dumps(points | {"pushes": []}))
    still = report_of(run, "pd_plus", *words, steps="pushed.json")["tracking_error"]["x"]
    assert ours["tracking_error"]["x"] > still + 1e-4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pid",), "unknown controller 'pid', known: impedance, pd_plus, kinematic, projector, kinematic_projector"),
        (
            ("kinematic", "--stiffness", "1"),
            "expected no --stiffness with kinematic, because it belongs to",
        ),
        (("pd_plus", "--feedback", "1"), "it belongs to kinematic, kinematic_projector"),
        (("pd_plus", "--posture-stiffness", "1"), "it belongs to projector"),
        (("projector", "--second", "xi2"), "unknown second task 'xi2', known: joints, xi"),
        (("impedance", "--second", "xi"), "it belongs to projector, kinematic_projector"),
        (("projector", "--coupling", "coupled"), "it belongs to impedance, pd_plus"),
        (("kinematic", "--mass-factor", "1.1"), "--mass-factor is 1.1, expected no --mass-factor with kinematic"),
        (("kinematic", "--friction", "1,1"), "it belongs to impedance, pd_plus, projector"),
        (("pd_plus", "--coupling", "both"), "unknown coupling 'both', known: coupled, decoupled"),
        (("pd_plus", "--stiffness", "1,2"), "stiffness has shape (2,), expected (3,)"),
        (("pd_plus", "--stiffness", "-1"), "stiffness[0] is -1.0, expected positive numbers"),
        (("pd_plus", "--stiffness", "soft"), "--stiffness is ['soft'], expected an array of numbers"),
        (("pd_plus", "--limit", "0"), "limit[0] is 0.0, expected positive numbers"),
        (("kinematic_projector", "--feedback", "1,2"), "feedback (task, then joints) has shape (2,), expected (4,)"),
        (("pd_plus", "--rate", "0"), "control_rate is 0.0, expected a finite number > 0"),
        (("pd_plus", "--noise", "1,1"), "--noise is 1,1, expected no noise without --rate"),
        (("pd_plus", "--noise", "1", "--rate", "100"), "--noise is '1', expected two numbers"),
        (("kinematic", "--noise", "1,1", "--rate", "100"), "kinematic measures no velocity"),
        (("pd_plus", "--seed", "1"), "--seed is 1, expected no seed without --noise"),
        (("pd_plus", "--friction", "-1,0"), "viscous[0] is -1.0"),
        (("pd_plus", "--plant", "bullet"), "unknown plant 'bullet', known: cvodes, mujoco"),
        (("pd_plus", "--plant", "mujoco"), "--plant is mujoco, expected --rate as well, because MuJoCo"),
        (("kinematic", "--plant", "mujoco", "--rate", "100"), "expected no MuJoCo with a velocity controller"),
        (
            ("pd_plus", "--compiled", "--plant", "mujoco", "--rate", "100"),
            "compiled is True, expected False with MuJoCo",
        ),
        (("pd_plus", "--mass-factor", "0"), "factor is 0.0, expected numbers > 0"),
        (("pd_plus", "--animation", "webp"), "unknown animation format 'webp', known: gif, mp4"),
        (("pd_plus", "--out", "no/out"), "folder no does not exist"),
        (("pd_plus", "--out", "short.json"), "--out is short.json, expected a folder"),
        (("pd_plus", "--steps", "none.json"), "steps file none.json: cannot be read"),
        (("pd_plus", "--steps", "a.orthocas"), "steps file a.orthocas: "),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(run: Run, words: tuple[str, ...], message: str) -> None:
    before = set(Path().iterdir())
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert set(Path().iterdir()) == before


def test_mp4_without_ffmpeg_is_refused_before_the_run(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    code, out, err = run("pd_plus", "--animation", "mp4")
    assert (code, out) == (2, "")
    assert "animation is mp4, expected gif, because mp4 needs ffmpeg, which is not on the PATH" in err
    assert not Path("out").exists()


@pytest.mark.parametrize("name", ["pd_plus", "kinematic_projector"])
def test_a_reference_that_leaves_the_domain_is_reported_before_the_run(run: Run, name: str) -> None:
    Path("far.json").write_text(json.dumps({"duration": 2, "steps": [{"time": 1, "move": {"x": 0.6}}]}))
    code, out, err = run(name, steps="far.json")
    assert (code, out) == (2, "")
    assert "the reference leaves the domain at t = 1." in err
    assert not Path("out").exists()


@pytest.mark.parametrize("name", ["pd_plus", "kinematic_projector"])
def test_grown_charts_are_refused(run: Run, name: str, planar_x: oc.Problem) -> None:
    oc.grow(planar_x, leaf="linear").save("grown.orthocas")
    code, out, err = run(name, chart="grown.orthocas")
    assert (code, out) == (2, "")
    assert "orthocas.distil" in err
    assert err.count("\n") == 1


def interrupting(stage: str) -> Callable[[], Any]:
    """A stand-in for the terminal's monitor that sends Ctrl-C in the middle of a stage."""

    @contextmanager
    def monitor() -> Iterator[Monitor]:
        def show(progress: Progress) -> None:
            if progress.stage.startswith(stage) and progress.fraction > 0.5:
                os.kill(os.getpid(), signal.SIGINT)

        yield show

    return monitor


@pytest.mark.usefixtures("blank")
def test_ctrl_c_in_the_run_keeps_what_was_simulated(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("out").mkdir()
    with published(Path("out"), listed=True) as drafts:
        (drafts / "animation.gif").write_text("of an earlier run")
    monkeypatch.setattr(command, "terminal_monitor", interrupting("simulate"))
    code, out, err = run("pd_plus", "--json")
    assert code == 130
    assert "interrupted: the run so far is saved, without an animation" in err
    assert written() == FILES
    report = json.loads(out)
    assert report["outcome"] == "interrupted"
    assert 0.5 <= report["duration"] < 0.8
    assert report["coupling_index"] is None
    assert Trajectory.load("out/trajectory.npz").times[-1] == report["duration"]


@pytest.mark.usefixtures("blank")
def test_files_of_others_stay_unless_forced(run: Run) -> None:
    Path("out").mkdir()
    Path("out/animation.gif").write_text("my holidays")
    for words in (("pd_plus",), ("pd_plus", "--force", "--animation", "none")):  # without one it is in nobody's way
        code, _, err = run(*words)
        assert (code, err.count("\n")) == ((0, 0) if "--force" in words else (2, 1)), err
        assert Path("out/animation.gif").read_text() == "my holidays"
    assert run("pd_plus", "--force")[0] == 0
    assert Path("out/animation.gif").read_bytes().startswith(b"GIF")
    Path("out/report.json").write_text("edited")
    code, _, err = run("pd_plus")
    assert (code, Path("out/report.json").read_text()) == (2, "edited")
    assert "cannot write out/report.json: orthocas did not write the file" in err


@pytest.mark.usefixtures("blank")
def test_ctrl_c_in_the_animation_leaves_no_half_of_it(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "terminal_monitor", interrupting("draw"))
    code, out, err = run("pd_plus")
    assert code == 130
    assert "1 s: complete" in out
    assert "without an animation" in err
    assert written() == FILES


@pytest.mark.usefixtures("blank")
def test_ctrl_c_while_files_are_written_loses_nothing(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    save, signals = Trajectory.save, [signal.SIGINT]

    def interrupted(self: Trajectory, path: Path) -> None:
        save(self, path)
        if signals:
            os.kill(os.getpid(), signals.pop())

    monkeypatch.setattr(Trajectory, "save", interrupted)
    code, out, err = run("pd_plus")
    assert code == 130
    assert "1 s: complete" in out
    assert "without an animation" in err
    assert written() == FILES


@pytest.mark.usefixtures("blank")
def test_a_run_that_diverges_is_written_and_said(run: Run) -> None:
    code, out, err = run("impedance", "--stiffness", "1e14", "--animation", "none")
    assert code == 1
    assert "diverged" in out
    assert "the integrator gave up at t = 0.1 s, the run so far is saved" in err
    assert written() == FILES


@pytest.mark.usefixtures("blank")
def test_a_fallback_is_said_with_time_and_reason(run: Run) -> None:
    code, out, err = run("pd_plus", "--limit", "40", "--animation", "none")
    assert code == 0
    assert "coupling" not in out  # coordinates mean nothing outside the domain
    report = json.loads(Path("out/report.json").read_text())
    fallback, trajectory = report["fallback"], Trajectory.load("out/trajectory.npz")
    first = int(np.argmax(trajectory.fell_back))
    assert fallback["since"] == trajectory.times[first] > 0
    assert fallback["share"] == np.mean(trajectory.fell_back)
    assert report["saturated_share"] == np.mean(trajectory.status == ControlStatus.SATURATED) > 0
    assert "limit " in out
    assert (
        f"at t = {fallback['since']:.4g} s the arm left the domain: the controller commanded only the gravity torque"
        in err
    )
    assert (report["energy"], report["coupling_index"]) == (None, None)


@pytest.mark.usefixtures("blank")
def test_a_metric_other_than_inertia_is_noted(run: Run, planar_x: oc.Problem) -> None:
    problem = with_metric(planar_x, "euclidean")
    oc.fit(problem, oc.Linear()).chart.save("plain.orthocas")
    Path("still.json").write_text('{"duration": 0.1, "steps": []}')
    code, _, err = run("impedance", "--animation", "none", chart="plain.orthocas", steps="still.json")
    assert code == 0
    assert err.startswith("note: the metric of this chart is euclidean")
    assert "A = M" in err
    assert run("kinematic", "--animation", "none", chart="plain.orthocas", steps="still.json")[2] == ""
