"""A mobile base: how much does it turn, pick after pick?"""

import numpy as np
from redundancy.arms import Arm
from redundancy.paths import between, moved, targets
from redundancy.protocol import Run, Scenario, Score, Stream

PICKS, WAY, HEADING = 6, 150, 2  # ticks; joint


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """The tool goes to poses around the base and back to the middle, in the order in which boxes stand there."""
    start, path = arm.placement(arm.home), []
    for _ in range(2 if quick else PICKS):
        sideways, up, ahead, turn = rng.uniform(-0.6, 0.6), rng.uniform(-0.2, 0.1), rng.uniform(0.0, 0.6), rng.uniform(-1, 1)
        goal = moved(start, np.array([ahead, sideways, up]) * arm.size, np.array([0, 0, turn]))
        path += between(start, goal, WAY) + between(goal, start, WAY)
    return [Stream(arm.home, targets(arm, path))]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Turning of the base per pick, there and back, and its heading at the end."""
    run = runs[0]
    heading = np.concatenate([[run.stream.start[HEADING]], run.q[:, HEADING]])
    picks = len(run.q) / (2 * WAY)
    return Score(
        float(np.degrees(np.abs(np.diff(heading)).sum() / picks)), run.followed, float(np.degrees(abs(heading[-1])))
    )


SCENARIO = Scenario(
    "base",
    "The base turns instead of the arm",
    "turning of the base per pick [deg]",
    {
        "https://github.com/PickNikRobotics/moveit_pro_example_ws/pull/736": "the UR5e-on-Ridgeback spins its base a full "
        "~360° \"pirouette\" before a grasp",
    },
    streams,
    judge,
    also="heading of the base at the end [deg]",
    mobile=True,
)
