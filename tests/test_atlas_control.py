"""Laws on atlases: smooth weights of charts, hand-overs without a jump, and a blended potential that is passive."""

import warnings

import numpy as np
import pytest
from atlas_control.laws import AskedPosture, Blend, BlendedImpedance, HandedOver
from atlas_control.simulate import AtlasRun, simulate_in_atlas

import orthocas as oc
from orthocas import problems
from orthocas.control import PDPlus, Reference
from orthocas.errors import InvalidValueError, PathError
from orthocas.simulation import MuJoCoPlant, Push
from orthocas.tools.checks import Array

STIFFNESS = [400.0, 400.0, 50.0]
START = np.array([0.3, 0.7, 1.5])
STEP = np.array([-0.3, -0.5])  # of the tool [m]
RATE = 400.0


@pytest.fixture(scope="module")
def atlas(tmp_path_factory: pytest.TempPathFactory) -> oc.Atlas:
    """Small boxes around postures on a line in joint space."""
    known = problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, domain=known.domain)
    postures = np.array([0.3, 0.5, 1.4]) + np.linspace(-0.1, 1.0, 12)[:, None] * [0.0, 0.5, 0.3]
    asked = oc.AtlasSettings(degree=2, leak_deg=14.0, half_width=0.2, overlap=0.2)
    path = tmp_path_factory.mktemp("atlas") / "arm.orthocas-atlas"
    return oc.build_atlas(problem, path, asked, region=postures, radius=0.35, jobs=1)


@pytest.fixture(scope="module")
def points(atlas: oc.Atlas) -> Array:
    """Positions of the region, many of them where boxes overlap."""
    return START + np.random.default_rng(7).uniform(-0.25, 0.25, (60, 3))


def x_of(atlas: oc.Atlas, q: Array) -> Array:
    return np.asarray(atlas.problem.task.batched(q[None])[0][0])


def there_and_back(atlas: oc.Atlas, step: Array, seconds: float) -> Reference:
    x = x_of(atlas, START)
    return Reference.through(atlas.problem.task.labels, [0.0, seconds / 2, seconds], [x, x + step, x])


def bends(run: AtlasRun) -> Array:
    """Second differences of the torque at hand-overs: a jump that the motion does not explain."""
    k = np.searchsorted(run.times, [change.time for change in run.hand_overs])
    return np.asarray(np.abs(run.torque[k] - 2 * run.torque[k - 1] + run.torque[k - 2]))


@pytest.mark.slow
def test_weights_are_those_of_all_boxes_that_hold_the_position_and_add_up_to_one(
    atlas: oc.Atlas, points: Array
) -> None:
    blend = Blend(atlas.index)
    counts = set()
    for q in points:
        charts, weights, gradients = blend.at(q, int(atlas.chart_at(q)))
        holding = [k for k in range(len(atlas)) if atlas.box(k, near=q).contains(q)]
        assert sorted(charts.tolist()) == holding
        assert abs(weights.sum() - 1) < 1e-14
        assert weights.min() >= 0
        assert np.abs(gradients.sum(axis=0)).max() < 1e-10
        counts.add(len(charts))
    assert {1, 2} <= counts


@pytest.mark.slow
def test_blended_potential_has_the_force_that_the_law_applies(atlas: oc.Atlas, points: Array) -> None:
    law, h = BlendedImpedance(atlas, STIFFNESS), 1e-6
    for q in points[:20]:
        near = int(atlas.chart_at(q))
        _, slope, S = law.potential(q, START, near)
        steps = [law.potential(q + h * e, START, near)[0] - law.potential(q - h * e, START, near)[0] for e in np.eye(3)]
        assert np.abs(np.array(steps) / (2 * h) - slope).max() < 1e-5 * np.abs(slope).max()
        assert np.linalg.eigvalsh(S).min() > 0


@pytest.mark.slow
def test_energy_of_the_blended_impedance_falls_across_charts(atlas: oc.Atlas) -> None:
    plant = MuJoCoPlant(atlas.problem.robot, effort_limits=False)
    rest = there_and_back(atlas, np.zeros(2), 0.6)
    push = Push(0.0, 0.2, torque=[0.0, 40.0, 15.0])
    errors = []
    for rate in (250.0, 500.0):
        run = simulate_in_atlas(
            BlendedImpedance(atlas, STIFFNESS), rest, START, plant, control_rate=rate, pushes=[push]
        )
        after = run.times > 0.2
        storage, balance = run.storage[after], run.energy_balance[after]
        assert (np.diff(storage) <= 1e-9 * storage[0]).all()
        assert len(set(run.charts[after].tolist())) > 1
        assert not run.fell_back.any()
        errors.append(np.abs(balance - balance[0]).max() / storage[0])
    assert errors[0] < 0.05
    assert (
        1.5 < errors[0] / errors[1] < 2.5
    )  # the torque is held for a tick: the books close with the first power of it


@pytest.mark.slow
def test_posture_asked_for_and_torque_do_not_jump_at_hand_overs(atlas: oc.Atlas) -> None:
    law = HandedOver(atlas, lambda chart: PDPlus(chart, STIFFNESS))
    run = simulate_in_atlas(
        law, there_and_back(atlas, STEP, 1.0), START, MuJoCoPlant(atlas.problem.robot), control_rate=RATE
    )
    assert len(run.hand_overs) >= 2
    for change in run.hand_overs:
        assert change.posture_step < 1e-9
        assert change.velocity_step < 1e-9
        assert change.torque_step < 0.1
    assert bends(run).max() < 0.1
    assert np.abs(run.x - run.x_asked).max() < 2e-3
    assert not run.fell_back.any()


@pytest.mark.slow
def test_motions_that_repeat_through_charts_are_reported_once(atlas: oc.Atlas) -> None:
    """Around a rectangle; a motion there and back leaves the same behind, and is not the same hand-over."""
    x = x_of(atlas, START)
    corners = x + np.array([[0, 0], [-0.3, 0], [-0.3, -0.5], [0, -0.5], [0, 0]])
    once = Reference.through(atlas.problem.task.labels, np.linspace(0, 2, 5), corners)
    asked, said = AskedPosture(atlas), []
    asked.start(START)
    changes = 0
    for k in range(2400):
        asked.move(k * 5e-3, np.stack([part[0] for part in once.sample(np.array([k * 5e-3 % 2]))]))
        if (number := asked.wanted_at(asked.q)) != asked.number:
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always")
                asked.hand_over(number)
            said += [(changes, str(one.message)) for one in found]
            changes += 1
    assert changes > 4
    assert [("are not" in text, count >= 2) for count, text in said] == [(True, True)]


@pytest.mark.slow
def test_torque_fades_from_one_chart_to_the_next_with_a_wrong_model(atlas: oc.Atlas) -> None:
    law = HandedOver(atlas, lambda chart: PDPlus(chart, STIFFNESS))
    plant = MuJoCoPlant(atlas.problem.robot.with_scaled_masses(1.2))
    run = simulate_in_atlas(law, there_and_back(atlas, STEP, 1.0), START, plant, control_rate=RATE)
    worst = max(change.torque_step for change in run.hand_overs)
    assert worst > 0.5
    assert bends(run).max() < worst / 5


@pytest.mark.slow
def test_posture_asked_for_has_the_velocity_it_claims(atlas: oc.Atlas) -> None:
    motion = there_and_back(atlas, STEP, 4.0)
    asked, h = AskedPosture(atlas), 2e-3
    asked.start(START)
    times = np.arange(0.0, 2.0, h)
    wanted = np.stack(motion.sample(times), axis=1)
    q, dq, ddq, changes = [], [], [], []
    for k, time in enumerate(times):
        asked.move(float(time), wanted[k])
        if (number := asked.wanted_at(asked.q)) != asked.number:
            asked.hand_over(number)
            changes.append(k)
        q.append(asked.q)
        dq.append(asked.dq)
        ddq.append(asked.ddq)
    assert changes
    measured = (np.array(q)[2:] - np.array(q)[:-2]) / (2 * h)
    assert np.abs(measured - np.array(dq)[1:-1]).max() < 1e-5
    turning = (np.array(dq)[2:] - np.array(dq)[:-2]) / (2 * h)
    assert np.abs(turning - np.array(ddq)[1:-1]).max() < 1e-3 * max(1.0, np.abs(ddq).max())


def test_wrong_arguments_are_refused(atlas: oc.Atlas) -> None:
    law, plant = BlendedImpedance(atlas, STIFFNESS), MuJoCoPlant(atlas.problem.robot)
    with pytest.raises(PathError, match="no chart"):
        simulate_in_atlas(law, there_and_back(atlas, np.zeros(2), 0.1), [0.0, -2.0, -2.0], plant)
    with pytest.raises(InvalidValueError, match="labels of motion"):
        simulate_in_atlas(law, Reference.through(["a", "b"], [0.0, 1.0], np.zeros((2, 2))), START, plant)
    with pytest.raises(InvalidValueError, match="control_rate"):
        simulate_in_atlas(law, there_and_back(atlas, np.zeros(2), 0.1), START, plant, control_rate=0.0)
    kinematic = HandedOver(atlas, lambda chart: oc.control.Kinematic(chart, 1.0))
    with pytest.raises(InvalidValueError, match="torque law"):
        simulate_in_atlas(kinematic, there_and_back(atlas, np.zeros(2), 0.1), START, plant)
    with pytest.raises(PathError, match="cannot be reached"):
        simulate_in_atlas(law, there_and_back(atlas, np.full(2, 9.0), 0.5), START, plant)
