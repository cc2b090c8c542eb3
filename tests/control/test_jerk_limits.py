"""References within limits of velocity, acceleration and jerk."""

import sys

import numpy as np
import pytest

from orthocas.control import Reference
from orthocas.errors import InvalidValueError, MissingExtraError, ShapeError

pytest.importorskip("ruckig")
LABELS = ("x", "xi1")
POINTS = np.array([[0.0, 0.5], [0.4, 0.1], [0.4, 0.3]])
LIMITS = {"velocity": [0.5, 1.0], "acceleration": [1.0, 2.0], "jerk": [8.0, 10.0]}


def test_the_way_keeps_its_limits_and_rests_at_the_points() -> None:
    reference = Reference.jerk_limited(LABELS, POINTS, **LIMITS, pause=0.2)
    times = np.linspace(0, reference.duration, 20_001)
    value, velocity, acceleration = reference.sample(times)
    step = times[1]
    for measured, limit in ((velocity, "velocity"), (acceleration, "acceleration")):
        assert (np.abs(measured).max(axis=0) <= np.array(LIMITS[limit]) + 1e-9).all()
    jerk = np.diff(acceleration, axis=0) / step
    assert (np.abs(jerk).max(axis=0) <= np.array(LIMITS["jerk"]) + 1e-6).all()  # so accelerations do not jump
    # The velocity is the derivative of the value, and the acceleration that of the velocity.
    np.testing.assert_allclose(np.gradient(value, step, axis=0)[5:-5], velocity[5:-5], atol=1e-3)
    np.testing.assert_allclose(np.gradient(velocity, step, axis=0)[5:-5], acceleration[5:-5], atol=1e-2)
    np.testing.assert_allclose(value[0], POINTS[0], atol=1e-9)
    np.testing.assert_allclose(value[-1], POINTS[-1], atol=1e-9)
    resting = np.abs(velocity).max(axis=1) < 1e-9
    np.testing.assert_allclose(value[resting & (times > 0.1) & (times < reference.duration - 0.3)][0], POINTS[1])


def test_a_long_way_takes_the_time_of_the_closed_form() -> None:
    """With v reached and a not: s / v + v / a + a / j for a trapezoid of acceleration."""
    reference = Reference.jerk_limited(["x"], [[0.0], [10.0]], velocity=1.0, acceleration=2.0, jerk=10.0)
    assert reference.duration == pytest.approx(10 / 1 + 1 / 2 + 2 / 10, abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"points": [[0.0, 0.0]]}, InvalidValueError),
        ({"points": [[0.0, 0.0], [0.0, 0.0]]}, InvalidValueError),
        ({"points": [[0.0, 0.0], [1e300, 0.0]]}, InvalidValueError),
        ({"velocity": 1e-300}, InvalidValueError),
        ({"velocity": 0.0}, InvalidValueError),
        ({"jerk": [1.0, np.inf]}, InvalidValueError),
        ({"acceleration": [1.0, 1.0, 1.0]}, ShapeError),
        ({"pause": -1.0}, InvalidValueError),
    ],
)
def test_what_is_no_way_is_refused(changes: dict[str, object], error: type[Exception]) -> None:
    with pytest.raises(error):
        Reference.jerk_limited(LABELS, **({"points": POINTS} | LIMITS | changes))


def test_without_ruckig_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(MissingExtraError, match=r"orthocas\[jerk\]"):
        Reference.jerk_limited(LABELS, POINTS, **LIMITS)
