"""Views without a browser: what a user's wishes do to a chart, how robots look, motions, comparison, refusals."""

import re
import shutil
import socket
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from charts import linear_on_the_torus
from conftest import robot_data
from programs import Run
from public_objects import circle, clear, cyclic, fitted, joint_motion, trajectory

import orthocas as oc
from orthocas import checks, problems
from orthocas.errors import (
    InvalidValueError,
    MissingExtraError,
    NoExpressionError,
    PathError,
    PathFileError,
    RobotError,
    UnknownNameError,
    ViewError,
)
from orthocas.fitting.fit import Fit
from orthocas.reaching.fan import fan_along
from orthocas.robots.files import lock_off_chain, read_urdf
from orthocas.viewing import Motion, cyclic_motions, export_page, window
from orthocas.viewing.body_poses import BodyPoses
from orthocas.viewing.loop import Loop
from orthocas.viewing.motion import read_joint_motion, read_run
from orthocas.viewing.panel import ChartPanel, PlayerPanel, RobotPanel
from orthocas.viewing.session import Session
from orthocas.viewing.solids import ball, block, capsule, drum
from orthocas.viewing.stick_arm import stick_arm
from orthocas.viewing.urdf_look import urdf_look
from orthocas.viewing.view import shape_of, subject


def test_a_coordinate_moves_the_joints_and_holds_the_task(iiwa_fit: Fit) -> None:
    session = Session(iiwa_fit.chart)
    x, q = iiwa_fit.chart.task(session.q), session.q
    session.wish({"xi2": float(iiwa_fit.chart.xi(q)[1]) + 0.2})
    assert session.follow()
    moved = session.readings
    assert np.abs(session.q - q).max() > 0.05
    assert np.abs(iiwa_fit.chart.task(session.q) - x).max() < 1e-9
    assert moved.drift < 1e-9
    np.testing.assert_allclose(moved.xi - iiwa_fit.chart.xi(q), [0, 0.2, 0, 0], atol=1e-9)
    assert moved.stop == ""


def test_a_task_component_moves_alone(iiwa_fit: Fit) -> None:
    session = Session(iiwa_fit.chart)
    before = iiwa_fit.chart.phi(session.q)
    session.wish({"z": before[2] + 0.05})
    session.follow()
    np.testing.assert_allclose(iiwa_fit.chart.phi(session.q) - before, [0, 0, 0.05, 0, 0, 0, 0], atol=1e-9)
    assert session.readings.drift < 1e-9  # from where the task was wished to be


def test_a_wish_out_of_reach_ends_at_the_border_and_tells_the_joint() -> None:
    chart = fitted().chart
    session = Session(chart)
    reach = chart.xi_range(session.home)["xi1"]
    x = chart.task(session.home)
    session.wish({"xi1": reach.high + 5})
    session.follow()
    readings = session.readings
    assert readings.stop == str(reach.high_stop)
    assert 0 <= reach.high - readings.xi[0] < 1e-2
    assert chart.problem.domain.contains(session.q)
    assert np.abs(chart.task(session.q) - x).max() < 1e-9
    session.wish({"xi1": reach.here})
    assert session.follow()
    np.testing.assert_allclose(session.q, session.home, atol=1e-8)
    assert session.readings.stop == ""


def test_undo_and_home_return() -> None:
    session = Session(fitted().chart)
    places = [session.q]
    for value in (0.05, 0.1):
        session.remember()
        session.wish({"xi1": float(session.readings.xi[0]) + value})
        session.follow()
        places.append(session.q)
    session.go_home()
    for place in (places[2], places[1], places[0]):
        session.undo()
        np.testing.assert_array_equal(session.q, place)
    assert not session.can_undo
    session.undo()
    np.testing.assert_array_equal(session.q, places[0])


def test_wishes_are_checked() -> None:
    session = Session(fitted().chart)
    with pytest.raises(UnknownNameError, match="unknown component of phi 'xi9', known: x, xi1, xi2"):
        session.wish({"xi9": 0.0})
    with pytest.raises(InvalidValueError, match="wish for xi1 is nan, expected a finite number"):
        session.wish({"xi1": np.nan})
    with pytest.raises(NoExpressionError):
        Session(circle())


@pytest.mark.parametrize("build", [lambda: fitted().chart, cyclic, clear])
def test_fans_reach_as_far_as_the_ranges_say(build: Callable[[], oc.Chart]) -> None:
    chart = build()
    home = chart.problem.domain.centre
    for k, reach in enumerate(chart.xi_range(home)):
        fan = fan_along(chart, home, k)
        assert np.abs(chart.task(fan.q) - chart.task(home)).max() < 1e-8
        if np.isfinite([reach.low, reach.high]).all():
            np.testing.assert_allclose([fan.xi[0], fan.xi[-1]], [reach.low, reach.high], atol=1e-9)
            assert (np.diff(fan.xi) > 0).all()
        assert fan.spread(7).shape == (7, chart.n)
        np.testing.assert_allclose(fan.spread(7)[[0, -1]], fan.q[[0, -1]], atol=1e-12)


def test_body_poses_are_those_of_pinocchio() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(path, "panda_hand")
    q = np.linspace(-0.6, 0.3, 7)
    positions, quaternions = BodyPoses(robot.tree)(np.array([q, 0 * q]))
    np.testing.assert_allclose(positions[0, 1:], robot.joint_points(q)[1:], atol=1e-12)
    expected = pin.Quaternion(robot.tip_rotation(q)).coeffs()[[3, 0, 1, 2]]
    np.testing.assert_allclose(quaternions[0, -1] * np.sign(quaternions[0, -1] @ expected), expected, atol=1e-12)
    np.testing.assert_allclose(quaternions[:, 0], [[1, 0, 0, 0]] * 2)


def test_meshes_are_where_pinocchio_places_them() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(path, "panda_hand")
    found = urdf_look(path, robot.tree)
    assert found.missing == ()
    q = np.array([0.3, -0.4, 0.5, -1.2, 0.2, 1.0, -0.7])
    positions, quaternions = BodyPoses(robot.tree)(q[None])
    model = lock_off_chain(read_urdf(path), "panda_hand")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pinocchio imports what it deprecates itself
        geometry = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.VISUAL, str(path.parents[4]))
    data, placed = model.createData(), geometry.createData()
    pin.updateGeometryPlacements(model, data, geometry, placed, q)
    lows = []
    for pose, thing in zip(placed.oMg, geometry.geometryObjects, strict=True):
        corners = np.array(thing.geometry.vertices()) @ pose.rotation.T + pose.translation
        lows.append(np.concatenate([corners.min(axis=0), corners.max(axis=0)]))
    ours = []
    for i, solids in enumerate(found.look):
        turn = pin.Quaternion(*quaternions[0, i]).matrix()
        for solid in solids:
            corners = solid.vertices @ turn.T + positions[0, i]
            ours.append(np.concatenate([corners.min(axis=0), corners.max(axis=0)]))
    assert len(ours) == len(lows) > 8
    for box in ours:
        assert np.abs(np.array(lows) - box).max(axis=1).min() < 1e-6


def test_rods_stand_for_links_whose_meshes_are_missing(tmp_path: Path) -> None:
    whole = robot_data("panda_description/urdf/panda.urdf")
    lonely = tmp_path / "panda.urdf"
    shutil.copy(whole, lonely)
    robot = oc.Robot.from_urdf(lonely, "panda_hand")
    shape = shape_of(robot, lonely, None)
    assert len(shape.missing) > 8
    assert shape.missing[0].endswith(".dae")
    assert [len(part) for part in shape.look] == [len(part) for part in stick_arm(robot.tree)]


def test_shapes_of_urdf_are_drawn_at_their_origins(tmp_path: Path) -> None:
    text = """<robot name="r"><material name="blue"><color rgba="0 0 1 1"/></material><link name="a"><visual>
    <geometry><box size="1 2 3"/></geometry></visual></link>
    <link name="b"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="1 0 0" rpy="0 0 0"/><geometry><sphere radius="0.5"/></geometry><material name="blue"/></visual>
    <visual><geometry><cylinder radius="0.1" length="2"/></geometry><material name="nothing"/></visual></link>
    <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
    path = tmp_path / "r.urdf"
    path.write_text(text)
    robot = oc.Robot.from_urdf(path)
    look = urdf_look(path, robot.tree).look
    np.testing.assert_allclose(np.ptp(look[0][0].vertices, axis=0), [1, 2, 3])
    sphere, cylinder = look[1]
    assert sphere.colour == (0, 0, 255)
    turn = BodyPoses(robot.tree)(np.zeros((1, 1)))[1][0, 1]
    R = pin.Quaternion(*turn).matrix()
    np.testing.assert_allclose((sphere.vertices @ R.T).mean(axis=0), [1, 0, 0], atol=0.02)
    np.testing.assert_allclose(np.ptp(cylinder.vertices @ R.T, axis=0), [0.2, 0.2, 2], atol=1e-3)
    other = oc.Robot.planar([1, 1], [1, 1])
    with pytest.raises(RobotError, match=r"has the joints j, expected q1, q2|unknown frame"):
        urdf_look(path, replace(other.tree, tip_name="b"))


@pytest.mark.parametrize(
    "solid", [drum(0.3, 0.2, (0, 0, 0)), ball(0.5, (0, 0, 0)), block([1, 2, 3], (0, 0, 0)),
              capsule(np.ones(3), np.array([1.0, 2, 0]), (0.2, 0.1), (0, 0, 0))]
)  # fmt: skip
def test_solids_are_closed_and_seen_from_outside(solid: object) -> None:
    """The volume that the triangles enclose is positive, and close to that of the shape."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))  # type: ignore[attr-defined]
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    middle = (a + b + c).mean(axis=0) / 3
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - middle)
    assert volume > 0
    assert (outward > -1e-9).all()


def test_runs_and_paths_are_played_from_their_files(tmp_path: Path) -> None:
    chart, run, motion = fitted().chart, trajectory(), joint_motion()
    run.save(tmp_path / "run.npz")
    motion.save_csv(tmp_path / "q.csv")
    played = read_run(tmp_path / "run.npz", chart.problem.robot)
    np.testing.assert_array_equal(played.at(float(run.times[3] - run.times[0])), run.q[3])
    along = read_joint_motion(tmp_path / "q.csv", chart.problem.robot)
    assert along.labels == motion.labels
    np.testing.assert_allclose(along.q, motion.q)
    np.testing.assert_allclose(along.values, np.hstack([motion.x, motion.xi]))
    middle = (along.times[1] + along.times[2]) / 2
    np.testing.assert_allclose(along.at(middle), (motion.q[1] + motion.q[2]) / 2)
    assert along.index(middle) == 1
    with pytest.raises(InvalidValueError, match=re.escape("joints of")):
        read_run(tmp_path / "run.npz", problems.get("iiwa").robot)


BROKEN = {
    "": "it has 0 instants after the header",
    "time_s,q1,q2\n0,1,2\n1,1,2\n": "column 'q3' is missing",
    "time_s,q1,q2,q3\n0,1,2,3\n0,1,2,3\n": "time_s does not increase",
    "time_s,q1,q2,q3\n0,1,2,3\n1,1,2\n": "line 3: 3 numbers, expected 4 as in the header",
    "time_s,q1,q2,q3\n0,1,2,nan\n1,1,2,3\n": "line 2: q3 is 'nan', expected a number",
    "time_s,q1,q1,q3\n0,1,2,3\n1,1,2,3\n": "column 'q1' comes twice",
}


@pytest.mark.parametrize("text", BROKEN)
def test_broken_motion_files_are_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "q.csv"
    path.write_text(text)
    with pytest.raises(PathFileError, match=re.escape(BROKEN[text])):
        read_joint_motion(path, fitted().chart.problem.robot)


def test_constant_coordinates_return_and_the_pseudo_inverse_drifts(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    ours, theirs = cyclic_motions(chart, cycles=2)
    for motion in (ours, theirs):
        x = chart.task(motion.q)
        assert np.abs(x - ours.values).max() < 1e-6  # both tools are on the path
        assert np.ptp(x, axis=0)[:2].min() > 0.1
    assert [k for k, _ in ours.returns(ours.duration)] == [1, 2]
    assert max(degrees for _, degrees in ours.returns(ours.duration)) < 1e-6
    assert theirs.returns(theirs.duration)[1][1] > theirs.returns(theirs.duration)[0][1] > 0.1
    assert ours.returns(1.0) == []
    assert np.abs(chart.xi(ours.q) - chart.xi(ours.q[0])).max() < 1e-8
    with pytest.raises(PathError, match="not closed"):
        cyclic_motions(chart, chart.task(chart.problem.domain.centre) + np.eye(3))
    far = chart.task(chart.problem.domain.centre) + 3 * np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]])
    with pytest.raises(PathError, match="with constant xi from point"):
        cyclic_motions(chart, far)


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
        ChartPanel(hostile).html(replace(readings, stop=evil)),
        RobotPanel(robot).html(readings.q),
        PlayerPanel(robot, [motion]).html(0.5),
        PlayerPanel(robot, [motion, replace(motion, cycles=(0.5,))]).html(0.5),
    ]
    for page in pages:
        assert "<img" not in page
    session = Session(chart)
    page = ChartPanel(chart).html(session.readings)
    shown = dict(re.findall(r'data-oc="([^"]+)" data-value="([^"]+)"', page))
    assert float(shown["drift"]) < 1e-12
    assert [float(shown[name]) for name in ("q1", "q2", "q3")] == session.q.tolist()
    quality = chart.quality(session.q)
    assert float(shown["conditioning"]) == float(quality.conditioning)
    assert float(shown["xi1"]) == quality.leak_deg[0]
    assert float(shown["border"]) == float(quality.border_distance)


def test_panels_of_charts_without_borders() -> None:
    chart = linear_on_the_torus()
    page = ChartPanel(chart).html(Session(chart, np.array([0.6, 0.8, 0.8])).readings)
    assert 'data-oc="border" data-value="inf"' in page


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
    assert [window.is_local(host) for host in ("127.0.0.1", "::1", "localhost", "0.0.0.0")] == [True, True, True, False]
    assert window.url_of("0.0.0.0", 80) == "http://127.0.0.1:80"
    assert window.url_of("::1", 80) == "http://[::1]:80"


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


def test_motions_belong_to_their_robot() -> None:
    arm, motions = subject(trajectory(), fitted().chart)
    assert arm is fitted().chart.problem.robot
    assert len(motions) == 1
    with pytest.raises(InvalidValueError, match="joints of the motion is q1, q2, q3, expected"):
        subject(trajectory(), problems.get("iiwa").robot)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing.orthocas"], "nothing.orthocas"),
        (["a.orthocas", "--port", "99999"], "port is 99999, expected"),
        (["a.orthocas", "--host", "203.0.113.7"], "expected an address of this machine"),
        (["a.orthocas", "--path", "p.csv"], "--path is p.csv, expected --compare as well"),
        (["q.csv"], "--chart is missing, expected --chart or --robot"),
        (["q.csv", "--chart", "other.orthocas"], "column 'A1' is missing"),
        (["iiwa", "--compare"], "--compare is given, expected a chart file"),
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
