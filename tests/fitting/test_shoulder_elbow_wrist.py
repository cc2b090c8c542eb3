"""SEW angles: against the geometry of Pinocchio's joint axes, along self-motions, near their singularities."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.bases.given import SEW_KINDS, sew_angle
from orthocas.errors import RobotError, UnknownNameError
from orthocas.problems import CENTRE, iiwa_robot, urdf_path
from orthocas.robots import pinocchio_model, urdf

Z = np.array([0.0, 0.0, 1.0])


def iiwa_model() -> pin.Model:
    with urdf_path() as path:
        return urdf.read_urdf(path)[0]


def panda_model() -> pin.Model:
    return pinocchio_model.lock_off_chain(
        urdf.read_urdf(robot_data("panda_description/urdf/panda.urdf"))[0], "panda_hand"
    )


def changed(robot: oc.Robot, **changes: Any) -> oc.Robot:
    return oc.Robot(replace(robot.tree, **changes))


def angle_about(axis: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Right-handed angle about a unit axis from the half-plane of first to that of second."""
    a, b = (v - axis * (axis @ v) for v in (first, second))
    return float(np.arctan2(axis @ np.cross(a, b), a @ b))


def difference(a: Any, b: Any) -> np.ndarray:
    """a - b modulo a full turn."""
    return np.asarray(np.angle(np.exp(1j * (np.asarray(a, dtype=float) - np.asarray(b, dtype=float)))))


def gradient_of(psi: ca.Function) -> Callable[[np.ndarray], np.ndarray]:
    q = ca.SX.sym("q", 7)
    gradient = ca.Function("gradient", [q], [ca.gradient(psi(q), q)])
    return lambda at: np.array(gradient(at)).ravel()


def meeting_point(axes: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The point nearest to some lines (point, direction), which has to lie on all of them."""
    across = [np.eye(3) - np.outer(d, d) for _, d in axes]
    point = np.linalg.solve(sum(across), sum(A @ p for A, (p, _) in zip(across, axes, strict=True)))
    for A, (p, _) in zip(across, axes, strict=True):
        assert np.linalg.norm(A @ (point - p)) < 1e-9
    return point


def points_from_pinocchio(model: pin.Model, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """S, E, W from the joint axes in the world: a column (p x d, d) of the Jacobian is the line through p along d."""
    J = pin.computeJointJacobians(model, model.createData(), q)
    axes = [(np.cross(d, moment), d) for moment, d in zip(J[:3].T, J[3:].T, strict=True)]
    (p3, d3), (p4, d4) = axes[2:4]
    normal = np.cross(d3, d4)
    on_4 = np.linalg.solve(np.column_stack([d3, normal, -d4]), p4 - p3)[2]
    return meeting_point(axes[:3]), p4 + on_4 * d4, meeting_point(axes[4:6])


def reference_direction(kind: str, e_SW: np.ndarray) -> np.ndarray:
    """Where psi = 0: up, or -x carried from the zenith to e_SW by the shortest rotation."""
    return Z if kind == "conventional" else pin.Quaternion.FromTwoVectors(Z, e_SW).matrix()[:, 0] * -1


@pytest.mark.parametrize("kind", SEW_KINDS)
@pytest.mark.parametrize(
    ("build", "tip"), [(iiwa_model, "link_ee"), (panda_model, "panda_hand")], ids=["iiwa", "panda"]
)
def test_angle_is_that_between_the_half_planes_of_elbow_and_reference(
    build: Callable[[], pin.Model], tip: str, kind: str
) -> None:
    model = build()
    psi = sew_angle(oc.Robot.from_model(model, tip), kind)
    for q in np.random.default_rng(7).uniform(-2, 2, (50, 7)):
        S, E, W = points_from_pinocchio(model, q)
        e_SW = (W - S) / np.linalg.norm(W - S)
        want = angle_about(e_SW, reference_direction(kind, e_SW), E - S)
        assert abs(difference(psi(q), want)) < 1e-9


@pytest.mark.parametrize("kind", SEW_KINDS)
def test_self_motion_turns_the_elbow_and_the_angle_alike(kind: str) -> None:
    """Runge-Kutta along the null vector of the pose Jacobian of the iiwa; the elbow turns by more than a radian."""
    model, robot = iiwa_model(), iiwa_robot()
    q = start = np.array(CENTRE) + 0.3
    previous = np.eye(7)[0]
    for _ in range(60):
        slopes: list[np.ndarray] = []
        for fraction in (0.0, 0.5, 0.5, 1.0):
            at = q + 0.03 * fraction * slopes[-1] if slopes else q
            null = np.linalg.svd(robot.tip_jacobian(at))[2][-1]
            slopes.append(null * np.sign(null @ previous))
        previous = slopes[0]
        q = q + 0.03 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3]) / 6
    (S, E, W), (_, E_end, W_end) = points_from_pinocchio(model, start), points_from_pinocchio(model, q)
    np.testing.assert_allclose(robot.tip_rotation(q), robot.tip_rotation(start), atol=1e-6)
    np.testing.assert_allclose(W_end, W, atol=1e-6)  # Runge-Kutta's error
    turn = angle_about((W - S) / np.linalg.norm(W - S), E - S, E_end - S)
    assert abs(turn) > 1
    psi = sew_angle(robot, kind)
    assert abs(difference(psi(q) - psi(start), turn)) < 1e-5


@pytest.mark.parametrize("kind", SEW_KINDS)
@pytest.mark.parametrize("name", ["iiwa", "panda"])
def test_gradient_matches_central_differences(name: str, kind: str) -> None:
    robot = iiwa_robot() if name == "iiwa" else oc.Robot.from_model(panda_model(), "panda_hand")
    psi, step = sew_angle(robot, kind), 1e-6
    gradient = gradient_of(psi)
    for q in np.random.default_rng(7).uniform(-1.5, 1.5, (10, 7)):
        want = [float(difference(psi(q + step * e), psi(q - step * e)).item()) / (2 * step) for e in np.eye(7)]
        got = gradient(q)
        np.testing.assert_allclose(got, want, atol=1e-7 * max(1, np.abs(got).max() ** 3))  # third derivative
        assert not got[5:].any()


@pytest.mark.parametrize(
    ("kind", "below", "singular"),
    [
        ("conventional", False, True),
        ("conventional", True, True),
        ("stereographic", False, False),
        ("stereographic", True, True),
    ],
)
def test_stereographic_angle_is_singular_on_the_lower_half_line_only(kind: str, below: bool, singular: bool) -> None:
    """The iiwa's wrist straight above or below its shoulder (q2 = -q4 / 2 off the vertical), then moved off by A3."""
    straight = np.array([0.4, (np.pi if below else 0) - 0.5, 0, -1.0, 0.3, 0.6, 0])
    S, _, W = points_from_pinocchio(iiwa_model(), straight)
    np.testing.assert_allclose((W - S) / np.linalg.norm(W - S), -Z if below else Z, atol=1e-12)
    gradient = gradient_of(sew_angle(iiwa_robot(), kind))
    far, near = (np.linalg.norm(gradient(straight + off * np.eye(7)[2])) for off in (1e-3, 1e-5))
    if singular:
        assert near / far == pytest.approx(100, rel=0.01)  # like 1 / distance
        assert far > 100
    else:
        assert near == pytest.approx(far, rel=0.01)
        assert far < 10


@pytest.mark.parametrize("kind", SEW_KINDS)
def test_elbow_up_reaching_forward_is_the_zero(kind: str) -> None:
    """So that the jump at +-pi is far from the centre of the iiwa problem."""
    assert float(sew_angle(iiwa_robot(), kind)(CENTRE)) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("kind", SEW_KINDS)
def test_angle_does_not_depend_on_where_frames_sit_on_their_axes(kind: str) -> None:
    robot = iiwa_robot()
    shifts = np.random.default_rng(7).uniform(-0.2, 0.2, 7)
    translations = robot.tree.translations.copy()
    for i, shift in enumerate(shifts):
        translations[i] += robot.tree.rotations[i][:, 2] * shift
        if i < 6:
            translations[i + 1, 2] -= shift
    q = np.random.default_rng(8).uniform(-2, 2, 7)
    moved = changed(robot, translations=translations)
    assert float(sew_angle(moved, kind)(q)) == pytest.approx(float(sew_angle(robot, kind)(q)), abs=1e-12)


def test_function_is_a_dense_sx_function_of_seven_joints() -> None:
    psi = sew_angle(iiwa_robot(), "stereographic")
    assert psi.name() == "sew_angle"
    assert (psi.name_in(), psi.name_out()) == (["q"], ["out"])
    assert (psi.size_in(0), psi.size_out(0)) == ((7, 1), (1, 1))
    assert psi.is_a("SXFunction")
    assert psi.sparsity_out(0).is_dense()


def test_robots_without_shoulder_elbow_and_wrist_are_refused() -> None:
    iiwa = iiwa_robot()
    with pytest.raises(UnknownNameError, match="unknown SEW angle 'swivel', known: conventional, stereographic"):
        sew_angle(iiwa, "swivel")
    with pytest.raises(RobotError, match="the robot has 3 joints, expected 7"):
        sew_angle(oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0]), "conventional")
    with pytest.raises(RobotError, match="axes of joints 'q1' and 'q2' are parallel"):
        sew_angle(oc.Robot.planar([1.0] * 7, [1.0] * 7), "conventional")
    kinds = ("revolute",) * 4 + ("prismatic",) + ("revolute",) * 2
    with pytest.raises(RobotError, match="joint 'A5' is prismatic, expected 7 revolute joints"):
        sew_angle(changed(iiwa, joint_kinds=kinds), "conventional")
    with pytest.raises(RobotError, match="joint 'A7' does not follow joint 'A6'"):
        sew_angle(changed(iiwa, parents=(-1, 0, 1, 2, 3, 4, 4)), "conventional")


def foot(line: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The point of a line (point, direction) that is nearest to another one."""
    (p, d), (o, e) = line, other
    return p + np.linalg.solve(np.column_stack([d, np.cross(d, e), -e]), o - p)[0] * d


@pytest.mark.parametrize("kind", SEW_KINDS)
def test_points_of_axes_that_pass_each_other_are_ends_of_common_normals(kind: str) -> None:
    """A Baxter: axes 1 and 2 pass at 69 mm, and so do 5 and 6, at 10 mm."""
    full = urdf.read_urdf(robot_data("baxter_description/urdf/baxter.urdf"))[0]
    model = pinocchio_model.lock_off_chain(full, "left_gripper")
    psi = sew_angle(oc.Robot.from_model(model, "left_gripper"), kind)
    for q in np.random.default_rng(7).uniform(-1.5, 1.5, (20, 7)):
        J = pin.computeJointJacobians(model, model.createData(), q)
        axes = [(np.cross(d, moment), d) for moment, d in zip(J[:3].T, J[3:].T, strict=True)]
        S, E, W = (foot(axes[k], axes[other]) for k, other in ((1, 2), (3, 2), (5, 4)))
        e_SW = (W - S) / np.linalg.norm(W - S)
        assert abs(difference(psi(q), angle_about(e_SW, reference_direction(kind, e_SW), E - S))) < 1e-9


def test_points_change_steadily_where_axes_part() -> None:
    """An iiwa whose axes pass at a tenth of a millimetre has nearly the angle of one whose axes meet."""
    iiwa = iiwa_robot()
    for joint, way in ((2, Z), (5, np.cross(iiwa.tree.rotations[5][:, 2], Z))):
        apart = iiwa.tree.translations.copy()
        apart[joint] += 1e-4 * way
        changed_psi, psi = (sew_angle(arm, "conventional") for arm in (changed(iiwa, translations=apart), iiwa))
        for q in np.random.default_rng(7).uniform(-1, 1, (10, 7)) + CENTRE:
            assert abs(difference(changed_psi(q), psi(q))) < 5e-3
