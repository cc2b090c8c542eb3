"""What a new user types first: it works, or the error names what serves."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from programs import output_of

import orthocas as oc
from orthocas.errors import InvalidValueError, OrthocasError
from orthocas.robots.collisions import Collisions
from orthocas.tools.display import GUESSES


@pytest.fixture(scope="module")
def chart() -> oc.Chart:
    return oc.load("panda-wide")


@pytest.fixture(scope="module")
def q(chart: oc.Chart) -> Any:
    return chart.domain.sample(1, seed=3)[0]


def _reference(chart: oc.Chart, q: Any) -> pin.SE3:
    """The tip's pose as Pinocchio's object."""
    return pin.SE3(np.asarray(chart.robot.tip_rotation(q)), np.asarray(chart.robot.tip_position(q)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "as_held",
    [
        lambda T: T.homogeneous,
        lambda T: T,
        lambda T: (T.translation, T.rotation),
        lambda T: (T.translation, np.roll(pin.Quaternion(T.rotation).coeffs(), 1)),
        lambda T: [T],
        lambda T: T.homogeneous[None],
    ],
    ids=["matrix", "SE3", "position and matrix", "position and quaternion", "list", "matrices"],
)
def test_targets_as_people_hold_them(chart: oc.Chart, q: Any, as_held: Callable[[pin.SE3], Any]) -> None:
    target = as_held(_reference(chart, q))
    for found in (
        chart.solve(x=target, xi=chart.xi(q)),
        chart.solve(x=target, xi=float(chart.xi(q)[0]), q_start=q),
        chart.nearest_xi(q, target),
    ):
        assert found.found.all()
        np.testing.assert_allclose(chart.robot.pose(found.q[0]), _reference(chart, q).homogeneous, atol=1e-8)


def test_many_xi_for_one_pose(chart: oc.Chart, q: Any) -> None:
    reach = chart.xi_range(q)
    xi = np.linspace(reach.low, reach.high, 7)[1:-1]
    found = chart.solve(x=chart.robot.pose(q), xi=xi, q_start=q)
    assert found.found.all()
    np.testing.assert_allclose(chart.xi(found.q), xi, atol=1e-8)
    np.testing.assert_allclose(chart.robot.pose(found.q), np.tile(chart.robot.pose(q), (5, 1, 1)), atol=1e-8)


@pytest.mark.parametrize("given", [{}, {"x": np.eye(4)}, {"xi": 0.1}, {"phi": np.zeros(7), "xi": 0.1}])
def test_half_a_target_says_what_is_missing(chart: oc.Chart, given: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match=r"expected phi, or x and xi; `nearest_xi` takes x and a posture"):
        chart.solve(**given)


def test_a_position_takes_the_position_of_a_pose() -> None:
    chart = oc.load("panda-position")
    q = chart.domain.centre
    np.testing.assert_allclose(chart.task.target(chart.robot.pose(q)), chart.x(q), atol=1e-14)


@pytest.mark.parametrize(
    "bad", [np.ones((4, 4)), 2 * np.eye(4), (np.zeros(3), np.zeros(4)), (np.zeros(3), np.full((3, 3), np.nan))]
)
def test_what_is_no_pose(chart: oc.Chart, bad: Any) -> None:
    with pytest.raises(oc.errors.OrthocasError):
        chart.solve(x=bad, xi=0.0)


def test_parts_of_a_chart(chart: oc.Chart, q: Any) -> None:
    assert chart.robot is chart.problem.robot
    assert chart.domain is chart.problem.domain
    assert chart.task is chart.problem.task
    assert chart.robot.jacobian(q).shape == (6, 7)
    np.testing.assert_array_equal(chart.x(q), chart.task(q))
    assert chart.domain.contains(chart.domain.sample(50, seed=1)).all()
    postures = chart.robot.sample(50, seed=1)
    assert ((postures >= chart.robot.lower) & (postures <= chart.robot.upper)).all()


def test_manipulability_is_the_volume_of_the_task_jacobian(chart: oc.Chart, q: Any) -> None:
    J = chart.robot.jacobian(q)
    np.testing.assert_allclose(chart.manipulability(q), np.sqrt(np.linalg.det(J @ J.T)), rtol=1e-9)
    function = chart.function("manipulability")
    np.testing.assert_allclose(float(function(q)), chart.manipulability(q), rtol=1e-9)
    gradient, step = np.array(function.jacobian()(q, 0)).ravel(), 1e-6 * np.eye(chart.n)
    differences = (chart.manipulability(q + step) - chart.manipulability(q - step)) / 2e-6
    np.testing.assert_allclose(gradient, differences, rtol=1e-5, atol=1e-7)


def test_the_gradient_of_the_manipulability_matches_differences_along_joints_and_along_xi(
    chart: oc.Chart, q: Any
) -> None:
    step = 1e-5
    pairs = [[q + sign * step * e for sign in (-1, 1)] for e in np.eye(7)]
    differences = [np.diff(chart.manipulability(pair))[0] / (2 * step) for pair in pairs]
    np.testing.assert_allclose(chart.manipulability_gradient(q), differences, atol=1e-8)
    along = chart.phi(q) + np.outer([-step, step], np.eye(7)[-1])
    ends = chart.inverse(along, q)
    slope = np.diff(chart.manipulability(ends))[0] / (2 * step)
    np.testing.assert_allclose(chart.manipulability_gradient(q, along="xi"), [slope], atol=1e-6)
    both = chart.manipulability_gradient(np.array([q, ends[0]]), along="xi")
    assert both.shape == (2, 1)
    with pytest.raises(InvalidValueError, match="'q' or 'xi'"):
        chart.manipulability_gradient(q, along="x")


def test_laws_have_default_gains(chart: oc.Chart) -> None:
    law = oc.control.PDPlus(chart)
    np.testing.assert_array_equal(law.stiffness, oc.control.PDPlus.on_chart(chart).stiffness)
    with pytest.raises(InvalidValueError, match=r"use Safety\.of\(law\)"):
        oc.control.Safety()


def test_fit_takes_a_robot_and_a_task() -> None:
    problem = oc.problems.get("planar_3r_xy")
    robot, q = problem.robot, np.array([0.7, 0.9, 0.6])
    chart = oc.fit(
        robot, oc.Task.position(robot, "xy"), parametrisation=oc.Linear(), metric=problem.metric, domain=problem.domain
    ).chart
    np.testing.assert_array_equal(chart.xi(q), oc.fit(problem, oc.Linear()).chart.xi(q))
    with pytest.raises(InvalidValueError, match="no task or second family"):
        oc.fit(problem, problem.task)


def test_poses_in_a_file(chart: oc.Chart, q: Any, tmp_path: Path) -> None:
    from orthocas.paths.tool_path import read_path

    T, rows = _reference(chart, q), ["x,y,z,qw,qx,qy,qz"]
    w = np.roll(pin.Quaternion(T.rotation).coeffs(), 1)
    rows += [",".join(f"{value:.6f}" for value in [*T.translation, *w])] * 2
    (tmp_path / "path.csv").write_text("\n".join(rows))
    x, xi = read_path(tmp_path / "path.csv", chart)
    assert xi is None
    np.testing.assert_allclose(x, np.tile(chart.x(q), (2, 1)), atol=5e-6)


@pytest.mark.parametrize("name", sorted(GUESSES["orthocas"]))
def test_guesses_of_the_package(name: str) -> None:
    with pytest.raises(AttributeError, match=rf"no attribute '{name}': use "):
        getattr(oc, name)


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in ("Robot", "Chart") for name in sorted(GUESSES[kind])]
)
def test_guesses_of_objects(chart: oc.Chart, kind: str, name: str) -> None:
    owner = chart if kind == "Chart" else chart.robot
    with pytest.raises(AttributeError, match=rf"no attribute '{name}': use "):
        getattr(owner, name)
    assert not hasattr(owner, name)


def test_what_is_suggested_exists(chart: oc.Chart) -> None:
    owners = {"oc": oc, "chart": chart, "robot": chart.robot, "law": oc.control.PDPlus(chart)}
    for table in GUESSES.values():
        for words in table.values():
            for owner, path in re.findall(r"\b(oc|chart|robot)\.([\w.]+)", words):
                value: Any = owners[owner]
                for part in path.rstrip(".").split("."):
                    # a robot of a chart file may have no solids
                    value = Collisions if part == "collisions" else getattr(value, part)


@pytest.mark.slow
@pytest.mark.parametrize("words", [("evaluate", "--samples", "200"), ("info",)])
def test_commands_take_names_of_ready_charts(words: tuple[str, ...], tmp_path: Path) -> None:
    command = Path(sys.executable).with_name("orthocas")
    assert "xi1" in output_of(command, words[0], "panda-wide", *words[1:], folder=tmp_path)


#: first lines of users of roboticstoolbox, Pinocchio, pink, mink, ikpy, pybotics and MATLAB, written before looking
FIRST_CALLS = """
oc.Robot("panda") oc.Robot.from_urdf("panda") oc.load("panda") oc.load_robot_description("panda_description")
oc.models oc.Manipulator oc.RobotWrapper oc.buildModelFromUrdf("panda.urdf") oc.Configuration(robot,q)
oc.Solver(robot) oc.IK(robot) oc.solve_ik(chart,[],0.01) oc.PostureTask() oc.ComTask() oc.NullspaceTask()
oc.DampingTask() oc.limits oc.barriers oc.integrate(q,q,0.1) oc.self_motion(chart,q) oc.xi_range(chart,q)
oc.animate(chart) oc.export_c(chart) oc.save(chart) oc.Sphere([0,0,0],1) oc.Obstacle oc.Trajectory() oc.fit("panda")
oc.fit(robot) oc.fit(robot,"pose") oc.fit_wide(robot,"pose") robot.fkine(q) robot.forward(q)
robot.frame_pose(q,"hand") robot.get_transform("hand") robot.jacobe(q) robot.hessian0(q)
robot.computeJointJacobians(q) robot.ikine_LM(q) robot.ik_LM(q) robot.solve(q) robot.gravload(q) robot.inertia_x(q)
robot.links robot.link_names robot.ee_links robot.tip robot.base robot.tool robot.qr robot.qz robot.vellim
robot.teach() robot.plot(q) robot.kinetic_energy(q,q) robot.self_collision(q) robot.in_collision(q) robot.distance(q)
robot.model robot.name chart.solve(T) chart.solve(T,q) chart.solve(T,0.1) chart.solve(T,xi=0.1) chart.solutions(T)
chart.ik_all(T) chart.solve_all(T) chart.nullspace_basis(q) chart.projector(q) chart.redundancy chart.arm_angle(q)
chart.swivel(q) chart.elbow(q) chart.xi_limits(q) chart.bounds chart.names chart.dof chart.pose(q) chart.jac(q)
chart.jacobian_xi(q) chart.velocity(q,q) chart.rates(q,q) chart.to_casadi() chart.to_c("x") chart.to_torch()
chart.plan(q,q) chart.path(q,q) chart.step(T) chart.controller() chart.info() chart.summary() chart.report()
chart.is_valid(q) chart.contains(q) chart.branch(q) law.step(q,q) law.torque(q,q) law.compute(q,q) law.update(q,q)
law.simulate() law.codegen()
"""


@pytest.mark.parametrize("call", FIRST_CALLS.split())
def test_first_calls_of_users_of_other_packages(chart: oc.Chart, q: Any, call: str) -> None:
    """They work, or the message names what serves: something of the package, the chart, the robot or the law."""
    known = {
        "oc": oc,
        "chart": chart,
        "robot": chart.robot,
        "q": q,
        "T": chart.robot.pose(q),
        "law": oc.control.Kinematic(chart),
    }
    try:
        eval(call, known)
    except (AttributeError, OrthocasError) as error:
        words = str(error)
        assert re.search(r"\b(oc|chart|robot|law|Robot)\.\w|solve\(x=|nearest_xi|known: |q \+ dq|print\(|dq @", words)
