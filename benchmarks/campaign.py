"""All faults on tight and wide charts at 1 kHz and 500 Hz, without and with the `FrictionObserver`: runaways (40 min).

The cases of `faults.py`, with true measurements and encoders of 13 bits, in MuJoCo without rotor inertia, on charts
with default gains and settings. A run ran away if a joint exceeds its limit by half under any reference, is not at rest
2.5 s after a catch, moves by more than 0.5 rad/s 1.5 s after a blow or when brakes open, or exceeds its limit by half
within 200 ticks after sensors stood still, but for those of an arm at rest whose reference then moves: these count
apart, since friction may hold such an arm.
"""

from collections.abc import Iterator

import faults
import numpy as np
from benchmark import run, table

CHARTS = (
    *("iiwa7-pose", "panda-pose", "xarm7-pose", "tiago-pro-left-pose"),
    *("iiwa7-wide", "panda-wide", "xarm7-wide", "baxter-left-wide", "tiago-pro-left-wide"),
)
PERIODS, RUNS = (1e-3, 2e-3), 2  # [s], of each case
SHARE, REST, MOVES = 1.5, 2.5, 0.5  # of a speed limit, [s], [rad/s]
HEADER = "| chart | memory | runs | ran away | sensors of resting arms: beyond 1.5 limits |\n|" + " --- |" * 5


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; return sums."""
    found = {"runs": 0, "away": 0, "unseen": 0}

    def rows() -> Iterator[str]:
        for name in CHARTS[:1] if quick else CHARTS:
            for memory in ("none", "friction"):
                with faults.arm_of(name, memory) as arm:
                    runs, away, unseen = count(arm, 1 if quick else RUNS)
                for key, value in zip(found, (runs, away, unseen), strict=True):
                    found[key] += value
                yield f"| {name} | {memory} | {runs} | {away} | {unseen} |"

    table(HEADER, rows())
    print(found)
    return {key: float(value) for key, value in found.items()}


def count(arm: faults.Arm, each: int) -> tuple[int, int, int]:
    """Runs, those that ran away, and resting arms whose sensors stood still and that got beyond 1.5 limits."""
    gone, unseen = [], []
    for period in PERIODS:
        faults.TICK = period
        for seen in (arm, arm.with_encoders(13)):
            for _ in range(each):
                speeds = {case: faults.stands_still(seen, case) > SHARE * arm.limits.min() for case in faults.STANDING}
                unseen.append(speeds.pop("reference"))
                gone += speeds.values()
                gone.append(faults.blow(seen)[1] > MOVES)
                gone += [faults.led(seen, ask) > SHARE for ask in faults.ASKED]
                gone += [rest > REST or not back for rest, back in (faults.caught(seen, d) for d in faults.DELAYS)]
                gone.append(faults.brakes(seen) > MOVES)
    faults.TICK = PERIODS[0]
    return len(gone) + len(unseen), int(np.sum(gone)), int(np.sum(unseen))


if __name__ == "__main__":
    run(main, __doc__)
