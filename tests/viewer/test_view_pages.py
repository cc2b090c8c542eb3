"""Pages on a server that nobody looks at: what their buttons, handles and exports do."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from public_objects import clear, cyclic, fitted, joint_motion, trajectory
from scipy.spatial.transform import Rotation
from solid_arms import build_arm

import orthocas as oc
from orthocas.errors import ArchiveError, InvalidValueError, ViewError
from orthocas.viewer import chart_page, cyclic_motions, export_page
from orthocas.viewer.motion import read_joint_motion

pytestmark = [
    pytest.mark.skipif(find_spec("viser") is None, reason="no viser: pip install 'orthocas[view]'"),
    pytest.mark.slow,
]


def wait(condition: Callable[[], bool]) -> None:
    """Wait until the thread of a page has done something."""
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def press(button: Any) -> None:
    """What viser does when somebody clicks."""
    asyncio.run(button._impl.update_cb[0](SimpleNamespace(client=object(), target=button)))


@pytest.mark.parametrize("build", [lambda: fitted().chart, cyclic, clear])
def test_handle_sweep_undo_and_home(build: Callable[[], oc.Chart]) -> None:
    chart = build()
    robot = chart.problem.robot
    with oc.view(chart, port=0) as view:
        page = view._page
        session, home = page.session, page.session.home
        page._handle.position = tuple(robot.tip_position(home) + 0.02)
        for phase in ("start", "update", "end"):
            asyncio.run(page._handle._impl_aux.update_cb[0](SimpleNamespace(target=page._handle, phase=phase)))
        wait(lambda: not page._undo.disabled and not page._gesture)
        np.testing.assert_allclose(chart.x(session.q) - chart.x(home), 0.02, atol=1e-9)
        np.testing.assert_allclose(chart.xi(session.q), chart.xi(home), atol=1e-9)
        np.testing.assert_allclose(page._handle.position, robot.tip_position(session.q), atol=1e-9)
        before = session.q
        press(page._sweep)
        wait(lambda: bool(np.abs(session.q - before).max() > 0.02))
        press(page._sweep)
        wait(lambda: page._sweep.label == "Sweep" and not page._gesture)
        assert np.abs(chart.x(session.q) - chart.x(before)).max() < 1e-9
        press(page._undo)
        wait(lambda: bool((session.q == before).all()))
        press(page._undo)
        wait(lambda: bool((session.q == home).all()))
        values = dict(zip(chart.labels, chart.phi(home).tolist(), strict=True))
        wait(lambda: all(abs(page._sliders[label].value - value) < 6e-4 for label, value in values.items()))


def test_rings_turn_the_tool_of_a_pose_task() -> None:
    """By 0.2 rad about the tool's own z axis; place and xi stay."""
    chart = oc.load("panda-wide")
    robot = chart.problem.robot
    with oc.view(chart, port=0) as view:
        page = view._page
        session, home = page.session, page.session.home
        here = Rotation.from_matrix(robot.tip_rotation(home))
        np.testing.assert_allclose(np.abs(page._rings.wxyz @ here.as_quat(scalar_first=True)), 1, atol=1e-12)
        wished = here * Rotation.from_rotvec([0, 0, 0.2])
        for end in (chart.xi_range(home)["xi1"].low_stop, chart.xi_range(home)["xi1"].high_stop):
            assert end.joint in page._readings.content
        page._rings.wxyz = tuple(wished.as_quat(scalar_first=True))
        for phase in ("start", "update", "end"):
            asyncio.run(page._rings._impl_aux.update_cb[0](SimpleNamespace(target=page._rings, phase=phase)))
        wait(lambda: not page._undo.disabled and not page._gesture)
        np.testing.assert_allclose(robot.tip_rotation(session.q), wished.as_matrix(), atol=1e-8)
        np.testing.assert_allclose(robot.tip_position(session.q), robot.tip_position(home), atol=1e-9)
        np.testing.assert_allclose(chart.xi(session.q), chart.xi(home), atol=1e-9)


def test_pages_offer_paths_and_robot_files_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is chosen is played and drawn; a file that is none leaves a message, and the page goes on."""
    chart = fitted().chart
    monkeypatch.chdir(tmp_path)
    x = chart.x(chart.problem.domain.home)
    rows = "\n".join(",".join(map(str, point)) for point in (x + 0.02, x - 0.03))
    Path("way.csv").write_text(f"{','.join(chart.labels[: chart.m])}\n{rows}\n")
    Path("other.csv").write_text("a,b\n1,2\n")
    Path("arm.urdf").write_text("no robot")
    with oc.view(chart, port=0) as view:
        page = view._page
        assert page._play.disabled
        chosen = {handle.label: handle for handle in view._server.gui._gui_input_handle_from_uuid.values()
                  if getattr(handle, "label", "") in ("path", "links")}  # fmt: skip
        assert chosen["path"].options == ("none", "other.csv", "way.csv")
        assert chosen["links"].options == ("none", "arm.urdf")
        chosen["path"].value = "way.csv"
        wait(lambda: not page._play.disabled)
        np.testing.assert_allclose(page._path, [x + 0.02, x - 0.03])
        chosen["path"].value = "none"
        wait(lambda: page._play.disabled)
        before = page._arm
        for what, name in (("links", "arm.urdf"), ("path", "other.csv")):
            chosen[what].value = name
            page._loop.ask("after", lambda: None)
            time.sleep(0.3)
            assert page._arm is before
            assert page._play.disabled
        chosen["links"].value = "none"
        wait(lambda: page._arm is not before)


def test_a_path_plays_and_its_recording_can_be_viewed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chart = fitted().chart
    monkeypatch.setattr(chart_page, "RULES", replace(chart_page.RULES, cycle=0.5))
    x = chart.x(chart.problem.domain.home)
    files: dict[str, bytes] = {}
    client = SimpleNamespace(send_file_download=lambda name, content, save_immediately: files.update({name: content}))
    with oc.view(chart, path=[x + 0.02, x - 0.03], port=0) as view:
        page = view._page
        page._loop.ask("record", lambda: page._toggle_record(client))
        press(page._play)
        wait(lambda: bool(np.abs(chart.x(page.session.q) - x + 0.03).max() < 1e-8))
        wait(lambda: page._play.label == "Play")
        np.testing.assert_allclose(chart.xi(page.session.q), chart.xi(page.session.home), atol=1e-8)
        page._loop.ask("record", lambda: page._toggle_record(client))
        wait(lambda: "joints.csv" in files)
        (tmp_path / "joints.csv").write_bytes(files["joints.csv"])
        motion = read_joint_motion(tmp_path / "joints.csv", chart.problem.robot)
        np.testing.assert_allclose(motion.q[0], page.session.home, atol=1e-8)
        np.testing.assert_allclose(motion.q[-1], page.session.q, atol=1e-8)
    with pytest.raises(InvalidValueError, match="a chart to show"):
        oc.view(chart.problem.robot, path=[x, x], port=0)


def test_a_taken_port_is_named_and_a_closed_one_is_free() -> None:
    robot = fitted().chart.problem.robot
    with oc.view(robot, port=0) as view:
        port = urlsplit(view.url).port
        with pytest.raises(ViewError, match=f"port {port} of 127.0.0.1 is taken"):
            oc.view(robot, port=port)
        assert view.url in view._repr_html_()
        assert view._server.request_share_url() is None  # nothing goes to other machines
    oc.view(robot, port=port).close()


def test_motions_play_and_stop() -> None:
    run = trajectory()
    with oc.view(run, robot=fitted().chart, port=0) as view:
        page = view._page
        press(page._play)
        wait(lambda: page._now > 0.1)
        press(page._play)
        wait(lambda: page._play.label == "Play")
        page._loop.ask("jump", lambda: page._jump(float(run.times[-1])))
        wait(lambda: page._now == run.times[-1])
        assert f'data-value="{float(run.q[-1, 0])!r}"' in page._readings.content


def test_pages_are_written_whole_and_replace_only_their_own(tmp_path: Path) -> None:
    chart, path = fitted().chart, tmp_path / "page.html"
    motions = cyclic_motions(chart, cycles=1)
    for shown, robot in ((joint_motion(), chart), (motions, chart), (chart.problem.robot, None)):
        export_page(shown, path, robot=robot)
        assert b"__VISER_EMBED_DATA__" in path.read_bytes()
        assert path.stat().st_size < 2 * 2**20
    path.write_text("mine")
    with pytest.raises(ArchiveError, match="orthocas did not write the file"):
        export_page(chart, path)
    assert path.read_text() == "mine"


def test_a_page_shows_the_nearest_pair_and_red_ones_where_they_are_close(tmp_path: Path) -> None:
    link = '<box size="0.3 0.04 0.04"/>'
    robot = build_arm(tmp_path, ["", link, link, link]).with_tool([1.0, 0.0, 0.0])
    home = np.array([0.6, 0.8, 0.8])
    chart = oc.fit(oc.Problem(robot, oc.Task.position(robot, "xy"), "euclidean", oc.Box(home, 0.5)), oc.Linear()).chart
    place = robot.frame_position(home, "link2") + 0.8 * robot.frame_rotation(home, "link2")[:, 0]
    for gap, shown, close in ((0.2, "mm", 0), (0.03, "mm", 2), (0.0, "touch", 2)):
        aside = place + (0.02 + 0.05 + gap - 0.02) * robot.frame_rotation(home, "link2")[:, 1]
        scene = oc.Scene({"ball": oc.obstacles.Sphere(aside, 0.05), "floor": oc.obstacles.Plane([0, 0, 1], [0, 0, -5])})
        around = robot.collisions.with_scene(scene)
        with oc.view(chart, collisions=around, port=0) as view:
            page = view._page
            content = page._readings.content
            assert "nearest pair" in content
            assert "link2 and ball" in content
            assert shown in content
            assert len(page._contacts._nodes) == 1 + close
    with pytest.raises(InvalidValueError, match="a chart to show"):
        oc.view(robot, collisions=robot.collisions, port=0)
