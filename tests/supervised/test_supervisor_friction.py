"""The supervised law in C on arms that stick, with encoders, and what its rates may be."""

import numpy as np
import pytest
import sticking
from programs import needs_c

import orthocas as oc
from orthocas.control import PDPlus, Safety
from orthocas.simulation import Friction, StickingPlant

pytestmark = needs_c


@pytest.mark.slow
def test_a_planar_arm_that_sticks_reaches_x_and_xi(
    planar_for_control: oc.Chart, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Joints rub with 3 N m, a quarter more to break away; stiff springs bear it, and nothing is caught."""
    monkeypatch.setattr(sticking, "WAY", 0.1)
    law = PDPlus.on_chart(planar_for_control, limit=120.0)
    plant = StickingPlant(law.problem.robot, friction=Friction(0.0, 3.0, 3.75))
    with sticking.supervised(law) as supervisor:
        x, xi, _ = sticking.lead(law, supervisor, plant, law.problem.domain.centre, 1.5)
    assert x < 0.5
    assert xi < 0.02


@pytest.mark.nightly
def test_an_arm_that_sticks_reaches_x_and_xi_and_is_not_caught() -> None:
    """A bare wrist jumps beyond its limit of speed as it breaks away, and the arm stands still under torques."""
    chart = oc.load("iiwa7-pose")
    law, robot, q = PDPlus(chart, remembers="friction"), chart.problem.robot, sticking.find_start(chart)
    coulomb = np.minimum(5.0, 0.1 * robot.effort_limits)
    plant = StickingPlant(robot, friction=Friction(0.0, coulomb, 1.25 * coulomb))
    with sticking.supervised(law) as supervisor:
        x, xi, _ = sticking.lead(law, supervisor, plant, q, 2.5)
    assert x < 0.5
    assert xi < 0.02


def test_the_observer_of_velocities_is_slower_the_coarser_encoders_are() -> None:
    law = PDPlus(oc.load("panda-position"))
    assert not Safety.of(law).observer_rate.any()
    for bits, rate in ((12, 42.4), (13, 60.0), (14, 84.9), (20, 120.0)):
        safety = Safety.of(law, encoder_step=2 * np.pi / 2**bits)
        np.testing.assert_allclose(safety.observer_rate, rate, rtol=1e-3)
    assert Safety.of(law, encoder_step=1e-3, observer_rate=0.0).observer_rate.max() == 0


def test_friction_that_may_hold_a_joint_is_a_share_of_its_effort_limit() -> None:
    law = PDPlus(oc.load("panda-position"))
    limits = law.chart.problem.robot.effort_limits
    np.testing.assert_allclose(Safety.of(law).friction, np.minimum(12.5, 0.125 * limits))


def test_joints_without_a_limit_of_effort_may_stick_on_vertical_axes_too() -> None:
    """There is no gravity that would say how much holds them."""
    robot = oc.Robot.planar([0.4, 0.3, 0.2], [2.0, 1.0, 0.5])
    chart = oc.fit(oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.3, 0.8, 0.8], 0.3))).chart
    assert np.isinf(robot.effort_limits).all()
    np.testing.assert_allclose(Safety.of(PDPlus(chart, 50.0, limit=90.0)).friction, 2.0)
