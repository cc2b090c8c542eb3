"""Closed loops with MuJoCo as plant: a sampled controller whose command is held between ticks."""

from collections.abc import Iterator

import casadi as ca
import numpy as np

from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array
from orthocas.control.reference import Reference
from orthocas.simulation.closed_loop import ClosedLoop, Piece
from orthocas.simulation.disturbances import Noise
from orthocas.simulation.loads import Loads
from orthocas.simulation.mujoco_plant import MuJoCoPlant
from orthocas.simulation.mujoco_scene import MuJoCo

_TICKS = 50  # ticks between two looks at Ctrl-C


def run_physics(
    loop: ClosedLoop, reference: Reference, start: Array, rate: float, noise: Noise, scene: MuJoCo
) -> Iterator[Piece]:
    """Yield pieces of 50 ticks, with the commands that were held.

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
    )
    plant.reset(start[: loop.n], start[loop.n :])
    ticks = int(np.floor(reference.duration * rate + 1e-9))
    times = np.arange(ticks) / rate
    wanted, errors = np.hstack(reference.sample(times)), noise.sample(ticks, loop.n)
    shares = loop.loads.shares(times, 1 / rate)
    law = _law(loop, len(reference.labels))
    for first in range(0, ticks, _TICKS):
        held = range(first, min(first + _TICKS, ticks))
        rows = []
        with deferred():
            for k in held:
                command, status = (
                    part.full().ravel() for part in law(np.concatenate([plant.q, plant.dq]) + errors[k], wanted[k])
                )
                plant.step(command, 1 / rate, _push(plant, loop.loads, shares[k]))
                rows.append(np.concatenate([plant.q, plant.dq, command, status]))
        states, commands, known = np.split(np.array(rows), [2 * loop.n, 3 * loop.n], axis=1)
        yield Piece(times[held] + 1 / rate, states, (commands, known[:, 0]))


def _push(plant: MuJoCoPlant, loads: Loads, shares: Array) -> Array | None:
    """Apply the forces of the pushes for a tick of which they last a share each. Returns their joint torques (n,)."""
    plant.release()
    if not shares.any():
        return None
    torque = np.zeros(plant.robot.n)
    for share, push in zip(shares, loads.pushes, strict=True):
        if share > 0:
            plant.push(share * push.force, push.link, push.point)
            torque += share * push.load(plant.robot.n)[3:]
    return torque


def _law(loop: ClosedLoop, k: int) -> ca.Function:
    """State as measured, reference with derivatives (3 k, 1) -> command, status."""
    state, reference = ca.MX.sym("state", 2 * loop.n), ca.MX.sym("reference", 3 * k)
    return ca.Function(
        "law",
        [state, reference],
        [*loop.commanded(state, (reference[:k], reference[k : 2 * k], reference[2 * k :]))],
    )
