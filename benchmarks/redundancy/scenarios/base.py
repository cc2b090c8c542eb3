"""A mobile base: where does it look after a row of picks?"""

from itertools import pairwise

import numpy as np
import pinocchio as pin

from redundancy.arms import Arm
from redundancy.paths import between, moved, targets
from redundancy.protocol import Run, Scenario, Score, Stream

PICKS, WAY, HEADING = 12, 100, 2  # ticks; joint


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """From the middle to a pick, to the place where things go, and back to the middle, pick after pick."""
    start, path = arm.placement(arm.home), []
    place = _around(arm, rng)
    for _ in range(2 if quick else PICKS):
        stops = [start, _around(arm, rng), place, start]
        for one, other in pairwise(stops):
            path += between(one, other, WAY)
    return [Stream(arm.home, targets(arm, path))]


def _around(arm: Arm, rng: np.random.Generator) -> pin.SE3:
    """A pose around the base."""
    ahead, sideways, up, turn = rng.uniform([0.0, -0.6, -0.2, -1.0], [0.6, 0.6, 0.1, 1.0])
    return moved(arm.placement(arm.home), np.array([ahead, sideways, up]) * arm.size, np.array([0.0, 0.0, turn]))


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Heading of the base at the end, and its turning per pick."""
    run = runs[0]
    heading = np.concatenate([[run.stream.start[HEADING]], run.q[:, HEADING]])
    picks = len(run.q) / (3 * WAY)
    turning = np.abs(np.diff(heading)).sum() / picks
    return Score(float(np.degrees(abs(heading[-1]))), run.followed, float(np.degrees(turning)))


SCENARIO = Scenario(
    "base",
    "The base turns instead of the arm",
    "heading of the base after all picks [deg]",
    {
        "https://github.com/PickNikRobotics/moveit_pro_example_ws/pull/736": "the UR5e-on-Ridgeback spins its base a "
        'full ~360° "pirouette" before a grasp',
    },
    streams,
    judge,
    least=0.1,
    also="turning per pick [deg]",
    mobile=True,
)
