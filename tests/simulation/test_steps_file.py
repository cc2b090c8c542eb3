"""Steps files: what they mean, and one clear error for every mistake."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import orthocas as oc
from orthocas.errors import StepsFileError
from orthocas.simulation.disturbances import read_steps

STEPS: dict[str, Any] = {
    "duration": 4,
    "steps": [
        {"time": 0.5, "move": {"x": 0.1}},
        {"time": 1, "to": {"xi1": 0.2}, "move": {"x": 0.05}},
        {"time": 2, "move": {"xi1": -0.1}},
    ],
}
POINTS: dict[str, Any] = {"points": [{"time": 1, "move": {"x": 0.1}}, {"time": 2}, {"time": 4, "to": {"xi2": 0.02}}]}


@pytest.fixture
def chart(planar_x: oc.Problem) -> oc.Chart:
    return oc.fit(planar_x, oc.Linear()).chart


def written(folder: Path, content: Any) -> Path:
    path = folder / "steps.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def changed(base: dict[str, Any], **parts: Any) -> dict[str, Any]:
    return {**base, **parts}


def test_moves_count_from_the_last_target_and_others_stay(chart: oc.Chart, tmp_path: Path) -> None:
    plan = read_steps(written(tmp_path, STEPS), chart)
    start = chart.phi(chart.problem.domain.centre)
    np.testing.assert_array_equal(plan.q_start, chart.problem.domain.centre)
    np.testing.assert_array_equal(plan.reference.times, [0, 0.5, 1, 2, 4])
    moves = [[0, 0, 0], [0.1, 0, 0], [0.15, 0.2, 0], [0.15, 0.1, 0]]
    wanted = start + np.array(moves)
    wanted[2:, 1] -= start[1]  # "to" is absolute
    np.testing.assert_allclose(plan.reference.targets, wanted, atol=1e-15)
    assert plan.reference.labels == ("x", "xi1", "xi2")
    assert plan.has_steps
    assert plan.pushes == ()


def test_points_are_met_and_a_point_without_quantities_is_a_rest(chart: oc.Chart, tmp_path: Path) -> None:
    plan = read_steps(written(tmp_path, POINTS), chart)
    start = chart.phi(chart.problem.domain.centre)
    value, velocity, _ = plan.reference.sample([0.0, 1.0, 2.0, 4.0])
    np.testing.assert_allclose(value[:, 0], start[0] + np.array([0, 0.1, 0.1, 0.1]), atol=1e-12)
    np.testing.assert_allclose(value[:, 2], [start[2], start[2], start[2], 0.02], atol=1e-12)
    np.testing.assert_allclose(velocity[[0, -1]], 0, atol=1e-12)
    assert plan.reference.duration == 4
    assert not plan.has_steps


def test_start_low_pass_and_pushes_are_taken_over(chart: oc.Chart, tmp_path: Path) -> None:
    pushes = [{"start": 1, "duration": 0.2, "force": [10, 0, -1]}, {"start": 2, "duration": 1, "torque": [1, 2, 3]}]
    content = changed(STEPS, start=[0.5, 0.7, 0.9], natural_frequency=3, damping_ratio=0, pushes=pushes)
    plan = read_steps(written(tmp_path, content), chart)
    np.testing.assert_array_equal(plan.q_start, [0.5, 0.7, 0.9])
    np.testing.assert_allclose(plan.reference.start, chart.phi([0.5, 0.7, 0.9]))
    swing = plan.reference.sample([0.5 + 0.4])[0][0, 0] - plan.reference.start[0]
    assert swing == pytest.approx(0.1 * (1 - np.cos(3 * 0.4)), rel=1e-12)  # undamped: e = e0 cos(omega0 t)
    assert [(push.start, push.end) for push in plan.pushes] == [(1.0, 1.2), (2.0, 3.0)]
    np.testing.assert_array_equal(plan.pushes[0].load(3), [10, 0, -1, 0, 0, 0])
    np.testing.assert_array_equal(plan.pushes[1].load(3), [0, 0, 0, 1, 2, 3])


def test_pushes_act_at_links_and_points(chart: oc.Chart, tmp_path: Path) -> None:
    pushes = [{**PUSH, "link": "q2", "point": [0.5, 0.1, 0]}, {**PUSH, "link": 2}, PUSH, {**PUSH, "point": [0, 0, 1]}]
    plan = read_steps(written(tmp_path, changed(STEPS, pushes=pushes)), chart)
    assert [push.link for push in plan.pushes] == ["q2", 2, None, None]
    assert [push.point.tolist() for push in plan.pushes] == [[0.5, 0.1, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize("name", ["steps_planar_3r_x.json", "steps_iiwa.json"])
def test_examples_are_steps_files(name: str, chart: oc.Chart, iiwa_fit: Any) -> None:
    path = Path(__file__).parents[2] / "examples" / name
    assert read_steps(path, iiwa_fit.chart if "iiwa" in name else chart).has_steps


def test_steps_files_in_the_docs_can_be_read(chart: oc.Chart, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / "simulation.md").read_text()
    blocks = re.findall(r"```json\n(.*?)```", text, flags=re.DOTALL)
    assert [read_steps(written(tmp_path, block), chart).has_steps for block in blocks] == [True, False]


ONE = {"time": 1, "move": {"x": 0.1}}
PUSH = {"start": 1, "duration": 0.1, "force": [1, 0, 0]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "truncated or not JSON"),
        (json.dumps(STEPS)[:40], "truncated or not JSON, Expecting property name"),
        ("\xff\xfe", "truncated or not JSON"),
        ("[1]", "content is [1], expected an object"),
        ("null", "content is null, expected an object"),
        ('{"steps": [], "duration": NaN}', "it holds NaN, expected finite numbers"),
        ('{"steps": [], "duration": 1, "duration": 2}', "the key 'duration' appears twice in one object"),
        ({}, "neither 'steps' nor 'points'"),
        (changed(STEPS, points=[]), "both 'steps' and 'points'"),
        (changed(STEPS, tempo=1), "the object with 'steps' has an unknown key 'tempo', known: steps, duration, start"),
        (changed(POINTS, duration=1), "the object with 'points' has an unknown key 'duration', known: points, start"),
        ({"steps": []}, "duration is missing, expected a number"),
        (changed(STEPS, duration="long"), 'duration is "long", expected a number from 0.001 to 1e+06'),
        (changed(STEPS, duration=0), "duration is 0, expected a number from 0.001"),
        (changed(STEPS, duration=10**400), "duration is 1000"),
        (changed(STEPS, duration=True), "duration is true"),
        (changed(STEPS, natural_frequency=0), "natural_frequency is 0, expected a number above 0"),
        (changed(STEPS, damping_ratio=-0.1), "damping_ratio is -0.1, expected a number from 0"),
        (changed(STEPS, start=[0, 0]), "start is [0, 0], expected a list of 3 numbers"),
        (changed(STEPS, start=[0, "a", 0]), 'start[1] is "a", expected a number'),
        (changed(STEPS, start=1), "start is 1, expected a list"),
        (changed(STEPS, steps={}), "steps is {}, expected a list"),
        (changed(STEPS, steps=[1]), "steps[0] is 1, expected an object"),
        (changed(STEPS, steps=[{"move": {"x": 1}}]), "steps[0].time is missing"),
        (changed(STEPS, steps=[{**ONE, "by": 1}]), "steps[0] has an unknown key 'by', known: time, move, to"),
        (changed(STEPS, steps=[{"time": 1}]), 'steps[0] is {"time": 1}, expected a quantity'),
        (changed(STEPS, steps=[ONE, {"time": 0.5, "to": {"x": 1}}]), "steps[1].time is 0.5, expected from 1 to below"),
        (
            changed(STEPS, steps=[{"time": 4, "to": {"x": 1}}]),
            "steps[0].time is 4.0, expected from 0 to below the dura",
        ),
        (changed(STEPS, steps=[{"time": 1, "to": {"y": 1}}]), "steps[0].to has an unknown quantity 'y', known: x, xi1"),
        (changed(STEPS, steps=[{"time": 1, "to": [1]}]), "steps[0].to is [1], expected an object"),
        (changed(STEPS, steps=[{"time": 1, "to": {"x": None}}]), "steps[0].to.x is missing"),
        (changed(STEPS, steps=[{**ONE, "to": {"x": 1}}]), "steps[0] has x in both 'move' and 'to'"),
        ({"points": []}, "points is [], expected at least one point"),
        (
            {"points": [{"time": 0}]},
            "points[0].time is 0.0, expected at least 0.001, because the start is the point at 0",
        ),
        ({"points": [ONE, ONE]}, "points[1].time is 1.0, expected at least 1.001"),
        (changed(STEPS, pushes=1), "pushes is 1, expected a list"),
        (changed(STEPS, pushes=[{**PUSH, "mass": 1}]), "pushes[0] has an unknown key 'mass', known: start, duration"),
        (
            changed(STEPS, pushes=[{"start": 1, "duration": 1}]),
            "expected a 'force' at the tip or a link, or a 'torque'",
        ),
        (
            changed(STEPS, pushes=[{**PUSH, "start": 9}]),
            "pushes[0].start is 9.0, expected below the end of the run at 4",
        ),
        (changed(STEPS, pushes=[{**PUSH, "start": -1}]), "pushes[0].start is -1, expected a number from 0"),
        (changed(STEPS, pushes=[{**PUSH, "duration": 0}]), "pushes[0].duration is 0"),
        (changed(STEPS, pushes=[{**PUSH, "force": [1]}]), "pushes[0].force is [1], expected a list of 3 numbers"),
        (changed(STEPS, pushes=[{**PUSH, "torque": [1]}]), "pushes[0].torque is [1], expected a list of 3 numbers"),
        (
            changed(STEPS, pushes=[{**PUSH, "link": "elbow"}]),
            'pushes[0].link is "elbow", expected the index of a joint',
        ),
        (changed(STEPS, pushes=[{**PUSH, "link": 3}]), "pushes[0].link is 3, expected the index of a joint"),
        (changed(STEPS, pushes=[{**PUSH, "link": -1}]), "pushes[0].link is -1, expected the index of a joint"),
        (changed(STEPS, pushes=[{**PUSH, "link": True}]), "pushes[0].link is true, expected the index of a joint"),
        (changed(STEPS, pushes=[{**PUSH, "link": 1.5}]), "pushes[0].link is 1.5, expected the index of a joint"),
        (changed(STEPS, pushes=[{**PUSH, "link": None}]), "pushes[0].link is null, expected the index of a joint"),
        (changed(STEPS, pushes=[{**PUSH, "link": ["q1"]}]), 'pushes[0].link is ["q1"], expected the index of a joint'),
        (
            changed(STEPS, pushes=[{**PUSH, "link": "arm"}]),
            "of a joint from 0, or a name: q1, q2, q3",
        ),
        (changed(STEPS, pushes=[{**PUSH, "point": [1, 2]}]), "pushes[0].point is [1, 2], expected a list of 3 numbers"),
        (
            changed(STEPS, pushes=[{"start": 1, "duration": 1, "torque": [0, 0, 1], "link": 1}]),
            "pushes[0] has a 'link' but no 'force', expected 'force' too, or no 'link'",
        ),
    ],
)
def test_a_mistake_is_named_with_file_and_place(chart: oc.Chart, tmp_path: Path, content: Any, message: str) -> None:
    path = written(tmp_path, content)
    with pytest.raises(StepsFileError) as caught:
        read_steps(path, chart)
    assert str(caught.value).startswith(f"steps file {path}: ")
    assert message in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300


def test_runs_of_more_instants_than_a_machine_holds_are_refused(chart: oc.Chart, tmp_path: Path) -> None:
    content = changed(STEPS, duration=1e6, natural_frequency=1e6)
    with pytest.raises(StepsFileError, match=r"needs 3.33e\+12 instants .*, expected at most 1e"):
        read_steps(written(tmp_path, content), chart)
    with pytest.raises(StepsFileError, match="larger than 8 MiB"):
        read_steps(written(tmp_path, " " * 2**24), chart)


def test_what_cannot_be_read_is_a_steps_file_error(chart: oc.Chart, tmp_path: Path) -> None:
    with pytest.raises(StepsFileError, match="cannot be read, No such file"):
        read_steps(tmp_path / "none.json", chart)
    with pytest.raises(StepsFileError, match="cannot be read, Is a directory"):
        read_steps(tmp_path, chart)
    with pytest.raises(StepsFileError, match="not JSON, it is nested too deep"):
        read_steps(written(tmp_path, "[" * 100_000), chart)
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(StepsFileError, match="not JSON"):
        read_steps(tmp_path / "binary", chart)
