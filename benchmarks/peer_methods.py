"""Methods that hold a redundant arm's posture: charts, and the solvers and laws that people use instead."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np
import pinocchio as pin
from peer_arms import TICK, Arm, Target
from scipy.spatial import KDTree
from textbook_law import TextbookLaw

import orthocas as oc
from orthocas.codegen import CompiledLibrary, compile_shared
from orthocas.control import PDPlus
from orthocas.control.gains import SPRING_FREQUENCY
from orthocas.errors import RobotError, SimulationError
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array

KNOWN, TRIED = 20_000, 40  # joint positions of an atlas, and how many of them are tried


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

    def solutions(self, commands: Array) -> Array:
        """With the wanted x, and xi as near as possible, (N, n), all at once."""
        return self.chart.solve(commands, inside=True).q


class OnAtlas:
    """An atlas with a position task, for targets only: in the charts of known positions whose tool is nearest."""

    def __init__(self, arm: Arm, path: str) -> None:
        self.atlas = oc.Atlas.load(path)
        low, high = np.maximum(arm.robot.lower, -np.pi), np.minimum(arm.robot.upper, np.pi)
        q = np.random.default_rng(0).uniform(low, high, (KNOWN, arm.robot.n))
        charts = self.atlas.chart_at(q)
        self.q, self.charts = q[charts >= 0], charts[charts >= 0]
        self.xi, self.tree = self.atlas.xi(self.q, self.charts), KDTree(arm.chart.task(self.q))
        self.robot, self.middle = arm.robot, arm.home

    def command(self, target: Target) -> Array:
        """The position of the tool."""
        return target.x

    def solutions(self, commands: Array) -> Array:
        """With the wanted x, and xi as at a known position, (N, n), all at once; the middle where none is found."""
        near = self.tree.query(commands, TRIED)[1]
        q = np.tile(self.middle, (len(commands), 1))
        left = np.arange(len(commands))
        for known in near.T:
            rows = known[left]
            found = self.atlas.inverse(commands[left], self.xi[rows], self.charts[rows], self.q[rows])
            good = ((found >= self.robot.lower) & (found <= self.robot.upper)).all(axis=1)  # NaN is not
            q[left[good]] = found[good]
            left = left[~good]
            if not left.size:
                break
        return q


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


class OperationalSpace:
    """The textbook's controller with a posture at 1 kHz, on the arm in MuJoCo. Ten calls are one tick.

    The target moves straight from tick to tick, with feed-forward of its velocity. Where the simulation fails, the arm
    stays.
    """

    calls = 10
    feed_forward = True

    def __init__(self, arm: Arm) -> None:
        self.plant, law = MuJoCoPlant(arm.robot), PDPlus.on_chart(arm.chart)
        self.folder = TemporaryDirectory()  # it lives as long as the method
        generated = oc.generate_c(arm.chart, self.folder.name, law, "peer")
        library = CompiledLibrary(compile_shared(generated, generated.folder), "peer", arm.chart.n)
        self.task, self.law = arm.chart.task, TextbookLaw(library, arm.chart.m, SPRING_FREQUENCY, 0.7)

    def start(self, q: Array) -> None:
        """Begin at rest at q."""
        self.plant.reset(q)
        self.q, self.last = q, (self.task(q), q)

    def command(self, target: Target) -> tuple[Array, Array]:
        """Task and posture."""
        return target.x, target.posture

    def tick(self, command: tuple[Array, Array]) -> Array:
        """Simulate."""
        before, rates = self.last, [0 * value for value in command]
        if self.feed_forward:
            rates = [(new - old) / TICK for new, old in zip(command, before, strict=True)]
        else:
            before = command
        with suppress(SimulationError):
            for k in range(1, self.calls + 1):
                x, posture = (old + k / self.calls * TICK * rate for old, rate in zip(before, rates, strict=True))
                wanted = np.stack([x, rates[0], 0 * x]), np.stack([posture, rates[1]])
                self.plant.step(self.law.command(self.plant.q, self.plant.dq, *wanted), TICK / self.calls)
                self.q = self.plant.q
        self.last = command
        return self.q


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
    yield "operational space", lambda: OperationalSpace(arm)
