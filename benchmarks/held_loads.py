"""Loads that the catcher holds although nobody told it of them, in MuJoCo: 3 kg in the hand (3 min).

The arms, laws and encoders of `faults.py`. The catcher takes over from a late tick. The hand takes the load 1 s before,
or in that tick, at random postures in the inner half of the domain where the motors can hold it; five runs each. How
far the flange moves, the time until all joints rest within 2.5 s, and in how many runs the law commands 1.5 s after it
was asked again.
"""

from collections.abc import Iterator

import numpy as np
from benchmark import run, table
from faults import ARMS, REST, SETTLED, TICK, Arm, arm_of

from orthocas.control import ControlStatus
from orthocas.simulation import MuJoCoPlant

LOAD, TAKEN = 3.0, (1000, 0)  # [kg], ticks before the catch
RUNS, CAUGHT, ASKED = 5, 2500, 1500
HEADER = (
    "| chart | taken 1 s before, in that tick: flange moves [mm] | at rest after [s] | back "
    "|\n| --- | --- | --- | --- |"
)


def main(quick: bool = False) -> list[str]:
    """Print the table."""
    return table(HEADER, rows(ARMS[:1] if quick else ARMS, 1 if quick else RUNS))


def rows(arms: tuple[str, ...], runs: int) -> Iterator[str]:
    """Two rows for each arm, without and with encoders: the worst of all runs."""
    for name in arms:
        with arm_of(name) as arm:
            for label, seen in ((name, arm), (f"{name}, encoders", arm.with_encoders(13))):
                found = np.array([[loaded(seen, before) for _ in range(runs)] for before in TAKEN])
                away = ", ".join(f"{1e3 * way:.0f}" for way in found[..., 0].max(axis=1))
                yield (
                    f"| {label} | {away} | {found[..., 1].max():.2f} "
                    f"| {int(found[..., 2].sum())} of {found[..., 2].size} |"
                )


def loaded(arm: Arm, before: int) -> tuple[float, float, bool]:
    """How far the flange moves [m], the time until all joints rest [s], and whether the law goes on when asked."""
    robot, heavy, q = arm.robot, arm.robot.with_payload(LOAD), arm.posture()
    while (np.abs(heavy.gravity(q)) > 0.9 * arm.law.limit).any():
        q = arm.posture()
    supervisor, plant = arm.started(q)
    reference, path, last, caught = arm.resting(q), [], 0, SETTLED + before
    for k in range(caught + CAUGHT + ASKED):
        if k == SETTLED:
            bare, plant = plant, MuJoCoPlant(heavy)
            plant.reset(bare.q, bare.dq)
        if k == caught + CAUGHT:
            supervisor.resume()
        command, status = supervisor.step(*arm.seen(plant), reference, 1.0 if k == caught else TICK)
        plant.step(command, TICK)
        if caught <= k < caught + CAUGHT:
            path.append(plant.q)
            last = len(path) if np.abs(plant.dq).max() > REST else last
    moved = robot.tip_position(np.array(path)) - robot.tip_position(path[0])
    return float(np.linalg.norm(moved, axis=1).max()), last * TICK, status is ControlStatus.OK


if __name__ == "__main__":
    run(main, __doc__)
