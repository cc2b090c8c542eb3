"""The numbers of a kinematic tree: a robot of Pinocchio as plain data, which chart files store."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, RobotError
from orthocas.tools.checks import Array, as_float_array, freeze_array, require_known, require_shape, require_text
from orthocas.tools.display import listed


@dataclass(frozen=True, slots=True)
class TreeRules:
    """Bounds and tolerances of the numbers of a robot."""

    joints: int = 150  #: largest number of joints: the cost of a mass matrix grows with its square
    frames: int = 1000  #: largest number of frames, more than any robot has
    largest: float = 1e30  #: larger numbers overflow in products
    not_turned: float = 1e-6  #: largest entry of |R R^T - 1|, for rotations in single precision
    symmetric: float = 1e-6  #: allowed asymmetry of an inertia, relative to its largest entry
    #: allowed negative moment, relative to the largest entry: identified inertias in robot files have -0.07
    indefinite: float = 0.1
    no_inertia: float = 1e-9  #: [kg m^2], allowed negative moment of bodies without inertia


RULES = TreeRules()
_OF_JOINTS = ("rotations", "translations", "masses", "centres", "inertias", "armatures")
REVOLUTE_ROOM = np.pi / 4  #: [rad] on either side of a default posture, as the hypercube of [AS2023] Sec. 9
PRISMATIC_ROOM = 0.25  #: [m]


JointKind = Literal["revolute", "prismatic"]
JOINT_KINDS: tuple[JointKind, ...] = ("revolute", "prismatic")


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame that is fixed in a body."""

    name: str
    parent: int  #: body that carries it, -1 for the base
    rotation: Array  #: (3, 3) in that body's frame
    translation: Array  #: (3,) [m]


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """Joints, bodies, tip frames and further frames by name. Joint i of n moves body i.

    Body frames are rotated so that every joint axis is the body's z axis. Joint i places its body at
    `rotations[i] Rz(q_i), translations[i]` (revolute) or `rotations[i], translations[i] + q_i rotations[i] z`
    (prismatic) in the parent body's frame.

    Mimic joints come after the n joints and have no coordinate of their own. Joint n + j moves body n + j, at
    `mimic_factors[j] q_l + mimic_offsets[j]` with its leader l = `mimic_leaders[j]`, so the positions of all N joints
    are S q + s_0. Without mimic joints N = n, and parents come before children.

    Raises:
        ShapeError, InvalidValueError, UnknownNameError, RobotError: for numbers or names that no robot has.
    """

    joint_names: tuple[str, ...]
    joint_kinds: tuple[JointKind, ...]
    parents: tuple[int, ...]  #: (N,) index of the parent body, -1 for the base
    rotations: Array  #: (N, 3, 3) joint frames in the parent's frame
    translations: Array  #: (N, 3) [m]
    masses: Array  #: (N,) [kg]
    centres: Array  #: (N, 3) centre of mass in the body frame [m]
    inertias: Array  #: (N, 3, 3) about the centre of mass, in the body frame [kg m^2]
    armatures: Array  #: (N,) rotor inertia seen at the joint [kg m^2] or [kg]
    lower: Array  #: (n,) joint limits [rad] or [m], -inf where unlimited
    upper: Array  #: (n,)
    effort_limits: Array  #: (n,) largest torque [N m] or force [N], inf where unknown
    velocity_limits: Array  #: (n,) largest speed [rad/s] or [m/s], inf where unknown
    tip_name: str
    tip_parent: int  #: body that carries the tip, -1 for the base
    tip_rotation: Array  #: (3, 3) in that body's frame
    tip_translation: Array  #: (3,) [m]
    gravity: Array  #: (3,) gravity acceleration in the world [m/s^2]
    tips: tuple[str, ...] = ()  #: names of further tips among the frames
    frame_names: tuple[str, ...] = ()  #: of k further frames that tasks may use
    frame_parents: tuple[int, ...] = ()  #: bodies that carry them, -1 for the base
    frame_rotations: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))  #: (k, 3, 3) in the body's frame
    frame_translations: Array = field(default_factory=lambda: np.zeros((0, 3)))  #: (k, 3) [m]
    mimic_names: tuple[str, ...] = ()  #: names of the N - n joints that follow others
    mimic_kinds: tuple[JointKind, ...] = ()
    mimic_leaders: tuple[int, ...] = ()  #: indices of the joints that they follow, below n
    mimic_factors: Array = field(default_factory=lambda: np.zeros(0))  #: (N - n,)
    mimic_offsets: Array = field(default_factory=lambda: np.zeros(0))  #: (N - n,) [rad] or [m]

    def __post_init__(self) -> None:
        n, bodies = self.n, self.bodies
        if n == 0:
            raise RobotError("the robot has no movable joint, expected at least one")
        if n > RULES.joints:
            raise RobotError(f"the robot has {n} movable joints, expected at most {RULES.joints}")
        shapes: dict[str, tuple[int, ...]] = {
            "rotations": (bodies, 3, 3),
            "translations": (bodies, 3),
            "masses": (bodies,),
            "centres": (bodies, 3),
            "inertias": (bodies, 3, 3),
            "armatures": (bodies,),
            "mimic_factors": (bodies - n,),
            "mimic_offsets": (bodies - n,),
            "tip_rotation": (3, 3),
            "tip_translation": (3,),
            "gravity": (3,),
            "frame_rotations": (len(self.frame_names), 3, 3),
            "frame_translations": (len(self.frame_names), 3),
        }
        for name, shape in shapes.items():
            array = freeze_array(name, getattr(self, name), shape)
            object.__setattr__(self, name, array)
            # Products of larger numbers would overflow.
            if array.size and np.abs(array).max() > RULES.largest:
                row = int(np.unravel_index(np.abs(array).argmax(), array.shape)[0])
                place = f" at joint '{self.body_joints[row]}'" if name in _OF_JOINTS else ""
                largest = f"{float(np.abs(array).max()):g}"
                raise InvalidValueError(f"largest entry of {name}{place}", largest, f"at most {RULES.largest:g}")
        # Limits may be infinite.
        for name in ("lower", "upper", "effort_limits", "velocity_limits"):
            limits = as_float_array(name, getattr(self, name)).copy()
            require_shape(name, limits.shape, (n,))
            limits.setflags(write=False)
            object.__setattr__(self, name, limits)
        for name in ("mimic_kinds", "mimic_leaders"):
            require_shape(name, (len(getattr(self, name)),), (bodies - n,))
        for j, leader in enumerate(self.mimic_leaders):
            _require_index(f"mimic_leaders[{j}]", leader, n - 1, least=0)
            if self.mimic_factors[j] == 0:
                raise InvalidValueError(f"mimic_factors[{j}]", 0, "a factor other than 0")
        self._check_joints()
        self._check_frames()

    def _check_joints(self) -> None:
        """Check names, kinds, limits, the order of bodies and rotations."""
        names = self.body_joints
        require_shape("joint_kinds", (len(self.joint_kinds),), (self.n,))
        require_shape("parents", (len(self.parents),), (self.bodies,))
        for i, name in enumerate(names):
            require_text(f"joint_names[{i}]", name)
        if len(set(names)) < self.bodies:
            twice = next(name for i, name in enumerate(names) if name in names[:i])
            raise RobotError(f"two joints are called '{twice}', expected different names")
        require_text("tip_name", self.tip_name)
        for i, kind in enumerate(self.body_kinds):
            require_known("joint kind", kind, JOINT_KINDS)
            # A mimic joint may carry joints with smaller indices.
            _require_index(f"parents[{i}]", self.parents[i], self.bodies - 1 if self.mimic_names else i - 1)
            _require_rotation(f"rotations[{i}]", self.rotations[i])
        if len(self.order) < self.bodies:
            raise RobotError("the joints carry each other in a loop, expected a tree")
        for i, name in enumerate(self.joint_names):
            # The range of a joint must not be empty.
            lower, upper = self.lower[i], self.upper[i]
            if not lower <= upper or lower == np.inf or upper == -np.inf:
                raise RobotError(f"joint '{name}' has limits [{lower:g}, {upper:g}], expected lower <= upper")
            for what, limit in (("effort", self.effort_limits[i]), ("velocity", self.velocity_limits[i])):
                if not limit > 0:
                    raise RobotError(f"joint '{name}' has the {what} limit {limit:g}, expected a number > 0")

    def _check_frames(self) -> None:
        """Check the tip, further frames, and the bodies that carry them."""
        _require_index("tip_parent", self.tip_parent, self.bodies - 1)
        _require_rotation("tip_rotation", self.tip_rotation)
        require_shape("frame_parents", (len(self.frame_parents),), (len(self.frame_names),))
        if len(self.frame_names) > RULES.frames:
            raise RobotError(f"the robot has {len(self.frame_names)} frames, expected at most {RULES.frames}")
        for k, name in enumerate(self.frame_names):
            require_text(f"frame_names[{k}]", name)
            _require_index(f"frame_parents[{k}]", self.frame_parents[k], self.bodies - 1)
            _require_rotation(f"frame_rotations[{k}]", self.frame_rotations[k])
        for tip in self.tips:
            require_known("tip", tip, self.frame_names)
        # Error messages name a body by its links.
        frames = list(zip((self.tip_name, *self.frame_names), (self.tip_parent, *self.frame_parents), strict=True))
        for i, name in enumerate(self.body_joints):
            links = [frame for frame, parent in frames if parent == i]
            require_body(name, self.masses[i], self.inertias[i], self.armatures[i], links)

    def equals(self, other: "KinematicTree") -> bool:
        """Whether all names and numbers are equal, as for one file that was read twice."""
        return other is self or all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    @property
    def tip(self) -> Frame:
        """The first tip."""
        return Frame(self.tip_name, self.tip_parent, self.tip_rotation, self.tip_translation)

    def frame(self, name: str) -> Frame:
        """The tip or a further frame by its name.

        Raises:
            UnknownNameError: if there is no such frame.
        """
        require_known("frame", name, (self.tip_name, *self.frame_names))
        if name == self.tip_name:
            return self.tip
        k = self.frame_names.index(name)
        return Frame(name, self.frame_parents[k], self.frame_rotations[k], self.frame_translations[k])

    def carriers(self, body: int) -> list[int]:
        """The bodies from the base to a body, both included; none for -1. Bodies from n on belong to mimics."""
        chain = []
        while body >= 0:
            chain.append(body)
            body = self.parents[body]
        return chain[::-1]

    @property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.joint_names)

    @property
    def bodies(self) -> int:
        """Number N of joints including mimic joints, which is also the number of bodies."""
        return len(self.joint_names) + len(self.mimic_names)

    @property
    def body_joints(self) -> tuple[str, ...]:
        """Names of the joints that move the bodies, (N,)."""
        return (*self.joint_names, *self.mimic_names)

    @property
    def body_kinds(self) -> tuple[JointKind, ...]:
        """Kinds of the joints that move the bodies, (N,)."""
        return (*self.joint_kinds, *self.mimic_kinds)

    @property
    def leaders(self) -> tuple[int, ...]:
        """Index of the coordinate that moves each body, (N,)."""
        return (*range(self.n), *self.mimic_leaders)

    @property
    def coupling(self) -> Array:
        """S (N, n): the positions of all joints are S q + s_0, and their velocities S dq."""
        S = np.zeros((self.bodies, self.n))
        S[range(self.bodies), self.leaders] = (*np.ones(self.n), *self.mimic_factors)
        return S

    @property
    def order(self) -> tuple[int, ...]:
        """All bodies, parents before children."""
        if not self.mimic_names:
            return tuple(range(self.n))
        placed: list[int] = []
        waiting = list(range(self.bodies))
        while ready := [i for i in waiting if self.parents[i] < 0 or self.parents[i] in placed]:
            placed.append(ready[0])
            waiting.remove(ready[0])
        return tuple(placed)

    def expand(self, q: Any) -> Any:
        """S q + s_0, the positions of all joints; q is SX or MX (n, 1), or an array (n,) or (K, n)."""
        if not self.mimic_names:
            return q
        leaders, offsets = list(self.leaders), np.concatenate([np.zeros(self.n), self.mimic_offsets])
        factors = np.concatenate([np.ones(self.n), self.mimic_factors])
        if isinstance(q, ca.SX | ca.MX):
            return q[leaders, 0] * ca.DM(factors) + ca.DM(offsets)
        return q[..., leaders] * factors + offsets

    def require_no_mimics(self, what: str) -> None:
        """Raise RobotError if the robot has mimic joints, for an operation that does not support them."""
        if self.mimic_names:
            joint, leader = self.mimic_names[0], self.joint_names[self.mimic_leaders[0]]
            raise RobotError(f"{what}: not possible with mimic joints; here '{joint}' mimics '{leader}'")

    @property
    def centre_posture(self) -> Array:
        """A posture away from the joint limits, (n,) [rad] or [m].

        It is the centre of the limits. A joint without both limits has the value closest to 0 that is pi/4 rad (0.25 m)
        away from its limit.
        """
        room = np.where(self.prismatic, PRISMATIC_ROOM, REVOLUTE_ROOM)
        posture = np.clip(np.zeros(self.n), self.lower + room, self.upper - room)
        limited = np.isfinite(self.lower) & np.isfinite(self.upper)
        posture[limited] = (self.lower[limited] + self.upper[limited]) / 2
        return np.asarray(posture)

    def draw_postures(self, count: int, seed: int) -> Array:
        """Uniform postures between the limits, (count, n). Unlimited joints take a whole turn, or half a metre."""
        width = np.where(self.prismatic, 2 * PRISMATIC_ROOM, 2 * np.pi)
        upwards = np.where(np.isfinite(self.upper), self.upper - width, -width / 2)
        low = np.where(np.isfinite(self.lower), self.lower, upwards)
        high = np.where(np.isfinite(self.upper), self.upper, low + width)
        return np.random.default_rng(seed).uniform(low, np.maximum(low, high), (count, self.n))

    @property
    def prismatic(self) -> tuple[bool, ...]:
        """Whether each joint is prismatic."""
        return tuple(kind == "prismatic" for kind in self.joint_kinds)

    @property
    def floating(self) -> tuple[int, ...]:
        """The joints of a floating base, which no motor drives; none if the base is fixed or driven."""
        for names in (_FLOATING, _AFLOAT):
            if self.joint_names[: len(names)] == names:
                return tuple(range(len(names)))
        return ()


def _require_index(name: str, value: int, largest: int, least: int = -1) -> None:
    """Raise InvalidValueError unless the value is the index of a body, or -1 for the base."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not least <= value <= largest:
        raise InvalidValueError(name, repr(value)[:80], f"an index from {least} to {largest}")


def _require_rotation(name: str, matrix: Array) -> None:
    """Raise InvalidValueError unless the matrix (3, 3) is a rotation, to single precision."""
    bounded = np.abs(matrix).max() < 2
    if not bounded or np.abs(matrix @ matrix.T - np.eye(3)).max() > RULES.not_turned or np.linalg.det(matrix) < 0:
        raise InvalidValueError(name, matrix.round(6).tolist(), "a rotation matrix")


def require_body(joint: str, mass: float, inertia: Array, armature: float, links: Sequence[str] = ()) -> None:
    """Raise RobotError unless mass, armature and inertia (3, 3) about the centre of mass are not negative.

    Identified inertias in published robot files are often slightly indefinite and violate the triangle inequality.
    Whether the mass matrix is positive definite is for the metric to check.
    """
    size = float(np.abs(inertia).max())
    smallest = float(np.linalg.eigvalsh((inertia + inertia.T) / 2)[0])
    symmetric = np.abs(inertia - inertia.T).max() <= RULES.symmetric * size
    # Rounding in files may make a moment slightly negative.
    if mass >= 0 and armature >= 0 and symmetric and smallest >= -RULES.indefinite * size - RULES.no_inertia:
        return
    # Report what is wrong, and with which body.
    body = f"the body moved by joint '{joint}'{f' ({listed(links)})' if links else ''}"
    if mass < 0:
        raise RobotError(f"{body} has mass {mass:g} kg, expected >= 0")
    if armature < 0:
        raise RobotError(f"joint '{joint}' has armature {armature:g}, expected >= 0")
    if not symmetric:
        raise RobotError(f"{body} has an inertia matrix that is not symmetric")
    raise RobotError(f"{body} has the principal moment of inertia {smallest:.3g} kg m^2, expected >= 0")


def require_driven(what: str, tree: KinematicTree) -> None:
    """Raise RobotError for a robot with a floating base, whose first joints no motor drives."""
    if tree.floating:
        raise RobotError(
            f"{what} needs driven joints, but no motor drives a floating base. Charts of it support fit, "
            "evaluation and inverse; Robot.zero_momentum has what moves the base"
        )


def set_gravity(tree: KinematicTree, gravity: ArrayLike | None) -> KinematicTree:
    """The tree under another gravity acceleration in the axes of the base, (3,) [m/s^2]; None changes nothing.

    Raises:
        ShapeError, InvalidValueError: if it is not three finite numbers.
        RobotError: if the base floats, and gravity is not zero.
    """
    if gravity is None:
        return tree
    vector = freeze_array("gravity", gravity, (3,))
    if tree.floating and vector.any():
        raise RobotError(f"gravity is {vector.tolist()}, expected zeros: a floating base has no gravity")
    return replace(tree, gravity=vector)


_PLANAR = "planar"
_RAIL = "rail:"
_FLOATING = ("float_x", "float_y", "float_z", "float_yaw", "float_pitch", "float_roll")
_AFLOAT = ("float_x", "float_y", "float_heading")
_BASES: dict[str, tuple[str, ...]] = {
    _PLANAR: ("base_x", "base_y", "base_heading"),
    **{f"{_RAIL}{axis}": (f"base_{axis}",) for axis in "xyz"},
    "floating": _FLOATING,
    "floating:xy": _AFLOAT,
}
_AXES = {"heading": "z", "yaw": "z", "pitch": "y", "roll": "x"}  #: rotation axes of the base's turning joints
BASE_JOINTS = tuple({joint for joints in _BASES.values() for joint in joints})  #: all joint names of moving bases


def place_on_base(tree: KinematicTree, base: str, mass: float, centre: Array, inertia: Array) -> KinematicTree:
    """A tree whose base slides along the world's x and y and turns about z, slides along one axis, or floats.

    The joints of the base come first, without limits: base_x, base_y, base_heading; base_x, base_y or base_z; float_x,
    float_y, float_z, float_yaw, float_pitch, float_roll, where the last three turn about z, then y, then x; or float_x,
    float_y, float_heading. A floating base has no gravity.

    Args:
        tree: the robot on a fixed base.
        base: "planar", "rail:x", "rail:y", "rail:z", "floating", or "floating:xy".
        mass: mass of the base itself, that is of all links that no joint of the robot moves [kg].
        centre: centre of that mass, (3,) [m].
        inertia: about that centre, (3, 3) [kg m^2].

    Raises:
        InvalidValueError: for another kind of base.
        RobotError: if the robot has joints of these names.
    """
    if not isinstance(base, str) or base not in _BASES:
        kinds = f"one of {', '.join(_BASES)}. The place of wheels that cannot slide sideways is no function of joints: "
        raise InvalidValueError("base", repr(base)[:80], kinds + "use planar, and let the base follow the motion")
    names = _BASES[base]
    moves = [name.rpartition("_")[2] for name in names]
    joint_kinds: list[JointKind] = ["revolute" if move in _AXES else "prismatic" for move in moves]
    # Rotations that bring z onto the axis of each joint, and back from the world's axes to those of the last body.
    along = [np.roll(np.eye(3), 2 - "xyz".index(_AXES.get(move, move)), axis=1) for move in moves]
    k, back = len(names), along[-1].T
    free, first = np.full(k, np.inf), np.zeros((k, 3))

    def shift(body: int) -> int:
        return body + k

    def turn_base(rotations: Array, translations: Array, parents: tuple[int, ...]) -> tuple[Array, Array]:
        """Frames of the bodies on the base, in axes of the last body that moves the base."""
        on_base = np.array([parent < 0 for parent in parents], dtype=bool)
        turned = np.where(on_base[:, None, None], back @ rotations, rotations)
        return turned, np.where(on_base[:, None], translations @ back.T, translations)

    rotations, translations = turn_base(tree.rotations, tree.translations, tree.parents)
    frames, places = turn_base(tree.frame_rotations, tree.frame_translations, tree.frame_parents)
    (tip,), (place,) = turn_base(tree.tip_rotation[None], tree.tip_translation[None], (tree.tip_parent,))
    steps = [along[i - 1].T @ along[i] if i else along[i] for i in range(k)]
    bodies = np.zeros((k, 3, 3))
    bodies[-1] = back @ inertia @ back.T
    centres = first.copy()
    centres[-1] = back @ centre
    return replace(
        tree,
        joint_names=(*names, *tree.joint_names),
        joint_kinds=(*joint_kinds, *tree.joint_kinds),
        parents=(*range(-1, k - 1), *map(shift, tree.parents)),
        rotations=np.concatenate([steps, rotations]),
        translations=np.concatenate([first, translations]),
        masses=np.concatenate([np.zeros(k - 1), [mass], tree.masses]),
        centres=np.concatenate([centres, tree.centres]),
        inertias=np.concatenate([bodies, tree.inertias]),
        armatures=np.concatenate([np.zeros(k), tree.armatures]),
        lower=np.concatenate([-free, tree.lower]),
        upper=np.concatenate([free, tree.upper]),
        effort_limits=np.concatenate([free, tree.effort_limits]),
        velocity_limits=np.concatenate([free, tree.velocity_limits]),
        gravity=np.zeros(3) if names in (_FLOATING, _AFLOAT) else tree.gravity,
        tip_parent=shift(tree.tip_parent),
        tip_rotation=tip,
        tip_translation=place,
        frame_parents=tuple(map(shift, tree.frame_parents)),
        frame_rotations=frames,
        frame_translations=places,
        mimic_leaders=tuple(map(shift, tree.mimic_leaders)),
    )
