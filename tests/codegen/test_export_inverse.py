"""The inverse of exported modules: the answers of `chart.solve`, with derivatives, in three libraries."""

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import pytest
from public_objects import clear, exact, fitted, network, planar, ring, wide
from test_export import array_of, module_of

import orthocas as oc
from orthocas import problems
from orthocas.charts.inverse import InverseStatus
from orthocas.codegen.export import LIBRARIES
from orthocas.tasks.corridor import Corridor
from orthocas.tasks.domains import Domain
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

FOUND, OUTSIDE, LIMIT, NOT_FOUND, BAD_INPUT = 0, 2, 3, 5, 6


@cache
def in_corridor() -> oc.Chart:
    known = problems.get("planar_3r_xy")
    postures = known.domain.centre + np.linspace(-0.3, 0.3, 5)[:, None] * [1.0, -0.5, 0.5]
    domain = Corridor(oc.Box(known.domain.centre, known.domain.half_width), postures, 0.2)
    return oc.fit(oc.Problem(known.robot, known.task, domain=domain), oc.Polynomial(2), samples=300).chart


class Blob(Domain):
    """A domain of a user, with an expression for its condition."""

    name, centre, half_width = "blob", np.array([0.6, 0.8, 0.8]), np.full(3, 0.3)
    heading = "a ball"

    @property
    def condition(self) -> Any:
        return self

    @property
    def pivots(self) -> ca.Function:
        q = ca.SX.sym("q", 3)
        return ca.Function("pivots", [q], [0.09 - ca.sumsqr(q - ca.DM(self.centre))])

    def to_data(self) -> Any:
        return {}, {}

    def contains(self, q: Any) -> Any:
        return ((np.asarray(q) - self.centre) ** 2).sum(axis=-1) < 0.09


@cache
def in_blob() -> oc.Chart:
    known = problems.get("planar_3r_xy")
    return oc.fit(oc.Problem(known.robot, known.task, domain=Blob()), oc.Polynomial(2), samples=300).chart


@cache
def pose() -> oc.Chart:
    """A wide chart: clear of singular positions, and without a fold, of poses."""
    return oc.charts.load("panda-wide")


CHARTS: dict[str, Callable[[], oc.Chart]] = {
    "box": lambda: fitted().chart,
    "network": network,
    "clear box": clear,
    "wide": lambda: wide().chart,
    "exact quantity": lambda: exact().chart,
    "circle": ring,
    "corridor": in_corridor,
    "a user's domain": in_blob,
    "pose, wide": pose,
}


def targets_of(chart: oc.Chart, count: int = 300, away: float = 0.05) -> tuple[Array, Array]:
    """Values of phi around a domain, a quarter of them beyond it, and starts near them."""
    domain, rng = chart.problem.domain, np.random.default_rng(4)
    points = sample_uniform(domain, count, 3)
    points[::4] = domain.centre + 1.2 * (points[::4] - domain.centre)
    starts = points + away * domain.half_width * rng.uniform(-1, 1, points.shape)
    return chart.phi(points), starts


def require_same(found: tuple[Any, Any], chart: oc.Chart, phi: Array, starts: Array) -> None:
    """The rows of `chart.solve`, with their status; what it puts more finely is not found here.

    Where Newton's method ends nowhere, or outside, the chart goes on along the line of phi from the start; modules do
    not. So in few rows they have no solution, or one outside, where the chart has found one, or one inside.
    """
    q, status = map(np.asarray, found)
    known = chart.solve(phi, starts)
    want = np.where(np.isin(known.status, (InverseStatus.SINGULAR, InverseStatus.OUT_OF_REACH)), 5, known.status)
    other = status != want
    assert other.mean() < 0.02
    assert (want[other] < status[other]).all()
    solved = ~other & (want != NOT_FOUND)
    np.testing.assert_allclose(q[solved], known.q[solved], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHARTS)
def test_inverse_has_the_answers_of_the_chart(tmp_path: Path, name: str) -> None:
    chart = CHARTS[name]()
    module = module_of(chart, "numpy", tmp_path)
    away = (
        0.01 if name in ("circle", "wide", "pose, wide") else 0.05
    )  # beyond their domains, they fold: there are several solutions
    phi, starts = targets_of(chart, away=away)
    require_same(module.inverse(phi, starts), chart, phi, starts)
    q, status = module.inverse(phi[0], starts[0])
    assert (q.shape, status.shape) == ((chart.n,), ())
    assert module.inverse(phi[:0], starts[0])[0].shape == (0, chart.n)


def test_places_outside_have_names(tmp_path: Path) -> None:
    """Inside, outside the box, out of reach, and bad numbers."""
    chart = clear()
    module = module_of(chart, "numpy", tmp_path)
    centre, width = chart.problem.domain.centre, chart.problem.domain.half_width
    points = np.array([centre, centre + [0, 1.01, 0] * width])
    targets = np.vstack([chart.phi(points), 9.0 + chart.phi(centre), chart.phi(centre) * np.nan])
    q, status = module.inverse(targets, np.vstack([points, centre, centre]))
    assert status.tolist() == [FOUND, OUTSIDE, NOT_FOUND, BAD_INPUT]
    assert np.isnan(q[3]).all()
    assert np.isfinite(q[:3]).all()
    assert module.inverse(targets[:1], points[:1] * np.inf)[1] == BAD_INPUT


def test_limits_of_joints_are_told(tmp_path: Path) -> None:
    chart = pose()
    domain, robot = chart.problem.domain, chart.problem.robot
    module = module_of(chart, "numpy", tmp_path)
    q = domain.centre.copy()
    q[0] = robot.upper[0] + 0.01
    assert module.inverse(chart.phi(q), q)[1] == LIMIT == chart.solve(chart.phi(q), q).status[0]


@pytest.mark.slow
def test_poses_beyond_half_a_turn(tmp_path: Path) -> None:
    """Orientations near half a turn from the reference, where the components of x jump: against the pose itself."""
    chart = pose()
    module, rng = module_of(chart, "numpy", tmp_path), np.random.default_rng(2)
    points = sample_uniform(chart.problem.domain, 20_000, 5)
    angle = np.linalg.norm(chart.x(points)[:, 3:], axis=1)
    points = points[np.argsort(-angle)[:100]]
    starts = points + 0.05 * rng.uniform(-1, 1, points.shape)
    jumped = np.abs(chart.x(points) - chart.x(starts))[:, 3:].max(axis=1)
    assert (jumped > 1.0).sum() > 10
    q, status = module.inverse(chart.phi(points), starts)
    np.testing.assert_array_equal(status, FOUND)
    np.testing.assert_allclose(q, points, rtol=0, atol=1e-9)


def test_no_rotation_is_more_than_half_a_turn_away(tmp_path: Path) -> None:
    """Orientations longer than 2 = 2 sin(pi / 2) have no solution, as for `chart.solve`."""
    chart = pose()
    module, points = module_of(chart, "numpy", tmp_path), sample_uniform(chart.problem.domain, 100, 5)
    phi = chart.phi(points)
    phi[:, 3:6] *= 2.05 / np.linalg.norm(phi[:, 3:6], axis=1)[:, None]
    np.testing.assert_array_equal(chart.solve(phi, points).status, InverseStatus.OUT_OF_REACH)
    np.testing.assert_array_equal(module.inverse(phi, points)[1], NOT_FOUND)
    np.testing.assert_array_equal(module.nearest_xi(points, phi[:, : chart.m])[1], NOT_FOUND)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box", "wide", "circle", "corridor", "pose, wide"])
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_other_libraries_agree_and_differentiate(tmp_path: Path, library: str, name: str) -> None:
    """Answers, and the derivative of a sum over rows against central differences of `chart.solve`."""
    array, chart = array_of(library), CHARTS[name]()
    module = module_of(chart, library, tmp_path)
    phi, starts = targets_of(chart, 60)
    require_same(module.inverse(array(phi), array(starts)), chart, phi, starts)
    centre = chart.problem.domain.centre
    points = 0.2 * (sample_uniform(chart.problem.domain, 40, 5) - centre)  # far from folds
    points += [0.5, 1.3] if name == "circle" else centre
    phi, weights = chart.phi(points), np.random.default_rng(1).normal(size=points.shape)
    beyond = phi[:3] + 50.0
    starts = array(np.vstack([points + 0.01, points[:3]]))
    weighed = array(np.vstack([weights, weights[:3]]))
    found = gradient(
        library, lambda phi: (module.inverse(phi, starts)[0] * weighed).sum(), array(np.vstack([phi, beyond]))
    )
    want = differences(chart, phi, points, weights)
    np.testing.assert_allclose(found[:-3], want, rtol=0, atol=1e-7 * max(1.0, np.abs(want).max()))
    np.testing.assert_array_equal(found[-3:], 0.0)


def differences(chart: oc.Chart, phi: Array, q: Array, weights: Array) -> Array:
    """d(weights . q)/dphi of solutions by central differences of fourth order."""
    found = np.zeros_like(phi)
    for k, aside in enumerate(1e-3 * np.diag(chart.parts.phi_sizes)):
        for factor, times in ((8, 1), (-8, -1), (-1, 2), (1, -2)):
            moved = chart.solve(phi + times * aside, q)
            assert (moved.error < 1e-9).all()
            found[:, k] += factor * (moved.q * weights).sum(axis=1) / (12 * aside[k])
    return found


def gradient(library: str, function: Callable[[Any], Any], at: Any) -> Array:
    own = sys.modules["torch"].func if library == "torch" else sys.modules["jax"]
    return np.asarray(own.grad(function)(at))


@pytest.mark.parametrize("library", ["torch", "jax"])
@pytest.mark.slow
def test_second_derivatives_are_right(tmp_path: Path, library: str) -> None:
    """A Hessian against central differences of the first derivative, J^-1."""
    array, chart = array_of(library), fitted().chart
    module, q = module_of(chart, library, tmp_path), chart.problem.domain.centre + 0.1
    phi, start = chart.phi(q), array(q + 0.05)
    own = sys.modules["torch"].func if library == "torch" else sys.modules["jax"]
    found = np.asarray(own.jacfwd(own.jacrev(lambda phi: module.inverse(phi, start)[0]))(array(phi)))
    step = 1e-5

    def slope(phi: Array) -> Array:
        return np.asarray(np.linalg.inv(chart.jacobian(chart.inverse(phi, q, outside=True))))

    sides = [(slope(phi + step * e) - slope(phi - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(found, np.stack(sides, axis=2), rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "name"), [("torch", "box"), ("torch", "wide"), ("torch", "a user's domain"), ("jax", "box")]
)
def test_rows_may_be_mapped_one_by_one(tmp_path: Path, library: str, name: str) -> None:
    """vmap, once and twice, of both searches; and of their derivatives, where that of the inverse is J^-1."""
    array, chart = array_of(library), CHARTS[name]()
    module = module_of(chart, library, tmp_path)
    own: Any = sys.modules["torch"].func if library == "torch" else sys.modules["jax"]
    jitted: Any = own.jit if library == "jax" else lambda function: function
    phi, starts = targets_of(chart, 12, away=0.01)
    arguments = {"inverse": (phi, starts), "nearest_xi": (starts, phi[:, : chart.m])}
    for function, sets in arguments.items():
        search, rows = getattr(module, function), [array(values) for values in sets]
        q, status = map(np.asarray, search(*rows))
        mapped = jitted(own.vmap(search))(*rows)
        np.testing.assert_array_equal(np.asarray(mapped[1]), status)
        np.testing.assert_allclose(np.asarray(mapped[0]), q, rtol=0, atol=1e-12)
        if library == "torch":  # JAX compiles each for half a minute
            twice = own.vmap(own.vmap(search))(*(values.reshape(3, 4, -1) for values in rows))[0]
            np.testing.assert_allclose(twice.numpy().reshape(q.shape), q, rtol=0, atol=1e-12)
    solved = np.asarray(module.inverse(array(phi), array(starts))[1]) != NOT_FOUND
    want = np.linalg.inv(chart.jacobian(np.asarray(module.inverse(array(phi), array(starts))[0])))
    for derivative in (own.jacrev, own.jacfwd)[: 2 if library == "torch" else 1]:
        slopes = jitted(own.vmap(derivative(lambda target, start: module.inverse(target, start)[0])))
        found = np.asarray(slopes(array(phi), array(starts)))
        np.testing.assert_allclose(found[solved], want[solved], rtol=0, atol=1e-9 * np.abs(want[solved]).max())


def compiled(library: str, module: ModuleType) -> Callable[..., Any]:
    if library == "jax":
        return sys.modules["jax"].jit(module.inverse)  # type: ignore[no-any-return]
    return sys.modules["torch"].compile(module.inverse, fullgraph=True, backend="aot_eager")  # type: ignore[no-any-return]


@pytest.mark.slow
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_inverse_compiles_whole(tmp_path: Path, library: str) -> None:
    array, chart = array_of(library), wide().chart
    module = module_of(chart, library, tmp_path)
    phi, starts = targets_of(chart, 40)
    require_same(compiled(library, module)(array(phi), array(starts)), chart, phi, starts)


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.slow
def test_single_precision_stays(tmp_path: Path, library: str) -> None:
    array, chart = array_of(library), fitted().chart
    module, points = module_of(chart, library, tmp_path), sample_uniform(planar().domain, 50, 3)
    single = array(chart.phi(points).astype(np.float32)), array((points + 0.02).astype(np.float32))
    q, status = module.inverse(*single)
    assert "float32" in str(q.dtype)
    assert "int" in str(status.dtype)
    np.testing.assert_array_equal(
        np.asarray(status)[(np.abs(points - planar().domain.centre) < 0.3).all(axis=1)], FOUND
    )
    np.testing.assert_allclose(np.asarray(q), points, rtol=0, atol=1e-4)


def test_sets_of_other_shapes_are_refused(tmp_path: Path) -> None:
    module = module_of(fitted().chart, "numpy", tmp_path)
    with pytest.raises(ValueError, match=r"of shape \(4, 3\) and \(3, 3\), expected \(3,\) or \(N, 3\)"):
        module.inverse(np.zeros((4, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"of shape \(2,\), expected \(3,\) or \(N, 3\)"):
        module.phi(np.zeros(2))
