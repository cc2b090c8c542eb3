"""Long teleoperation: does the elbow stay where the operator had it?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import wandering
from redundancy.protocol import Run, Scenario, Score, Stream, Target

TICKS = 1000


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """A smooth random motion of the hand that never repeats itself. The elbow is wanted at its angle at home, 0."""
    path = wandering(arm, rng, TICKS // 3 if quick else TICKS, 0.15, 0.4)
    return [Stream(arm.home, [Target(x, arm.home, 0.0) for x in path], known=False)]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """How far the elbow turns from its angle at the beginning, rms, over the whole run."""
    angles = np.array([arm.elbow(q) for q in runs[0].q])
    return Score(float(np.degrees(np.sqrt((angles**2).mean()))), runs[0].followed)


SCENARIO = Scenario(
    "teleop",
    "The elbow bends unnaturally in teleoperation",
    "elbow's angle away from that at the beginning, rms [deg]",
    {
        "https://github.com/enactic/openarm/issues/308": "redundant degrees of freedom cannot be defined, which has "
        "frequently resulted in the arm's elbow bending unnaturally during extended operation.",
    },
    streams,
    judge,
    least=0.1,
)
