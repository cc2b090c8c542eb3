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
from orthocas.fitting.like import SWIVEL, Like, Likeness, like_label, quantity_of
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array
from orthocas.tools.display import percent

_MEANT = 100.0  # weight of the mean squared error of a meaning, relative to the slope
_STEP, _MOST_STEPS, _FEWEST = 0.02, 400, 5  # of unit self-motions, along which a meaning is taken
_STILL = 1e-3  # change of a quantity for a unit self-motion
_TINY = 1e-12  # least sum of squares to divide by
_HELD_OUT = 10_000  # samples of the domain for errors


class Wish(NamedTuple):
    """The term c^T E c - 2 g^T c + a of a coordinate's coefficients c (K,)."""

    E: Array
    g: Array
    a: float


@dataclass(frozen=True)
class MeaningError:
    """How far a coordinate is from a quantity at samples of the domain, not only at home."""

    rms: float  #: root mean square difference, in the unit of the quantity; of angles, the shortest
    correlation: float  #: of the two; angles are taken within half a turn of their value at home
    against: float  #: share of the positions at which self-motions change the two in opposite senses

    @property
    def explained(self) -> str:
        """In words."""
        against = percent(self.against, fault=True)
        return f"{self.rms:.2g} off (rms), correlation {self.correlation:.2f}, against it on {against} of the domain"

    def notes(self) -> dict[str, float]:
        """For the notes of a chart."""
        return {
            "error of its meaning": self.rms,
            "correlation with its meaning": self.correlation,
            "share against its meaning": self.against,
        }


@dataclass(frozen=True, eq=False)
class Meaning:
    """Values that a coordinate is to have along the self-motion of a posture."""

    points: Array  #: (k, n), the posture in the middle
    values: Array  #: (k,), monotone
    middle: int  #: place of the posture
    slope: float  #: mean change of the value for a unit self-motion, in the sense of `unit_self_motion`
    name: str  #: with its unit
    wanted: bool  #: whether coordinates are fitted to the values; otherwise they only get their scale and offset
    quantity: ca.Function  #: q (n, 1) -> the quantity (1, 1)
    turns: bool  #: whether it is an angle that jumps by whole turns

    @property
    def label(self) -> str:
        """What the coordinate means, for the notes of a chart."""
        return like_label(self.name, "at home")

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
        turns = like == SWIVEL
        if turns:
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
        along = points[low : high + 1], values[low : high + 1]
        return cls(*along, middle - low, float(slope), name, True, quantity, turns)

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

    def error(self, problem: Problem, coordinates: Coordinates, seed: int) -> MeaningError:
        """What coordinates miss of the quantity at held-out samples of the domain, where it has a value."""
        samples = sample_problem(problem, _HELD_OUT, (seed, _HELD_OUT))
        q = ca.SX.sym("q", problem.n)
        both = dense_function("quantity", [q], [self.quantity(q), ca.jacobian(self.quantity(q), q)])
        value, slopes = (part.reshape(len(samples), -1) for part in Batched(both)(samples.points))
        xi, J = coordinates.once("xi", samples.points), coordinates.jacobian(samples.points)[:, 0]
        z = samples.null_basis[:, :, 0]
        known = np.isfinite(value[:, 0]) & np.isfinite(slopes).all(axis=1)
        xi, value = xi[known, 0], value[known, 0]
        missed, value = xi - value, value - self.values[self.middle]
        if self.turns:
            missed, value = _within_half_a_turn(missed), _within_half_a_turn(value)
        senses = np.einsum("sn,sn->s", J, z) * np.einsum("sn,sn->s", slopes, z)
        return MeaningError(
            rms=float(np.sqrt(np.mean(missed**2))),
            correlation=float(np.corrcoef(xi, value)[0, 1]),
            against=float(np.mean(senses[known] < 0)),
        )


def _within_half_a_turn(angles: Array) -> Array:
    return np.asarray(angles - 2 * np.pi * np.round(angles / (2 * np.pi)))


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
    square = 1.0 if problem.metric.is_identity else z @ problem.metric.evaluate(q[None])[0] @ z
    return np.asarray(z / np.sqrt(square))
