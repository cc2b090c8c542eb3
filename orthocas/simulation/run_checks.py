"""What the arguments of `simulate` must be, and which robot is the plant."""

from collections.abc import Mapping, Sequence
from typing import Literal

from orthocas.checks import as_number, require_kind
from orthocas.control.controller import Controller, require_controller
from orthocas.control.reference import Reference
from orthocas.control.safety import Safety
from orthocas.errors import InvalidValueError
from orthocas.robots import Robot
from orthocas.simulation.closed_loop import ClosedLoop
from orthocas.simulation.disturbances import Friction, Noise, Push
from orthocas.simulation.mujoco_scene import MUJOCO, MuJoCo

Plant = Robot | MuJoCo | Literal["mujoco"] | None  #: the true robot, or MuJoCo with it; None: the controller's model

_MOST_TICKS = 1e7  # of a sampled run


def plant_of(plant: Plant, controller: Controller) -> tuple[Robot, MuJoCo | None]:
    """The true robot, and the scene if MuJoCo simulates it.

    Raises:
        InvalidValueError: if the plant is something else.
    """
    model = controller.problem.robot
    scene = MuJoCo() if isinstance(plant, str) and plant == MUJOCO else plant
    if scene is None or isinstance(scene, Robot):
        return scene or model, None
    if isinstance(scene, MuJoCo):
        return scene.robot or model, scene
    given = repr(plant)[:80] if isinstance(plant, str | int | float) else f"a {type(plant).__name__}"
    raise InvalidValueError("plant", given, f"a Robot, '{MUJOCO}' or a MuJoCo")


def require_kinds(
    controller: Controller, reference: Reference, pushes: Sequence[Push], optional: Mapping[type, object]
) -> None:
    """Raise InvalidValueError for objects of the wrong class."""
    require_controller(controller)
    require_kind("reference", reference, Reference)
    for kind, value in optional.items():
        if value is not None:
            require_kind(kind.__name__.lower(), value, kind)
    require_kind("pushes", pushes, Sequence)
    for push in pushes:
        require_kind("an entry of pushes", push, Push)


def require_fitting(
    loop: ClosedLoop,
    reference: Reference,
    friction: Friction | None,
    noise: Noise | None,
    control_rate: float | None,
    in_mujoco: bool,
    safety: Safety | None,
) -> None:
    """Raise InvalidValueError for arguments that would be ignored, or fail later with a less clear message."""
    controller = loop.controller
    if reference.labels != controller.labels:
        raise InvalidValueError(
            "labels of the reference", reference.labels, f"those of the controller {controller.labels}"
        )
    if loop.n != controller.problem.n:
        raise InvalidValueError("joints of the plant", loop.n, f"{controller.problem.n}, as in the controller's robot")
    forces = loop.loads.pushes or friction is not None or loop.stops is not None
    if not loop.torque and (forces or loop.plant is not controller.problem.robot):
        raise InvalidValueError(
            "pushes, friction, stops or plant",
            "given",
            "none of them, because forces do not affect a velocity controller",
        )
    late = [push.start for push in loop.loads.pushes if push.start >= reference.duration]
    if late:
        raise InvalidValueError("start of a push", late[0], f"a time before the end at {reference.duration:g} s")
    if control_rate is not None and as_number("control_rate", control_rate) * reference.duration < 1:
        raise InvalidValueError("control_rate", control_rate, f"at least one tick in {reference.duration:g} s")
    if control_rate is not None and as_number("control_rate", control_rate) * reference.duration > _MOST_TICKS:
        raise InvalidValueError(
            "control_rate", control_rate, f"at most {_MOST_TICKS:g} ticks in {reference.duration:g} s"
        )
    if noise is not None and control_rate is None:
        raise InvalidValueError(
            "noise", noise, "no noise without control_rate, because white noise needs control ticks"
        )
    if safety is not None and control_rate is None:
        raise InvalidValueError("control_rate", None, "a number, because a supervised law runs tick by tick")
    if in_mujoco:
        _require_for_mujoco(loop, control_rate)


def _require_for_mujoco(loop: ClosedLoop, control_rate: float | None) -> None:
    """Raise InvalidValueError for what MuJoCo does not simulate."""
    if control_rate is None:
        raise InvalidValueError("control_rate", None, "a number, because MuJoCo runs with a sampled controller")
    if not loop.torque:
        raise InvalidValueError("plant", MUJOCO, "no MuJoCo with a velocity controller, which commands no torques")
    if loop.stops is not None:
        raise InvalidValueError("stops", "given", "none with MuJoCo, which has its own: MuJoCo(stops=True)")
