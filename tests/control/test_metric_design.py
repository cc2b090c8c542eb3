"""The choice of a metric decides whether coordinates are exact (examples/metric_design.py)."""

import metric_design
import numpy as np
import pytest
from exact_tasks import LENGTHS, planar_4r

from orthocas import problems

pytestmark = pytest.mark.slow


def test_leak_vanishes_at_the_lengths_of_the_links_and_grows_with_the_distance_from_them() -> None:
    """The minimum that the search finds from equal weights."""
    arm, lengths = planar_4r(True), np.array(LENGTHS)
    at = [lengths, lengths * [1.0, 1.05, 1.0, 1.0], lengths * [1.0, 1.1, 1.0, 1.0], np.ones(4)]
    leaks = [metric_design.expected(metric_design.of_links(arm, weights), 100) for weights in at]
    assert leaks[0] < 1e-9
    assert leaks[2] == pytest.approx(2 * leaks[1], rel=0.1)
    assert leaks[3] > leaks[2]


def test_rotors_lower_the_leak() -> None:
    tip = problems.get("planar_3r_xy")
    none, some = (metric_design.expected(metric_design.with_rotors(tip, b), 100) for b in (0.0, 1.0))
    assert none == pytest.approx(metric_design.expected(tip, 100))
    assert some < 0.5 * none
