"""Along the border of reach: how near does the tool stay to a hand that goes on sideways beyond it?"""

import numpy as np

from redundancy.arms import Arm
from redundancy.paths import direction, moved, smooth, targets
from redundancy.protocol import Run, Scenario, Score, Stream
from redundancy.scenarios.reach import way_out

OUT, ASIDE, REST = 200, 200, 100  # ticks
FAR = 0.2  # sideways [m]


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """The hand leads the tool straight out of reach, 200 mm to a side and back, and back in."""
    start, way = arm.placement(arm.home), way_out(arm)
    side = np.cross(way, direction(rng))
    side *= FAR / np.linalg.norm(side)
    out = [moved(start, s * way, np.zeros(3)) for s in smooth(OUT)]
    aside = [moved(start, way + s * side, np.zeros(3)) for s in smooth(ASIDE)]
    return [Stream(arm.home, targets(arm, out + aside + aside[::-1] + out[::-1] + [start] * REST), known=False)]


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Mean distance of tool and hand on the way aside; served: back on target at the end, within limits."""
    run = runs[0]
    there = slice(OUT, OUT + 2 * ASIDE)
    tool = [arm.placement(run.q[k - 1]).translation for k in (OUT, OUT + ASIDE)]
    followed = float(np.linalg.norm(tool[1] - tool[0])) if np.isfinite(run.q).all() else np.inf
    return Score(1e3 * float(run.errors[there, 0].mean()), bool(run.on_target[-1] and run.placed), 1e3 * followed)


SCENARIO = Scenario(
    "border",
    "Along the border of reach",
    "distance of the tool from a hand that goes 200 mm sideways beyond reach [mm]",
    {
        "https://github.com/ACETeleop/ACETeleop/issues/3": "it reaches a certain point where it starts to shake "
        "uncontrollably.",
    },
    streams,
    judge,
    least=1.0,
    also="way of the tool meanwhile [mm]",
    served="the tip is back on its target at the end, and no joint ever left its limits",
)
