"""Views without a browser: panels, the loop, addresses, and refusals."""

import re
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from charts import linear_on_the_torus
from programs import Run
from public_objects import circle, fitted, joint_motion, trajectory

import orthocas as oc
from orthocas import problems
from orthocas.charts.point_quality import measure_held_speeds
from orthocas.errors import InvalidValueError, MissingExtraError, NoExpressionError, ViewError
from orthocas.tools import checks
from orthocas.viewer import Motion, export_page, window
from orthocas.viewer.panel import ChartPanel, PlayerPanel, RobotPanel, format_drift
from orthocas.viewer.session import Session
from orthocas.viewer.view import PlayerPage
from orthocas.viewer.window import Loop, is_local


def test_panels_hold_the_numbers_and_escape_names() -> None:
    chart = fitted().chart
    evil = "<img src=x onerror=alert(1)>"
    robot = oc.Robot(replace(chart.problem.robot.tree, joint_names=(evil, "b", "c")))
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=chart.problem.domain, name=evil)
    hostile = oc.fit(problem, oc.Linear()).chart
    readings = Session(hostile).readings
    motion = Motion(
        evil, np.arange(2.0), np.zeros((2, 3)), (evil,), np.zeros((2, 1)), np.ones((2, 1)), np.array([True] * 2)
    )
    pages = [
        ChartPanel(hostile).format_html(replace(readings, stop=evil)),
        RobotPanel(robot).format_html(readings.q),
        PlayerPanel(robot, [motion]).format_html(0.5),
        PlayerPanel(robot, [motion, replace(motion, cycles=(0.5,))]).format_html(0.5),
    ]
    for page in pages:
        assert "<img" not in page
    session = Session(chart)
    page = ChartPanel(chart).format_html(session.readings)
    shown = dict(re.findall(r'data-oc="([^"]+)" data-value="([^"]+)"', page))
    assert float(shown["drift"]) < 1e-12
    assert [float(shown[name]) for name in ("q1", "q2", "q3")] == session.q.tolist()
    quality = chart.quality(session.q)
    assert float(shown["conditioning"]) == float(quality.conditioning)
    assert float(shown["xi1"]) == quality.leak_deg[0]
    assert float(shown["boundary"]) == float(quality.boundary_distance)


class Plots:
    """A server whose plots can be looked at."""

    def __init__(self) -> None:
        self.gui, self.drawn = self, []  # type: ignore[var-annotated]

    def add_uplot(self, data, series, **words) -> None:  # type: ignore[no-untyped-def]
        self.drawn.append((data, [line["label"] for line in series], words["title"]))


def test_pages_of_runs_plot_commands_and_have_units() -> None:
    run, robot = trajectory(), oc.problems.get("planar_3r_xy").robot
    motion = Motion.of_run(run)
    page, server = object.__new__(PlayerPage), Plots()
    page._server = server
    page._plot_commands(robot, motion)
    ((data, labels, title),) = server.drawn
    assert (labels[1:], title) == (
        list(robot.joint_names),
        "command [N m]" if run.kind == "torque" else "command [rad/s]",
    )
    for k, drawn in enumerate(data[1:]):
        np.testing.assert_array_equal(drawn, np.interp(data[0], run.times - run.times[0], run.command[:, k]))
    assert f">{run.labels[0]} [m]<" in PlayerPanel(robot, [motion], {run.labels[0]: "m"}).format_html(0.0)


def test_panels_of_one_coordinate_show_what_holding_it_takes() -> None:
    chart = oc.fit(oc.problems.get("planar_3r_xy"), oc.Linear()).chart
    session = Session(chart, chart.problem.domain.centre + np.array([0.1, 0.3, -0.3]))
    page = ChartPanel(chart).format_html(session.readings)
    shown = dict(re.findall(r'data-oc="([^"]+)" data-value="([^"]+)"', page))
    J, q = chart.coordinates.jacobian(session.q[None]), np.tile(session.q, (2000, 1))
    speeds = measure_held_speeds(chart.problem, q, np.repeat(J, 2000, axis=0), 0)
    assert float(shown["speed to hold it"]) == pytest.approx(speeds.max(), rel=1e-4)
    assert speeds.max() > 1.001


def test_panels_of_charts_without_boundaries() -> None:
    chart = linear_on_the_torus()
    page = ChartPanel(chart).format_html(Session(chart, np.array([0.6, 0.8, 0.8])).readings)
    assert 'data-oc="boundary" data-value="inf"' in page


def test_panels_show_a_dash_for_what_has_no_value_and_units_with_the_rest() -> None:
    chart = fitted().chart
    readings = Session(chart).readings
    bare = replace(readings, q=np.full(3, np.nan), leak_deg=np.full(2, np.nan), conditioning=np.nan)
    page = ChartPanel(chart).format_html(bare)
    assert page.count(">-</b>") == 6
    assert "nan%" not in page
    page = ChartPanel(chart).format_html(readings)
    low = chart.problem.domain.half_width - np.abs(readings.q - chart.problem.domain.centre)
    assert f">{np.degrees(low.min()):.1f}°</b>" in page
    assert f"boundary q{np.argmin(low) + 1}" in page
    assert format_drift(np.array([3e-4, 2e-4, np.radians(0.5)]), ("m", "m", "rad")) == "300 µm, 0.5°"
    assert format_drift(np.array([0.0, 0.0]), ("m", "rad")) == "< 1 nm, < 0.001°"
    assert format_drift(np.array([0.02]), ("px",)) == "2e-02 px"


@pytest.mark.slow
def test_a_loop_does_the_last_of_several_wishes_and_settles_once() -> None:
    done: list[str] = []
    errors: list[Exception] = []
    hold, settled = threading.Event(), threading.Event()

    def settle() -> None:
        done.append("settled")
        settled.set()

    def fail() -> None:
        raise ValueError("no")

    loop = Loop(settle, errors.append)
    loop.start()
    loop.ask("first", lambda: (hold.wait(5), done.append("first"))[0] and None)
    time.sleep(0.05)
    for k in range(100):
        loop.ask("slider", lambda k=k: done.append(str(k)))  # type: ignore[misc]
    loop.ask("bad", fail)
    hold.set()
    assert settled.wait(5)
    ticks: list[float] = []
    loop.animate(lambda seconds: bool(ticks.append(seconds)) or len(ticks) < 5)
    time.sleep(0.4)
    loop.stop()
    assert done[:3] == ["first", "99", "settled"]
    assert [str(error) for error in errors] == ["no"]
    assert len(ticks) == 5
    assert ticks == sorted(ticks)


def test_addresses_that_cannot_be_opened_are_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ViewError, match=f"port {port} of 127.0.0.1 is taken, expected a free one; 0 finds one"):
            window.require_free("127.0.0.1", port)
    with pytest.raises(ViewError, match="host is '203.0.113.7', expected an address of this machine"):
        window.require_free("203.0.113.7", 0)
    with pytest.raises(ViewError, match="host is 'no such host', expected"):
        window.require_free("no such host", 0)
    with pytest.raises(InvalidValueError, match="port"):
        window.require_free("127.0.0.1", 70000)
    assert [is_local(host) for host in ("127.0.0.1", "::1", "localhost", "0.0.0.0")] == [True, True, True, False]
    assert window.build_url("0.0.0.0", 80) == "http://127.0.0.1:80"
    assert window.build_url("::1", 80) == "http://[::1]:80"


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(checks, "import_module", missing)
    with pytest.raises(MissingExtraError, match=re.escape("pip install 'orthocas[view]'")):
        oc.view(fitted().chart, port=0)


@pytest.mark.parametrize(
    ("shown", "error", "message"),
    [
        (3, InvalidValueError, "shown is a int, expected a chart"),
        ([], InvalidValueError, "shown is a list, expected a chart"),
        (circle, NoExpressionError, "received grown coordinates"),
        (trajectory, InvalidValueError, "robot is None, expected the robot that moved, or a chart of it"),
    ],
)
def test_what_cannot_be_shown_is_refused(shown: object, error: type[Exception], message: str, tmp_path: Path) -> None:
    thing = shown() if callable(shown) else shown
    with pytest.raises(error, match=message):
        oc.view(thing)
    with pytest.raises(error, match=message):
        export_page(thing, tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing.orthocas"], "nothing.orthocas"),
        (["a.orthocas", "--port", "99999"], "port is 99999, expected"),
        (["a.orthocas", "--port", "203.0.113.7:0"], "expected an address of this machine"),
        (["a.orthocas", "--path", "p.csv", "--export", "page.html"], "--path requires a live page of a chart"),
        (["iiwa", "--path", "p.csv"], "--path requires a live page of a chart"),
        (["q.csv"], "give --chart or --robot"),
        (["q.csv", "--chart", "other.orthocas"], "column 'A1' is missing"),
        (["iiwa", "--compare"], "--compare requires a chart file"),
        (["a.orthocas", "--export", "no/page.html"], "folder no does not exist"),
        (["a.orthocas", "--export", "a.orthocas"], "orthocas did not write the file"),
        (["a.orthocas", "--robot", "nothing.urdf", "--port", "0"], "cannot read URDF file nothing.urdf"),
    ],
)
def test_command_line_refusals(run: Run, words: list[str], message: str) -> None:
    fitted().chart.save("a.orthocas")
    oc.fit(problems.get("iiwa"), oc.Linear()).chart.save("other.orthocas")
    joint_motion().save_csv("q.csv")
    code, out, err = run("view", *words)
    assert (code, out) == (2, "")
    assert err.startswith("orthocas: ")
    assert message in err
    assert err.count("\n") == 1


def test_cameras_see_the_arm_in_pictures_of_every_shape() -> None:
    """The ball around the arm, projected by hand, is within the picture."""
    middle, radius = np.array([0.2, -0.1, 0.5]), 0.7
    direction, up = np.array([2.0, -2.0, 1.0]) / 3, np.array([0.0, 0.0, 1.0])
    frame = window.Framing(middle, direction, window.RULES.room * radius / np.sin(window.RULES.view_angle / 2))
    for width, height in ((1180, 900), (736, 768), (472, 800), (390, 422)):
        position, look_at = frame.compute_view(width, height)
        ahead = (look_at - position) / np.linalg.norm(look_at - position)
        right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
        axes = np.stack([right, np.cross(right, ahead), ahead])
        points = np.random.default_rng(7).normal(size=(500, 3))
        seen = (middle + radius * points / np.linalg.norm(points, axis=1)[:, None] - position) @ axes.T
        pixels = height / 2 / np.tan(window.RULES.view_angle / 2) * seen[:, :2] / seen[:, 2:]
        assert (np.abs(pixels) < np.array([width, height]) / 2).all()
