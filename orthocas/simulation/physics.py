"""Closed loops with MuJoCo as plant: a sampled controller whose command is held between ticks."""

from collections.abc import Callable, Iterator

import casadi as ca
import numpy as np

from orthocas.checks import Array
from orthocas.control.reference import Reference
from orthocas.simulation.closed_loop import ClosedLoop, Piece
from orthocas.simulation.disturbances import Noise
from orthocas.simulation.loads import Loads
from orthocas.simulation.mujoco_plant import MuJoCoPlant
from orthocas.simulation.mujoco_scene import MuJoCo
from orthocas.simulation.sampled import pieces
from orthocas.simulation.supervised import SupervisedLaw


def run_physics(
    loop: ClosedLoop,
    reference: Reference,
    start: Array,
    rate: float,
    noise: Noise,
    scene: MuJoCo,
    supervised: SupervisedLaw | None = None,
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
    plant.reset(start[: loop.n], start[loop.n :])
    ticks = int(np.floor(reference.duration * rate + 1e-9))
    times = np.arange(ticks) / rate
    wanted, errors = np.hstack(reference.sample(times)), noise.sample(ticks, loop.n)
    shares = loop.loads.shares(times, 1 / rate)
    law = _law(loop, len(reference.labels)) if supervised is None else supervised.tick
    if supervised is not None:
        supervised.start(start[: loop.n] + errors[0, : loop.n])

    def tick(k: int) -> Array:
        q, dq = np.split(np.concatenate([plant.q, plant.dq]) + errors[k], 2)
        sent = law(q, dq, wanted[k])
        plant.step(sent[: loop.n], 1 / rate, apply_pushes(plant, loop.loads, shares[k]))
        return np.concatenate([plant.q, plant.dq, sent])

    yield from pieces(tick, times, 1 / rate, 2 * loop.n)


def apply_pushes(plant: MuJoCoPlant, loads: Loads, shares: Array) -> Array | None:
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


def _law(loop: ClosedLoop, k: int) -> Callable[[Array, Array, Array], Array]:
    """q and dq as measured, reference with derivatives (3 k,) -> [command; status; no cause]."""
    state, reference = ca.MX.sym("state", 2 * loop.n), ca.MX.sym("reference", 3 * k)
    sent = ca.vertcat(*loop.commanded(state, (reference[:k], reference[k : 2 * k], reference[2 * k :])), 0)
    law = ca.Function("law", [state, reference], [sent])
    return lambda q, dq, wanted: np.asarray(law(np.concatenate([q, dq]), wanted).full().ravel())
