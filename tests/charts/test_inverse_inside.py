"""Rows that are kept inside the domain: the nearest coordinates at the same task values."""

from itertools import combinations, product

import casadi as ca
import numpy as np
import pytest
from charts import beyond_domain
from public_objects import clear

import orthocas as oc
from orthocas.charts.descent import Programs, solve_programs
from orthocas.charts.inside import project
from orthocas.fitting.fit import Fit
from orthocas.tasks.samples import sample_uniform

FOUND, NEAREST = oc.InverseStatus.FOUND, oc.InverseStatus.NEAREST


def test_inside_gives_the_nearest_coordinates_that_keep_the_task(planar_arm: oc.Chart) -> None:
    """No point of a fine net of self-motions inside the domain is nearer, and rows without such points say so."""
    domain = planar_arm.problem.domain
    phi = planar_arm.phi(beyond_domain(planar_arm, 60, 1.25))
    solutions = planar_arm.solve(phi, inside=True)
    assert {FOUND, NEAREST} <= set(solutions.statuses)
    kept = np.isin(solutions.status, (FOUND, NEAREST))
    assert domain.contains(solutions.q).all()
    np.testing.assert_allclose(planar_arm.x(solutions.q[kept]), phi[kept, :2], atol=1e-8)
    np.testing.assert_allclose(solutions.distance, np.abs(planar_arm.xi(solutions.q) - phi[:, 2:])[:, 0], atol=1e-9)
    for k in np.flatnonzero(solutions.status != FOUND):
        inner = self_motion(planar_arm, phi[k, :2])
        if solutions.status[k] == NEAREST:
            least = np.abs(planar_arm.xi(inner) - phi[k, 2]).min() if len(inner) else np.inf
            assert solutions.distance[k] <= least + 1e-9
        else:
            assert len(inner) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ur5-position", "pr2-left-wide"])
def test_inside_finds_what_a_search_without_it_finds(name: str) -> None:
    """r > 1: all of these rows have solutions inside the domain; searches in and beyond it begin at the same places."""
    chart = oc.load(name)
    phi = chart.phi(chart.domain.sample(200, 7))
    found = chart.solve(phi).found
    assert found.mean() > 0.99
    assert chart.solve(phi[found], inside=True).found.all()


def self_motion(planar_arm: oc.Chart, x: np.ndarray) -> np.ndarray:
    """Joint positions of the planar arm inside the domain with the tip at x, in closed form for 4,001 last joints."""
    domain = planar_arm.problem.domain
    wrist_angle = np.linspace(*(domain.centre[2] + domain.half_width[2] * np.array([-1, 1])), 4001)
    reach = np.hypot(1 + np.cos(wrist_angle), np.sin(wrist_angle))  # of links 2 and 3 as one
    bend = np.arctan2(np.sin(wrist_angle), 1 + np.cos(wrist_angle))
    cosine = (x @ x - 1 - reach**2) / (2 * reach)
    found = []
    for sign in (-1, 1):
        with np.errstate(invalid="ignore"):
            elbow = sign * np.arccos(cosine)
        shoulder = np.arctan2(x[1], x[0]) - np.arctan2(reach * np.sin(elbow), 1 + reach * np.cos(elbow))
        found.append(np.stack([shoulder, elbow - bend, wrist_angle], axis=1))
    q = np.concatenate(found)
    q = q[np.isfinite(q).all(axis=1)]
    return q[domain.contains(q)]


def test_inside_keeps_clear_of_singular_positions() -> None:
    """The part of a box that is clear counts as inside, and no other."""
    chart = clear()
    box = oc.Box(chart.problem.domain.centre, 1.2 * chart.problem.domain.half_width)
    solutions = chart.solve(chart.phi(sample_uniform(box, 150, 1)), inside=True)
    kept = np.isin(solutions.status, (FOUND, NEAREST))
    assert (solutions.status == NEAREST).sum() > 5
    assert chart.problem.domain.contains(solutions.q[kept]).all()


def test_descents_end_as_near_as_ipopt(iiwa_fit: Fit) -> None:
    """From the same starts, both end at the same distance; Ipopt stays a little off the boundary."""
    chart = iiwa_fit.chart
    phi = chart.phi(beyond_domain(chart, 60, 1.3))
    inside = chart.parts.inverse.inside
    assert inside is not None
    q, in_reach = inside.with_task(phi, np.tile(chart.problem.domain.centre, (60, 1)))
    assert 20 < in_reach.sum() < 60
    phi, q = phi[in_reach], q[in_reach]
    mine, theirs = inside.nearer(phi, q), by_ipopt(chart, phi, q)
    assert chart.problem.domain.contains(mine).all()
    np.testing.assert_allclose(chart.x(mine), phi[:, : chart.m], atol=1e-9)
    away, theirs_away = (np.linalg.norm(chart.xi(found) - phi[:, chart.m :], axis=1) for found in (mine, theirs))
    np.testing.assert_allclose(away, theirs_away, atol=1e-6)


def by_ipopt(chart: oc.Chart, phi: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Where Ipopt ends from starts (N, n) with the task values kept."""
    low, high = chart.problem.domain.bounds
    q, target = ca.MX.sym("q", chart.n), ca.MX.sym("phi", chart.n)
    error = chart.function("phi")(q) - target
    program = {"x": q, "p": target, "f": ca.sumsqr(error[chart.m :]) / 2, "g": error[: chart.m]}
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9}
    solver = ca.nlpsol("nearest", "ipopt", program, options)
    found = [
        solver(x0=start, p=value, lbx=low, ubx=high, lbg=0, ubg=0)["x"]
        for start, value in zip(starts, phi, strict=True)
    ]
    return np.clip(np.array(ca.horzcat(*found)).T, low, high)


def test_bounded_programs_have_the_least_of_all_active_sets() -> None:
    """With 4 variables there are 81 guesses which bounds hold; the least allowed value is the minimum."""
    rng, n = np.random.default_rng(3), 4
    root = rng.standard_normal((50, n, n))
    H, g, high = root @ root.transpose(0, 2, 1), 3 * rng.standard_normal((50, n)), rng.uniform(0, 1, (50, n))
    programs = Programs(H, g, -rng.uniform(0, 1, (50, n)), high)
    d, _, solved = solve_programs(programs, np.zeros((50, n), dtype=np.int8))
    assert solved.mean() >= 0.98
    for k in np.flatnonzero(solved):
        values = [value(programs, k, np.array(held)) for held in product((-1, 0, 1), repeat=n)]
        assert np.isclose(d[k] @ programs.H[k] @ d[k] / 2 + programs.g[k] @ d[k], min(values), atol=1e-9)


def value(programs: Programs, k: int, held: np.ndarray) -> float:
    """The least value of a program with some variables at their low (-1) or high (1) bounds, or infinity."""
    H, g, low, high = (getattr(programs, name)[k] for name in ("H", "g", "low", "high"))
    d, free = np.where(held < 0, low, high), held == 0
    if free.any():
        d[free] = np.linalg.solve(H[np.ix_(free, free)], -g[free] - H[np.ix_(free, ~free)] @ d[~free])
    allowed = (d >= low - 1e-9).all() and (d <= high + 1e-9).all()
    return float(d @ H @ d / 2 + g @ d) if allowed else np.inf


def test_projections_are_the_nearest_points_of_polygons() -> None:
    """In a plane, the nearest point is the wish, or its foot on one bound, or a corner: the nearest allowed of all.

    Guesses which bounds hold, right or wrong, change nothing.
    """
    rng, k = np.random.default_rng(5), 5
    B, wanted = rng.standard_normal((80, k, 2)), 3 * rng.standard_normal((80, 2))
    low, high = -rng.uniform(0, 1, (80, k)), rng.uniform(0, 1, (80, k))
    z, held = project(B, low, high, wanted, np.zeros((80, k), dtype=np.int8))
    for guess in (held, rng.integers(-1, 2, (80, k), dtype=np.int8)):
        np.testing.assert_allclose(project(B, low, high, wanted, guess)[0], z, atol=1e-8)
    values = (B @ z[:, :, None])[:, :, 0]
    assert (values >= low - 1e-9).all()
    assert (values <= high + 1e-9).all()
    for i in range(80):
        lines = [(B[i, j], bound) for j in range(k) for bound in (low[i, j], high[i, j])]
        points = [wanted[i], *(wanted[i] + (bound - b @ wanted[i]) / (b @ b) * b for b, bound in lines)]
        points += [
            np.linalg.solve([b, other], [bound, at])
            for (b, bound), (other, at) in combinations(lines, 2)
            if abs(np.linalg.det([b, other])) > 1e-12
        ]
        allowed = [p for p in points if (B[i] @ p >= low[i] - 1e-9).all() and (B[i] @ p <= high[i] + 1e-9).all()]
        least = min(np.linalg.norm(p - wanted[i]) for p in allowed)
        assert abs(np.linalg.norm(z[i] - wanted[i]) - least) < 1e-8
