"""Self-motions against ssik's closed form, where it is installed: every posture of its charts is on an arc."""

import numpy as np
import pytest

import orthocas as oc
from orthocas.problems import urdf_path
from orthocas.tools.checks import Array

POSES, SAMPLES, SAME = 6, 12, 1e-5  # poses; postures on an arc of ssik; [rad], as exact as its folds are


@pytest.mark.nightly
def test_postures_of_ssik_are_on_arcs_and_ends_agree() -> None:
    ssik, _ = (pytest.importorskip(name) for name in ("ssik", "urchin"))
    with urdf_path() as path:
        robot = oc.Robot.from_urdf(path, tip="link_ee")
        ik = ssik.Manipulator.from_urdf(path, base="link_0", ee="link_ee")
    arm = oc.Arm(oc.Task.pose(robot))
    for q in robot.sample(POSES, seed=1):
        motions, ends = arm.self_motion(robot.pose(q)), 0
        own_ends = np.array([arc.at([0.0, arc.length]) for arc in motions if not arc.closed]).reshape(-1, robot.n)
        for chart in ik.self_motion(np.asarray(robot.pose(q))).charts:
            for low, high in chart.in_limits():
                for posture in wrap(chart.q(np.linspace(low, high, SAMPLES)), robot):
                    assert motions.nearest(posture).value < SAME
                for end in wrap(chart.q(np.array([low, high])), robot):
                    at_limit = np.minimum(end - robot.lower, robot.upper - end).min() < 1e-6
                    if at_limit and high - low > 1e-3:
                        assert np.linalg.norm(own_ends - end, axis=1).min() < SAME
                        ends += 1
        assert ends > 0


def wrap(q: Array, robot: oc.Robot) -> Array:
    """The representatives within the limits, of those that exist."""
    q = q[np.isfinite(q).all(axis=1)]
    centre = (robot.lower + robot.upper) / 2
    return np.asarray(np.clip(q - 2 * np.pi * np.round((q - centre) / (2 * np.pi)), robot.lower, robot.upper))
