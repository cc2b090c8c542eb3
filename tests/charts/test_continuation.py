"""Values within the range of a coordinate are found from the joint position that the range belongs to."""

from collections.abc import Callable

import numpy as np
import pytest
from charts import in_a_corridor
from public_objects import clear

import orthocas as oc
from orthocas.tasks.samples import sample_uniform

ROUNDING = 1e-12


def walk(chart: oc.Chart, q: np.ndarray, k: int, step: float) -> float:
    """The value of the k-th coordinate where it leaves the domain or turns back, in even steps and plain Newton."""
    phi, row = chart.phi(q), chart.m + k
    side = np.sign(np.linalg.det(chart.parts.batched_rates(q[None])[0]))
    for count in range(1, 100_000):
        target, new = phi.copy(), q.copy()
        target[row] += count * step
        for _ in range(6):
            new = new + np.linalg.solve(
                chart.parts.batched_rates(new[None])[0], chart.parts.phi_map.difference(target, chart.phi(new))
            )
        kept = np.abs(chart.parts.phi_map.difference(target, chart.phi(new))).max() < 1e-10
        turned = np.sign(np.linalg.det(chart.parts.batched_rates(new[None])[0])) != side
        if not kept or turned or np.abs(new - q).max() > 0.2 or not chart.problem.domain.contains(new):
            return float(phi[row] + (count - 1) * step)
        q = new
    raise AssertionError("the range has no end")


def on_a_box() -> oc.Chart:
    """A chart of a box on which the coordinate folds."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    domain = oc.Box([0.6, 0.9, 0.9], 0.9)
    return oc.fit(oc.Problem(robot, oc.Task.position(robot, "xy"), domain=domain), oc.Linear()).chart


KINDS: dict[str, Callable[[], oc.Chart]] = {
    "box": on_a_box,
    "clear box": clear,
    "corridor": in_a_corridor,
    "regular part": lambda: oc.charts.load("xarm7-wide"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_ends_of_a_range_are_found_from_there(kind: str) -> None:
    """Newton's method alone jumps past some: at 90 % of the ranges of xarm7-wide, 81 of 720."""
    chart = KINDS[kind]()
    assert chart.problem.domain.name == kind
    starts, targets = [], []
    for q in sample_uniform(chart.problem.domain, 12 if chart.r == 1 else 6, 5):
        for k in range(chart.r):
            for step in (-0.02, 0.02):
                end = walk(chart, q, k, step)
                for share in (0.9, 0.99):
                    target = chart.phi(q)
                    target[chart.m + k] += share * (end - target[chart.m + k])
                    starts.append(q)
                    targets.append(target)
    solutions = chart.solve(np.array(targets), np.array(starts))
    assert solutions.found.all()
    np.testing.assert_allclose(chart.parts.phi_map.residual(np.array(targets), solutions.q), 0, atol=1e-9)


def test_orientations_go_the_shorter_way_from_a_start() -> None:
    """Across half a turn from the reference of the task, where the components of x jump."""
    chart = oc.charts.load("iiwa7-wide")
    domain = chart.problem.domain
    q = sample_uniform(domain, 400, 2)
    step = np.zeros_like(q)
    step[:, 6] = 0.25
    inside = domain.contains(q + step)
    q, other = q[inside], (q + step)[inside]
    seam = np.abs(chart.x(other) - chart.x(q))[:, 3:].max(axis=1) > 1.0
    assert seam.sum() > 5
    assert chart.solve(chart.phi(other[seam]), q[seam]).found.all()
