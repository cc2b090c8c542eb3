"""Motions of the tip: lines, circles, and smooth random ones."""

import numpy as np
import pinocchio as pin

from orthocas.tools.checks import Array
from redundancy.arms import Arm
from redundancy.protocol import Target


def smooth(count: int) -> Array:
    """Shares of a way from 0 to 1, at rest at both ends (count,); the last one is 1."""
    s = np.arange(1, count + 1) / count
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def moved(start: pin.SE3, shift: Array, turn: Array) -> pin.SE3:
    """A pose shifted [m] and turned [rad] in the world's axes."""
    return pin.SE3(pin.exp3(turn) @ start.rotation, start.translation + shift)


def between(a: pin.SE3, b: pin.SE3, count: int) -> list[pin.SE3]:
    """From a to b on a straight line, turning about one axis."""
    turn = pin.log3(b.rotation @ a.rotation.T)
    return [moved(a, s * (b.translation - a.translation), s * turn) for s in smooth(count)]


def direction(rng: np.random.Generator) -> Array:
    """A unit vector."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def in_ball(arm: Arm, rng: np.random.Generator, radius: float, turn: float) -> pin.SE3:
    """A pose near that of home: shifted by at most `radius` of the arm's size, turned by at most `turn` [rad]."""
    shift, axis = direction(rng) * radius * arm.size * rng.uniform() ** (1 / 3), direction(rng)
    return moved(arm.placement(arm.home), shift, axis * turn * rng.uniform())


def wandering(arm: Arm, rng: np.random.Generator, count: int, radius: float, turn: float) -> list[pin.SE3]:
    """A smooth random motion from the pose of home, with a band of 0.05 to 0.3 Hz, at most so far away."""
    time = np.arange(1, count + 1) * 0.01
    frequencies = rng.uniform(0.05, 0.3, (6, 4))
    waves = np.sin(2 * np.pi * frequencies[:, :, None] * time) * rng.normal(size=(6, 4, 1))
    signals = waves.sum(axis=1).T * np.minimum(1, time / 2)[:, None]
    for part, most in ((slice(0, 3), radius * arm.size), (slice(3, 6), turn)):
        signals[:, part] *= most / np.linalg.norm(signals[:, part], axis=1).max()
    start = arm.placement(arm.home)
    return [moved(start, s[:3], s[3:]) for s in signals]


def targets(arm: Arm, placements: list[pin.SE3]) -> list[Target]:
    """Poses with the posture of home."""
    return [Target(placement, arm.home) for placement in placements]
