"""Simulation of controllers in closed loop with the full dynamics, and evaluation of the runs."""

from orthocas.simulation.disturbances import Friction, Noise, Push, Stops
from orthocas.simulation.mujoco_plant import Elasticity, MuJoCo, MuJoCoPlant, Payload, Wall
from orthocas.simulation.run import simulate, simulate_many
from orthocas.simulation.sticking import StickingPlant
from orthocas.simulation.trajectory import (
    Breakdown,
    Coupling,
    Outcome,
    Trajectory,
    coupling_index,
    task_acceleration_breakdown,
)

__all__ = [
    "Breakdown",
    "Coupling",
    "Elasticity",
    "Friction",
    "MuJoCo",
    "MuJoCoPlant",
    "Noise",
    "Outcome",
    "Payload",
    "Push",
    "StickingPlant",
    "Stops",
    "Trajectory",
    "Wall",
    "coupling_index",
    "simulate",
    "simulate_many",
    "task_acceleration_breakdown",
]
