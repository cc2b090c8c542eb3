"""`--collisions` and `--srdf`: what commands say of contacts is what Python says."""

import json
from pathlib import Path

import numpy as np
import pytest
from programs import Run
from solid_arms import build_arm

import orthocas as oc
from orthocas.robots.collisions import Collisions

FREE = np.array([0.6, 1.7, 1.9])
LINK = '<box size="0.3 0.04 0.04"/>'
LIMITS = ("--velocity-limit", "1")


@pytest.fixture
def arm(run: Run) -> tuple[oc.Chart, Collisions]:
    """A chart file a.orthocas, its robot file arm.urdf and a path p.csv in an empty folder; base and last link meet."""
    robot = build_arm(Path(), ['<box size="0.5 0.5 0.1"/>', LINK, LINK, LINK]).with_tool([1.0, 0.0, 0.0])
    domain = oc.Box([0.6, 2.2, 2.2], 0.6)
    chart = oc.fit(oc.Problem(robot, oc.Task.position(robot, "xy"), "euclidean", domain), oc.Linear()).chart
    chart.save("a.orthocas")
    Path("pairs").mkdir()
    Path("pairs/none.srdf").write_text('<robot name="arm"><disable_collisions link1="link0" link2="link3"/></robot>')
    rows = ["x,y", *(f"{x!r},{y!r}" for x, y in (chart.x(FREE) + np.linspace([0, 0], [0.05, 0], 8)).tolist())]
    Path("p.csv").write_text("\n".join(rows) + "\n")
    return chart, robot.collisions


@pytest.mark.slow
def test_info_and_evaluate_have_the_share_that_touches(run: Run, arm: tuple[oc.Chart, Collisions]) -> None:
    chart, collisions = arm
    free = collisions.check_free(chart.domain.sample(10_000, 1))
    assert 0.02 < 1 - free.mean() < 0.9
    code, out, err = run("info", "a.orthocas", "--collisions", "arm.urdf", "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["touching_share"] == pytest.approx(1 - free.mean())
    assert found["touching_pair"] == ["link0", "link3"]
    assert found["collisions"] == {"pairs": len(collisions.pairs), "origin": collisions.origin}
    assert found["unchecked"] == []
    options = ("--samples", "2000", "--collisions", "arm.urdf")
    report = json.loads(run("evaluate", "a.orthocas", *options, "--json")[1])
    touching = int((~collisions.check_free(chart.domain.sample(2000, 1))).sum())
    assert report["contacts"]["touching"] == touching
    again = json.loads(run("evaluate", "a.orthocas", *options, "--srdf", "pairs/none.srdf", "--json")[1])
    assert again["contacts"]["pair"] != ["link0", "link3"]
    robot = json.loads(run("info", "arm.urdf", "--collisions", "arm.urdf", "--json")[1])
    assert robot["collisions"]["pairs"] == len(collisions.pairs)


def test_bad_files_and_lone_options_are_refused(run: Run, arm: tuple[oc.Chart, Collisions]) -> None:
    code, out, err = run("info", "a.orthocas", "--srdf", "pairs/none.srdf")
    assert (code, out) == (2, "")
    assert "--srdf requires --collisions FILE.urdf" in err
    for command in (("evaluate", "a.orthocas"), ("follow", "a.orthocas", "p.csv", "--out", "q.csv")):
        code, out, err = run(*command, "--collisions", "nothing.urdf")
        assert (code, out) == (2, "")
        assert "nothing.urdf" in err
    assert not Path("q.csv").exists()


def test_follow_refuses_contacts_and_says_which(run: Run, arm: tuple[oc.Chart, Collisions]) -> None:
    options = ("a.orthocas", "p.csv", *LIMITS, "--out", "q.csv", "--collisions", "arm.urdf")
    assert run("follow", *options, "--json")[::2] == (0, "")
    chart = arm[0]
    x, y = chart.robot.frame_position(FREE, "link2")[:2]
    code, _, err = run("follow", *options, "--obstacle", f"sphere:{x},{y},0,0.3", "--force")
    assert code == 2
    assert "obstacle" in err


@pytest.mark.slow
def test_simulate_notes_the_nearest_pair(run: Run, arm: tuple[oc.Chart, Collisions]) -> None:
    Path("steps.json").write_text('{"duration": 0.3, "steps": [{"time": 0.1, "move": {"xi1": 0.01}}]}')
    words = ("a.orthocas", "--controller", "kinematic", "--steps", "steps.json", "--out", "out", "--animation", "none")
    code, _, err = run("simulate", *words, "--collisions", "arm.urdf")
    assert code == 0
    assert "no contact: 'link" in err or "touch; the simulation knows no contacts" in err
