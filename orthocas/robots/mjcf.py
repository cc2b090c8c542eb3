"""MJCF files and compiled MuJoCo models as a `pin.Model` with the same mass matrix and bias."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from orthocas.errors import RobotError, one_line
from orthocas.robots.pinocchio_model import Mimic, resolve_mimics, suggest_lock
from orthocas.robots.urdf import RULES, read_xml
from orthocas.tools.checks import Array, as_path, import_extra

#: attributes that hold names
_WORDS = ("name", "class", "childclass", "joint", "body", "file", "mesh", "material")


def read_mjcf(source: Any, locked: Mapping[str, float] | None = None) -> tuple[pin.Model, dict[str, Mimic]]:
    """The kinematics, masses, armatures, limits of position and effort, gravity and mimic joints of an MJCF file.

    MuJoCo's own compiler reads the file, with meshes, includes, default classes, attached and replicated bodies. The
    model has a frame for every body, named site and named joint. If several share a name, `find_frame` prefers the body
    to the site, and the site to the joint. Bodies and joints without a name are called body<i> and joint<i>, with
    MuJoCo's index i. Named keyframes become reference configurations.

    Mass matrix and bias equal MuJoCo's qM and qfrc_bias. A `Robot` has no passive forces and no constraint forces:
    springs, damping, friction, gravity compensation (gravcomp), fluids and contacts are ignored. Of <equality>, active
    linear couplings of two joints are kept, as exact constraints: the first joint mimics the second. Others are
    ignored.

    The effort limit of a joint is the sum over its actuators of |gear| times the force range, or of |gear gain| times
    the control range for motors. It is at most the joint's actuatorfrcrange.

    Args:
        source: the path of a file, or a `mujoco.MjModel`.
        locked: joints that the caller locks. They stop following a coupling, but other joints still follow them.

    Raises:
        MissingExtraError: if MuJoCo is not installed.
        RobotError: if MuJoCo refuses the file, if the model has no joint, armatures on tendons or actuators, or
            flexible bodies, or if joints follow each other in a loop.
    """
    mujoco = import_extra("mujoco", "reading MJCF files", "mujoco")
    if isinstance(source, mujoco.MjModel):
        compiled, name = source, "the model"
    else:
        compiled, name = compile_mjcf(source), str(as_path("path", source))
    _refuse_unread(compiled, name)
    model = pin.Model()
    off = bool(compiled.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    model.gravity.linear = np.zeros(3) if off else compiled.opt.gravity
    # For each body: the joint that moves it, and the body's pose in that joint's frame.
    carriers = [(0, pin.SE3.Identity())]
    for i in range(1, compiled.nbody):
        carriers.append(_add_body(mujoco, model, compiled, i, *carriers[compiled.body_parentid[i]]))
    for i in range(compiled.nsite):
        if compiled.site(i).name:
            joint, placement = carriers[compiled.site_bodyid[i]]
            there = placement * build_pose(compiled.site_pos[i], compiled.site_quat[i])
            model.addFrame(pin.Frame(compiled.site(i).name, joint, there, pin.FrameType.OP_FRAME))
    for i in range(compiled.nkey):
        if compiled.key(i).name:
            model.referenceConfigurations[compiled.key(i).name] = compiled.key_qpos[i]
    return model, _find_mimics(mujoco, compiled, locked or {})


def compile_mjcf(path: Any) -> Any:
    """The `mujoco.MjModel` of a file; errors as in `read_mjcf`."""
    mujoco = import_extra("mujoco", "reading MJCF files", "mujoco")
    source = as_path("path", path)
    # Bounds on size and depth protect MuJoCo's parser, and so does the refusal of document types.
    root = read_xml(source, "MJCF", "mujoco")
    if sum(1 for _ in root.iter("body")) > RULES.links:
        raise RobotError(f"{source} has more than {RULES.links} bodies")
    # Refuse NaN, for which MuJoCo only prints a warning.
    for element in root.iter():
        for attribute, value in element.attrib.items():
            if attribute not in _WORDS and re.search(r"(?<!\w)[-+]?nan(?!\w)", value, re.IGNORECASE):
                raise RobotError(f"{source}: {attribute} of <{element.tag}> is '{value}', expected finite numbers")
    try:
        return mujoco.MjModel.from_xml_path(str(source))
    except ValueError as error:
        raise RobotError(f"MuJoCo refuses {source}: {one_line(str(error))}") from None


def _find_mimics(mujoco: Any, compiled: Any, locked: Mapping[str, float]) -> dict[str, Mimic]:
    """Joints that follow others: q1 - ref1 = a0 + a1 (q2 - ref2), where MuJoCo's polynomial has no higher terms."""
    direct = dict[str, Mimic]()
    for i in range(compiled.neq):
        first, second = int(compiled.eq_obj1id[i]), int(compiled.eq_obj2id[i])
        coupled = compiled.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and second >= 0 and compiled.eq_active0[i]
        a0, a1, *higher = compiled.eq_data[i][:5]
        if not coupled or any(higher) or not a1:
            continue
        names = [compiled.joint(k).name or f"joint{k}" for k in (first, second)]
        if names[0] in locked:
            continue
        ref1, ref2 = (float(compiled.qpos0[compiled.jnt_qposadr[k]]) for k in (first, second))
        coupling = Mimic(names[1], float(a1), ref1 + float(a0) - float(a1) * ref2)
        if direct.setdefault(names[0], coupling) != coupling:
            raise RobotError(
                f"joint '{names[0]}' is coupled to '{direct[names[0]].leader}' and, otherwise, to '{names[1]}', "
                f"expected one linear coupling of a joint: {suggest_lock(names[0])}"
            )
    return resolve_mimics(direct)


def _refuse_unread(compiled: Any, name: str) -> None:
    """Refuse model features that change the mass matrix and are not supported."""
    if not compiled.njnt:
        raise RobotError(f"{name} has no joint, expected at least one")
    if compiled.nbody - 1 > RULES.links:
        raise RobotError(f"{name} has more than {RULES.links} bodies")
    placed = [
        "body_pos",
        "body_quat",
        "body_ipos",
        "body_inertia",
        "body_mass",
        "jnt_pos",
        "jnt_axis",
        "jnt_range",
        "qpos0",
    ]
    try:
        compiled.names.decode()
    except UnicodeDecodeError:
        raise RobotError(f"{name} has names that are not UTF-8, expected a file in UTF-8") from None
    if not all(np.isfinite(getattr(compiled, part)).all() for part in placed):
        raise RobotError(f"{name} holds numbers that are not finite")
    # Flexible bodies change the mass matrix, and so do armatures of tendons and actuators.
    if compiled.nflex:
        raise RobotError(f"{name} has a flexible body, which orthocas does not support")
    for kind in ("tendon", "actuator"):
        loaded = np.flatnonzero(getattr(compiled, f"{kind}_armature", np.zeros(0)))
        if loaded.size:
            element = getattr(compiled, kind)(int(loaded[0])).name or f"{kind} {loaded[0]}"
            raise RobotError(f"'{element}' of {name} has an armature, which orthocas supports on joints only")


def _add_body(mujoco: Any, model: pin.Model, compiled: Any, i: int, joint: int, placement: pin.SE3) -> Any:
    """Add a body to the joint that moves its parent. Returns the joint that moves it, and its pose in that frame."""
    placement = placement * build_pose(compiled.body_pos[i], compiled.body_quat[i])
    for k in range(compiled.body_jntadr[i], compiled.body_jntadr[i] + compiled.body_jntnum[i]):
        joint, placement = _add_joint(mujoco, model, compiled, k, joint, placement)
    model.addFrame(pin.Frame(name_body(compiled, i), joint, placement, pin.FrameType.BODY))
    # Bodies that are fixed to the world load no joint.
    if joint:
        turn = pin.Quaternion(*compiled.body_iquat[i]).matrix()
        inertia = turn @ np.diag(compiled.body_inertia[i]) @ turn.T
        model.appendBodyToJoint(
            joint, pin.Inertia(compiled.body_mass[i], compiled.body_ipos[i].copy(), inertia), placement
        )
    return joint, placement


def name_body(compiled: Any, i: int) -> str:
    """The name of body i."""
    return str(compiled.body(i).name or f"body{i}")


def _add_joint(mujoco: Any, model: pin.Model, compiled: Any, k: int, parent: int, placement: pin.SE3) -> Any:
    """Add joint k to a body at `placement`. Returns its index, and the pose of the body in its frame."""
    name, kind = compiled.joint(k).name or f"joint{k}", compiled.jnt_type[k]
    anchor = pin.SE3(np.eye(3), compiled.jnt_pos[k].copy())
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        anchor = pin.SE3.Identity()
        index = model.addJoint(parent, pin.JointModelFreeFlyer(), placement, name)
    elif kind == mujoco.mjtJoint.mjJNT_BALL:
        index = model.addJoint(parent, pin.JointModelSpherical(), placement * anchor, name)
    else:
        slides, axis = kind == mujoco.mjtJoint.mjJNT_SLIDE, compiled.jnt_axis[k].copy()
        # In the pose of the file, the joint position equals `ref`.
        back = -axis * compiled.qpos0[compiled.jnt_qposadr[k]]
        shift = pin.SE3(np.eye(3), back) if slides else pin.SE3(pin.exp3(back), np.zeros(3))
        moved = (pin.JointModelPrismaticUnaligned if slides else pin.JointModelRevoluteUnaligned)(axis)
        lower, upper = compiled.jnt_range[k] if compiled.jnt_limited[k] else (-np.inf, np.inf)
        limits = (np.array([value]) for value in (_find_effort(mujoco, compiled, k), np.inf, lower, upper))
        index = model.addJoint(parent, moved, placement * anchor * shift, name, *limits)
    model.addJointFrame(index)
    first, count = model.joints[index].idx_v, model.joints[index].nv
    model.armature[first : first + count] = compiled.dof_armature[compiled.jnt_dofadr[k]]
    return index, anchor.inverse()


def _find_effort(mujoco: Any, compiled: Any, k: int) -> float:
    """Largest force [N] or torque [N m] available in both directions at joint k; inf without actuators or limits."""
    limit = _reach(compiled.jnt_actfrcrange[k]) if compiled.jnt_actfrclimited[k] else np.inf
    at_joint = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    plain = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE)
    total = 0.0
    for i in range(compiled.nu):
        gear = abs(compiled.actuator_gear[i, 0])
        # Motors that act through tendons or sites do not have a torque at one joint.
        if compiled.actuator_trntype[i] not in at_joint or compiled.actuator_trnid[i, 0] != k or not gear:
            continue
        force = _reach(compiled.actuator_forcerange[i]) if compiled.actuator_forcelimited[i] else np.inf
        # The force of a motor is gain times control.
        kind = compiled.actuator_gaintype[i], compiled.actuator_biastype[i], compiled.actuator_dyntype[i]
        if kind == plain and compiled.actuator_ctrllimited[i]:
            force = min(force, abs(compiled.actuator_gainprm[i, 0]) * _reach(compiled.actuator_ctrlrange[i]))
        total += float(gear * force)
    # Motors of one joint add up, within the joint's own limit.
    return min(limit, total) if total > 0 else limit


def _reach(ends: Array) -> float:
    """The largest magnitude available in both directions of a range; inf if the range has only one sign."""
    lower, upper = ends
    return float(min(-lower, upper)) if lower < 0 < upper else np.inf


def build_pose(position: Array, quaternion: Array) -> pin.SE3:
    """A pose. MuJoCo's quaternions and Pinocchio's constructor both begin with the real part."""
    return pin.SE3(pin.Quaternion(*quaternion).normalized().matrix(), position.copy())
