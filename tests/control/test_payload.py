"""A load at the tip against Pinocchio with the same body appended."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import ArrayLike

import orthocas as oc
from orthocas.errors import InvalidValueError
from orthocas.problems import urdf_path
from orthocas.tools.checks import Array


def random_payload(rng: np.random.Generator) -> Array:
    """Ten numbers with a full inertia matrix."""
    factor = 0.1 * rng.normal(size=(3, 3))
    return np.r_[rng.uniform(0.5, 2), 0.1 * rng.normal(size=3), (factor @ factor.T)[np.triu_indices(3)]]


def loaded(model: pin.Model, payload: Array, frame: str) -> pin.Model:
    """A copy of the model with the payload appended at a frame."""
    copy, inertia = pin.Model(model), np.zeros((3, 3))
    inertia[np.triu_indices(3)] = payload[4:]
    inertia += np.triu(inertia, 1).T
    at = copy.frames[copy.getFrameId(frame)]
    copy.appendBodyToJoint(at.parentJoint, pin.Inertia(payload[0], payload[1:4], inertia), at.placement)
    return copy


def arm_model() -> pin.Model:
    with urdf_path() as path:
        return pin.buildModelFromUrdf(str(path))


@pytest.mark.slow
def test_dynamics_with_a_payload_equal_those_of_pinocchio() -> None:
    """As a further argument, and built into the robot; the tool turns and moves the tip frame."""
    rng = np.random.default_rng(3)
    tool = np.array([0.1, -0.05, 0.2, 0.3, -0.4, 0.5])
    robot, base = oc.problems.get("iiwa").robot.with_tool(tool), arm_model()
    parent = base.frames[base.getFrameId("link_ee")]
    pose = parent.placement * pin.SE3(pin.rpy.rpyToMatrix(*tool[3:]), tool[:3])
    base.addFrame(pin.Frame("tool", parent.parentJoint, 0, pose, pin.FrameType.OP_FRAME))
    for _ in range(5):
        payload, (q, dq, w) = random_payload(rng), rng.normal(size=(3, 7))
        model = loaded(base, payload, "tool")
        data, heavy = model.createData(), robot.with_payload(payload)
        want = {
            "mass_matrix": ((q,), pin.crba(model, data, q).copy()),
            "bias": ((q, dq), pin.rnea(model, data, q, dq, 0 * q).copy()),
            "gravity": ((q,), pin.rnea(model, data, q, 0 * q, 0 * q).copy()),
            "coriolis_product": ((q, dq, w), pin.computeCoriolisMatrix(model, data, q, dq) @ w),
        }
        for name, (state, value) in want.items():
            found = robot.function(f"{name}_with_payload")(*state, payload).full().reshape(value.shape)
            np.testing.assert_allclose(found, value, atol=1e-12)
            np.testing.assert_allclose(getattr(heavy, name)(*state), value, atol=1e-12)


def test_no_payload_changes_nothing() -> None:
    robot, q = oc.problems.get("iiwa").robot, np.linspace(-1, 1, 7)
    np.testing.assert_array_equal(robot.with_payload(0.0).mass_matrix(q), robot.mass_matrix(q))
    found = robot.function("mass_matrix_with_payload")(q, np.zeros(10)).full()
    np.testing.assert_allclose(found, robot.mass_matrix(q), atol=1e-15)


def test_a_mass_is_a_point_at_the_tip() -> None:
    """M grows by m J^T J, and gravity by m J^T (0, 0, 9.81)."""
    robot, q = oc.problems.get("iiwa").robot, np.linspace(-1, 1, 7)
    heavy, J = robot.with_payload(1.5), robot.tip_jacobian(q)[:3]
    np.testing.assert_allclose(heavy.mass_matrix(q) - robot.mass_matrix(q), 1.5 * J.T @ J, atol=1e-13)
    np.testing.assert_allclose(heavy.gravity(q) - robot.gravity(q), 1.5 * 9.81 * J[2], atol=1e-12)


@pytest.mark.parametrize(
    ("payload", "word"),
    [
        (-1.0, "mass of payload is -1"),
        ([1.0, 0.0], "shape of payload"),
        ([1.0, 0, 0, np.nan], "payload"),
        ([1.0, 0, 0, 80.0], r"centre of payload is \[0.0, 0.0, 80.0\].*are these millimetres"),
        ([1.0, 0, 0, 0, 1, 0, 0, 1, 0, -1], "smallest principal inertia of payload"),
        ("heavy", "payload"),
    ],
)
def test_impossible_payloads_are_refused(payload: Any, word: str) -> None:
    robot = oc.Robot.planar([1, 1], [1, 1])
    makers: list[Callable[[ArrayLike], object]] = [robot.with_payload, lambda p: oc.control.RunTimeModel(payload=p)]
    for make in makers:
        with pytest.raises(InvalidValueError, match=word):
            make(payload)
