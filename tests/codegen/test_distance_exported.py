"""Distances of capsules in exported modules are those of coal for the same capsules, with their gradients."""

from pathlib import Path

import numpy as np
import pytest
from solid_arms import BALL, build_arm
from test_export import module_of

import orthocas as oc
from orthocas.errors import InvalidValueError
from orthocas.robots.capsules import FittedCapsules
from orthocas.robots.collisions import Collisions
from orthocas.tools.checks import Array

SOLIDS = [BALL, '<box size="0.6 0.2 0.1"/>', '<cylinder radius="0.1" length="0.5"/>', '<box size="0.4 0.3 0.02"/>']


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[oc.Chart, FittedCapsules]:
    """A planar arm of several solids, with a floor and a post; pairs of links and of half-spaces take turns."""
    robot = build_arm(Path(tmp_path_factory.mktemp("arm")), SOLIDS)
    wall = oc.obstacles.Plane([0.3, 1.0, 0.1], [0.0, -1.5, 0.0])
    post = oc.obstacles.Capsule([1.5, 1.5, -1.0], [1.4, 1.6, 1.0], 0.05)
    around = robot.collisions.with_scene(oc.Scene({"wall": wall})).with_scene(oc.Scene({"post": post}))
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box([0.4, 0.4, 0.4], 0.2))
    return oc.fit(problem, oc.Linear(), samples=200).chart, oc.fit_capsules(around)


def sample(fitted: FittedCapsules) -> tuple[Array, Array]:
    """Postures, and the distances of all pairs there."""
    q = oc.Robot(fitted.collisions.tree).sample(300, seed=4)
    return q, fitted.collisions.pair_distances(q)


@pytest.mark.slow
def test_distances_of_a_module_are_those_of_coal(arm: tuple[oc.Chart, FittedCapsules], tmp_path: Path) -> None:
    chart, fitted = arm
    q, pairs = sample(fitted)
    assert {"wall", "post", "link3"} <= {fitted.collisions.pairs[k][1] for k in pairs.argmin(axis=1)}
    module = module_of(chart, "numpy", tmp_path, capsules=fitted)
    assert fitted.collisions.pairs == module.PAIRS
    # Overlaps are as deep as coal says, to a micrometre.
    np.testing.assert_allclose(module.pair_distances(q), pairs, rtol=0, atol=1e-6)
    np.testing.assert_allclose(module.distance(q), pairs.min(axis=1), rtol=0, atol=1e-6)
    apart = pairs.min(axis=1) > 1e-3
    np.testing.assert_allclose(module.distance(q)[apart], pairs.min(axis=1)[apart], rtol=0, atol=1e-9)
    assert module.distance(q[0]).shape == ()
    assert module.pair_distances(q[:0]).shape == (0, len(module.PAIRS))
    np.testing.assert_allclose(module.xi(q), chart.xi(q), atol=1e-12)
    assert not hasattr(module_of(chart, "numpy", tmp_path), "distance")


@pytest.mark.parametrize("to", ["torch", "jax"])
def test_gradients_of_a_module_are_those_of_the_nearest_pair(
    to: str, arm: tuple[oc.Chart, FittedCapsules], tmp_path: Path
) -> None:
    library = pytest.importorskip(to)
    chart, fitted = arm
    q, pairs = sample(fitted)
    # One nearest pair, and separate solids.
    two = np.sort(pairs, axis=1)[:, :2]
    q = q[(two[:, 0] > 1e-3) & (two[:, 1] - two[:, 0] > 1e-6)]
    module, wanted = module_of(chart, to, tmp_path, capsules=fitted), fitted.collisions.distance(q)
    if to == "torch":
        points = library.tensor(q, requires_grad=True)
        values = module.distance(points)
        values.sum().backward()
        found, gradients = values.detach().numpy(), points.grad.numpy()
    else:
        library.config.update("jax_enable_x64", True)
        found = np.asarray(module.distance(q))
        gradients = np.asarray(library.vmap(library.grad(module.distance))(q))
    np.testing.assert_allclose(found, wanted.distance, atol=1e-9)
    # Parallel axes have many nearest points.
    assert np.quantile(np.abs(gradients - wanted.gradient), 0.95) < 1e-5


def test_other_robots_and_no_pairs_are_refused(arm: tuple[oc.Chart, FittedCapsules], tmp_path: Path) -> None:
    chart, fitted = arm
    model = fitted.collisions
    bare = oc.fit_capsules(Collisions(model.tree, model.parts[:1], ()))
    with pytest.raises(InvalidValueError, match="without pairs"):
        oc.export(chart, "numpy", tmp_path / "arm.py", capsules=bare)
    other = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    problem = oc.Problem(other, oc.Task.position(other, "x"), domain=oc.Box([0.5, 0.5], 0.3))
    with pytest.raises(InvalidValueError, match="those of the chart's robot"):
        oc.export(oc.fit(problem, oc.Linear(), samples=100).chart, "numpy", tmp_path / "arm.py", capsules=fitted)
