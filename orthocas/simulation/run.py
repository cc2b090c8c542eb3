"""`simulate` and `simulate_many`: run a controller, a reference and a robot in closed loop."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from orthocas.control.controller import Controller, get_counted_function, require_controller
from orthocas.control.memory import find_memory
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.errors import Interrupted, InvalidValueError, SimulationError
from orthocas.robots.robot import Robot
from orthocas.simulation.disturbances import RULES, Friction, Loads, Noise, Push, Stops
from orthocas.simulation.loops import (
    ClosedLoop,
    CompiledLoop,
    LawWithMemory,
    Piece,
    SupervisedLaw,
    integrate,
    run_physics,
    run_supervised,
    run_ticks,
)
from orthocas.simulation.mujoco_plant import MUJOCO, MuJoCo
from orthocas.simulation.trajectory import Outcome, Trajectory, find_loss
from orthocas.tools.batch import THREADS, Batched
from orthocas.tools.checks import Array, as_point, require_executor, require_kind, require_known, require_positive
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.progress import Monitor, Progress, silent

Plant = Robot | MuJoCo | Literal["mujoco"] | None  #: the true robot, or MuJoCo with it; None: the controller's model


def simulate(
    controller: Controller,
    reference: Reference,
    q_start: ArrayLike,
    *,
    dq_start: ArrayLike | None = None,
    step: float = 0.01,
    control_rate: float | None = None,
    plant: Plant = None,
    pushes: Sequence[Push] = (),
    friction: Friction | None = None,
    stops: Stops | None = None,
    noise: Noise | None = None,
    safety: Safety | None = None,
    resume_after: float = 1.0,
    must_be_reachable: bool = True,
    tolerance: float = RULES.tolerance,
    compiled: bool = False,
    monitor: Monitor = silent,
) -> Trajectory:
    """Simulate a closed loop for the duration of the reference, with SUNDIALS (CVODES), in compiled C or with MuJoCo.

    With a torque controller, the robot obeys M ddq + C dq + g = tau + loads - friction ([AS2023] eq. (26)). With a
    velocity controller it follows its command exactly, dq = command. In MuJoCo, joints also stop at their limits,
    motors saturate at the robot's effort limits, and the tip may touch a wall.

    Args:
        controller: a controller of `orthocas.control`.
        reference: the reference motion, with the labels of the controller.
        q_start: joint positions at t = 0, (n,) [rad] or [m].
        dq_start: joint velocities at t = 0, (n,); default: at rest. For torque controllers only.
        step: longest time between two instants of the result [s].
        control_rate: ticks per second of a sampled controller, which holds its command between ticks. The result then
            has one instant per tick. Default: a controller in continuous time.
        plant: the true robot, for example `robot.with_scaled_masses(1.1)`; default: the controller's model. Or
            "mujoco", or `MuJoCo(robot, ...)`: the robot in MuJoCo, for sampled torque controllers (extra
            `orthocas[mujoco]`).
        pushes: external loads at the tip, at links or at joints.
        friction: friction in the joints.
        stops: joint stops for CVODES; default: none. For torque controllers only. MuJoCo has its own stops.
        noise: noise on the measurements of a sampled controller.
        safety: run the supervised law of the generated C with these settings, for example
            `oc.control.Safety.of(controller)`, instead of the law alone. Needs a law on a chart, a `control_rate` and a
            C compiler. As on the robot, the run begins with NAME_start; `status` and `cause` of the result tell what
            happened.
        resume_after: with `safety`, time from a catch until the law is requested again [s]; infinite: never.
        must_be_reachable: whether to raise an error before the run if the reference leaves the domain.
        tolerance: relative and absolute tolerance of the integrator.
        compiled: run law, robot and integrator in C (Dormand and Prince's method of order 8), with the same results
            within the tolerance. The first run with a law compiles it, which takes some seconds. Libraries are cached
            in `orthocas/libraries` in $XDG_CACHE_HOME or ~/.cache. Needs a C compiler; not with `safety` or MuJoCo.
        monitor: receives progress.

    Returns:
        The trajectory. Its outcome tells whether the run ended early because the integrator failed, or whether the law
        lost the arm: LOST with a `reason`, see `orthocas.simulation.trajectory.find_loss`.

    Raises:
        UnreachableReferenceError: if the reference leaves the domain.
        MissingExtraError: if MuJoCo is the plant and not installed.
        CompileError: if C must be compiled and there is no C compiler.
        ShapeError, InvalidValueError, UnknownNameError: for arguments of the wrong shape, value or type.
        Interrupted: after Ctrl-C; its `result` is the trajectory so far, with outcome INTERRUPTED.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> problem = problems.get("planar_3r_xy")
        >>> chart = oc.fit(problem, oc.Polynomial(degree=2), samples=300).chart
        >>> controller = oc.control.PDPlus(chart, stiffness=50.0)
        >>> start = chart.phi(problem.domain.centre)
        >>> reference = oc.control.Reference.steps(chart.labels, start, [(0.1, {"x": start[0] + 0.05})], duration=0.5)
        >>> trajectory = oc.simulate(controller, reference, problem.domain.centre)
        >>> trajectory.outcome.value, bool(abs(trajectory.value - trajectory.reference).max() < 0.01)
        ('complete', True)
    """
    settings = Settings(
        dq_start=dq_start,
        step=step,
        control_rate=control_rate,
        plant=plant,
        pushes=pushes,
        friction=friction,
        stops=stops,
        noise=noise,
        safety=safety,
        resume_after=resume_after,
        must_be_reachable=must_be_reachable,
        tolerance=tolerance,
        compiled=compiled,
    )
    return prepare(controller, reference, q_start, settings).run(monitor)


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


def prepare(controller: Controller, reference: Reference, q_start: ArrayLike, settings: Settings) -> Prepared:
    """Check the arguments of `simulate`, and build the closed loop."""
    friction, noise, rate = settings.friction, settings.noise, settings.control_rate
    _check_kinds(controller, reference, settings)
    robot, scene = _read_plant(settings.plant, controller)
    loop = ClosedLoop(controller, robot, friction or Friction(), Loads(robot.tree, settings.pushes), settings.stops)
    _check_settings(loop, reference, settings, scene)
    start, dq_start = as_point("q_start", q_start, loop.n), settings.dq_start
    if loop.torque:
        dq = np.zeros(loop.n) if dq_start is None else as_point("dq_start", dq_start, loop.n)
        start = np.concatenate([start, dq])
    elif dq_start is not None:
        expected = "None, because velocity is not a state with a velocity controller"
        raise InvalidValueError("dq_start", dq_start, expected)
    if settings.must_be_reachable:
        controller.require_reachable(reference, start[: loop.n])
    compiled = CompiledLoop(loop, reference) if settings.compiled else None

    # Choose what runs the loop: in continuous time, or tick by tick in MuJoCo, in CVODES or in compiled C.
    run: Callable[..., Iterator[Piece]]
    if rate is None:
        run = partial(integrate, step=settings.step, tolerance=settings.tolerance, compiled=compiled)
    else:
        law: SupervisedLaw | LawWithMemory | None = None
        if settings.safety is not None:
            law = SupervisedLaw(controller, settings.safety, settings.resume_after, 1 / rate)
        elif find_memory(controller) is not None:
            law = LawWithMemory(controller, 1 / rate)
        if scene is not None:
            run = partial(run_physics, scene=scene, supervised=law)
        elif law is not None:
            run = partial(run_supervised, tolerance=settings.tolerance, law=law)
        else:
            run = partial(run_ticks, tolerance=settings.tolerance, compiled=compiled)
        run = partial(run, rate=rate, noise=noise or Noise())
    return Prepared(loop, reference, start, run, compiled, settings.safety is not None)


def _check_kinds(controller: Controller, reference: Reference, settings: Settings) -> None:
    """Raise InvalidValueError for objects of the wrong class."""
    require_controller(controller)
    require_kind("reference", reference, Reference)
    for kind, value in ((Friction, settings.friction), (Stops, settings.stops), (Noise, settings.noise)):
        if value is not None:
            require_kind(kind.__name__.lower(), value, kind)
    require_kind("pushes", settings.pushes, Sequence)
    for push in settings.pushes:
        require_kind("an entry of pushes", push, Push)


def _read_plant(plant: Plant, controller: Controller) -> tuple[Robot, MuJoCo | None]:
    """The true robot, and the scene if MuJoCo simulates it.

    Raises:
        InvalidValueError: if the plant is of another type.
    """
    model = controller.problem.robot
    scene = MuJoCo() if isinstance(plant, str) and plant == MUJOCO else plant
    if scene is None or isinstance(scene, Robot):
        return scene or model, None
    if isinstance(scene, MuJoCo):
        return scene.robot or model, scene
    received = repr(plant)[:80] if isinstance(plant, str | int | float) else f"a {type(plant).__name__}"
    raise InvalidValueError("plant", received, f"a Robot, '{MUJOCO}' or a MuJoCo")


def _check_settings(loop: ClosedLoop, reference: Reference, settings: Settings, scene: MuJoCo | None) -> None:
    """Raise InvalidValueError for arguments that would be ignored, or would fail later with an unclear message."""
    rate, end, law = settings.control_rate, reference.duration, loop.controller
    for name, value in (("step", settings.step), ("tolerance", settings.tolerance), ("control_rate", rate)):
        if value is not None:
            require_positive(name, value)
    require_kind("compiled", settings.compiled, bool)
    sampled, in_mujoco, remembers = rate is not None, scene is not None, find_memory(law) is not None
    forces = bool(loop.loads.pushes) or settings.friction is not None or loop.stops is not None
    forces = forces or loop.plant is not law.problem.robot
    last_push = max((push.start for push in loop.loads.pushes), default=0.0)
    ticks = (rate or 0.0) * end
    in_python = "MuJoCo" if in_mujoco else "safety"
    faults = (
        # Arguments that do not fit together.
        (
            reference.labels != law.labels,
            "labels of the reference",
            reference.labels,
            f"those of the controller {law.labels}",
        ),
        (loop.n != law.problem.n, "joints of the plant", loop.n, f"{law.problem.n}, as in the controller's robot"),
        (
            not loop.torque and forces,
            "pushes, friction, stops or plant",
            "given",
            "none of them, because forces do not affect a velocity controller",
        ),
        (last_push >= end, "start of a push", last_push, f"a time before the end at {end:g} s"),
        (sampled and ticks < 1, "control_rate", rate, f"at least one tick in {end:g} s"),
        (ticks > RULES.most_ticks, "control_rate", rate, f"at most {RULES.most_ticks:g} ticks in {end:g} s"),
        # Arguments that require ticks.
        (
            settings.noise is not None and not sampled,
            "noise",
            settings.noise,
            "no noise without control_rate, because white noise needs control ticks",
        ),
        (
            settings.safety is not None and not sampled,
            "control_rate",
            None,
            "a number, because a supervised law runs tick by tick",
        ),
        (in_mujoco and not sampled, "control_rate", None, "a number, because MuJoCo runs with a sampled controller"),
        (remembers and not sampled, "control_rate", None, "a rate, such as 1000.0, for a law with a memory"),
        # Arguments that MuJoCo or compiled C do not support.
        (
            in_mujoco and not loop.torque,
            "plant",
            MUJOCO,
            "no MuJoCo with a velocity controller, which commands no torques",
        ),
        (
            in_mujoco and loop.stops is not None,
            "stops",
            "given",
            "none with MuJoCo, which has its own: MuJoCo(stops=True)",
        ),
        (
            settings.compiled and (in_mujoco or settings.safety is not None),
            "compiled",
            True,
            f"False with {in_python}, which runs tick by tick from Python",
        ),
        (settings.compiled and remembers, "compiled", True, "False for a law with a memory"),
    )
    for wrong, argument, received, expected in faults:
        if wrong:
            raise InvalidValueError(argument, received, expected)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A closed loop that can run once."""

    loop: ClosedLoop
    reference: Reference
    start: Array  #: state at t = 0
    pieces: Callable[[ClosedLoop, Reference, Array], Iterator[Piece]]
    compiled: CompiledLoop | None
    supervised: bool

    def run(self, monitor: Monitor) -> Trajectory:
        """Run the simulation.

        Raises:
            Interrupted: after Ctrl-C; its `result` is the trajectory so far, with outcome INTERRUPTED.
        """
        # A run that ends early is a result too.
        pieces: list[Piece] = []
        outcome = Outcome.COMPLETE
        try:
            for piece in self.pieces(self.loop, self.reference, self.start):
                pieces.append(piece)
                time = piece.times[-1]
                name = f"simulate {self.loop.controller.name}"
                monitor(Progress(name, time / self.reference.duration, f"{time:.1f} s"))
        except KeyboardInterrupt:
            outcome = Outcome.INTERRUPTED
        except SimulationError:
            outcome = Outcome.DIVERGED
        try:
            run = self._build_trajectory(pieces, outcome)
        except KeyboardInterrupt:
            # Keep the run so far.
            run = self._build_trajectory(pieces, Outcome.INTERRUPTED)
        if run.outcome is Outcome.INTERRUPTED:
            raise Interrupted(run)
        return run

    def _build_trajectory(self, pieces: Sequence[Piece], outcome: Outcome) -> Trajectory:
        """Join the pieces, and compute the quantities that follow from states and reference."""
        loop, controller, n = self.loop, self.loop.controller, self.loop.n
        # The state at t = 0, then the states at the ends of all steps.
        times = np.concatenate([[0.0], *(piece.times for piece in pieces)])
        states = np.vstack([self.start, *(piece.states for piece in pieces)])
        q = states[:, :n]
        target = self.reference.sample(np.minimum(times, self.reference.duration))
        dq = states[:, n:] if loop.torque else np.zeros_like(q)
        # Take the held commands, and repeat the last one at the end. In continuous time, evaluate the law.
        held = [piece.held for piece in pieces if piece.held is not None]
        if held:
            columns = ([part.commands for part in held], [part.status for part in held], [part.cause for part in held])
            command, status, cause = (np.concatenate([*parts, parts[-1][-1:]]) for parts in columns)
        else:
            command, status = self._evaluate("command", q, dq, *target)
            cause = np.zeros(len(command))
        energy = controller.energy if self.compiled is None else controller.energy_graph
        unknown = [np.full((len(times), 1), np.nan)] * 2
        storage, power = unknown if energy is None else self._evaluate("energy", q, dq, *target)
        value, chart = self._evaluate("measured", q)[0], controller.chart
        if chart is not None and controller.labels == chart.labels and chart.parts.turns.any():
            # Shift circle-valued quantities by the full turns that bring them nearest to the reference.
            value = np.asarray(target[0] + wrap_shortest(value - target[0], chart.parts.turns))
        run = Trajectory(
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
            value=value,
            reference=target[0],
            reference_velocity=target[1],
            reference_acceleration=target[2],
            storage=storage[:, 0],
            dissipated_power=power[:, 0],
            cause=cause.astype(int),
        )
        # A law may continue although it has lost the arm.
        reason = find_loss(run, controller, loop.loads.pushes, self.supervised) if outcome is Outcome.COMPLETE else ""
        return replace(run, outcome=Outcome.LOST, reason=reason) if reason else run

    def _evaluate(self, name: str, *arguments: Array) -> list[Array]:
        """`command`, `energy` or `measured` of the law for N rows of arguments."""
        # Compiled runs use the law in C, and others use CasADi.
        if self.compiled is not None:
            return self.compiled.rows(name, *arguments)
        controller = self.loop.controller
        if name == "measured":
            return Batched(controller.measured)(*arguments)
        function = get_counted_function(controller, "function" if name == "command" else "energy")
        assert function is not None
        gains = [np.tile(gain, (len(arguments[0]), 1)) for gain in controller.gains.values()]
        return Batched(function)(*arguments, *gains)


_POSITIONAL = ("controller", "reference", "q_start")
_DEFAULTS = {
    name: parameter.default
    for name, parameter in inspect.signature(simulate).parameters.items()
    if name not in (*_POSITIONAL, "monitor")
}


def simulate_many(
    controller: Controller,
    reference: Reference,
    q_start: ArrayLike,
    changes: Sequence[Mapping[str, Any]],
    *,
    executor: Executor | None = None,
    monitor: Monitor = silent,
    **settings: Any,
) -> tuple[Trajectory, ...]:
    """Simulate one run for each entry of `changes`, which holds the arguments of `simulate` that differ in this run.

    Args:
        controller: as in `simulate`.
        reference: the motion to follow.
        q_start: joint positions at t = 0, (n,) [rad] or [m].
        changes: for each run, arguments of `simulate` by name: plant, pushes, friction, noise, controller, q_start, ...
        executor: distributes the runs, for example `concurrent.futures.ProcessPoolExecutor`, or
            `distributed.Client(...).get_executor(pure=False)` of Dask. Default: this process. Compiled runs then use
            OMP_NUM_THREADS threads, or one per core.
        monitor: receives progress.
        settings: further arguments of `simulate` for all runs, such as `control_rate` and `compiled`. With
            `compiled=True`, runs that differ in masses, friction, gains or sizes of pushes share one library.

    Returns:
        The trajectories in the order of `changes`.

    Raises:
        UnknownNameError: if `simulate` has no such argument.
        UnreachableReferenceError, ShapeError, InvalidValueError, CompileError: as in `simulate`.
        Interrupted: after Ctrl-C; its `result` has the finished trajectories.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> problem = problems.get("planar_3r_xy")
        >>> chart = oc.fit(problem, oc.Polynomial(degree=2), samples=300).chart
        >>> controller, centre = oc.control.PDPlus(chart, stiffness=50.0), problem.domain.centre
        >>> reference = oc.control.Reference.steps(chart.labels, chart.phi(centre), [], duration=0.2)
        >>> heavier = [{"plant": problem.robot.with_scaled_masses(scale)} for scale in (1.0, 1.2)]
        >>> runs = oc.simulate_many(controller, reference, centre, heavier)
        >>> [bool(abs(run.q - centre).max() > 1e-3) for run in runs]  # the heavier arm sags
        [False, True]
    """
    require_executor(executor)
    require_kind("changes", changes, Sequence)
    common = {"controller": controller, "reference": reference, "q_start": q_start, **settings}
    for k, change in enumerate(changes):
        require_kind(f"changes[{k}]", change, Mapping)
        for name in (*common, *change):
            require_known("argument of simulate", name, (*_POSITIONAL, *_DEFAULTS))
    calls = [{**common, **change} for change in changes]
    if executor is not None:
        return _share_runs(executor, [partial(simulate, **call) for call in calls], monitor)

    # Prepare all runs in this thread, because CasADi must not build functions in several threads.
    runs = []
    for call in calls:
        named = {**_DEFAULTS, **call}
        law, path, start = (named.pop(name) for name in _POSITIONAL)
        runs.append(partial(prepare(law, path, start, Settings(**named)).run, silent))
    if THREADS > 1 and all(call.get("compiled") for call in calls):
        with ThreadPoolExecutor(THREADS) as pool:
            return _share_runs(pool, runs, monitor)
    done: list[Trajectory] = []
    try:
        for run in runs:
            done.append(run())
            _report(monitor, len(done), len(runs))
    except KeyboardInterrupt:
        raise Interrupted(tuple(done)) from None
    return tuple(done)


def _share_runs(
    executor: Executor, runs: Sequence[Callable[[], Trajectory]], monitor: Monitor
) -> tuple[Trajectory, ...]:
    futures = [executor.submit(run) for run in runs]
    try:
        for done, future in enumerate(as_completed(futures), start=1):
            # If a run fails, stop all.
            future.result()
            _report(monitor, done, len(runs))
        return tuple(future.result() for future in futures)
    except KeyboardInterrupt:
        ready = tuple(future.result() for future in futures if future.done() and not future.exception())
        raise Interrupted(ready) from None
    finally:
        for future in futures:
            future.cancel()


def _report(monitor: Monitor, done: int, count: int) -> None:
    monitor(Progress("simulate many", done / count, f"{done} of {count} runs"))
