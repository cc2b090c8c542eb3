"""`orthocas simulate`: refusals and interrupts; nothing written on bad input, nothing of others replaced."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from programs import Run
from simulate_command import FILES, written

import orthocas as oc
from orthocas.cli import simulate as command
from orthocas.simulation import Trajectory
from orthocas.tools.files import publish
from orthocas.tools.progress import Monitor, Progress


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pid",), "unknown controller 'pid', known: impedance, pd_plus, kinematic"),
        (
            ("kinematic", "--stiffness", "1"),
            "kinematic has no option --stiffness, which is for",
        ),
        (("pd_plus", "--feedback", "1"), "which is for kinematic"),
        (("kinematic", "--coupling", "coupled"), "which is for impedance, pd_plus"),
        (("kinematic", "--mass-factor", "1.1"), "kinematic has no option --mass-factor"),
        (("kinematic", "--friction", "1,1"), "which is for impedance, pd_plus"),
        (("pd_plus", "--coupling", "both"), "unknown coupling 'both', known: coupled, decoupled"),
        (("pd_plus", "--stiffness", "1,2"), "stiffness has shape (2,), expected (3,)"),
        (("pd_plus", "--stiffness", "-1"), "stiffness[0] is -1.0, expected positive numbers"),
        (("pd_plus", "--stiffness", "soft"), "--stiffness is ['soft'], expected an array of numbers"),
        (("pd_plus", "--limit", "0"), "limit[0] is 0.0, expected positive numbers"),
        (("kinematic", "--feedback", "1,2"), "feedback has shape (2,), expected (3,)"),
        (("pd_plus", "--rate", "0"), "control_rate is 0.0, expected a finite number > 0"),
        (("pd_plus", "--noise", "1,1"), "--noise requires --rate"),
        (("pd_plus", "--noise", "1", "--rate", "100"), "--noise is '1', expected two numbers"),
        (("kinematic", "--noise", "1,1", "--rate", "100"), "kinematic measures no velocity"),
        (("pd_plus", "--seed", "1"), "the seed of noise is a third number of --noise"),
        (("pd_plus", "--noise", "1,1,1.5", "--rate", "100"), "seed is 1.5"),
        (("pd_plus", "--friction", "-1,0"), "viscous[0] is -1.0"),
        (("pd_plus", "--plant", "bullet"), "unknown plant 'bullet', known: cvodes, mujoco"),
        (("pd_plus", "--plant", "mujoco"), "--plant mujoco requires --rate"),
        (("kinematic", "--plant", "mujoco", "--rate", "100"), "expected no MuJoCo with a velocity controller"),
        (("pd_plus", "--mass-factor", "0"), "factor is 0.0, expected numbers > 0"),
        (("pd_plus", "--animation", "webp"), "unknown animation format 'webp', known: gif, mp4"),
        (("pd_plus", "--out", "no/out"), "folder no does not exist"),
        (("pd_plus", "--out", "short.json"), "--out is short.json, expected a folder"),
        (("pd_plus", "--steps", "none.json"), "steps file none.json: cannot be read"),
        (("pd_plus", "--steps", "a.orthocas"), "steps file a.orthocas: "),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(run_simulate: Run, words: tuple[str, ...], message: str) -> None:
    before = set(Path().iterdir())
    code, out, err = run_simulate(*words)
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert set(Path().iterdir()) == before


def test_mp4_without_ffmpeg_is_refused_before_the_run(run_simulate: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    code, out, err = run_simulate("pd_plus", "--animation", "mp4")
    assert (code, out) == (2, "")
    assert "animation is mp4, expected gif, because mp4 needs ffmpeg, which is not on the PATH" in err
    assert not Path("out").exists()


@pytest.mark.parametrize("name", ["pd_plus", "kinematic"])
def test_a_reference_that_leaves_the_domain_is_reported_before_the_run(run_simulate: Run, name: str) -> None:
    Path("far.json").write_text(json.dumps({"duration": 2, "steps": [{"time": 1, "move": {"x": 0.6}}]}))
    code, out, err = run_simulate(name, steps="far.json")
    assert (code, out) == (2, "")
    assert "the reference leaves the domain at t = 1." in err
    assert not Path("out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pd_plus", "kinematic"])
def test_grown_charts_are_refused(run_simulate: Run, name: str, planar_x: oc.Problem) -> None:
    oc.grow(planar_x, leaf="linear").save("grown.orthocas")
    code, out, err = run_simulate(name, chart="grown.orthocas")
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


@pytest.mark.usefixtures("blank_pictures")
def test_ctrl_c_in_the_run_keeps_what_was_simulated(run_simulate: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("out").mkdir()
    with publish(Path("out"), listed=True) as drafts:
        (drafts / "animation.gif").write_text("of an earlier run")
    monkeypatch.setattr(command, "terminal_monitor", interrupting("simulate"))
    code, out, err = run_simulate("pd_plus", "--json")
    assert code == 130
    assert "interrupted: the run so far is saved, without an animation" in err
    assert written() == FILES
    report = json.loads(out)
    assert report["outcome"] == "interrupted"
    assert 0.5 <= report["duration"] < 0.8
    assert report["coupling_index"] is None
    assert Trajectory.load("out/trajectory.npz").times[-1] == report["duration"]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_files_of_others_stay_unless_forced(run_simulate: Run) -> None:
    Path("out").mkdir()
    Path("out/animation.gif").write_text("my holidays")
    for words in (("pd_plus",), ("pd_plus", "--force", "--animation", "none")):  # without one it is in nobody's way
        code, _, err = run_simulate(*words)
        assert (code, err.count("\n")) == ((0, 0) if "--force" in words else (2, 1)), err
        assert Path("out/animation.gif").read_text() == "my holidays"
    assert run_simulate("pd_plus", "--force")[0] == 0
    assert Path("out/animation.gif").read_bytes().startswith(b"GIF")
    Path("out/report.json").write_text("edited")
    code, _, err = run_simulate("pd_plus")
    assert (code, Path("out/report.json").read_text()) == (2, "edited")
    assert "cannot write out/report.json: orthocas did not write the file" in err


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_ctrl_c_in_the_animation_leaves_no_half_of_it(run_simulate: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "terminal_monitor", interrupting("draw"))
    code, out, err = run_simulate("pd_plus")
    assert code == 130
    assert "1 s: complete" in out
    assert "without an animation" in err
    assert written() == FILES


@pytest.mark.usefixtures("blank_pictures")
def test_ctrl_c_while_files_are_written_loses_nothing(run_simulate: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    save, signals = Trajectory.save, [signal.SIGINT]

    def interrupted(self: Trajectory, path: Path) -> None:
        save(self, path)
        if signals:
            os.kill(os.getpid(), signals.pop())

    monkeypatch.setattr(Trajectory, "save", interrupted)
    code, out, err = run_simulate("pd_plus")
    assert code == 130
    assert "1 s: complete" in out
    assert "without an animation" in err
    assert written() == FILES
