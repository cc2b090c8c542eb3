"""Domains: the regions of joint space on which charts are fitted and evaluated, with seeded sampling."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, Self, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import DomainError, InvalidValueError, ShapeError
from orthocas.robots.robot import Robot
from orthocas.robots.tree import PRISMATIC_ROOM, REVOLUTE_ROOM
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_point_set,
    frozen_array,
    require_count,
    require_kind,
    require_memory,
)

_MOST_JOINTS = 1000
_MOST_SAMPLES = 10**12
_POWERS = (1.0, 0.5, 0.25)  # of the distance from the middle: uniform, near faces, near corners
_LEAST_SHARE, _TRIED = 1e-3, 10_000  # of the points of a box, at least so many, that have to lie in the domain
_BLOCK = 1000  # fewest points to draw at once, after the first ones
_WIDEST = 1e6  # [rad] or [m]; wider boxes are mistakes, and overflow later


@runtime_checkable
class Domain(Protocol):
    """A box in joint space. A torus is the box of full turns."""

    @property
    def name(self) -> str:
        """Kind of the domain: 'box' or 'torus'."""
        ...

    @property
    def centre(self) -> Array:
        """Middle of the domain, (n,)."""
        ...

    @property
    def half_width(self) -> Array:
        """Half of the edge lengths, (n,), > 0."""
        ...

    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie in the domain: a bool, or (N,)."""
        ...


@runtime_checkable
class SelfDrawing(Protocol):
    """A domain that is a small part of its box, and draws points itself."""

    def draw(self, rng: np.random.Generator, count: int, power: float) -> Array:
        """At most `count` points (M, n): uniform for power 1, nearer to the border for smaller powers."""
        ...


@runtime_checkable
class Conditioned(Protocol):
    """A part of a box with a condition: `ClearBox` and `Corridor`."""

    @property
    def heading(self) -> str:
        """The condition in one line."""
        ...

    @property
    def pivots(self) -> ca.Function:
        """q (n, 1) -> numbers that are all positive just at those points of the box where the condition holds."""
        ...

    def within(self, box: "Box") -> "Box":
        """The same condition on another box."""
        ...

    def told(self, q: Array) -> str:
        """What is wrong with a position (n,) of the box where the condition does not hold."""
        ...


@dataclass(frozen=True, eq=False)
class Box:
    """All q with |q_i - centre_i| <= half_width_i.

    Args:
        centre: (n,) [rad] or [m].
        half_width: (n,) or one number for all joints, > 0 [rad] or [m].
        unbounded: indices of joints whose every position lies inside, such as a joint that turns without end. Samples
            still keep within their half-width.

    Example:
        >>> import orthocas as oc
        >>> box = oc.Box([0.0, 1.0], 0.5)
        >>> box.half_width.tolist()
        [0.5, 0.5]
        >>> box.contains([[0.2, 1.4], [1.0, 1.0]]).tolist()
        [True, False]
    """

    centre: Array
    half_width: Array
    unbounded: tuple[int, ...] = ()
    name: str = "box"

    def __init__(self, centre: ArrayLike, half_width: ArrayLike, unbounded: Sequence[int] = ()) -> None:
        middle = frozen_array("centre", centre, (None,))
        widths = as_float_array("half_width", half_width)
        if widths.ndim > 0 and widths.shape != middle.shape:
            raise ShapeError("half_width", widths.shape, middle.shape)
        widths = frozen_array("half_width", np.broadcast_to(widths, middle.shape), middle.shape)
        if widths.size == 0:
            raise InvalidValueError("centre", "empty", "at least one joint")
        if widths.min() <= 0 or widths.max() > _WIDEST:
            bad = widths.min() if widths.min() <= 0 else widths.max()
            raise InvalidValueError("half_width", bad, f"positive numbers up to {_WIDEST:g}")
        object.__setattr__(self, "centre", middle)
        object.__setattr__(self, "half_width", widths)
        object.__setattr__(self, "unbounded", _joint_indices("unbounded", unbounded, len(middle)))

    @classmethod
    def from_limits(cls, lower: ArrayLike, upper: ArrayLike) -> Self:
        """All q with lower_i <= q_i <= upper_i.

        Args:
            lower: (n,) [rad] or [m].
            upper: (n,), above lower everywhere.

        Raises:
            ShapeError: if the two differ in length.
            InvalidValueError: if a number is not finite, or lower_i >= upper_i.
        """
        low = frozen_array("lower", lower, (None,))
        high = frozen_array("upper", upper, low.shape)
        wrong = np.flatnonzero(low >= high)
        if wrong.size:
            i = int(wrong[0])
            raise InvalidValueError(f"lower[{i}]", low[i], f"a number below upper[{i}] = {high[i]:g}")
        return cls((low + high) / 2, (high - low) / 2)

    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie in the box: a bool, or (N,)."""
        return _between_borders(self, q)


@dataclass(frozen=True, eq=False)
class Torus:
    """Full turns of n revolute joints, sampled on (-pi, pi].

    Example:
        >>> import orthocas as oc
        >>> oc.Torus(2).half_width.round(3).tolist()
        [3.142, 3.142]
    """

    n: int
    name: str = "torus"

    def __init__(self, n: int) -> None:
        require_count("n", n, most=_MOST_JOINTS)
        object.__setattr__(self, "n", n)

    @property
    def centre(self) -> Array:
        """The zero posture, (n,)."""
        return np.zeros(self.n)

    @property
    def half_width(self) -> Array:
        """pi for every joint, (n,)."""
        return np.full(self.n, np.pi)

    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie on the torus: a bool, or (N,). All finite angles do."""
        return _between_borders(self, q)


def sample_uniform(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points uniformly from the domain, (samples, n)."""
    rng = _generator(domain, samples, seed)
    return _inside(domain, samples, lambda count: _drawn(domain, rng, count, 1.0))


def sample_heavily(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points of which a third is uniform, a third near faces and a third near corners, (samples, n).

    Charts fail there first. The distances from the centre are |u|^p half-widths, with uniform u and p = 1, 1/2 and 1/4.

    Source:
        ours.
    """
    rng, third = _generator(domain, samples, seed), samples // 3

    sizes = (samples - 2 * third, third, third)
    parts = [
        _inside(domain, size, partial(_drawn, domain, rng, power=power))
        for size, power in zip(sizes, _POWERS, strict=True)
    ]
    return np.vstack(parts)


def sample_evenly(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points that fill the domain more evenly than random points, (samples, n).

    They follow the additive recurrence frac(shift + k alpha), alpha_j = g^-j, with g the root of g^(n+1) = g + 1 and a
    random shift. Each point is uniformly distributed, and every part of the sequence is even. Means over the domain
    converge faster than with independent points. Domains that draw points themselves get independent ones.

    Source:
        M. Roberts, docs/references.md [R2018]. The use for training is ours.
    """
    if isinstance(domain, SelfDrawing):
        return sample_uniform(domain, samples, seed)
    rng, n = _generator(domain, samples, seed), len(domain.centre)
    g = 1.5
    for _ in range(64):
        g = (1 + g) ** (1 / (n + 1))
    shift, done = rng.uniform(size=n), 0

    def draw(count: int) -> Array:
        nonlocal done
        k = np.arange(done + 1, done + count + 1)[:, None]
        done += count
        return _scaled(domain, 2 * ((shift + k * g ** -np.arange(1.0, n + 1)) % 1.0) - 1)

    return _inside(domain, samples, draw)


def contains(domain: Domain, q: ArrayLike) -> Any:
    """Whether points (n,) or (N, n) lie in the domain: a bool, or (N,). Finite angles always lie on a torus."""
    require_domain(domain)
    return domain.contains(q)


def require_domain(domain: Domain) -> None:
    """Raise InvalidValueError unless the object is a domain."""
    if isinstance(domain, type) or not isinstance(domain, Domain):
        raise InvalidValueError("domain", f"a {type(domain).__name__}", "a Box or a Torus")


def borders(domain: Domain) -> tuple[Array, Array]:
    """Lowest and highest joint positions, (n,) each. They are infinite for unbounded joints, and for a torus."""
    half_width = domain.half_width.copy()
    half_width[list(domain.unbounded) if isinstance(domain, Box) else slice(None)] = np.inf
    return domain.centre - half_width, domain.centre + half_width


def reach(domain: Domain) -> Array:
    """Largest distance from the centre that counts as inside, (n,), with slack for rounding at the borders."""
    lower, upper = borders(domain)
    values: Array = (upper - lower) / 2 + slack(domain)
    return values


def slack(domain: Domain) -> Array:
    """What the borders of a domain give for rounding, (n,)."""
    values: Array = 1e-12 * domain.half_width + 4 * np.finfo(float).eps * np.abs(domain.centre)
    return values


def default_box(robot: Robot, centre: ArrayLike | None = None, half_width: ArrayLike | None = None) -> Box:
    """A box inside the joint limits.

    The centre is the middle of the limits. For a joint without both limits it is 0, or the allowed value nearest to 0.
    Half-widths are pi/4 for revolute and 0.25 m for prismatic joints, or less where the limits are closer.

    Args:
        robot: the robot.
        centre: another centre (n,).
        half_width: another half-width (n,), or one for all joints. It is not clipped, so a `Problem` rejects a box that
            leaves the limits.
    """
    require_kind("robot", robot, Robot)
    middle = robot.tree.middle if centre is None else frozen_array("centre", centre, (robot.n,))
    if half_width is not None:
        return Box(middle, half_width)
    widths = default_half_width(robot, middle)
    if widths.min() <= 0:
        _raise_outside(robot, int(np.argmin(widths)), middle, middle)
    return Box(middle, widths)


def default_half_width(robot: Robot, centre: Array) -> Array:
    """Half-widths of default boxes around centres (n,) or (N, n), same shape; <= 0 at or beyond a joint limit."""
    room = np.minimum(centre - robot.lower, robot.upper - centre)
    widths: Array = np.minimum(_wanted_half_width(robot), room)
    return widths


def require_within_limits(robot: Robot, domain: Domain) -> None:
    """Check a domain against a robot.

    Raises:
        ShapeError: if the domain has another number of joints.
        DomainError: if the domain leaves the joint limits, or is a torus and a joint is prismatic. The message names
            the joint.
    """
    if len(domain.centre) != robot.n:
        raise ShapeError("domain", (len(domain.centre),), (robot.n,))
    if isinstance(domain, Torus) and any(robot.tree.prismatic):
        name = robot.joint_names[robot.tree.prismatic.index(True)]
        raise DomainError(f"joint '{name}' is prismatic, expected a Box domain instead of a Torus")
    low, high = domain.centre - domain.half_width, domain.centre + domain.half_width
    if isinstance(domain, Box):
        low, high = borders(domain)
    slack = 1e-9 * domain.half_width  # limits in a URDF are decimal, so sums are not exact
    outside = np.flatnonzero((low < robot.lower - slack) | (high > robot.upper + slack))
    if outside.size:
        _raise_outside(robot, int(outside[0]), low, high)


def _between_borders(domain: Domain, q: ArrayLike) -> Any:
    """Whether points (n,) or (N, n) lie between the borders of a domain: a bool, or (N,)."""
    points, single = as_point_set("q", q, len(domain.centre))
    inside = np.all(np.abs(points - domain.centre) <= reach(domain), axis=1)
    return inside[0] if single else inside


def _generator(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> np.random.Generator:
    """The generator of a seed, after checks of what is asked for."""
    require_count("samples", samples, most=_MOST_SAMPLES)
    for part in seed if isinstance(seed, tuple) else (seed,):
        require_count("seed", part, least=0)
    require_memory(f"{samples} samples", 32.0 * samples * len(domain.centre))
    return np.random.default_rng(seed)


def _drawn(domain: Domain, rng: np.random.Generator, count: int, power: float) -> Array:
    """Points of the box around the domain with distances |u|^power half-widths from the centre; see `SelfDrawing`."""
    if isinstance(domain, SelfDrawing):
        return domain.draw(rng, count, power)
    u = rng.uniform(-1.0, 1.0, (count, len(domain.centre)))
    return _scaled(domain, u if power == 1 else np.sign(u) * np.abs(u) ** power)


def _scaled(domain: Domain, u: Array) -> Array:
    """Points of the cube [-1, 1]^n in the box around the domain."""
    points: Array = domain.centre + domain.half_width * u
    return points


def _inside(domain: Domain, samples: int, draw: Callable[[int], Array]) -> Array:
    """The first points of a sequence that lie in the domain, (samples, n); `draw` returns the next so many points.

    Raises:
        DomainError: if next to none of them does.
    """
    found = [np.empty((0, len(domain.centre)))]
    drawn = kept = 0
    size = samples
    while kept < samples:
        if drawn >= _TRIED and kept < _LEAST_SHARE * drawn:
            share = f"{kept} of {drawn} points of its box lie in the domain"
            raise DomainError(f"{share}, expected at least {_LEAST_SHARE:.1%}: lower least_singular_value")
        points = draw(size)
        found.append(points[domain.contains(points)])
        drawn, kept = drawn + size, kept + len(found[-1])
        size = max(samples - kept, _BLOCK)
    return np.concatenate(found)[:samples]


def _joint_indices(name: str, values: Any, n: int) -> tuple[int, ...]:
    """Different indices of joints, sorted."""
    if not isinstance(values, list | tuple | range):
        raise InvalidValueError(name, repr(values)[:80], "a list of joint indices")
    found = sorted({require_count(f"entry of {name}", value, least=0, most=n - 1) for value in values})
    return tuple(found)


def _wanted_half_width(robot: Robot) -> Array:
    return np.where(robot.tree.prismatic, PRISMATIC_ROOM, REVOLUTE_ROOM)


def _raise_outside(robot: Robot, i: int, low: Array, high: Array) -> None:
    raise DomainError(
        f"domain of joint '{robot.joint_names[i]}' is [{low[i]:.4g}, {high[i]:.4g}], "
        f"expected an interval inside its limits [{robot.lower[i]:.4g}, {robot.upper[i]:.4g}]"
    )
