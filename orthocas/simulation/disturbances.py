"""Disturbances that the model leaves out: pushes, friction, sensor noise, and where they act."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.control.gains import non_negative_gains, positive_gains
from orthocas.errors import InvalidValueError
from orthocas.robots.kinematics import point_jacobian
from orthocas.robots.tree import KinematicTree
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, frozen_array, require_count, require_known, require_shape

_STICTION_SPEED = 0.01  # [rad/s] or [m/s]: above twice this speed, Coulomb friction is nearly at its full value

Link = str | int | None  #: a link, by the joint that moves it (name or index), or a frame by its name; None: the tip


class Place(NamedTuple):
    """A point of a body."""

    body: int  #: index of the joint that moves it, -1 for the base
    point: tuple[float, float, float]  #: in the frame of the body in `KinematicTree` [m]


def place_of(tree: KinematicTree, link: Link, point: Array) -> Place:
    """The place of a point (3,) in the frame of a link, or of the tip.

    Raises:
        UnknownNameError, InvalidValueError: if the robot has no such link.
    """
    if link is None:
        x, y, z = tree.tip_translation + tree.tip_rotation @ point
        return Place(tree.tip_parent, (float(x), float(y), float(z)))
    if isinstance(link, str):
        if link in tree.frame_names:
            frame = tree.frame(link)
            x, y, z = frame.translation + frame.rotation @ point
            return Place(frame.parent, (float(x), float(y), float(z)))
        require_known("link, named by the joint that moves it,", link, tree.joint_names)
        link = tree.joint_names.index(link)
    require_link(link, tree.n)
    return Place(int(link), tuple(point.tolist()))


def require_link(link: object, n: int | None = None) -> None:
    """Raise InvalidValueError unless the link is a name, None, or an index (of n joints, if n is known)."""
    if link is None or isinstance(link, str):
        return
    whole = isinstance(link, int | np.integer) and not isinstance(link, bool)
    if not whole or link < 0 or (n is not None and link >= n):  # type: ignore[operator]
        most = "" if n is None else f" from 0 to {n - 1}"
        raise InvalidValueError("link", repr(link)[:80], f"the name of a joint, or the index of one{most}")


@dataclass(frozen=True, eq=False)
class Push:
    """An external load that is constant for some time.

    Args:
        start: [s], >= 0.
        duration: [s], > 0.
        force: in world axes, (3,) [N]; default no force.
        torque: at the joints, (n,) [N m] or [N]; default no torque.
        link: where the force acts: a link, by the name or the index of the joint that moves it, or a frame of the robot
            by its name; default the tip.
        point: where on the link, in its frame, (3,) [m]. Frames of links are those of `Robot.tree`: the origin is on
            the joint's axis, which is z.
    """

    start: float
    duration: float
    force: Array
    torque: Array | None
    link: Link
    point: Array

    def __init__(
        self,
        start: float,
        duration: float,
        force: ArrayLike = (0.0, 0.0, 0.0),
        torque: ArrayLike | None = None,
        link: Link = None,
        point: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        for name, value, want in (("start", start, ">= 0"), ("duration", duration, "> 0")):
            number = as_float_array(f"{name} of a push", value)
            require_shape(f"{name} of a push", number.shape, ())
            if not (np.isfinite(number) and (number > 0 or (number == 0 and name == "start"))):
                raise InvalidValueError(f"{name} of a push", value, f"a finite number {want}")
        object.__setattr__(self, "start", float(start))
        object.__setattr__(self, "duration", float(duration))
        object.__setattr__(self, "force", frozen_array("force", force, (3,)))
        object.__setattr__(self, "torque", None if torque is None else frozen_array("torque", torque, (None,)))
        require_link(link)
        object.__setattr__(self, "link", link)
        object.__setattr__(self, "point", frozen_array("point", point, (3,)))

    @property
    def end(self) -> float:
        """Time at which the push ends [s]."""
        return self.start + self.duration

    def load(self, n: int) -> Array:
        """Force and joint torques in one row, (3 + n,)."""
        torque = np.zeros(n) if self.torque is None else self.torque
        require_shape("torque of a push", torque.shape, (n,))
        return np.concatenate([self.force, torque])


@dataclass(frozen=True, eq=False)
class Friction:
    """Joint friction tau_f = viscous dq + coulomb tanh(dq / 0.01), which opposes the motion.

    Args:
        viscous: >= 0, (n,) or one number [N m s/rad].
        coulomb: >= 0, (n,) or one number [N m].
    """

    viscous: ArrayLike = 0.0
    coulomb: ArrayLike = 0.0

    def numbers(self, n: int) -> Array:
        """Viscous and Coulomb friction of n joints in one row, (2 n,)."""
        return np.concatenate([non_negative_gains(name, getattr(self, name), n) for name in ("viscous", "coulomb")])

    @staticmethod
    def torque(dq: ca.SX, numbers: ca.SX) -> ca.SX:
        """Friction torque, to be subtracted from the joint torque, (n, 1), for `numbers` as a column (2 n, 1)."""
        n = dq.shape[0]
        friction: ca.SX = numbers[:n] * dq + numbers[n:] * ca.tanh(dq / _STICTION_SPEED)
        return friction


@dataclass(frozen=True, eq=False)
class Stops:
    """Joint stops tau_s = -stiffness p max(0, 1 + damping dp/dt), where p is how far a joint is beyond its limit.

    The damping grows with p, as in the contact model of Hunt and Crossley, so the torque is continuous and never pulls.

    Args:
        stiffness: > 0, (n,) or one number [N m/rad] or [N/m].
        damping: >= 0, (n,) or one number [s/rad] or [s/m].
    """

    stiffness: ArrayLike = 2e4
    damping: ArrayLike = 1.0

    def torque(self, tree: KinematicTree, q: ca.SX, dq: ca.SX) -> ca.SX:
        """Torque of the stops on the joints, (n, 1)."""
        stiffness = positive_gains("stiffness of stops", self.stiffness, tree.n)
        damping = non_negative_gains("damping of stops", self.damping, tree.n)
        torque = ca.SX(tree.n, 1)
        for i in range(tree.n):
            for limit, side in ((tree.lower[i], -1.0), (tree.upper[i], 1.0)):
                if np.isfinite(limit):
                    beyond = ca.fmax(0, side * (q[i] - limit))
                    torque[i] -= side * stiffness[i] * beyond * ca.fmax(0, 1 + side * damping[i] * dq[i])
        return torque


@dataclass(frozen=True)
class Noise:
    """White Gaussian noise on the measurements of the controller, drawn anew at every control tick.

    Args:
        position: standard deviation >= 0 [rad] or [m].
        velocity: standard deviation >= 0 [rad/s] or [m/s].
        seed: of the random numbers.
    """

    position: float = 0.0
    velocity: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require_count("seed", self.seed, least=0)
        for name in ("position", "velocity"):
            value = as_float_array(f"{name} noise", getattr(self, name))
            if value.shape or not (np.isfinite(value) and value >= 0):
                raise InvalidValueError(f"{name} noise", getattr(self, name), "a finite number >= 0")

    def sample(self, ticks: int, n: int) -> Array:
        """Measurement errors of q and dq, (ticks, 2 n)."""
        rng = np.random.default_rng(self.seed)
        return np.asarray(rng.normal(size=(ticks, 2 * n)) * np.repeat([self.position, self.velocity], n))


class Loads:
    """The pushes of a run, as rows [force at each of P places (3 P); torque of the joints (n)].

    Raises:
        UnknownNameError, InvalidValueError, ShapeError: if a push does not fit the robot.
    """

    def __init__(self, tree: KinematicTree, pushes: Sequence[Push] = ()) -> None:
        self.pushes = tuple(pushes)
        self._tree = tree
        self._of_push = [place_of(tree, push.link, push.point) for push in self.pushes]
        self._rows  # noqa: B018 (refuses torques of other robots at once)

    @cached_property
    def places(self) -> tuple[Place, ...]:
        """The different places where forces act."""
        return tuple(dict.fromkeys(self._of_push))

    @property
    def size(self) -> int:
        """Length of a row, 3 P + n."""
        return 3 * len(self.places) + self._tree.n

    def shares(self, starts: Array, length: float) -> Array:
        """How much of each interval of equal length each push lasts, (N, pushes): short pushes keep their impulses."""
        shares = [
            np.maximum(np.minimum(starts + length, push.end) - np.maximum(starts, push.start), 0.0) / length
            for push in self.pushes
        ]
        return np.array(shares).reshape(-1, len(starts)).T

    def mean(self, starts: Array, length: float) -> Array:
        """Mean rows over time intervals of equal length, (N, 3 P + n)."""
        return np.asarray(self.shares(starts, length) @ self._rows)

    def at(self, times: Array) -> Array:
        """Rows at times (N,), (N, 3 P + n). A push acts from its start until just before its end."""
        active = [(times >= push.start) & (times < push.end) for push in self.pushes]
        return np.asarray(np.array(active).reshape(-1, len(times)).T @ self._rows)

    def joint_torques(self, q: ca.SX, row: ca.SX) -> ca.SX:
        """J^T f at every place, plus the torque of the joints, (n, 1), for a row (3 P + n, 1)."""
        torque = row[3 * len(self.places) :]
        for k, place in enumerate(self.places):
            torque += point_jacobian(self._tree, q, place.body, np.array(place.point)).T @ row[3 * k : 3 * k + 3]
        return torque

    @cached_property
    def _rows(self) -> Array:
        """The row of each push while it acts, (pushes, 3 P + n)."""
        rows = np.zeros((len(self.pushes), self.size))
        for row, push, place in zip(rows, self.pushes, self._of_push, strict=True):
            load, k = push.load(self._tree.n), self.places.index(place)
            row[3 * k : 3 * k + 3], row[3 * len(self.places) :] = load[:3], load[3:]
        return rows
