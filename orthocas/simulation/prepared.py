"""A closed loop that is ready to run: arguments checked, functions built and compiled."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import Batched
from orthocas.checks import Array, as_number, as_point, require_kind
from orthocas.control.controller import Controller
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.coordinates.turns import shortest
from orthocas.errors import Interrupted, InvalidValueError, SimulationError
from orthocas.minimising.watch import Monitor, Progress
from orthocas.simulation.closed_loop import ClosedLoop, Piece
from orthocas.simulation.compiled_loop import CompiledLoop
from orthocas.simulation.continuous import integrate
from orthocas.simulation.disturbances import Friction, Noise, Push, Stops
from orthocas.simulation.loads import Loads
from orthocas.simulation.mujoco_scene import MuJoCo
from orthocas.simulation.physics import run_physics
from orthocas.simulation.run_checks import Plant, plant_of, require_fitting, require_kinds
from orthocas.simulation.sampled import run_ticks
from orthocas.simulation.supervised import SupervisedLaw, run_supervised
from orthocas.simulation.trajectory import Outcome, Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Settings:
    """The keyword arguments of `simulate`."""

    dq_start: ArrayLike | None
    step: float
    control_rate: float | None
    plant: Plant
    pushes: Sequence[Push]
    friction: Friction | None
    stops: Stops | None
    noise: Noise | None
    safety: Safety | None
    resume_after: float
    must_be_reachable: bool
    tolerance: float
    compiled: bool

    def require_numbers(self) -> None:
        """Raise InvalidValueError unless step, tolerance and rate are finite and positive."""
        rate = 1.0 if self.control_rate is None else self.control_rate
        for name, value in (("step", self.step), ("tolerance", self.tolerance), ("control_rate", rate)):
            if not 0 < as_number(name, value) < np.inf:
                raise InvalidValueError(name, value, "a finite number > 0")


def prepare(controller: Controller, reference: Reference, q_start: ArrayLike, settings: Settings) -> "Prepared":
    """Check the arguments of `simulate`, and build what the run needs."""
    friction, noise, rate = settings.friction, settings.noise, settings.control_rate
    require_kinds(controller, reference, settings.pushes, {Friction: friction, Stops: settings.stops, Noise: noise})
    robot, scene = plant_of(settings.plant, controller)
    loop = ClosedLoop(controller, robot, friction or Friction(), Loads(robot.tree, settings.pushes), settings.stops)
    settings.require_numbers()
    require_fitting(loop, reference, friction, noise, rate, scene is not None, settings.safety)
    _require_compilable(settings, scene)
    start = _start_state(loop, q_start, settings.dq_start)
    if settings.must_be_reachable:
        controller.require_reachable(reference, start[: loop.n])
    compiled = CompiledLoop(loop, reference) if settings.compiled else None
    if rate is None:
        pieces = partial(integrate, step=settings.step, tolerance=settings.tolerance, compiled=compiled)
    else:
        law = None
        if settings.safety is not None:
            law = SupervisedLaw(controller, settings.safety, settings.resume_after, 1 / rate)
        ticks = _ticks(scene, settings.tolerance, law, compiled)
        pieces = partial(ticks, rate=rate, noise=noise or Noise())
    return Prepared(loop, reference, start, pieces, compiled)


def _require_compilable(settings: Settings, scene: MuJoCo | None) -> None:
    """Raise InvalidValueError where a compiled run is asked of something else."""
    require_kind("compiled", settings.compiled, bool)
    if settings.compiled and (scene is not None or settings.safety is not None):
        what = "safety" if scene is None else "MuJoCo"
        raise InvalidValueError("compiled", True, f"False with {what}, which runs tick by tick from Python")


@dataclass(frozen=True, eq=False)
class Prepared:
    """A closed loop that is ready to run, once."""

    loop: ClosedLoop
    reference: Reference
    start: Array  #: state at t = 0
    pieces: Callable[[ClosedLoop, Reference, Array], Iterator[Piece]]
    compiled: CompiledLoop | None

    def run(self, monitor: Monitor) -> Trajectory:
        """Simulate.

        Raises:
            Interrupted: after Ctrl-C; its `result` is the trajectory up to there, with outcome INTERRUPTED.
        """
        pieces: list[Piece] = []
        outcome = Outcome.COMPLETE
        try:
            for piece in self.pieces(self.loop, self.reference, self.start):
                pieces.append(piece)
                monitor(_progress(self.loop.controller.name, piece.times[-1], self.reference.duration))
        except KeyboardInterrupt:
            outcome = Outcome.INTERRUPTED
        except SimulationError:
            outcome = Outcome.DIVERGED
        try:
            run = self._trajectory(pieces, outcome)
        except KeyboardInterrupt:  # keep the run up to here
            run = self._trajectory(pieces, Outcome.INTERRUPTED)
        if run.outcome is Outcome.INTERRUPTED:
            raise Interrupted(run)
        return run

    def _trajectory(self, pieces: Sequence[Piece], outcome: Outcome) -> Trajectory:
        """Join the pieces, and add what follows from the states and the reference."""
        loop, controller, n = self.loop, self.loop.controller, self.loop.n
        times = np.concatenate([[0.0], *(piece.times for piece in pieces)])
        states = np.vstack([self.start, *(piece.states for piece in pieces)])
        q = states[:, :n]
        wanted = self.reference.sample(np.minimum(times, self.reference.duration))
        dq = states[:, n:] if loop.torque else np.zeros_like(q)
        command, status, cause = self._commands(pieces, q, dq, *wanted)
        energy = controller.energy if self.compiled is None else controller.energy_graph
        unknown = [np.full((len(times), 1), np.nan)] * 2
        storage, power = unknown if energy is None else self._rows("energy", q, dq, *wanted)
        return Trajectory(
            controller=controller.name,
            kind=controller.command,
            outcome=outcome,
            labels=controller.labels,
            joint_names=loop.plant.joint_names,
            times=times,
            q=q,
            dq=dq if loop.torque else command,
            command=command,
            status=status.ravel().astype(int),
            value=_near(controller, self._rows("measured", q)[0], wanted[0]),
            reference=wanted[0],
            reference_velocity=wanted[1],
            reference_acceleration=wanted[2],
            storage=storage[:, 0],
            dissipated_power=power[:, 0],
            cause=cause.astype(int),
        )

    def _commands(self, pieces: Sequence[Piece], *arguments: Array) -> tuple[Array, Array, Array]:
        """Commands, status and causes: those that were held, the last one also for the end, or those of the law."""
        held = [piece.held for piece in pieces if piece.held is not None]
        if not held:
            command, status = self._rows("command", *arguments)
            return command, status, np.zeros(len(command))
        columns = ([part.commands for part in held], [part.status for part in held], [part.cause for part in held])
        command, status, cause = (np.concatenate([*parts, parts[-1][-1:]]) for parts in columns)
        return command, status, cause

    def _rows(self, name: str, *arguments: Array) -> list[Array]:
        """`command`, `energy` or `measured` of the law for N rows of arguments."""
        if self.compiled is not None:
            return self.compiled.rows(name, *arguments)
        controller = self.loop.controller
        if name == "measured":
            return Batched(controller.measured)(*arguments)
        function = controller.function if name == "command" else controller.energy
        assert function is not None
        gains = [np.tile(gain, (len(arguments[0]), 1)) for gain in controller.gains.values()]
        return Batched(function)(*arguments, *gains)


def _ticks(
    scene: MuJoCo | None, tolerance: float, law: SupervisedLaw | None, compiled: CompiledLoop | None
) -> Callable[..., Iterator[Piece]]:
    """What runs a sampled controller: MuJoCo, CVODES or compiled C, with the law alone or the supervised one."""
    if scene is not None:
        return partial(run_physics, scene=scene, supervised=law)
    if law is not None:
        return partial(run_supervised, tolerance=tolerance, law=law)
    return partial(run_ticks, tolerance=tolerance, compiled=compiled)


def _progress(name: str, time: float, duration: float) -> Progress:
    return Progress(f"simulate {name}", time / duration, f"{time:.1f} s")


def _start_state(loop: ClosedLoop, q_start: ArrayLike, dq_start: ArrayLike | None) -> Array:
    q = as_point("q_start", q_start, loop.n)
    if not loop.torque:
        if dq_start is not None:
            raise InvalidValueError(
                "dq_start", dq_start, "None, because velocity is not a state with a velocity controller"
            )
        return q
    return np.concatenate([q, np.zeros(loop.n) if dq_start is None else as_point("dq_start", dq_start, loop.n)])


def _near(controller: Controller, value: Array, wanted: Array) -> Array:
    """Measured quantities (N, k), circle-valued ones with the whole turns that bring them nearest to the reference."""
    chart = controller.chart
    if chart is None or controller.labels != chart.labels:
        return value
    return np.asarray(wanted + shortest(value - wanted, chart.turns)) if chart.turns.any() else value
