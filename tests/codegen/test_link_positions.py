"""Joint positions of arms whose gears give way, from those of their motors, in C."""

from pathlib import Path

import numpy as np
import pytest
from programs import needs_c
from scipy.optimize import fsolve

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, PDPlus
from orthocas.errors import ShapeError
from orthocas.simulation import Elasticity, MuJoCoPlant

pytestmark = needs_c

STIFFNESS, ROTOR, TICK = 5000.0, 0.2, 1e-3


@pytest.mark.slow
def test_springs_carry_gravity_or_what_sensors_measure(planar_for_control: oc.Chart, tmp_path: Path) -> None:
    """Against SciPy's solution of k (theta - q) = g(q); by its definition with a torque."""
    chart, robot = planar_for_control, planar_for_control.problem.robot
    library = CompiledLibrary(compile_shared(oc.generate_c(chart, tmp_path, None, "arm"), tmp_path), "arm", chart.n)
    motors, stiffness = chart.problem.domain.centre + 0.05, np.array([STIFFNESS, 2 * STIFFNESS, np.inf])
    q, status = library.link_positions(motors, stiffness)
    wanted = fsolve(lambda at: at - motors + robot.gravity(at) / stiffness, motors, xtol=1e-13)
    assert ControlStatus(status) is ControlStatus.OK
    np.testing.assert_allclose(q, wanted, atol=1e-9)
    assert abs(q[0] - motors[0]) > 1e-3
    torque = np.array([10.0, -5.0, 3.0])
    q, _ = library.link_positions(motors, stiffness, torque)
    np.testing.assert_allclose(q, motors - torque / stiffness, atol=1e-15)
    for spoiled in (([np.nan, 0, 0], stiffness), (motors, np.zeros(3)), (motors, stiffness, [np.inf, 0, 0])):
        q, status = library.link_positions(*map(np.array, spoiled))
        assert ControlStatus(status) is ControlStatus.NOT_FINITE
        assert not q.any()
    # Gears so soft that the arm falls over do not converge.
    _, status = library.link_positions(motors, np.full(3, 20.0))
    assert ControlStatus(status) is ControlStatus.STOPPED_EARLY
    with pytest.raises(ShapeError):
        library.link_positions(motors[:2], stiffness)


@pytest.mark.slow
def test_a_law_on_them_brings_the_tip_of_an_elastic_arm_to_its_target(tmp_path: Path) -> None:
    """An iiwa in MuJoCo. On positions of the motors alone the tip hangs by millimetres."""
    chart = oc.charts.load("iiwa7-position")
    law, robot, q = PDPlus(chart), chart.problem.robot, chart.problem.domain.centre
    path = compile_shared(oc.generate_c(chart, tmp_path, law, "arm"), tmp_path, ("-O1",))
    library, stiffness = CompiledLibrary(path, "arm", chart.n), np.full(chart.n, STIFFNESS)
    reference = np.concatenate([chart.phi(q), np.zeros(2 * chart.n)])

    def sag(measured: str) -> float:
        """How far the tip is from its target after a second [m]."""
        plant, supervisor = MuJoCoPlant(robot, elasticity=Elasticity(STIFFNESS, ROTOR)), Supervisor(library, law)
        plant.reset(q)
        supervisor.start(q, robot.gravity(q))
        for _ in range(1000):
            joints = library.link_positions(plant.motor_q, stiffness)[0] if measured == "gravity" else plant.motor_q
            command, status = supervisor.step(joints, plant.motor_dq, reference, TICK)
            assert status is not ControlStatus.CAUGHT
            plant.step(command, TICK)
        return float(np.linalg.norm(chart.phi(plant.q)[:3] - reference[:3]))

    assert sag("gravity") < 0.1e-3
    assert sag("motors") > 3e-3
