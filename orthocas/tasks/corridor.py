"""Neighbourhood of a path of postures, as the domain of one chart for a long motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, cast

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, ShapeError
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import NARROWEST, WIDEST, Box, Domain, register_domain
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, as_point_set, freeze_array, require_kind
from orthocas.tools.display import number_list
from orthocas.tools.files import find_columns, read_table
from orthocas.tools.json import get_part

CORRIDOR = "corridor"  #: name of the kind
RADIUS = 0.2  #: default radius around a path [rad]
_MOST_POSTURES = 2000  #: largest number of postures of a path
_MOST_IN_FILE = 1_000_000  #: largest number of postures of a CSV file


@register_domain
@dataclass(frozen=True, eq=False, init=False, kw_only=True)
class Corridor(Box):
    """All q of a box near a path of postures (ours): sum_i ((q_i - p_i) / radius_i)^2 <= 1 for a point p of the path.

    The path consists of straight lines between successive postures. Joints with an infinite radius are not counted.
    `corridor_problem` determines these joints, and builds the box.

    A chart of a corridor has one value of xi per posture. So a loop of the task gives a closed joint path if this path
    can be shrunk to a point inside. The leak grows with the radius, and hardly with the length of the path.

    Args:
        box: the corridor is the part of this box near the path.
        postures: the path, (N, n) [rad] or [m], numbers up to 1e6.
        radius: one number, or one for each joint (n,), from 1e-9 to 1e6 or infinite [rad] or [m].

    Raises:
        ShapeError, InvalidValueError: for arguments of the wrong shape or value.

    Example:
        >>> import orthocas as oc
        >>> from orthocas.tasks.corridor import Corridor
        >>> corridor = Corridor(oc.Box([0.5, 0.5], 0.7), [[0.0, 0.0], [1.0, 1.0]], 0.2)
        >>> corridor.contains([[0.5, 0.6], [0.9, 0.1]]).tolist()
        [True, False]
    """

    name: str = CORRIDOR
    is_box = False
    draws_itself = True
    postures: Array
    radius: Array

    def __init__(self, box: Box, postures: ArrayLike, radius: ArrayLike) -> None:
        require_kind("box", box, Box)
        super().__init__(box.centre, box.half_width, box.unbounded)
        n = len(box.centre)
        # Check the path, then the radius of each joint.
        path = freeze_array("postures", postures, (None, n))
        if (widest := np.abs(path).max(initial=0.0)) > WIDEST:
            raise InvalidValueError("postures", f"up to {widest:.3g}", f"numbers up to {WIDEST:g}")
        if not 1 <= len(path) <= _MOST_POSTURES:
            raise InvalidValueError("number of postures", len(path), f"from 1 to {_MOST_POSTURES}")
        sizes = as_float_array("radius", radius)
        if sizes.shape not in ((), (n,)):
            raise ShapeError("radius", sizes.shape, (n,))
        finite = np.isfinite(sizes)
        if not ((sizes > NARROWEST) & (~finite | (sizes <= WIDEST))).all() or not finite.any():
            expected = f"numbers above {NARROWEST:g} up to {WIDEST:g}, or infinite ones for some of the joints"
            raise InvalidValueError("radius", sizes.tolist(), expected)
        sizes = np.array(np.broadcast_to(sizes, (n,)))
        sizes.setflags(write=False)
        for field, value in (("postures", path), ("radius", sizes)):
            object.__setattr__(self, field, value)
        # A corridor outside the box would be empty.
        if not self.contains(path).any():
            raise InvalidValueError("postures", "outside the box", "postures of which at least one lies in the box")

    @property
    def heading(self) -> str:
        """The condition in one line."""
        sizes = number_list(self.radius[self.counted])
        return f"distance to a path of {len(self.postures)} postures at most 1 in units of {sizes}"

    @property
    def condition(self) -> Self:
        """The domain itself, which is its own condition."""
        return self

    @property
    def path_bound(self) -> Self:
        """The domain itself, which bounds the distance to its path."""
        return self

    def describe_condition(self) -> dict[str, str]:
        """The condition in one line."""
        return {"corridor": self.heading}

    def to_data(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """Path and radius."""
        return super().to_data()[0], {"postures": self.postures, "radius": self.radius}

    @classmethod
    def from_data(cls, task: Any, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Domain:
        """Rebuild the corridor from a file."""
        box = cast("Box", Box.from_data(task, data, arrays))
        return cls(box, *(get_part(arrays, name, np.ndarray) for name in ("postures", "radius")))

    def apply_to(self, box: Box) -> Self:
        """The same condition on another box. Joints whose half-width there is larger are not counted."""
        wider = box.half_width > self.half_width * (1 + 1e-9)
        return type(self)(box, self.postures, np.where(wider, np.inf, self.radius))

    def explain(self, q: Array) -> str:
        """Say why a position (n,) is too far from the path."""
        distance = float(np.sqrt(1 - float(self.pivots(q))))
        return f"the position is {distance:.3g} radii away from the path of the corridor, expected at most 1"

    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie in the corridor: a bool, or (N,)."""
        points, single = as_point_set("q", q, len(self.centre))
        inside = np.array(super().contains(points))
        inside[inside] = self.squared_distance(points[inside]) <= 1
        return inside[0] if single else inside

    @cached_property
    def pivots(self) -> ca.Function:
        """q (n, 1) -> 1 - (distance to the path)^2, positive inside."""
        q = ca.SX.sym("q", len(self.centre))
        z = q[self.counted.tolist()] / ca.DM(self.radius[self.counted])
        squares = []
        for start, axis, square in zip(*self.lines, strict=True):
            apart, length = z - ca.DM(start), float(np.sqrt(square))
            along = ca.fmin(ca.fmax(ca.dot(apart, ca.DM(axis)), 0), length)
            squares.append(ca.sumsqr(apart - along * ca.DM(axis)))
        return dense_function("pivots", [q], [1 - ca.mmin(ca.vertcat(*squares))])

    def draw(self, rng: np.random.Generator, count: int, power: float) -> Array:
        """Draw at most `count` points (M, n): uniform for power 1, nearer to the boundary for smaller powers.

        Points are drawn in cylinders around the lines, in proportion to their volumes. A point of the corridor that
        lies in k cylinders is kept with probability 1 / k.
        """
        u = rng.uniform(-1.0, 1.0, (count, len(self.centre)))
        q = self.centre + self.half_width * np.sign(u) * np.abs(u) ** power
        # The cylinders have radius 1 and extend the lines by 1 at both ends.
        starts, axes, squares = self.lines
        length, d = np.sqrt(squares), starts.shape[1]
        k = rng.choice(len(length), size=count, p=(length + 2) / (length + 2).sum())
        direction = rng.normal(size=(count, d))
        direction -= (direction * axes[k]).sum(axis=1, keepdims=True) * axes[k]
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-300)
        distance = rng.uniform(size=(count, 1)) ** (power / max(d - 1, 1)) if d > 1 else 0.0
        heights = rng.uniform(-1.0, length[k] + 1)[:, None]
        q[:, self.counted] = (starts[k] + heights * axes[k] + distance * direction) * self.radius[self.counted]
        # Keep a point in k cylinders with probability 1 / k.
        q = q[self.contains(q)]
        along, across = self._parts(q)
        held = (across <= 1) & (along * length >= -1) & ((along - 1) * length <= 1)
        return np.asarray(q[rng.uniform(size=len(q)) * held.sum(axis=1) < 1])

    def squared_distance(self, points: Array) -> Array:
        """Squared distance of points (N, n) from the path, in units of the radii, (N,)."""
        along, across = self._parts(points)
        beyond = along - np.clip(along, 0.0, 1.0)
        return np.asarray((across + beyond**2 * self.lines[2]).min(axis=1))

    def lengths(self, steps: Array) -> Array:
        """Lengths of steps (N, n) in units of the radii, (N,)."""
        return np.asarray(np.linalg.norm(steps / self.radius, axis=1))

    def _parts(self, points: Array) -> tuple[Array, Array]:
        """Position of points (N, n) along every line (0 to 1 on it), and squared distances from it, (N, lines) each."""
        starts, axes, squares = self.lines
        z = points[:, self.counted] / self.radius[self.counted]
        along = z @ axes.T - (starts * axes).sum(axis=1)
        total = (z**2).sum(axis=1)[:, None] - 2 * z @ starts.T + (starts**2).sum(axis=1)
        return along / np.sqrt(squares), total - along**2

    @cached_property
    def counted(self) -> Any:
        """The joints with a finite radius, ascending."""
        return np.flatnonzero(np.isfinite(self.radius))

    @cached_property
    def lines(self) -> tuple[Array, Array, Array]:
        """Start, unit direction and squared length of every line, for the counted joints in units of the radius."""
        z = (self.postures / self.radius)[:, self.counted]
        starts, steps = (z[:-1], np.diff(z, axis=0)) if len(z) > 1 else (z, np.zeros_like(z))
        squares = np.maximum((steps**2).sum(axis=1), 1e-24)
        return starts, steps / np.sqrt(squares)[:, None], squares


def read_postures(path: Path, robot: Robot) -> Array:
    """Read postures (N, n) from a CSV file: a header with the joint names in any order, then one posture per line.

    Other columns, such as time and velocities, are ignored.

    Raises:
        PathFileError: names the file, the line and the error.
    """
    return read_table(
        path, "postures file", "postures", _MOST_IN_FILE, lambda names: find_columns(names, robot.joint_names), least=1
    )
