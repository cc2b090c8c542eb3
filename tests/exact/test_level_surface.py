"""Level surfaces of functions of three joints: on the surface, on the box, of the right topology, round triangles."""

from collections import Counter, defaultdict

import mesh_chart
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from orthocas.errors import InvalidValueError, NotADiskError, ShapeError
from orthocas.exact.mesh import Function, TriangleMesh, build_level_surface, flip_to_delaunay, require_disk
from orthocas.tools.checks import Array

PI = np.pi
ARM_BOX = ((0.0, -PI, -PI), (PI, PI, PI))  # of the joints of a planar 3R arm; its leaves are disks
ON_LEVEL = 1e-12  # what the docstring promises


def tip_x(q: Array) -> Array:
    return np.cos(np.cumsum(q, axis=1)).sum(axis=1)


def tip_x_gradient(q: Array) -> Array:
    return np.cumsum(-np.sin(np.cumsum(q, axis=1))[:, ::-1], axis=1)[:, ::-1]


def arm_leaf(level: float = 0.0, cells: int = 24, box: tuple[tuple[float, ...], ...] = ARM_BOX) -> TriangleMesh:
    return build_level_surface(tip_x, tip_x_gradient, level, *box, cells)


def sphere(half_width: float, cells: int) -> TriangleMesh:
    return build_level_surface(
        lambda q: (q**2).sum(axis=1), lambda q: 2 * q, 1.0, [-half_width] * 3, [half_width] * 3, cells
    )


def of_height(f: Function, slope: Function) -> tuple[Function, Function]:
    """A function of q3 alone, and its gradient."""
    return lambda q: f(q[:, 2]), lambda q: np.array([0.0, 0.0, 1.0]) * slope(q[:, 2])[:, None]


def normals(mesh: TriangleMesh) -> Array:
    """Area vectors, (F, 3)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def area(mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(normals(mesh), axis=1).sum())


def topology(mesh: TriangleMesh) -> tuple[int, int, int, int]:
    return mesh.components, mesh.boundary_loops, mesh.euler_characteristic, mesh.clashing_edges


def angles(mesh: TriangleMesh) -> Array:
    """Of the corners, (F, 3)."""
    return np.asarray(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_angles)


def opposite_angles(mesh: TriangleMesh) -> Array:
    """Sums of both angles opposite an inner edge."""
    found = defaultdict(list)
    for face, corners in zip(mesh.faces.tolist(), angles(mesh), strict=True):
        for k in range(3):
            found[frozenset((face[k - 2], face[k - 1]))].append(corners[k])
    return np.array([sum(pair) for pair in found.values() if len(pair) == 2])


@pytest.mark.parametrize("cells", [20, 21])  # with and without grid points on the sphere
def test_sphere_is_closed_and_its_area_converges(cells: int) -> None:
    mesh = sphere(1.25, cells)
    assert topology(mesh) == (1, 0, 2, 0)
    assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=0, atol=ON_LEVEL)
    assert_allclose(area(mesh), 4 * PI, rtol=6e-3)  # inscribed triangles of size h = 2.5 / cells miss about h^2 / 3
    assert area(mesh) < 4 * PI
    assert abs(area(sphere(1.25, 2 * cells)) - 4 * PI) < 0.35 * abs(area(mesh) - 4 * PI)  # second order: 1/4


def test_normals_point_along_the_gradient() -> None:
    mesh = sphere(1.25, 20)
    assert np.all(np.sum(normals(mesh) * mesh.vertices[mesh.faces].mean(axis=1), axis=1) > 0)
    leaf = arm_leaf()
    assert np.all(np.sum(normals(leaf) * tip_x_gradient(leaf.vertices[leaf.faces].mean(axis=1)), axis=1) > 0)


@pytest.mark.parametrize("level", [0.0, 0.123])
def test_plane_is_a_square_of_the_exact_area(level: float) -> None:
    mesh = build_level_surface(*of_height(lambda z: z, np.ones_like), level, [-1, -1, -1], [1, 1, 1], 10)
    assert topology(mesh) == (1, 1, 1, 0)
    assert_allclose(mesh.vertices[:, 2], level, rtol=0, atol=ON_LEVEL)
    assert_allclose(area(mesh), 4.0, rtol=1e-12)


def test_boundary_stays_on_the_faces_of_the_box_and_on_the_surface() -> None:
    mesh = sphere(0.8, 20)  # a sphere with six holes
    assert topology(mesh) == (1, 6, -4, 0)
    rim = mesh.vertices[np.unique(mesh.boundary_edges)]
    assert np.all(np.abs(rim).max(axis=1) == 0.8)
    assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=0, atol=ON_LEVEL)
    assert_allclose(area(mesh), 4 * PI - 6 * 2 * PI * (1 - 0.8), rtol=6e-3)  # six caps of height 1 - 0.8 are cut off


@pytest.mark.parametrize("level", [0.0, 0.3, -0.3])
def test_leaf_of_the_arm_is_a_disk_on_its_level(level: float) -> None:
    mesh = arm_leaf(level)
    assert topology(mesh) == (1, 1, 1, 0)
    assert np.abs(tip_x(mesh.vertices) - level).max() <= ON_LEVEL
    assert np.all((mesh.vertices >= ARM_BOX[0]) & (mesh.vertices <= ARM_BOX[1]))
    loop = require_disk(mesh)
    around = [(face[k], face[k - 2]) for face in mesh.faces.tolist() for k in range(3)]
    count = Counter(frozenset(edge) for edge in around)
    rim = {edge for edge in around if count[frozenset(edge)] == 1}  # counterclockwise as their triangles are
    assert set(zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)) == rim
    assert {tuple(edge) for edge in mesh.boundary_edges.tolist()} == rim
    assert len(loop) == len(rim)
    assert loop[0] == min(loop)


def test_structure_equals_that_of_trimesh() -> None:
    for mesh in (arm_leaf(), sphere(1.25, 12), sphere(0.8, 12), arm_leaf(box=((0.0, -PI, 0.0), (PI, PI, 2 * PI)))):
        peer = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert np.array_equal(mesh.edges[np.lexsort(mesh.edges.T)], peer.edges_unique[np.lexsort(peer.edges_unique.T)])
        assert mesh.euler_characteristic == peer.euler_number
        assert mesh.components == peer.body_count
        assert mesh.boundary_loops == (0 if peer.is_watertight else len(peer.outline().entities))


def test_leaf_of_a_whole_first_turn_is_a_tube() -> None:
    mesh = arm_leaf(box=((-PI, -PI, -PI), (PI, PI, PI)))
    assert topology(mesh) == (1, 2, 0, 0)
    with pytest.raises(NotADiskError, match="1 components, 2 boundary loops, .* 0 and .* expected a disk"):
        require_disk(mesh)


def test_leaf_cut_elsewhere_has_three_parts() -> None:
    with pytest.raises(NotADiskError, match="3 components, 3 boundary loops, Euler characteristic 3"):
        require_disk(arm_leaf(box=((0.0, -PI, 0.0), (PI, PI, 2 * PI))))


def test_meshes_that_are_nearly_disks_are_refused() -> None:
    corners = np.random.default_rng(7).uniform(size=(7, 3))
    bow_tie = TriangleMesh(corners[:5], np.array([[0, 1, 2], [2, 3, 4]]))
    fin = TriangleMesh(corners[:5], np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    turned = TriangleMesh(corners[:4], np.array([[0, 1, 2], [0, 1, 3]]))
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    # five triangles in a row whose first and last meet in a vertex only
    pinched = TriangleMesh(corners[:6], np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5], [4, 5, 0]]))
    for mesh, found in (
        (bow_tie, "2 components"),
        (fin, "1 non-manifold edges"),
        (turned, "1 non-manifold edges"),
        (empty, "0 components"),
        (pinched, "Euler characteristic 0"),
        (TriangleMesh(corners[:4], np.array([[0, 1, 2]])), "Euler characteristic 2"),  # a vertex without a triangle
    ):
        with pytest.raises(NotADiskError, match=found):
            require_disk(mesh)


@pytest.mark.slow
@pytest.mark.parametrize("cells", [12, 20, 33, 50])
@pytest.mark.parametrize("level", [0.0, 0.3])
def test_triangles_are_round_and_delaunay(cells: int, level: float) -> None:
    mesh = arm_leaf(level, cells)
    assert opposite_angles(mesh).max() < PI + 1e-8
    assert np.degrees(angles(mesh).min()) > 12  # measured 17 to 24; marching cubes alone: 5


def test_flips_keep_a_square_and_turn_its_bad_diagonal() -> None:
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [0, 1, 0], [4, 1, 0], [2, -1, 0], [2, 2, 0]])
    kite = np.array([[0, 4, 1], [0, 1, 5]])
    flipped = {frozenset(face) for face in flip_to_delaunay(corners, kite).tolist()}
    assert flipped == {frozenset({0, 4, 5}), frozenset({4, 1, 5})}
    rectangle = np.array([[0, 1, 2], [1, 3, 2]])  # both diagonals are Delaunay
    assert np.array_equal(flip_to_delaunay(corners, rectangle), rectangle)


KITE = np.array([[0.0, 0, 0], [4, 0, 0], [0, 0, 9], [4, 0, 9], [2, -1, 0], [2, 1, 0], [2, 0, 5]])


def test_no_flip_makes_an_edge_that_exists() -> None:
    taken = np.array([[0, 4, 1], [0, 1, 5], [5, 4, 6]])  # the edge 4 - 5 belongs to the third triangle
    assert np.array_equal(flip_to_delaunay(KITE, taken), taken)


def test_two_flips_do_not_make_the_same_edge() -> None:
    above = KITE.copy()
    above[[2, 3], 2] = 0.1
    faces = np.array([[0, 4, 1], [0, 1, 5], [2, 4, 3], [2, 3, 5]])
    flipped = TriangleMesh(above, flip_to_delaunay(above, faces))
    assert flipped.clashing_edges == 0
    assert sum({4, 5} <= set(face) for face in flipped.faces.tolist()) == 2


def test_no_flip_turns_a_triangle_over() -> None:
    bent = np.array([[-0.62, 1.23, -1.84], [1.64, -2.02, -0.04], [-1.08, 0.82, -0.77], [-1.13, -0.34, -0.41]])
    folded = np.array([[0, 1, 2], [1, 0, 3]])  # opposite angles of more than half a turn, but both corners on one side
    assert np.array_equal(flip_to_delaunay(bent, folded), folded)


def test_vertices_that_cannot_slide_stay_on_the_surface() -> None:
    def radius(q: Array) -> Array:
        return np.linalg.norm(q, axis=1)

    def steep(q: Array) -> Array:
        return np.arctan(400 * (radius(q) - 1))

    def slope(q: Array) -> Array:
        r = radius(q)
        return q * (400 / (1 + (400 * (r - 1)) ** 2) / r)[:, None]

    mesh = build_level_surface(steep, slope, 0.0, [-1.25] * 3, [1.25] * 3, 6)
    assert topology(mesh) == (1, 0, 2, 0)
    assert_allclose(radius(mesh.vertices), 1.0, rtol=0, atol=ON_LEVEL)


def test_bisection_takes_over_where_newton_runs_away() -> None:
    h, slope = of_height(lambda z: np.arctan(50 * (z - 0.05)), lambda z: 50 / (1 + (50 * (z - 0.05)) ** 2))
    mesh = build_level_surface(h, slope, 0.0, [-1, -1, -1], [1, 1, 1], 4)
    assert_allclose(mesh.vertices[:, 2], 0.05, rtol=0, atol=ON_LEVEL)
    assert_allclose(area(mesh), 4.0, rtol=1e-12)


def test_function_that_jumps_is_refused() -> None:
    h, slope = of_height(lambda z: np.where(z > 0.05, 1.0, -1.0), np.zeros_like)
    with pytest.raises(
        InvalidValueError, match=r"level is 0.0, .* that h does not jump across; it does near .* 0.05\]"
    ):
        build_level_surface(h, slope, 0.0, [-1, -1, -1], [1, 1, 1], 4)


def test_level_outside_the_box_says_what_h_does_there() -> None:
    with pytest.raises(InvalidValueError, match=r"level is 3.5, expected a value of h in the box, found -3 to 3"):
        arm_leaf(3.5)


def test_bad_arguments_are_named() -> None:
    def surface(h: Function = tip_x, gradient: Function = tip_x_gradient, **changed: object) -> TriangleMesh:
        settings = {"level": 0.0, "low": ARM_BOX[0], "high": ARM_BOX[1], "cells": 6} | changed
        return build_level_surface(h, gradient, **settings)  # type: ignore[arg-type]

    with pytest.raises(InvalidValueError, match=r"h\(q\)\[\d+\] is nan"):
        surface(h=lambda q: np.where(q[:, 0] > 1, np.nan, tip_x(q)))
    with pytest.raises(InvalidValueError, match=r"gradient\(q\)\[\d+, \d+\] is nan"):
        surface(gradient=lambda q: np.full_like(q, np.nan))
    with pytest.raises(ShapeError, match=r"h\(q\) has shape"):
        surface(h=lambda q: tip_x(q)[:, None])
    with pytest.raises(ShapeError, match=r"gradient\(q\) has shape"):
        surface(gradient=lambda q: tip_x_gradient(q)[:, :2])
    with pytest.raises(ShapeError, match="low has shape"):
        surface(low=[0.0, 0.0])
    with pytest.raises(InvalidValueError, match="low is .* less than high"):
        surface(low=[4.0, 0.0, 0.0])
    with pytest.raises(InvalidValueError, match="cells is 1,"):
        surface(cells=1)
    with pytest.raises(InvalidValueError, match="level is nan"):
        surface(level=np.nan)
    with pytest.raises(InvalidValueError, match="faces is 3, expected whole numbers from 0 to 2"):
        TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 3]]))
    with pytest.raises(ShapeError, match="faces has shape"):
        TriangleMesh(np.zeros((3, 3)), np.array([0, 1, 2]))


def test_mesh_is_a_read_only_copy() -> None:
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    mesh = TriangleMesh(vertices, faces)
    vertices[0], faces[0] = 5.0, 0
    assert mesh.vertices[0, 0] == 1.0
    assert mesh.faces.tolist() == [[0, 1, 2]]
    with pytest.raises(ValueError, match="read-only"):
        mesh.faces[0, 0] = 1


def test_benchmark_prints_a_row() -> None:
    (row,) = mesh_chart.main(quick=True)
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert len(cells) == mesh_chart.HEADER.splitlines()[0].strip("|").count("|") + 1
    assert int(cells[0]) > 1000
    assert all(float(cell) >= 0 for cell in cells[1:4])
