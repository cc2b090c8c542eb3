"""Closed loops in continuous time and tick by tick: in CVODES, compiled C and MuJoCo, and with supervised laws."""

import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from orthocas.control.controller import Controller, ControlStatus, get_counted_function
from orthocas.control.memory import Remembering
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.errors import InvalidValueError, SimulationError
from orthocas.robots import dynamics
from orthocas.robots.robot import Robot
from orthocas.simulation.disturbances import RULES, Friction, Loads, Noise, Push, Stops
from orthocas.simulation.mujoco_plant import MuJoCo, MuJoCoPlant
from orthocas.tools.cached import building, cached_property
from orthocas.tools.checks import Array, as_number, require_kind
from orthocas.tools.expressions import expand_scalars
from orthocas.tools.files import open_draft_folder
from orthocas.tools.interrupts import deferred

if TYPE_CHECKING:
    from orthocas.codegen.library import Supervisor

_log = logging.getLogger(__name__)

KEPT = 96  #: functions that a process caches
#: (begin, end) [s], start of the reference's segment [s], its parameters, load, state -> states at 25 equally spaced
#: instants
Integrator = Callable[[tuple[float, float], float, Array, Array, Array], Array]
#: state; references with derivatives (N, 3 k), noise and loads of N ticks -> states after them, commands, status (N, 1)
Ticks = Callable[..., tuple[Array, Array, Array]]


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A controller on a plant. The state is [q; dq] for torque controllers and q for velocity controllers."""

    controller: Controller
    plant: Robot  #: the true robot, which may differ from the controller's model
    friction: Friction
    loads: Loads
    stops: Stops | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.plant.n

    @property
    def size(self) -> int:
        """Size of the state."""
        return 2 * self.n if self.torque else self.n

    @property
    def torque(self) -> bool:
        """Whether the command is a torque."""
        return self.controller.command == "torque"

    @property
    def stiff(self) -> bool:
        """Whether friction or stops require an implicit method."""
        return self.stops is not None or bool(self.friction.numbers(self.n)[self.n : 3 * self.n].any())

    @cached_property
    def plant_rate(self) -> ca.Function:
        """state, command (n, 1), load (`Loads.size`, 1) -> rate of the state."""
        plant: ca.Function = build_once(Recipe(("plant", self.plant_key), lambda: self.plant_of_numbers))
        state, command, load, _ = plant.sx_in()
        rate = plant.call([state, command, load, ca.SX(ca.DM(self.plant_numbers))])
        return ca.Function("plant", [state, command, load], rate)

    @property
    def plant_of_numbers(self) -> ca.Function:
        """`plant_rate` with `plant_numbers` as a fourth input: one function serves all masses and frictions."""
        n = self.n
        q, dq, command, load = (
            ca.SX.sym(name, size) for name, size in (("q", n), ("dq", n), ("u", n), ("load", self.loads.size))
        )
        numbers = ca.SX.sym("numbers", len(self.plant_numbers))
        if not self.torque:
            return ca.Function("plant", [q, command, load, numbers], [command])
        # M ddq + C dq + g = command + loads + stops - friction
        torque = command + self.loads.joint_torques(q, load)
        if self.stops is not None:
            torque += self.stops.torque(self.plant.tree, q, dq)
        if self.rubs:
            torque -= self.friction.torque(dq, numbers[: 4 * n])
        inertials = numbers[4 * n :] if self.rubs else numbers
        tree = self.plant.tree
        ddq = dynamics.build_forward_dynamics(tree, q, dq, torque, inertials)
        return ca.Function("plant", [ca.vertcat(q, dq), command, load, numbers], [ca.vertcat(dq, ddq)])

    @property
    def plant_numbers(self) -> Array:
        """Amounts of friction, if any, then the inertial parameters of the robot."""
        if not self.torque:
            return np.zeros(0)
        inertials = dynamics.collect_inertials(self.plant.tree)
        return np.concatenate([self.friction.numbers(self.n), inertials]) if self.rubs else inertials

    @property
    def plant_key(self) -> tuple[object, ...]:
        """Equal for loops with the same `plant_of_numbers`."""
        if not self.torque:
            return (self.n,)
        tree = self.plant.tree
        arrays = [tree.rotations, tree.translations, tree.armatures, tree.gravity]
        arrays += [tree.mimic_factors, tree.mimic_offsets]
        if self.stops is not None:
            arrays += [np.asarray(self.stops.stiffness), np.asarray(self.stops.damping), tree.lower, tree.upper]
        numbers = tuple(array.tobytes() for array in arrays)
        joints = (tree.body_kinds, tree.parents, tree.mimic_leaders)
        return (joints, numbers, self.loads.places, self.rubs, self.stops is None)

    @property
    def rubs(self) -> bool:
        """Whether the plant has friction."""
        return bool(self.friction.numbers(self.n)[: 3 * self.n].any())

    def commanded(self, state: ca.MX, reference: Sequence[ca.MX]) -> tuple[ca.MX, ca.MX]:
        """Command and status for a (measured) state and a reference with two derivatives."""
        dq = state[self.n :] if self.torque else ca.MX(self.n, 1)
        gains = [ca.DM(gain) for gain in self.controller.gains.values()]
        command, status = get_counted_function(self.controller).call([state[: self.n], dq, *reference, *gains])
        return command, status

    def rate(self, reference: Reference) -> ca.Function:
        """state, time since the start of a segment, its parameters, load -> rate of the state.

        The process caches it, so runs that differ only in start, targets or size of loads build it once.
        """
        profile = reference.profile

        def build() -> ca.Function:
            state = ca.MX.sym("state", self.size)
            t, parameters = ca.MX.sym("t"), ca.MX.sym("parameters", profile.size1_in(1))
            load = ca.MX.sym("load", self.loads.size)
            command, _ = self.commanded(state, profile.call([t, parameters]))
            rate = ca.Function("rate", [state, t, parameters, load], [self.plant_rate(state, command, load)])
            return expand_scalars(rate) if self.controller.function.is_a("SXFunction") else rate

        gains = tuple(gain.tobytes() for gain in self.controller.gains.values())
        plant = (self.plant_key, self.plant_numbers.tobytes())
        rate: ca.Function = build_once(Recipe(("rate", self.controller.function, gains, plant, profile), build))
        return rate


@dataclass(frozen=True)
class Recipe:
    """How to build a function. Recipes with equal keys build equal functions."""

    key: Hashable
    build: Callable[[], Any] = field(compare=False)


@lru_cache(KEPT)
def build_once(recipe: Recipe) -> Any:
    """What a recipe builds; the process builds it once, as long as it is cached."""
    return recipe.build()


@dataclass(frozen=True, eq=False)
class Held:
    """Outputs of a sampled controller at the start of each of N ticks."""

    commands: Array  #: (N, n), held until the end of the tick
    status: Array  #: (N,)
    cause: Array  #: (N,) reason of the last catch of a supervised law


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a run: N instants, each at the end of a time step."""

    times: Array  #: (N,) [s]
    states: Array  #: (N, s)
    held: Held | None = None  #: outputs of a sampled controller in the tick that ends at each instant


def run_compiled(function: ca.Function, *arguments: Any, **named: Any) -> Any:
    """Call a function that integrates; Ctrl-C takes effect after it returns.

    Raises:
        SimulationError: if CVODES fails.
    """
    with deferred():
        try:
            return function(*arguments, **named)
        except RuntimeError as error:
            raise SimulationError(f"CVODES failed: {str(error)[:200]}") from None


def list_cvodes_options(tolerance: float, stiff: bool) -> dict[str, Any]:
    """Adams with functional iteration, which needs no Jacobian; BDF with Newton iteration for stiff loops."""
    return {
        "linear_multistep_method": "bdf" if stiff else "adams",
        "nonlinear_solver_iteration": "newton" if stiff else "functional",
        "abstol": tolerance,
        "reltol": tolerance,
        "max_num_steps": 20_000,
        "disable_internal_warnings": True,
        "show_eval_warnings": False,
    }


class CompiledLoop:
    """A closed loop in C. Its constructor compiles what is not cached.

    Args:
        loop: the loop.
        reference: the reference to follow.

    Raises:
        CompileError: if there is no C compiler.
    """

    def __init__(self, loop: ClosedLoop, reference: Reference) -> None:
        # CasADi may lose Ctrl-C while it builds functions.
        with deferred(), building:
            law, profile = loop.controller, reference.profile
            named = {"command": law.graph, "measured": law.measured, "energy": law.energy_graph}
            own = {name: function for name, function in named.items() if function is not None}
            self._law = _compile(("law", *own.items()), lambda: [_rename(*item) for item in own.items()])
            self._plant = _compile(
                ("plant in C", loop.plant_key), lambda: [expand_scalars(_rename("plant", loop.plant_of_numbers))]
            )
            self._profile = _compile(("profile", profile), lambda: [_rename("profile", profile)])
        self._loop, self._gains = loop, list(loop.controller.gains.values())

    def continuous(self, step: float, tolerance: float, outputs: int) -> Callable[..., Array]:
        """The function that `integrate` calls, for one thread; its first step has the given length [s]."""
        return partial(self._build_integrator(step, tolerance).continuous, outputs)

    def ticks(self, period: float, tolerance: float) -> Callable[..., tuple[Array, Array, Array]]:
        """The function that `run_ticks` calls in one thread, for ticks of the length `period` [s]."""
        return partial(self._build_integrator(period, tolerance).ticks, period)

    def rows(self, name: str, *arguments: Array) -> list[Array]:
        """`command`, `energy` or `measured` of the law for N rows of arguments; gains are appended."""
        gains = [] if name == "measured" else self._gains
        return list(self._law.rows(name, *arguments, *gains))

    def _build_integrator(self, step: float, tolerance: float) -> Any:
        # Only compiled runs need a code generator and a compiler.
        from orthocas.codegen import compiled

        loop, none = self._loop, [None] * 5
        kernels = (
            self._law.kernel("command", [*none, *self._gains]),
            self._plant.kernel("plant", [None, None, None, loop.plant_numbers]),
            self._profile.kernel("profile"),
        )
        sizes = (loop.n, len(loop.controller.labels), loop.size, loop.loads.size)
        return compiled.Integrator(kernels, sizes, tolerance, step)


def _compile(key: Hashable, build: Callable[[], list[ca.Function]]) -> Any:
    """Functions in compiled C; the process compiles them once, as long as they are cached."""
    # Only compiled runs need a code generator and a compiler.
    from orthocas.codegen.compiled import CompiledFunctions

    return build_once(Recipe(key, lambda: CompiledFunctions(build())))


def _rename(name: str, function: ca.Function) -> ca.Function:
    inputs = function.mx_in()
    return ca.Function(name, inputs, [ca.densify(out) for out in function.call(inputs)])


def integrate(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    step: float,
    tolerance: float,
    compiled: CompiledLoop | None,
) -> Iterator[Piece]:
    """Yield pieces of 25 instants, from the first one after the start to the end of the reference.

    Raises:
        SimulationError: if the integrator fails.
    """
    run: Integrator = (
        _build_continuous(loop, reference, tolerance)
        if compiled is None
        else compiled.continuous(step, tolerance, outputs=RULES.outputs)
    )
    state = start
    try:
        for begin, end in _cut_pieces(reference, loop.loads.pushes, step * RULES.outputs):
            centre = np.array([(begin + end) / 2])
            segment, load = int(reference.segment(centre)[0]), loop.loads.at(centre)[0]
            # The formulas of reference and loads do not change within a piece.
            states = run((begin, end), reference.times[segment], reference.parameters[segment], load, state)
            state = states[-1]
            yield Piece(begin + (end - begin) * np.arange(1, RULES.outputs + 1) / RULES.outputs, states)
    finally:
        # Delete under the lock, because its expressions share nodes with those that other threads build.
        with building:
            del run


def _build_continuous(loop: ClosedLoop, reference: Reference, tolerance: float) -> Integrator:
    """The CVODES integrator over an interval, with states at 25 equally spaced instants."""
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred(), building:
        rate = loop.rate(reference)
        state_size, _, p_size, load_size = (rate.size1_in(i) for i in range(4))
        kind: Any = ca.SX if rate.is_a("SXFunction") else ca.MX
        x, s = kind.sym("x", state_size), kind.sym("s")
        p = kind.sym("p", 2 + p_size + load_size)
        length, since, parameters, load = p[0], p[1], p[2 : 2 + p_size], p[2 + p_size :]
        # Integrate over s from 0 to 1, so that one integrator serves intervals of all lengths.
        ode = length * rate(x, since + s * length, parameters, load)
        system, options = {"x": x, "t": s, "p": p, "ode": ode}, list_cvodes_options(tolerance, loop.stiff)
        grid = np.arange(1, RULES.outputs + 1) / RULES.outputs
        integrator = ca.integrator("closed_loop", "cvodes", system, 0.0, grid, options)

    def run(span: tuple[float, float], since: float, parameters: Array, load: Array, state: Array) -> Array:
        p = np.concatenate([[span[1] - span[0], span[0] - since], parameters, load])
        return np.asarray(run_compiled(integrator, x0=ca.DM(state), p=ca.DM(p))["xf"]).T

    return run


def _cut_pieces(reference: Reference, pushes: tuple[Push, ...], longest: float) -> Iterator[tuple[float, float]]:
    """Intervals of at most a given length, without a step of the reference or a change of load inside."""
    # Cut at steps of the reference, and at starts and ends of pushes.
    edges = np.array([*reference.times, *(t for push in pushes for t in (push.start, push.end))])
    boundaries = np.unique(edges[edges <= reference.duration])
    boundaries = boundaries[np.diff(boundaries, prepend=-1.0) > RULES.same_time]
    for begin, end in pairwise(boundaries):
        count = max(1, int(np.ceil((end - begin) / longest - 1e-9)))
        cuts = np.linspace(begin, end, count + 1)
        yield from pairwise(cuts)


def run_ticks(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    rate: float,
    noise: Noise,
    tolerance: float,
    compiled: CompiledLoop | None,
) -> Iterator[Piece]:
    """Yield pieces of 50 ticks, with the held commands.

    Raises:
        SimulationError: if the integrator fails.
    """
    times, target, errors = sample_ticks(loop, reference, rate, noise)
    columns = (target, errors[:, : loop.size], loop.loads.mean(times, 1 / rate))
    ticks = len(times)
    k, period = len(reference.labels), 1 / rate
    run = _build_ticks(loop, period, k, tolerance) if compiled is None else compiled.ticks(period, tolerance)
    state = start
    try:
        for first in range(0, ticks, RULES.ticks):
            part = slice(first, min(first + RULES.ticks, ticks))
            states, commands, status = run(state, *(column[part] for column in columns))
            state = states[-1]
            yield Piece(times[part] + period, states, Held(commands, status[:, 0], 0 * status[:, 0]))
    finally:
        # Delete under the lock, because its expressions share nodes with those that other threads build.
        with building:
            del run


def sample_ticks(loop: ClosedLoop, reference: Reference, rate: float, noise: Noise) -> tuple[Array, Array, Array]:
    """Starts of the ticks (N,) [s], references with derivatives (N, 3 k), and sensor errors (N, 2 n)."""
    # Only whole ticks; the reference ends with its last segment.
    times = np.arange(int(np.floor(reference.duration * rate + 1e-9))) / rate
    return times, np.hstack(reference.sample(times)), noise.sample(len(times), loop.n)


def yield_pieces(tick: Callable[[int], Array], times: Array, period: float, size: int) -> Iterator[Piece]:
    """Yield pieces of 50 ticks for a plant that is stepped tick by tick.

    Args:
        tick: index of a tick -> [state at its end (size,); command (n,); status; cause].
        times: starts of the ticks (N,) [s].
        period: length of a tick [s].
        size: size of the state.
    """
    for first in range(0, len(times), RULES.ticks):
        held = range(first, min(first + RULES.ticks, len(times)))
        with deferred():
            rows = np.array([tick(k) for k in held])
        states, commands, reports = np.split(rows, [size, rows.shape[1] - 2], axis=1)
        yield Piece(times[held] + period, states, Held(commands, reports[:, 0], reports[:, 1]))


def build_held_plant(loop: ClosedLoop, length: float, tolerance: float) -> ca.Function:
    """x0, p = [command; load] -> xf, the state after a tick in which command and load are constant."""
    x, u, w = (ca.SX.sym(*of) for of in (("x", loop.plant_rate.size1_in(0)), ("u", loop.n), ("load", loop.loads.size)))
    ode = {"x": x, "p": ca.vertcat(u, w), "ode": loop.plant_rate(x, u, w)}
    return ca.integrator("plant", "cvodes", ode, 0.0, length, list_cvodes_options(tolerance, loop.stiff))


def _build_ticks(loop: ClosedLoop, period: float, k: int, tolerance: float) -> Ticks:
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred(), building:
        # State, reference with derivatives (3 k, 1), noise, load -> state after the tick, command, status.
        size = loop.plant_rate.size1_in(0)
        plant = build_held_plant(loop, period, tolerance)
        x, reference = ca.MX.sym("state", size), ca.MX.sym("reference", 3 * k)
        noise, load = ca.MX.sym("noise", size), ca.MX.sym("load", loop.loads.size)
        command, status = loop.commanded(x + noise, (reference[:k], reference[k : 2 * k], reference[2 * k :]))
        end = plant(x0=x, p=ca.vertcat(command, load))["xf"]
        tick = ca.Function("tick", [x, reference, noise, load], [end, command, status])
        ticks = tick.mapaccum(RULES.ticks)

    def run(state: Array, *columns: Array) -> tuple[Array, Array, Array]:
        # Repeat the last row to fill the fixed number of rows of a call.
        missing = RULES.ticks - len(columns[0])
        inputs = [ca.DM(np.vstack([column, np.repeat(column[-1:], missing, axis=0)]).T) for column in columns]
        outputs = run_compiled(ticks, ca.DM(state), *inputs)
        states, commands, status = (np.asarray(out).T[: len(columns[0])] for out in outputs)
        return states, commands, status

    return run


class SupervisedLaw:
    """A supervised law in compiled C, and the program that resumes it.

    Args:
        controller: a law on a chart.
        safety: settings of the supervision.
        resume_after: time from each catch until the program requests the law again [s]; infinite: never.
        period: length of a tick [s].

    Raises:
        InvalidValueError: for a law without a chart, for invalid settings, and for a period that is too long.
        CompileError: if there is no C compiler.
    """

    def __init__(self, controller: Controller, safety: Safety, resume_after: float, period: float) -> None:
        # Only supervised runs need a code generator and a compiler.
        from orthocas import codegen

        require_kind("safety", safety, Safety)
        if not as_number("resume_after", resume_after) >= 0:
            raise InvalidValueError("resume_after", resume_after, "a number >= 0 or infinity")
        if period > safety.longest_period:
            slowest = 1 / safety.longest_period
            raise InvalidValueError(
                "control_rate", 1 / period, f"at least {slowest:g}, because of safety.longest_period"
            )
        if controller.chart is None:
            raise InvalidValueError("safety", "given", f"no safety, because {controller.name} has no chart")
        self._resume_after, self._period, self._caught_for = resume_after, period, 0.0
        self._joints, self._torque = controller.problem.robot.joint_names, controller.command == "torque"
        # The compiled law stays loaded after its folder is deleted.
        with open_draft_folder() as folder:
            generated = codegen.generate_c(controller.chart, folder / "law", controller, "law", safety=safety)
            library = codegen.compile_shared(generated, generated.folder)
            compiled = codegen.CompiledLibrary(library, "law", controller.problem.n)
            self._law: Supervisor = codegen.Supervisor(compiled, controller)

    def start(self, q: Array, holding: Array) -> None:
        """Start at joint positions (n,); the holding torque (n,) may be one that a robot would refuse."""
        mismatch, status = self._law.check_start(q, holding)
        if self._torque and status is ControlStatus.LOAD_MISMATCH:
            worst = int(np.argmax(np.abs(mismatch)))
            words = "a robot would refuse this start: the torque that holds it is %.3g off the model's at joint '%s'"
            _log.warning(words, mismatch[worst], self._joints[worst])
        self._law.start(q)
        self._caught_for = 0.0

    def tick(self, q: Array, dq: Array, reference: Array) -> Array:
        """[command; status; reason of the last catch], (n + 2,), for a reference with two derivatives (3 k,)."""
        # Mode 1 of the C state is the catcher.
        self._caught_for = self._caught_for + self._period if self._law.mode == 1 else 0.0
        if self._caught_for > self._resume_after:
            self._law.resume()
        command, status = self._law.step(q, dq, reference, self._period)
        return np.concatenate([command, [status, self._law.cause]])


class LawWithMemory:
    """A law with memory, run in Python.

    Args:
        controller: a law with a memory.
        period: length of a tick [s].
    """

    def __init__(self, controller: Controller, period: float) -> None:
        self._ticks, self._period = Remembering(controller), period

    def start(self, q: Array, holding: Array) -> None:
        """Start at joint positions (n,) with any holding torque."""
        self._ticks.start()

    def tick(self, q: Array, dq: Array, reference: Array) -> Array:
        """[command; status; no cause], (n + 2,), for a reference with two derivatives (3 k,)."""
        command, status = self._ticks.tick(q, dq, reference.reshape(3, -1), self._period)
        return np.concatenate([command, [status, ControlStatus.OK]])


def run_supervised(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    rate: float,
    noise: Noise,
    tolerance: float,
    law: SupervisedLaw | LawWithMemory,
) -> Iterator[Piece]:
    """Yield pieces of 50 ticks, with the commands that were held while CVODES integrated the plant.

    Raises:
        SimulationError: if CVODES fails.
    """
    n, size = loop.n, len(start)
    times, target, errors = sample_ticks(loop, reference, rate, noise)
    loads = loop.loads.mean(times, 1 / rate)
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred(), building:
        plant = build_held_plant(loop, 1 / rate, tolerance)
    # In each tick: measure, compute the command, and hold it while the plant moves.
    law.start(start[:n] + errors[0, :n], np.asarray(loop.plant.gravity(start[:n])))
    state, sent = start, np.zeros(n + 2)

    def tick(k: int) -> Array:
        nonlocal state, sent
        # The robot of a velocity controller moves with the commanded velocity.
        dq = state[n:] if loop.torque else sent[:n]
        sent = law.tick(state[:n] + errors[k, :n], dq + errors[k, n:], target[k])
        state = run_compiled(plant, x0=ca.DM(state), p=ca.DM(np.concatenate([sent[:n], loads[k]])))["xf"].full().ravel()
        return np.concatenate([state, sent])

    yield from yield_pieces(tick, times, 1 / rate, size)


def run_physics(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    rate: float,
    noise: Noise,
    scene: MuJoCo,
    supervised: SupervisedLaw | LawWithMemory | None,
) -> Iterator[Piece]:
    """Yield pieces of 50 ticks with the held commands of the law, or of the supervised law, on MuJoCo.

    Raises:
        SimulationError: if MuJoCo fails.
    """
    plant = MuJoCoPlant(
        loop.plant,
        friction=loop.friction,
        stops=scene.stops,
        effort_limits=scene.effort_limits,
        payload=scene.payload,
        wall=scene.wall,
        timestep=scene.timestep,
        elasticity=scene.elasticity,
    )
    # Reset the plant, and compute the torque that holds it at rest.
    plant.reset(start[: loop.n])
    holding = plant.bias
    plant.reset(start[: loop.n], start[loop.n :])
    # Inputs of each tick: targets with derivatives, sensor errors, and the fraction that each push covers.
    times, target, errors = sample_ticks(loop, reference, rate, noise)
    shares = loop.loads.shares(times, 1 / rate)
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred(), building:
        law = _build_law(loop, len(reference.labels)) if supervised is None else supervised.tick
    if supervised is not None:
        supervised.start(start[: loop.n] + errors[0, : loop.n], holding)

    def tick(k: int) -> Array:
        q, dq = np.split(np.concatenate([plant.q, plant.dq]) + errors[k], 2)
        sent = law(q, dq, target[k])
        plant.step(sent[: loop.n], 1 / rate, apply_pushes(plant, loop.loads, shares[k]))
        return np.concatenate([plant.q, plant.dq, sent])

    yield from yield_pieces(tick, times, 1 / rate, 2 * loop.n)


def apply_pushes(plant: MuJoCoPlant, loads: Loads, shares: Array) -> Array | None:
    """Apply the forces of pushes for one tick, scaled by their fractions of it. Returns joint torques (n,)."""
    # Joint torques of pushes are added to the law's.
    plant.release()
    if not shares.any():
        return None
    torque = np.zeros(plant.robot.n)
    for share, push in zip(shares, loads.pushes, strict=True):
        if share > 0:
            plant.push(share * push.force, push.link, push.point)
            torque += share * push.load(plant.robot.n)[3:]
    return torque


def _build_law(loop: ClosedLoop, k: int) -> Callable[[Array, Array, Array], Array]:
    """Measured q and dq, reference with derivatives (3 k,) -> [command; status; no cause]."""
    state, reference = ca.MX.sym("state", 2 * loop.n), ca.MX.sym("reference", 3 * k)
    sent = ca.vertcat(*loop.commanded(state, (reference[:k], reference[k : 2 * k], reference[2 * k :])), 0)
    law = ca.Function("law", [state, reference], [sent])
    return lambda q, dq, target: np.asarray(law(np.concatenate([q, dq]), target).full().ravel())
