"""The border of reach: does the arm shake while its target waits beyond it?"""

import numpy as np

from orthocas.tools.checks import Array
from redundancy.arms import TICK, Arm
from redundancy.paths import moved, smooth, targets
from redundancy.protocol import Run, Scenario, Score, Stream

OUT, WAIT, BACK, REST = 200, 200, 200, 100  # ticks
BEYOND, TREMOR = 0.15, 1e-3  # of the arm's size; of the operator's hand [m]


def streams(arm: Arm, rng: np.random.Generator, quick: bool) -> list[Stream]:
    """The hand leads the tool straight out of reach, waits there with a tremor, and leads it back."""
    start, way = arm.placement(arm.home), way_out(arm)
    out = [moved(start, s * way, np.zeros(3)) for s in smooth(OUT)]
    noise = np.zeros((WAIT, 3))
    for k in range(1, WAIT):
        noise[k] = 0.8 * noise[k - 1] + 0.6 * TREMOR * rng.normal(size=3)
    wait = [moved(start, way + tremor, np.zeros(3)) for tremor in noise]
    return [Stream(arm.home, targets(arm, out + wait + out[::-1] + [start] * REST), known=False)]


def way_out(arm: Arm) -> Array:
    """From the tip at home straight away from the shoulder, to beyond what the stretched arm reaches (3,) [m]."""
    shoulder = np.ravel(arm.robot.frame_position(arm.home, f"{arm.joints[1]}_link"))
    away = arm.placement(arm.home).translation - shoulder
    distance = float(np.linalg.norm(away))
    return np.asarray((max(arm.size - distance, 0.0) + BEYOND * arm.size) * away / distance)


def judge(arm: Arm, runs: list[Run]) -> Score:
    """Mean speed of the fastest joint while the target waits; served: back on target at the end, within limits."""
    run = runs[0]
    still = slice(OUT + WAIT // 4, OUT + WAIT)
    speed = np.abs(np.diff(run.q[still], axis=0)).max(axis=1).mean() / TICK
    back = bool(run.on_target[-1] and run.placed)
    return Score(float(speed), back, 1e3 * float(run.errors[still, 0].mean()))


SCENARIO = Scenario(
    "reach",
    "Shaking at the border of reach",
    "speed of the fastest joint while the target waits beyond reach [rad/s]",
    {
        "https://github.com/ACETeleop/ACETeleop/issues/3": "it reaches a certain point where it starts to shake "
        "uncontrollably.",
    },
    streams,
    judge,
    least=1e-2,
    also="distance of tool and target meanwhile [mm]",
    served="the tip is back on its target at the end, and no joint ever left its limits",
)
