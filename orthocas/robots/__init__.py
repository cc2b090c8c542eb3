"""Robots: numbers of a `pin.Model` turned into CasADi kinematics and dynamics."""

from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree

__all__ = ["KinematicTree", "Robot"]
