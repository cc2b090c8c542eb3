"""Obstacles, and the distances of a robot's links from them."""

from orthocas.obstacles.link_distances import LinkDistances
from orthocas.obstacles.shapes import Capsule, Obstacle, Plane, Sphere

__all__ = ["Capsule", "LinkDistances", "Obstacle", "Plane", "Sphere"]
