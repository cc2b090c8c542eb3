"""Wide fits that leave postures in self-collision aside: what counts is the free part, and files say which it is."""

from pathlib import Path

import pytest
from solid_arms import BALL, build_arm

import orthocas as oc
from orthocas.charts.chart_file import FREE
from orthocas.errors import InvalidValueError, RobotError
from orthocas.fitting.wide_search import Search, WideSettings

BENT = oc.Box([0.0, 1.5, 1.5], [3.0, 1.4, 1.4])  # bent so far that the last ball may meet the base
LARGE = '<sphere radius="0.5"/>'


def test_only_free_postures_count(tmp_path: Path) -> None:
    robot = build_arm(tmp_path, [LARGE, BALL, BALL, LARGE])
    task = oc.Task.position(robot, "xy")
    found = oc.fit_wide(robot, task, BENT, samples=600, collisions=True)
    chart, collisions = found.chart, robot.collisions
    assert chart.notes[FREE] == collisions.origin
    assert "clear and free positions" in found.facts()["regular"]
    # No sample of the loss touches.
    search = Search(chart.problem, oc.Polynomial(2), WideSettings(collisions=collisions))
    touching = ~collisions.check_free(chart.problem.domain.sample(2000, 1))
    assert 0.02 < touching.mean() < 0.9
    assert collisions.check_free(search.sample(500, 1)).all()
    # The file has the solids, and the report is that of free samples.
    chart.save(tmp_path / "a.orthocas")
    loaded = oc.load(tmp_path / "a.orthocas")
    assert loaded.robot.collisions.pairs == collisions.pairs
    report = oc.evaluate(loaded, samples=2000, seed=1)
    assert report.samples == int((~touching).sum())
    assert report.contacts is not None
    assert report.contacts.touching == int(touching.sum())
    free = chart.problem.domain.sample(2000, 1)[~touching]
    assert report.conditioning.p01 == oc.evaluate(chart, points=free).conditioning.p01


def test_robots_without_solids_or_free_postures_are_refused(tmp_path: Path) -> None:
    bare = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    with pytest.raises(RobotError, match="the links have no solids"):
        oc.fit_wide(bare, oc.Task.position(bare, "xy"), BENT, collisions=True)
    huge = build_arm(tmp_path, ['<sphere radius="9"/>', "", "", BALL])
    model = huge.collisions
    solid = type(model)(huge.tree, model.parts, [("link0", "link3")])
    problem = oc.Problem(huge, oc.Task.position(huge, "xy"), domain=oc.Box(BENT.centre, 0.5))
    with pytest.raises(InvalidValueError, match="a contact at all samples"):
        Search(problem, oc.Polynomial(2), WideSettings(collisions=solid)).sample(100, 1)
