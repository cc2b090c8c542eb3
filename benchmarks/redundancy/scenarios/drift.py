"""Repeated tool paths: does the arm come back to the posture where it began?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import direction, moved, targets
from redundancy.protocol import Run, Scenario, Score, Stream

RADIUS, ROUNDS, TICKS, REST = 0.08, 10, 150, 50  # of the arm's size; of a circle; at the end


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """Circles through the pose of home at constant orientation, in a random plane."""
    one, other = np.linalg.qr(np.stack([direction(rng), direction(rng)], axis=1))[0].T
    angles = 2 * np.pi * np.arange(1, (2 if quick else ROUNDS) * TICKS + 1) / TICKS
    ways = RADIUS * arm.size * (np.outer(np.cos(angles) - 1, one) + np.outer(np.sin(angles), other))
    start = arm.placement(arm.home)
    path = [moved(start, way, np.zeros(3)) for way in ways]
    return [Stream(arm.home, targets(arm, path + [start] * REST))]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Largest change of a joint over all rounds."""
    drift = max(float(np.abs(run.q[-1] - run.stream.start).max()) for run in runs)
    return Score(drift, all(run.followed for run in runs))


SCENARIO = Scenario(
    "drift",
    "Drift over repeated tool paths",
    "largest joint change after 10 rounds [rad]",
    {
        "https://github.com/IFL-CAMP/iiwa_stack/issues/133": "the robot starts at first position but joint space is "
        "slightly different, after several loops, joints get into the position that robot is not able to move anymore.",
        "https://github.com/facebookresearch/fairo/pull/664": "Before the Franka arm would drift in the null space "
        "after repeated executions of the planner",
    },
    streams,
    judge,
    least=1e-4,
)
