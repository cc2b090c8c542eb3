"""Turns of the tool: how far does it turn about its own axis?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import moved, smooth, targets
from redundancy.protocol import Run, Scenario, Score, Stream

TICKS, REST, TURN = 300, 20, 0.97 * np.pi  # of a turn one way; at the end of it; [rad]


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """About each axis of the tool, nearly half a turn to each side and back."""
    start, found = arm.placement(arm.home), []
    for axis in np.eye(3)[2:] if quick else np.eye(3):
        for sense in (-1.0, 1.0):
            way = sense * TURN * (start.rotation @ axis)
            out = [moved(start, np.zeros(3), s * way) for s in smooth(TICKS)]
            path = out + [out[-1]] * REST + out[::-1] + [start] * REST
            found.append(Stream(arm.home, targets(arm, path), known=False))
    return found


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Share of the ticks off the target; served: back on it at the end, within limits."""
    off = 100 * float(np.mean([1 - run.on_target.mean() for run in runs]))
    return Score(off, all(run.on_target[-1] and run.placed and run.slow for run in runs))


SCENARIO = Scenario(
    "turns",
    "Turns of the tool",
    "ticks off the target [%]",
    {
        "https://github.com/moveit/moveit2/issues/3480": "we faced a difficulty on having the axis to cross the "
        "[-PI, PI] frontier on any joint",
    },
    streams,
    judge,
    percent=True,
    served="the tip is back on its target after each turn, and all joints kept their limits of position and velocity",
)
