"""Sliders of the null space: does the tool stay while the arm moves?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.protocol import Run, Scenario, Score, Stream, Target

MOVES, TICKS, FAR, REACHED = 8, 100, 0.35, 0.2  # jumps of the slider; ticks after each; [rad]; of a jump left at most


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """The slider jumps to random postures of the self-motion at home, at once. The tool is to stay."""
    placement, found = arm.placement(arm.home), []
    for angle in rng.uniform(-FAR, FAR, 5 if quick else MOVES):
        found += [Target(placement, arm.with_elbow(angle))] * TICKS
    return [Stream(arm.home, found)]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Largest error of the tool [mm]; served: the posture was reached, but for a fifth of the jump, in the mean."""
    run, shares = runs[0], []
    before = run.stream.start
    for k in range(TICKS - 1, len(run.q), TICKS):
        wanted = run.stream.targets[k].posture
        shares.append(np.linalg.norm(run.q[k] - wanted) / max(np.linalg.norm(before - wanted), 1e-3))
        before = wanted
    return Score(1e3 * float(run.errors[:, 0].max()), bool(np.mean(shares) < REACHED))


SCENARIO = Scenario(
    "slider",
    "Sliders that leave the null space",
    "largest error of the tool [mm]",
    {
        "https://github.com/moveit/moveit/issues/2970": "dragging the null-space slider can leave the null-space and "
        "start moving the end effector away from the picked pose.",
    },
    streams,
    judge,
    least=1e-2,
    served="1 s after a jump of the slider, at most a fifth of the way to its posture is left, in the mean",
)
