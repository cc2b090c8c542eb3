"""The robot: names, limits, kinematics and dynamics, for SX, MX and NumPy."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, Literal, Self

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, RobotError, ShapeError
from orthocas.robots import dynamics, kinematics
from orthocas.robots.capsules import build_rods
from orthocas.robots.collision_files import CollisionSource, KnownSolids
from orthocas.robots.collisions import Collisions
from orthocas.robots.dynamics import PAYLOAD, add_payload
from orthocas.robots.kinematics import add_tool
from orthocas.robots.mjcf import read_mjcf
from orthocas.robots.pinocchio_model import (
    TIP,
    Mimics,
    build_planar,
    build_tree,
    find_default_tip,
    find_floating_base,
    find_frame,
    lock_joints,
    lock_off_chain,
    read_model_postures,
)
from orthocas.robots.tree import KinematicTree, set_gravity
from orthocas.robots.urdf import find_robot_file, list_robot_files, read_srdf_postures, read_urdf
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import BuiltOnUse, cached_property
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_path,
    as_point_set,
    freeze_array,
    require_count,
    require_kind,
    require_known,
)
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import WRITTEN_OUT

_log = logging.getLogger(__name__)

Locked = Mapping[str, float] | None  #: joint -> position at which it is locked [rad] or [m]
Tool = ArrayLike | None
Gravity = ArrayLike | None
_Key = tuple[str | None, ...]  #: name of a function, then names of frames
FrameQuantity = Literal["position", "rotation", "jacobian"]


class Robot(Shown):
    """A robot with n revolute or prismatic joints, one or more tip frames, and further frames by name.

    Methods take CasADi columns (n, 1), SX or MX, and return the same kind. Or they take NumPy arrays, one state (n,) or
    a set (N, n), and return NumPy arrays. Positions are in rad or m, velocities in rad/s or m/s, forces in N m or N.

    Example:
        >>> import casadi as ca
        >>> import numpy as np
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
        >>> robot.tip_position([0.0, np.pi / 2])[:2].round(3).tolist()
        [1.0, 1.0]
        >>> robot.mass_matrix(np.zeros((5, 2))).shape  # a set of 5 joint positions
        (5, 2, 2)
        >>> robot.gravity(ca.SX.sym("q", 2)).shape  # an expression
        (2, 1)
    """

    def __init__(
        self,
        tree: KinematicTree,
        homes: Mapping[str, ArrayLike] | None = None,
        solids: CollisionSource | KnownSolids | None = None,
    ) -> None:
        require_kind("tree", tree, KinematicTree)
        homes = {} if homes is None else homes
        require_kind("homes", homes, Mapping)
        self.tree = tree
        #: named postures (n,) of the robot's files: SRDF group states, MJCF keyframes. Chart files do not store them.
        self.homes = {name: freeze_array(f"home '{name}'", q, (tree.n,)) for name, q in homes.items()}
        #: the files that `collisions` reads, or the solids of a chart file; None if there are none
        self.solids = solids

    @classmethod
    def from_file(
        cls,
        path: str | PathLike[str],
        tip: str | None = None,
        locked: Locked = None,
        tool: Tool = None,
        *,
        tips: Sequence[str] = (),
        base: str | None = None,
        gravity: Gravity = None,
    ) -> Self:
        """Build the joints that move the tips from a robot file: MJCF if its name ends in .xml, otherwise URDF.

        Every joint that moves no tip, of any type, is locked at zero, or at the limit closest to zero.

        Args:
            path: the file. A file whose name ends in .xacro is expanded first, which runs its expressions. Named
                postures (`homes`) come from an SRDF file with the same stem, beside it or in ../srdf, or from the
                keyframes of the MJCF file.
            tip: name of any frame. Default: the end of the longest chain; if there are several chains, a TipWarning
                names the others.
            locked: joints to lock, with their positions [rad] or [m]; also joints on the chain to a tip. Joints that
                mimic them follow. A floating, spherical or planar joint is locked at its neutral position, given as 0.
            tool: pose of the tip of a massless tool in the (first) tip frame; see `with_tool`.
            tips: names of several frames, such as two hands, in place of `tip`.
            base: "planar" for a base that slides along the world's x and y and turns about z, by the joints base_x,
                base_y, base_heading; "rail:x", "rail:y" or "rail:z" for a rail; "floating" for a free base without
                drives and without gravity, by the joints float_x, float_y, float_z, float_yaw, float_pitch, float_roll;
                "floating:xy" for a free base in the plane, by float_x, float_y, float_heading. See `zero_momentum` for
                free bases. These joints come first and have no limits. Default: a fixed base.
            gravity: gravity acceleration in the axes of the base, (3,) [m/s^2], such as (0, 0, 9.81) for an arm that
                hangs from a ceiling. Default: (0, 0, -9.81), or that of the MJCF file.

        Raises:
            RobotError: if the file cannot be read, or a joint on the chain to the tip is not revolute, continuous or
                prismatic. The message says which one to lock.
            UnknownNameError: if the frame or a locked joint does not exist.
        """
        build = cls.from_mjcf if as_path("path", path).suffix.lower() == ".xml" else cls.from_urdf
        return build(path, tip, locked, tool, tips=tips, base=base, gravity=gravity)

    @classmethod
    def from_name(
        cls,
        name: str,
        tip: str | None = None,
        locked: Locked = None,
        tool: Tool = None,
        *,
        tips: Sequence[str] = (),
        base: str | None = None,
        gravity: Gravity = None,
    ) -> Self:
        """Build a known robot, such as "panda", from a file of example-robot-data or of robot_descriptions.

        One of these packages must be installed. The other arguments are those of `from_file`.

        Raises:
            UnknownNameError: if no installed package knows the name. The message lists the known names.
        """
        return cls.from_urdf(find_robot_file(name), tip, locked, tool, tips=tips, base=base, gravity=gravity)

    @classmethod
    def from_urdf(
        cls,
        path: str | PathLike[str],
        tip: str | None = None,
        locked: Locked = None,
        tool: Tool = None,
        *,
        tips: Sequence[str] = (),
        base: str | None = None,
        gravity: Gravity = None,
    ) -> Self:
        """Build the joints that move the tips from a URDF file; see `from_file`."""
        file, names = as_path("path", path), _check_tips(tip, tips)
        # Someone who passes a bare name such as panda probably wants from_name.
        if not file.suffix and not file.exists() and file.name in list_robot_files():
            raise RobotError(f"cannot read URDF file {file}: no such file; Robot.from_name('{file}') knows this name")
        tree, _ = _build_chain(*read_urdf(file), names, locked, tool, base, gravity)
        # Read solids only on demand: meshes take longer than everything else.
        source = CollisionSource(file.absolute(), None, dict(locked or {}))
        return cls(tree, read_srdf_postures(file, tree.joint_names), source)

    @classmethod
    def from_mjcf(
        cls,
        path: Any,
        tip: str | None = None,
        locked: Locked = None,
        tool: Tool = None,
        *,
        tips: Sequence[str] = (),
        base: str | None = None,
        gravity: Gravity = None,
    ) -> Self:
        """Build the joints that move the tips from a MuJoCo MJCF file, or from a `mujoco.MjModel`; see `from_file`.

        Needs the extra `orthocas[mujoco]`, because MuJoCo's compiler reads the file.
        """
        tree, model = _build_chain(*read_mjcf(path, locked), _check_tips(tip, tips), locked, tool, base, gravity)
        homes = read_model_postures(model, tree.joint_names)
        # A compiled model has no file from which solids could be read later.
        if not isinstance(path, str | PathLike):
            return cls(tree, homes)
        return cls(tree, homes, CollisionSource(as_path("path", path).absolute(), None, dict(locked or {})))

    @classmethod
    def from_model(
        cls,
        model: pin.Model,
        tip: str | None = None,
        locked: Locked = None,
        *,
        tips: Sequence[str] = (),
        base: str | None = None,
        gravity: Gravity = None,
    ) -> Self:
        """Build from a Pinocchio model, with all its joints.

        Args:
            model: the model. Joints that are not locked must be revolute, continuous or prismatic.
            tip: name of any frame of the model. Default: as in `from_file`.
            tips: names of several frames, such as two hands, in place of `tip`.
            locked: joints to lock, with their positions [rad] or [m].
            base: as in `from_file`.
            gravity: as in `from_file`; default: that of the model.

        Raises:
            UnknownNameError: if the frame or a locked joint does not exist.
            RobotError: if a joint that is not locked is of another type (floating base, spherical, mimic, ...).
        """
        require_kind("model", model, pin.Model)
        names = _check_tips(tip, tips) or (find_default_tip(model),)
        for name in names:
            find_frame(model, name)
        tree = set_gravity(build_tree(lock_joints(model, locked or {}), *names, base=base), gravity)
        return cls(tree, read_model_postures(model, tree.joint_names))

    @classmethod
    def planar(cls, lengths: Sequence[float], masses: Sequence[float]) -> Self:
        """A planar arm with uniform links of given lengths [m] and masses [kg]. Gravity points along -y."""
        return cls(build_tree(build_planar(lengths, masses), TIP))

    def with_scaled_masses(self, factor: ArrayLike) -> Self:
        """The same robot with scaled masses: mass and inertia of each body times a factor, (n,) or one number > 0.

        The body of a mimic joint takes the factor of its leader.

        Raises:
            ShapeError, InvalidValueError: if the factors are invalid.
        """
        values = as_float_array("factor", factor)
        factors = freeze_array("factor", np.full(self.n, values) if values.ndim == 0 else values, (self.n,))
        if factors.min() <= 0:
            raise InvalidValueError("factor", factors.min(), "numbers > 0")
        factors = factors[list(self.tree.leaders)]
        masses, inertias = self.tree.masses * factors, self.tree.inertias * factors[:, None, None]
        return type(self)(replace(self.tree, masses=masses, inertias=inertias), self.homes, self.solids)

    def with_tool(self, tool: ArrayLike) -> Self:
        """The same robot with its tip at the end of a massless tool: tip pose = old tip pose times tool pose.

        Args:
            tool: (3,) position in the tip frame [m], (6,) position and roll, pitch, yaw [rad] as in URDF, or a
                homogeneous transform (4, 4).

        Raises:
            InvalidValueError: if the tool has another form.
        """
        return type(self)(add_tool(self.tree, tool), self.homes, self.solids)

    def with_payload(self, payload: ArrayLike) -> Self:
        """The same robot carrying a load that is fixed to the tip.

        Args:
            payload: mass [kg] of a point at the tip, (4,) with the centre of mass in the tip frame [m], or (10,) also
                with the inertia about that centre, in axes of the tip frame: Ixx, Ixy, Ixz, Iyy, Iyz, Izz [kg m^2].

        Raises:
            InvalidValueError: if the payload has another form, a negative mass, or an indefinite inertia.
        """
        return type(self)(add_payload(self.tree, payload), self.homes, self.solids)

    def with_gravity(self, gravity: ArrayLike) -> Self:
        """The same robot under another gravity, such as on a wall, a ceiling or the moon.

        Args:
            gravity: gravity acceleration in the axes of the base, (3,) [m/s^2].

        Raises:
            ShapeError, InvalidValueError: if it is not three finite numbers.
            RobotError: if the base floats, and gravity is not zero.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[2.0], masses=[3.0])
            >>> robot.with_gravity([0.0, -1.62, 0.0]).gravity([0.0]).round(9).tolist()
            [4.86]
        """
        return type(self)(set_gravity(self.tree, gravity), self.homes, self.solids)

    def with_solids(self, urdf: str | PathLike[str], srdf: str | PathLike[str] | None = None) -> Self:
        """The same robot with the solids of another file, such as a robot of a chart file, for `collisions`.

        Args:
            urdf: the robot's URDF file, or its MJCF file, whose name ends in .xml.
            srdf: an SRDF file, whose disabled pairs are not checked. Default: the one with the same stem, beside the
                URDF file or in ../srdf.
        """
        locked = {} if self.solids is None else self.solids.locked
        pairs = None if srdf is None else as_path("srdf", srdf)
        return type(self)(self.tree, self.homes, CollisionSource(as_path("urdf", urdf), pairs, locked))

    def with_rods(self, radius: ArrayLike) -> Self:
        """The same robot with rods as links, so that `collisions` works for robots whose files have no solids.

        Each moving link on the way to a tip becomes a capsule from the origin of its joint to that of the next joint,
        or to the tip. If the next joint slides, its rod begins where the slide has taken it. Rods are checked against
        objects, `collisions.with_scene(...)`, but not against each other.

        Args:
            radius: radius of all rods, or (n,) of each joint's rod, > 0 [m].

        Example:
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[1.0, 1.0]).with_rods(0.1)
            >>> ball = oc.obstacles.Sphere([0.5, 1.0, 0.0], 0.2)
            >>> near = robot.collisions.with_scene(oc.Scene({"ball": ball})).distance([0.0, 0.0])
            >>> near.pair, round(near.distance, 3)
            (('link of q1', 'ball'), 0.7)
        """
        return type(self)(self.tree, self.homes, KnownSolids(build_rods(self.tree, radius)))

    @cached_property
    def collisions(self) -> Collisions:
        """Distances between the links, from <collision> elements of a URDF file, MJCF geoms, or a chart file.

        Raises:
            RobotError: if the robot was not built from a file, or the file or all its solids are missing.
        """
        if self.solids is None:
            hint = "robot.with_solids(urdf) names its file, robot.with_rods(radius) takes rods for links"
            raise RobotError(f"the links have no solids, expected a robot from a URDF or MJCF file: {hint}")
        return self.solids.read(self.tree)

    def home(self, name: str) -> Array:
        """A named posture (n,) of the robot's files.

        Raises:
            UnknownNameError: if there is no such posture. The message lists the known ones.
        """
        require_known("home", name, self.homes or {"none, the robot's files name no posture": None})
        return self.homes[name]

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.tree.n

    @property
    def tips(self) -> tuple[str, ...]:
        """Names of the tip frames."""
        return (self.tree.tip_name, *self.tree.tips)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of all frames that the robot knows: tips and links."""
        return (self.tree.tip_name, *self.tree.frame_names)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of q."""
        return self.tree.joint_names

    @property
    def mimics(self) -> tuple[str, ...]:
        """Joints that follow others, as equations: "finger2 = -1 finger1 + 0.02". They have no part in q."""
        tree = self.tree
        leaders = (tree.joint_names[leader] for leader in tree.mimic_leaders)
        rows = zip(tree.mimic_names, leaders, tree.mimic_factors, tree.mimic_offsets, strict=True)
        return tuple(f"{name} = {a:g} {leader}{f' {b:+g}' if b else ''}" for name, leader, a, b in rows)

    @property
    def lower(self) -> Array:
        """Lower joint limits (n,) [rad] or [m], -inf where unlimited."""
        return self.tree.lower

    @property
    def upper(self) -> Array:
        """Upper joint limits (n,) [rad] or [m], inf where unlimited."""
        return self.tree.upper

    @property
    def effort_limits(self) -> Array:
        """Largest joint torques [N m] or forces [N], (n,); inf where the file has no limit or 0."""
        return self.tree.effort_limits

    @property
    def velocity_limits(self) -> Array:
        """Largest joint speeds [rad/s] or [m/s], (n,); inf where the file has no limit or 0."""
        return self.tree.velocity_limits

    def facts(self) -> dict[str, str]:
        """Joints, limits, tip and mass. Limits of effort and velocity are left out if the file has none."""
        tree = self.tree
        tips = f"tip {tree.tip_name}" if not tree.tips else f"tips {listed(self.tips)}"
        # Leave out lines without information.
        sliding = [name for name, slides in zip(tree.joint_names, tree.prismatic, strict=True) if slides]
        return {
            "robot": f"{self.n} joints, {tips}, {tree.masses.sum():.4g} kg",
            "joints": listed(tree.joint_names),
            **({"prismatic": listed(sliding)} if sliding else {}),
            **({"mimic": listed(self.mimics)} if tree.mimic_names else {}),
            "lower": number_list(self.lower),
            "upper": number_list(self.upper),
            **({"effort": number_list(self.effort_limits)} if np.isfinite(self.effort_limits).any() else {}),
            **({"velocity": number_list(self.velocity_limits)} if np.isfinite(self.velocity_limits).any() else {}),
        }

    def mass_matrix(self, q: Any) -> Any:
        """M(q), (n, n), symmetric positive definite."""
        return self._call("mass_matrix", q)

    def gravity(self, q: Any) -> Any:
        """g(q), (n,): the joint torques that hold the robot at rest."""
        return self._call("gravity", q)

    def bias(self, q: Any, dq: Any) -> Any:
        """C(q, dq) dq + g(q), (n,)."""
        return self._call("bias", q, dq)

    def inverse_dynamics(self, q: Any, dq: Any, ddq: Any) -> Any:
        """tau = M ddq + C dq + g, (n,)."""
        return self._call("inverse_dynamics", q, dq, ddq)

    def forward_dynamics(self, q: Any, dq: Any, tau: Any) -> Any:
        """ddq = M^-1 (tau - C dq - g), (n,)."""
        return self._call("forward_dynamics", q, dq, tau)

    def zero_momentum(self, q: Any) -> Any:
        """H(q), (n, a): velocities of all n joints of a robot with a floating base, per velocity of its a arm joints.

        The base moves such that the momentum stays zero: dq = H da with H = [-M_bb^-1 M_ba; I]. For a task with
        Jacobian J, J H is the generalised Jacobian, and H^T M H is the generalised inertia. H is not the Jacobian of a
        function, because the final pose of the base depends on the path of the arms.

        Raises:
            RobotError: if the base does not float.

        Source:
            [UY1989]
        """
        if not self.tree.floating:
            raise RobotError("this robot's base does not float: build it with base='floating' or 'floating:xy'")
        return self._call("zero_momentum", q)

    def coriolis_product(self, q: Any, v: Any, w: Any) -> Any:
        """C(q, v) w, (n,), with the Christoffel form of C (dM/dt - 2 C is skew). Bilinear and symmetric in (v, w)."""
        return self._call("coriolis_product", q, v, w)

    def tip_position(self, q: Any) -> Any:
        """Position of the tip in the world, (3,) [m]."""
        return self._call("tip_position", q)

    def tip_rotation(self, q: Any) -> Any:
        """Rotation of the tip in the world, (3, 3)."""
        return self._call("tip_rotation", q)

    def tip_jacobian(self, q: Any) -> Any:
        """Geometric Jacobian of the tip in world axes, (6, n): linear rows, then angular rows."""
        return self._call("tip_jacobian", q)

    def pose(self, q: Any, frame: str | None = None) -> Any:
        """Pose of a frame, or of the tip, in the world: a homogeneous transform (4, 4) [m].

        Example:
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
            >>> robot.pose([0.0, 0.0])[:3, 3].tolist()
            [2.0, 0.0, 0.0]
        """
        R, p = (self._call(self._find_key(part, frame, None), q) for part in ("rotation", "position"))
        if isinstance(p, ca.SX | ca.MX):
            return ca.vertcat(ca.horzcat(R, p), ca.DM([[0.0, 0.0, 0.0, 1.0]]))
        pose = np.zeros((*p.shape[:-1], 4, 4))
        pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = R, p, 1.0
        return pose

    def jacobian(self, q: Any, frame: str | None = None) -> Any:
        """Geometric Jacobian of a frame, or of the tip, in world axes, (6, n): linear rows, then angular rows."""
        return self._call(self._find_key("jacobian", frame, None), q)

    def sample(self, count: int, seed: int = 0) -> Array:
        """Random postures within the joint limits, (count, n), uniform [rad] or [m].

        Joints without limits take a whole turn, or half a metre.
        """
        return self.tree.draw_postures(require_count("count", count), require_count("seed", seed, least=0))

    def frame_position(self, q: Any, frame: str, relative_to: str | None = None) -> Any:
        """Position of a frame in the world, or in another frame, (3,) [m].

        Raises:
            UnknownNameError: if there is no such frame.

        Example:
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[3.0, 3.0])
            >>> robot.frame_position([0.0, 0.0], "tip").tolist()
            [2.0, 0.0, 0.0]
        """
        return self._call(self._find_key("position", frame, relative_to), q)

    def frame_rotation(self, q: Any, frame: str, relative_to: str | None = None) -> Any:
        """Rotation of a frame in the world, or in another frame, (3, 3)."""
        return self._call(self._find_key("rotation", frame, relative_to), q)

    def frame_jacobian(self, q: Any, frame: str, relative_to: str | None = None) -> Any:
        """Geometric Jacobian of a frame, (6, n): linear rows, then angular rows.

        Rows are in world axes, or relative to another frame and in its axes.
        """
        return self._call(self._find_key("jacobian", frame, relative_to), q)

    def centre_of_mass(self, q: Any) -> Any:
        """Centre of mass of all that the joints move, in the world, (3,) [m]."""
        return self._call("centre_of_mass", q)

    def frame_function(
        self, quantity: FrameQuantity, frame: str | None = None, relative_to: str | None = None
    ) -> ca.Function:
        """q (n, 1) -> position (3, 1), rotation (3, 3) or geometric Jacobian (6, n) of a frame, for larger graphs.

        Args:
            quantity: "position", "rotation" or "jacobian".
            frame: its name; None for the (first) tip.
            relative_to: name of the frame of reference; None for the world.

        Raises:
            UnknownNameError: if there is no such quantity or frame.
        """
        require_known("quantity of a frame", quantity, ("position", "rotation", "jacobian"))
        return self._functions[self._find_key(quantity, frame, relative_to)]

    def joint_points(self, q: Any) -> Array:
        """A line to draw, along base, joint origins and tip: q (N, n) -> (N, points, 3) [m].

        With several tips, the line goes to the other tips first and returns along their joints.
        """
        points, single = as_point_set("q", q, self.n)
        flat = self._batched["joint_points",](points)[0].transpose(0, 2, 1)
        return flat[0] if single else flat

    def function(self, name: str) -> ca.Function:
        """The CasADi function behind a method, for code generation and larger graphs.

        `mass_matrix`, `gravity`, `bias` and `coriolis_product` also exist as `mass_matrix_with_payload` and so on, with
        the ten numbers of `with_payload` as a further argument.

        Raises:
            UnknownNameError: if there is no such function.
        """
        require_known("robot function", name, [name for name in _FUNCTIONS if not name.startswith("frame_")])
        return self._functions[name,]

    @cached_property
    def _batched(self) -> BuiltOnUse[_Key, Batched]:
        return BuiltOnUse(lambda key: Batched(self._functions[key]))

    @cached_property
    def _functions(self) -> BuiltOnUse[_Key, ca.Function]:
        return BuiltOnUse(self._build_function)

    def _build_function(self, key: _Key) -> ca.Function:
        name, frames = str(key[0]), key[1:]
        names, expression = _FUNCTIONS[name]
        by_bias = name.startswith("coriolis_product") and self.n > WRITTEN_OUT
        kind = ca.MX if by_bias else ca.SX
        arguments: list[Any] = [kind.sym(argument, PAYLOAD if argument == "payload" else self.n) for argument in names]
        if by_bias:
            # The difference of two biases, in which gravity cancels, needs no further code in generated C.
            q, v, w, *payload = arguments
            bias = self.function("bias_with_payload" if payload else "bias")
            result = (bias(q, v + w, *payload) - bias(q, v - w, *payload)) / 4
        else:
            result = expression(self.tree, *arguments, *(frame and self.tree.frame(frame) for frame in frames))
        return dense_function(name, arguments, [result], names)

    def _find_key(self, quantity: str, frame: str | None, relative_to: str | None) -> _Key:
        """Key of a frame's function; the functions of the tip in the world have names of their own."""
        for name in (frame, relative_to):
            if name is not None:
                self.tree.frame(name)
        of_tip = frame in (None, self.tree.tip_name) and relative_to is None
        return (f"tip_{quantity}",) if of_tip else (f"frame_{quantity}", frame or self.tree.tip_name, relative_to)

    def _call(self, name: str | _Key, *arguments: Any) -> Any:
        """Call a function with CasADi or NumPy arguments, and return the same kind."""
        key = (name,) if isinstance(name, str) else name
        function = self._functions[key]
        # CasADi arguments give an expression, which needs columns of the right size.
        if any(isinstance(a, ca.SX | ca.MX) for a in arguments):
            for a in arguments:
                shape = tuple(a.shape) if hasattr(a, "shape") else np.shape(as_float_array("a joint vector", a))
                if shape != (self.n, 1):
                    raise ShapeError("a CasADi joint vector", shape, (self.n, 1))
            return function(*arguments)
        # NumPy arguments give arrays, for one state or for a set.
        sets = [as_point_set(name, a, self.n) for name, a in zip(function.name_in(), arguments, strict=True)]
        points = [p for p, _ in sets]
        if len({len(p) for p in points}) > 1:
            raise ShapeError("the second state set", points[1].shape, points[0].shape)
        rows, columns = function.size_out(0)
        result = self._batched[key](*points)[0].reshape((-1, rows, columns) if key[0] in _MATRICES else (-1, rows))
        return result[0] if all(single for _, single in sets) else result


def _build_chain(
    model: pin.Model,
    mimics: Mimics,
    tips: tuple[str, ...],
    locked: Locked,
    tool: Tool,
    base: str | None,
    gravity: Gravity,
) -> tuple[KinematicTree, pin.Model]:
    """The joints that move the tips, without joints that the user locks, as a tree and as a model."""
    tips = tips or (find_default_tip(model),)
    # First lock the user's joints and a base that floats in the file, then all joints that move no tip.
    model = lock_joints(model, locked or {}, mimics)
    if (floating := find_floating_base(model, tips)) and base is None:
        joint = floating[0]
        _log.warning("the base floats in the file (joint '%s') and is held: base='floating' lets it move", joint)
    model = lock_joints(model, dict.fromkeys(floating, 0.0))
    chain = lock_off_chain(model, *tips, mimics=mimics)
    tree = set_gravity(build_tree(chain, *tips, base=base, mimics=mimics), gravity)
    return tree if tool is None else add_tool(tree, tool), chain


def _check_tips(tip: str | None, tips: Sequence[str]) -> tuple[str, ...]:
    """The names of the tips; an empty tuple if none is given.

    Raises:
        InvalidValueError: if an entry is not a name, one appears twice, or both arguments are given.
    """
    if tip is not None and tips:
        raise InvalidValueError(
            "tips", repr(tips)[:80], "nothing, because tip is given: put all tips in tips, or only one in tip"
        )
    valid = not isinstance(tips, str) and isinstance(tips, Sequence) and all(isinstance(name, str) for name in tips)
    if not valid or len(set(tips)) < len(tips):
        raise InvalidValueError("tips", repr(tips)[:80], "different names of frames")
    return tuple(tips) if tip is None else (tip,)


#: name -> names of the arguments, and the function that builds the expression
_FUNCTIONS: dict[str, tuple[tuple[str, ...], Callable[..., ca.SX]]] = {
    "mass_matrix": (("q",), dynamics.build_mass_matrix),
    "gravity": (("q",), dynamics.build_gravity),
    "frame_position": (("q",), lambda tree, q, *frames: kinematics.build_frame_pose(tree, q, *frames)[1]),
    "frame_rotation": (("q",), lambda tree, q, *frames: kinematics.build_frame_pose(tree, q, *frames)[0]),
    "frame_jacobian": (("q",), kinematics.build_frame_jacobian),
    "centre_of_mass": (("q",), kinematics.build_centre_of_mass),
    "tip_position": (("q",), lambda tree, q: kinematics.build_tip_pose(tree, q)[1]),
    "tip_rotation": (("q",), lambda tree, q: kinematics.build_tip_pose(tree, q)[0]),
    "tip_jacobian": (("q",), kinematics.build_tip_jacobian),
    "joint_points": (("q",), kinematics.build_joint_points),
    "bias": (("q", "dq"), dynamics.build_bias),
    "inverse_dynamics": (("q", "dq", "ddq"), dynamics.build_inverse_dynamics),
    "forward_dynamics": (("q", "dq", "tau"), dynamics.build_forward_dynamics),
    "coriolis_product": (("q", "v", "w"), dynamics.build_coriolis_product),
    "zero_momentum": (("q",), dynamics.build_zero_momentum),
}
for _name in ("mass_matrix", "gravity", "bias", "coriolis_product"):
    _FUNCTIONS[f"{_name}_with_payload"] = (*_FUNCTIONS[_name][0], "payload"), _FUNCTIONS[_name][1]
_MATRICES = (
    "mass_matrix",
    "zero_momentum",
    *(f"{of}_{quantity}" for of in ("tip", "frame") for quantity in ("rotation", "jacobian")),
)
