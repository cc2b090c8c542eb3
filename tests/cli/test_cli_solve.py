"""`orthocas solve` and `orthocas fit --domain all`, and what other commands say of arm files."""

import json
from pathlib import Path

import numpy as np
import pytest
from programs import Run

import orthocas as oc


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    known = oc.problems.get("planar_3r_xy")
    fit = oc.fit_wide(
        known.robot, known.task, oc.Box([0.0, 1.3, 1.3], [3.0, 1.2, 1.2]), parametrisation=oc.Polynomial(3, ["q1"])
    )
    path = tmp_path_factory.mktemp("arm") / "planar.arm"
    oc.Arm(known.task, (fit.chart,)).save(path)
    return path


@pytest.mark.slow
def test_charts_and_arms_are_solved(run: Run, arm_file: Path) -> None:
    arm, q = oc.Arm.load(arm_file), np.array([0.3, 0.9, 0.8])
    x, xi = arm.x(q), float(arm.charts[0].xi(q)[0])
    words = ["solve", str(arm_file), "--x", f"{x[0]},{x[1]}", "--xi", str(xi), "--start", "0.3,0.9,0.8", "--json"]
    found = json.loads(run(*words)[1])["postures"][0]
    assert found["status"] == "FOUND"
    assert found["q"] == pytest.approx(q, abs=1e-8)
    every = json.loads(run(*words[:6], "--all", "--json")[1])["postures"]
    assert any(np.allclose(part["q"], q, atol=1e-7) for part in every)
    code, text, _ = run("solve", "panda-wide", "--x", "0.4,0.1,0.5,0,1,0,0", "--start", "0.3,0.4,0.1,-1.9,0.2,2.2,0.5")
    assert (code, text[:6]) == (0, "status")
    code, text, _ = run("solve", str(arm_file), "--x", "9,9")
    assert (code, "NOT_FOUND" in text) == (1, True)


def test_a_number_that_is_not_finite_has_a_status(run: Run) -> None:
    code, text, _ = run("solve", "panda-position", "--x", "0.4,0.1,0.5", "--xi", "nan,0,0,0", "--json")
    assert (code, json.loads(text)["postures"][0]["status"]) == (1, "BAD_INPUT")


def test_codegen_writes_the_tracker_of_an_arm(run: Run, arm_file: Path, tmp_path: Path) -> None:
    made = json.loads(run("codegen", str(arm_file), "--controller", "track", "--out", str(tmp_path / "c"), "--json")[1])
    assert Path(made["source"]).name == "arm_track.c"
    assert Path(made["header"]).exists()


def test_bad_input_is_one_sentence(run: Run, arm_file: Path) -> None:
    for words, part in (
        (["solve", str(arm_file), "--x", "1"], "2 numbers"),
        (["solve", str(arm_file), "--x", "1,1", "--all"], "--all requires --xi"),
        (["solve", "panda-wide", "--x", "0,0,0,0,0,0", "--all"], "an arm file"),
        (["evaluate", str(arm_file)], "oc.Arm.load and orthocas solve"),
        (["fit", "planar_3r_xy", "--domain", "all", "--param", "linear"], "leave out --param"),
    ):
        code, out, message = run(*words)
        assert (code, out, message.count("\n")) == (2, "", 1)
        assert part in message


@pytest.mark.slow
@pytest.mark.nightly
def test_a_fit_of_all_branches_makes_an_arm(run: Run, tmp_path: Path) -> None:
    target = tmp_path / "planar.arm"
    made = json.loads(run("fit", "planar_3r_xy", "--domain", "all", "--out", str(target), "--json")[1])
    assert [part["branch"] for part in made["branches"]] == list(oc.Arm.load(target).branch_names)
