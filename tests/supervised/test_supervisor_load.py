"""What the supervised law feels beside its model: the load that its catcher holds."""

from pathlib import Path

import numpy as np
import pytest
import wrong_models
from programs import needs_c, nightly
from supervised import TICK, Arm, at_rest, run

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, PDPlus
from orthocas.tools.checks import Array

pytestmark = needs_c

RATE = 2.0  # [1/s]


def test_the_load_is_learned_with_its_time_constant(supervisor: Supervisor, planar_for_control: oc.Chart) -> None:
    """Joints feel an unknown torque from the start; the load is its opposite, 1 - exp(-2 t) of it, in any motion."""
    chart, unknown = planar_for_control, np.array([3.0, -2.0, 1.0])
    q = chart.problem.domain.centre
    arm, reference = Arm(chart.problem.robot, q), at_rest(chart, q)
    supervisor.start(q)
    for seconds in (0.25, 0.5, 0.75):
        run(supervisor, arm, reference, 0.25, lambda _: unknown)
        np.testing.assert_allclose(supervisor.load, -unknown * (1 - np.exp(-RATE * seconds)), rtol=0.03)


def test_brakes_and_starts_forget_it_and_blows_do_not_count(
    supervisor: Supervisor, planar_for_control: oc.Chart
) -> None:
    """A blow of 1 kg m^2 x 20 rad/s in a tick counts as the largest command in that tick, at most."""
    chart, q = planar_for_control, planar_for_control.problem.domain.centre
    reference = at_rest(chart, q)
    for forget in (supervisor.hold, supervisor.release, supervisor.start):
        supervisor.start(q)
        run(supervisor, Arm(chart.problem.robot, q), reference, 0.3, lambda _: np.full(3, 2.0))
        assert np.abs(supervisor.load).min() > 0.5
        forget(q)
        assert not supervisor.load.any()
    supervisor.start(q)
    arm = Arm(chart.problem.robot, q)
    run(supervisor, arm, reference, 0.1)
    before, arm.dq = supervisor.load, np.full(3, 20.0)
    run(supervisor, arm, reference, TICK)
    most = RATE * TICK * 120.0  # the limit of the fixture's law
    assert np.abs(supervisor.load - before).max() <= 1.01 * most


def moved(
    supervisor: Supervisor, plant: oc.simulation.MuJoCoPlant, reference: Array, ticks: int
) -> tuple[ControlStatus, Array, Array]:
    """The last status, the path (ticks, n), and the fastest joint of each tick."""
    path, speeds, status = [], [], ControlStatus.OK
    for _ in range(ticks):
        command, status = supervisor.step(plant.q, plant.dq, reference, TICK)
        plant.step(command, TICK)
        path.append(plant.q)
        speeds.append(np.abs(plant.dq).max())
    return status, np.array(path), np.array(speeds)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-position", *nightly("iiwa7-position")])
def test_the_catcher_holds_three_unknown_kilograms(name: str, tmp_path: Path) -> None:
    """In MuJoCo, without rotors: taken 1 s before the catch, and in its tick. The arm rests, holds the true weight, and
    goes back when asked."""
    pytest.importorskip("mujoco")
    chart = oc.charts.load(name)
    law, robot = PDPlus.on_chart(chart), chart.problem.robot
    loaded = robot.with_payload(3.0)
    library = CompiledLibrary(compile_shared(oc.generate_c(chart, tmp_path, law, "arm"), tmp_path), "arm", chart.n)
    q = chart.problem.domain.centre + 0.1
    assert chart.problem.domain.contains(q)
    reference, sag = at_rest(chart, q), {}
    for before in (1000, 0):
        supervisor, plant = Supervisor(library, law), oc.simulation.MuJoCoPlant(robot)
        plant.reset(q)
        supervisor.start(q)
        moved(supervisor, plant, reference, 300)
        bare, plant = plant, oc.simulation.MuJoCoPlant(loaded)
        plant.reset(bare.q, bare.dq)
        assert before == 0 or moved(supervisor, plant, reference, before)[0] is ControlStatus.OK
        here = robot.tip_position(plant.q)
        supervisor.step(plant.q, plant.dq, reference, 1.0)  # a late tick
        status, path, speeds = moved(supervisor, plant, reference, 3000)
        assert status is ControlStatus.CAUGHT
        assert speeds[2500:].max() < 0.05
        weight = loaded.gravity(plant.q) - robot.gravity(plant.q)
        np.testing.assert_allclose(supervisor.load, weight, atol=0.05 * np.abs(weight).max())
        supervisor.resume()
        assert moved(supervisor, plant, reference, 2000)[0] is ControlStatus.OK
        sag[before] = np.linalg.norm(robot.tip_position(path) - here, axis=1).max()
    assert sag[1000] < 0.1
    assert sag[1000] < sag[0] / 2  # known before


@pytest.mark.nightly
def test_a_lift_that_the_catcher_takes_stays_where_it_is(tmp_path: Path) -> None:
    """With 40 % less mass than the model, a lift that may move at 7 cm/s is too fast at once: 1 mm, not 10 cm."""
    chart = oc.charts.load("tiago-pro-left-position")
    law = PDPlus(chart)
    library = CompiledLibrary(compile_shared(oc.generate_c(chart, tmp_path, law, "arm"), tmp_path), "arm", chart.n)
    off, caught = wrong_models.sag(law, library, "40 % lighter", 0, told=True)
    assert caught
    assert off < 2e-3
