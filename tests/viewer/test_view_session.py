"""What a user's wishes do to a chart in a view: sliders, undo, home, and what a coordinate reaches."""

from collections.abc import Callable

import numpy as np
import pytest
from public_objects import circle, clear, cyclic, fitted

import orthocas as oc
from orthocas.charts.self_motion import fan_along
from orthocas.errors import InvalidValueError, NoExpressionError, UnknownNameError
from orthocas.fitting.fit import Fit
from orthocas.viewer.session import Session


def test_a_coordinate_moves_the_joints_and_holds_the_task(iiwa_fit: Fit) -> None:
    session = Session(iiwa_fit.chart)
    x, q = iiwa_fit.chart.x(session.q), session.q
    session.wish({"xi2": float(iiwa_fit.chart.xi(q)[1]) + 0.2})
    assert session.follow()
    moved = session.readings
    assert np.abs(session.q - q).max() > 0.05
    assert np.abs(iiwa_fit.chart.x(session.q) - x).max() < 1e-9
    assert (moved.drift < 1e-9).all()
    np.testing.assert_allclose(moved.xi - iiwa_fit.chart.xi(q), [0, 0.2, 0, 0], atol=1e-9)
    assert moved.stop == ""


def test_a_task_component_moves_alone(iiwa_fit: Fit) -> None:
    session = Session(iiwa_fit.chart)
    before = iiwa_fit.chart.phi(session.q)
    session.wish({"z": before[2] + 0.05})
    session.follow()
    np.testing.assert_allclose(iiwa_fit.chart.phi(session.q) - before, [0, 0, 0.05, 0, 0, 0, 0], atol=1e-9)
    assert (session.readings.drift < 1e-9).all()  # from where the task was wished to be


@pytest.mark.parametrize("end", [0, 1])
def test_a_slider_of_the_task_ends_where_its_component_ends(iiwa_fit: Fit, end: int) -> None:
    """What the range has is reached, and what is a centimetre beyond is not."""
    reach = Session(iiwa_fit.chart).find_reach(2)[end]
    for beyond, reached in ((0.0, True), (0.01, False)):
        session = Session(iiwa_fit.chart)
        session.wish({"z": reach + (2 * end - 1) * beyond})
        session.follow()
        missed = abs(session.readings.x[2] - reach - (2 * end - 1) * beyond)
        assert (missed < 1e-6) == reached


def test_a_wish_out_of_reach_ends_at_the_boundary_and_tells_the_joint() -> None:
    chart = fitted().chart
    session = Session(chart)
    reach = chart.xi_range(session.home)["xi1"]
    x = chart.x(session.home)
    session.wish({"xi1": reach.high + 5})
    session.follow()
    readings = session.readings
    stop = reach.high_stop
    assert readings.stop == f"joint '{stop.joint}' at {np.degrees(stop.value):.1f}°, the boundary of the domain"
    assert 0 <= reach.high - readings.xi[0] < 1e-2
    assert chart.problem.domain.contains(session.q)
    assert np.abs(chart.x(session.q) - x).max() < 1e-9
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
    with pytest.raises(InvalidValueError, match="target for xi1 is nan, expected a finite number"):
        session.wish({"xi1": np.nan})
    with pytest.raises(NoExpressionError):
        Session(circle())


@pytest.mark.parametrize("build", [lambda: fitted().chart, cyclic, clear])
def test_fans_reach_as_far_as_the_ranges_say(build: Callable[[], oc.Chart]) -> None:
    chart = build()
    home = chart.problem.domain.centre
    for k, reach in enumerate(chart.xi_range(home)):
        fan = fan_along(chart, home, k)
        assert np.abs(chart.x(fan.q) - chart.x(home)).max() < 1e-8
        if np.isfinite([reach.low, reach.high]).all():
            np.testing.assert_allclose([fan.xi[0], fan.xi[-1]], [reach.low, reach.high], atol=1e-9)
            assert (np.diff(fan.xi) > 0).all()
        assert fan.spread(7).shape == (7, chart.n)
        np.testing.assert_allclose(fan.spread(7)[[0, -1]], fan.q[[0, -1]], atol=1e-12)


@pytest.mark.slow
def test_a_mirrored_arm_holds_the_pose_within_its_joint_limits() -> None:
    chart = oc.charts.load("iiwa7-wide")
    robot = chart.problem.robot
    session = Session(chart)
    session.branches = oc.branches(robot, chart.problem.task)
    shoulder = next(cut for cut in session.branches.mirrors if session.branches.cuts[cut].part == "shoulder")
    before, name = session.q, session.branches.of(session.q)
    session.flip(shoulder)

    def arm() -> np.ndarray:
        return np.asarray(session.mirror(session.q[None])[0])

    assert (robot.lower <= arm()).all()
    assert (arm() <= robot.upper).all()
    np.testing.assert_allclose(robot.tip_position(arm()), robot.tip_position(before), atol=1e-6)
    np.testing.assert_allclose(robot.tip_rotation(arm()), robot.tip_rotation(before), atol=1e-6)
    found = session.branches.of(arm())
    assert name is not None
    assert found is not None
    assert name.name.split()[1:] == found.name.split()[1:]
    assert {name.name.split()[0], found.name.split()[0]} == {"shoulder-", "shoulder+"}
    assert session.place == f"mirrored: branch {found.name}"
    here = float(chart.xi(session.q)[0])
    for far in (here - 9.0, here + 9.0):  # beyond what the mirrored arm can reach
        session.wish({"xi1": far})
        session.follow()
        assert (robot.lower <= arm()).all()
        assert (arm() <= robot.upper).all()
        np.testing.assert_allclose(robot.tip_position(arm()), robot.tip_position(before), atol=1e-6)
    session.undo()
    assert session.flips == ()
    np.testing.assert_array_equal(session.q, before)
