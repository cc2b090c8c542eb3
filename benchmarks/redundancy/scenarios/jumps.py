"""Cartesian paths: how many does the arm follow without a jump?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import direction, moved, smooth, targets
from redundancy.protocol import Run, Scenario, Score, Stream

COUNT, LENGTH, TICKS = 8, 0.5, 200  # of the arm's size


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """Straight lines in random directions at constant orientation; some leave the reach of the arm."""
    start, found = arm.placement(arm.home), []
    for _ in range(4 if quick else COUNT):
        way = LENGTH * arm.size * direction(rng)
        found.append(Stream(arm.home, targets(arm, [moved(start, s * way, np.zeros(3)) for s in smooth(TICKS)])))
    return found


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Share of lines that are not followed to the end, with joints within their limits of position and velocity."""
    lost, jumped = ([not run.followed for run in runs], [not run.slow for run in runs])
    return Score(100 * float(np.mean(lost)), True, 100 * float(np.mean(jumped)))


SCENARIO = Scenario(
    "jumps",
    "Jitter and jumps along Cartesian paths",
    "lines not followed [%]",
    {
        "https://github.com/mani-skill/ManiSkill/issues/1207": "the arm on the right-hand side of the screen rotates "
        "the wrist and forearm roll joints 180 degrees opposite to one another, even though the same position could be "
        "achieved by rotating neither joint.",
        "https://github.com/moveit/moveit/issues/797": "I have stumbled on this IK jumps issue for a very long time "
        "before actually understanding what was happening.",
    },
    streams,
    judge,
    also="lines on which a joint exceeds its velocity limit [%]",
    least=1.0,
    percent=True,
    served="every method; a line is followed if the tip stays within 2 mm and 0.02 rad at 99 % of the ticks, and no "
    "joint leaves its limits of position and velocity",
)
