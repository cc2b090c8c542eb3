"""Laws on arms that stick: what is left of x and xi with the friction observer, and that nothing hunts."""

from typing import Any

import numpy as np
import pytest
from programs import nightly

import orthocas as oc
from orthocas.control import FrictionObserver, PDPlus, Remembering
from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.simulation import Friction, StickingPlant
from orthocas.tools.checks import Array

TICK = 1e-3


@pytest.fixture(scope="module")
def chart() -> oc.Chart:
    return oc.charts.load("panda-wide")


def led(chart: oc.Chart, remembers: Any, seconds: float, plant: StickingPlant) -> tuple[Array, Array]:
    """Errors of phi and speeds (ticks, n) while xi goes by 0.3 through a filter of 1 Hz, from the domain's centre."""
    law = PDPlus(chart, remembers=remembers)
    ticks, q = Remembering(law), chart.problem.domain.centre
    plant.reset(q)
    start = chart.phi(q)
    target = start.copy()
    target[chart.m] += 0.3
    steps = {chart.labels[chart.m]: target[chart.m]}
    reference = oc.control.Reference.steps(chart.labels, start, [(0.0, steps)], duration=seconds)
    wanted = np.stack(reference.sample(np.arange(round(seconds / TICK)) * TICK), axis=1)
    errors, speeds = [], []
    for row in wanted:
        command, _ = ticks.tick(plant.q, plant.dq, row, TICK)
        plant.step(command, TICK)
        errors.append(chart.phi(plant.q) - row[0])
        speeds.append(plant.dq)
    return np.array(errors), np.array(speeds)


@pytest.mark.slow
def test_joints_that_stick_leave_x_and_xi_within_half_a_millimetre_and_0_02(chart: oc.Chart) -> None:
    """5 N m at most 10 % of the effort limit, a quarter more to break away; without the observer, the hand is off."""
    robot = chart.problem.robot
    coulomb = np.minimum(5.0, 0.1 * robot.effort_limits)
    plant = StickingPlant(robot, friction=Friction(0.0, coulomb, 1.25 * coulomb))
    bare, _ = led(chart, None, 2.0, plant)
    errors, speeds = led(chart, FrictionObserver(), 6.0, plant)
    assert np.linalg.norm(bare[-1, :3]) > 0.5e-3
    assert np.linalg.norm(errors[3000:, :3], axis=1).max() < 0.5e-3
    assert np.abs(errors[3000:, chart.m :]).max() < 0.02
    # Nothing hunts: all joints stand, exactly.
    assert not speeds[4000:].any()


@pytest.mark.slow
@pytest.mark.parametrize("change", nightly("payload", "masses"))
def test_unknown_loads_leave_less_than_a_millimetre(chart: oc.Chart, change: str) -> None:
    """3 kg, and masses that are 40 % off, without friction."""
    robot = chart.problem.robot
    true = robot.with_payload([3.0, 0.0, 0.0, 0.05]) if change == "payload" else robot.with_scaled_masses(1.4)
    errors, speeds = led(chart, FrictionObserver(), 4.0, StickingPlant(true))
    assert np.linalg.norm(errors[3000:, :3], axis=1).max() < 1e-3
    assert np.abs(speeds[-500:]).max() < 1e-3


def test_an_observer_of_friction_does_nothing_where_the_model_is_true(chart: oc.Chart) -> None:
    law, q = PDPlus(chart, remembers=FrictionObserver()), chart.problem.domain.centre
    ticks = Remembering(law)
    wanted = np.array([chart.phi(q), 0 * q, 0 * q])
    for _ in range(3):
        ticks.tick(q, 0 * q, wanted, TICK)
    assert not ticks.fields["correction"].any()


def test_a_joint_that_stands_is_pulled_ever_more_and_one_that_moves_is_let_go(chart: oc.Chart) -> None:
    """db_i/dt = -60/s k_i d_i where dq_i = 0 and a joint is off; b falls to 1/e on 3 mrad."""
    law, q, n = PDPlus(chart, remembers=FrictionObserver(rate=1e-9)), chart.problem.domain.centre, chart.n
    robot = chart.problem.robot
    # The last joint alone is off, by 50 mrad.
    off = np.zeros(n)
    off[-1] = -0.05
    wanted = np.array([chart.phi(q - off), 0 * q, 0 * q])
    ticks = Remembering(law)
    ticks.start(q)
    for _ in range(11):
        ticks.tick(q, 0 * q, wanted, TICK)
    M = robot.mass_matrix(q)
    firm = max(1 / (1 / (M[-1, -1] * law.fastest**2) + law.compliance[-1]), 2 * robot.effort_limits[-1])
    b = ticks.fields["breakaway"]
    assert b[-1] == pytest.approx(60.0 * 10 * TICK * firm * 0.05, rel=0.03)
    assert np.abs(b[:-1]).max() < 0.02 * b[-1]
    ticks.tick(q, np.full(n, 1.0), wanted, TICK)
    np.testing.assert_allclose(ticks.fields["breakaway"][-1], b[-1] * np.exp(-1 / 3), rtol=1e-3)


def test_memories_have_names(chart: oc.Chart) -> None:
    assert PDPlus(chart, remembers="friction").remembers == FrictionObserver()
    with pytest.raises(UnknownNameError, match="stiction"):
        PDPlus(chart, remembers="stiction")


def test_tolerances_that_no_chart_has_are_refused(chart: oc.Chart) -> None:
    with pytest.raises(InvalidValueError, match="tolerance"):
        PDPlus(chart, remembers=FrictionObserver(tolerance=0.0))
    with pytest.raises(ShapeError, match="tolerance"):
        PDPlus(chart, remembers=FrictionObserver(tolerance=[1e-3] * 3))
