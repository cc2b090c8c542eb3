"""What laws are asked to do: steps, circles, or nothing, as phi and as the posture that belongs to it."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from baselines import posture_reference

import orthocas as oc
from orthocas.control import Reference
from orthocas.errors import UnreachableReferenceError
from orthocas.tools.checks import Array

TICK = 1e-3  # [s]
REST = 0.2  # at the start of every motion [s]
MOTION = 0.4  # joint motion of steps in xi [rad]
ROOM = 0.9  # share of the box for the reference: laws without feed-forward leave it by a little
RADIUS, PERIOD = 0.1, 2.0  # of the circle [m], [s]


@dataclass(frozen=True)
class Motion:
    """What is wanted at every tick."""

    phi: Array  #: (N, 3, n), with two derivatives
    posture: Array  #: (N, 2, n), with one derivative

    def at_end(self) -> "Motion":
        """The last tick alone."""
        return Motion(self.phi[-1:], self.posture[-1:])


def motion_of(chart: oc.Chart, q: Array, changes: list[tuple[float, dict[str, float]]], duration: float) -> Motion:
    """Steps through the low pass of the paper; raises UnreachableReferenceError if they leave the domain."""
    reference = Reference.steps(chart.labels, chart.phi(q), changes, duration)
    times = np.arange(0, duration, TICK)
    posture = posture_reference(chart, reference, q)
    joints = np.stack(posture.sample(times)[:2], axis=1)[:, :, chart.m :]
    return Motion(np.stack(reference.sample(times), axis=1), joints)


def step_of(chart: oc.Chart, q: Array, label: str, size: float | None = None) -> Motion:
    """A step in one quantity, of a size or one that moves a joint by MOTION; smaller where the domain asks for it."""
    i, domain = chart.labels.index(label), chart.problem.domain
    size = MOTION / np.abs(np.linalg.inv(chart.jacobian(q))[:, i]).max() if size is None else size
    for share in (1.0, -1.0, 0.7, -0.7, 0.5, -0.5, 0.35, -0.35, 0.25, -0.25, 0.15, -0.15):
        with suppress(UnreachableReferenceError):
            motion = motion_of(chart, q, [(REST, {label: chart.phi(q)[i] + share * size})], REST + 2.0)
            if (np.abs(motion.posture[:, 0] - domain.centre) < ROOM * domain.half_width).all():
                return motion
    raise UnreachableReferenceError(f"no step in {label} stays within the domain")


def held(chart: oc.Chart, q: Array, duration: float) -> Motion:
    """Hold still."""
    ticks = round(duration / TICK)
    rest = np.zeros_like(q)
    return Motion(np.tile([chart.phi(q), rest, rest], (ticks, 1, 1)), np.tile([q, rest], (ticks, 1, 1)))


def circles(chart: oc.Chart, q: Array, count: int) -> Motion:
    """The flange follows a horizontal circle, from rest to rest in every cycle; xi, or the posture, stays constant."""
    still = held(chart, q, count * PERIOD + 1.0)
    moving = round(count * PERIOD / TICK)
    s = TICK * np.arange(moving) / PERIOD % 1
    angle = 2 * np.pi * s**3 * (10 - 15 * s + 6 * s**2)
    rate, bend = 60 * np.pi * (s * (1 - s)) ** 2, 120 * np.pi * s * (1 - s) * (1 - 2 * s)
    rate, bend = rate / PERIOD, bend / PERIOD**2
    towards, along = (
        np.stack(pair, axis=1) for pair in ((np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle)))
    )
    still.phi[:moving, 0, :2] += RADIUS * (towards - [1, 0])
    still.phi[:moving, 1, :2] = RADIUS * along * rate[:, None]
    still.phi[:moving, 2, :2] = RADIUS * (along * bend[:, None] - towards * rate[:, None] ** 2)
    return still
