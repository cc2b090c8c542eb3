"""Domains: the regions of joint space on which charts are fitted and evaluated."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeAlias, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import DomainError, InvalidValueError, ShapeError, degrees_hint
from orthocas.robots.robot import Robot
from orthocas.robots.tree import PRISMATIC_ROOM, REVOLUTE_ROOM
from orthocas.tools import json
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_point_set,
    freeze_array,
    require_count,
    require_kind,
    require_known,
    require_memory,
)

if TYPE_CHECKING:
    from orthocas.tasks.clear_box import ClearBox
    from orthocas.tasks.corridor import Corridor
    from orthocas.tasks.task import Task


@dataclass(frozen=True, slots=True)
class SamplingRules:
    """Numbers of the sampling of domains."""

    most: int = 10**12  #: largest number of samples of one call
    least_fraction: float = 1e-3  #: smallest fraction of the box that the domain may fill
    tried: int = 10_000  #: points to draw before this fraction is checked
    block: int = 1000  #: smallest number of points drawn at once after the first draw


SAMPLING = SamplingRules()
_MOST_JOINTS = 1000
NARROWEST = 1e-9  #: [rad] or [m]; narrower boxes are within rounding errors
WIDEST = 1e6  #: [rad] or [m]; wider boxes are mistakes and overflow later


class StopKind(Enum):
    """Why a motion ends."""

    JOINT = "joint"  #: a joint is at the boundary of the domain, or at its limit
    NEAR_SINGULAR = "near singular"  #: the relative singular value of the task is at the bound of a `ClearBox`
    FOLD = "fold"  #: the coordinate reverses: J = dphi/dq is singular, or at the bound of a `RegularPart`
    CONTACT = "contact"  #: two links touch, or a link and an object of the scene
    CONDITION = "condition"  #: another condition of the domain ends here, such as the distance to a path
    SINGULAR = "singular"  #: the task is singular there, or grown coordinates end, so the motion cannot continue
    ENDLESS = "endless"  #: no end: the motion returns to its start, up to full turns of unbounded joints


@dataclass(frozen=True, eq=False)
class Wall:
    """A curved boundary of a domain, for a condition in addition to the box."""

    kind: StopKind
    room: Callable[[Array], float]  #: q (n,) -> a number that is positive inside and 0 at the boundary
    #: q (n,) -> the bounded quantity, for messages; None: no such quantity
    value: Callable[[Array], float] | None = None
    heading: str = ""  #: the condition in one line


class Domain(ABC):
    """A region of joint space inside a box.

    A domain of your own derives from this class, sets `name`, `centre` and `half_width`, and defines `contains`. That
    is enough for fit, evaluation and inverse. To be saved, it also defines `to_data` and `from_data`, and is registered
    with `orthocas.register_domain`. Laws and trackers need a `condition`; proofs and C need a `singular_bound` or a
    `path_bound`.
    """

    name: str  #: name of the kind, used in files and messages
    centre: Array  #: centre of the box around it, (n,)
    half_width: Array  #: half of the edge lengths of that box, (n,), > 0
    unbounded: tuple[int, ...] = ()  #: joints without bounds: all their positions are inside
    full_turns: bool = False  #: whether all joints turn endlessly and positions repeat after a turn
    is_box: bool = False  #: whether the domain is the whole box
    #: whether `draw` draws points in the domain directly, because it is a small part of its box
    draws_itself: bool = False

    @abstractmethod
    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie in the domain: a bool, or (N,)."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest joint positions, (n,) each. They are infinite for unbounded joints, and for a torus."""
        half_width = self.half_width.copy()
        half_width[slice(None) if self.full_turns else list(self.unbounded)] = np.inf
        return self.centre - half_width, self.centre + half_width

    @property
    def home(self) -> Array:
        """A position inside (n,) where motions and references start: the centre, unless it lies outside."""
        return self.centre

    @property
    def slack(self) -> Array:
        """Tolerance for rounding at the boundaries, (n,)."""
        return np.asarray(1e-12 * self.half_width + 4 * np.finfo(float).eps * np.abs(self.centre))

    @cached_property
    def reach(self) -> Array:
        """Largest distance from the centre that counts as inside, (n,), with tolerance for rounding at boundaries."""
        lower, upper = self.bounds
        return np.asarray((upper - lower) / 2 + self.slack)

    @property
    def condition(self) -> Condition | None:
        """The condition inside the box, as an expression; None if the domain is the whole box.

        Raises:
            DomainError: if the domain has a condition without an expression.
        """
        if self.is_box:
            return None
        raise DomainError(
            f"a domain of kind '{self.name}' has no CasADi expression of its condition, which this operation needs"
        )

    @property
    def known_condition(self) -> Condition | None:
        """The `condition`; also None if there is no expression of it, and only `contains` checks it."""
        try:
            return self.condition
        except DomainError:
            return None

    @property
    def singular_bound(self) -> SingularBound | None:
        """The condition if it bounds the singular values of a task; otherwise None."""
        return None

    @property
    def path_bound(self) -> PathBound | None:
        """The condition if it bounds the distance to a path; otherwise None."""
        return None

    @property
    def room_to_fold(self) -> ca.Function | None:
        """q (n, 1) -> a number (1, 1), positive inside and 0 where a chart's coordinates fold; None if there is none.

        Some domains have this in addition to a bound on singular values. It is the last of the pivots of `condition`.
        """
        return None

    @property
    def fold_bound(self) -> FoldBound | None:
        """The parts of `room_to_fold`, for exports that evaluate it with other libraries."""
        return None

    @property
    def walls(self) -> tuple[Wall, ...]:
        """The conditions that end a motion inside the box, each as a function that is 0 at the boundary.

        Ranges, self-motions, paths and messages use only these functions. For a condition without an expression, the
        function uses `contains`.
        """
        if self.is_box:
            return ()
        if (condition := self.known_condition) is None:
            return (Wall(StopKind.CONDITION, lambda q: 1.0 if self.contains(q) else -1.0, heading=f"the {self.name}"),)
        pivots = condition.pivots
        return (Wall(StopKind.CONDITION, lambda q: float(pivots(q).full().min()), heading=condition.heading),)

    def require_bounds(self, what: str) -> None:
        """Raise DomainError unless proofs and C support this kind of domain."""
        if not (self.is_box or self.singular_bound or self.path_bound):
            raise DomainError(
                f"a domain of kind '{self.name}' has no {what}, which exists for boxes, tori, and domains with a bound "
                "on singular values or on the distance to a path"
            )

    def sample(self, count: int, seed: int | tuple[int, ...] = 0) -> Array:
        """Random positions of the domain, uniform, (count, n) [rad] or [m].

        Raises:
            DomainError: if almost no point of the box lies in the domain.
        """
        rng = make_generator(self, count, seed)
        return keep_inside(self, count, lambda size: self.draw(rng, size, 1.0))

    def draw(self, rng: np.random.Generator, count: int, power: float) -> Array:
        """Draw at most `count` points (M, n) at |u|^power half-widths from the centre; some may lie outside the domain.

        They are uniform for power 1, and nearer to the boundaries for smaller powers.
        """
        u = rng.uniform(-1.0, 1.0, (count, len(self.centre)))
        points: Array = self.centre + self.half_width * (u if power == 1 else np.sign(u) * np.abs(u) ** power)
        return points

    def apply_to(self, box: Box) -> Domain:
        """The same condition on another box."""
        raise DomainError(f"a domain of kind '{self.name}' cannot be resized, expected a box")

    def explain(self, q: Array) -> str:
        """Say why a position (n,) of the box lies outside the domain."""
        return f"the position {np.round(q, 4).tolist()} lies outside the {self.name}"

    def describe_condition(self) -> dict[str, str]:
        """The condition in one line, with its name as key."""
        return {}

    def report_condition(self) -> dict[str, Any]:
        """The fields of the condition in `orthocas info --json`."""
        return {}

    def to_data(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """Plain data and arrays for files, in addition to name, centre and half-width."""
        raise DomainError(
            f"a domain of kind '{self.name}' cannot be saved, expected `to_data`, `from_data` and a registered kind"
        )

    @classmethod
    def from_data(cls, task: Task, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Domain:
        """Rebuild the domain from `to_data`; `arrays` also has centre and half_width. The data may be damaged."""
        raise NotImplementedError


def make_generator(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> np.random.Generator:
    """Check the arguments of a sampler, and return its random generator."""
    require_count("samples", samples, most=SAMPLING.most)
    for part in seed if isinstance(seed, tuple) else (seed,):
        require_count("seed", part, least=0)
    require_memory(f"{samples} samples", 32.0 * samples * len(domain.centre))
    return np.random.default_rng(seed)


def keep_inside(domain: Domain, samples: int, draw: Callable[[int], Array]) -> Array:
    """The first points of a sequence that lie in the domain, (samples, n); `draw(k)` returns the next k points.

    Raises:
        DomainError: if almost none of them does.
    """
    kept = [np.empty((0, len(domain.centre)))]
    drawn, count, size = 0, 0, samples
    while count < samples:
        if drawn >= SAMPLING.tried and count < SAMPLING.least_fraction * drawn:
            raise DomainError(
                f"{count} of {drawn} points of its box lie in the domain, expected at least "
                f"{SAMPLING.least_fraction:.1%}: lower least_singular_value, or raise the radius of the corridor"
            )
        points = draw(size)
        kept.append(points[domain.contains(points)])
        drawn, count = drawn + size, count + len(kept[-1])
        size = max(samples - count, SAMPLING.block)
    return np.concatenate(kept)[:samples]


class Condition(Protocol):
    """A condition that holds in a part of a box."""

    @property
    def heading(self) -> str:
        """The condition in one line."""
        ...

    @property
    def pivots(self) -> ca.Function:
        """q (n, 1) -> numbers that are all positive exactly where the condition holds in the box."""
        ...


SingularBound: TypeAlias = "ClearBox"  #: a condition s(q) > bound on the relative singular value of a task
PathBound: TypeAlias = "Corridor"  #: a condition on the distance to a path of postures, in radii


class FoldBound(Protocol):
    """A condition orientation * v(q) > least_volume on the volume of coordinates, as `orthocas.fit_wide` builds it."""

    @property
    def gradients(self) -> ca.Function:
        """q (n, 1) -> J_xi (r, n); its rows may have any length."""
        ...

    @property
    def least_volume(self) -> float:
        """The bound, > 0."""
        ...

    @property
    def orientation(self) -> float:
        """The sign of the volume at the centre."""
        ...


Kind = TypeVar("Kind", bound=Domain)
_KINDS: dict[str, type[Domain]] = {}


def register_domain(kind: type[Kind]) -> type[Kind]:
    """Register a kind of domain so that files can hold it; also a decorator. Its `name` stands in files.

    Raises:
        InvalidValueError: if it is not a subclass of Domain, or its name is taken.
    """
    if not (isinstance(kind, type) and issubclass(kind, Domain)):
        raise InvalidValueError("kind", repr(kind)[:80], "a class derived from orthocas.tasks.domains.Domain")
    name = getattr(kind, "name", "")
    if not isinstance(name, str) or not name or _KINDS.get(name, kind) is not kind:
        raise InvalidValueError("name of the kind", repr(name)[:80], f"a name other than {', '.join(_KINDS)}")
    _KINDS[name] = kind
    return kind


def domain_from_data(name: str, task: Task, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Domain:
    """Rebuild a domain from the data of a file.

    Raises:
        UnknownNameError: if no registered kind has that name.
        OrthocasError, and errors of Python and NumPy: if the data are damaged.
    """
    require_known("domain", name, _KINDS)
    return _KINDS[name].from_data(task, data, arrays)


@register_domain
@dataclass(frozen=True, eq=False)
class Box(Domain):
    """All q with |q_i - centre_i| <= half_width_i.

    Args:
        centre: (n,) [rad] or [m].
        half_width: (n,) or one number for all joints, > 1e-9 [rad] or [m].
        unbounded: indices of joints without bounds, such as joints that turn endlessly. Samples still stay within their
            half-width.

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
    is_box = True

    def __init__(self, centre: ArrayLike, half_width: ArrayLike, unbounded: Sequence[int] = ()) -> None:
        middle = freeze_array("centre", centre, (None,))
        widths = as_float_array("half_width", half_width)
        # Check both; one half-width applies to all joints.
        if widths.ndim > 0 and widths.shape != middle.shape:
            raise ShapeError("half_width", widths.shape, middle.shape)
        widths = freeze_array("half_width", np.broadcast_to(widths, middle.shape), middle.shape)
        if widths.size == 0:
            raise InvalidValueError("centre", "empty", "at least one joint")
        if widths.min() <= NARROWEST or widths.max() > WIDEST:
            bad = widths.min() if widths.min() <= NARROWEST else widths.max()
            raise InvalidValueError("half_width", f"{bad:g}", f"numbers above {NARROWEST:g}, up to {WIDEST:g}")
        object.__setattr__(self, "centre", middle)
        object.__setattr__(self, "half_width", widths)
        if not isinstance(unbounded, list | tuple | range):
            raise InvalidValueError("unbounded", repr(unbounded)[:80], "a list of joint indices")
        joints = {require_count("entry of unbounded", k, least=0, most=len(middle) - 1) for k in unbounded}
        object.__setattr__(self, "unbounded", tuple(sorted(joints)))

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
        low = freeze_array("lower", lower, (None,))
        high = freeze_array("upper", upper, low.shape)
        wrong = np.flatnonzero(low >= high)
        if wrong.size:
            i = int(wrong[0])
            raise InvalidValueError(f"lower[{i}]", low[i], f"a number below upper[{i}] = {high[i]:g}")
        return cls((low + high) / 2, (high - low) / 2)

    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie in the box: a bool, or (N,)."""
        return _between_boundaries(self, q)

    def apply_to(self, box: Box) -> Box:
        """The other box."""
        return box

    def to_data(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """The unbounded joints."""
        return {"unbounded": list(self.unbounded)}, {}

    @classmethod
    def from_data(cls, task: Task, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Domain:
        """Rebuild the box from a file."""
        # Older files do not store unbounded joints.
        unbounded = json.get_part(data, "unbounded", list) if "unbounded" in data else ()
        centre, half_width = (json.get_part(arrays, name, np.ndarray) for name in ("centre", "half_width"))
        return Box(centre, half_width, unbounded)


@register_domain
@dataclass(frozen=True, eq=False)
class Torus(Domain):
    """Full turns of n revolute joints, sampled on (-pi, pi].

    Example:
        >>> import orthocas as oc
        >>> oc.Torus(2).half_width.round(3).tolist()
        [3.142, 3.142]
    """

    n: int
    centre: Array = field(repr=False)  #: the zero posture, (n,)
    half_width: Array = field(repr=False)  #: pi for every joint, (n,)
    name: str = "torus"
    is_box = True
    full_turns = True

    def __init__(self, n: int) -> None:
        require_count("n", n, most=_MOST_JOINTS)
        object.__setattr__(self, "n", n)
        object.__setattr__(self, "centre", freeze_array("centre", np.zeros(n), (n,)))
        object.__setattr__(self, "half_width", freeze_array("half_width", np.full(n, np.pi), (n,)))

    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie on the torus: a bool, or (N,). All finite angles do."""
        return _between_boundaries(self, q)

    def to_data(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """No data: the number of joints defines a torus."""
        return {}, {}

    @classmethod
    def from_data(cls, task: Task, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Domain:
        """The torus of the robot's joints."""
        return cls(task.robot.n)


def default_box(robot: Robot, centre: ArrayLike | None = None, half_width: ArrayLike | None = None) -> Box:
    """A box inside the joint limits.

    The centre is that of the limits, and for a joint without both limits the allowed value nearest to 0. Half-widths
    are pi/4 for revolute and 0.25 m for prismatic joints, or less where the limits are closer.

    Args:
        robot: the robot.
        centre: another centre (n,).
        half_width: another half-width (n,), or one for all joints. It is not clipped to the joint limits; a `Problem`
            rejects a box that exceeds them.
    """
    require_kind("robot", robot, Robot)
    middle = robot.tree.centre_posture if centre is None else freeze_array("centre", centre, (robot.n,))
    if half_width is not None:
        return Box(middle, half_width)
    widths = default_half_width(robot, middle)
    if widths.min() <= 0:
        _raise_outside(robot, int(np.argmin(widths)), middle, middle)
    return Box(middle, widths)


def default_half_width(robot: Robot, centre: Array) -> Array:
    """Half-widths of default boxes around centres (n,) or (N, n), same shape; <= 0 at or beyond a joint limit."""
    room = np.minimum(centre - robot.lower, robot.upper - centre)
    largest = np.where(robot.tree.prismatic, PRISMATIC_ROOM, REVOLUTE_ROOM)
    widths: Array = np.minimum(largest, room)
    return widths


def require_within_limits(robot: Robot, domain: Domain) -> None:
    """Check a domain against a robot.

    Raises:
        ShapeError: if the domain has another number of joints.
        DomainError: if the domain leaves the joint limits, or is a torus and a joint is prismatic. The message names
            the joint.
        RobotError: if the domain is a torus and a joint mimics another one, since the mimic joint may not return after
            a turn.
    """
    if len(domain.centre) != robot.n:
        raise ShapeError("domain", (len(domain.centre),), (robot.n,))
    if domain.full_turns and any(robot.tree.prismatic):
        name = robot.joint_names[robot.tree.prismatic.index(True)]
        raise DomainError(f"joint '{name}' is prismatic, expected a Box domain instead of a Torus")
    if domain.full_turns:
        robot.tree.require_no_mimics("a Torus domain")
    low, high = domain.centre - domain.half_width, domain.centre + domain.half_width
    if not domain.full_turns:
        low, high = domain.bounds
    # URDF files hold rounded decimals, so allow rounding errors.
    slack = 1e-9 * domain.half_width
    outside = np.flatnonzero((low < robot.lower - slack) | (high > robot.upper + slack))
    if outside.size:
        _raise_outside(robot, int(outside[0]), low, high)


def _between_boundaries(domain: Domain, q: ArrayLike) -> Any:
    """Whether points (n,) or (N, n) lie between the boundaries of a domain: a bool, or (N,)."""
    points, single = as_point_set("q", q, len(domain.centre))
    inside = np.all(np.abs(points - domain.centre) <= domain.reach, axis=1)
    return inside[0] if single else inside


def _raise_outside(robot: Robot, i: int, low: Array, high: Array) -> None:
    raise DomainError(
        f"domain of joint '{robot.joint_names[i]}' is [{low[i]:.4g}, {high[i]:.4g}], "
        f"expected an interval inside its limits [{robot.lower[i]:.4g}, {robot.upper[i]:.4g}]"
        + ("" if robot.tree.prismatic[i] else degrees_hint(low[i], high[i]))
    )
