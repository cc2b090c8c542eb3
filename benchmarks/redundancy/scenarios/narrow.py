"""Narrow limits: does the tool go on where joints run along their limits?"""

import numpy as np

from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.paths import smooth
from redundancy.protocol import Run, Scenario, Score, Stream, Target

COUNT, REST = 4, 20
BEYOND, HELD = 0.3, 2  # of the way to a limit that the motion would go beyond it; joints that are held there
FAST = 0.5  # of the limits of velocity, which the fastest joint has


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """Poses of a joint motion from home of which some joints come to their limits, rest there, and come back."""
    return [_stream(arm, rng) for _ in range(2 if quick else COUNT)]


def _stream(arm: Arm, rng: np.random.Generator) -> Stream:
    middle, half = (arm.lower + arm.upper) / 2, (arm.upper - arm.lower) / 2
    end = np.clip(arm.home + rng.uniform(-0.5, 0.5, arm.n) * half, arm.lower, arm.upper)
    held = rng.choice(arm.n, HELD, replace=False)
    # Those that are to come to a limit go to the nearer one, and would go beyond it.
    side = np.where(arm.home > middle, 1.0, -1.0)
    room = np.abs(middle + side * half - arm.home)
    end[held] = (arm.home + side * (1 + BEYOND) * room)[held]
    longest = float((np.abs(end - arm.home) / arm.fastest).max())
    ticks = int(np.ceil(1.875 * longest / (FAST * TICK)))  # 1.875 is the greatest slope of `smooth`
    way = [np.clip(arm.home + s * (end - arm.home), arm.lower, arm.upper) for s in smooth(ticks)]
    path: list[Array] = [*way, *[way[-1]] * REST, *way[::-1], *[arm.home] * REST]
    return Stream(arm.home, [Target(arm.placement(q), arm.home) for q in path], known=False)


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Share of motions that are not followed."""
    return Score(100 * float(np.mean([not run.followed for run in runs])), True)


SCENARIO = Scenario(
    "narrow",
    "Joints at their limits",
    "motions to joint limits not followed [%]",
    {
        "https://github.com/personalrobotics/ssik/issues/359": "reachable in-limits poses can return [] on tight-limit "
        "redundant 7R",
    },
    streams,
    judge,
    percent=True,
    served="the method ran",
)
