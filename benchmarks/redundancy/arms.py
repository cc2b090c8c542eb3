"""The arms: serial chains with seven joints, each as one small URDF that all methods read."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import files
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin

import orthocas as oc
from orthocas.problems import urdf_path
from orthocas.tasks.regular_box import regular_box
from orthocas.tools.checks import Array

TICK = 0.01  #: [s]
BASE, TIP = "base", "tip"  #: links of every arm's file
FASTEST = 2.0  # of joints whose file says nothing [rad/s]
ROOM = 2.0  # of a mobile base, to every side [m]
BASE_SPEED = 1.0  # [m/s], [rad/s]
BASE_JOINTS = (
    ("prismatic", "base_x", "1 0 0", ROOM),
    ("prismatic", "base_y", "0 1 0", ROOM),
    ("revolute", "base_heading", "0 0 1", np.pi),
)


@dataclass(frozen=True)
class Source:
    """Where an arm comes from."""

    file: str  #: end of a path in example-robot-data; "" for the file in orthocas
    tip: str
    first: str  #: first joint of the chain
    home: tuple[float, ...] = ()  #: the maker's; empty for a posture in the middle of the joint range


SOURCES = {
    "iiwa": Source("", "link_ee", "A1"),
    "panda": Source(
        "panda_description/urdf/panda.urdf",
        "panda_hand",
        "panda_joint1",
        (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4),
    ),
    "xarm7": Source("xarm_description/urdf/xarm7.urdf", "link_eef", "joint1"),
    "baxter": Source("baxter_description/urdf/baxter.urdf", "left_gripper_base_link", "left_s0"),
    "tiago": Source("tiago_description/robots/tiago.urdf", "arm_7_link", "arm_1_joint"),
    "tiago-pro": Source("tiago_pro_description/robots/tiago_pro.urdf", "arm_left_tool_link", "arm_left_1_joint"),
    "pr2": Source("pr2_description/urdf/pr2.urdf", "l_gripper_tool_frame", "l_shoulder_pan_joint"),
    "g1": Source("g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_wrist_yaw_link", "left_shoulder_pitch_joint"),
}
TUNED_ON = ("iiwa", "panda")  #: the other six never see the tuning of settings
HELD_OUT = {
    "talos": Source("talos_data/robots/talos_reduced.urdf", "gripper_left_base_link", "arm_left_1_joint"),
    "romeo": Source("romeo_description/urdf/romeo.urdf", "l_wrist", "LShoulderPitch"),
}  #: arms on which no method was looked at while it was written


class Arm:
    """A chain in Pinocchio and in orthocas, a posture to begin at, and the angle of its elbow.

    Args:
        name: of `SOURCES` or `HELD_OUT`.
        mobile: with a base that moves in the plane and turns, three joints more.
    """

    def __init__(self, name: str, mobile: bool = False) -> None:
        self.name, self.mobile = name, mobile
        self.file = chain(name, mobile)  #: the URDF
        self.model = pin.buildModelFromXML(self.file)
        self.data, self.frame = self.model.createData(), self.model.getFrameId(TIP)
        self.robot = oc.Robot.from_model(self.model, TIP)
        self.joints = self.robot.joint_names
        self.lower, self.upper = self.robot.lower, self.robot.upper
        self.fastest, self.n = self.robot.velocity_limits, self.robot.n

    @cached_property
    def home(self) -> Array:
        """The maker's, or a posture in the middle of the joint range, bent if that is singular; a base is at 0."""
        if self.mobile:
            return np.concatenate([np.zeros(3), Arm(self.name).home])
        home = {**SOURCES, **HELD_OUT}[self.name].home
        if home:
            return np.array(home)
        return np.array(regular_box(self.robot, oc.Task.pose(self.robot)).centre)

    @cached_property
    def task(self) -> oc.Task:
        """The pose of the tip, relative to that at home."""
        return oc.Task.pose(self.robot).with_reference_at(self.home)

    def elbow_expression(self, q: ca.SX) -> ca.SX:
        """The rotation of joint 4 about the line from joint 2 to joint 6 [rad], 0 at home."""
        shoulder, elbow, wrist = (self.robot.frame_position(q, f"{self.joints[k]}_link") for k in (1, 3, 5))
        line, side = wrist - shoulder, elbow - shoulder
        across = ca.cross(ca.cross(line / ca.norm_2(line), ca.DM(self._reference)), line)
        cosine, sine = ca.dot(across, side), ca.dot(line / ca.norm_2(line), ca.cross(across, side))
        at_home = ca.Function("home", [q], [ca.atan2(sine, cosine)])(self.home)
        return ca.atan2(
            sine * ca.cos(at_home) - cosine * ca.sin(at_home), cosine * ca.cos(at_home) + sine * ca.sin(at_home)
        )

    @cached_property
    def elbow(self) -> Callable[[Array], float]:
        """q -> the angle of the elbow [rad]."""
        q = ca.SX.sym("q", self.n)
        angle = ca.Function("elbow", [q], [self.elbow_expression(q)])
        return lambda q: float(angle(q))

    @cached_property
    def _reference(self) -> Array:
        """Up, or ahead where the arm at home points up: the direction from which the angle of the elbow counts."""
        shoulder, wrist = (self.robot.frame_position(self.home, f"{self.joints[k]}_link") for k in (1, 5))
        line = np.ravel(wrist - shoulder)
        return np.array([0.0, 0.0, 1.0]) if abs(line[2]) < 0.85 * np.linalg.norm(line) else np.array([1.0, 0.0, 0.0])

    @cached_property
    def size(self) -> float:
        """The distance from joint 2 to the tip of the stretched arm, link by link [m]."""
        steps = [np.linalg.norm(place.translation) for place in list(self.model.jointPlacements)[-5:]]
        return float(sum(steps) + np.linalg.norm(self.model.frames[self.frame].placement.translation))

    @cached_property
    def leaves(self) -> tuple[Array, Array]:
        """Elbow angles (N,), ascending, and postures (N, n) of the self-motion at home that have them."""
        ways = [self._along(sign) for sign in (-1.0, 1.0)]
        both = [*ways[0][::-1], self.home, *ways[1]]
        angles = np.unwrap([self.elbow(q) for q in both])
        order = np.argsort(angles)
        return angles[order], np.array(both)[order]

    def _along(self, sign: float, step: float = 0.01, most: int = 100) -> list[Array]:
        """Postures of the self-motion from home in one sense, as long as the angle of the elbow goes on with it."""
        q, placement, found, before = self.home, self.placement(self.home), [], sign * self.self_motion(self.home)
        for _ in range(most):
            way = self.self_motion(q)
            way = way if way @ before > 0 else -way
            ahead = q + step * way
            for _ in range(3):
                ahead = ahead + np.linalg.pinv(self.jacobian(ahead)) @ self.error(ahead, placement)
            if not self.inside(ahead):
                break
            q, before = ahead, way
            found.append(q)
        return found

    def with_elbow(self, angle: float) -> Array:
        """The posture at home with that angle of the elbow, as near as its self-motion gets (n,)."""
        angles, postures = self.leaves
        return np.array([np.interp(angle, angles, column) for column in postures.T])

    def inside(self, q: Array) -> bool:
        """Whether joint positions (..., n) keep the limits."""
        return bool((q >= self.lower - 1e-6).all() and (q <= self.upper + 1e-6).all())

    def placement(self, q: Array) -> pin.SE3:
        """Of the tip."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.frame].copy()

    def jacobian(self, q: Array) -> Array:
        """Of the tip, in the world's axes (6, n), linear rows first."""
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.asarray(pin.computeFrameJacobian(self.model, self.data, q, self.frame, axes))

    def error(self, q: Array, wanted: pin.SE3) -> Array:
        """Position [m] and rotation [rad] that are left, in the world's axes (6,)."""
        found = self.placement(q)
        turn = found.rotation @ pin.log3(found.rotation.T @ wanted.rotation)
        return np.concatenate([wanted.translation - found.translation, turn])

    def self_motion(self, q: Array) -> Array:
        """The unit joint motion that leaves the tip alone, of an arm with one more joint than the task (n,)."""
        return np.asarray(np.linalg.svd(self.jacobian(q))[2][-1])


def chain(name: str, mobile: bool = False) -> str:
    """The URDF of the chain alone, without pictures: base, joints with their limits and inertias, tip.

    Joints without an end get limits of half a turn to both sides, so that all methods see the same range.
    """
    source = {**SOURCES, **HELD_OUT}[name]
    model, frame = _reduced(source)
    first = model.getJointId(source.first)
    order = [first]
    while order[-1] != frame.parentJoint:
        order.append(next(i for i in model.supports[frame.parentJoint] if model.parents[i] == order[-1]))
    parts, last = [f'<robot name="{name}"><link name="{BASE}"/>'], BASE
    if mobile:
        for kind, joint, axis, end in BASE_JOINTS:
            inertia = _inertia(pin.Inertia(20.0, np.zeros(3), np.eye(3)))
            parts.append(_joint(kind, joint, last, pin.SE3.Identity(), axis, (-end, end, BASE_SPEED), inertia))
            last = f"{joint}_link"
    for i in order:
        joint = model.joints[i]
        low, high = _limits(model, joint)
        speed = float(model.velocityLimit[joint.idx_v])
        speed = speed if 0 < speed < 100 else FASTEST
        axis = " ".join(f"{v:.17g}" for v in _axis(joint))
        inertia = _inertia(model.inertias[i])
        parts.append(
            _joint("revolute", model.names[i], last, model.jointPlacements[i], axis, (low, high, speed), inertia)
        )
        last = f"{model.names[i]}_link"
    parts.append(_fixed(last, frame.placement))
    return "\n".join([*parts, "</robot>"])


def _reduced(source: Source) -> tuple[pin.Model, pin.Frame]:
    """The whole robot with all joints locked that are not between the first one and the tip."""
    if source.file:
        path = next(Path(str(f.locate())) for f in files("example-robot-data") or [] if str(f).endswith(source.file))
        model = pin.buildModelFromUrdf(str(path.resolve()))
    else:
        with urdf_path() as path:
            model = pin.buildModelFromUrdf(str(path))
    supports = list(model.supports[model.frames[model.getFrameId(source.tip)].parentJoint])
    kept = supports[supports.index(model.getJointId(source.first)) :]
    q = pin.neutral(model)
    idle = [i for i in range(1, model.njoints) if i not in kept]
    model = pin.buildReducedModel(model, idle, q)
    return model, model.frames[model.getFrameId(source.tip)]


def _axis(joint: pin.JointModel) -> Array:
    """Of a revolute joint, in its own frame."""
    data = joint.createData()
    joint.calc(data, np.array([1.0, 0.0]) if joint.nq == 2 else np.zeros(1))
    return np.asarray(data.S).ravel()[3:]


def _limits(model: pin.Model, joint: pin.JointModel) -> tuple[float, float]:
    if joint.nq == 2:
        return -np.pi, np.pi
    low, high = (float(ends[joint.idx_q]) for ends in (model.lowerPositionLimit, model.upperPositionLimit))
    return max(low, -2 * np.pi), min(high, 2 * np.pi)


def _place(placement: pin.SE3) -> str:
    xyz, rpy = placement.translation, pin.rpy.matrixToRpy(placement.rotation)
    return f'<origin xyz="{" ".join(f"{v:.17g}" for v in xyz)}" rpy="{" ".join(f"{v:.17g}" for v in rpy)}"/>'


def _inertia(inertia: pin.Inertia) -> str:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.inertia
    words = "".join(
        f' {n}="{v:.17g}"'
        for n, v in zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (xx, xy, xz, yy, yz, zz), strict=True)
    )
    place = _place(pin.SE3(np.eye(3), inertia.lever))
    return f'<inertial>{place}<mass value="{inertia.mass:.17g}"/><inertia{words}/></inertial>'


def _joint(
    kind: str, name: str, parent: str, place: pin.SE3, axis: str, limits: tuple[float, float, float], inertia: str
) -> str:
    low, high, speed = limits
    return (
        f'<link name="{name}_link">{inertia}</link><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{name}_link"/>{_place(place)}<axis xyz="{axis}"/>'
        f'<limit lower="{low:.17g}" upper="{high:.17g}" velocity="{speed:.17g}" effort="1000"/></joint>'
    )


def _fixed(parent: str, place: pin.SE3) -> str:
    return (
        f'<link name="{TIP}"/><joint name="{TIP}_joint" type="fixed"><parent link="{parent}"/>'
        f'<child link="{TIP}"/>{_place(place)}</joint>'
    )
