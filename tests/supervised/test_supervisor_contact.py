"""Guarded moves against stiff walls, and the energy that the supervised law gives to what it touches."""

import contact
import numpy as np
import pytest
from programs import needs_c, nightly
from supervised import TICK, at_rest

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor
from orthocas.control import ControlStatus, PDPlus, Safety
from orthocas.errors import InvalidValueError
from orthocas.simulation import MuJoCoPlant

pytestmark = needs_c

DRAG, SPEED, SECONDS = 400.0, 0.08, 0.8  # [N s/m], [m/s], [s]


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [1e6, *nightly(1e4, 1e5)])
def test_a_guarded_move_stops_at_a_stiff_wall(
    supervised_library: CompiledLibrary, supervised_law: PDPlus, monkeypatch: pytest.MonkeyPatch, stiffness: float
) -> None:
    """The catcher takes over and hardly presses; the wall takes the blow, speed times the root of stiffness and mass.

    No law takes that back: torques come too late. Without a guard the law goes on, and presses with more than 10 N.
    """
    for name, value in (("BEFORE", 0.05), ("DURATION", 0.5), ("SECONDS", 0.7)):
        monkeypatch.setattr(contact, name, value)
    law, robot, q = supervised_law, supervised_law.problem.robot, supervised_law.problem.domain.home
    guard = Supervisor(supervised_library, law, Safety.of(law, contact_torque=2.0))
    contacts, most, left, _, _ = contact.touch(law, guard, stiffness)
    assert guard.cause == ControlStatus.TOUCHED
    J = robot.tip_jacobian(q)[0]
    mass = 1 / (J @ np.linalg.solve(robot.mass_matrix(q), J))
    assert most <= 1.1 * (1.875 * contact.WAY / contact.DURATION * np.sqrt(stiffness * mass) + 5.0)
    assert left < 1.0
    assert contacts < 15


@pytest.mark.nightly
@pytest.mark.parametrize("stiffness", [1e5, 1e6])
def test_a_blow_that_the_law_survives_does_not_call_the_catcher(stiffness: float) -> None:
    """A stiff wall turns the light wrist of a panda at 70 % of its limit, while the law already takes that back.

    The torque that presses against the wall is no torque that makes joints faster.
    """
    law = PDPlus(oc.load("panda-wide"))
    with contact.supervised(law) as supervisor:
        contacts, _, _, unrest, lost = contact.touch(law, supervisor, stiffness)
    assert not lost
    assert contacts <= 5
    assert unrest < 1e-3


@pytest.mark.slow
def test_no_more_energy_than_its_limit_goes_to_what_the_arm_touches(
    supervised_library: CompiledLibrary, supervised_law: PDPlus
) -> None:
    """A reference that moves on against drag: the drag takes the limit and what the rate brings, and no more."""
    law, rate, taken = supervised_law, 0.05, {}
    chart, robot, q = law.chart, law.problem.robot, law.problem.domain.home
    for limit in (0.1, np.inf):
        guard = Supervisor(supervised_library, law, Safety.of(law, energy_limit=limit, energy_rate=rate))
        guard.start(q, robot.gravity(q))
        plant, reference, taken[limit] = MuJoCoPlant(robot), at_rest(chart, q), 0.0
        plant.reset(q)
        reference[chart.n] = SPEED
        for _ in range(round(SECONDS / TICK)):
            reference[0] += SPEED * TICK
            speed = float(robot.tip_jacobian(plant.q)[0] @ plant.dq)
            plant.release()
            plant.push([-DRAG * speed, 0.0, 0.0])
            plant.step(guard.step(plant.q, plant.dq, reference, TICK)[0], TICK)
            taken[limit] += DRAG * speed**2 * TICK
        assert (guard.cause == ControlStatus.TOUCHED) == (limit == 0.1)
    # What commands gave is what the drag took, and what moves.
    moving = 0.5 * plant.dq @ robot.mass_matrix(plant.q) @ plant.dq
    assert guard.energy == pytest.approx(taken[np.inf] + moving - rate * SECONDS, abs=0.01)
    assert taken[np.inf] > 0.3
    assert 0.1 < taken[0.1] <= 0.1 + rate * SECONDS


@pytest.mark.slow
def test_energy_is_what_the_arm_has_when_nothing_takes_any(
    supervised_library: CompiledLibrary, supervised_law: PDPlus
) -> None:
    """Coriolis torques, which move energy from joint to joint, neither give nor take any."""
    law = supervised_law
    chart, robot, q = law.chart, law.problem.robot, law.problem.domain.home
    guard = Supervisor(supervised_library, law, Safety.of(law, energy_rate=1e-9))
    guard.start(q, robot.gravity(q))
    plant, reference, given = MuJoCoPlant(robot), at_rest(chart, q), []
    plant.reset(q)
    for k in range(400):
        for i, way in ((chart.m, 0.5), (0, 0.15)):
            reference[i] += way * np.sin(np.pi * k * TICK / 0.4) * TICK * np.pi
            reference[chart.n + i] = way * np.sin(np.pi * k * TICK / 0.4) * np.pi
        plant.step(guard.step(plant.q, plant.dq, reference, TICK)[0], TICK)
        given.append((guard.energy, 0.5 * plant.dq @ robot.mass_matrix(plant.q) @ plant.dq))
    energy, moving = np.array(given).T
    assert moving.max() > 10
    np.testing.assert_allclose(energy, moving, atol=0.02 * moving.max())


def test_settings_of_guards_are_torques_and_energies(supervised_law: PDPlus) -> None:
    assert np.isinf(Safety.of(supervised_law).contact_torque).all()
    assert Safety.of(supervised_law).energy_limit == np.inf
    for changes, words in (
        ({"contact_torque": -1.0}, "contact_torque is .*, expected numbers >= 0"),
        ({"energy_limit": 0.0}, "energy_limit is .*, expected a number > 0"),
        ({"energy_limit": np.nan}, "energy_limit is .*, expected a number > 0"),
        ({"energy_rate": np.inf}, "energy_rate is .*, expected a finite number > 0"),
    ):
        with pytest.raises(InvalidValueError, match=words):
            Safety.of(supervised_law, **changes)
