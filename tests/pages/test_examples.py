"""Examples and benchmarks run in their quick modes and return sensible numbers."""

import re
from pathlib import Path

import batches
import beyond_reach
import c_timing
import casadi as ca
import casadi_dynamics
import certificates
import clear_positions
import collision_scenes
import collisions
import collisions_in_mujoco
import compare_parametrisations
import contact
import distillation
import domain_size
import elastic_joints
import elbow_angle
import exported_inverse
import exported_nearest
import fits
import folds
import follow_path
import following
import front
import gallery
import growing_queries
import iiwa_demo
import inverse
import involutivity
import ipopt_front
import metric_loss
import numpy as np
import paper_network
import pytest
import quality_and_time
import quantities
import random_walk
import scaling
import starts
import suggested_domains
import supervised_tick
import wide_charts
import xi_in_qp
import xi_in_solvers
from paper.registry import FIGURES
from PIL import Image
from programs import needs_c

import orthocas as oc
from orthocas.tasks.samples import sample_uniform


@pytest.mark.slow
def test_demo_saves_chart_and_pictures(tmp_path: Path) -> None:
    found = iiwa_demo.main(tmp_path, quick=True)
    assert found["task_std_deg"] < 3.2
    assert found["mutual_std_deg"] < 5.2
    assert found["conditioning_min"] > 0.1
    for name in ("iiwa.orthocas", "iiwa_quality.png", "iiwa_self_motion.png"):
        assert (tmp_path / name).stat().st_size > 10_000


@pytest.mark.nightly
@pytest.mark.slow
def test_fit_benchmark_prints_rows() -> None:
    rows = fits.main(quick=True)
    assert len(rows) == 2
    assert rows[0].startswith("| iiwa | polynomial:2 |")


@pytest.mark.nightly
@pytest.mark.slow
def test_fold_benchmark_finds_none() -> None:
    (line,) = folds.main(quick=True)
    *_, searched, uniform, heavy, count = (float(word) for word in line.strip("| ").split("|")[1:])
    assert count == 0
    assert searched <= min(uniform, heavy)


@pytest.mark.nightly
@pytest.mark.slow
def test_benchmark_of_paths_keeps_limits_and_closes() -> None:
    rows = following.main(quick=True)
    assert len(rows) == 6
    for line in rows[:3]:
        cells = [cell.strip() for cell in line.strip("| ").split("|")]
        assert all(float(share.strip(" %")) <= 100 for share in cells[4].split(","))
        assert float(cells[-1]) < 1e-9


@pytest.mark.slow
def test_path_past_a_post(tmp_path: Path) -> None:
    found = follow_path.main(tmp_path, quick=True)
    assert found["hold: distance from the post [m]"] < 0
    assert found["objective: distance from the post [m]"] > follow_path.CLEARANCE
    assert found["objective: joints away from their start at the end [rad]"] < 1e-9
    with Image.open(tmp_path / "follow_path.png") as picture:
        assert picture.size[0] > 1000


@pytest.mark.nightly
@pytest.mark.slow
def test_quality_and_time_are_drawn_for_two_degrees(tmp_path: Path) -> None:
    low, high = quality_and_time.main(tmp_path, quick=True)
    assert high.task < low.task
    assert (tmp_path / "front_seconds.png").stat().st_size > 10_000


@pytest.mark.nightly
@pytest.mark.slow
def test_certificate_benchmark_proves_its_box() -> None:
    (line,) = certificates.main(quick=True)
    assert "| 100% |" in line


@pytest.mark.nightly
@pytest.mark.slow
def test_scaling_benchmark_prints_rows() -> None:
    assert len(scaling.main(quick=True)) == 2


@pytest.mark.slow
def test_loss_in_the_metric_moves_the_task_less_in_closed_loop() -> None:
    """One arm, place, seed and goal: the direction, not the size, of what the whole study shows."""
    ratios = metric_loss.main(quick=True)
    for what in ("leak, rms [deg]", "coupling index [m]", "PD+ decoupled: task error, rms [mm]"):
        assert ratios[f"planar_3r_xy: {what}"] < 0.8
    assert ratios["planar_3r_xy: paper's task angle, std [deg]"] > 1.2


def test_compiled_timing_harness_times_calls() -> None:
    x = ca.SX.sym("x", 3)
    try:
        times = c_timing.nanoseconds_per_call({"f": ca.Function("f", [x], [ca.sin(x)])}, rounds=1, calls=1000)
    except RuntimeError as error:
        pytest.skip(str(error))
    assert np.isfinite(times["f"])
    assert times["f"] > 1


@pytest.mark.nightly
@pytest.mark.slow
def test_front_shows_the_trade_and_the_trap(tmp_path: Path) -> None:
    found = front.main(tmp_path, quick=True)
    assert found["task_std_small_lambda2"] < found["task_std_large_lambda2"]
    assert found["p01_small_lambda2"] < 0.2  # nearly parallel coordinates at the paper's weights
    assert found["p01_with_regularity"] > found["p01_without_regularity"]
    assert found["folded_with_regularity"] == 0
    assert (tmp_path / "front.png").stat().st_size > 10_000


@pytest.mark.nightly
@pytest.mark.slow
def test_involutivity_defect_tells_the_angles_of_fits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = involutivity.main(tmp_path, quick=True)
    assert found["rank_correlation"] > 0.95
    assert 0.7 < found["smallest_ratio"] < found["median_ratio"] < 1.2  # nothing is fitted to the expected angles
    assert found["largest_ratio"] < 1.6
    assert found["x_I"] < found["xy_I"] / 50  # same arm, same box: with and without exact coordinates
    assert found["x_M"] < found["xy_M"] / 50
    assert capsys.readouterr().out.count("\n") == 7
    assert (tmp_path / "involutivity.png").stat().st_size > 10_000


@pytest.mark.nightly
@pytest.mark.slow
def test_angles_grow_with_the_box_as_the_defect_expects_at_any_degree(tmp_path: Path) -> None:
    found = domain_size.main(tmp_path, quick=True)
    assert 0.9 < found["smallest_ratio"] <= found["largest_ratio"] < 1.15  # nothing is fitted to the expected angles
    assert abs(found["exponent"] - found["expected_exponent"]) < 0.15
    assert found["exponent"] > 1.1  # faster than the size: the defect itself grows
    assert found["gain_of_degree"] < 1.3
    assert (tmp_path / "domain_size.png").stat().st_size > 10_000


def test_a_clear_box_takes_for_clear_what_pinocchio_does() -> None:
    of_x, frame = clear_positions.main(quick=True)
    assert float(of_x.split("|")[3].strip(" %")) > 20
    assert frame.endswith("| 0.0% | 0.0% |")


@pytest.mark.nightly
@pytest.mark.slow
def test_suggested_domain_of_an_arm_from_its_urdf_has_no_folds() -> None:
    (line,) = suggested_domains.main(quick=True)
    *_, widths, leak, least = line.strip("| ").split("|")
    assert widths.count("cyclic") == widths.count("idle") == 1
    assert float(leak) <= 8.2  # 8 on the samples of the confirmation
    assert float(least) >= 0.2


@pytest.mark.nightly
@pytest.mark.slow
def test_comparison_example_draws_and_returns_the_best(tmp_path: Path) -> None:
    best = compare_parametrisations.main(tmp_path, quick=True)
    least = min(value for name, value in best["planar_3r_xy"].items() if name.endswith("task_std_deg"))
    assert 5 < least < 8
    for name in ("front.png", "convergence.png", "comparison.csv", "table.txt"):
        assert (tmp_path / "planar_3r_xy" / name).stat().st_size > 100


def test_comparison_example_knows_every_problem() -> None:
    assert set(compare_parametrisations.BASES) == set(compare_parametrisations.NETWORKS)
    problem = compare_parametrisations.build("iiwa_pose")
    assert (problem.m, problem.r) == (6, 1)


@pytest.mark.slow
def test_distillation_keeps_more_with_the_degree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = distillation.main(tmp_path, quick=True)
    assert found["euclidean polynomial:4"] < 0.2 < found["euclidean polynomial:2"] < 2
    assert found["inertia polynomial:4"] > 2  # steep coordinates: stated in the docs
    assert "| euclidean | polynomial:4 |" in capsys.readouterr().out
    assert oc.evaluate(oc.load(tmp_path / "distilled_euclidean.orthocas"), 1000).task_angle.std < 0.2


@pytest.mark.slow
def test_gallery_shrinks_pictures(tmp_path: Path) -> None:
    assert set(gallery.main(tmp_path, "fig11", quick=True)) == {"fig11"}
    with Image.open(tmp_path / "fig11.png") as picture:
        assert picture.mode == "RGB"
        assert 600 < picture.width <= gallery.WIDTH


def test_gallery_keeps_every_colour(tmp_path: Path) -> None:
    red, green = np.meshgrid(np.arange(0, 256, 4, dtype=np.uint8), np.arange(0, 256, 4, dtype=np.uint8))
    colours = np.stack([red, green, red ^ green], axis=2)  # 4096 of them
    Image.fromarray(colours).save(tmp_path / "many.png")
    gallery.shrink(tmp_path / "many.png")
    with Image.open(tmp_path / "many.png") as picture:
        assert np.array_equal(np.asarray(picture), colours)


def test_gallery_page_shows_every_figure() -> None:
    page = (Path(__file__).parents[2] / "docs" / "gallery.md").read_text()
    shown = re.findall(r"figures/paper/(fig\d+)\.png", page)
    assert shown == list(FIGURES)
    assert page.count("- Agrees: ") == page.count("- Differs: ") == len(shown)


@pytest.mark.nightly
@pytest.mark.slow
def test_growing_benchmark_compares_equal_results(capsys: pytest.CaptureFixture[str]) -> None:
    found = growing_queries.main(quick=True)
    assert found["euclidean ours error"] < 1e-9
    assert found["euclidean CVODES error"] < 1e-8
    assert found["euclidean SciPy RK45, NumPy by hand, stop 1e-06 error"] < 1e-5
    assert found["euclidean SciPy RK45, robot functions, stop 1e-09 error"] < 1e-8
    assert "| ours |" in capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.slow
def test_fronts_of_ipopt_and_gauss_newton_agree(capsys: pytest.CaptureFixture[str]) -> None:
    found = ipopt_front.main(quick=True)
    assert found["iiwa_domination"] < 0.02
    assert found["planar_3r_xy_domination"] < 0.02
    assert capsys.readouterr().out.count("\n") == 4


@pytest.mark.nightly
@needs_c
@pytest.mark.slow
def test_the_flange_moves_alike_in_single_precision(capsys: pytest.CaptureFixture[str]) -> None:
    found = supervised_tick.main(quick=True)
    assert found["flange"] < 1e-5
    assert 1e-8 < found["proof"] < 1e-4
    assert len(re.findall(r"\| (?:double|float) \|", capsys.readouterr().out)) == 2


@pytest.mark.nightly
@pytest.mark.slow
@needs_c
def test_benchmark_of_the_inverse_finds_every_row(capsys: pytest.CaptureFixture[str]) -> None:
    found = inverse.main(quick=True)
    assert {found[f"{solver}, none found"] for solver in ("NumPy", "compiled C")} == {1.0}
    assert {value for name, value in found.items() if name.endswith("wrong")} == {0}
    assert len(re.findall(r"\| (?:NumPy|compiled C) \|", capsys.readouterr().out)) == 8


@pytest.mark.nightly
@pytest.mark.slow
@needs_c
def test_benchmarks_of_contact_and_gears_lose_no_arm() -> None:
    for benchmark in (contact, elastic_joints):
        found = benchmark.main(quick=True)
        assert found["runs"] >= 3
        assert found["lost"] == 0
    # without the springs' sag taken off, the tip is off by millimetres
    assert found["gravity"] < 0.1 < found["motors"]


@pytest.mark.nightly
@pytest.mark.slow
def test_benchmarks_of_networks_and_starts_print_rows(capsys: pytest.CaptureFixture[str]) -> None:
    assert "| q | 300 | 1000, 30 |" in paper_network.row((1000.0, 30.0), raw=True, quick=True)
    starts.main(quick=True)
    assert "| polynomial:2 | gauss_newton |" in capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.slow
@needs_c
def test_benchmark_of_casadi_dynamics_times_every_function() -> None:
    """The fastest of few rounds: a forward dynamics takes longer than the mass matrix in it."""
    found = casadi_dynamics.main(quick=True)
    assert len(found) == len(casadi_dynamics.FUNCTIONS)
    assert 0 < found["iiwa, 7 joints, mass matrix"] < found["iiwa, 7 joints, forward dynamics"]


@pytest.mark.nightly
@pytest.mark.slow
@needs_c
def test_benchmark_of_batches_prints_rows() -> None:
    rows = batches.main(quick=True)
    assert [row.split("|")[1].strip() for row in rows[:3]] == ["orthocas", "NumPy, float64", "NumPy, float32"]


@pytest.mark.nightly
@pytest.mark.slow
def test_benchmark_of_exported_inverses_finds_the_answers_of_the_chart() -> None:
    found = exported_inverse.main(quick=True)
    assert found["panda, pose, wide, numpy, difference [rad]"] < 1e-9
    assert found["iiwa, position, degree 4, numpy, other status"] == 0


@pytest.mark.slow
def test_benchmark_of_the_nearest_xi_finds_the_answers_of_the_chart() -> None:
    found = exported_nearest.main(quick=True)
    assert found["iiwa7-pose, numpy, as the chart [%]"] == 100.0


@pytest.mark.slow
def test_benchmark_beyond_reach_finds_nothing_nearer() -> None:
    found = beyond_reach.main(quick=True)
    assert found["panda-wide, nearer [m]"] < 1e-5
    assert found["panda-wide, settled"] == 1
    assert found["panda-wide, left"] == 0
    assert found["panda-wide, way [m]"] > 0.05


@pytest.mark.nightly
def test_benchmark_of_scenes_moves_the_elbow_into_a_slot() -> None:
    """Without pink, whose barrier then has no answer; contacts are looked for at all ticks and between them."""
    found = collision_scenes.main(quick=True)
    assert found["into a slot, planned, done"] == found["into a slot, ours, done"] == 1
    assert found["into a slot, ours, contacts"] == 0


@pytest.mark.nightly
def test_benchmark_of_collisions_agrees_with_coal_and_touches_nothing() -> None:
    found = collisions.main(quick=True)
    assert found["panda, differ"] == 0
    assert found["panda, apart [m]"] < 1e-9
    assert found["panda, lost"] == 0
    assert found["panda, ratio"] < 1.6
    assert found["panda, contacts"] == 0
    assert found["panda, nearest [m]"] > 0.01 - 1e-6


@pytest.mark.nightly
def test_benchmark_of_collisions_agrees_with_mujoco() -> None:
    found = collisions_in_mujoco.main(quick=True)
    assert found["panda, URDF, deep"] == 0
    assert found["panda, URDF, apart [m]"] < 1e-7


@pytest.mark.nightly
def test_benchmark_of_random_walks_breaks_no_limit() -> None:
    found = random_walk.main(quick=True)
    assert found["one arm, beyond joint limits"] == 0
    assert found.get("many arms, JAX, beyond joint limits", 0) == 0


@pytest.mark.slow
def test_benchmark_of_xi_in_a_quadratic_program_leaves_the_tool_alone() -> None:
    pytest.importorskip("pink", reason="pink is in the extra `peers`")
    found = xi_in_qp.main(quick=True)
    assert found["xi, cost 0.1, error [m]"] < 2e-5 < found["posture, cost 0.1, error [m]"]
    assert found["xi, cost 0.1, drift [rad]"] < 1e-5 < found["none, drift [rad]"]


@pytest.mark.slow
def test_xi_in_an_inverse_dynamics_leaves_the_tool_alone_at_any_weight() -> None:
    found = xi_in_qp.in_dynamics(quick=True)
    errors = {kind: [found[f"{kind}, weight {w:g}, error [m]"] for w in xi_in_qp.WEIGHTS] for kind in ("posture", "xi")}
    assert errors["xi"][2] < 1.01 * errors["xi"][0] < 5e-6 < errors["posture"][1] < errors["posture"][2] / 5


@pytest.mark.slow
@pytest.mark.parametrize("title", xi_in_solvers.WEIGHTS)
def test_xi_in_other_solvers_leaves_the_tool_alone_at_any_weight(title: str) -> None:
    """The recipes of docs/how-to/qp.md, which need environments of their own."""
    pytest.importorskip(title.lower(), reason="needs an older Pinocchio, see docs/how-to/qp.md")
    measured, code = xi_in_solvers.MEASURED[title], xi_in_solvers.part(title)
    errors = {
        kind: [measured(code, kind, weight, False)[0] for weight in xi_in_solvers.WEIGHTS[title]]
        for kind in ("posture", "xi")
    }
    assert max(errors["xi"]) < 5e-6
    assert errors["posture"][2] > 20 * errors["xi"][2]


def test_gradients_agree_with_pytorch() -> None:
    pytest.importorskip("torch")
    import gradients

    assert len(gradients.main(quick=True)) == 2  # it checks values and gradients before timing


@pytest.mark.nightly
def test_the_elbow_angle_leans_farther_into_the_task_than_fitted_coordinates() -> None:
    """The benchmark takes leaks straight from Jacobians; `evaluate` has formulas of its own."""
    found = {name: numbers["leak rms [deg]"] for name, numbers in elbow_angle.main(quick=True).items()}
    assert found["stereographic SEW"] > found["conventional SEW"] > 1.5 * found["linear"] > 1.5 * found["fitted"]
    arm = oc.problems.get("iiwa")
    task = oc.Task.named(arm.robot, "pose", arm.domain.centre)
    chart = oc.fit(oc.Problem(arm.robot, task, domain=arm.domain), oc.SEW()).chart
    points = sample_uniform(arm.domain, 500, 2)
    assert oc.evaluate(chart, points=points).leak.rms == pytest.approx(
        np.sqrt((elbow_angle.leaks(chart, points) ** 2).mean()), rel=1e-6
    )
    panda = wide_charts.robot_of("panda")
    problem = oc.Problem(panda, oc.Task.pose(panda))
    points = sample_uniform(problem.domain, 50, 2)
    for kind in ("conventional", "stereographic"):
        own, same = (oc.fit(problem, angle).chart for angle in (oc.SEW(kind), elbow_angle.through_origins(panda, kind)))
        np.testing.assert_allclose(same.xi(points), own.xi(points), atol=1e-12)


@pytest.mark.nightly
def test_benchmark_of_quantities_has_them_exactly_and_nearly() -> None:
    exact, near = quantities.main(quick=True)
    assert [row.split(" | ")[0] for row in (*exact, *near)] == [
        "| panda, conventional",
        "| panda, stereographic",
        "| iiwa, A3",
    ]
    assert all(row.count("|") == 4 for row in exact)


@pytest.mark.nightly
@pytest.mark.slow
def test_benchmark_of_wide_charts_closes_loops() -> None:
    row, nearer, everywhere, loops = wide_charts.main(quick=True)
    assert float(row.split("|")[4].strip("% ")) > 99
    assert float(nearer.split("|")[3].strip("% ")) > 99
    assert float(everywhere.split("|")[4].strip("% ")) > 100 / 8 - 5  # the chart of one of eight branches
    words = [word.strip() for word in loops.split("|")]
    assert words[3] == words[5] == "3 of 3"
    assert max(float(words[4]), float(words[6])) < 1e-9
