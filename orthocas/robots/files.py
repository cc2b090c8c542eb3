"""Reading URDF and MJCF files through Pinocchio, and locking joints."""

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from orthocas.checks import Array, require_known
from orthocas.errors import InvalidValueError, RobotError


def read_urdf(path: str | Path) -> pin.Model:
    """Read a URDF file; mimic joints stay visible so that they can be refused or locked.

    Raises:
        RobotError: if the file is missing or is not a URDF model.
    """
    return _read(Path(path), "robot", "URDF", lambda name: pin.buildModelFromUrdf(name, mimic=True))


def read_mjcf(path: str | Path) -> pin.Model:
    """Read a MuJoCo MJCF file.

    Raises:
        RobotError: if the file is missing or is not an MJCF model.
    """
    return _read(Path(path), "mujoco", "MJCF", pin.buildModelFromMJCF)


def lock_joints(model: pin.Model, locked: Mapping[str, float]) -> pin.Model:
    """Fix joints at the given positions [rad] or [m]; joints that mimic a locked joint follow it.

    Raises:
        UnknownNameError: if there is no such joint.
        InvalidValueError: if a position is not finite.
    """
    names = list(model.names)[1:]
    position = pin.neutral(model)
    ids = []
    for name, value in locked.items():
        require_known("joint", name, names)
        if not np.isfinite(value):
            raise InvalidValueError(f"locked position of joint '{name}'", value, "a finite number")
        ids.append(model.getJointId(name))
        _set_position(model, ids[-1], float(value), position)
    ids += [i for i in _mimic_ids(model) if i not in ids and _is_led_by(model, i, ids)]
    return pin.buildReducedModel(model, ids, position) if ids else model


def joints_off_chain(model: pin.Model, tip: str) -> dict[str, float]:
    """Joints that do not move the tip, with the position nearest to zero inside their limits.

    Raises:
        UnknownNameError: if there is no frame called tip.
    """
    require_known("frame", tip, [frame.name for frame in model.frames])
    chain = set(model.supports[model.frames[model.getFrameId(tip)].parentJoint])
    mimic = _mimic_ids(model)
    positions = {}
    for i in range(1, model.njoints):
        joint = model.joints[i]
        if i not in chain and i not in mimic and joint.nv == 1:
            limits = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            positions[model.names[i]] = 0.0 if joint.nq == 2 else float(np.clip(0.0, *limits))
    return positions


def default_tip(model: pin.Model) -> str:
    """The last frame of a robot with a single chain.

    Raises:
        RobotError: if the robot branches, with the frames to choose from.
    """
    carriers = {model.parents[i] for i in range(1, model.njoints)}
    leaves = [i for i in range(1, model.njoints) if i not in carriers]
    last: dict[int, str] = {i: [frame.name for frame in model.frames if frame.parentJoint == i][-1] for i in leaves}
    if len(leaves) != 1:
        raise RobotError(f"the robot ends in {len(leaves)} places, name the tip frame: {', '.join(last.values())}")
    return last[leaves[0]]


def _read(path: Path, root: str, kind: str, build: Callable[[str], pin.Model]) -> pin.Model:
    """Check that the file is XML of the right kind, then let Pinocchio build the model."""
    try:
        found = ElementTree.parse(path).getroot().tag
    except OSError as error:
        raise RobotError(f"cannot read {kind} file {path}: {error.strerror}") from None
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise RobotError(f"{path} is not a {kind} file: {error}") from None
    if found != root:
        raise RobotError(f"{path} is not a {kind} file: its root element is <{found}>, expected <{root}>")
    with _captured_stderr() as notes:
        try:
            return build(str(path))
        except (ValueError, RuntimeError) as error:
            notes.seek(0)
            reason = " ".join((notes.read().decode(errors="replace") or str(error)).split())
            raise RobotError(f"{path} is not a usable {kind} model: {reason[:300]}") from None


@contextmanager
def _captured_stderr() -> Iterator[IO[bytes]]:
    """Catch what the C++ parser writes to standard error: it belongs in our message, not on the user's terminal."""
    saved = os.dup(2)
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)
        try:
            yield sink
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def _set_position(model: pin.Model, i: int, value: float, position: Array) -> None:
    """Write a joint position into a configuration; Pinocchio keeps cos and sin of a continuous joint."""
    joint = model.joints[i]
    if joint.nv != 1:
        raise RobotError(f"joint '{model.names[i]}' is of type {joint.shortname()} and cannot be locked at one number")
    position[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(value), np.sin(value)) if joint.nq == 2 else value


def _mimic_ids(model: pin.Model) -> list[int]:
    return [i for i in range(1, model.njoints) if model.joints[i].shortname() == "JointModelMimic"]


def _is_led_by(model: pin.Model, mimic: int, ids: list[int]) -> bool:
    """Whether a mimic joint takes its position from one of the joints ids (it shares its index in q)."""
    return any(model.joints[i].idx_q == model.joints[mimic].idx_q for i in ids)
