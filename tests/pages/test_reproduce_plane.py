"""Figures of the planar arm with two joints, and histograms with three: facts of the paper, on coarse grids."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from paper import Drawing
from paper.planar_flow import cosines_by_differences, deviations, flow_lines, grown_chart, planar_problem

pytestmark = pytest.mark.slow

NAMES = ("fig09", "fig12", "fig13", "fig14", "fig17", "fig18", "fig20")


@pytest.fixture
def n(request: pytest.FixtureRequest, drawings: dict[str, Drawing]) -> dict[str, float]:
    return dict(drawings[request.param].numbers)


@pytest.mark.parametrize("name", NAMES)
def test_figures_have_pictures_and_finite_numbers(drawings: dict[str, Drawing], name: str) -> None:
    assert all(isinstance(figure, Figure) for figure in drawings[name].figures.values())
    assert np.isfinite(list(drawings[name].numbers.values())).all()


@pytest.mark.parametrize("n", ["fig09"], indirect=True)
def test_raised_gradient_is_tangent_and_plain_one_is_not(n: dict[str, float]) -> None:
    """Sec. 3.1: M^-1 J_xi^T is tangent to the task's leaves; J_xi is rotated."""
    assert n["largest_cosine_J_x_and_raised_J_xi"] < 1e-12
    assert n["median_cosine_from_differences_of_xi"] < 1e-6
    assert n["mean_angle_J_xi_and_raised_J_xi_deg"] > 45
    assert n["mean_cosine_J_x_and_J_xi"] > 0.7


@pytest.mark.parametrize("n", ["fig12", "fig14"], indirect=True)
def test_flow_lines_end_at_extrema_and_pulls_on_the_base_leaf(n: dict[str, float]) -> None:
    """Sec. 5.1: depending on the sign, the flow ends at one of the singular points."""
    assert n["curves"] == n["ends_at_maximum"] == n["ends_at_minimum"] == 36
    assert n["ends_at_saddles"] == 0  # only the lines into a saddle end there, a set of measure zero
    assert n["distance_of_ends_from_singular_points"] < 1e-3  # 1e-8 m below the extrema, curvatures above 0.2 m
    assert n["task_error_of_drawn_pulls"] < 1e-12
    assert n["task_error_of_pulls"] < 1e-6  # the threshold of the paper
    assert n["share_that_reaches_base_leaf"] > 0.995


@pytest.mark.parametrize("n", ["fig13"], indirect=True)
def test_grown_coordinate_is_exact_and_jumps_at_saddles(n: dict[str, float]) -> None:
    for metric in ("euclidean", "inertia"):
        assert n[f"{metric}_share_with_a_value"] > 0.995
        assert n[f"{metric}_largest_cosine"] < 1e-10
        assert n[f"{metric}_median_cosine_from_differences_of_xi"] < 1e-6
        for k in (1, 2):  # q -> -q maps a saddle to itself and S0 to itself, half around
            assert n[f"{metric}_jump_at_saddle_{k}"] == pytest.approx(np.pi, abs=1e-6)


@pytest.mark.parametrize("n", ["fig13"], indirect=True)
def test_metric_does_not_change_values_on_the_base_leaf(n: dict[str, float]) -> None:
    """Sec. 5.1.2: "the value of xi on S0 does not change at all"."""
    assert n["difference_on_base_leaf"] < 1e-8


@pytest.mark.parametrize("n", ["fig13"], indirect=True)
def test_whole_picture_is_one_region(n: dict[str, float]) -> None:
    """Sec. 5.1.1: jumps can be moved to the boundary, but for those at the maximum."""
    for metric in ("euclidean", "inertia"):
        assert n[f"{metric}_broken_edges_on_torus"] > 60  # jumps go once around, over more than 60 cells
        assert n[f"{metric}_broken_edges_put_together"] < 0.3 * n[f"{metric}_broken_edges_on_torus"]


@pytest.mark.parametrize("n", ["fig17"], indirect=True)
def test_network_folds_on_closed_leaves(n: dict[str, float]) -> None:
    """Sec. 6.1: no global coordinate. A continuous function on a circle has values twice or more."""
    assert n["untrained_median_deviation_deg"] > 30  # a random direction gives 45
    for case in ("euclidean_{}_of_start_1", "inertia_{}_of_start_1", "euclidean_{}_from_grown"):
        assert n[case.format("least_times_of_a_value_on_a_leaf")] == 2
        assert n[case.format("largest_times_of_a_value_on_a_leaf")] % 2 == 0
        assert n[case.format("median_deviation_deg")] < 20
        assert n[case.format("median_angle_to_grown_gradient_deg")] < 10  # by selection; 90 if one of them were wrong
    assert n["euclidean_share_of_values_twice_on_a_leaf_from_grown"] > 0.9  # as the paper has them


@pytest.mark.parametrize("n", ["fig18"], indirect=True)
def test_surfaces_are_periodic(n: dict[str, float]) -> None:
    assert (n["least_task_value"], n["largest_task_value"]) == pytest.approx((-2, 2))
    assert n["difference_across_the_edges"] < 1e-12
    assert n["largest_xi"] - n["least_xi"] > 0.5


@pytest.mark.parametrize("n", ["fig20"], indirect=True)
def test_needle_is_narrower_than_hill(n: dict[str, float]) -> None:
    """Sec. 6.2: the histogram is "much more needle shaped" in the involutive case; degree 4 of 6 here."""
    assert n["involutive_std_deg"] < 0.5 * n["non_involutive_std_deg"]
    assert 3 < n["non_involutive_std_deg"] < 5  # limited by the task: degrees 4 to 6 give 3.9 to 3.5
    for case in ("involutive", "non_involutive"):
        assert n[f"{case}_mean_deg"] == pytest.approx(90, abs=0.5)
    assert n["involutive_angles"] == n["non_involutive_angles"] == 20_000  # two pairs of gradients per sample


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_flow_lines_are_orthogonal_to_leaves_in_the_metric(metric: str) -> None:
    """Chords of a flow line have no component along its leaves: v^T A dq = 0 for J_x v = 0."""
    problem = planar_problem(metric)
    start = np.array([[0.9, 0.7]])
    goal = problem.task.batched(start)[0][:, 0] - 1e-3
    (line,) = flow_lines(problem, start, goal, 2)
    assert problem.task.batched(line)[0][-1] == pytest.approx(goal, abs=1e-12)
    middle, chord = line[1], line[2] - line[0]
    J, A = problem.task.batched_jacobian(middle[None])[0].ravel(), problem.metric.batched(middle[None])[0][0]
    tangent = np.array([-J[1], J[0]])
    cosine = tangent @ A @ chord / np.sqrt((tangent @ A @ tangent) * (chord @ A @ chord))
    assert abs(cosine) < 1e-5  # chords of length 1e-3


def test_flow_line_down_from_a_saddle_leads_back_past_it() -> None:
    """Starting along the eigenvector of falling h; the direction is that of the golden ratio."""
    problem = planar_problem("euclidean")
    saddle, into = np.array([0.0, np.pi]), np.array([-0.85065081, 0.52573111])
    (down,) = flow_lines(problem, (saddle + 1e-6 * into)[None], np.array([-1e-3]), 5)
    (up,) = flow_lines(problem, down[-1:], np.array([1.0]), 40)
    assert np.linalg.norm(up - saddle, axis=1).min() < 0.05


def test_deviation_is_the_angle_of_the_paper() -> None:
    problem = planar_problem("inertia")
    q = np.array([[0.7, 0.9]])
    J, M = problem.task.batched_jacobian(q)[0][0], problem.metric.batched(q)[0][0]
    gradient = np.linalg.solve(M, J.ravel())
    turned = np.array([-gradient[1], gradient[0]])
    assert deviations(problem, q, turned[None]) == pytest.approx([0], abs=1e-6)
    assert deviations(problem, q, (turned + np.tan(0.1) * gradient)[None]) == pytest.approx([np.degrees(0.1)])
    assert deviations(problem, q, gradient[None]) == pytest.approx([90])


def test_differences_of_grown_coordinate_are_orthogonal_to_the_task() -> None:
    chart = grown_chart(planar_problem("inertia"))
    points = np.array([[0.9, 0.7], [-0.4, 1.5], [1.2, -2.0]])
    assert cosines_by_differences(chart, points) == pytest.approx(np.zeros(3), abs=1e-6)
