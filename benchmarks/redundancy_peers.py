"""What holds a redundant arm's posture: charts against the solvers that people use, on the same tool paths.

Every method follows a stream of tool positions (`position`) or poses (`pose`) at 100 Hz, one joint position per tick:

- chart: the tracker of cubic coordinates, which holds still where there is no q inside the domain; for targets,
  `solve(inside=True)`;
- SEW chart (pose): the task and the stereographic SEW angle as coordinates, not orthogonal;
- pink, mink: a frame task and a posture task of a given cost, joint limits, DAQP, one step per tick;
- ssik (pose): the tracker, which holds an angle of its own (a swivel, or a joint);
- pseudo-inverse: dq = J^+ (dx_d + k e), without limits;
- operational space: the textbook's torque control with a posture (6 Hz) at 1 kHz, on the arm in MuJoCo, which
  rests for 1 s after the circles.

Columns: drift of the joints after the closed circles; largest error of the tool while self-motion is commanded there
and back, share of that self-motion which was reached, and what is left of it at the end; straight lines of 0.6 m and
back, followed to 1 mm (many leave the reach of the arm, more the domain of a chart), ticks outside the joint limits on
them, and the fastest joint; targets found from the middle of the domain within 100 steps: those of random joint
positions in the domain, and in the whole joint range; one tick. Charts solve all `--targets` of the domain at once;
for others, and in the whole joint range, one target takes up to 0.2 s, so there are `--peer-targets`.

Peers get whole postures where a chart gets xi: those of the chart's inverse map. Needs pin-pink, mink, daqp and ssik
(the extra `peers`); rows of those that are not installed are left out.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from peer_arms import MOVE, MOVE_TIME, TICK, Arm, Target, circles, lines, self_motion, smooth
from peer_methods import SSIK, Method, Mink, OnAtlas, OnChart, OperationalSpace, Pink, methods

from orthocas.tasks.domains import sample_uniform
from orthocas.tools.checks import Array

ARMS, TASKS, PARTS = ("iiwa", "panda", "xarm7"), ("position", "pose"), ("motions", "shares")
CLOSE, CLOSE_TURN = 1e-4, 1e-3  # a target is found: [m], [rad]
FOLLOWED = 1e-3  # [m]
SETTLING = 1.0  # of a simulated arm after the circles [s]
STEPS, UNHURRIED = 100, 10.0  # of an iterative solver for one target; the time of each [s]
AT_REST = 1e-9  # joint motion of a step after which others change nothing [rad]
FEW = 500  # targets for simulations
COLUMNS = (
    *("method", "drift [rad]", "tool error [mm]", "reached", "left [rad]", "lines", "outside limits"),
    *("fastest joint [rad/s]", "tick [us]"),
)
SHARES = ("targets of the domain", "of the joint range", "targets")


@dataclass(frozen=True)
class Run:
    """What a method did with a stream."""

    q: Array  #: (N, n)
    errors: Array  #: of the tool (N,) [m]
    seconds: Array  #: (N,)


def followed(method: Method, arm: Arm, targets: list[Target], q: Array) -> Run:
    """Stream targets to a method that begins at q."""
    method.start(q)
    commands = [method.command(target) for target in targets]
    path, errors, seconds = [], [], []
    for target, command in zip(targets, commands, strict=True):
        start = time.perf_counter()
        path.append(method.tick(command))
        seconds.append(time.perf_counter() - start)
        errors.append(np.linalg.norm(arm.error(path[-1], target.placement)[:3]))
    return Run(np.array(path), np.array(errors), np.array(seconds))


def moved_itself(method: Method, arm: Arm) -> tuple[float, float, float]:
    """Error of the tool [m], share of the motion reached, joint motion left [rad], under `self_motion`."""
    targets = self_motion(arm)
    run = followed(method, arm, targets, arm.home)
    k = len(targets) // 2
    wanted = targets[k].posture - arm.home
    reached = float((run.q[k] - arm.home) @ wanted / (wanted @ wanted))
    return run.errors.max(), reached, float(np.abs(run.q[-1] - arm.home).max())


def moved_by_ssik(method: SSIK, arm: Arm) -> tuple[float, float, float]:
    """The same with ssik's own coordinate, which has a name there."""
    method.start(arm.home)
    first, held = method.tracker.redundancy.t, arm.target(arm.home)
    path = []
    for share in smooth(np.arange(TICK, MOVE_TIME, TICK) / MOVE_TIME):
        path.append(np.array(method.tracker.set_redundancy(first + share * MOVE).q))
    path.append(np.array(method.tracker.set_redundancy(first).q))
    errors = [np.linalg.norm(arm.error(q, held.placement)[:3]) for q in path]
    return max(errors), 1.0, float(np.abs(path[-1] - arm.home).max())


def found(method: Method | OnAtlas, arm: Arm, points: Array) -> float:
    """Share of targets, those of joint positions (N, n), that are reached from home within the joint limits."""
    targets = [arm.target(q, posture=arm.home) for q in points]
    if isinstance(method, OnChart | OnAtlas):
        reached = method.solutions(np.array([method.command(target) for target in targets]))
        return float(np.mean([is_found(arm, *pair) for pair in zip(reached, targets, strict=True)]))
    if isinstance(method, Pink | Mink):
        method.period = UNHURRIED  # limits of velocity stop nothing here
    if isinstance(method, OperationalSpace):
        method.feed_forward = False  # the target rests
    return float(np.mean([found_one(method, arm, target) for target in targets]))


def found_one(method: Method, arm: Arm, target: Target) -> bool:
    """Whether a target is reached from home."""
    method.start(arm.home)
    command, q = method.command(target), arm.home
    if isinstance(method, SSIK):
        return is_found(arm, method.solution(command), target)
    for _ in range(STEPS):
        before, q = q, method.tick(command)
        if is_found(arm, q, target):
            return True
        if not isinstance(method, OperationalSpace) and np.abs(q - before).max() < AT_REST:
            break
    return False


def is_found(arm: Arm, q: Array, target: Target) -> bool:
    """Whether the tool is where it should be, within the joint limits."""
    close = np.where(np.arange(arm.chart.m) < 3, CLOSE, CLOSE_TURN)
    return bool((np.abs(arm.error(q, target.placement)) < close).all() and inside_limits(arm, q[None])[0])


def inside_limits(arm: Arm, q: Array) -> Array:
    """Whether joint positions (N, n) keep the robot's limits, (N,)."""
    return np.asarray(((q >= arm.robot.lower - 1e-9) & (q <= arm.robot.upper + 1e-9)).all(axis=1))


def motion(name: str, method: Method, arm: Arm, options: argparse.Namespace) -> list[str]:
    """The columns of motions."""
    settles = isinstance(method, OperationalSpace)
    rest = [arm.target(arm.home)] * round(SETTLING / TICK if settles else 0)
    turned = followed(method, arm, circles(arm, options.circles) + rest, arm.home)
    drift = float(np.abs(turned.q[-1] - arm.home).max())
    named = isinstance(method, SSIK) and method.ik.tracker(arm.home).redundancy is not None
    error, reached, left = moved_by_ssik(method, arm) if named else moved_itself(method, arm)
    runs = [followed(method, arm, line, arm.home) for line in lines(arm, options.lines)]
    whole = sum(bool(run.errors.max() < FOLLOWED) for run in runs)
    outside = sum(int((~inside_limits(arm, run.q)).sum()) for run in runs)
    fastest = max(float(np.abs(np.diff(run.q, axis=0)).max()) / TICK for run in runs)
    seconds = np.median(turned.seconds) / (method.calls if settles else 1)
    columns = [name, f"{drift:.1e}", f"{1e3 * error:.2g}", f"{100 * reached:.0f} %", f"{left:.1e}"]
    return [*columns, f"{whole} of {len(runs)}", f"{outside}", f"{fastest:.1f}", f"{1e6 * seconds:.0f}"]


def shares(method: Method | OnAtlas, arm: Arm, options: argparse.Namespace) -> list[str]:
    """The columns of targets that are found."""
    count = options.targets if isinstance(method, OnChart) else options.peer_targets
    count = min(count, FEW) if isinstance(method, OperationalSpace) else count
    low, high = np.maximum(arm.robot.lower, -np.pi), np.minimum(arm.robot.upper, np.pi)
    everywhere = np.random.default_rng(7).uniform(low, high, (count, arm.robot.n))
    found_of = [found(method, arm, points) for points in (sample_uniform(arm.domain, count, 8), everywhere)]
    return [*(f"{100 * share:.1f} %" for share in found_of), f"{count:,}"]


def table(arm: Arm, options: argparse.Namespace) -> None:
    """Print the table of an arm and a task."""
    moves = "motions" in options.parts
    columns = [*(COLUMNS if moves else COLUMNS[:1]), *(SHARES if "shares" in options.parts else ())]
    print(f"\n**{arm.name}, {arm.task}**\n\n| {' | '.join(columns)} |\n" + "| --- " * len(columns) + "|")
    rows: list[tuple[str, Callable[[], Method | OnAtlas]]] = [*methods(arm)]
    if options.atlas and (arm.name, arm.task) == ("iiwa", "position"):
        rows.append(("atlas", lambda: OnAtlas(arm, options.atlas)))
    for label, build in rows:
        if not options.methods or label.startswith(tuple(options.methods)):
            method = build()
            words = [label] if isinstance(method, OnAtlas) or not moves else motion(label, method, arm, options)
            words += ["-"] * (len(COLUMNS) - 1 if moves and len(words) == 1 else 0)
            words += shares(method, arm, options) if "shares" in options.parts else []
            print(f"| {' | '.join(words)} |", flush=True)


def main() -> None:
    """Print a table in Markdown for each arm and task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--circles", type=int, default=50)
    parser.add_argument("--lines", type=int, default=40)
    parser.add_argument("--targets", type=int, default=10_000, help="for charts")
    parser.add_argument("--peer-targets", type=int, default=10_000, help="for others")
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS, help="motions, shares of targets found")
    parser.add_argument("--atlas", help="file of an atlas, for a row of the 7-DoF arm's positions")
    parser.add_argument("--methods", nargs="+", help="rows by the beginnings of their names; default: all")
    parser.add_argument("--arms", nargs="+", default=ARMS, choices=ARMS)
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    parser.add_argument("--quick", action="store_true", help="one arm, short runs")
    options = parser.parse_args()
    if options.quick:
        options.circles, options.lines, options.targets, options.peer_targets, options.arms = 1, 2, 20, 5, ARMS[:1]
    for task in options.tasks:
        for name in options.arms:
            table(Arm(name, task), options)


if __name__ == "__main__":
    main()
