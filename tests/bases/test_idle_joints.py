"""Joints that do not move the task, up to the rounding of angles in robot files: fits, wide fits and boxes."""

import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import Run, robot_data
from programs import nightly

import orthocas as oc
from orthocas.errors import BranchWarning
from orthocas.fitting.probe import Bounds, Quality
from orthocas.tasks.samples import NEGLIGIBLE

TASK = "position+axis:z"
UR5 = "ur_description/urdf/ur5_robot.urdf"


def rounded(folder: Path, decimals: int) -> Path:
    """A ur5 whose angles have so many decimals: its last joint tilts the axis that it turns about."""
    path = folder / "ur5.urdf"
    text = robot_data(UR5).read_text()
    angle = re.compile(r"\d+\.\d{6,}")
    path.write_text(
        re.sub(r'rpy="[^"]*"', lambda rpy: angle.sub(lambda a: f"{float(a[0]):.{decimals}f}", rpy[0]), text)
    )
    return path


@pytest.fixture(params=[11, *nightly(9)])
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> oc.Robot:
    return oc.Robot.from_urdf(rounded(tmp_path, request.param), "tool0")


def tilt(robot: oc.Robot) -> float:
    """How far one turn of the last joint moves the axis, by the rotations alone."""
    q = robot.tree.centre_posture
    axes = [robot.tip_rotation(q + turn * np.eye(6)[5])[:, 2] for turn in np.linspace(0, 6, 7)]
    return float(np.ptp(axes, axis=0).max())


def test_fit_is_the_joint_itself(robot: oc.Robot) -> None:
    assert 0 < tilt(robot) < NEGLIGIBLE
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = oc.fit(oc.Problem(robot, oc.Task.named(robot, TASK)))
    assert fit.idle_joints == ("wrist_3_joint",)
    assert oc.evaluate(fit.chart, 500).leak.rms < np.degrees(10 * NEGLIGIBLE)


def test_coarser_angles_are_no_rounding(tmp_path: Path) -> None:
    """1.5708 tilts the axis by 4e-6: joint 6 moves the task, if little."""
    coarse = oc.Robot.from_urdf(rounded(tmp_path, 4), "tool0")
    assert tilt(coarse) > NEGLIGIBLE
    assert oc.fit(oc.Problem(coarse, oc.Task.named(coarse, TASK)), oc.Polynomial(1), samples=200).idle_joints == ()


@pytest.mark.slow
def test_wide_fit_is_the_joint_itself_on_all_of_its_side_of_the_branch(robot: oc.Robot) -> None:
    """Polynomials in all joints leaked by 60 deg. Along xi, position and axis stay, by the kinematics alone."""
    with pytest.warns(BranchWarning, match="singular positions divide it, so the chart has one side"):
        fit = oc.fit_wide(robot, oc.Task.named(robot, TASK))
    assert fit.idle_joints == ("wrist_3_joint",)
    assert 0.4 < fit.regular_share < 0.6
    assert oc.evaluate(fit.chart, 500).leak.rms < np.degrees(10 * NEGLIGIBLE)
    q = fit.chart.problem.domain.centre
    moved = fit.chart.inverse(fit.chart.phi(q) + 0.5 * np.eye(6)[5], q)
    np.testing.assert_allclose(moved - q, 0.5 * np.eye(6)[5], atol=1e-7)


@pytest.mark.slow
def test_widest_box_of_an_exact_coordinate_ends_at_singular_postures_of_the_task(robot: oc.Robot) -> None:
    """It was refused for a leak of nan deg and a conditioning of -1, with warnings of NumPy."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = oc.suggest_domain(robot, oc.Task.named(robot, TASK))
    reasons = {joint.joint: joint.reason for joint in found.joints}
    assert reasons["wrist_3_joint"] == "idle"
    assert {reasons[name] for name in ("elbow_joint", "wrist_2_joint")} == {"singularity"}
    low, high = found.domain.centre - found.domain.half_width, found.domain.centre + found.domain.half_width
    for k in (2, 4):  # elbow straight, and the wrist's axes in line: det of the other joints' columns is 0
        assert low[k] * high[k] > 0
    assert (found.leak_deg, found.conditioning) == (0.0, pytest.approx(1.0))


def test_info_names_them(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("info", str(rounded(tmp_path, 9)), "--json")
    assert code == 0
    assert json.loads(out)["extra_coordinates"]["position"] == "r = 3, idle: wrist_3_joint"


def test_folds_are_no_negative_conditioning() -> None:
    quality = Quality(1.0, -0.395, np.zeros(2), 1.0, 1.0)
    bounds = Bounds(8.0, 0.2)
    assert next(iter(quality.excess(bounds))) == "conditioning"
    words = quality.explained("conditioning", bounds)
    assert words == "a trial chart folds over (det J changes its sign), expected a conditioning of at least 0.2"
    kept = Quality(1.0, 0.1, np.zeros(2), 1.0, 1.0).explained("conditioning", bounds)
    assert kept == "a trial chart has a conditioning of 0.1, expected a conditioning of at least 0.2"
