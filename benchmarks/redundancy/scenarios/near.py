"""Near targets: are the answers near each other, whatever the way?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import between, direction, in_ball, moved, targets
from redundancy.protocol import Run, Scenario, Score, Stream

PAIRS, WAY, HOLD = 6, 110, 20  # of targets; ticks
APART, TURNED = 2e-3, np.radians(0.5)  # [m], [rad]


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """All first ones of pairs in one order, then all second ones in another."""
    count = 4 if quick else PAIRS
    first = [in_ball(arm, rng, 0.15, 0.4) for _ in range(count)]
    second = [moved(x, APART * direction(rng), TURNED * direction(rng)) for x in first]
    path, last = [], arm.placement(arm.home)
    for goal in (*first, *(second[k] for k in _order(count))):
        path += between(last, goal, WAY) + [goal] * HOLD
        last = goal
    return [Stream(arm.home, targets(arm, path), known=False)]


def _order(count: int) -> list[int]:
    """Another order, the same each time: every fifth one."""
    step = next(k for k in (5, 7, 3, 1) if np.gcd(k, count) == 1)
    return [(step * k + 1) % count for k in range(count)]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Largest difference of a joint between the two answers of a pair."""
    ends = runs[0].q[WAY + HOLD - 1 :: WAY + HOLD]
    count = len(ends) // 2
    apart = [np.abs(ends[count + k] - ends[pair]).max() for k, pair in enumerate(_order(count))]
    return Score(float(max(apart)), runs[0].followed)


SCENARIO = Scenario(
    "near",
    "Consistent answers for near targets",
    "largest joint difference between answers for targets 2 mm apart [rad]",
    {
        "https://github.com/flexivrobotics/flexiv_rdk/issues/163": "for target points that are in very close proximity "
        "to one another in Cartesian space, the trajectory taken from the starting pose is neither consistent nor "
        "repeatable across multiple runs.",
    },
    streams,
    judge,
    least=1e-3,
)
