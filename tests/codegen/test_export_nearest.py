"""The nearest xi of exported modules: feasible, no worse than what others find, with derivatives."""

import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from public_objects import fitted, planar
from scipy.optimize import minimize
from test_export import array_of, module_of
from test_export_inverse import CHARTS as CHARTS_OF_INVERSE

import orthocas as oc
from orthocas.charts.inverse import InverseStatus
from orthocas.codegen.export import LIBRARIES
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

FOUND, NEAREST, NOT_FOUND, BAD_INPUT = 0, 1, 5, 6


@cache
def position() -> oc.Chart:
    """A box with four coordinates."""
    return oc.charts.load("panda-position")


SHARED = ("box", "clear box", "wide", "corridor", "a user's domain", "pose, wide")
CHARTS = {name: CHARTS_OF_INVERSE[name] for name in SHARED} | {"position": position}


def wishes_of(chart: oc.Chart, count: int = 300, away: float = 0.3) -> tuple[Array, Array]:
    """Postures in a domain, and task values of others nearby."""
    domain, rng = chart.problem.domain, np.random.default_rng(4)
    wishes = sample_uniform(domain, count, 3)
    others = wishes + away * domain.half_width * rng.uniform(-1, 1, wishes.shape)
    kept = domain.contains(others)
    return wishes[kept], chart.x(others[kept])


def missed(chart: oc.Chart, wishes: Array, x: Array, q: Array) -> tuple[Array, Array]:
    """The largest error of x, and the distance of xi, (N,) each."""
    target = np.concatenate([x, chart.xi(wishes)], axis=1)
    away = chart.parts.phi_map.difference(target, chart.phi(q))
    error = np.abs(away / chart.parts.phi_map.scale(target))[:, : chart.m].max(axis=1)
    return error, np.linalg.norm(away[:, chart.m :], axis=1)


def something_nearer_around(chart: oc.Chart, wish: Array, x: Array, q: Array) -> bool:
    """Whether one of 2,000 points up to 0.01 half-widths away, moved to x and inside, has a nearer xi than q (n,)."""
    rng, domain, m = np.random.default_rng(2), chart.problem.domain, chart.m
    points = q + 0.01 * domain.half_width * rng.uniform(-1, 1, (2000, chart.n)) * rng.uniform(size=(2000, 1))
    for _ in range(4):
        J = chart.parts.relative.batched_rates(points)[0].reshape(-1, m, chart.n)
        step = (
            np.linalg.pinv(J)
            @ chart.parts.relative.difference(np.tile(x, (len(points), 1)), chart.x(points))[:, :, None]
        )
        points = points + step[:, :, 0]
    points = points[domain.contains(points)]
    target = np.concatenate([np.tile(x, (len(points) + 1, 1)), np.tile(chart.xi(wish), (len(points) + 1, 1))], axis=1)
    away = chart.parts.phi_map.difference(target, chart.phi(np.vstack([q, points])))[:, m:]
    distance = np.linalg.norm(away, axis=1)
    return bool(distance[1:].min(initial=np.inf) < distance[0] - 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHARTS)
def test_nearest_xi_is_that_of_the_chart(tmp_path: Path, name: str) -> None:
    """Inside, with x, and as near as what the chart finds, or a local minimum; the chart finds nothing farther."""
    chart = CHARTS[name]()
    module = module_of(chart, "numpy", tmp_path)
    wishes, x = wishes_of(chart, 500, 0.1 if name == "pose, wide" else 0.3)
    q, status = module.nearest_xi(wishes, x)
    known = chart.nearest_xi(wishes, x)
    ended = status <= NEAREST
    error, distance = missed(chart, wishes, x, q)
    assert (error[ended] < 2e-9).all()
    assert chart.problem.domain.contains(q[ended]).all()
    assert (distance[status == FOUND] < 1e-8).all()
    assert (distance[ended] >= known.distance[ended] - 1e-7).all()
    worse = np.flatnonzero(ended & (distance > known.distance + 1e-7))
    descends = sum(something_nearer_around(chart, wishes[k], x[k], q[k]) for k in worse)
    assert (np.count_nonzero(~ended) + descends) / len(x) <= 0.005
    assert len(worse) / len(x) < 0.06
    assert (status == NEAREST).sum() > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box", "position"])
def test_scipy_finds_nothing_nearer(tmp_path: Path, name: str) -> None:
    """SLSQP from the answer and from the wish, with the constraints of the problem."""
    chart = CHARTS[name]()
    module, domain = module_of(chart, "numpy", tmp_path), chart.problem.domain
    wishes, x = wishes_of(chart)
    q, status = module.nearest_xi(wishes, x)
    rows = np.flatnonzero(status == NEAREST)[:25]
    assert len(rows) == 25
    for k in rows:
        wanted, at = chart.xi(wishes[k]), missed(chart, wishes[k : k + 1], x[k : k + 1], q[k : k + 1])[1][0]
        for start in (q[k], wishes[k]):
            found = minimize(
                lambda q, wanted=wanted: ((chart.xi(q) - wanted) ** 2).sum(),
                start,
                jac=lambda q, wanted=wanted: 2 * chart.jacobian(q)[chart.m :].T @ (chart.xi(q) - wanted),
                bounds=list(zip(*domain.bounds, strict=True)),
                constraints={
                    "type": "eq",
                    "fun": lambda q, k=k: chart.x(q) - x[k],
                    "jac": lambda q: chart.jacobian(q)[: chart.m],
                },
                method="SLSQP",
                options={"ftol": 1e-14, "maxiter": 200},
            )
            feasible = np.abs(chart.x(found.x) - x[k]).max() < 1e-9
            assert not feasible or np.sqrt(found.fun) > at - 1e-6


def gradients(module: Any, library: str, wishes: Any, x: Any, weights: Any) -> tuple[Array, Array]:
    """Of a weighed sum, with respect to wishes and x."""
    own = sys.modules["torch"].func if library == "torch" else sys.modules["jax"]
    both = own.grad(lambda wishes, x: (module.nearest_xi(wishes, x)[0] * weights).sum(), argnums=(0, 1))(wishes, x)
    return np.asarray(both[0]), np.asarray(both[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box", "pose"])
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_derivatives(tmp_path: Path, library: str, name: str) -> None:
    """Central differences where xi is found, and at corners of the box, where x alone moves joints; 0 elsewhere."""
    array, chart = array_of(library), fitted().chart if name == "box" else oc.charts.load("iiwa7-pose")
    module, domain = module_of(chart, library, tmp_path), chart.problem.domain
    wishes, x = wishes_of(chart, 80, 0.5)
    wishes, x = np.vstack([wishes, wishes[:2]]), np.vstack([x, x[:2] + 9.0])
    q, status = map(np.asarray, module.nearest_xi(array(wishes), array(x)))
    weights = np.random.default_rng(1).normal(size=q.shape)
    found = gradients(module, library, array(wishes), array(x), array(weights))
    held = (np.abs(q - domain.centre) > (1 - 1e-9) * domain.half_width).sum(axis=1)
    counted = (status == FOUND) | ((status == NEAREST) & (held == chart.r))
    assert (status == FOUND).any()
    assert (status == NEAREST).any()
    assert status[-2:].tolist() == [NOT_FOUND, NOT_FOUND]
    numbers = module_of(chart, "numpy", tmp_path)
    inner = (np.abs(wishes - domain.centre) < domain.half_width - 1e-4).all(axis=1)  # beyond, they count at the face
    for k, slopes in enumerate(found):
        want = np.zeros_like(slopes)
        for j in range(slopes.shape[1]):
            sides = []
            for sign in (1, -1):
                given = [wishes.copy(), x.copy()]
                given[k][:, j] += sign * 1e-5
                sides.append((numbers.nearest_xi(*given)[0] * weights).sum(axis=1))
            want[:, j] = (sides[0] - sides[1]) / 2e-5
        rows = counted & inner
        np.testing.assert_allclose(slopes[rows], want[rows], rtol=1e-6, atol=1e-5 * np.abs(want[rows]).max())
        np.testing.assert_array_equal(slopes[~counted], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wide", "position"])
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_nearest_xi_compiles_whole(tmp_path: Path, library: str, name: str) -> None:
    array, chart = array_of(library), CHARTS[name]()
    module = module_of(chart, library, tmp_path)
    wishes, x = wishes_of(chart, 60)
    if library == "jax":
        compiled = sys.modules["jax"].jit(module.nearest_xi)
    else:
        compiled = sys.modules["torch"].compile(module.nearest_xi, fullgraph=True, backend="aot_eager")
    q, status = map(np.asarray, compiled(array(wishes), array(x)))
    want, known = module_of(chart, "numpy", tmp_path).nearest_xi(wishes, x)
    np.testing.assert_array_equal(status, known)
    np.testing.assert_allclose(q[known <= NEAREST], want[known <= NEAREST], rtol=0, atol=1e-7)


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.slow
def test_single_precision_stays(tmp_path: Path, library: str) -> None:
    array, chart = array_of(library), fitted().chart
    module, (wishes, x) = module_of(chart, library, tmp_path), wishes_of(fitted().chart, 60)
    q, status = module.nearest_xi(array(wishes.astype(np.float32)), array(x.astype(np.float32)))
    assert "float32" in str(q.dtype)
    status = np.asarray(status)
    assert (status <= NEAREST).mean() > 0.95
    assert (status == NEAREST).any()
    error, _ = missed(chart, wishes, x, np.asarray(q, dtype=float))
    assert (error[status <= NEAREST] < 1e-4).all()


def test_rows_that_are_not_finite_and_other_shapes(tmp_path: Path) -> None:
    chart = fitted().chart
    module, centre = module_of(chart, "numpy", tmp_path), planar().domain.centre
    x = chart.x(centre)
    q, status = module.nearest_xi(np.vstack([centre, centre, centre * np.nan]), np.vstack([x, x * np.nan, x]))
    assert status.tolist() == [FOUND, BAD_INPUT, BAD_INPUT]
    assert np.isnan(q[1:]).all()
    np.testing.assert_allclose(q[0], centre, atol=1e-9)
    one, status = module.nearest_xi(centre, x)
    assert (one.shape, status.shape) == ((3,), ())
    np.testing.assert_array_equal(module.nearest_xi(centre[None], x)[0], one[None])
    assert module.nearest_xi(np.zeros((0, 3)), x)[0].shape == (0, 3)
    with pytest.raises(ValueError, match=r"of shape \(3, 3\) and \(4, 1\), expected \(1,\) or \(N, 1\)"):
        module.nearest_xi(np.zeros((3, 3)), np.zeros((4, 1)))


def test_wishes_beyond_the_box_count_at_its_face(tmp_path: Path) -> None:
    chart = fitted().chart
    module, domain = module_of(chart, "numpy", tmp_path), chart.problem.domain
    far, face = domain.centre + 3 * domain.half_width, domain.centre + domain.half_width
    x = chart.x(domain.centre + 0.9 * domain.half_width)
    np.testing.assert_array_equal(module.nearest_xi(far, x)[0], module.nearest_xi(face, x)[0])
    assert chart.nearest_xi(far, x).status[0] == InverseStatus(int(module.nearest_xi(far, x)[1]))
