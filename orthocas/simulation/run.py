"""`simulate`: runs a controller, a reference and a robot in closed loop."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import Batched
from orthocas.checks import Array, as_number, as_point
from orthocas.control.controller import Controller
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.coordinates.turns import shortest
from orthocas.errors import Interrupted, InvalidValueError, SimulationError
from orthocas.minimising.watch import Monitor, Progress, silent
from orthocas.simulation.closed_loop import ClosedLoop, Piece
from orthocas.simulation.continuous import integrate
from orthocas.simulation.disturbances import Friction, Noise, Push, Stops
from orthocas.simulation.loads import Loads
from orthocas.simulation.mujoco_scene import MuJoCo
from orthocas.simulation.physics import run_physics
from orthocas.simulation.run_checks import Plant, plant_of, require_fitting, require_kinds
from orthocas.simulation.sampled import run_ticks
from orthocas.simulation.supervised import SupervisedLaw, run_supervised
from orthocas.simulation.trajectory import Outcome, Trajectory

TOLERANCE = 1e-8  #: relative and absolute, of CVODES


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
    tolerance: float = TOLERANCE,
    monitor: Monitor = silent,
) -> Trajectory:
    """Simulate a closed loop for the duration of the reference, with SUNDIALS (CVODES) or with MuJoCo.

    With a torque controller, the robot obeys M ddq + C dq + g = tau + loads - friction ([AS2023] eq. (26)). With a
    velocity controller it follows its commands perfectly, dq = command. In MuJoCo, joints also stop at their limits,
    motors saturate at the robot's limits of effort, and the tip may touch a wall.

    Args:
        controller: see `orthocas.control`.
        reference: the motion to follow, with the labels of the controller.
        q_start: joint positions at t = 0, (n,) [rad] or [m].
        dq_start: joint velocities at t = 0, (n,); default at rest. For torque controllers only.
        step: longest time between two instants of the result [s].
        control_rate: ticks per second of a sampled controller, which holds its command between ticks. The instants of
            the result are then the ticks. Default: a controller in continuous time.
        plant: the true robot, for example `robot.with_scaled_masses(1.1)`; default the controller's model. Or "mujoco",
            or `MuJoCo(robot, ...)`: the robot in MuJoCo, for sampled torque controllers (extra `orthocas[sim]`).
        pushes: external loads, at the tip, at links or at joints.
        friction: friction in the joints.
        stops: joint stops for CVODES; default none. For torque controllers only. MuJoCo has its own.
        noise: noise on the measurements of a sampled controller.
        safety: run the supervised law of the generated C with these settings, for example
            `oc.control.Safety.of(controller)`, in place of the law alone. Needs a law on a chart, a `control_rate` and
            a C compiler. The run begins as on the robot, with NAME_start; its `status` and `cause` tell what happened.
        resume_after: with `safety`, time from a catch until the law is asked for again [s]; infinite: never.
        must_be_reachable: whether to raise an error, before the run, if the reference leaves the domain.
        tolerance: relative and absolute tolerance of CVODES.
        monitor: called with progress.

    Returns:
        The trajectory. Its outcome tells whether it ended early because the integrator gave up.

    Raises:
        UnreachableReferenceError: if the reference leaves the domain.
        MissingExtraError: if MuJoCo is the plant and not installed.
        CompileError: if a supervised law needs a C compiler and there is none.
        ShapeError, InvalidValueError, UnknownNameError: for arguments of the wrong shape, value or type.
        Interrupted: after Ctrl-C; its `result` is the trajectory up to there, with outcome INTERRUPTED.

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
    require_kinds(controller, reference, pushes, {Friction: friction, Stops: stops, Noise: noise})
    robot, scene = plant_of(plant, controller)
    loop = ClosedLoop(controller, robot, friction or Friction(), Loads(robot.tree, pushes), stops)
    for name, value in (
        ("step", step),
        ("tolerance", tolerance),
        ("control_rate", 1.0 if control_rate is None else control_rate),
    ):
        if not 0 < as_number(name, value) < np.inf:
            raise InvalidValueError(name, value, "a finite number > 0")
    require_fitting(loop, reference, friction, noise, control_rate, scene is not None, safety)
    start = _start_state(loop, q_start, dq_start)
    if must_be_reachable:
        controller.require_reachable(reference, start[: loop.n])
    pieces: list[Piece] = []
    outcome = Outcome.COMPLETE
    if control_rate is None:
        running = integrate(loop, reference, start, step, tolerance)
    else:
        law = None if safety is None else SupervisedLaw(controller, safety, resume_after, 1 / control_rate)
        running = _ticks(scene, tolerance, law)(loop, reference, start, control_rate, noise or Noise())
    try:
        for piece in running:
            pieces.append(piece)
            monitor(_progress(controller.name, piece.times[-1], reference.duration))
    except KeyboardInterrupt:
        outcome = Outcome.INTERRUPTED
    except SimulationError:
        outcome = Outcome.DIVERGED
    try:
        run = _trajectory(loop, reference, start, pieces, outcome)
    except KeyboardInterrupt:  # keep the run up to here
        run = _trajectory(loop, reference, start, pieces, Outcome.INTERRUPTED)
    if run.outcome is Outcome.INTERRUPTED:
        raise Interrupted(run)
    return run


def _ticks(scene: MuJoCo | None, tolerance: float, law: SupervisedLaw | None) -> Callable[..., Iterator[Piece]]:
    """What runs a sampled controller: MuJoCo or CVODES, with the law alone or the supervised one."""
    if scene is not None:
        return partial(run_physics, scene=scene, supervised=law)
    if law is not None:
        return partial(run_supervised, tolerance=tolerance, law=law)
    return partial(run_ticks, tolerance=tolerance)


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


def _trajectory(
    loop: ClosedLoop, reference: Reference, start: Array, pieces: Sequence[Piece], outcome: Outcome
) -> Trajectory:
    """Join the pieces, and add what follows from the states and the reference."""
    controller, n = loop.controller, loop.n
    times = np.concatenate([[0.0], *(piece.times for piece in pieces)])
    states = np.vstack([start, *(piece.states for piece in pieces)])
    q = states[:, :n]
    wanted = reference.sample(np.minimum(times, reference.duration))
    dq = states[:, n:] if loop.torque else np.zeros_like(q)
    arguments = [q, dq, *wanted, *(np.tile(gain, (len(times), 1)) for gain in controller.gains.values())]
    command, status = Batched(controller.function)(*arguments)
    held = [piece.held for piece in pieces if piece.held is not None]
    cause = np.zeros(len(times))
    if held:  # noisy measurements: use the commands that were sent, and the last one also for the end
        command = _with_last([part.commands for part in held])
        status, cause = _with_last([part.status for part in held]), _with_last([part.cause for part in held])
    unknown = [np.full((len(times), 1), np.nan)] * 2
    storage, power = unknown if controller.energy is None else Batched(controller.energy)(*arguments)
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
        value=_near(controller, Batched(controller.measured)(q)[0], wanted[0]),
        reference=wanted[0],
        reference_velocity=wanted[1],
        reference_acceleration=wanted[2],
        storage=storage[:, 0],
        dissipated_power=power[:, 0],
        cause=cause.astype(int),
    )


def _near(controller: Controller, value: Array, wanted: Array) -> Array:
    """Measured quantities (N, k), circle-valued ones with the whole turns that bring them nearest to the reference."""
    chart = controller.chart
    if chart is None or controller.labels != chart.labels:
        return value
    return np.asarray(wanted + shortest(value - wanted, chart.turns)) if chart.turns.any() else value


def _with_last(parts: Sequence[Array]) -> Array:
    """The rows of all parts, and the last one once more."""
    return np.concatenate([*parts, parts[-1][-1:]])
