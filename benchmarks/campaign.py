"""All faults on tight and wide charts at 1 kHz and 500 Hz, without and with the `FrictionObserver` (10 min).

The cases of `faults.py`, with true measurements and encoders of 13 bits, in MuJoCo without rotor inertia, on charts
with default gains and settings. Each column counts the runs that did what its bound forbids. These arms have no
friction, while the default settings take it that a joint may stick. So arms at rest whose sensors die, and whose
reference then moves, are counted three times: as they are, with settings that state so ("stated"), and with the dry
friction that the default settings state ("sticks").
"""

from collections.abc import Iterator
from dataclasses import replace

import faults
import numpy as np
from benchmark import run, table

from orthocas.control import Safety
from orthocas.simulation import Friction

CHARTS = (
    *("iiwa7-pose", "panda-pose", "xarm7-pose", "tiago-pro-left-pose"),
    *("iiwa7-wide", "panda-wide", "xarm7-wide", "baxter-left-wide", "tiago-pro-left-wide"),
)
PERIODS, RUNS = (1e-3, 2e-3), 2  # [s], of each case
FAST = 1.5  # [limits of speed]
MOVES = 0.5  # [rad/s] 1.5 s after a blow, or when brakes open
SHAKES = 0.1  # before the end of the time that is watched: caught, without rest [s]
DRY = 0.8  # Coulomb friction, of what may hold a joint
COUNTED = "dead", "dead_and_led", "stated", "sticks", "led", "caught", "moved"
HEADER = (
    "| chart | memory | runs | dead sensors: fast | dead at rest, then led: fast | stated: fast | sticks: fast |"
    " led: fast | caught: no rest | blows, brakes: moves |\n|" + " --- |" * 10
)


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; return sums."""
    found = np.zeros(8, int)

    def rows() -> Iterator[str]:
        for name in CHARTS[:1] if quick else CHARTS:
            for memory in ("none", "friction"):
                with faults.arm_of(name, memory) as arm:
                    counted = count(arm, 1 if quick else RUNS)
                found[:] += counted
                yield f"| {name} | {memory} | " + " | ".join(map(str, counted)) + " |"

    table(HEADER, rows())
    names = ("runs", *COUNTED)
    print(dict(zip(names, found.tolist(), strict=True)))
    return dict(zip(names, found.astype(float).tolist(), strict=True))


def count(arm: faults.Arm, each: int) -> list[int]:
    """How many runs there were, and how many crossed the bound of each column."""
    crossed: dict[str, list[bool]] = {name: [] for name in COUNTED}
    for period in PERIODS:
        faults.TICK = period
        for seen in (arm, arm.with_encoders(13)):
            for _ in range(each):
                for case in faults.STANDING:
                    kind = "dead_and_led" if case == "reference" else "dead"
                    crossed[kind].append(faults.stands_still(seen, case)[1] > FAST)
                smooth = Safety.of(arm.law, friction=0.0, encoder_step=seen.safety.encoder_step)
                crossed["stated"].append(faults.stands_still(replace(seen, safety=smooth), "reference")[1] > FAST)
                stiff = replace(seen, friction=Friction(coulomb=DRY * seen.safety.friction))
                crossed["sticks"].append(faults.stands_still(stiff, "reference")[1] > FAST)
                crossed["led"] += [faults.led(seen, ask) > FAST for ask in faults.ASKED]
                ends = [faults.caught(seen, delay) for delay in faults.DELAYS]
                crossed["caught"] += [rest > faults.WATCHED - SHAKES or not back for rest, back in ends]
                crossed["moved"] += [faults.blow(seen)[1] > MOVES, faults.brakes(seen) > MOVES]
    faults.TICK = PERIODS[0]
    return [sum(map(len, crossed.values())), *(int(np.sum(values)) for values in crossed.values())]


if __name__ == "__main__":
    run(main, __doc__)
