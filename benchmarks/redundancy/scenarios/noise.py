"""Noise on targets: how much of the hand's tremor do the joints make of it?"""

import numpy as np

from redundancy.arms import TICK, Arm
from redundancy.paths import moved, targets
from redundancy.protocol import Run, Scenario, Score, Stream

TICKS, TREMOR, TURNED = 300, 3e-4, 1e-3  # of the hand [m], [rad]


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """The hand rests at home and trembles."""
    noise = np.zeros((TICKS, 6))
    for k in range(1, TICKS):
        noise[k] = 0.8 * noise[k - 1] + 0.6 * rng.normal(size=6)
    start = arm.placement(arm.home)
    return [Stream(arm.home, targets(arm, [moved(start, TREMOR * v[:3], TURNED * v[3:]) for v in noise]), known=False)]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Mean speed of the fastest joint."""
    run = runs[0]
    return Score(float(np.abs(np.diff(run.q, axis=0)).max(axis=1).mean()) / TICK, run.followed)


SCENARIO = Scenario(
    "noise",
    "Noise on targets",
    "speed of the fastest joint while the hand trembles [rad/s]",
    {
        "https://github.com/almond-bot/axol/pull/165": "Teleop jitter had several compounding causes",
    },
    streams,
    judge,
    least=1e-2,
)
