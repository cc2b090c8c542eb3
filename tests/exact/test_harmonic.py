"""Harmonic maps onto the disk: against trimesh and SciPy, exact for affine maps, without folds."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from test_level_surface import arm_leaf

from orthocas.errors import FoldedMapError, InvalidValueError, NotADiskError, ShapeError
from orthocas.exact.mesh import (
    TriangleMesh,
    build_level_surface,
    compute_signed_areas,
    map_to_disk,
    require_disk,
    solve_dirichlet,
)
from orthocas.tools.checks import Array


def square(cells: int = 12) -> TriangleMesh:
    """An uneven mesh of a flat square."""
    up = np.array([0.0, 0.0, 1.0])
    flat = build_level_surface(
        lambda q: q[:, 2], lambda q: np.tile(up, (len(q), 1)), 0.05, [-1, -1, -1], [1, 1, 1], cells
    )
    moved = flat.vertices.copy()
    inside = np.setdiff1d(np.arange(len(moved)), require_disk(flat))
    moved[inside, :2] += np.random.default_rng(7).uniform(-0.3, 0.3, (len(inside), 2)) / cells
    return TriangleMesh(moved, flat.faces)


def fan(sides: int = 6) -> TriangleMesh:
    """A regular polygon with its centre."""
    angles = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides)], axis=1)
    faces = [[k, (k + 1) % sides, sides] for k in range(sides)]
    return TriangleMesh(np.vstack([3 * rim + 5, [[5.0, 5.0, 5.0]]]), np.array(faces))


def angles_of(points: Array) -> Array:
    return np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi)


def by_angles(mesh: TriangleMesh) -> Array:
    """The harmonic map with cotangents of trimesh's angles, the boundary step by step and SciPy's sparse solver."""
    peer = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    weights = 1 / np.tan(peer.face_angles)
    i, j = np.concatenate([mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]], mesh.faces[:, [0, 1]]]).T
    w = weights.T.ravel()
    entries = np.concatenate([w, w, -w, -w]), (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))
    laplacian = coo_array(entries, shape=(len(mesh.vertices),) * 2).tocsr()
    steps = set(zip(i.tolist(), j.tolist(), strict=True))
    following = {start: end for start, end in steps if (end, start) not in steps}
    rim = [min(following)]
    while len(rim) < len(following):
        rim.append(following[rim[-1]])
    lengths = np.linalg.norm(np.roll(mesh.vertices[rim], -1, axis=0) - mesh.vertices[rim], axis=1)
    angles = 2 * np.pi * (np.cumsum(lengths) - lengths) / lengths.sum()
    disk = np.zeros((len(mesh.vertices), 2))
    disk[rim] = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    inner = np.setdiff1d(np.arange(len(disk)), rim)
    disk[inner] = spsolve(laplacian[inner][:, inner].tocsc(), -(laplacian[inner] @ disk))
    return disk


@pytest.mark.parametrize("level", [0.0, 0.3, -0.3])
def test_map_equals_that_of_trimesh_and_scipy(level: float) -> None:
    mesh = arm_leaf(level, 40)
    assert_allclose(map_to_disk(mesh), by_angles(mesh), rtol=0, atol=1e-9)  # the two solvers differ by rounding


@pytest.mark.parametrize("level", [0.0, 0.3, -0.3])
@pytest.mark.parametrize("cells", [20, 27, 36, 60])
def test_map_of_the_arm_does_not_fold(level: float, cells: int) -> None:
    mesh = arm_leaf(level, cells)
    disk, loop = map_to_disk(mesh), require_disk(mesh)
    areas = compute_signed_areas(disk, mesh.faces)
    assert areas.min() > 0
    rim = angles_of(disk[loop])
    steps = np.diff(np.append(rim, 2 * np.pi))
    polygon = np.sum(np.sin(steps)) / 2
    assert_allclose(areas.sum(), polygon, rtol=1e-12)  # the triangles cover the polygon once
    assert_allclose(np.linalg.norm(disk[loop], axis=1), 1.0, rtol=0, atol=1e-15)
    assert np.linalg.norm(np.delete(disk, loop, axis=0), axis=1).max() < 1
    lengths = np.linalg.norm(np.roll(mesh.vertices[loop], -1, axis=0) - mesh.vertices[loop], axis=1)
    assert rim[0] == 0.0
    assert_allclose(steps, 2 * np.pi * lengths / lengths.sum(), rtol=0, atol=1e-12)


def test_affine_boundary_values_give_the_affine_map() -> None:
    mesh = square()
    affine = mesh.vertices @ np.array([[0.3, -1.0, 2.0], [0.7, 0.2, 1.0], [0.0, 0.0, 0.0]]) + [1.0, -2.0, 3.0]
    loop = require_disk(mesh)
    assert_allclose(solve_dirichlet(mesh, loop, affine[loop]), affine, rtol=0, atol=1e-13)


def test_values_may_be_given_at_any_vertices() -> None:
    mesh = square()
    fixed = np.array([5, 40, 3])
    found = solve_dirichlet(mesh, fixed, np.array([[1.0], [-2.0], [0.5]]))
    assert_allclose(found[fixed, 0], [1.0, -2.0, 0.5], rtol=0, atol=0)
    assert -2 <= found.min() <= found.max() <= 1


def test_centre_of_a_regular_polygon_goes_to_the_centre() -> None:
    disk = map_to_disk(fan())
    assert_allclose(disk[6], 0.0, atol=1e-15)
    assert_allclose(angles_of(disk[:6]), np.pi / 3 * np.arange(6), atol=1e-15)


def test_single_triangle_has_no_unknowns() -> None:
    disk = map_to_disk(TriangleMesh(np.eye(3), np.array([[0, 1, 2]])))
    assert_allclose(compute_signed_areas(disk, np.array([[0, 1, 2]])), 3 * np.sqrt(3) / 4, rtol=1e-14)


def test_map_follows_a_change_of_size_and_place() -> None:
    mesh = arm_leaf()
    turn = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    moved = TriangleMesh(1000 * mesh.vertices @ turn + 5, mesh.faces)
    assert_allclose(map_to_disk(moved), map_to_disk(mesh), rtol=0, atol=1e-10)


def test_obtuse_triangles_fold_and_are_reported() -> None:
    mesh = square()
    crumpled = mesh.vertices.copy()
    crumpled[:, 2] = np.random.default_rng(7).uniform(-1, 1, len(crumpled))
    with pytest.raises(FoldedMapError, match=rf"folds \d+ of {len(mesh.faces)} triangles, expected 0"):
        map_to_disk(TriangleMesh(crumpled, mesh.faces))


def test_bad_input_is_refused() -> None:
    mesh = fan()
    for moved in (6, 1):  # an inner vertex and one of the boundary
        vertices = mesh.vertices.copy()
        vertices[moved] = vertices[0]
        with pytest.raises(InvalidValueError, match="cotangent.* expected a finite number"):
            map_to_disk(TriangleMesh(vertices, mesh.faces))
    with pytest.raises(NotADiskError, match="Euler characteristic"):
        map_to_disk(TriangleMesh(mesh.vertices, mesh.faces[:-2][::2]))
    with pytest.raises(ShapeError, match="values"):
        solve_dirichlet(mesh, np.arange(6), np.zeros((5, 2)))
    apart = TriangleMesh(np.vstack([np.eye(3), np.eye(3) + 5]), np.arange(6).reshape(2, 3))
    with pytest.raises(InvalidValueError, match="fixed is 3 vertices, expected at least one in each component"):
        solve_dirichlet(apart, np.arange(3), np.zeros((3, 1)))
