"""What coordinates of wide charts mean: values along the self-motion of a posture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import casadi as ca
import numpy as np

from orthocas.bases.family import LinearFamily
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import InvalidValueError, RobotError
from orthocas.fitting.like import SWIVEL, Like, Likeness, quantity_of
from orthocas.tasks.metric import metric_matrices
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array

_MEANT = 100.0  # weight of the mean squared error of a meaning, relative to the slope
_STEP, _MOST_STEPS, _FEWEST = 0.02, 400, 5  # of unit self-motions, along which a meaning is taken
_STILL = 1e-3  # change of a quantity for a unit self-motion
_TINY = 1e-12  # least sum of squares to divide by


class Wish(NamedTuple):
    """The term c^T E c - 2 g^T c + a of a coordinate's coefficients c (K,)."""

    E: Array
    g: Array
    a: float


@dataclass(frozen=True, eq=False)
class Meaning:
    """Values that a coordinate is to have along the self-motion of a posture."""

    points: Array  #: (k, n), the posture in the middle
    values: Array  #: (k,), monotone
    middle: int  #: place of the posture
    slope: float  #: mean change of the value for a unit self-motion, in the sense of `unit_self_motion`
    name: str  #: with its unit
    wanted: bool  #: whether coordinates are fitted to the values; otherwise they only get their scale and offset

    @classmethod
    def by_default(cls, problem: Problem, posture: Array) -> "Meaning | None":
        """The scale of the angle of the elbow, if the arm has shoulder, elbow and wrist and r = 1."""
        try:
            return replace(cls.of(problem, SWIVEL, posture), wanted=False)
        except (InvalidValueError, RobotError):
            return None

    @classmethod
    def of(cls, problem: Problem, like: Likeness, posture: Array) -> "Meaning":
        """Follow the self-motion of a posture both ways, as long as it is in the domain and the quantity is monotone.

        Raises:
            InvalidValueError: if there is more than one quantity, or it stands still there.
        """
        if isinstance(like, Task) or (isinstance(like, Sequence) and not isinstance(like, str)):
            several = Like.of(problem, like)
            if len(several.names) != 1:
                raise InvalidValueError("like", f"{len(several.names)} quantities", "one, as r = 1")
            name, quantity = several.names[0], several.function
        else:
            name, quantity = quantity_of(problem.robot, like)
        sides = [_followed(problem, posture, sign * _STEP) for sign in (-1.0, 1.0)]
        points = np.concatenate([sides[0][:0:-1], sides[1]])
        middle = len(sides[0]) - 1
        values = np.unwrap(Batched(quantity)(points)[0][:, 0])  # angles do not jump
        if like == SWIVEL:
            values -= 2 * np.pi * np.round(values[middle] / (2 * np.pi))
        steps = np.diff(values)
        if len(points) < _FEWEST or not np.isfinite(steps).all():
            raise InvalidValueError(
                "like", "of too short a self-motion at the home", "another home, farther from limits"
            )
        k = min(middle, len(steps) - 1)
        same = np.sign(steps) == np.sign(steps[k])
        low = k - int(np.argmin(same[k::-1])) + 1 if not same[: k + 1].all() else 0
        high = k + int(np.argmin(same[k:])) if not same[k:].all() else len(steps)
        slope = (values[high] - values[low]) / (_STEP * max(1, high - low))
        if high - low < _FEWEST or abs(slope) < _STILL:
            raise InvalidValueError("like", "a quantity that stands still at the home", "one that self-motions change")
        return cls(points[low : high + 1], values[low : high + 1], middle - low, float(slope), name, True)

    def wish(self, family: LinearFamily) -> Wish:
        """The mean squared difference from the values, over the squared slope, for coefficients of a family."""
        q = ca.SX.sym("q", self.points.shape[1])
        psi = Batched(dense_function("psi", [q], [family.basis(q)]))(self.points)[0].reshape(len(self.points), -1)
        rows, sides = psi - psi[self.middle], self.values - self.values[self.middle]
        weight = _MEANT / len(rows) / self.slope**2
        return Wish(weight * rows.T @ rows, weight * rows.T @ sides, weight * float(sides @ sides))

    def named(self, raw: Coordinates) -> Coordinates:
        """Coordinates in units of the quantity, with its value at the posture.

        The scale is that for which they were fitted, or the best one.
        """
        xi, scale = raw.once("xi", self.points)[:, 0], 1.0
        away, values = xi - xi[self.middle], self.values - self.values[self.middle]
        if not self.wanted:
            scale = float(away @ values / max(away @ away, _TINY))
        return replace(
            raw, offset=np.array([xi[self.middle] - self.values[self.middle] / scale]), scale=np.array([scale])
        )

    def error(self, coordinates: Coordinates) -> float:
        """Root mean square of what coordinates miss along the self-motion."""
        return float(np.sqrt(np.mean((coordinates.once("xi", self.points)[:, 0] - self.values) ** 2)))


def _followed(problem: Problem, posture: Array, step: float) -> Array:
    """The self-motion from a posture in steps of unit self-motions, up to the boundary of the domain, (k, n)."""
    found, slope = [posture], partial(unit_self_motion, problem)
    while len(found) < _MOST_STEPS and problem.domain.contains(found[-1]):
        q = found[-1]
        middle = q + step / 2 * slope(q)
        again = q + step / 2 * slope(middle)
        found.append(q + step / 6 * (slope(q) + 2 * slope(middle) + 2 * slope(again) + slope(q + step * slope(again))))
    return np.array(found[:-1] if len(found) > 1 else found)


def unit_self_motion(problem: Problem, q: Array) -> Array:
    """The unit self-motion z (n,) of a position for r = 1, with z^T A z = 1 and det [J_x; z^T] > 0."""
    J = problem.task.batched_frame_jacobian(q[None])[0].reshape(problem.m, problem.n)
    z = np.linalg.svd(J)[2][-1]
    z = z * np.sign(np.linalg.det(np.vstack([J, z])))
    square = 1.0 if problem.metric.is_identity else z @ metric_matrices(problem.metric, q[None])[0] @ z
    return np.asarray(z / np.sqrt(square))
