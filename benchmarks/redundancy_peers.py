"""What holds a redundant arm's posture: charts against the solvers that people use, on the same tool paths.

Every method follows a stream of tool positions (`position`) or poses (`pose`) at 100 Hz, one joint position per tick:

- chart: the tracker of cubic coordinates, which holds still where there is no q inside the domain; for targets,
  `solve(inside=True)`;
- SEW chart (pose): the task and the stereographic SEW angle as coordinates, not orthogonal;
- pink, mink: a frame task and a posture task of a given cost, joint limits, DAQP, one step per tick;
- ssik (pose): the tracker, which holds an angle of its own (a swivel, or a joint);
- pseudo-inverse: dq = J^+ (dx_d + k e), without limits.

Columns: drift of the joints after the closed circles; largest error of the tool while self-motion is commanded there
and back, share of that self-motion which was reached, and what is left of it at the end; straight lines of 0.6 m and
back, followed to 1 mm (many leave the reach of the arm, more the domain of a chart), ticks outside the joint limits on
them, and the fastest joint; targets found from the middle of the domain within 100 steps: those of random joint
positions in the domain, and in the whole joint range; one tick.

Peers get whole postures where a chart gets xi: those of the chart's inverse map. Needs pin-pink, mink, daqp and ssik
(the extra `peers`); rows of those that are not installed are left out.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np
import pinocchio as pin
from default_gains import problem_of, robot_file

import orthocas as oc
from orthocas.checks import Array
from orthocas.domains import sample_uniform
from orthocas.errors import RobotError
from orthocas.simulation import MuJoCoPlant

ARMS, TASKS = ("iiwa", "panda", "xarm7"), ("position", "pose")
TICK = 0.01  # [s]
RADIUS, PERIOD = 0.08, 2.0  # of the circle [m], [s]
MOVE, MOVE_TIME = 0.3, 4.0  # of the first extra coordinate: largest joint motion [rad], there and back [s]
LENGTH, LINE_TIME = 0.6, 4.0  # of a line [m], there and back [s]
CLOSE, CLOSE_TURN = 1e-4, 1e-3  # a target is found: [m], [rad]
FOLLOWED = 1e-3  # [m]
STEPS, UNHURRIED = 100, 10.0  # of an iterative solver for one target; the time of each [s]
COLUMNS = (
    *("method", "drift [rad]", "tool error [mm]", "reached", "left [rad]", "lines", "outside limits"),
    *("fastest joint [rad/s]", "targets of the domain", "of the joint range", "tick [us]"),
)


@dataclass(frozen=True)
class Target:
    """What is wanted at a tick, in the words of every method."""

    x: Array  #: task value (m,)
    placement: pin.SE3  #: of the tool; only its position counts for a position task
    posture: Array  #: (n,): charts hold its coordinates


class Method(Protocol):
    """A solver with a state."""

    def start(self, q: Array) -> None:
        """Begin at a joint position."""
        ...

    def command(self, target: Target) -> Any:
        """The target in the method's own words."""
        ...

    def tick(self, command: Any) -> Array:
        """The next joint position."""
        ...


class Arm:
    """A chart, and its robot in Pinocchio."""

    def __init__(self, name: str, task: str) -> None:
        self.name, self.task = name, task
        self.chart = oc.fit(problem_of(name, task, "euclidean"), oc.Polynomial(3), weights=(1000, 30, 150, 1)).chart
        self.robot, self.domain = self.chart.problem.robot, self.chart.problem.domain
        self.home: Array = self.domain.centre
        with robot_file(name) as (path, self.tip, locked):
            self.file = Path(path).read_text()
            model = pin.buildModelFromUrdf(str(path))
        values = pin.neutral(model)
        for joint, value in locked.items():
            values[model.joints[model.getJointId(joint)].idx_q] = value
        idle = [i for i in range(1, model.njoints) if model.names[i] not in self.robot.joint_names]
        self.model = pin.buildReducedModel(model, idle, values)
        self.data, self.frame = self.model.createData(), self.model.getFrameId(self.tip)

    def placement(self, q: Array) -> pin.SE3:
        """Of the tool."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.frame].copy()

    def jacobian(self, q: Array) -> Array:
        """Of the tool, in the world's axes (m, n), linear rows first."""
        J = pin.computeFrameJacobian(self.model, self.data, q, self.frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        return np.asarray(J[: self.chart.m])

    def error(self, q: Array, wanted: pin.SE3) -> Array:
        """Position [m], and rotation [rad] for a pose, in the world's axes (m,)."""
        found = self.placement(q)
        turn = found.rotation @ pin.log3(found.rotation.T @ wanted.rotation)
        return np.concatenate([wanted.translation - found.translation, turn])[: self.chart.m]

    def target(self, q: Array, posture: Array | None = None, shift: Array | None = None) -> Target:
        """The tool as at q, or shifted (3,), and a posture; default q."""
        shift = np.zeros(3) if shift is None else shift
        placement, x = self.placement(q), self.chart.task(q)
        x[:3] += shift
        return Target(x, pin.SE3(placement.rotation, placement.translation + shift), q if posture is None else posture)


class OnChart:
    """The tracker of a chart. It holds still where there is no q inside the domain."""

    def __init__(self, chart: oc.Chart) -> None:
        self.chart = chart

    def start(self, q: Array) -> None:
        """Begin at q."""
        self.tracker = self.chart.tracker(q, largest_step=np.inf)

    def command(self, target: Target) -> Array:
        """phi."""
        return np.concatenate([target.x, self.chart.xi(target.posture)])

    def tick(self, command: Array) -> Array:
        """Follow."""
        return self.tracker.step(command)

    def solution(self, command: Array) -> Array:
        """With the wanted x, and xi as near as possible."""
        return self.chart.solve(command, inside=True).q[0]


class Pink:
    """One step of a quadratic program per tick."""

    period = TICK

    def __init__(self, arm: Arm, cost: float) -> None:
        self.pink, self.arm = import_module("pink"), arm
        turning = 0.0 if arm.task == "position" else 1.0
        self.frame = self.pink.tasks.FrameTask(arm.tip, position_cost=1.0, orientation_cost=turning)
        self.posture = self.pink.tasks.PostureTask(cost=cost)
        self.tasks = [self.frame, *([self.posture] if cost else [])]

    def start(self, q: Array) -> None:
        """Begin at q."""
        self.configuration = self.pink.Configuration(self.arm.model, self.arm.model.createData(), q)

    def command(self, target: Target) -> Target:
        """As it is."""
        return target

    def tick(self, command: Target) -> Array:
        """Solve and integrate."""
        self.frame.set_target(command.placement)
        self.posture.set_target(command.posture)
        with suppress(self.pink.exceptions.NoSolutionFound):  # it holds still
            velocity = self.pink.solve_ik(self.configuration, self.tasks, self.period, "daqp", safety_break=False)
            self.configuration.integrate_inplace(velocity, self.period)
        return np.array(self.configuration.q)


class Mink:
    """The same with MuJoCo's kinematics."""

    period = TICK

    def __init__(self, arm: Arm, cost: float) -> None:
        self.mink = import_module("mink")
        self.model = MuJoCoPlant(arm.robot).model
        turning = 0.0 if arm.task == "position" else 1.0
        self.frame = self.mink.FrameTask("tip", "body", position_cost=1.0, orientation_cost=turning)
        self.posture = self.mink.PostureTask(self.model, cost=cost)
        self.tasks = [self.frame, *([self.posture] if cost else [])]
        fastest = {f"joint{i}": limit for i, limit in enumerate(arm.robot.velocity_limits)}
        self.limits = [self.mink.ConfigurationLimit(self.model), self.mink.VelocityLimit(self.model, fastest)]

    def start(self, q: Array) -> None:
        """Begin at q."""
        self.configuration = self.mink.Configuration(self.model, q)

    def command(self, target: Target) -> tuple[Any, Array]:
        """Pose and posture."""
        return self.mink.SE3.from_matrix(target.placement.homogeneous), target.posture

    def tick(self, command: tuple[Any, Array]) -> Array:
        """Solve and integrate."""
        self.frame.set_target(command[0])
        self.posture.set_target(command[1])
        with suppress(self.mink.NoSolutionFound):  # it holds still
            velocity = self.mink.solve_ik(self.configuration, self.tasks, self.period, "daqp", limits=self.limits)
            self.configuration.integrate_inplace(velocity, self.period)
        return np.array(self.configuration.q)


class PseudoInverse:
    """dq = J^+ e / dt: the whole error in one tick."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm

    def start(self, q: Array) -> None:
        """Begin at q."""
        self.q = q

    def command(self, target: Target) -> pin.SE3:
        """Only the tool."""
        return target.placement

    def tick(self, command: pin.SE3) -> Array:
        """The shortest joint motion."""
        error = self.arm.error(self.q, command)
        self.q = self.q + np.linalg.pinv(self.arm.jacobian(self.q)) @ error
        return self.q


class SSIK:
    """The tracker of ssik on a pose. Its redundancy coordinate takes the place of the posture."""

    def __init__(self, arm: Arm) -> None:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(arm.file)
            self.ik = import_module("ssik").Manipulator.from_urdf(path, base=arm.model.frames[1].name, ee=arm.tip)

    def start(self, q: Array) -> None:
        """Begin at q."""
        self.tracker = self.ik.tracker(q)

    def command(self, target: Target) -> Array:
        """The pose."""
        return np.asarray(target.placement.homogeneous)

    def tick(self, command: Array) -> Array:
        """Follow."""
        return np.array(self.tracker.update(command).q)

    def solution(self, command: Array) -> Array:
        """The solution nearest to where it began, on any branch."""
        solutions = self.ik.solve(command, max_solutions=1, q_seed=self.tracker.q)
        return np.array(solutions[0].q if solutions else self.tracker.q)


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


def smooth(share: Array) -> Array:
    """From 0 to 1 and back to 0, at rest at both ends and in the middle."""
    s = np.minimum(2 * share, 2 - 2 * share)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def circles(arm: Arm, count: int) -> list[Target]:
    """The tool follows a horizontal circle through where it is; the posture is that of the start."""
    angles = 2 * np.pi * TICK / PERIOD * np.arange(1, round(count * PERIOD / TICK) + 1)
    shifts = RADIUS * np.stack([np.cos(angles) - 1, np.sin(angles), 0 * angles], axis=1)
    return [arm.target(arm.home, shift=shift) for shift in shifts]


def self_motion(arm: Arm) -> list[Target]:
    """The tool rests, the first extra coordinate goes out and back."""
    chart, q, targets = arm.chart, arm.home, []
    size = MOVE / np.abs(np.linalg.inv(chart.jacobian(q))[:, chart.m]).max()
    for share in smooth(np.arange(TICK, MOVE_TIME, TICK) / MOVE_TIME):
        wanted = chart.phi(arm.home)
        wanted[chart.m] += share * size
        q = chart.inverse(wanted, q)
        targets.append(arm.target(arm.home, posture=q))
    return [*targets, arm.target(arm.home)]


def lines(arm: Arm, count: int) -> Iterator[list[Target]]:
    """The tool goes out on a line and back, in random directions; the posture is that of the start."""
    directions = np.random.default_rng(5).standard_normal((count, 3))
    for direction in directions / np.linalg.norm(directions, axis=1)[:, None]:
        shares = smooth(np.arange(TICK, LINE_TIME, TICK) / LINE_TIME)
        yield [arm.target(arm.home, shift=LENGTH * share * direction) for share in shares]


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


def found(method: Method, arm: Arm, points: Array) -> float:
    """Share of targets, those of joint positions (N, n), that are reached from home within the joint limits."""
    at_once = isinstance(method, OnChart | SSIK)
    if isinstance(method, Pink | Mink):
        method.period = UNHURRIED  # limits of velocity stop nothing here
    close, count = np.where(np.arange(arm.chart.m) < 3, CLOSE, CLOSE_TURN), 0
    for q in points:
        target = arm.target(q, posture=arm.home)
        method.start(arm.home)
        command = method.command(target)
        steps = 1 if at_once else STEPS
        for _ in range(steps):
            reached = method.solution(command) if at_once else method.tick(command)
            if (np.abs(arm.error(reached, target.placement)) < close).all():
                count += bool(inside_limits(arm, reached[None])[0])
                break
    return count / len(points)


def inside_limits(arm: Arm, q: Array) -> Array:
    """Whether joint positions (N, n) keep the robot's limits, (N,)."""
    return np.asarray(((q >= arm.robot.lower - 1e-9) & (q <= arm.robot.upper + 1e-9)).all(axis=1))


def methods(arm: Arm) -> Iterator[tuple[str, Callable[[], Method]]]:
    """Those that can be had here, by the names of the rows."""
    yield "chart", lambda: OnChart(arm.chart)
    if arm.task == "pose":
        with suppress(RobotError):
            sew = oc.fit(arm.chart.problem, oc.SEW()).chart
            yield "stereographic SEW", lambda: OnChart(sew)
    for name, kind in (("pink", Pink), ("mink", Mink)):
        if find_spec(name):
            for cost in (0.0, 1e-3, 1e-2):
                yield f"{name}, posture {cost:g}", lambda kind=kind, cost=cost: kind(arm, cost)
    if arm.task == "pose" and find_spec("ssik"):
        yield "ssik", lambda: SSIK(arm)
    yield "pseudo-inverse", lambda: PseudoInverse(arm)


def row(name: str, method: Method, arm: Arm, options: argparse.Namespace) -> str:
    """All columns of a method."""
    turned = followed(method, arm, circles(arm, options.circles), arm.home)
    drift = float(np.abs(turned.q[-1] - arm.home).max())
    named = isinstance(method, SSIK) and method.ik.tracker(arm.home).redundancy is not None
    error, reached, left = moved_by_ssik(method, arm) if named else moved_itself(method, arm)
    runs = [followed(method, arm, line, arm.home) for line in lines(arm, options.lines)]
    whole = sum(bool(run.errors.max() < FOLLOWED) for run in runs)
    outside = sum(int((~inside_limits(arm, run.q)).sum()) for run in runs)
    fastest = max(float(np.abs(np.diff(run.q, axis=0)).max()) / TICK for run in runs)
    rng = np.random.default_rng(7)
    everywhere = rng.uniform(
        np.maximum(arm.robot.lower, -np.pi), np.minimum(arm.robot.upper, np.pi), (options.targets, arm.robot.n)
    )
    near = sample_uniform(arm.domain, options.targets, 8)
    return (
        f"| {name} | {drift:.1e} | {1e3 * error:.2g} | {100 * reached:.0f} % | {left:.1e} | {whole} of {len(runs)} "
        f"| {outside} | {fastest:.1f} | {100 * found(method, arm, near):.1f} % "
        f"| {100 * found(method, arm, everywhere):.1f} % | {1e6 * np.median(turned.seconds):.0f} |"
    )


def main() -> None:
    """Print a table in Markdown for each arm and task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--circles", type=int, default=50)
    parser.add_argument("--lines", type=int, default=40)
    parser.add_argument("--targets", type=int, default=10_000)
    parser.add_argument("--arms", nargs="+", default=ARMS, choices=ARMS)
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    parser.add_argument("--quick", action="store_true", help="one arm, short runs")
    options = parser.parse_args()
    if options.quick:
        options.circles, options.lines, options.targets, options.arms = 1, 2, 20, ARMS[:1]
    for task in options.tasks:
        for name in options.arms:
            arm = Arm(name, task)
            print(f"\n**{name}, {task}**\n")
            print(f"| {' | '.join(COLUMNS)} |\n" + "| --- " * len(COLUMNS) + "|")
            for label, build in methods(arm):
                print(row(label, build(), arm, options), flush=True)


if __name__ == "__main__":
    main()
