"""Boundaries of domains with a condition: damped before them, caught in time, brought back."""

from pathlib import Path

import numpy as np
import pytest
from programs import needs_c
from supervised import TICK, Arm, at_rest, moving, run

import orthocas as oc
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.regular_part import RegularPart
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, PDPlus, Safety, matched_stiffness
from orthocas.paths import corridor_problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

pytestmark = needs_c


@pytest.mark.slow
def test_the_bound_on_singular_values_is_a_boundary_with_a_zone_before_it(tmp_path: Path) -> None:
    """Led slowly towards a straight arm: damped, caught before the bound, brought back; torques change smoothly."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    box = oc.Box([0.6, 0.8, 0.8], [0.8, 1.2, 1.2])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=box, least_singular_value=0.2)
    clear = problem.domain
    assert isinstance(clear, oc.ClearBox)
    chart = oc.fit(problem, oc.Polynomial(3)).chart
    law = PDPlus.on_chart(chart)
    generated = oc.generate_c(chart, tmp_path, law, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3)
    supervisor = Supervisor(library, law, Safety.of(law, command_rate=np.inf, reference_acceleration=np.inf))
    straight, speed = np.array([0.6, 0.0, 0.1]), np.array([0.0, -0.2, -0.175])
    start = straight - 2 * speed
    arm = Arm(robot, start)
    supervisor.start(start)
    run(supervisor, arm, at_rest(chart, start), 0.2)
    statuses, commands, path = [], [], []
    for k in range(2000):
        command, status = supervisor.step(arm.q, arm.dq, moving(chart, start + k * TICK * speed, speed), TICK)
        arm.move(command)
        statuses.append(status)
        commands.append(command)
        path.append(arm.q)
    sizes = clear.singular_values(np.array(path))
    first = [statuses.index(status) for status in (ControlStatus.NEAR_BOUNDARY, ControlStatus.CAUGHT)]
    assert [set(part) for part in np.split(np.array(statuses), first)] == [
        {ControlStatus.OK},
        {ControlStatus.NEAR_BOUNDARY},
        {ControlStatus.CAUGHT},
    ]
    assert first[1] - first[0] > 10
    span = clear.singular_values(box.centre) - 0.2
    assert sizes[first[0]] == pytest.approx(0.2 + 0.06 * span, abs=0.01 * span)
    assert min(sizes[: first[1] + 1]) > 0.2
    changes = np.abs(np.diff(commands, axis=0)).max(axis=1)
    assert max(changes[k - 1] for k in first) < 0.5  # [N m] where the status changes
    handing = slice(first[1], first[1] + 30)  # the ticks of fade_out
    assert changes[handing].max() < 0.1 * np.ptp(commands[handing], axis=0).max()  # 1/30 if it were even
    assert np.delete(changes, handing)[first[0] - 100 :].max() < 1.0
    assert np.abs(arm.dq).max() < 1e-3
    supervisor.resume()
    statuses, _, _ = run(supervisor, arm, at_rest(chart, box.centre), 2.5)
    assert statuses[0] is ControlStatus.RETURNING
    assert statuses[-1] is ControlStatus.OK


def volumes_of(robot: oc.Robot, gradients: Array, q: Array) -> Array:
    """Cosines between gradients of a coordinate and self-motions of a planar arm, without their signs, (N,)."""
    moved = [(robot.tip_position(q + e) - robot.tip_position(q - e))[:, :2] / 2e-6 for e in 1e-6 * np.eye(3)]
    along = np.linalg.svd(np.stack(moved, axis=2))[2][:, -1]
    return np.asarray(np.abs((along * gradients).sum(axis=1)) / np.linalg.norm(gradients, axis=1))


@pytest.mark.slow
def test_the_end_of_coordinates_is_a_boundary_with_a_zone_before_it(tmp_path: Path) -> None:
    """Led towards where a wide chart leans into the task: damped, caught before the bound, brought back.

    Soft springs lag behind where the arm is damped. Those of tracking laws do not: they lead it 1e-4 past the bound.
    """
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    box = oc.Box([0.6, 1.2, 1.2], [0.8, 1.1, 1.1])
    loose = oc.Weights(task=1e-6, mutual=0.0, regularity=0.0)
    wide = oc.fit_wide(
        robot, oc.Task.position(robot, "xy"), box, clearance=0.05, parametrisation=oc.Polynomial(2), weights=loose
    )
    clear, coordinates, bound = wide.chart.problem.domain, wide.chart.coordinates, 0.9
    assert isinstance(coordinates, Coordinates)
    domain = RegularPart(clear, coordinates, bound)
    chart = oc.Chart(oc.Problem(robot, wide.chart.problem.task, domain=domain), coordinates)
    law = PDPlus(chart, matched_stiffness(chart))
    library = CompiledLibrary(compile_shared(oc.generate_c(chart, tmp_path, law, "arm"), tmp_path), "arm", 3)
    supervisor = Supervisor(library, law, Safety.of(law, command_rate=np.inf, reference_acceleration=np.inf))
    start = domain.centre
    inner = sample_uniform(oc.Box(box.centre, 0.9 * box.half_width), 2000, 0)
    beyond = inner[(clear.singular_values(inner) > 0.3) & (domain.volumes(inner) < bound - 0.02)][0]
    speed = 0.3 * (beyond - start) / np.linalg.norm(beyond - start)
    arm = Arm(robot, start)
    supervisor.start(start)
    run(supervisor, arm, at_rest(chart, start), 0.2)
    statuses, path = [], []
    for k in range(round(np.linalg.norm(beyond - start) / 0.3 / TICK)):
        command, status = supervisor.step(arm.q, arm.dq, moving(chart, start + k * TICK * speed, speed), TICK)
        arm.move(command)
        statuses.append(status)
        path.append(arm.q)
    visited = np.array(path)
    volumes = volumes_of(robot, chart.coordinates.jacobian(visited)[:, 0], visited)
    first = [statuses.index(status) for status in (ControlStatus.NEAR_BOUNDARY, ControlStatus.CAUGHT)]
    assert set(statuses[: first[0]]) == {ControlStatus.OK}
    assert set(statuses[first[0] : first[1]]) == {ControlStatus.NEAR_BOUNDARY}
    assert first[1] - first[0] > 10
    usual = np.median(domain.volumes(sample_uniform(domain, 4000, 1))) - bound
    assert volumes[first[0]] == pytest.approx(bound + 0.06 * usual, abs=0.02 * usual)
    assert min(volumes) > bound
    assert np.abs(arm.dq).max() < 1e-3
    supervisor.resume()
    statuses, _, _ = run(supervisor, arm, at_rest(chart, start), 4.0)
    assert statuses[0] is ControlStatus.RETURNING
    assert statuses[-1] is ControlStatus.OK


PATH = np.array([[0.0, 0.6, 0.8], [0.6, 1.4, 1.2]])
RADIUS = 0.3


@pytest.fixture(scope="module")
def in_corridor(planar_xy: oc.Problem, tmp_path_factory: pytest.TempPathFactory) -> tuple[PDPlus, CompiledLibrary]:
    """A law near a path of postures; joint 1 is cyclic, so its distance to the path does not count."""
    problem = corridor_problem(planar_xy, PATH, RADIUS)
    law = PDPlus.on_chart(oc.fit(problem, oc.Polynomial(2, "auto"), samples=400).chart)
    out = tmp_path_factory.mktemp("corridor")
    generated = oc.generate_c(law.chart, out, law, "arm")
    return law, CompiledLibrary(compile_shared(generated, out), "arm", 3)


def from_path(q: Array) -> tuple[float, Array]:
    """Distance from the path in radii, and its nearest point, in the joints 2 and 3."""
    apart, way = (q - PATH[0])[1:], (PATH[1] - PATH[0])[1:]
    nearest = PATH[0] + np.clip(apart @ way / (way @ way), 0, 1) * (PATH[1] - PATH[0])
    return float(np.linalg.norm((q - nearest)[1:])) / RADIUS, np.asarray(nearest)


@pytest.mark.slow
def test_the_distance_to_the_path_of_a_corridor_is_a_boundary_with_a_zone_before_it(
    in_corridor: tuple[PDPlus, CompiledLibrary],
) -> None:
    """Led off the path: damped in the last 6 % of the radius, caught in the last 1 %, as far as it gets in 30 ms."""
    law, library = in_corridor
    chart, speed = law.chart, np.array([0.1, 0.2, -0.2])
    start = PATH.mean(axis=0) + 0.8 * speed
    supervisor = Supervisor(library, law, Safety.of(law, command_rate=np.inf, reference_acceleration=np.inf))
    assert library.check() < 1e-9
    supervisor.start(start)
    for _ in range(100):
        supervisor.step(start, np.zeros(3), at_rest(chart, start), TICK)
    damped, statuses = 0, []
    for k in range(2000):
        q = start + k * TICK * speed
        reference = moving(chart, q, speed)
        command, status = supervisor.step(q, speed, reference, TICK)
        statuses.append(status)
        room = 1 - from_path(q)[0]
        if status is ControlStatus.CAUGHT:
            ahead = 1 - from_path(q + 0.03 * speed)[0]
            assert ahead < 0.01 < room + 1e-6
            break
        assert status is (ControlStatus.NEAR_BOUNDARY if room < 0.06 else ControlStatus.OK)
        if room < 0.059:
            alone = law.function(q, speed, *np.split(reference, 3), *law.gains.values())[0].full().ravel()
            drag = 12.0 * (0.06 - room) / 0.05 * law.problem.robot.mass_matrix(q) @ speed
            np.testing.assert_allclose(command, alone - drag, atol=1e-6)
            damped += 1
    assert damped > 20
    assert statuses[-1] is ControlStatus.CAUGHT
    assert supervisor.cause == ControlStatus.OUTSIDE_DOMAIN


@pytest.mark.slow
@pytest.mark.parametrize("beyond", [[0.4, 0.9, -0.2], [2.0, -0.8, -0.3]])  # beside the path, and before its begin
def test_from_outside_of_a_corridor_the_arm_goes_to_the_nearest_part_of_the_path(
    in_corridor: tuple[PDPlus, CompiledLibrary], beyond: list[float]
) -> None:
    law, library = in_corridor
    supervisor = Supervisor(library, law, Safety.of(law, return_speed=0.02))
    q, still = PATH.mean(axis=0) + beyond, np.zeros(3)
    assert not law.problem.domain.contains(q)
    supervisor.start(q)
    assert supervisor.step(q, still, at_rest(law.chart, q), TICK)[1] is ControlStatus.CAUGHT
    distance, nearest = from_path(q)
    goal = nearest + 0.85 / distance * (q - nearest)  # 0.05 radii inside the margin of return
    np.testing.assert_allclose(supervisor.safe, [q[0], *goal[1:]], atol=1e-4)
    supervisor.resume()
    statuses = []
    while len(statuses) < 20000 and ControlStatus.OK not in statuses:  # an arm that is always where the anchor is
        statuses.append(supervisor.step(supervisor.anchor, still, at_rest(law.chart, q), TICK)[1])
    assert set(statuses) == {ControlStatus.RETURNING, ControlStatus.OK}
    assert from_path(supervisor.q)[0] < 0.9
