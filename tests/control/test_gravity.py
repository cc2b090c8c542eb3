"""Gravity in the axes of the base: dynamics, laws, C, runs, MuJoCo and chart files, against Pinocchio."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import Run, arm, robot_data
from programs import needs_c

import orthocas as oc
from orthocas.cli.options import ProblemOptions
from orthocas.codegen import CompiledLibrary, compile_shared
from orthocas.control import PDPlus, Reference
from orthocas.errors import InvalidValueError, OptionError, RobotError, ShapeError
from orthocas.tools.checks import Array

PANDA = "panda_description/urdf/panda.urdf"
WALL = np.array([9.2, -1.5, 3.0])  # [m/s^2]
HOME = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8])


@pytest.fixture(scope="module")
def model() -> pin.Model:
    """Pinocchio's panda on the wall, the reference."""
    found, _ = arm("panda")
    found.gravity.linear = WALL
    return found


@pytest.fixture(scope="module")
def robot() -> oc.Robot:
    return oc.Robot.from_urdf(robot_data(PANDA), "panda_hand", gravity=WALL)


@pytest.fixture(scope="module")
def chart(robot: oc.Robot, tmp_path_factory: pytest.TempPathFactory) -> oc.Chart:
    """Saved and loaded."""
    problem = oc.Problem(robot, oc.Task.position(robot), domain=oc.Box(HOME, 0.3))
    path = tmp_path_factory.mktemp("gravity") / "wall.orthocas"
    oc.fit(problem, oc.Polynomial(1)).chart.save(path)
    return oc.load(path)


def torques(model: pin.Model, q: Array) -> Array:
    return np.asarray(pin.computeGeneralizedGravity(model, model.createData(), q))


def test_dynamics_are_pinocchios(robot: oc.Robot, model: pin.Model) -> None:
    data = model.createData()
    for q, dq, ddq in np.random.default_rng(7).uniform(-1, 1, (5, 3, 7)):
        np.testing.assert_allclose(robot.gravity(q), torques(model, q), atol=1e-10)
        np.testing.assert_allclose(robot.bias(q, dq), pin.nonLinearEffects(model, data, q, dq), atol=1e-10)
        np.testing.assert_allclose(robot.inverse_dynamics(q, dq, ddq), pin.rnea(model, data, q, dq, ddq), atol=1e-10)
        np.testing.assert_allclose(robot.forward_dynamics(q, dq, ddq), pin.aba(model, data, q, dq, ddq), atol=1e-8)


def test_every_way_to_a_robot_takes_it_and_keeps_it(model: pin.Model, tmp_path: Path) -> None:
    file = robot_data(PANDA)
    plain = oc.Robot.from_model(model, "panda_hand", gravity=[0, 0, -9.81])
    np.testing.assert_array_equal(plain.tree.gravity, oc.Robot.from_urdf(file).tree.gravity)
    tooled = oc.Robot.from_file(file, "panda_hand", tool=[0, 0, 0.1], gravity=WALL).with_payload(2.0)
    for found in (tooled, plain.with_gravity(WALL), oc.Robot.from_urdf(file, base="rail:x", gravity=WALL)):
        np.testing.assert_array_equal(found.tree.gravity, WALL)


def test_mjcf_files_have_their_own_unless_another_is_given() -> None:
    pytest.importorskip("mujoco", reason="the extra orthocas[mujoco] is not installed")
    import mujoco

    text = """<mujoco><option gravity="0 0 -1.62"/><worldbody><body><joint name="j" axis="0 1 0"/>
    <geom size="0.1" pos="1 0 0" mass="2"/></body></worldbody></mujoco>"""
    compiled = mujoco.MjModel.from_xml_string(text)
    assert oc.Robot.from_mjcf(compiled).gravity([0.0]) == pytest.approx([-2 * 1.62])
    assert oc.Robot.from_mjcf(compiled, gravity=[0, 0, 3.7]).gravity([0.0]) == pytest.approx([2 * 3.7])


def test_charts_keep_it_and_laws_at_rest_command_it(chart: oc.Chart, model: pin.Model) -> None:
    law = PDPlus(chart, 50.0)
    q = HOME + 0.1
    phi = chart.phi(q)
    command, status = law.function(q, np.zeros(7), phi, np.zeros(7), np.zeros(7), *law.gains.values())
    assert int(status) == 0
    np.testing.assert_allclose(command.full().ravel(), torques(model, q), atol=1e-9)


@needs_c
@pytest.mark.slow
def test_c_has_it(chart: oc.Chart, model: pin.Model, tmp_path: Path) -> None:
    generated = oc.generate_c(chart, tmp_path, None, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 7)
    for q in HOME + np.random.default_rng(7).uniform(-0.3, 0.3, (10, 7)):
        _, _, gravity, _ = library.dynamics(q, np.zeros(7))
        np.testing.assert_allclose(gravity, torques(model, q), atol=1e-10)


def test_mujoco_holds_an_arm_by_its_torque(robot: oc.Robot, model: pin.Model) -> None:
    pytest.importorskip("mujoco", minversion="4", reason="the extra orthocas[mujoco] is not installed")
    plant = oc.simulation.MuJoCoPlant(robot, effort_limits=False)
    plant.reset(HOME)
    plant.step(torques(model, HOME), 1e-3)
    assert np.abs(plant.acceleration).max() < 1e-8
    plant.reset(HOME)
    plant.step(np.zeros(7), 1e-3)
    fall = pin.aba(model, model.createData(), plant.q, plant.dq, np.zeros(7))
    np.testing.assert_allclose(plant.acceleration, fall, atol=1e-8 * np.abs(fall).max())


@pytest.mark.slow
def test_simulated_arm_rests_under_it(chart: oc.Chart, robot: oc.Robot) -> None:
    """On a robot that stands upright the same law lets it go: the difference of the torques is 20 N m and more."""
    reference = Reference.steps(chart.labels, chart.phi(HOME), [], 0.3)
    run = oc.simulate(PDPlus(chart, 50.0), reference, HOME)
    np.testing.assert_allclose(run.q[-1], HOME, atol=1e-6)
    upright = oc.simulate(PDPlus(chart, 50.0), reference, HOME, plant=robot.with_gravity([0, 0, -9.81]))
    assert np.abs(upright.q[-1] - HOME).max() > 0.05


def test_what_is_no_gravity_is_refused() -> None:
    file = robot_data(PANDA)
    with pytest.raises(ShapeError, match=r"gravity has shape \(2,\), expected \(3,\)"):
        oc.Robot.from_urdf(file, gravity=[0, -9.81])
    with pytest.raises(InvalidValueError, match="gravity"):
        oc.Robot.from_urdf(file, gravity=[0, 0, np.nan])
    with pytest.raises(RobotError, match="a floating base has no gravity"):
        oc.Robot.from_urdf(file, base="floating", gravity=[0, 0, -9.81])


def test_command_line_takes_it_with_robot_files_only(run: Run) -> None:
    file = str(robot_data(PANDA))
    words = ("fit", file, "--tip", "panda_hand", "--param", "linear", "--samples", "50", "--out", "a.orthocas")
    assert run(*words, "--gravity", "-9.81,0,0")[0] == 0
    assert oc.load("a.orthocas").problem.robot.tree.gravity.tolist() == [-9.81, 0, 0]
    words = (*words, "--force")
    assert run(*words, "--gravity", "9.81")[::2] == (2, "orthocas: gravity has shape (1,), expected (3,)\n")
    message = "the named problem 'iiwa' has its own robot: leave out --gravity"
    assert message in run("fit", "iiwa", "--gravity", "0,0,0")[2]


def test_the_gravity_of_a_law_has_its_own_option(run: Run) -> None:
    code, _, err = run("codegen", "a.orthocas", "--controller", "pd_plus", "--out", "c", "--gravity", "robot")
    assert code == 2
    assert err.startswith("orthocas: no such option: --gravity; ")
    assert "codegen --gravity-compensation law or robot" in err


@pytest.mark.parametrize("words", ["1.5", "1.5,0,0,0.1"])
def test_the_payload_of_the_command_line_is_that_of_the_robot(words: str) -> None:
    file = robot_data(PANDA)
    options = ProblemOptions(tip="panda_hand", payload=words)
    carried = [float(word) for word in words.split(",")]
    expected = oc.Robot.from_urdf(file, tip="panda_hand").with_payload(carried if len(carried) > 1 else carried[0])
    q = np.full(7, 0.3)
    np.testing.assert_array_equal(options.build_robot(str(file)).gravity(q), expected.gravity(q))
    with pytest.raises(OptionError):
        options.require_no_robot("the named problem 'iiwa'")
