"""Whether an arm's tracker ever loses its arm, and whether `Arm.solve` finds postures that exist (10 min).

Lines of 30 and 40 cm from Franka's ready posture, in random directions at constant orientation: of those that damped
least squares can follow within the limits of position and velocity, how many the tracker follows, and how far xi goes.
Streams of a minute that no operator would send: jumps to poses anywhere, out of reach, behind the base, numbers that
are not finite, xi far outside; then the pose of the beginning for ten seconds. Poses of random postures within the
limits, on arms of makers and of random shape. `--quick` takes few of each.
"""

import time
from collections.abc import Iterator

import numpy as np
from arm import random_arm
from benchmark import run, table
from redundancy.arms import Arm

import orthocas as oc
from orthocas.arms import TrackStatus
from orthocas.arms.arm import list_arms
from orthocas.tools.checks import Array

READY = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])  # of Franka's arms
LENGTHS, LINES, TICKS, PERIOD = (0.3, 0.4), 30, 300, 0.01  # [m]; of each length; of a line; [s]
CLOSE, STAYS = 1e-6, 1e-2  # error of x that is on the line; of xi that is held
HOLD, BACK, LATE = 40, 1000, 1e-3  # ticks of a target, and at the end; [s] of a tick that is late
BARE = ("tiago", "g1")  # arms without charts
RANDOM, POSES = (1, 2, 3, 4), 200


def follow_by_least_squares(arm: oc.Arm, q: Array, targets: Array) -> bool:
    """Whether damped least squares keep to a line within the limits of position and velocity."""
    most = arm.robot.velocity_limits * PERIOD
    for target in arm.maps.targets.build(targets):
        start = q
        for _ in range(5):
            e, J = (part[0] for part in arm.maps.evaluate(q[None], target[None]))
            q = q + J.T @ np.linalg.solve(J @ J.T + 1e-8 * np.eye(len(e)), e)
        e = arm.maps.evaluate(q[None], target[None])[0]
        inside = (q >= arm.robot.lower).all() and (q <= arm.robot.upper).all()
        if not (np.abs(e).max() < CLOSE and inside and (np.abs(q - start) <= most).all()):
            return False
    return True


def follow_lines(count: int) -> Iterator[str]:
    """A row for each length."""
    arm, rng = oc.Arm.load("panda"), np.random.default_rng(0)
    for length in LENGTHS:
        begin = arm.x(READY)
        shares = (1 - np.cos(np.linspace(0, np.pi, TICKS))) / 2
        able = both = held = alone = 0
        for _ in range(count):
            way = rng.normal(size=3)
            targets = np.tile(begin, (TICKS, 1))
            targets[:, :3] += shares[:, None] * length * way / np.linalg.norm(way)
            tracker = arm.tracker(READY, period=PERIOD, detours=False)
            errors, xi = [], [tracker.xi]
            for x in targets:
                tracker.step(x)
                errors.append(np.abs(arm.maps.evaluate(tracker.q[None], arm.maps.targets.build(x[None]))[0]).max())
                xi.append(tracker.xi)
            can, does = follow_by_least_squares(arm, READY, targets), max(errors) < CLOSE
            able, both, alone = able + can, both + (can and does), alone + (does and not can)
            held += can and does and np.nanmax(np.abs(np.array(xi) - xi[0])) < STAYS
        yield f"| {100 * length:.0f} | {count} | {able} | {both} | {held} | {alone} |"


def name_arms() -> dict[str, oc.Arm]:
    """Ready arms, and two without charts."""
    return {name: oc.Arm.load(name) for name in list_arms()} | {name: oc.Arm(Arm(name).task) for name in BARE}


def sample(arm: oc.Arm, rng: np.random.Generator, count: int) -> Array:
    """Random postures (count, n) within the limits, of at most half a turn to both sides."""
    low, high = np.maximum(arm.robot.lower, -np.pi), np.minimum(arm.robot.upper, np.pi)
    return rng.uniform(low, high, (count, arm.robot.n))


def lead_astray(arms: dict[str, oc.Arm], seconds: float) -> Iterator[str]:
    """A row for each arm."""
    for name, arm in arms.items():
        robot, rng = arm.robot, np.random.default_rng(1)
        low, high, most = robot.lower, robot.upper, robot.velocity_limits * PERIOD
        home = np.array(arm.charts[0].domain.centre) if arm.charts else Arm(name).home
        stream: list[tuple[Array, Array | None]] = []
        for number in range(int(seconds / PERIOD / HOLD)):
            x, kind = arm.x(sample(arm, rng, 1)[0]), number % 5
            if kind == 1:
                x[:3] += rng.normal(size=3) * 2.0
            if kind == 2:
                x[rng.integers(6)] = rng.choice([np.nan, np.inf])
            if kind == 3:
                x[:2] *= -1.0
            for _ in range(HOLD):
                shake = 1e-3 * rng.normal(size=6) if kind == 4 else 0.0
                xi = rng.uniform(-3, 3, robot.n - 6) if arm.charts and rng.uniform() < 0.3 else None
                stream.append((x + shake, xi))
        tracker, times, broken = arm.tracker(home, period=PERIOD), [], 0
        for x, xi in stream + [(arm.x(home), None)] * BACK:
            before, began = tracker.q, time.thread_time()
            q = tracker.step(x, xi if xi is None or len(xi) > 1 else xi[0])
            times.append(time.thread_time() - began)
            broken += not ((q >= low) & (q <= high) & (np.abs(q - before) <= most * (1 + 1e-9))).all()
        lost = tracker.status not in (TrackStatus.OK, TrackStatus.YIELDING)
        us = 1e6 * np.array(times)
        late = int((us > 1e6 * LATE).sum())
        row = f"| {name} | {len(us)} | {broken} | {int(lost)} | {np.median(us):.0f} "
        yield f"{row}| {np.quantile(us, 0.999):.0f} | {late} |"


def find_poses(arms: dict[str, oc.Arm], count: int) -> Iterator[str]:
    """A row for each arm."""
    arms = {name: arm for name, arm in arms.items() if arm.robot.n == 7}  # others have trackers only
    for name, arm in (arms | {f"random {k}": oc.Arm(oc.Task.pose(random_arm(k))) for k in RANDOM}).items():
        rng = np.random.default_rng(3)
        x = arm.x(sample(arm, rng, count))
        found = arm.solve(x)
        error = np.abs(arm.maps.evaluate(found.q[found.found], arm.maps.targets.build(x[found.found]))[0]).max()
        yield f"| {name} | {int(found.found.sum())} of {count} | {error:.0e} |"


def main(quick: bool = False) -> dict[str, list[str]]:
    """Print three tables, and return their rows."""
    arms = name_arms()
    if quick:
        arms = {"panda": arms["panda"]}
    lines = "| length [cm] | lines | least squares follow | of these the arm | of these with xi held | the arm alone |"
    streams = "| arm | ticks | limits broken | lost at the end | tick: median [us] | 99.9 % [us] | ticks over 1 ms |"
    rows = {"lines": table(lines, follow_lines(3 if quick else LINES))}
    rows |= {"streams": table(streams, lead_astray(arms, 2.0 if quick else 60.0))}
    if not quick:
        rows |= {"poses": table("| arm | poses of random postures found | error of x |", find_poses(arms, POSES))}
    return rows


if __name__ == "__main__":
    run(main, __doc__)
