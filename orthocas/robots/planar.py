"""Planar arms with uniform links, as a `pin.Model` like that of a URDF file."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from orthocas.errors import InvalidValueError
from orthocas.tools.checks import frozen_array

TIP = "tip"
GRAVITY = 9.81  #: [m/s^2]


def planar_model(lengths: Sequence[float], masses: Sequence[float]) -> pin.Model:
    """A chain in the x-y plane with joints about z. At q = 0 it lies along x; gravity points along -y.

    Each link is a thin rod with uniform mass: I = m l^2 / 12 about its centre.

    Args:
        lengths: link lengths [m], > 0.
        masses: link masses [kg], > 0, one per link.

    Raises:
        ShapeError: if the two differ in length.
        InvalidValueError: if a number is not positive.

    Source:
        [AS2023] Fig. 5 and Sec. 8.
    """
    lengths = frozen_array("lengths", lengths, (None,)).tolist()
    masses = frozen_array("masses", masses, (len(lengths),)).tolist()
    for name, values in (("lengths", lengths), ("masses", masses)):
        if not values or min(values) <= 0:
            raise InvalidValueError(name, values, "positive numbers, one per link")
    model = pin.Model()
    model.name = f"planar_{len(lengths)}r"
    model.gravity.linear = np.array([0.0, -GRAVITY, 0.0])
    parent, offset = 0, 0.0
    limit = np.full(1, np.inf)
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        placement = pin.SE3(np.eye(3), np.array([offset, 0.0, 0.0]))
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"q{i + 1}", limit, limit, -limit, limit)
        across = mass * length**2 / 12
        rod = pin.Inertia(mass, np.array([length / 2, 0.0, 0.0]), np.diag([0.0, across, across]))
        model.appendBodyToJoint(parent, rod, pin.SE3.Identity())
        offset = length
    model.addFrame(pin.Frame(TIP, parent, pin.SE3(np.eye(3), np.array([offset, 0.0, 0.0])), pin.FrameType.OP_FRAME))
    return model
