"""Closest points on triangle meshes: against all triangles by least squares, and in closed form."""

import copy
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose
from test_level_surface import arm_leaf, sphere

from orthocas.errors import InvalidValueError, ShapeError
from orthocas.exact import mesh as triangle_locator
from orthocas.exact.mesh import Located, TriangleLocator, TriangleMesh, map_to_disk
from orthocas.tools.checks import Array

ROUNDING = 1e-13  # of distances between points of size 1 to 10


@pytest.fixture(scope="module")
def leaf() -> TriangleMesh:
    return arm_leaf(0.0, 30)


def on_mesh(mesh: TriangleMesh, count: int) -> Array:
    rng = np.random.default_rng(7)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=count)]]
    return np.einsum("nc,ncd->nd", rng.dirichlet([1, 1, 1], count), corners)


def checked(vertices: Array, faces: Array, points: Array, flatness: float = 1.0) -> Located:
    """Locate, and check that faces, barycentric coordinates and distances belong together.

    Args:
        vertices: of the mesh.
        faces: of the mesh.
        points: queries.
        flatness: the rounding of barycentric coordinates grows with length over height of the triangles.
    """
    found = TriangleLocator(vertices, faces).locate(points)
    assert found.face.shape == found.distance.shape == (len(points),)
    assert found.barycentric.min(initial=0.0) >= 0
    assert_allclose(found.barycentric.sum(axis=1), 1.0, rtol=0, atol=1e-15)
    feet = np.einsum("nc,ncd->nd", found.barycentric, vertices[faces[found.face]])
    size = max(np.abs(points).max(initial=0.0), np.abs(vertices).max())
    assert_allclose(np.linalg.norm(feet - points, axis=1), found.distance, rtol=0, atol=2e-15 * size * flatness)
    return found


def over_all(vertices: Array, faces: Array, points: Array) -> Array:
    """Distances with the corners, edges and planes of every triangle tried, by least squares."""
    best, corners = np.full(len(points), np.inf), vertices[faces]
    for part in ([0], [1], [2], [0, 1], [1, 2], [2, 0], [0, 1, 2]):
        first = corners[:, part[:1]]
        edges = corners[:, part[1:]] - first
        along = (points - first) @ np.linalg.pinv(edges)
        on_it = (along.min(axis=2, initial=0.0) >= 0) & (along.sum(axis=2) <= 1)
        distance = np.linalg.norm(first + along @ edges - points, axis=2)
        best = np.minimum(best, np.where(on_it, distance, np.inf).min(axis=0))
    return best


def queries(mesh: TriangleMesh) -> dict[str, Array]:
    rng = np.random.default_rng(8)
    base = on_mesh(mesh, 150)
    a, b = mesh.vertices[mesh.edges[:80]].transpose(1, 0, 2)
    return {
        "on": base,
        "near": base + rng.normal(size=base.shape) * 0.02,
        "off": base + rng.normal(size=base.shape) * 0.5,
        "far": rng.normal(size=(60, 3)) * 100,
        "vertex": mesh.vertices[:80],
        "edge": a + rng.uniform(size=(80, 1)) * (b - a),
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["on", "near", "off", "far", "vertex", "edge"])
def test_no_other_triangle_is_closer(leaf: TriangleMesh, kind: str) -> None:
    points = queries(leaf)[kind]
    found = checked(leaf.vertices, leaf.faces, points)
    assert_allclose(found.distance, over_all(leaf.vertices, leaf.faces, points), rtol=1e-13, atol=ROUNDING)


def test_points_of_the_disk_lie_in_their_triangles(leaf: TriangleMesh) -> None:
    disk = map_to_disk(leaf)
    rng = np.random.default_rng(7)
    weights, face = rng.dirichlet([1, 1, 1], 2000), rng.integers(len(leaf.faces), size=2000)
    found = checked(disk, leaf.faces, np.einsum("nc,ncd->nd", weights, disk[leaf.faces[face]]))
    assert np.array_equal(found.face, face)
    assert_allclose(found.barycentric, weights, rtol=0, atol=1e-9)
    assert found.distance.max() < ROUNDING


@pytest.mark.slow
def test_distance_to_a_disk_from_outside(leaf: TriangleMesh) -> None:
    disk = map_to_disk(leaf)
    points = 3 * np.random.default_rng(7).normal(size=(200, 2))
    found = checked(disk, leaf.faces, points)
    assert_allclose(found.distance, np.maximum(np.linalg.norm(points, axis=1) - 1, 0), rtol=0, atol=2e-3)  # a polygon
    assert_allclose(found.distance, over_all(disk, leaf.faces, points), rtol=1e-14, atol=1e-15)


@pytest.mark.slow
def test_centre_of_a_sphere_is_equally_far_from_everything() -> None:
    ball = sphere(1.25, 20)
    found = checked(ball.vertices, ball.faces, np.zeros((3, 3)))
    assert_allclose(found.distance, over_all(ball.vertices, ball.faces, np.zeros((1, 3)))[0], rtol=1e-15)
    assert 0.98 < found.distance[0] < 1


def test_closest_points_of_one_triangle_in_every_region() -> None:
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
    points = np.array([[0.5, 0.5], [-1, -1], [1, -3], [5, 0], [2, 2], [-2, 1], [0, 6]])
    found = checked(corners, np.array([[0, 1, 2]]), points)
    wanted = [[0.5, 0.25, 0.25], [1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0, 0, 1]]
    assert_allclose(found.barycentric, wanted, rtol=0, atol=1e-15)
    assert_allclose(found.distance, [0, 2**0.5, 3, 3, 2**0.5, 2, 4], rtol=0, atol=1e-15)


def test_wide_triangle_among_small_ones_is_not_missed() -> None:
    rng = np.random.default_rng(7)
    small = (rng.uniform(size=(500, 1, 3)) + 0.01 * rng.normal(size=(500, 3, 3))).reshape(-1, 3)
    vertices = np.vstack([small, [[-100, -100, 0.5], [300, -100, 0.5], [-100, 300, 0.5]]])
    faces = np.arange(len(vertices)).reshape(-1, 3)
    points = rng.uniform(size=(100, 3))
    found = checked(vertices, faces, points)
    assert np.any(found.face == 500)
    assert np.any(found.face != 500)
    assert_allclose(found.distance, over_all(vertices, faces, points), rtol=1e-13, atol=ROUNDING)


def test_triangles_without_area_are_refused() -> None:
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [1, 0, 0], [9, 9, 9]])
    with pytest.raises(InvalidValueError, match=r"area of triangle 1 is 0.0, expected a positive number"):
        TriangleLocator(vertices, [[0, 1, 3], [0, 1, 2]])
    with pytest.raises(InvalidValueError, match="area of triangle 0"):
        TriangleLocator(vertices[:, :2], [[3, 3, 3]])


def test_barycentric_coordinates_keep_digits_in_flat_triangles() -> None:
    flat = np.array([[0.1, 0.2, 0.3], [1.1, 1.2, 1.3], [0.6, 0.7, 0.8]])
    flat[2] += 1e-4 * np.array([1.0, -1.0, 0.0])
    weights = np.random.default_rng(7).dirichlet([1, 1, 1], 500)
    found = checked(flat, np.array([[0, 1, 2]]), weights @ flat, flatness=1e4)
    assert_allclose(found.barycentric, weights, rtol=0, atol=2e-16 * 1e8)  # rounding of libigl's point over the height


FLATTEST = 1e6


def length_over_height(triangles: Array) -> Array:
    """Longest edge over the height above it, (F,); infinite without area."""
    edges = np.pad(np.roll(triangles, -1, axis=1) - triangles, ((0, 0), (0, 0), (0, 3 - triangles.shape[2])))
    square = (edges**2).sum(axis=2).max(axis=1)
    twice_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return np.divide(square, twice_area, out=np.full(len(triangles), np.inf), where=twice_area > 0)


coordinate = st.floats(-1.0, 1.0, width=32)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.integers(2, 3).flatmap(
        lambda d: st.tuples(
            st.integers(1, 12).flatmap(lambda f: arrays(float, (3 * f, d), elements=coordinate)),
            st.integers(1, 6).flatmap(lambda n: arrays(float, (n, d), elements=coordinate)),
        )
    ),
    st.sampled_from([0.1, 1.0, 50.0]),
)
def test_any_triangles_and_points(mesh_and_points: tuple[Array, Array], spread: float) -> None:
    vertices, points = mesh_and_points
    faces = np.arange(len(vertices)).reshape(-1, 3)
    flatness = length_over_height(vertices[faces])
    faces, flatness = faces[flatness < FLATTEST], flatness[flatness < FLATTEST]
    assume(len(faces))
    found = checked(vertices, faces, spread * points, flatness.max())
    assert_allclose(found.distance, over_all(vertices, faces, spread * points), rtol=1e-13, atol=1e-13)
    # closest: no corner is nearer, and the way there makes no acute angle with the way on to any corner
    corners = vertices[faces[found.face]]
    feet = np.einsum("nc,ncd->nd", found.barycentric, corners)
    ahead = np.einsum("ncd,nd->nc", corners - feet[:, None], spread * points - feet)
    assert ahead.max() < 1e-6


def test_result_does_not_depend_on_the_chunks(leaf: TriangleMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    points = queries(leaf)["off"]
    whole = checked(leaf.vertices, leaf.faces, points)
    monkeypatch.setattr(triangle_locator, "RULES", replace(triangle_locator.RULES, chunk=7))
    for one, other in zip(whole, checked(leaf.vertices, leaf.faces, points), strict=True):
        assert np.array_equal(one, other)


def test_no_points_are_no_trouble(leaf: TriangleMesh) -> None:
    assert checked(leaf.vertices, leaf.faces, np.zeros((0, 3))).barycentric.shape == (0, 3)


def test_locators_are_pickled_and_copied(leaf: TriangleMesh) -> None:
    points = queries(leaf)["near"]
    for vertices, queried in ((leaf.vertices, points), (map_to_disk(leaf), points[:, :2])):
        locator = TriangleLocator(vertices, leaf.faces)
        for again in (pickle.loads(pickle.dumps(locator)), copy.deepcopy(locator)):
            for one, other in zip(locator.locate(queried), again.locate(queried), strict=True):
                assert np.array_equal(one, other)


def test_bad_input_is_named(leaf: TriangleMesh) -> None:
    with pytest.raises(ShapeError, match=r"vertices has shape \(3, 4\)"):
        TriangleLocator(np.zeros((3, 4)), [[0, 1, 2]])
    with pytest.raises(ShapeError, match="faces has shape"):
        TriangleLocator(np.eye(3), [[0, 1]])
    with pytest.raises(InvalidValueError, match="faces is empty, expected at least one triangle"):
        TriangleLocator(np.eye(3), np.zeros((0, 3), dtype=int))
    for bad, shown in ((3, "3"), (-1, "-1"), (1.5, "1.5")):
        with pytest.raises(InvalidValueError, match=f"faces is {shown}, expected whole numbers from 0 to 2"):
            TriangleLocator(np.eye(3), [[0, 1, bad]])
    with pytest.raises(InvalidValueError, match="vertices"):
        TriangleLocator(np.full((3, 3), np.nan), [[0, 1, 2]])
    with pytest.raises(ShapeError, match="points has shape"):
        TriangleLocator(leaf.vertices, leaf.faces).locate(np.zeros((5, 2)))
    for bad, name in ((np.nan, "points"), (np.inf, "points"), (1e200, "squared distance")):
        with pytest.raises(InvalidValueError, match=f"{name}.* expected a finite number"):
            TriangleLocator(leaf.vertices, leaf.faces).locate(np.full((2, 3), bad))


@pytest.mark.slow
def test_a_tree_that_lives_until_the_end_is_no_leak() -> None:
    """A reference that Python never gives up, as caches of other libraries hold them."""
    code = """
import ctypes
from orthocas.exact.mesh import TriangleLocator
locator = TriangleLocator([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
ctypes.pythonapi.Py_IncRef(ctypes.py_object(locator))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr + done.stdout == ""
