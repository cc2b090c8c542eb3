"""Figures of the paper in three joints: leaves, grown and fitted coordinates, and what keeps them from being exact."""

import numpy as np
import pytest
from paper import Drawing, Scene
from paper.charted_surface import add_with_edges, add_with_lines, part_below
from paper.painting import Isolines
from paper.section import curves_inside, section

pytestmark = pytest.mark.slow

NAMES = ("fig01", "fig10", "fig15", "fig19")
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), np.array([[0, 1, 2], [1, 3, 2]])


def test_every_picture_has_axes(drawings: dict[str, Drawing]) -> None:
    for drawing in drawings.values():
        assert all(figure.axes for figure in drawing.figures.values())


def test_fig01_leaves_meet_at_right_angles(drawings: dict[str, Drawing]) -> None:
    """Sec. 3.1: leaves of xi1 and xi2 are orthogonal to those of x, but not to each other."""
    n = drawings["fig01"].numbers
    assert n["mean_angle_task_xi_deg"] == pytest.approx(90, abs=1e-9)
    assert n["largest_deviation_from_90_deg"] < 1e-6
    assert n["largest_deviation_of_drawn_surfaces_deg"] < 0.7  # grids of 17 x 17; 0.07 for 41 x 41
    assert abs(n["smallest_angle_xi1_xi2_deg"] - 90) > 5


def test_fig10_ends_differ_by_the_bracket(drawings: dict[str, Drawing]) -> None:
    """Sec. 3.1: both paths end at the same task value, on one self-motion curve, eps^2 [X_1, X_2] apart."""
    n = drawings["fig10"].numbers
    assert n["gap_drawn"] > 0.2
    assert n["task_difference_of_ends"] < 1e-9
    assert n["distance_of_qb_from_curve_through_qa"] < 1e-4  # chords of 0.02 rad
    assert n["gap_at_0.04"] > n["gap_at_0.02"] > n["gap_at_0.01"]
    assert n["order_of_gap"] == pytest.approx(2, abs=0.05)  # 2 + O(eps)
    assert n["gap_over_bracket_prediction"] == pytest.approx(1, abs=0.03)  # 1 + O(eps)
    assert n["bracket_over_defect_formula"] == pytest.approx(1, abs=1e-12)
    assert n["gap_of_commuting_pair"] < 1e-10


def test_fig15_coordinates_are_exact_and_constant_along_the_flow(drawings: dict[str, Drawing]) -> None:
    """Sec. 5.2: S0 is a disk, its map is one-to-one, and xi is carried unchanged to x = +-0.3."""
    n = drawings["fig15"].numbers
    assert (n["boundary_loops"], n["euler_characteristic"], n["flipped_triangles"]) == (1, 1, 0)
    assert n["task_error_at_vertices"] < 1e-12
    assert n["largest_cosine"] < 1e-7
    assert n["largest_change_along_flow"] < 1e-7  # local errors of the flow are 1e-10
    assert n["samples_with_coordinates"] > 0.85
    assert 0.95 < n["covered_at_0.3"] < 1
    assert n["covered_at_-0.3"] == pytest.approx(n["covered_at_0.3"], abs=2e-3)  # q -> (pi - q1, -q2, -q3) maps x to -x
    assert n["seconds_to_grow"] < 30


def test_fig19_planes_are_nearly_tangent(drawings: dict[str, Drawing]) -> None:
    """Sec. 6.2: no exact coordinate exists, but a good one."""
    n = drawings["fig19"].numbers
    assert n["rectangles"] >= 12
    assert 0.5 < n["mean_tilt_of_rectangles_deg"] < n["largest_tilt_of_rectangles_deg"] < 15
    assert n["mean_tilt_in_section_deg"] < 6
    assert n["task_angle_mean_deg"] == pytest.approx(90, abs=2)
    assert 0.5 < n["task_angle_std_deg"] < n["expected_angle_deg"]  # that of quadratic coordinates
    assert n["involutivity_defect_mean"] > 0.1


def test_two_families_of_lines_cross() -> None:
    """On the unit square: lines x = 0.5 and y = 0.5 of width 0.2 have the area 0.2 and, less the crossing, 0.16."""
    vertices, faces = SQUARE
    scene = Scene()
    families = [
        Isolines(vertices[:, k], np.array([0.5]), np.array([colour]), 0.2)
        for k, colour in enumerate(([1.0, 0, 0, 1], [0.0, 1, 0, 1]))
    ]
    add_with_lines(scene, vertices, faces, "#0000ff", families)
    areas = _areas(scene.corners)
    shares = [areas[scene.colours[:, k] == 1].sum() for k in range(3)]
    assert shares == pytest.approx([0.16, 0.2, 0.64])


def test_edges_lie_within_triangles() -> None:
    vertices, faces = SQUARE
    scene = Scene()
    add_with_edges(scene, vertices, faces, np.ones((2, 3)), np.zeros(3), 0.1)
    areas = _areas(scene.corners)
    inner = (1 - 0.05 / (1 / (2 + np.sqrt(2)))) ** 2  # the radius of the inscribed circle shrinks by half a width
    assert areas.sum() == pytest.approx(1)
    assert areas[scene.colours[:, 0] == 1].sum() == pytest.approx(inner)


def test_part_below_is_cut_where_the_function_has_the_level() -> None:
    vertices, faces = SQUARE
    points, triangles, values = part_below(vertices, faces, vertices[:, 1], 0.3, vertices[:, :1] * 2)
    assert _areas(points[triangles]).sum() == pytest.approx(0.3)
    assert points[:, 1].max() == pytest.approx(0.3)
    assert values[:, 0] == pytest.approx(2 * points[:, 0])


def test_curves_inside_reach_from_face_to_face() -> None:
    """Also for a curve along which q1 makes a whole turn, whose start is in the middle of the box."""
    low, high = np.array([-0.8, 1.2, 0.8]), np.array([1.2, 2.7, 2.4])
    start = np.array([[0.0, 1.6, 1.6]])
    problem = section(low, high)
    (curve,) = curves_inside(problem, start, 0.02)
    assert np.linalg.norm(np.diff(curve, axis=0), axis=1).max() < 0.021
    assert np.linalg.norm(curve - start, axis=1).min() < 1e-12
    for end in curve[[0, -1]]:
        assert np.minimum(end - low, high - end).min() < 0.021
    assert problem.task.batched(curve)[0] == pytest.approx(np.tile(problem.task.batched(start)[0], (len(curve), 1)))


def _areas(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
