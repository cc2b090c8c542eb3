"""Closed loops of the planar arm: what Figs. 22 to 26 and 30 of the paper say, in coarse fits, and their parts."""

import closed_loop_choices
import numpy as np
import pytest
from matplotlib.figure import Figure
from paper import Drawing
from paper.closed_loop_picture import draw_coordinates, draw_plane, moved
from paper.fig24 import largest_curvature
from paper.joint_space_path import coordinate_grid
from paper.planar_loop import (
    ALL_OF_X,
    FOLDED,
    GENTLE,
    INTERLEAVED,
    LARGE,
    STRONG,
    Arm,
    Place,
    Run,
    combined,
    follow,
    out_of_reach,
    task_angle_std,
)

from orthocas.charts.chart import Chart
from orthocas.tasks.domains import Box

pytestmark = pytest.mark.slow

NAMES = ("fig22", "fig23", "fig24", "fig25", "fig26", "fig30")
Numbers = dict[str, float]


@pytest.fixture(scope="module")
def numbers(drawings: dict[str, Drawing]) -> dict[str, Numbers]:
    return {name: dict(drawing.numbers) for name, drawing in drawings.items()}


@pytest.fixture(scope="module")
def linear_run() -> Run:
    arm = Arm()
    return follow(arm.linear("x", GENTLE), arm.base(GENTLE), INTERLEAVED)


@pytest.mark.parametrize("name", NAMES)
def test_figures_have_pictures_and_finite_numbers(drawings: dict[str, Drawing], name: str) -> None:
    assert all(figure.axes for figure in drawings[name].figures.values())
    assert np.isfinite(list(drawings[name].numbers.values())).all()


@pytest.mark.parametrize("name", NAMES)
def test_controllers_never_fall_back(numbers: dict[str, Numbers], name: str) -> None:
    """Every motion stays in the box of its fit; linear coordinates have none."""
    shares = [value for key, value in numbers[name].items() if key.endswith("share_not_ok")]
    assert shares
    assert max(shares) == 0


def test_linear_coordinates_couple_moderately_where_curvature_is_low(numbers: dict[str, Numbers]) -> None:
    """Fig. 22: "even for relatively large motions in joint space ... moderately decoupled"."""
    n = numbers["fig22"]
    assert n["largest_joint_motion_rad"] > 0.5
    assert 0.01 < n["coupling_x_from_xi1"] < 0.1
    assert n["missed_x"] < 1e-3


def test_fitted_coordinates_do_not_couple(numbers: dict[str, Numbers]) -> None:
    """Fig. 23: no coupling to be seen, for the motion of Fig. 22."""
    n = numbers["fig23"]
    assert n["largest_joint_motion_rad"] == pytest.approx(numbers["fig22"]["largest_joint_motion_rad"], rel=0.2)
    assert max(value for key, value in n.items() if key.startswith("coupling")) < 1e-3
    assert n["task_angle_std_deg"] < 0.2


def test_linear_coordinates_contradict_the_task_where_curvature_is_high(numbers: dict[str, Numbers]) -> None:
    """Fig. 24: poor decoupling, and targets that cannot be reached because no posture has them all."""
    n = numbers["fig24"]
    assert n["strong_linear_curvature_per_rad"] > 5 * n["gentle_linear_curvature_per_rad"]
    assert n["strong_linear_out_of_reach_m"] > 0.2
    assert n["gentle_linear_out_of_reach_m"] < 1e-6
    assert n["strong_linear_missed_x"] > 0.05
    assert n["gentle_linear_missed_x"] < 1e-3
    for label in ("xi1", "xi2"):
        linear, gentle = n[f"strong_linear_coupling_x_from_{label}"], n[f"gentle_linear_coupling_x_from_{label}"]
        assert linear > 0.2
        assert linear > 5 * gentle
        assert n[f"strong_fitted_coupling_x_from_{label}"] < 0.01  # 0.0015 with the fit of the full figure
    assert n["strong_fitted_missed_x"] < 1e-3


def test_error_of_the_fit_matters_less_than_curvature_and_coriolis_terms(numbers: dict[str, Numbers]) -> None:
    """Fig. 25, also against linear coordinates, whose error is of the size of the others."""
    n = numbers["fig25"]
    others = min(n["largest_curvature"], n["largest_coriolis"])
    assert 0 < n["largest_error"] < 0.02 * others
    assert n["linear_largest_error"] > 0.3 * n["linear_largest_curvature"]
    assert n["rms_error"] < 0.02 * min(n["rms_curvature"], n["rms_coriolis"])
    assert n["coupling_x_from_xi1"] > 10 * numbers["fig23"]["coupling_x_from_xi1"]  # "now clearly observable"


def test_large_steps_spoil_linear_coordinates_of_the_tip_position(numbers: dict[str, Numbers]) -> None:
    """Fig. 26: linear coordinates are good for small steps, fitted ones still for large ones."""
    n = numbers["fig26"]
    assert n["linear_small_out_of_reach_m"] < 1e-6
    assert n["linear_large_out_of_reach_m"] > 0.02
    for label in ("x", "y", "xi1"):
        assert n[f"linear_small_missed_{label}"] < 1e-3
        assert n[f"linear_large_missed_{label}"] > 0.02
        assert n[f"fitted_large_missed_{label}"] < 5e-3
    assert n["fitted_task_angle_std_deg"] < 0.6 * n["linear_task_angle_std_deg"]


def test_x_and_y_couple_more_than_xi_without_feed_forward(numbers: dict[str, Numbers]) -> None:
    """Figs. 26, 30. With feed-forward it is the other way round: the controller knows the inertia between x and y."""
    n = numbers["fig30"]
    mutual = {name: max(n[f"{name}_coupling_x_from_y"], n[f"{name}_coupling_y_from_x"]) for name in _WAYS}
    from_xi = {name: max(n[f"{name}_coupling_{label}_from_xi1"] for label in "xy") for name in _WAYS}
    step = {"mutual": 0.25, "xi": 0.4}  # [m], [1]: excursions are compared, in metres
    assert mutual["feedback"] * step["mutual"] > 2 * from_xi["feedback"] * step["xi"]
    assert mutual["feed_forward"] * step["mutual"] < from_xi["feed_forward"] * step["xi"]
    assert mutual["feed_forward"] < mutual["feedback"] / 3
    m = numbers["fig26"]
    assert m["fitted_feedback_coupling_y_from_x"] > 3 * m["fitted_feedback_coupling_y_from_xi1"]


_WAYS = ("feed_forward", "feedback")


@pytest.mark.parametrize("lengths", [(1.0, 1.0, 1.0), (0.5, 0.4, 0.3)])
@pytest.mark.parametrize("place", [GENTLE, STRONG, FOLDED])
def test_bases_have_their_tip_above_the_first_joint(lengths: tuple[float, ...], place: Place) -> None:
    arm = Arm(lengths)
    q = arm.base(place)
    x, y = arm.problem("xy", arm.box(place)).task.batched(q[None])[0][0]
    assert x == pytest.approx(0, abs=1e-15)
    assert y > 0
    assert (q[1], q[2]) == (place.q2, place.q3)
    assert np.all(np.abs(q - arm.box(place).centre) < arm.box(place).half_width)


def test_combined_coordinates_agree_with_the_linear_ones_at_the_base() -> None:
    arm = Arm()
    linear, fitted = arm.linear("x", GENTLE), arm.fitted("x", GENTLE, True)
    base, box = arm.base(GENTLE), arm.box(GENTLE)
    assert fitted.xi(base) == pytest.approx(np.zeros(2), abs=1e-12)
    assert fitted.jacobian(base) == pytest.approx(linear.jacobian(base), abs=5e-3)  # as good as the fit is there
    turn = np.array([[0.0, 2.0], [-1.0, 0.5]])
    turned = combined(fitted, base, turn @ fitted.jacobian(base)[1:])
    q = base + np.array([0.1, -0.1, 0.2])
    assert turned.xi(q) == pytest.approx(turn @ fitted.xi(q), abs=1e-12)
    assert task_angle_std(linear, box, True) > 20 * task_angle_std(fitted, box, True)


def test_steps_follow_the_plan(linear_run: Run) -> None:
    reference = linear_run.reference
    assert reference.times.tolist() == [0, 1, 3, 5, 7, 9, 11, 13]
    assert (reference.targets - reference.start).tolist()[-1] == pytest.approx([0.25, 0, 0])
    assert reference.targets[4] - reference.start == pytest.approx([0, -0.3, 0])


def test_missed_is_read_at_the_ends_of_steps(linear_run: Run) -> None:
    times, x = linear_run.trajectory.times, linear_run.trajectory.value[:, 0]
    ends = [x[np.argmin(np.abs(times - end))] for end in (1, 3, 5, 7, 9, 11, 13)]
    assert linear_run.missed[0] == pytest.approx(np.abs(ends - linear_run.reference.targets[:, 0]).max(), abs=1e-12)


def test_curvature_is_that_of_the_turning_normal() -> None:
    """Principal curvatures are the eigenvalues of dn/dq on the tangent plane."""
    arm = Arm()
    chart, q = arm.linear("x", STRONG), arm.base(STRONG)

    def normal(point: np.ndarray) -> np.ndarray:
        slope = chart.jacobian(point)[0]
        return slope / np.linalg.norm(slope)

    h = 1e-6
    turning = np.array([(normal(q + h * e) - normal(q - h * e)) / (2 * h) for e in np.eye(3)]).T
    tangents = np.linalg.svd(normal(q)[None])[2][1:]
    found = np.abs(np.linalg.eigvals(tangents @ turning @ tangents.T)).max()
    assert largest_curvature(arm, STRONG) == pytest.approx(found, rel=1e-6)


def test_targets_are_in_reach_while_only_x_moves() -> None:
    """The line through the base along v crosses the leaf x = 0.25 m, not the one at 2.5 m."""
    arm = Arm()
    chart, start = arm.linear("x", GENTLE), arm.base(GENTLE)
    near, far = (follow(chart, start, ({"x": x},)) for x in (0.25, 2.5))
    assert out_of_reach(near) < 1e-6
    assert out_of_reach(far) > 0.5


def test_coordinate_lines_lie_on_the_manifold() -> None:
    arm = Arm()
    chart = arm.fitted("x", STRONG, True)
    grid = np.array([np.linspace(0, 0.2, 5), np.linspace(-0.2, 0, 5)])
    points = coordinate_grid(chart, arm.base(STRONG), 0.1, grid)
    phi = chart.phi(points.reshape(-1, 3)).reshape(5, 5, 3)
    assert phi[..., 0] == pytest.approx(0.1, abs=1e-8)
    assert phi[..., 1] == pytest.approx(np.tile(grid[0][:, None], (1, 5)), abs=1e-8)
    assert phi[..., 2] == pytest.approx(np.tile(grid[1], (5, 1)), abs=1e-8)


def test_panels_show_desired_and_actual_from_the_start(linear_run: Run) -> None:
    above, plane = Figure().subplots(1, 2)
    draw_coordinates(above, linear_run)
    draw_plane(plane, linear_run, "x", "xi1")
    desired, actual = above.lines[:2]
    assert desired.get_linewidth() > actual.get_linewidth()
    assert actual.get_ydata() == pytest.approx(moved(linear_run, "x")[0])
    assert actual.get_ydata()[0] == desired.get_ydata()[0] == 0
    assert desired.get_ydata()[-1] == pytest.approx(0.25, abs=1e-4)
    assert plane.lines[1].get_ydata() == pytest.approx(moved(linear_run, "xi1")[0])
    assert plane.get_xlabel() == "$x$ [m]"


def test_fallback_is_marked_grey() -> None:
    """A box that ends before the motion does."""
    arm = Arm()
    small = Box(arm.base(STRONG), 0.2)
    chart = Chart(arm.problem("x", small), arm.linear("x", STRONG).coordinates)
    run = follow(chart, arm.base(STRONG), ALL_OF_X[:1])
    axes = Figure().subplots()
    draw_coordinates(axes, run)
    assert run.share_not_ok > 0
    assert len(axes.collections[0].get_paths()) > 0


def test_stiffness_reaches_the_controller() -> None:
    arm = Arm()
    chart, start = arm.linear("xy", FOLDED), arm.base(FOLDED)
    soft, stiff = (follow(chart, start, LARGE[:2], stiffness=k).trajectory.tracking_error[0] for k in (25.0, 400.0))
    assert stiff < 0.7 * soft


@pytest.mark.nightly
def test_conclusions_hold_for_other_choices(capsys: pytest.CaptureFixture[str]) -> None:
    found = closed_loop_choices.main(quick=True)
    assert found["choices"] == 3
    assert found["largest_share_not_ok"] == 0
    assert found["least_gain_low_curvature"] > 50
    assert found["least_gain_high_curvature"] > 20
    assert found["largest_error_share"] < 0.02
    assert found["choices_with_mutual_feedback_above_1"] == 3
    assert found["largest_mutual_feed_forward"] < 1  # with feed-forward the paper's third conclusion is not found
    assert found["planar_3r_x_coupling_x_from_xi1"] < 0.005
    assert capsys.readouterr().out.count("\n") == 5


def test_choices_scale_steps_with_the_arm() -> None:
    choice = closed_loop_choices.Choice("", lengths=(0.5, 0.4, 0.3), steps=0.5)
    moves = ({"x": 0.25}, {"xi1": 0.3})
    run = closed_loop_choices.run(choice, "linear", "x", moves, GENTLE, True, True)
    assert run.reference.targets[-1] - run.reference.start == pytest.approx([0.25 * 0.4 * 0.5, 0.15, 0])
