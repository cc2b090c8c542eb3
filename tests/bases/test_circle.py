"""Circle-valued coordinates: smooth around closed leaves, in fits, inverse maps, control laws and simulation."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import orthocas as oc
from orthocas import solvers
from orthocas.bases import JointSpace
from orthocas.bases.composed import CircleFamily
from orthocas.certificates import check_certificate
from orthocas.charts.coordinates import Coordinates
from orthocas.codegen import check_c
from orthocas.control import Kinematic, Reference
from orthocas.errors import InvalidValueError
from orthocas.tools.expressions import wrap_shortest

RING = oc.Box([0.0, 1.2], [np.pi, 0.4], unbounded=[0])  # joint 1 turns without end


def ring() -> oc.Problem:
    """The radius of a planar arm: its leaves are circles of q1."""
    robot = oc.Robot.planar([1.0, 0.7], [3.0, 2.0])
    task = oc.Task.custom(robot, "radius", lambda q: ca.sqrt(1.49 + 1.4 * ca.cos(q[1])))
    return oc.Problem(robot, task, "euclidean", RING)


@pytest.fixture(scope="module")
def around() -> oc.Chart:
    """Coordinates of the ring; joint 1 is not split off, so that they have to be learned."""
    weights, solver = (1000, 0, 150), solvers.LBFGS(max_iterations=150)  # the third forbids folds, and so makes it wind
    return oc.fit(ring(), oc.Circle(oc.Fourier(2)), solver, weights=weights, samples=300, split_idle=False).chart


def family() -> tuple[CircleFamily, np.ndarray, np.ndarray]:
    space = JointSpace(np.zeros(3), np.ones(3), (False,) * 3, ("a", "b", "c"))
    found = oc.Circle(oc.Polynomial(2)).family(space, 2)
    return found, np.random.default_rng(3).normal(size=found.size), np.random.default_rng(4).normal(size=(3, 5))


def evaluated(found: CircleFamily, theta: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles (r, N) and gradients (r, n, N)."""
    points, parameters = ca.SX.sym("q", *q.shape), ca.SX.sym("theta", len(theta))
    parts = [found.expression(points, parameters), *found.jacobian(points, parameters)]
    xi, *gradients = ca.Function("circle", [points, parameters], parts).call([q, theta])
    return np.asarray(xi), np.array([np.asarray(part) for part in gradients])


def test_gradients_are_those_of_the_angles() -> None:
    found, theta, q = family()
    gradients = evaluated(found, theta, q)[1]
    for k in range(3):
        shift = 1e-6 * np.eye(3)[:, [k]]
        ahead, behind = (evaluated(found, theta, q + sign * shift)[0] for sign in (1, -1))
        slopes = wrap_shortest((ahead - behind).T, np.full(2, 2 * np.pi)).T / 2e-6
        assert gradients[:, k] == pytest.approx(slopes, rel=1e-5, abs=1e-6)


def test_turning_and_reordering_the_pairs_does_so_to_the_angles() -> None:
    found, theta, q = family()
    xi, angles = evaluated(found, theta, q)[0], np.array([0.4, -2.0])
    turned = evaluated(found, found.turned(theta, angles), q)[0]
    assert np.exp(1j * turned) == pytest.approx(np.exp(1j * (xi - angles[:, None])))
    assert evaluated(found, found.reordered(theta, [1, 0]), q)[0] == pytest.approx(xi[::-1])


def test_coordinate_of_a_closed_leaf_has_no_fold_and_no_cut(around: oc.Chart) -> None:
    """Real-valued coordinates have a fold on every circle. This one follows the angle of joint 1 all around."""
    turn = np.linspace(0, 2 * np.pi, 200)
    points = np.column_stack([turn, np.full(200, 1.3)])
    xi = np.unwrap(around.xi(points)[:, 0])
    assert abs(xi[-1] - xi[0]) == pytest.approx(2 * np.pi * round(abs(xi[-1] - xi[0]) / (2 * np.pi)), abs=1e-9)
    rises = np.diff(xi)
    assert (rises > 0).all() or (rises < 0).all()
    assert abs(xi[-1] - xi[0]) > 6
    assert oc.evaluate(around, 2000).task_angle.max < 0.5  # q1 itself is exact
    assert around.parts.turns.tolist() == [0, 2 * np.pi]
    assert around.xi([0.0, 1.2]) == pytest.approx([0.0], abs=1e-12)


def test_inverse_goes_the_shorter_way_across_the_cut(around: oc.Chart) -> None:
    """Targets just beyond pi are reached from starts just before, by all solvers of phi(q) = phi."""
    q = around.inverse([around.task([0.0, 1.3])[0], np.pi - 0.01], [0.5, 1.3])
    phi = around.phi(q)
    beyond = phi + np.array([0.0, 0.03])
    many = np.tile(beyond, (20, 1))  # more than a few rows go another way
    starts = np.tile(q, (20, 1))
    found = around.solve(many, starts).require(inside=False).q
    steps = [around.inverse(beyond, q), found[7], around.function("inverse")(beyond, q).full().ravel()]
    steps.append(around.tracker(q).step(beyond))
    for reached in steps:
        assert np.abs(reached - q).max() < 0.1
        assert wrap_shortest(around.phi(reached) - beyond, around.parts.turns) == pytest.approx(np.zeros(2), abs=1e-8)
    wanted = beyond - np.array([0.0, 2 * np.pi])  # the same point of the circle
    assert around.inverse(wanted, q) == pytest.approx(steps[0], abs=1e-9)


def test_laws_pull_the_shorter_way(around: oc.Chart) -> None:
    error = wrap_shortest(ca.DM([0.1, 6.0]), around.parts.turns)
    assert np.asarray(error).ravel() == pytest.approx([0.1, 6.0 - 2 * np.pi])


def test_velocity_control_goes_round_more_than_once(around: oc.Chart) -> None:
    """The reference counts turns, the measured angle does not; the error stays that of the integration."""
    q0 = np.array([0.0, 1.2])
    start = around.phi(q0)
    reference = Reference.steps(around.labels, start, [(0.0, {"xi1": start[1] + 9.0})], 4.0)
    run = oc.simulate(Kinematic(around, 5.0, limit=np.inf), reference, q0, must_be_reachable=False)
    assert run.tracking_error.max() < 1e-4
    assert 7 < abs(run.q[-1, 0] - q0[0]) < 11  # one turn and a half
    assert run.value[-1, 1] == pytest.approx(start[1] + 9.0, abs=0.01)


def test_self_motion_counts_on_across_the_cut(around: oc.Chart) -> None:
    motion = around.self_motion([0.0, 1.2])
    assert motion.closed
    assert np.abs(np.diff(motion.xi[:, 0])).max() < 0.5
    assert np.ptp(motion.xi[:, 0]) > 6


@pytest.mark.slow
def test_grown_circle_is_distilled_across_its_cut() -> None:
    """cos xi and sin xi are smooth where xi jumps; here xi is the angle of joint 1 itself."""
    grown = oc.grow(ring(), leaf="circle")
    smooth = oc.distil(grown, oc.Circle(oc.Fourier(1)), samples=500)
    assert smooth.value_rms[0] < 1e-6
    assert smooth.gradient_rms[0] < 1e-6
    assert oc.distil(grown, oc.Fourier(4), samples=500).value_rms[0] > 0.1
    with pytest.raises(InvalidValueError, match="no coordinate of the chart is an angle"):
        oc.distil(oc.grow(oc.problems.get("planar_3r_x"), leaf="linear"), oc.Circle(oc.Fourier(1)))


def test_chart_file_keeps_the_circle(around: oc.Chart, tmp_path: Path) -> None:
    around.save(tmp_path / "c.orthocas")
    again = oc.load(tmp_path / "c.orthocas")
    q = np.array([[0.4, 1.1], [3.0, 1.4]])
    assert (again.xi(q) == around.xi(q)).all()
    assert again.coordinates.label == "circle:fourier:2"
    assert again.parts.turns.tolist() == around.parts.turns.tolist()


@pytest.mark.slow
def test_c_equals_python_and_its_inverse_crosses_the_cut(around: oc.Chart, tmp_path: Path) -> None:
    law = Kinematic(around, 5.0)
    generated = oc.generate_c(around, tmp_path / "c", law, name="ring")
    assert max(check_c(generated, around, law, states=100).differences.values()) < 1e-10
    assert "xi1 is an angle [rad]" in (tmp_path / "c" / "ring.h").read_text()
    q = around.inverse([around.task([0.0, 1.3])[0], np.pi - 0.01], [0.5, 1.3])
    beyond = around.phi(q) + np.array([[0.0, 0.03], [0.0, 0.03 - 6 * np.pi]])  # the same point of the circle
    found = oc.compile_inverse(around, tmp_path).solve(beyond, np.tile(q, (2, 1))).require().q
    assert np.abs(found - q).max() < 0.1
    assert found[0] == pytest.approx(found[1], abs=1e-9)
    assert wrap_shortest(around.phi(found) - beyond, around.parts.turns) == pytest.approx(np.zeros((2, 2)), abs=1e-8)


def bounded(chart: oc.Chart, half_width: float) -> oc.Chart:
    whole, box = chart.problem, oc.Box([0.0, 1.2], [half_width, 0.4])
    return replace(chart, problem=oc.Problem(whole.robot, whole.task, whole.metric, box))


@pytest.mark.slow
def test_certificate_of_a_ring_ends_one_to_one_before_a_whole_turn(around: oc.Chart) -> None:
    """The whole ring has no fold; but its ends share phi, so it is one-to-one on less than a turn only."""
    whole = bounded(around, np.pi)
    certificate = oc.certify(whole)
    assert certificate.proved
    assert certificate.injective is not None
    low, high = certificate.injective.low[0], certificate.injective.high[0]
    change = np.ptp(np.unwrap(around.xi(np.column_stack([np.linspace(low, high, 100), np.full(100, 1.2)]))[:, 0]))
    assert 2 < change < 2 * np.pi
    assert check_certificate(whole, certificate)


@pytest.mark.slow
def test_path_goes_round_by_the_shorter_ways_of_its_schedule(around: oc.Chart) -> None:
    """Angles from -pi to pi at the waypoints mean the same as angles that count on."""
    bend = 0.05 * np.sin(np.linspace(0, np.pi, 9))
    path, xi = around.task([0.0, 1.2]) + bend[:, None], np.linspace(0, 10, 9)[:, None]
    motions = [
        oc.follow(around, path, schedule, q_start=[0.0, 1.2], velocity_limits=1.0, period=0.1)
        for schedule in (xi, wrap_shortest(xi, np.array([2 * np.pi])))
    ]
    assert np.abs(motions[1].q - motions[0].q).max() < 1e-9
    assert np.ptp(motions[1].q[:, 0]) > 2 * np.pi
    assert motions[1].xi[-1, 0] == pytest.approx(10.0)
    chosen = oc.follow(around, path, "objective", q_start=[3.1, 1.2], velocity_limits=1.0, period=0.1)
    assert np.abs(np.diff(chosen.xi[:, 0])).max() < 0.5


def test_sets_of_self_motions_refuse_circles_in_one_line() -> None:
    problem = oc.problems.get("planar_3r_x")
    own = Coordinates(
        oc.Circle(oc.Fourier(1)), JointSpace.of(problem), (), np.linspace(0.1, 1, 28), np.zeros(2), np.ones(2)
    )
    with pytest.raises(InvalidValueError, match=r"chart is one with circle-valued coordinates \(xi1, xi2\)"):
        oc.Chart(problem, own).self_motion(problem.domain.centre)


@pytest.mark.parametrize("pairs", [oc.Linear(), oc.Circle(oc.Fourier(1)), "fourier:2", oc.Fourier(2, cyclic=("q1",))])
def test_pairs_are_families_to_fit(pairs: object) -> None:
    with pytest.raises(InvalidValueError, match="pairs"):
        oc.Circle(pairs)  # type: ignore[arg-type]
