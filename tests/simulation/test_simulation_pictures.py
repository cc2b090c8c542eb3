"""Pictures and animations of runs show what the arrays hold; files appear whole or not at all."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import robot_data
from matplotlib.colors import to_rgb
from PIL import Image

import orthocas as oc
from orthocas.control import ControlStatus, Kinematic, PDPlus, Reference
from orthocas.errors import ArchiveError, InvalidValueError, UnknownNameError
from orthocas.fitting.fit import Fit
from orthocas.simulation import Outcome, Trajectory, figure
from orthocas.simulation.figure import ACTUAL, RULES, MovingPicture, save_animation, trajectory_figure, units_of
from orthocas.tools.files import LIST, publish
from orthocas.tools.progress import Progress


@pytest.fixture(scope="module")
def planar_run(planar_fit: Fit) -> Trajectory:
    chart = planar_fit.chart
    q = chart.problem.domain.centre
    start = chart.phi(q)
    reference = Reference.steps(chart.labels, start, [(0.1, {"x": start[0] + 0.1})], 2.0)
    return oc.simulate(PDPlus(chart, [200.0, 5000.0, 5000.0]), reference, q)


@pytest.fixture(scope="module")
def spatial_run(iiwa_fit: Fit) -> Trajectory:
    chart = iiwa_fit.chart
    q = chart.problem.domain.centre
    start = chart.phi(q)
    reference = Reference.steps(chart.labels, start, [(0.0, {"z": start[2] - 0.1, "xi1": 0.2})], 0.5)
    return oc.simulate(Kinematic(chart), reference, q)


def with_fallback(run: Trajectory) -> Trajectory:
    """Outside the domain from 1 to 1.5 s, where the coordinates are nonsense."""
    outside = (run.times >= 1) & (run.times < 1.5)
    status = np.where(outside, ControlStatus.OUTSIDE_DOMAIN, ControlStatus.OK)
    storage = np.where(outside, 1e9, run.storage)
    return replace(run, status=status, value=np.where(outside[:, None], 1e6, run.value), storage=storage)


def test_figure_shows_values_references_joints_commands_and_storage(planar_run: Trajectory, planar_fit: Fit) -> None:
    axes = trajectory_figure(planar_run, units_of(planar_fit.chart.problem)).axes
    assert len(axes) == 6
    for i in range(3):
        actual, wanted = axes[i].lines
        np.testing.assert_array_equal(actual.get_ydata(), planar_run.value[:, i])
        np.testing.assert_array_equal(wanted.get_ydata(), planar_run.reference[:, i])
        assert (actual.get_label(), wanted.get_label()) == ("actual", "reference")
    labels = [panel.get_ylabel() for panel in axes]
    assert labels == ["x [m]", r"$\xi_{1}$", r"$\xi_{2}$", "joints q [rad]", "torque [N m]", "storage V [J]"]
    assert axes[0].get_title(loc="right") == f"largest error {planar_run.tracking_error[0]:.2g} m"
    for panel, data in ((axes[3], planar_run.q), (axes[4], planar_run.command)):
        np.testing.assert_array_equal(np.transpose([line.get_ydata() for line in panel.lines]), data)
    assert [text.get_text() for text in axes[3].get_legend().get_texts()] == ["q1", "q2", "q3"]
    assert [panel.get_xlabel() for panel in axes] == ["", "", "time [s]", "", "", "time [s]"]


@pytest.mark.slow
def test_velocity_controllers_have_no_storage_panel(spatial_run: Trajectory) -> None:
    axes = trajectory_figure(spatial_run).axes
    assert len(axes) == 7 + 2
    assert axes[-1].get_ylabel() == "velocity [rad/s or m/s]"


def test_fallback_is_shaded_and_does_not_spoil_the_scales(planar_run: Trajectory) -> None:
    figure = trajectory_figure(with_fallback(planar_run))
    (patch,) = figure.axes[0].patches
    data = patch.get_extents().transformed(figure.axes[0].transData.inverted())
    np.testing.assert_allclose(data.intervalx, [1, 1.5], atol=0.011)  # between instants
    assert figure.axes[0].get_ylim()[1] < 1
    assert figure.axes[5].get_ylim()[1] < 1e6
    assert "fallback, outside domain" in figure.get_suptitle()
    assert not trajectory_figure(planar_run).axes[0].patches
    assert "diverged" in trajectory_figure(replace(planar_run, outcome=Outcome.DIVERGED)).get_suptitle()


def test_units_follow_task_and_joints() -> None:
    arm = oc.Robot.planar([1, 1], [1, 1])
    box = oc.Box([0.5, 0.5], 0.2)
    units = units_of(oc.Problem(arm, oc.Task.position(arm, "x"), "euclidean", box))
    assert (units["q1"], units["x"]) == ("rad", "m")
    custom = oc.Task.custom(arm, "sum", lambda q: q[0] + q[1])
    assert units_of(oc.Problem(arm, custom, "euclidean", box)) == {"q1": "rad", "q2": "rad"}
    named = oc.Task.custom(arm, "sum", lambda q: q[0] + q[1], units=("rad",))
    assert units_of(oc.Problem(arm, named, "euclidean", box))["sum[0]"] == "rad"


@pytest.mark.slow
def test_moving_picture_draws_the_arm_where_it_is(planar_run: Trajectory, planar_fit: Fit) -> None:
    """The tip's way is blue, on pixels that the tip has passed, and nowhere ahead of it."""
    problem = planar_fit.chart.problem
    film = MovingPicture(planar_run, problem)
    last = len(planar_run.times) - 1
    first, final = film.pictures(np.array([0, last]))
    axes = film.axes[0]
    passed = problem.robot.joint_points(planar_run.q)[last // 12, -1, :2]  # on the way, not under the arm's last link
    column, up = axes.transData.transform(passed)
    row = final.shape[0] - 1 - round(up)
    blue = np.round(np.array(to_rgb(ACTUAL)) * 255)

    def distance(picture: Any) -> float:
        patch = picture[row - 2 : row + 3, round(column) - 2 : round(column) + 3].astype(float)
        return float(np.abs(patch - blue).sum(axis=2).min())

    assert distance(final) < 60 < distance(first)


@pytest.mark.slow
def test_moving_picture_moves_on_both_sides_in_the_plane_and_in_space(
    planar_run: Trajectory, spatial_run: Trajectory, planar_fit: Fit, iiwa_fit: Fit
) -> None:
    for run, fit in ((planar_run, planar_fit), (spatial_run, iiwa_fit)):
        first, last = MovingPicture(run, fit.chart.problem).pictures(np.array([0, len(run.times) - 1]))
        height, width, _ = first.shape
        assert (height % 2, width % 2) == (0, 0)  # as MP4 wants
        changed = (first != last).any(axis=2)
        assert changed[:, : width // 2].sum() > 200
        assert changed[:, width // 2 :].sum() > 200
        assert changed.mean() < 0.2


@pytest.mark.slow
def test_gif_plays_in_real_time(planar_run: Trajectory, planar_fit: Fit, tmp_path: Path) -> None:
    seen: list[Progress] = []
    save_animation(tmp_path / "a.gif", planar_run, planar_fit.chart.problem, seen.append)
    with Image.open(tmp_path / "a.gif") as film:
        count = film.n_frames  # type: ignore[attr-defined]
        lengths = []
        for k in range(count):
            film.seek(k)
            lengths.append(film.info["duration"])
    assert count == len(seen) == 41
    assert sum(lengths) == 41 * 50
    assert seen[-1].fraction == 1
    assert {path.name for path in tmp_path.iterdir()} == {"a.gif", LIST}


@pytest.mark.slow
def test_long_runs_are_shown_faster(
    planar_run: Trajectory, planar_fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orthocas.simulation.figure.RULES", replace(RULES, most_frames=10))
    save_animation(tmp_path / "a.gif", planar_run, planar_fit.chart.problem)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 11  # type: ignore[attr-defined]
    title = MovingPicture(planar_run, planar_fit.chart.problem, speed=4.0).title
    assert title == "pd_plus, 4 x real time"


def fake_ffmpeg(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> None:
    script = folder / "bin" / "ffmpeg"
    script.parent.mkdir()
    script.write_text(f"#!{sys.executable}\nimport json, sys\n{body}\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(script.parent))


TAKE_ALL = "data = sys.stdin.buffer.read(); open(sys.argv[-1], 'w').write(json.dumps([sys.argv[1:], len(data)]))"


@pytest.mark.slow
def test_mp4_goes_through_ffmpeg(
    planar_run: Trajectory, planar_fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_ffmpeg(tmp_path, monkeypatch, TAKE_ALL)
    save_animation(tmp_path / "a.mp4", planar_run, planar_fit.chart.problem)
    words, received = json.loads((tmp_path / "a.mp4").read_text())
    width, height = map(int, words[words.index("-s") + 1].split("x"))
    assert received == 41 * width * height * 3
    assert words[words.index("-r") + 1] == "20"


def test_ffmpeg_that_fails_says_why(
    planar_run: Trajectory, planar_fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_ffmpeg(tmp_path, monkeypatch, "sys.exit('no encoder here')")
    with pytest.raises(ArchiveError, match="ffmpeg could not write a.mp4: no encoder here"):
        save_animation(tmp_path / "a.mp4", planar_run, planar_fit.chart.problem)
    assert [path.name for path in tmp_path.iterdir()] == ["bin"]


def test_formats_that_cannot_be_made_are_refused(
    planar_run: Trajectory, planar_fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    problem = planar_fit.chart.problem
    with pytest.raises(InvalidValueError, match="mp4 needs ffmpeg, which is not on the PATH"):
        save_animation(tmp_path / "a.mp4", planar_run, problem)
    with pytest.raises(UnknownNameError, match="unknown animation format 'webm', known: gif, mp4"):
        save_animation(tmp_path / "a.webm", planar_run, problem)
    with pytest.raises(ArchiveError, match="does not exist"):
        save_animation(tmp_path / "none" / "a.gif", planar_run, problem)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_interrupted_animation_leaves_nothing_and_keeps_the_old_one(
    planar_run: Trajectory, planar_fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    fake_ffmpeg(tmp_path, monkeypatch, TAKE_ALL)
    with publish(tmp_path, listed=True) as drafts:
        (drafts / name).write_text("old")

    def stop(progress: Progress) -> None:
        if progress.fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_animation(tmp_path / name, planar_run, planar_fit.chart.problem, stop)
    assert (tmp_path / name).read_text() == "old"
    assert {path.name for path in tmp_path.iterdir()} == {"bin", name, LIST}


@pytest.mark.slow
def test_a_run_of_one_instant_can_be_drawn(planar_run: Trajectory, planar_fit: Fit, tmp_path: Path) -> None:
    arrays = {name: value[:1] for name, value in vars(planar_run).items() if isinstance(value, np.ndarray)}
    instant = replace(planar_run, outcome=Outcome.DIVERGED, **arrays)
    trajectory_figure(instant).savefig(tmp_path / "a.png")
    save_animation(tmp_path / "a.gif", instant, planar_fit.chart.problem)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 1  # type: ignore[attr-defined]


def test_targets_are_drawn_for_positions_of_the_first_tip_only() -> None:
    """A position of another hand, and of both, whose labels have numbers, have no target at the first one."""
    robot = oc.Robot.from_urdf(
        robot_data("baxter_description/urdf/baxter.urdf"), tips=["left_gripper", "right_gripper"]
    )
    q = np.zeros((3, robot.n))
    own, other = oc.Task.position(robot), oc.Task.position(robot, frame="right_gripper")
    for task, drawn in ((own, True), (other, False), (oc.Task.stack(own, other), False)):
        problem = oc.Problem(robot, task, domain=oc.Box(robot.tree.centre_posture, 0.1))
        run: Any = SimpleNamespace(times=np.arange(3.0), q=q, reference=np.tile(task.batched(q[:1])[0], (3, 1)))
        targets = figure._compute_tip_targets(run, problem)
        assert np.isfinite(targets).all() == drawn
        if drawn:
            np.testing.assert_allclose(targets, robot.tip_position(q), atol=1e-12)
