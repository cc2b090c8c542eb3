"""Figures that the paper sketches, and those of its network and appendix: what they show is computed."""

import casadi as ca
import numpy as np
import pytest
from matplotlib.figure import Figure
from paper import FIGURES, ChosenFit, Drawing
from paper.fig29 import unfolded
from paper.pose_map import joints, pose, pose_jacobian
from programs import nightly

import orthocas as oc
from orthocas import bases
from orthocas.bases import JointSpace

pytestmark = pytest.mark.slow

NAMES = ("fig03", "fig04", "fig05", "fig16", "fig27", "fig29")


@pytest.mark.parametrize("name", NAMES)
def test_figures_have_pictures_and_finite_numbers(drawings: dict[str, Drawing], name: str) -> None:
    assert all(isinstance(figure, Figure) and figure.axes for figure in drawings[name].figures.values())
    assert np.isfinite(list(drawings[name].numbers.values())).all()


def test_the_paper_has_thirty_figures() -> None:
    assert list(FIGURES) == [f"fig{k:02d}" for k in range(1, 31)]


def test_map_to_poses_is_one_to_one_and_regular(drawings: dict[str, Drawing]) -> None:
    """Sec. 2: the task manifold is SE(2); with two joints the map embeds the torus in it."""
    n = drawings["fig03"].numbers
    assert n["least_singular_value"] == pytest.approx(
        (3 - 5**0.5) / 2, abs=1e-3
    )  # of [[1, 0], [1, 1], [0, 0]] at worst
    assert n["error_of_inverse_rad"] < 1e-12
    assert n["error_of_drawn_tips_m"] < 1e-12


def test_pose_and_its_inverse_agree_with_complex_numbers() -> None:
    q = np.random.default_rng(2).uniform(-np.pi, np.pi, (50, 2))
    first, both = np.exp(1j * q[:, 0]), np.exp(1j * q.sum(axis=1))
    assert pose(q)[:, :2] == pytest.approx(np.column_stack([(first + both).real, (first + both).imag]))
    assert np.exp(1j * pose(q)[:, 2]) == pytest.approx(both)
    assert joints(pose(q)) == pytest.approx(q)


def test_push_forward_is_the_derivative_along_the_curve(drawings: dict[str, Drawing]) -> None:
    """Sec. 2.1: in coordinates the push-forward is the Jacobian, and the pullback its transpose."""
    n = drawings["fig04"].numbers
    assert n["difference_error"] < 1e-4 * n["speed_in_task_space"]
    assert n["order_of_difference_error"] == pytest.approx(2, abs=0.01)
    assert n["power_error_of_pullback"] < 1e-14
    assert pose_jacobian(np.array([[0.3, 0.4]]))[0, 2].tolist() == [1, 1]  # phi = q1 + q2


def test_drawn_arms_are_the_models(drawings: dict[str, Drawing]) -> None:
    n = drawings["fig05"].numbers
    assert (n["joints_a"], n["joints_b"]) == (2, 3)
    assert max(n["tip_error_a_m"], n["tip_error_b_m"]) < 1e-12
    assert (n["mass_of_all_links_a_kg"], n["mass_of_all_links_b_kg"]) == (6, 9)  # 3 kg each, Sec. 8


def test_network_with_raw_inputs_has_the_paper_number_of_parameters(drawings: dict[str, Drawing]) -> None:
    """Sec. 9: about 535e3 parameters."""
    n = drawings["fig16"].numbers
    assert n["parameters_with_raw_inputs"] == 535_044 == 7 * 1024 + 1024 + 1024 * 512 + 512 + 512 * 4 + 4
    assert n["parameters_with_sines_and_cosines"] == 542_212
    assert n["error_of_formula"] < 1e-14


def test_raw_inputs_give_a_network_that_is_not_periodic() -> None:
    space = JointSpace(np.zeros(2), np.ones(2), (False, True), ("a", "b"))
    network = oc.MLP((3, 2), raw=True)
    family = network.family(space, 2)
    theta, q = family.initial(4), np.array([[0.3, -1.0], [0.2, 0.7]])
    W1, b1 = theta[:6].reshape(2, 3).T, theta[6:9]
    W2, b2 = theta[9:15].reshape(3, 2).T, theta[15:17]
    W3, b3 = theta[17:21].reshape(2, 2).T, theta[21:]
    layers = np.tanh(W2 @ np.tanh(W1 @ q + b1[:, None]) + b2[:, None])
    assert np.asarray(family.expression(ca.DM(q), ca.DM(theta))) == pytest.approx(W3 @ layers + b3[:, None])
    assert network.label == "mlp:3x2:raw"
    assert bases.parse_parametrisation(network.label) == network


def test_arm_has_the_angles_of_the_paper(drawings: dict[str, Drawing]) -> None:
    """Sec. 9: standard deviations of 2.06 and 3.44 degrees."""
    n = drawings["fig27"].numbers
    assert n["task_std_deg"] < 2.06
    assert n["mutual_std_deg"] < 3.44
    assert abs(n["task_mean_deg"] - 90) < 0.5
    assert abs(n["mutual_mean_deg"] - 90) < 1  # 90.40 in the paper


@pytest.mark.parametrize("seed", [0, *nightly(1)])
def test_networks_draw_the_figures_of_fits_with_the_same_facts(seed: int) -> None:
    """What is asserted of polynomials in Figs. 20 and 23, with small networks from two starts."""
    chosen = ChosenFit(oc.MLP((16, 16)), seed)
    draw = {name: FIGURES[name].draw_fit for name in ("fig20", "fig23")}
    angles, loop = (dict(recipe(True, chosen).numbers) for recipe in draw.values() if recipe is not None)
    assert angles["involutive_std_deg"] < 0.5 * angles["non_involutive_std_deg"]
    assert 3 < angles["non_involutive_std_deg"] < 5
    assert loop["largest_joint_motion_rad"] > 0.5
    assert max(value for key, value in loop.items() if key.startswith("coupling")) < 0.02  # 0.05 for linear coordinates
    assert loop["share_not_ok"] == 0


def test_weights_of_the_appendix_make_the_map_harmonic(drawings: dict[str, Drawing]) -> None:
    """Eqs. (40), (41), (43): cot(alpha) + cot(beta), and the mean of the neighbours."""
    n = drawings["fig29"].numbers
    assert n["error_of_weight"] < 1e-12
    assert n["residual_of_row"] < 1e-12
    assert n["least_weight"] > 0
    assert n["neighbours"] >= 5


def test_unfolding_keeps_all_lengths() -> None:
    corners = np.random.default_rng(5).normal(size=(4, 3))
    flat = unfolded(*corners)
    for a, b in ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3)):
        assert np.linalg.norm(flat[a] - flat[b]) == pytest.approx(np.linalg.norm(corners[a] - corners[b]))
    assert flat[2, 1] > 0 > flat[3, 1]
