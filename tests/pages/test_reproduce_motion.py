"""Figures of springs, of the closed loop and of the journey of the 7-DoF arm: facts of the paper."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from paper import Drawing
from paper.hidden_spring import HiddenSpring

from orthocas.errors import SolveError

pytestmark = pytest.mark.slow

NAMES = ("fig02", "fig21", "fig28")


@pytest.fixture(scope="module")
def spring() -> HiddenSpring:
    return HiddenSpring()


@pytest.mark.parametrize("name", NAMES)
def test_figures_have_pictures_and_finite_numbers(drawings: dict[str, Drawing], name: str) -> None:
    assert all(isinstance(figure, Figure) and figure.axes for figure in drawings[name].figures.values())
    assert np.isfinite(list(drawings[name].numbers.values())).all()


def test_projected_spring_is_stuck_and_geodetic_spring_is_not(drawings: dict[str, Drawing]) -> None:
    """Fig. 2: a torque that is not 0 and vanishes after the projection; along xi there is one minimum only."""
    n = drawings["fig02"].numbers
    assert n["hidden_torque_Nm"] > 50
    assert n["projected_torque_Nm"] < 1e-10
    assert n["hidden_energy_J"] > 30
    assert n["barrier_J"] > 1
    assert n["minima_of_projected_spring_before_the_goal"] == 1
    assert n["minima_of_geodetic_spring_before_the_goal"] == n["minima_with_tip_nearer"] == 0
    assert n["task_error_of_curve_m"] < 1e-12


def test_start_stuck_point_and_goal_are_on_one_self_motion_curve(spring: HiddenSpring) -> None:
    """All have the same tip, and the traced curve passes them: within half a step of 0.02 rad and its sagitta."""
    tips = spring.problem.task.batched(np.array([spring.start, spring.stuck, spring.goal]))[0]
    assert tips == pytest.approx(np.tile([spring.radius, 0.0], (3, 1)), abs=1e-10)
    for q in (spring.start, spring.stuck, spring.goal):
        assert np.linalg.norm(spring.curve - q, axis=1).min() < 0.011


def test_stuck_point_is_a_minimum_of_the_energy_along_the_curve(spring: HiddenSpring) -> None:
    """The energy grows to both sides, and its slope there is minus the projected torque."""
    near = spring.curve[np.abs(spring.curve[:, 0] - spring.stuck[0]) < 0.3]
    assert (spring.posture_energy(near) >= spring.posture_energy(spring.stuck[None])).all()
    k = len(near) // 4
    chord, rise = near[k + 1] - near[k - 1], np.diff(spring.posture_energy(near[[k - 1, k + 1]]))[0]
    assert spring.posture_torque(near[k]) @ chord == pytest.approx(-rise, rel=1e-3)  # chord of 0.04 rad
    assert abs(spring.projected_torque(near[k])) == pytest.approx(abs(rise) / np.linalg.norm(chord), rel=1e-3)


def test_spring_without_a_second_minimum_is_an_error() -> None:
    with pytest.raises(SolveError, match=r"no minimum between start and goal at radius 0\.3"):
        _ = HiddenSpring(0.3).stuck


def test_block_diagram_is_what_the_controller_computes(drawings: dict[str, Drawing]) -> None:
    n = drawings["fig21"].numbers
    assert n["torque_error_Nm"] < 1e-12 * n["largest_torque_Nm"] * 100  # rounding of inverses in another order


def test_low_pass_overshoots_as_its_damping_ratio_says(drawings: dict[str, Drawing]) -> None:
    n = drawings["fig21"].numbers
    assert n["overshoot"] == pytest.approx(np.exp(-0.7 * np.pi / np.sqrt(0.51)), rel=1e-6)
    assert n["acceleration_after_a_step_1_s2"] == pytest.approx((2 * np.pi) ** 2)
    assert n["differential_equation_error"] < 1e-12 * (2 * np.pi) ** 2


def test_journey_ends_where_it_began(drawings: dict[str, Drawing]) -> None:
    """Sec. 9: after a long journey all joints are back, and steps in xi move them as much as steps in x."""
    n = drawings["fig28"].numbers
    assert n["steps"] >= 20
    assert n["joint_error_at_the_end_rad"] <= 1e-6
    assert n["least_joint_excursion_rad"] > 0.5
    assert n["largest_joint_excursion_rad"] < np.pi / 4
    assert n["largest_coupling_index"] < 1e-5  # dq = J^-1 d_phi_d: nothing but the error of the integration
    assert n["instants_without_command"] == 0
    assert n["task_angle_std_deg"] < 2.2
