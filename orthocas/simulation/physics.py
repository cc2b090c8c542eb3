"""Closed loops with MuJoCo as plant, and with the supervised law of generated C."""

import logging
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from orthocas.control.controller import Controller, ControlStatus
from orthocas.control.memory import Remembering
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.errors import InvalidValueError
from orthocas.simulation.disturbances import Loads, Noise
from orthocas.simulation.loops import ClosedLoop, Piece, build_held_plant, run_compiled, sample_ticks, yield_pieces
from orthocas.simulation.mujoco_plant import MuJoCo, MuJoCoPlant
from orthocas.tools.cached import building
from orthocas.tools.checks import Array, as_number, require_kind
from orthocas.tools.files import open_draft_folder
from orthocas.tools.interrupts import deferred

if TYPE_CHECKING:
    from orthocas.codegen.library import Supervisor

_log = logging.getLogger(__name__)


class SupervisedLaw:
    """A supervised law in compiled C, and the program around it.

    Args:
        controller: a law on a chart.
        safety: its settings.
        resume_after: time from each catch until the program asks for the law again [s]; infinite: never.
        period: of the ticks [s].

    Raises:
        InvalidValueError: for a law without a chart, for other settings, and periods that are always too late.
        CompileError: if there is no C compiler.
    """

    def __init__(self, controller: Controller, safety: Safety, resume_after: float, period: float) -> None:
        from orthocas import codegen  # few runs need a code generator and a compiler

        require_kind("safety", safety, Safety)
        if not as_number("resume_after", resume_after) >= 0:
            raise InvalidValueError("resume_after", resume_after, "a number >= 0 or infinity")
        if period > safety.longest_period:
            slowest = 1 / safety.longest_period
            raise InvalidValueError("control_rate", 1 / period, f"at least {slowest:g}, as safety.longest_period wants")
        if controller.chart is None:
            raise InvalidValueError("safety", "given", f"none with {controller.name} without a chart")
        self._resume_after, self._period, self._caught_for = resume_after, period, 0.0
        self._joints, self._torque = controller.problem.robot.joint_names, controller.command == "torque"
        # The law in C, which stays loaded when its folder is gone.
        with open_draft_folder() as folder:
            generated = codegen.generate_c(controller.chart, folder / "law", controller, "law", safety=safety)
            library = codegen.compile_shared(generated, generated.folder)
            compiled = codegen.CompiledLibrary(library, "law", controller.problem.n)
            self._law: Supervisor = codegen.Supervisor(compiled, controller)

    def start(self, q: Array, holding: Array) -> None:
        """Begin at joint positions (n,), also where the torque (n,) that holds the plant is one that robots refuse."""
        mismatch, status = self._law.check_start(q, holding)
        if self._torque and status is ControlStatus.LOAD_MISMATCH:
            worst = int(np.argmax(np.abs(mismatch)))
            words = "a robot would refuse this start: the torque that holds it is %.3g off the model's at joint '%s'"
            _log.warning(words, mismatch[worst], self._joints[worst])
        self._law.start(q)
        self._caught_for = 0.0

    def tick(self, q: Array, dq: Array, reference: Array) -> Array:
        """[command; status; why the catcher took over last], (n + 2,), for a reference with two derivatives (3 k,)."""
        # Mode 1 of the state in C is the catcher.
        self._caught_for = self._caught_for + self._period if self._law.mode == 1 else 0.0
        if self._caught_for > self._resume_after:
            self._law.resume()
        command, status = self._law.step(q, dq, reference, self._period)
        return np.concatenate([command, [status, self._law.cause]])


class LawWithMemory:
    """A law and its memory in Python.

    Args:
        controller: a law with a memory.
        period: of the ticks [s].
    """

    def __init__(self, controller: Controller, period: float) -> None:
        self._ticks, self._period = Remembering(controller), period

    def start(self, q: Array, holding: Array) -> None:
        """Begin, at any joint positions, whatever holds the plant."""
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
        SimulationError: if CVODES gives up.
    """
    n, size = loop.n, len(start)
    times, target, errors = sample_ticks(loop, reference, rate, noise)
    loads = loop.loads.mean(times, 1 / rate)
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred(), building:
        plant = build_held_plant(loop, 1 / rate, tolerance)
    # Each tick: measure, ask the law, hold its command while the plant moves.
    law.start(start[:n] + errors[0, :n], np.asarray(loop.plant.gravity(start[:n])))
    state, sent = start, np.zeros(n + 2)

    def tick(k: int) -> Array:
        nonlocal state, sent
        # A velocity controller's robot follows its command.
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
    supervised: SupervisedLaw | LawWithMemory | None = None,
) -> Iterator[Piece]:
    """Yield pieces of 50 ticks, with the commands that were held: those of the law, or of the supervised law.

    Raises:
        SimulationError: if MuJoCo gives up.
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
    # What holds the plant at rest, and the start.
    plant.reset(start[: loop.n])
    holding = plant.bias
    plant.reset(start[: loop.n], start[loop.n :])
    # What each tick needs: targets with derivatives, errors of the sensors, and the share of it that each push lasts.
    times, target, errors = sample_ticks(loop, reference, rate, noise)
    shares = loop.loads.shares(times, 1 / rate)
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred(), building:
        law = _law(loop, len(reference.labels)) if supervised is None else supervised.tick
    if supervised is not None:
        supervised.start(start[: loop.n] + errors[0, : loop.n], holding)

    def tick(k: int) -> Array:
        q, dq = np.split(np.concatenate([plant.q, plant.dq]) + errors[k], 2)
        sent = law(q, dq, target[k])
        plant.step(sent[: loop.n], 1 / rate, apply_pushes(plant, loop.loads, shares[k]))
        return np.concatenate([plant.q, plant.dq, sent])

    yield from yield_pieces(tick, times, 1 / rate, 2 * loop.n)


def apply_pushes(plant: MuJoCoPlant, loads: Loads, shares: Array) -> Array | None:
    """Apply the forces of the pushes for a tick of which they last a share each. Returns their joint torques (n,)."""
    # Pushes act by their shares of the tick; joint torques come beside the law's.
    plant.release()
    if not shares.any():
        return None
    torque = np.zeros(plant.robot.n)
    for share, push in zip(shares, loads.pushes, strict=True):
        if share > 0:
            plant.push(share * push.force, push.link, push.point)
            torque += share * push.load(plant.robot.n)[3:]
    return torque


def _law(loop: ClosedLoop, k: int) -> Callable[[Array, Array, Array], Array]:
    """q and dq as measured, reference with derivatives (3 k,) -> [command; status; no cause]."""
    state, reference = ca.MX.sym("state", 2 * loop.n), ca.MX.sym("reference", 3 * k)
    sent = ca.vertcat(*loop.commanded(state, (reference[:k], reference[k : 2 * k], reference[2 * k :])), 0)
    law = ca.Function("law", [state, reference], [sent])
    return lambda q, dq, target: np.asarray(law(np.concatenate([q, dq]), target).full().ravel())
