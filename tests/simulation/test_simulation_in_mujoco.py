"""`simulate` with MuJoCo as plant, against the same run in CVODES; pushes at links and joint stops in both."""

import numpy as np
import pytest
from charts import with_metric, with_upper_limit

import orthocas as oc
from orthocas.control import Impedance, Kinematic, PDPlus, Reference
from orthocas.errors import Interrupted, InvalidValueError, UnknownNameError
from orthocas.simulation import Friction, MuJoCo, Noise, Outcome, Payload, Push, Stops, Wall, simulate
from orthocas.simulation.run import Plant
from orthocas.tools.checks import Array
from orthocas.tools.progress import Progress

pytest.importorskip("mujoco", minversion="4", reason="the extra orthocas[mujoco] is not installed")

PUSHES = (
    Push(0.1, 0.2, [20.0, -10.0, 0.0], link="q2", point=[0.5, 0.1, 0.0]),
    Push(0.15, 0.0305, [0.0, 30.0, 0.0]),
    Push(0.2, 0.1, torque=[1.0, 0.0, -2.0], link=0),
)


@pytest.fixture(scope="module")
def law(planar_chart: oc.Chart) -> PDPlus:
    return PDPlus(planar_chart, 60.0)


@pytest.fixture(scope="module")
def steps(planar_chart: oc.Chart, planar_q0: Array) -> Reference:
    phi = planar_chart.phi(planar_q0)
    return Reference.steps(planar_chart.labels, phi, [(0.1, {"x": phi[0] + 0.05}), (0.3, {"xi1": 0.03})], 0.6)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [None, Friction(0.8)])
def test_run_is_that_of_cvodes(law: PDPlus, steps: Reference, planar_q0: Array, friction: Friction | None) -> None:
    """The same sampled loop with pushes at the tip, at a link and at joints, heavier than the model, with noise.

    What is left is the tolerance of CVODES.
    """
    heavier = law.problem.robot.with_scaled_masses(1.2)
    common = {"control_rate": 1000.0, "pushes": PUSHES, "friction": friction, "noise": Noise(1e-4, 1e-3, 3)}
    cvodes = simulate(law, steps, planar_q0, plant=heavier, tolerance=1e-13, **common)  # type: ignore[arg-type]
    ours = simulate(law, steps, planar_q0, plant=MuJoCo(heavier), **common)  # type: ignore[arg-type]
    assert ours.outcome is Outcome.COMPLETE
    np.testing.assert_array_equal(ours.times, cvodes.times)
    np.testing.assert_allclose(ours.q, cvodes.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.dq, cvodes.dq, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.command, cvodes.command, rtol=0, atol=1e-7)
    assert np.abs(ours.q - planar_q0).max() > 0.03


@pytest.mark.slow
def test_run_of_the_iiwa_is_that_of_cvodes() -> None:
    """7-DoF arm, impedance control, a push of 40 N at the elbow for 0.1 s, and the limits of the data sheet."""
    base = oc.problems.get("iiwa")
    chart = oc.fit(with_metric(base, "inertia"), oc.Polynomial(2), weights=(1000, 30, 150)).chart
    q = base.domain.centre
    law = Impedance(chart, 200.0)
    reference = Reference.steps(chart.labels, chart.phi(q), [(0.0, {"x": chart.phi(q)[0] + 0.02})], 0.4)
    pushes = [Push(0.05, 0.1, [40.0, 0.0, 0.0], link=3)]
    cvodes = simulate(law, reference, q, control_rate=1000, pushes=pushes, tolerance=1e-11)
    ours = simulate(law, reference, q, control_rate=1000, pushes=pushes, plant="mujoco")
    np.testing.assert_allclose(ours.q, cvodes.q, rtol=0, atol=1e-7)
    assert (np.abs(ours.command) < base.robot.effort_limits).all()
    assert np.abs(ours.dq).max() > 0.2


def test_payload_makes_the_arm_sag_and_a_wall_holds_it(law: PDPlus, planar_chart: oc.Chart, planar_q0: Array) -> None:
    robot = planar_chart.problem.robot
    rest = Reference.steps(planar_chart.labels, planar_chart.phi(planar_q0), [], 0.3)
    below = robot.tip_position(planar_q0) - np.array([0.0, 0.03, 0.0])
    wall = Wall(below, [0.0, 1.0, 0.0], tip_radius=0.02)
    sagging, held = (
        robot.tip_position(simulate(law, rest, planar_q0, control_rate=1000, plant=scene).q)[:, 1]
        for scene in (MuJoCo(payload=Payload(1.0)), MuJoCo(payload=Payload(1.0), wall=wall))
    )
    assert sagging[-1] < sagging[0] - 0.05
    assert held.min() > held[0] - 0.015  # the sphere meets the wall after 10 mm


@pytest.mark.slow
def test_stops_hold_a_pushed_joint_in_both_plants(law: PDPlus, planar_chart: oc.Chart, planar_q0: Array) -> None:
    """A torque of 60 N m pushes joint 2 against its limit for half a second."""
    limit = float(planar_q0[1]) + 0.1
    tight = with_upper_limit(planar_chart.problem.robot, 1, limit)
    rest = Reference.steps(planar_chart.labels, planar_chart.phi(planar_q0), [], 0.6)
    common = {"control_rate": 1000.0, "pushes": [Push(0.0, 0.5, torque=[0.0, 60.0, 0.0])]}
    free = simulate(law, rest, planar_q0, plant=tight, tolerance=1e-12, **common)  # type: ignore[arg-type]
    stopped = simulate(law, rest, planar_q0, plant=tight, stops=Stops(), **common)  # type: ignore[arg-type]
    ours = simulate(law, rest, planar_q0, plant=MuJoCo(tight), **common)  # type: ignore[arg-type]
    without = simulate(law, rest, planar_q0, plant=MuJoCo(tight, stops=False), **common)  # type: ignore[arg-type]
    assert free.q[:, 1].max() > limit + 0.2
    np.testing.assert_allclose(without.q, free.q, rtol=0, atol=1e-6)
    for run in (stopped, ours):
        assert limit < run.q[:, 1].max() < limit + 0.02
        assert run.q[500, 1] == pytest.approx(limit, abs=0.005)  # pressed against the stop
    np.testing.assert_allclose(stopped.q[500], ours.q[500], rtol=0, atol=0.005)  # in between they bounce differently


def test_motors_saturate_at_the_plants_efforts(law: PDPlus, planar_chart: oc.Chart, planar_q0: Array) -> None:
    """Too weak to hold itself, the arm falls, while the controller still asks for more."""
    robot = planar_chart.problem.robot
    weak = with_upper_limit(robot, 1, np.inf, effort=5.0)
    rest = Reference.steps(planar_chart.labels, planar_chart.phi(planar_q0), [], 0.2)
    run = simulate(law, rest, planar_q0, control_rate=1000, plant=MuJoCo(weak))
    assert np.abs(run.q[-1] - planar_q0).max() > 0.1
    assert np.abs(run.command).max() > 5.0
    strong = simulate(law, rest, planar_q0, control_rate=1000, plant=MuJoCo(weak, effort_limits=False))
    np.testing.assert_allclose(strong.q[-1], planar_q0, atol=1e-6)


def test_ctrl_c_keeps_the_run_so_far(law: PDPlus, steps: Reference, planar_q0: Array) -> None:
    def stop(progress: Progress) -> None:
        if progress.fraction > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as caught:
        simulate(law, steps, planar_q0, control_rate=1000, plant="mujoco", monitor=stop)
    run = caught.value.result
    assert run.outcome is Outcome.INTERRUPTED
    assert 0.1 < run.times[-1] < 0.4


def test_what_mujoco_does_not_simulate_is_refused_by_name(
    law: PDPlus, planar_chart: oc.Chart, steps: Reference, planar_q0: Array
) -> None:
    with pytest.raises(InvalidValueError, match="control_rate is None, expected a number, because MuJoCo"):
        simulate(law, steps, planar_q0, plant="mujoco")
    with pytest.raises(InvalidValueError, match="plant is 'bullet', expected a Robot, 'mujoco' or a MuJoCo"):
        simulate(law, steps, planar_q0, plant="bullet", control_rate=1000)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match=r"stops is given, expected none with MuJoCo"):
        simulate(law, steps, planar_q0, plant="mujoco", control_rate=1000, stops=Stops())
    with pytest.raises(InvalidValueError, match="plant is mujoco, expected no MuJoCo with a velocity controller"):
        simulate(Kinematic(planar_chart), steps, planar_q0, plant="mujoco", control_rate=1000)
    with pytest.raises(InvalidValueError, match="joints of the plant is 2, expected 3"):
        simulate(law, steps, planar_q0, plant=MuJoCo(oc.Robot.planar([1, 1], [1, 1])), control_rate=1000)
    with pytest.raises(InvalidValueError, match="robot is 'arm', expected a Robot"):
        MuJoCo("arm")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("link", "error", "message"),
    [
        ("elbow", UnknownNameError, "unknown link, named by the joint that moves it, 'elbow', known: q1, q2, q3"),
        (3, InvalidValueError, "link is 3, expected the name of a joint, or the index of one from 0 to 2"),
    ],
)
@pytest.mark.parametrize("plant", [None, "mujoco"])
def test_links_that_the_robot_lacks_are_named(
    law: PDPlus, steps: Reference, planar_q0: Array, link: str | int, error: type[Exception], message: str, plant: Plant
) -> None:
    with pytest.raises(error, match=message):
        simulate(law, steps, planar_q0, plant=plant, control_rate=1000, pushes=[Push(0.0, 0.1, [1.0, 0, 0], link=link)])
