"""Collision models in chart files: the same distances afterwards, and clear errors for damaged ones."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chart_files import header_of, resealed
from solid_arms import BALL, build_arm

import orthocas as oc
from orthocas.errors import ChartFileError, InvalidValueError, RobotError
from orthocas.robots.collisions import Collisions, Part
from orthocas.robots.shapes import EllipsoidGeometry, Shape
from orthocas.tools.checks import Array


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[oc.Chart, Collisions]:
    """A chart of a planar arm with solids of all kinds."""
    cylinder = '<cylinder radius="0.1" length="0.3"/>'
    robot = build_arm(Path(tmp_path_factory.mktemp("arm")), [BALL, '<box size="0.3 0.1 0.1"/>', cylinder])
    rng = np.random.default_rng(2)
    scene = oc.Scene(
        {
            "mesh": oc.obstacles.Mesh((rng.normal(size=(30, 3)) * 0.2).astype(np.float32), [0.5, 1.8, 0.0]),
            "post": oc.obstacles.Capsule([1.5, 1.5, -1.0], [1.4, 1.6, 1.0], 0.05),
            "wall": oc.obstacles.Plane([0.3, 1.0, 0.1], [0.0, -1.5, 0.0]),
            "cloud": oc.obstacles.PointCloud((rng.normal(size=(30, 3)) * 0.1).astype(np.float32) - [1.8, 0, 0], 0.05),
        }
    )
    own = robot.collisions
    egg = Part("egg", 1, Shape(EllipsoidGeometry(np.array([0.1, 0.05, 0.2])), np.eye(3), np.array([0.3, 0.0, 0.0])))
    whole = Collisions(own.tree, [*own.parts, egg], [*own.pairs, ("link0", "egg")], ("hand",), "given")
    with pytest.raises(InvalidValueError, match="'egg' and 'cloud'"):
        whole.with_scene(scene)
    model = whole.with_scene(scene, allowed=[("egg", "cloud")])
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box([0.5, 0.5], 0.4))
    return oc.fit(problem, oc.Linear(), samples=100).chart, model


def compare(first: Collisions, second: Collisions, q: Array) -> None:
    """The same pairs and distances."""
    assert first.pairs == second.pairs
    assert (first.missing, first.origin) == (second.missing, second.origin)
    np.testing.assert_allclose(first.pair_distances(q), second.pair_distances(q), atol=2e-6)


def test_charts_carry_solids(arm: tuple[oc.Chart, Collisions], tmp_path: Path) -> None:
    chart, model = arm
    chart.save(tmp_path / "bare.orthocas")
    with pytest.raises(RobotError, match="the links have no solids"):
        _ = oc.load(tmp_path / "bare.orthocas").robot.collisions
    chart.save(tmp_path / "a.orthocas", collisions=model)
    loaded = oc.load(tmp_path / "a.orthocas")
    q = loaded.robot.sample(50, seed=1)
    compare(loaded.robot.collisions, model, q)
    # They stay with the robot, its tools, and the next file; and are no part of what a certificate is about.
    loaded.save(tmp_path / "b.orthocas")
    compare(oc.load(tmp_path / "b.orthocas").robot.collisions, model, q)
    compare(loaded.robot.with_tool([0.1, 0.0, 0.0]).collisions, model, q)
    np.testing.assert_array_equal(loaded.xi(q), chart.xi(q))
    assert oc.evaluate(loaded, samples=200, collisions=loaded.robot.collisions).contacts is not None
    other = Collisions(oc.Robot.planar([2.0, 1.0], [1.0, 1.0]).tree, model.parts[:1], ())
    with pytest.raises(InvalidValueError, match="those of the chart's robot"):
        chart.save(tmp_path / "c.orthocas", collisions=other)


def change(path: Path, name: str, value: Any) -> None:
    """Another value of the model in a file, with a right digest."""
    header: dict[str, Any] = header_of(path)
    header["collisions"][name] = value
    resealed(path, header)


DAMAGES: dict[str, Any] = {
    "pairs": [[[0, 99]], [[0]], "x", [[True, 0]], [[0.5, 1]], [[-1, 0]]],
    "parts": [[], 3, [{"name": "a", "body": 0, "kind": "box", "points": 0}], [{}], ["x"]],
    "missing": [3, None],
    "origin": [7, ""],
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_models_are_refused(arm: tuple[oc.Chart, Collisions], tmp_path: Path, name: str) -> None:
    chart, model = arm
    for k, value in enumerate(DAMAGES[name]):
        path = tmp_path / f"{k}.orthocas"
        chart.save(path, collisions=model)
        change(path, name, value)
        with pytest.raises(ChartFileError):
            oc.load(path)


def test_numbers_that_are_none_are_refused(arm: tuple[oc.Chart, Collisions], tmp_path: Path) -> None:
    chart, model = arm
    path = tmp_path / "a.orthocas"
    chart.save(path, collisions=model)
    with zipfile.ZipFile(path) as file:
        names = [name.removesuffix(".npy") for name in file.namelist() if "collisions" in name]
    assert len(names) == 3
    for name in names:
        for bad in (np.array([np.nan]), np.full((30, 3, 4), 1e9), np.zeros((30, 3, 4)), -np.ones(40)):
            chart.save(path, collisions=model)
            resealed(path, **{name: bad})
            with pytest.raises(ChartFileError):
                oc.load(path)
