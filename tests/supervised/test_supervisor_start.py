"""The check before a start: the torque that holds the arm, against the model's."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import robot_data
from programs import needs_c, nightly

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import Controller, ControlStatus, Kinematic, PDPlus, Reference, Safety
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.simulation import Friction, MuJoCoPlant, StickingPlant
from orthocas.tools.checks import Array

pytestmark = needs_c

MOUNTINGS = {  # of the base in the world, as in <origin rpy="...">, for arms whose model stands upright
    "ceiling": (np.pi, 0.0, 0.0),
    "wall, forwards": (0.0, np.pi / 2, 0.0),
    "wall, sidewards": (np.pi / 2, 0.0, 0.0),
    "tilted by 45 degrees": (0.0, np.pi / 4, 0.0),
    "tilted by 30 degrees": (np.pi / 6, 0.0, 0.0),
}


def mounted(robot: oc.Robot, rpy: tuple[float, float, float]) -> oc.Robot:
    """An upright robot on another mounting."""
    return robot.with_gravity(pin.rpy.rpyToMatrix(*rpy).T @ [0.0, 0.0, -9.81])


@pytest.mark.parametrize("rpy", MOUNTINGS.values(), ids=MOUNTINGS)
def test_gravity_of_a_mounting_is_that_of_a_base_turned_in_its_file(
    rpy: tuple[float, float, float], tmp_path: Path
) -> None:
    """By Pinocchio, from a file in which a fixed joint turns the base."""
    text = robot_data("panda_description/urdf/panda.urdf").read_text()
    words = " ".join(map(str, rpy))
    joint = f'<parent link="world"/><child link="panda_link0"/><origin xyz="0 0 0" rpy="{words}"/>'
    turned = f'<link name="world"/><joint name="mounting" type="fixed">{joint}</joint></robot>'
    (tmp_path / "turned.urdf").write_text(text.replace("</robot>", turned))
    model = pin.buildModelFromUrdf(str(tmp_path / "turned.urdf"))
    robot = oc.Robot.from_file(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
    robot = mounted(robot, rpy)
    for q in np.random.default_rng(7).uniform(-1, 1, (10, robot.n)):
        wanted = pin.computeGeneralizedGravity(model, model.createData(), np.append(q, np.zeros(model.nq - robot.n)))
        np.testing.assert_allclose(robot.gravity(q), wanted[: robot.n], atol=1e-9)


def test_the_check_of_a_start_is_the_torque_less_the_model(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    """At random postures, also outside the domain; just within the bound and just beyond it; nothing is remembered."""
    robot, supervisor = planar_for_control.problem.robot, Supervisor(supervised_library, supervised_law)
    bound = Safety.of(supervised_law).start_mismatch
    supervisor.start(planar_for_control.problem.domain.centre)
    before = bytes(supervisor._state)
    rng = np.random.default_rng(7)
    for q in rng.uniform(-3, 3, (100, 3)):
        off = bound * rng.uniform(-1, 1, 3)
        mismatch, status = supervisor.check_start(q, robot.gravity(q) + off)
        np.testing.assert_allclose(mismatch, off, atol=1e-12 * np.abs(robot.gravity(q)).max())
        assert status is ControlStatus.OK
        off[rng.integers(3)] = 1.001 * bound[0] * rng.choice([-1, 1])
        mismatch, status = supervisor.check_start(q, robot.gravity(q) + off)
        np.testing.assert_allclose(mismatch, off, atol=1e-12 * np.abs(robot.gravity(q)).max())
        assert status is ControlStatus.LOAD_MISMATCH
    assert bytes(supervisor._state) == before


def test_torques_and_settings_that_cannot_be_used_are_refused(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart
) -> None:
    q, supervisor = planar_for_control.problem.domain.centre, Supervisor(supervised_library, supervised_law)
    torque = planar_for_control.problem.robot.gravity(q)
    for bad in (np.nan, np.inf, -np.inf):
        for i in range(3):
            spoiled = np.where(np.arange(3) == i, bad, 0.0)
            for place, held in ((q, torque + spoiled), (q + spoiled, torque)):
                mismatch, status = supervisor.check_start(place, held)
                assert status is ControlStatus.NOT_FINITE
                assert not mismatch.any()
    with pytest.raises(ShapeError, match="torque has shape"):
        supervisor.check_start(q, torque[:2])
    with pytest.raises(InvalidValueError, match="start_mismatch is -1"):
        Safety.of(supervised_law, start_mismatch=-1.0)
    # Joints that nobody wants to be checked, and a bound of none.
    free = Supervisor(supervised_library, supervised_law, Safety.of(supervised_law, start_mismatch=np.inf))
    assert free.check_start(q, torque + 1e6)[1] is ControlStatus.OK
    free._safety.contents.start_mismatch[1] = np.nan
    assert free.check_start(q, torque)[1] is ControlStatus.BAD_INPUT


@pytest.mark.slow
def test_limits_of_gains_and_velocity_laws_leave_gravity_as_it_is(
    supervised_library: CompiledLibrary, supervised_law: Controller, planar_for_control: oc.Chart, tmp_path: Path
) -> None:
    """A low limit cuts the fallback, but not what holds the arm; a velocity law compares measured torques."""
    q, supervisor = planar_for_control.problem.domain.centre, Supervisor(supervised_library, supervised_law)
    gravity = planar_for_control.problem.robot.gravity(q)
    supervisor.gains = np.concatenate([supervisor.gains[:-3], np.full(3, 0.1)])
    assert np.abs(gravity).max() > 5.0
    np.testing.assert_allclose(supervisor.check_start(q, gravity)[0], 0.0, atol=1e-12)
    law = Kinematic.on_chart(planar_for_control)
    generated = oc.generate_c(planar_for_control, tmp_path, law, "arm")
    kinematic = Supervisor(CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3), law)
    mismatch, status = kinematic.check_start(q, gravity)
    np.testing.assert_allclose(mismatch, 0.0, atol=1e-12)
    assert status is ControlStatus.OK
    assert kinematic.check_start(q, 0 * q)[1] is ControlStatus.LOAD_MISMATCH


def holding_torque(plant: MuJoCoPlant, q: Array) -> Array:
    """The torque that holds an arm in MuJoCo, by its own inverse dynamics; the arm does not move under it."""
    plant.reset(q)
    torque = plant.bias
    plant.step(torque, 1e-3)
    assert np.abs(plant.dq).max() < 1e-6
    return torque


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count"), [("panda-position", 3), ("iiwa7-wide", 3), *nightly(("panda-position", 20), ("iiwa7-wide", 20))]
)
def test_wrong_mountings_and_tools_are_refused_before_anything_moves(name: str, count: int, tmp_path: Path) -> None:
    """In MuJoCo, at the centre and random postures of the domain, with the default bound.

    The true model starts, also where up to 2 N m of friction hold each joint; so does a tool that the law knows.
    """
    pytest.importorskip("mujoco")
    chart = oc.charts.load(name)
    law, robot, domain = PDPlus.on_chart(chart, inputs="payload"), chart.problem.robot, chart.problem.domain
    library = CompiledLibrary(compile_shared(oc.generate_c(chart, tmp_path, law, "arm"), tmp_path), "arm", chart.n)
    supervisor, rng = Supervisor(library, law), np.random.default_rng(7)
    true, tooled = MuJoCoPlant(robot), MuJoCoPlant(robot.with_payload(3.0))
    wrong = {name: MuJoCoPlant(mounted(robot, rpy)) for name, rpy in MOUNTINGS.items()}
    wrong["3 kg in the hand"] = tooled
    sticking = StickingPlant(robot, friction=Friction(coulomb=2.0))
    postures = [domain.home, *(q for q in domain.sample(count, 7))]
    for q in postures:
        held = holding_torque(true, q)
        mismatch, status = supervisor.check_start(q, held)
        np.testing.assert_allclose(mismatch, 0.0, atol=1e-6)
        assert status is ControlStatus.OK
        # What friction holds, too.
        held = held + rng.uniform(-2.0, 2.0, chart.n)
        sticking.reset(q)
        sticking.step(held, 0.01)
        assert not sticking.dq.any()
        assert supervisor.check_start(q, held)[1] is ControlStatus.OK
        for case, plant in wrong.items():
            mismatch, status = supervisor.check_start(q, holding_torque(plant, q))
            assert status is ControlStatus.LOAD_MISMATCH, (case, q, mismatch)
    # The same tool among the gains.
    payload = np.append(3.0, np.zeros(9))
    supervisor.gains = np.concatenate([payload if name == "payload" else gain for name, gain in law.gains.items()])
    for q in postures:
        mismatch, status = supervisor.check_start(q, holding_torque(tooled, q))
        np.testing.assert_allclose(mismatch, 0.0, atol=1e-6)
        assert status is ControlStatus.OK


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["cvodes", "mujoco"])
def test_simulations_say_that_a_robot_would_refuse_the_start(
    planar_for_control: oc.Chart, plant: str, caplog: pytest.LogCaptureFixture
) -> None:
    """They run all the same, to show what happens; a true model goes without a word."""
    problem = planar_for_control.problem
    law, q = PDPlus.on_chart(planar_for_control, limit=120.0), problem.domain.centre
    reference = Reference.steps(law.labels, planar_for_control.phi(q), [], 0.02)
    for scale, refused in ((1.0, 0), (1.5, 1)):
        robot = problem.robot.with_scaled_masses(scale)
        true = oc.simulation.MuJoCo(robot) if plant == "mujoco" else robot
        caplog.clear()
        run = oc.simulate(law, reference, q, plant=true, control_rate=1000, safety=Safety.of(law))
        assert run.outcome is oc.simulation.Outcome.COMPLETE
        assert len(caplog.records) == refused
        assert refused == 0 or "a robot would refuse this start" in caplog.text
