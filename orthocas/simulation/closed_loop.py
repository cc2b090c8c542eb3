"""The right-hand side of a closed loop: controller, plant and disturbances as one CasADi function."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from orthocas.control.controller import Controller
from orthocas.control.reference import Reference
from orthocas.errors import SimulationError
from orthocas.robots import dynamics
from orthocas.robots.robot import Robot
from orthocas.simulation.disturbances import Friction, Loads, Stops
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.expressions import scalar_code
from orthocas.tools.interrupts import deferred

KEPT = 32  #: functions of each kind that a process remembers


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
        """Numbers of a state."""
        return 2 * self.n if self.torque else self.n

    @property
    def torque(self) -> bool:
        """Whether the command is a torque."""
        return self.controller.command == "torque"

    @property
    def stiff(self) -> bool:
        """Whether friction or stops make an implicit method necessary."""
        return self.stops is not None or bool(np.any(np.asarray(self.friction.coulomb)))

    @cached_property
    def plant_rate(self) -> ca.Function:
        """state, command (n, 1), load (`Loads.size`, 1) -> rate of the state."""
        plant = _plant_of_numbers(Keyed(self.plant_key, self))
        state, command, load, _ = plant.sx_in()
        rate = plant.call([state, command, load, ca.SX(ca.DM(self.plant_numbers))])
        return ca.Function("plant", [state, command, load], rate)

    @property
    def plant_of_numbers(self) -> ca.Function:
        """The same with `plant_numbers` as a fourth input: one function for robots and friction of any amounts."""
        n = self.n
        q, dq, command, load = (
            ca.SX.sym(name, size) for name, size in (("q", n), ("dq", n), ("u", n), ("load", self.loads.size))
        )
        numbers = ca.SX.sym("numbers", len(self.plant_numbers))
        if not self.torque:
            return ca.Function("plant", [q, command, load, numbers], [command])
        torque = command + self.loads.joint_torques(q, load)
        if self.stops is not None:
            torque += self.stops.torque(self.plant.tree, q, dq)
        if self.rubs:
            torque -= self.friction.torque(dq, numbers[: 2 * n])
        inertials = numbers[2 * n :] if self.rubs else numbers
        tree = self.plant.tree
        ddq = dynamics.forward_dynamics(tree, q, dq, torque, tree.gravity, inertials)
        return ca.Function("plant", [ca.vertcat(q, dq), command, load, numbers], [ca.vertcat(dq, ddq)])

    @property
    def plant_numbers(self) -> Array:
        """Amounts of friction, if there is any, then the inertial parameters of the robot."""
        if not self.torque:
            return np.zeros(0)
        inertials = dynamics.inertial_numbers(self.plant.tree)
        return np.concatenate([self.friction.numbers(self.n), inertials]) if self.rubs else inertials

    @property
    def plant_key(self) -> tuple[object, ...]:
        """Equal for loops with the same `plant_of_numbers`."""
        if not self.torque:
            return (self.n,)
        tree = self.plant.tree
        arrays = [tree.rotations, tree.translations, tree.armatures, tree.gravity]
        if self.stops is not None:
            arrays += [np.asarray(self.stops.stiffness), np.asarray(self.stops.damping), tree.lower, tree.upper]
        numbers = tuple(array.tobytes() for array in arrays)
        return (tree.joint_kinds, tree.parents, numbers, self.loads.places, self.rubs, self.stops is None)

    @property
    def rubs(self) -> bool:
        """Whether there is friction."""
        return bool(self.friction.numbers(self.n).any())

    def commanded(self, state: ca.MX, reference: Sequence[ca.MX]) -> tuple[ca.MX, ca.MX]:
        """Command and status for a (measured) state and a reference with two derivatives."""
        dq = state[self.n :] if self.torque else ca.MX(self.n, 1)
        gains = [ca.DM(gain) for gain in self.controller.gains.values()]
        command, status = self.controller.function.call([state[: self.n], dq, *reference, *gains])
        return command, status

    def rate(self, reference: Reference) -> ca.Function:
        """state, time since the start of a segment, parameters of the segment, load -> rate of the state.

        A process remembers it, so runs that differ in start, targets or size of loads build it once.
        """
        gains = tuple(gain.tobytes() for gain in self.controller.gains.values())
        plant = (self.plant_key, self.plant_numbers.tobytes())
        return _rate(Keyed((self.controller.function, gains, plant), self), reference.profile)


@dataclass(frozen=True)
class Keyed:
    """A loop that counts as equal to others with the same key."""

    key: Hashable
    loop: ClosedLoop = field(compare=False)


@lru_cache(KEPT)
def _plant_of_numbers(keyed: Keyed) -> ca.Function:
    return keyed.loop.plant_of_numbers


@lru_cache(KEPT)
def _rate(keyed: Keyed, profile: ca.Function) -> ca.Function:
    loop = keyed.loop
    state = ca.MX.sym("state", loop.size)
    t, parameters = ca.MX.sym("t"), ca.MX.sym("parameters", profile.size1_in(1))
    load = ca.MX.sym("load", loop.loads.size)
    command, _ = loop.commanded(state, profile.call([t, parameters]))
    rate = ca.Function("rate", [state, t, parameters, load], [loop.plant_rate(state, command, load)])
    return scalar_code(rate) if loop.controller.function.is_a("SXFunction") else rate


@dataclass(frozen=True, eq=False)
class Held:
    """What a sampled controller said at the start of each of N ticks."""

    commands: Array  #: (N, n), held until the end of the tick
    status: Array  #: (N,)
    cause: Array  #: (N,) why the catcher of a supervised law took over last


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a run: N instants, each at the end of a time step."""

    times: Array  #: (N,) [s]
    states: Array  #: (N, s)
    held: Held | None = None  #: of sampled controllers, in the tick that ends at each instant


def run_compiled(function: ca.Function, *arguments: Any, **named: Any) -> Any:
    """Call a function that integrates; Ctrl-C is deferred until it returns.

    Raises:
        SimulationError: if CVODES gives up.
    """
    with deferred():
        try:
            return function(*arguments, **named)
        except RuntimeError as error:
            raise SimulationError(f"CVODES gave up: {str(error)[:200]}") from None


def cvodes_options(tolerance: float, stiff: bool) -> dict[str, Any]:
    """Adams with functional iteration, which needs no Jacobian, or BDF with Newton's if Coulomb friction is stiff."""
    return {
        "linear_multistep_method": "bdf" if stiff else "adams",
        "nonlinear_solver_iteration": "newton" if stiff else "functional",
        "abstol": tolerance,
        "reltol": tolerance,
        "max_num_steps": 20_000,
        "disable_internal_warnings": True,
        "show_eval_warnings": False,
    }
