"""Demonstrations: can a policy learn the joints from the pose of the hand?"""

import numpy as np
import pinocchio as pin
from scipy.spatial.distance import cdist

from orthocas.tools.checks import Array
from redundancy.arms import Arm
from redundancy.paths import between, in_ball, targets
from redundancy.protocol import Run, Scenario, Score, Stream

COUNT, WAY, EVERY, LEFT_OUT = 14, 110, 5, 4  # demonstrations; ticks; between samples; one of so many is for the test
WIDTHS, RIDGE = (0.5, 1.0, 2.0, 4.0), 1e-6  # of the kernel; chosen for the smallest error, so the learner is no excuse


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """One long session: the hand goes from one random pose to the next."""
    path, last = [], arm.placement(arm.home)
    for _ in range(8 if quick else COUNT):
        goal = in_ball(arm, rng, 0.15, 0.4)
        path += between(last, goal, WAY)
        last = goal
    return [Stream(arm.home, targets(arm, path), known=False)]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Error of a kernel regression from the pose to the joints, on demonstrations that it has not seen."""
    run, start = runs[0], arm.placement(arm.home)
    poses = np.array([_features(arm, start, target.placement) for target in run.stream.targets])[::EVERY]
    joints, number = run.q[::EVERY], np.arange(0, len(run.q), EVERY) // WAY
    test = number % LEFT_OUT == LEFT_OUT - 1
    errors = [_learned(poses[~test], joints[~test], poses[test], width) - joints[test] for width in WIDTHS]
    return Score(min(float(np.degrees(np.sqrt((e**2).mean()))) for e in errors), run.followed)


def _features(arm: Arm, start: pin.SE3, placement: pin.SE3) -> Array:
    """Position in arm sizes / 0.15 and rotation / 0.4, both relative to home."""
    turn = pin.log3(placement.rotation @ start.rotation.T)
    return np.concatenate([(placement.translation - start.translation) / (0.15 * arm.size), turn / 0.4])


def _learned(x: Array, y: Array, at: Array, width: float) -> Array:
    """Gaussian kernel ridge regression about the mean."""
    kernel = np.exp(-cdist(x, x, "sqeuclidean") / (2 * width**2)) + RIDGE * np.eye(len(x))
    weights = np.linalg.solve(kernel, y - y.mean(axis=0))
    return np.asarray(np.exp(-cdist(at, x, "sqeuclidean") / (2 * width**2)) @ weights + y.mean(axis=0))


SCENARIO = Scenario(
    "demos",
    "Multi-modal demonstrations",
    "joint error of a policy learned from the demonstrations, rms [deg]",
    {
        "https://arxiv.org/abs/2606.29940": "Existing retargeting methods yield imprecise or inconsistent solutions, "
        "causing action multi-modality that prevents supervised policies from reliably converging.",
    },
    streams,
    judge,
    least=0.05,
)
