"""What charts promise on every kind of domain, and on two of a user's: ranges, self-motions, trackers and inverses."""

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
import pytest

import orthocas as oc
from orthocas import problems
from orthocas.charts.self_motion import Interval
from orthocas.charts.trackers import RULES, TrackerStatus
from orthocas.charts.walls import Stop
from orthocas.errors import DomainError
from orthocas.tasks.corridor import Corridor
from orthocas.tasks.domains import StopKind
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

FOUND, NEAREST = oc.InverseStatus.FOUND, oc.InverseStatus.NEAREST
HAIR = 2.0**-20  # of the way to an end
CENTRE = problems.get("planar_3r_xy").domain.centre
FOLDS = {StopKind.FOLD, StopKind.SINGULAR, StopKind.ENDLESS}  # ends that no domain makes


class Round(oc.Domain):
    """A ball of which only `contains` is known."""

    name = "round"

    def __init__(self, centre: Array, radius: float) -> None:
        self.centre, self.radius = np.asarray(centre, dtype=float), radius
        self.half_width = np.full(self.centre.size, radius)

    def contains(self, q: object) -> object:
        return ((np.asarray(q) - self.centre) ** 2).sum(axis=-1) <= self.radius**2


class Ball(Round):
    """The ball of docs/how-to/extending.md."""

    name = "ball"

    @property
    def condition(self) -> "Ball":
        return self

    @property
    def heading(self) -> str:
        return f"|q - centre| <= {self.radius:g} rad"

    @property
    def pivots(self) -> ca.Function:
        q = ca.SX.sym("q", self.centre.size)
        return ca.Function("pivots", [q], [self.radius**2 - ca.sumsqr(q - self.centre)])


def corridor() -> Corridor:
    path = CENTRE + np.array([[-0.3, -0.2, 0.2], [0.0, 0.0, 0.0], [0.3, 0.2, -0.2]])
    return Corridor(oc.Box(CENTRE, 0.6), path, 0.15)


DOMAINS: dict[str, Callable[[oc.Task], oc.Domain]] = {
    "box": lambda task: oc.Box(CENTRE, 0.4),
    "torus": lambda task: oc.Torus(3),
    "clear box": lambda task: oc.ClearBox(oc.Box(CENTRE, 1.2), task, 0.3),
    "corridor": lambda task: corridor(),
    "ball": lambda task: Ball(CENTRE, 0.5),
    "round": lambda task: Round(CENTRE, 0.5),
}
ENDS = {
    "box": {StopKind.JOINT},
    "torus": FOLDS,
    "clear box": {StopKind.JOINT, StopKind.NEAR_SINGULAR},
    "regular part": {StopKind.JOINT, StopKind.NEAR_SINGULAR, StopKind.FOLD},
    "corridor": {StopKind.CONDITION},
    "ball": {StopKind.CONDITION},
    "round": {StopKind.CONDITION},
}
CHARTS = pytest.mark.parametrize("axes", ["xy", "x"], ids=["r=1", "r=2"])
KINDS = pytest.mark.parametrize("kind", ENDS)


@cache
def chart_of(kind: str, axes: str) -> oc.Chart:
    robot = problems.get("planar_3r_xy").robot
    task = oc.Task.position(robot, axes)
    if kind == "regular part":
        return oc.fit_wide(robot, task, oc.Box(CENTRE, 1.2), clearance=0.2).chart
    problem = oc.Problem(robot, task, "inertia", DOMAINS[kind](task))
    base = tuple(CENTRE.tolist())
    return oc.fit(problem, oc.Linear(base=base) if kind == "torus" else oc.Polynomial(3), samples=600).chart


def starts_of(chart: oc.Chart, count: int | None = None) -> Array:
    return sample_uniform(chart.problem.domain, count or 12 // (chart.r + 1), 5)


def newton(chart: oc.Chart, phi: Array, q: Array) -> Array | None:
    """The solution near q, by plain Newton steps; None if they do not converge, or go far."""
    new = q
    for _ in range(12):
        new = new + np.linalg.solve(
            chart.parts.batched_rates(new[None])[0], chart.parts.phi_map.difference(phi, chart.phi(new))
        )
        if np.abs(new - q).max() > 0.2:
            return None
    return new if np.abs(chart.parts.phi_map.difference(phi, chart.phi(new))).max() < 1e-10 else None


def walk(chart: oc.Chart, q: Array, k: int, end: float) -> tuple[Array, Array | None]:
    """Positions from q to a hair before an end of the k-th coordinate, (N, n), and that a hair beyond, (n,)."""
    here, row = chart.phi(q), chart.m + k
    onward = (end - here[row]) * np.eye(3)[row]
    points, share, step = [q], 0.0, 0.05
    while 1 - share > HAIR:
        step = min(step, (1 - share) / 2)
        new = newton(chart, here + (share + step) * onward, points[-1])
        if new is None:
            step /= 2
            assert step > HAIR / 16, f"no way on at {share} of the way"
            continue
        points.append(new)
        share, step = share + step, 2 * step
    return np.array(points), newton(chart, here + (1 + HAIR) * onward, points[-1])


def sides(chart: oc.Chart, q: Array) -> list[tuple[int, float, Stop]]:
    """Number of a coordinate, its end, and what stops it there, for all ends of ranges that are finite."""
    found = []
    for k, part in enumerate(chart.xi_range(q)):
        assert isinstance(part, Interval)
        found += [(k, part.low, part.low_stop), (k, part.high, part.high_stop)]
    return [side for side in found if np.isfinite(side[1])]


@pytest.mark.slow
@CHARTS
@KINDS
def test_ranges_end_where_the_domain_ends(kind: str, axes: str) -> None:
    chart = chart_of(kind, axes)
    domain, seen = chart.problem.domain, set()
    assert domain.name == kind
    for q in starts_of(chart):
        for k, end, stop in sides(chart, q):
            seen.add(stop.kind)
            before, beyond = walk(chart, q, k, end)
            assert domain.contains(before).all()
            det = np.abs(np.linalg.det(chart.parts.batched_rates(before)))
            if stop.kind in FOLDS and kind != "regular part":
                assert det[-1] < 0.02 * det.max()
                continue
            assert beyond is not None
            assert not domain.contains(beyond)
            if stop.kind is StopKind.JOINT:
                joint = chart.problem.robot.joint_names.index(stop.joint)
                assert before[-1, joint] == pytest.approx(stop.value, abs=1e-4)
            else:
                assert stop.condition == getattr(domain, "heading", f"the {kind}")
    assert seen <= ENDS[kind]
    assert StopKind.NEAR_SINGULAR in seen or kind != "clear box" or axes == "x"


@pytest.mark.slow
@CHARTS
@KINDS
def test_self_motions_stay_inside_and_keep_x(kind: str, axes: str) -> None:
    chart = chart_of(kind, axes)
    for q in starts_of(chart, 4):
        motion = chart.self_motion(q, samples=60)
        assert len(motion.q) > 4
        assert chart.problem.domain.contains(motion.q).all()
        np.testing.assert_allclose(chart.x(motion.q), np.tile(chart.x(q), (len(motion.q), 1)), atol=1e-9)
        kinds = {part.low_stop.kind for part in motion.extent} | {part.high_stop.kind for part in motion.extent}
        assert kinds <= ENDS[kind] | FOLDS


@pytest.mark.slow
@CHARTS
@KINDS
@pytest.mark.parametrize("inside", [False, True])
def test_values_within_a_range_are_found_from_there(kind: str, axes: str, inside: bool) -> None:
    chart = chart_of(kind, axes)
    starts, targets = [], []
    for q in starts_of(chart):
        for k, end, _ in sides(chart, q):
            for share in (0.9, 0.99):
                starts.append(q)
                targets.append(chart.phi(q))
                targets[-1][chart.m + k] += share * (end - targets[-1][chart.m + k])
    found = chart.solve(np.array(targets), np.array(starts), inside=inside)
    assert len(targets) >= 12
    assert found.found.all()
    assert chart.problem.domain.contains(found.q).all()
    np.testing.assert_allclose(chart.parts.phi_map.residual(np.array(targets), found.q), 0, atol=1e-8)


@pytest.mark.slow
@CHARTS
@KINDS
def test_statuses_of_the_inverse_say_where_q_lies(kind: str, axes: str) -> None:
    """Targets from inside and outside the domain, and values of xi that no q has."""
    chart = chart_of(kind, axes)
    domain = chart.problem.domain
    inside = starts_of(chart, 16)
    assert chart.solve(chart.phi(inside)).found.all()
    around = domain.centre + 1.5 * domain.half_width * np.random.default_rng(3).uniform(-1, 1, (16, 3))
    far = chart.phi(inside) + np.r_[np.zeros(chart.m), np.full(chart.r, 5.0)]
    for phi in (chart.phi(around), far):
        solutions = chart.solve(phi, inside)
        np.testing.assert_array_equal(solutions.found, domain.contains(solutions.q) & (solutions.error <= 1e-9))
        near = chart.solve(phi, inside, inside=True)
        kept = near.status <= NEAREST
        assert domain.contains(near.q[kept]).all()
        apart = chart.parts.phi_map.difference(phi, chart.phi(near.q))
        np.testing.assert_allclose(apart[kept, : chart.m], 0, atol=1e-8)
        np.testing.assert_allclose(near.distance[kept], np.linalg.norm(apart[kept, chart.m :], axis=1), atol=1e-9)
    assert (near.status == NEAREST).sum() > 8 or kind == "torus"  # where xi has no end


@pytest.mark.slow
@CHARTS
@KINDS
def test_nearest_xi_is_no_farther_than_a_known_position(kind: str, axes: str) -> None:
    chart = chart_of(kind, axes)
    own, wish = starts_of(chart, 24), starts_of(chart, 24)[::-1]
    near = chart.nearest_xi(wish, chart.x(own))
    assert (near.status <= NEAREST).all()
    assert chart.problem.domain.contains(near.q).all()
    np.testing.assert_allclose(chart.x(near.q), chart.x(own), atol=1e-8)
    apart = chart.parts.phi_map.difference(chart.phi(wish), chart.phi(own))[:, chart.m :]
    assert (near.distance <= np.linalg.norm(apart, axis=1) + 1e-9).all()
    assert (chart.nearest_xi(np.tile(CENTRE, (24, 1)), chart.x(own)).status <= NEAREST).all()


@CHARTS
@pytest.mark.parametrize("kind", ["clear box", "regular part"])
def test_poses_that_only_singular_positions_have_are_said_to_lie_outside(kind: str, axes: str) -> None:
    """A nearly stretched arm: the status was NOT_FOUND, though q had the pose within the limits."""
    chart = chart_of(kind, axes)
    domain = chart.problem.domain
    stretched = np.random.default_rng(2).uniform(-0.04, 0.04, (8, 3))
    assert not domain.contains(stretched).any()
    for wish in (stretched, np.tile(CENTRE, (8, 1))):
        near = chart.nearest_xi(wish, chart.x(stretched))
        assert (near.status == oc.InverseStatus.OUTSIDE_DOMAIN).all()
        assert not domain.contains(near.q).any()
        assert (np.abs(near.q - domain.centre) <= domain.half_width + 1e-9).all()
        np.testing.assert_allclose(chart.x(near.q), chart.x(stretched), atol=1e-8)
        assert near.error.max() < 1e-9
        apart = np.linalg.norm(chart.xi(near.q) - chart.xi(wish), axis=1)
        np.testing.assert_allclose(near.distance, apart, atol=1e-9)


def refuses_trackers(chart: oc.Chart) -> bool:
    """Whether a domain that only answers `contains` is refused, by name."""
    if chart.problem.domain.name != "round":
        return False
    for nearest in (False, True):
        with pytest.raises(DomainError, match="kind 'round' has no CasADi expression of its condition"):
            chart.tracker(CENTRE, nearest=nearest)
    return True


@pytest.mark.slow
@CHARTS
@KINDS
def test_trackers_go_to_the_end_of_a_range_and_stay(kind: str, axes: str) -> None:
    chart = chart_of(kind, axes)
    if refuses_trackers(chart):
        return
    for q in starts_of(chart, 4):
        for k, end, stop in sides(chart, q):
            tracker, phi = chart.tracker(q, largest_step=1.0), chart.phi(q)
            span, row = end - phi[chart.m + k], chart.m + k
            for point in walk(chart, q, k, end)[0]:
                last, reached = tracker.q, tracker.step(chart.phi(point))
                if kind == "torus" and tracker.status is not TrackerStatus.OK:  # nearly singular: steps are large
                    np.testing.assert_array_equal(reached, last)
                    break
                assert tracker.status is TrackerStatus.OK
                np.testing.assert_allclose(reached, point, atol=1e-7)
            last = tracker.q
            phi[row] += 1.001 * span
            np.testing.assert_array_equal(tracker.step(phi), last)
            if kind == "torus":
                assert tracker.status is not TrackerStatus.OUTSIDE_DOMAIN
            elif stop.kind is not StopKind.FOLD and newton(chart, phi, last) is not None:
                # A fold may lie beyond the limit; where it does, no posture has these values.
                assert tracker.status is TrackerStatus.OUTSIDE_DOMAIN


def cost(chart: oc.Chart, phi: Array, q: Array) -> Array:
    """What a tracker with `nearest=True` lowers, at points (N, n)."""
    weights = np.where(np.arange(3) < chart.m, 1 / chart.parts.phi_sizes, RULES.xi_weight)
    return np.asarray(((chart.parts.phi_map.difference(phi, chart.phi(q)) * weights) ** 2).sum(axis=1))


@pytest.mark.slow
@CHARTS
@KINDS
def test_reaching_trackers_rest_where_no_neighbour_is_nearer(kind: str, axes: str) -> None:
    chart = chart_of(kind, axes)
    if refuses_trackers(chart):
        return
    domain, rng, rests = chart.problem.domain, np.random.default_rng(7), 0
    for q in starts_of(chart, 4):
        tracker = chart.tracker(q, nearest=True)
        for shift in rng.normal(size=(4, 3)) * [2.0, 2.0, 0.3]:
            phi = chart.phi(q) + shift
            for _ in range(80):
                reached = tracker.step(phi)
                assert domain.contains(reached)
                if tracker.status in (TrackerStatus.NEAREST, TrackerStatus.OK):
                    break
            if tracker.status is TrackerStatus.NEAREST:
                around = reached + 10.0 ** rng.uniform(-4, -1.5, (1000, 1)) * rng.normal(size=(1000, 3))
                around = around[domain.contains(around)]
                here = cost(chart, phi, reached[None])[0]
                assert (cost(chart, phi, around) >= here * (1 - 1e-5)).all()
                rests += 1
    assert rests > 3
