"""A gamepad or SpaceMouse moves the hand and the elbow of a panda, 100 times a second.

The first six axes of the device are speeds of the hand, along x, y, z and about the axes of the hand, and the seventh
is that of xi, which is the elbow. They move a target, which is never far ahead of the arm, so a stick that is held at a
boundary winds nothing up. A tracker with `nearest=True` finds the joints: no joint leaves the domain or moves faster
than its limit. At a boundary, xi gives way first, then x, and the status says so. MuJoCo's model of the arm judges
where the hand is.

    python examples/teleoperation/joystick.py                           # a recording made of sines, 20 s
    python examples/teleoperation/joystick.py --events recording        # made by: cat /dev/input/js0 > recording
    python examples/teleoperation/joystick.py --events /dev/input/js0   # a device of Linux, until Ctrl-C

Events are those of Linux joysticks: time [ms], value, type, number of the axis, in 8 bytes.
"""

import argparse
import contextlib
import os
import stat
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

import orthocas as oc
from orthocas.charts.trackers import TrackerStatus
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array

PERIOD, SECONDS = 0.01, 20.0  # [s]
SPEEDS = np.array([0.15, 0.15, 0.15, 0.6, 0.6, 0.6, 0.6])  # of full sticks: [m/s], [rad/s], [1/s]
LEAD = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1, 0.05])  # of the target before the arm, in the units of phi
DEAD = 0.05  # share of a stick's way that counts as none
EVENT, FULL, AXIS, START = struct.Struct("<IhBB"), 32767, 2, 0x80  # START is a bit of events that tell the first state
PERIODS = (7.0, 5.0, 11.0, 9.0, 6.0, 8.0, 13.0)  # of the recording that is made up [s]


def made_up(seconds: float = SECONDS) -> Array:
    """Sticks (T, 7) in [-1, 1]; the elbow's is held for a while, beyond its boundary."""
    t = np.arange(0.0, seconds, PERIOD)[:, None]
    sticks = 0.4 * np.cos(2 * np.pi * t / np.array(PERIODS))
    sticks[len(t) // 4 : 3 * len(t) // 4] = [0, 0, 0, 0, 0, 0, 1]
    return np.asarray(sticks)


def apply(data: bytes, sticks: Array) -> None:
    """Put events into sticks (7,)."""
    for _, value, kind, axis in EVENT.iter_unpack(data[: len(data) // EVENT.size * EVENT.size]):
        if kind & ~START == AXIS and axis < len(sticks):
            sticks[axis] = value / FULL


def recorded(path: Path) -> Iterator[Array]:
    """Sticks (7,) of each tick of a recording."""
    data, sticks, first = path.read_bytes(), np.zeros(len(SPEEDS)), 0
    if not data or len(data) % EVENT.size:
        raise SystemExit(f"{path}: {len(data)} bytes, expected events of {EVENT.size}")
    times = np.array([event[0] for event in EVENT.iter_unpack(data)])
    for now in np.arange(times[0], times[-1] + 1e3 * PERIOD, 1e3 * PERIOD):
        last = int(np.searchsorted(times, now, side="right"))
        apply(data[first * EVENT.size : last * EVENT.size], sticks)
        first = max(first, last)
        yield sticks.copy()


def live(path: Path) -> Iterator[Array]:
    """Sticks (7,) of a device at each tick."""
    device, sticks, tick = os.open(path, os.O_RDONLY | os.O_NONBLOCK), np.zeros(len(SPEEDS)), time.perf_counter()
    try:
        while True:
            with contextlib.suppress(BlockingIOError):  # nothing moved
                apply(os.read(device, 1024 * EVENT.size), sticks)
            yield sticks.copy()
            tick += PERIOD
            time.sleep(max(0.0, tick - time.perf_counter()))
    except KeyboardInterrupt:
        return
    finally:
        os.close(device)


def moved(chart: oc.Chart, q: Array, target: Array, stick: Array) -> Array:
    """The target (n,) after a tick of sticks (7,), at most LEAD from phi(q)."""
    m, here, none = chart.m, np.array(chart.phi(q)), np.zeros(chart.m)
    change = PERIOD * SPEEDS * np.where(np.abs(stick) < DEAD, 0.0, np.clip(stick, -1.0, 1.0))
    ahead = np.clip(chart.parts.phi_map.difference(target[None], here[None])[0] + change, -LEAD, LEAD)
    x = chart.parts.relative.moved(here[:m], ahead[:m], here[:m], none, none)[
        0
    ]  # orientations turn about the hand's axes
    return np.concatenate([np.array(x).ravel(), here[m:] + ahead[m:]])


def main(sticks: Iterator[Array] | None = None, quick: bool = False) -> dict[str, float]:
    """Drive the arm, and print what became of it.

    Args:
        sticks: values (7,) in [-1, 1] of each tick; default: those of `made_up`.
        quick: 4 s.

    Returns:
        Shares of the ticks that reached what was asked for, and that went as near as possible; by MuJoCo, the largest
        error of the hand in the former, and the median of the others, [m]; the fastest joint, relative to its limit;
        the least distance of a joint to its limit [rad]; the median time of a tick [ms].
    """
    chart = oc.charts.load("panda-wide")
    robot, start = chart.problem.robot, chart.problem.domain.centre
    limit = PERIOD * robot.velocity_limits
    tracker, model = chart.tracker(start, largest_step=limit, nearest=True), MuJoCoPlant(robot).model
    state = mujoco.MjData(model)
    wanted = np.array(chart.phi(start))
    q, statuses, errors, held, took, room = [start], [], [], [0.0], [], np.inf
    for stick in made_up(4.0 if quick else SECONDS) if sticks is None else sticks:
        began = time.perf_counter()
        wanted = moved(chart, tracker.q, wanted, stick)
        q.append(tracker.step(wanted).copy())
        took.append(time.perf_counter() - began)
        statuses.append(tracker.status)
        state.qpos[:] = q[-1]
        mujoco.mj_kinematics(model, state)
        error = float(np.abs(state.body("tip").xpos - wanted[:3]).max())
        (errors if tracker.status == TrackerStatus.OK else held).append(error)
        room = min(room, float(np.minimum(q[-1] - robot.lower, robot.upper - q[-1]).min()))
    found = {
        "reached": float(np.mean(np.array(statuses) == TrackerStatus.OK)),
        "nearest": float(np.mean(np.array(statuses) == TrackerStatus.NEAREST)),
        "hand_error_m": max(errors, default=np.nan),
        "at_boundary_m": float(np.median(held)),
        "fastest": float((np.abs(np.diff(q, axis=0)) / limit).max()),
        "room_rad": room,
        "tick_ms": float(1e3 * np.median(took)),
    }
    names = ("ticks", "reached [%]", "as near as possible [%]", "hand off [m]", "at a boundary, median [m]")
    names += ("fastest joint [% of its limit]", "least distance to a joint limit [rad]", "tick [ms]")
    print(f"| {' | '.join(names)} |\n|{' --- |' * len(names)}")
    reached, nearest, error, boundary, fastest, room, tick = found.values()
    shares = f"{100 * reached:.1f} | {100 * nearest:.1f} | {error:.0e} | {boundary:.0e} | {100 * fastest:.0f}"
    print(f"| {len(statuses)} | {shares} | {room:.3f} | {tick:.1f} |")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=Path, help="a recording of a joystick, or its device")
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    events: Iterator[Array] | None = None
    if arguments.events is not None:
        is_device = stat.S_ISCHR(arguments.events.stat().st_mode)
        events = live(arguments.events) if is_device else recorded(arguments.events)
    main(events, arguments.quick)
