"""Strong pushes on the 7-DoF arm in MuJoCo, against the compiled supervised law."""

import pytest
from charts import with_metric
from programs import needs_c

import orthocas as oc

pytest.importorskip("mujoco", reason="the extra sim is not installed")

import safety

pytestmark = [needs_c, pytest.mark.slow]


def test_pushed_arms_slow_down_come_to_rest_and_come_back(iiwa: oc.Problem) -> None:
    chart = oc.fit(with_metric(iiwa, "inertia"), oc.Polynomial(2), weights=(1000, 30, 150, 1)).chart
    found = safety.pushes(chart, 3)
    assert any(push.caught for push in found)
    for push in found:
        assert push.slow_after <= 0.5
        assert push.rest_after <= 2.0
        assert push.change <= 1.0 + 1e-9  # N m in a millisecond
        assert push.back_after < 60.0
