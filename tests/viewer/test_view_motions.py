"""Motions that a view plays: files of runs and paths, and the comparison on a closed path."""

import re
from pathlib import Path

import numpy as np
import pytest
from public_objects import fitted, joint_motion, trajectory

from orthocas import problems
from orthocas.errors import InvalidValueError, PathError, PathFileError
from orthocas.fitting.fit import Fit
from orthocas.viewer import cyclic_motions
from orthocas.viewer.motion import read_joint_motion, read_run
from orthocas.viewer.view import read_subject


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


@pytest.mark.slow
def test_constant_coordinates_return_and_the_pseudo_inverse_drifts(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    ours, theirs = cyclic_motions(chart, cycles=2)
    for motion in (ours, theirs):
        x = chart.x(motion.q)
        assert np.abs(x - ours.values).max() < 1e-6  # both tools are on the path
        assert sorted(np.ptp(x, axis=0))[1] > 0.1  # a circle in one plane
    assert [k for k, _ in ours.returns(ours.duration)] == [1, 2]
    assert max(degrees for _, degrees in ours.returns(ours.duration)) < 1e-6
    assert theirs.returns(theirs.duration)[1][1] > theirs.returns(theirs.duration)[0][1] > 0.1
    assert ours.returns(1.0) == []
    assert np.abs(chart.xi(ours.q) - chart.xi(ours.q[0])).max() < 1e-8
    with pytest.raises(PathError, match="not closed"):
        cyclic_motions(chart, chart.x(chart.problem.domain.centre) + np.eye(3))
    far = chart.x(chart.problem.domain.centre) + 3 * np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]])
    with pytest.raises(PathError, match="with constant xi from point"):
        cyclic_motions(chart, far)


def test_motions_belong_to_their_robot() -> None:
    arm, motions = read_subject(trajectory(), fitted().chart)
    assert arm is fitted().chart.problem.robot
    assert len(motions) == 1
    with pytest.raises(InvalidValueError, match="joints of the motion is q1, q2, q3, expected"):
        read_subject(trajectory(), problems.get("iiwa").robot)
