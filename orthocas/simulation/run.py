"""`simulate`: runs a controller, a reference and a robot in closed loop."""

from collections.abc import Sequence

from numpy.typing import ArrayLike

from orthocas.control.controller import Controller
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.minimising.watch import Monitor, silent
from orthocas.simulation.disturbances import Friction, Noise, Push, Stops
from orthocas.simulation.prepared import Settings, prepare
from orthocas.simulation.run_checks import Plant
from orthocas.simulation.trajectory import Trajectory

TOLERANCE = 1e-8  #: relative and absolute, of the integrator


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
    compiled: bool = False,
    monitor: Monitor = silent,
) -> Trajectory:
    """Simulate a closed loop for the duration of the reference, with SUNDIALS (CVODES), in compiled C or with MuJoCo.

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
        tolerance: relative and absolute tolerance of the integrator.
        compiled: run law, robot and integrator in C (Dormand and Prince's method of order 8), with the same results
            within the tolerance. The first run with a law compiles it, which takes some seconds; libraries stay in
            `orthocas` in $XDG_CACHE_HOME or ~/.cache. Needs a C compiler; not with `safety` or MuJoCo.
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
