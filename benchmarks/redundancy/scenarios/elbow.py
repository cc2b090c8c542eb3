"""A number for the elbow: how far is the elbow from the angle that was asked for, while the tool moves?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import wandering
from redundancy.protocol import Run, Scenario, Score, Stream, Target

TICKS, SWING = 600, 0.3  # [rad]


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """A slow random motion of the tip, and an angle of the elbow that swings on its own.

    Methods that take a posture get the one at home that has this angle: what a user can record.
    """
    count = TICKS // 3 if quick else TICKS
    angles = SWING * np.sin(2 * np.pi * np.arange(1, count + 1) / TICKS * 2)
    path = wandering(arm, rng, count, 0.1, 0.2)
    return [Stream(arm.home, [Target(x, arm.with_elbow(a), float(a)) for x, a in zip(path, angles, strict=True)])]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Root mean square error of the elbow's angle."""
    error = np.concatenate([[arm.elbow(q) - t.elbow for q, t in zip(r.q, r.stream.targets, strict=True)] for r in runs])
    wrapped = (error + np.pi) % (2 * np.pi) - np.pi
    return Score(float(np.degrees(np.sqrt((wrapped**2).mean()))), all(run.followed for run in runs))


SCENARIO = Scenario(
    "elbow",
    "The elbow by number",
    "error of the elbow's angle, rms [deg]",
    {
        "https://github.com/xArm-Developer/xArm-Python-SDK/issues/45": "Is there any way I can bias the IK solution "
        "to a desired elbow configuration?",
        "https://github.com/lbr-stack/lbr_fri_ros2_stack/issues/179": "due to the multiple degrees of freedom, there "
        "is a problem in that the pose changes each time it is executed",
    },
    streams,
    judge,
    least=0.1,
)
