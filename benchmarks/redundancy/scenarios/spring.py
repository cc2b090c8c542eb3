"""A posture spring in the null space: does the arm get to its targets, or do joints end at their limits?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import between, targets
from redundancy.protocol import Run, Scenario, Score, Stream

COUNT, WAY, HOLD = 8, 150, 50  # targets; ticks
FAR, MARGIN = 1.0, 0.1  # of targets from home and from limits [rad]


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """Straight motions to the poses of random postures around home; the posture asked for is that of home."""
    found = []
    for _ in range(3 if quick else COUNT):
        q = np.clip(arm.home + rng.uniform(-FAR, FAR, arm.n), arm.lower + MARGIN, arm.upper - MARGIN)
        goal = arm.placement(q)
        path = between(arm.placement(arm.home), goal, WAY) + [goal] * HOLD
        found.append(Stream(arm.home, targets(arm, path), known=False))
    return found


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Share of targets where the arm does not end, and share of runs that end with a joint at its limit."""
    missed = [not (run.on_target[-1] and run.placed and run.slow) for run in runs]
    stuck = [bool((np.minimum(run.q[-1] - arm.lower, arm.upper - run.q[-1]) < 1e-2).any()) for run in runs]
    return Score(100 * float(np.mean(missed)), True, 100 * float(np.mean(stuck)))


SCENARIO = Scenario(
    "spring",
    "A posture spring, and joints at their limits",
    "targets missed [%]",
    {
        "https://github.com/isaac-sim/IsaacLab/pull/7862": "the null-space term cannot recentre the redundant joints "
        "once the task term drives them onto their limits.",
    },
    streams,
    judge,
    also="runs that end with a joint at its limit [%]",
    least=1.0,
    percent=True,
    served="every method; a target is missed where the tip ends 2 mm or 0.02 rad off, or a joint exceeds a limit",
)
