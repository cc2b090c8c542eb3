"""What a law learns of the robot at run time: payload, contact forces, extra torque, or the model itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.control.gains import spread_gains
from orthocas.errors import InvalidValueError
from orthocas.robots.dynamics import check_payload
from orthocas.robots.robot import Robot
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array, freeze_array, require_known

Source = Literal["own", "given"]
Gravity = Literal["law", "robot"]

UNITS: Mapping[str, str] = {  #: meaning of the inputs, in words
    "payload": "at the tip: mass [kg], centre in the tip frame [m], inertia xx, xy, xz, yy, yz, zz about it [kg m^2]",
    "wrench": "that the tip exerts on its surroundings, in world axes: force [N], torque about the tip [N m]",
    "extra_torque": "added to the command, for example against friction [N m] or [N]",
    "mass_matrix": "M(q) of the robot in every tick, symmetric, row by row",
    "coriolis_torque": "C(q, dq) dq of the robot in every tick [N m] or [N]",
    "gravity_torque": "g(q) of the robot in every tick [N m] or [N]",
}


@dataclass(frozen=True, eq=False)
class RunTimeModel:
    """Where a law gets its model from, and which additional inputs it has.

    Every value that is not None becomes an input of the law, among its gains, and this value is its default.

    Args:
        source: `own` computes mass matrix, Coriolis forces and gravity from the robot of the problem; `given` makes
            them inputs, for robots that report their own model. PD+ needs C(q, dq) w with the desired velocity w, and
            robots report C(q, dq) dq only. So PD+ then cancels the Coriolis forces of the true motion, and uses
            dJ/dt dq. The coupled loop becomes M_phi dde + D de + K e = 0, which tracks as well, but is no longer
            passive, because M_phi changes without a Coriolis term to match.
        gravity: `law` adds g(q) to the command; `robot` leaves it out, for robots that compensate it themselves. The
            fallback is then zero torque.
        payload: mass, (4,) mass and centre, or (10,) also inertia; see `Robot.with_payload`. It acts on mass matrix,
            Coriolis forces, gravity and fallback. Not with `given`, because the robot's model includes its load.
        wrench: force and torque (6,) that the tip exerts on its surroundings [N], [N m] in world axes; adds
            J_tip^T wrench. To cancel a measured force on the tip, pass its negative.
        extra_torque: (n,) or one number, added to the command, for example against friction [N m] or [N].

    Raises:
        ShapeError, InvalidValueError, UnknownNameError: for values of the wrong shape or name, or payload with `given`.
    """

    source: Source = "own"
    gravity: Gravity = "law"
    payload: ArrayLike | None = None
    wrench: ArrayLike | None = None
    extra_torque: ArrayLike | None = None

    def __post_init__(self) -> None:
        require_known("source of the model", self.source, get_args(Source))
        require_known("gravity", self.gravity, get_args(Gravity))
        if self.payload is not None:
            if self.source == "given":
                raise InvalidValueError("payload", self.payload, "none, because the given model includes the load")
            object.__setattr__(self, "payload", check_payload(self.payload))
        if self.wrench is not None:
            object.__setattr__(self, "wrench", freeze_array("wrench", self.wrench, (6,)))

    @property
    def settings(self) -> dict[str, str]:
        """The choices that differ from the default."""
        choices = {"model": self.source, "gravity": self.gravity}
        return {name: word for name, word in choices.items() if word not in ("own", "law")}

    def gains(self, problem: Problem, coriolis: bool) -> dict[str, Array]:
        """The default values of the inputs by name; a given model is that of the home of the domain at rest."""
        # What was asked for becomes an input; a given model takes the place of the law's own.
        result: dict[str, Array] = {}
        for name in ("payload", "wrench"):
            if (value := getattr(self, name)) is not None:
                result[name] = value
        if self.extra_torque is not None:
            result["extra_torque"] = spread_gains("extra_torque", self.extra_torque, problem.n)
        if self.source == "given":
            robot, q = problem.robot, problem.domain.home
            result["mass_matrix"] = freeze_array("mass_matrix", robot.mass_matrix(q).ravel(), (problem.n**2,))
            if coriolis:
                result["coriolis_torque"] = np.zeros(problem.n)
            if self.gravity == "law":
                result["gravity_torque"] = freeze_array("gravity_torque", robot.gravity(q), (problem.n,))
        return result

    def remarks(self) -> list[str]:
        """What to know before the law is switched on."""
        result = []
        if self.source == "given":
            result.append(
                "the robot's model is an input of this law: pass mass matrix and torques in every tick, because their "
                "defaults hold only at rest at the centre of the domain"
            )
        if self.gravity == "robot":
            result.append("this law leaves gravity to the robot: its fallback is zero torque")
        return result

    def robot(self, problem: Problem) -> Robot:
        """The robot with the default payload, for analysis."""
        return problem.robot if self.payload is None else problem.robot.with_payload(self.payload)

    def own_mass_matrix(self, robot: Robot, inputs: Mapping[str, ca.MX]) -> ca.MX:
        """M(q) from the robot of the problem, with the payload."""
        return _call_robot(robot, "mass_matrix", inputs, inputs["q"])

    def mass_matrix(self, robot: Robot, inputs: Mapping[str, ca.MX]) -> ca.MX:
        """M(q), (n, n), computed or given."""
        if self.source == "given":
            return ca.reshape(inputs["mass_matrix"], robot.n, robot.n)
        return self.own_mass_matrix(robot, inputs)

    def gravity_torque(self, robot: Robot, inputs: Mapping[str, ca.MX]) -> ca.MX:
        """The part of the command that holds the robot at rest, (n, 1)."""
        if self.gravity == "robot":
            return ca.MX(robot.n, 1)
        given = self.source == "given"
        return inputs["gravity_torque"] if given else _call_robot(robot, "gravity", inputs, inputs["q"])

    def coriolis_torque(self, robot: Robot, inputs: Mapping[str, ca.MX], w: ca.MX) -> ca.MX:
        """C(q, dq) w, (n, 1); the given C(q, dq) dq instead if the model is given."""
        if self.source == "given":
            return inputs["coriolis_torque"]
        return _call_robot(robot, "coriolis_product", inputs, inputs["q"], inputs["dq"], w)

    def feed_forward(self, robot: Robot, inputs: Mapping[str, ca.MX]) -> ca.MX:
        """J_tip^T wrench + extra_torque, (n, 1), as far as they are inputs."""
        torque = ca.MX(robot.n, 1)
        if "wrench" in inputs:
            torque += robot.tip_jacobian(inputs["q"]).T @ inputs["wrench"]
        return torque + inputs["extra_torque"] if "extra_torque" in inputs else torque


def _call_robot(robot: Robot, name: str, inputs: Mapping[str, ca.MX], *arguments: ca.MX) -> ca.MX:
    """A function of the robot, with the payload if that is an input."""
    if "payload" in inputs:
        return robot.function(f"{name}_with_payload")(*arguments, inputs["payload"])
    return robot.function(name)(*arguments)
