"""XiTask: error and Jacobian in the models of Pinocchio and MuJoCo, and the solvers of pink and mink with it."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data
from public_objects import circle, ring

import orthocas as oc
from orthocas import problems
from orthocas.control import XiTask
from orthocas.errors import InvalidValueError, NoExpressionError, ShapeError
from orthocas.simulation import Elasticity, MuJoCoPlant
from orthocas.tools.checks import Array

FINGERS = 2


def panda() -> tuple[oc.Chart, pin.Model]:
    """A chart of the arm, and Pinocchio's model with the fingers."""
    return oc.charts.load("panda-position"), pin.buildModelFromUrdf(
        str(robot_data("panda_description/urdf/panda.urdf"))
    )


def at_home(chart: oc.Chart) -> Array:
    return np.concatenate([chart.problem.domain.centre, np.full(FINGERS, 0.02)])


def test_jacobian_is_the_derivative_of_the_error_in_the_models_tangent_space() -> None:
    chart, model = panda()
    task, q = XiTask(chart, 1.0), at_home(chart)
    task.set_target(chart.xi(chart.problem.domain.centre) + 0.1)
    np.testing.assert_allclose(task.compute_error(SimpleNamespace(model=model, q=q)), -0.1, atol=1e-12)
    J, step = task.compute_jacobian(SimpleNamespace(model=model, q=q)), 1e-6
    for k in range(model.nv):
        sides = [
            task.compute_error(
                SimpleNamespace(model=model, q=pin.integrate(model, q, sign * step * np.eye(model.nv)[k]))
            )
            for sign in (1, -1)
        ]
        np.testing.assert_allclose((sides[0] - sides[1]) / (2 * step), J[:, k], atol=1e-8)


def test_joints_of_other_names_and_places_are_found_in_mujoco() -> None:
    chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(2), samples=300).chart
    joints = "".join(f'<body pos="1 0 0"><joint name="arm/{k}" axis="0 0 1"/><geom size=".1"/>' for k in range(chart.n))
    bodies = f'<body><freejoint/><geom size=".1"/>{joints}{"</body>" * (chart.n + 1)}'
    text = f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    q = np.concatenate([np.zeros(3), [1, 0, 0, 0], chart.problem.domain.centre])
    task = XiTask(chart, 2.0, joints=tuple(f"arm/{k}" for k in range(chart.n)))
    configuration = SimpleNamespace(model=model, q=q)
    task.set_target_from_configuration(configuration)
    np.testing.assert_array_equal(task.compute_error(configuration), 0.0)
    J = task.compute_jacobian(configuration)
    np.testing.assert_array_equal(J[:, :6], 0.0)
    np.testing.assert_allclose(J[:, 6:], chart.jacobian(chart.problem.domain.centre)[chart.m :], atol=1e-14)
    with pytest.raises(InvalidValueError, match="without a joint 'q1', expected one of .*arm/0, arm/1"):
        XiTask(chart, 1.0).compute_jacobian(configuration)


@pytest.mark.parametrize("elasticity", [None, Elasticity(stiffness=1e4, inertia=0.1)], ids=["rigid", "elastic"])
def test_joints_are_found_in_the_model_of_the_packages_own_plant(elasticity: Elasticity | None) -> None:
    """Without names given: MuJoCo integrates a velocity, and the error changes as the Jacobian says."""
    chart, _ = panda()
    plant = MuJoCoPlant(chart.problem.robot, elasticity=elasticity)
    model = plant.model
    joints = [model.joint(name) for name in chart.problem.robot.joint_names]
    q, velocity, step = np.zeros(model.nq), np.zeros(model.nv), 1e-6
    q[[joint.qposadr[0] for joint in joints]] = chart.problem.domain.centre
    velocity[[joint.dofadr[0] for joint in joints]] = np.random.default_rng(2).normal(size=chart.n)
    task = XiTask(chart, 1.0)
    task.set_target_from_configuration(SimpleNamespace(model=model, q=q))
    moved = q.copy()
    mujoco.mj_integratePos(model, moved, velocity, step)
    J = task.compute_jacobian(SimpleNamespace(model=model, q=q))
    error = task.compute_error(SimpleNamespace(model=model, q=moved))
    np.testing.assert_allclose(error / step, J @ velocity, atol=1e-4)
    assert np.abs(J @ velocity).max() > 0.1


def test_joints_without_end_and_circles_take_the_shorter_way() -> None:
    """Pinocchio stores continuous joints as cosine and sine; a coordinate of 2 pi less a little is as good as -that."""
    chart, model = ring(), pin.Model()
    for k, name in enumerate(chart.problem.robot.joint_names):
        model.addJoint(k, pin.JointModelRUBZ(), pin.SE3.Identity(), name)
    task, angles = XiTask(chart, 1.0), np.array([3.0, -2.0])
    task.set_target(chart.xi(angles) + 2 * np.pi - 0.1)
    configuration = SimpleNamespace(model=model, q=np.stack([np.cos(angles), np.sin(angles)], axis=1).ravel())
    np.testing.assert_allclose(task.compute_error(configuration), 0.1, atol=1e-12)


def test_objective_is_that_of_the_residual() -> None:
    chart, model = panda()
    task = XiTask(chart, 0.5, gain=0.3, lm_damping=0.1)
    task.set_target(chart.xi(chart.problem.domain.centre) + 0.1)
    configuration = SimpleNamespace(model=model, q=at_home(chart))
    H, c = task.compute_qp_objective(configuration)
    J, e = task.compute_jacobian(configuration), task.compute_error(configuration)
    dq = np.random.default_rng(0).normal(size=model.nv)
    found = dq @ H @ dq / 2 + c @ dq
    want = 0.125 * ((J @ dq + 0.3 * e) ** 2).sum() - 0.125 * (0.09 * e @ e) + 0.05 * 0.0225 * (e @ e) * (dq @ dq)
    assert found == pytest.approx(want, rel=1e-12)


def kept(solve: Any, chart: oc.Chart, start: Array) -> tuple[float, float]:
    """Largest errors of the tool [m] and of xi on a small circle of the tool."""
    errors = []
    for angle in np.linspace(0, 2 * np.pi, 101)[1:]:
        shift = 0.05 * np.array([np.cos(angle) - 1, np.sin(angle), 0.0])
        q = solve(shift)
        errors.append(
            (
                np.abs(chart.x(q)[:3] - chart.x(start)[:3] - shift).max(),
                np.abs(chart.xi(q) - chart.xi(start)).max(),
            )
        )
    return tuple(np.max(errors, axis=0))  # type: ignore[return-value]


@pytest.mark.slow
def test_pink_meets_tool_and_xi_together() -> None:
    pink = pytest.importorskip("pink", reason="pink is in the extra `peers`")
    chart, model = panda()
    q = at_home(chart)
    configuration = pink.Configuration(model, model.createData(), q)
    tip = pink.tasks.FrameTask("panda_hand", position_cost=1.0, orientation_cost=0.0)
    task = XiTask(chart, 0.1)
    task.set_target_from_configuration(configuration)
    home = configuration.get_transform_frame_to_world(tip.frame).copy()

    def solve(shift: Array) -> Array:
        tip.set_target(pin.SE3(home.rotation, home.translation + shift))
        for _ in range(10):
            velocity = pink.solve_ik(configuration, [tip, task], 1.0, "daqp", damping=1e-12, limits=())
            configuration.integrate_inplace(velocity, 1.0)
        return np.asarray(configuration.q[: chart.n])

    tool, xi = kept(solve, chart, q[: chart.n])
    assert tool < 1e-6
    assert xi < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("others", ["tasks", "constraints"])
def test_mink_meets_tool_and_xi_together_as_a_constraint_too(others: str) -> None:
    mink = pytest.importorskip("mink", reason="mink is in the extra `peers`")
    chart, _ = panda()
    model, q = MuJoCoPlant(chart.problem.robot).model, chart.problem.domain.centre
    configuration = mink.Configuration(model, q)
    tip = mink.FrameTask("tip", "body", position_cost=1.0, orientation_cost=0.0)
    task = XiTask(chart, 0.1)
    task.set_target_from_configuration(configuration)
    home = configuration.get_transform_frame_to_world("tip", "body").as_matrix()

    def solve(shift: Array) -> Array:
        target = home.copy()
        target[:3, 3] += shift
        tip.set_target(mink.SE3.from_matrix(target))
        for _ in range(10):
            lists = {"tasks": [tip, task]} if others == "tasks" else {"tasks": [tip], "constraints": [task]}
            velocity = mink.solve_ik(configuration, **lists, dt=1.0, solver="daqp", limits=[])
            configuration.integrate_inplace(velocity, 1.0)
        return np.asarray(configuration.q)

    tool, xi = kept(solve, chart, q)
    assert tool < 1e-6
    assert xi < 1e-6


def test_what_is_wrong_is_named() -> None:
    chart, _ = panda()
    with pytest.raises(NoExpressionError):
        XiTask(circle(), 1.0)
    with pytest.raises(InvalidValueError, match="gain"):
        XiTask(chart, 1.0, gain=1.5)
    with pytest.raises(ShapeError, match="joints"):
        XiTask(chart, 1.0, joints=("a",))
    task, configuration = XiTask(chart, 1.0), SimpleNamespace(model=pin.Model(), q=np.zeros(0))
    with pytest.raises(InvalidValueError, match="target of the task is none"):
        task.compute_error(configuration)
    with pytest.raises(ShapeError):
        task.set_target(np.zeros(9))
    task.set_target(np.zeros(chart.r))
    with pytest.raises(InvalidValueError, match="without a joint 'panda_joint1'"):
        task.compute_error(configuration)
