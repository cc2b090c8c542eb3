"""Clear boxes: the part of a box where the task is not near-singular, in Python, in files, in C and in proofs."""

import dataclasses
import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from chart_files import header_of, resealed
from numpy.typing import NDArray
from programs import Run, needs_c

import orthocas as oc
from orthocas import control
from orthocas.bases.cyclic import widen_over_cyclic_joints
from orthocas.certificates.certify import check_certificate
from orthocas.charts.point_quality import worst_points
from orthocas.codegen import CompiledLibrary, check_c, compile_shared
from orthocas.codegen.generate import _compute_check
from orthocas.codegen.rendering import DOUBLE
from orthocas.control import ControlStatus
from orthocas.errors import ChartFileError, DomainError, InvalidValueError, UnreachableReferenceError
from orthocas.fitting.fit import offer_clear_part
from orthocas.tasks.samples import sample_boundary_weighted, sample_evenly, sample_uniform

Numbers = NDArray[np.float64]
BOUND = 0.2
WIDE = oc.Box(
    [0.6, 0.8, 0.8], [0.8, 1.15, 1.15]
)  # reaches beyond the straight arm, q2 = q3 = 0, to no clear position there
STRAIGHT = [0.6, 0.02, 0.01]


@pytest.fixture(scope="module")
def problem() -> oc.Problem:
    known = oc.problems.get("planar_3r_xy")
    return oc.Problem(known.robot, known.task, domain=WIDE, least_singular_value=BOUND)


@pytest.fixture(scope="module")
def chart(problem: oc.Problem) -> oc.Chart:
    return oc.fit(problem, oc.Polynomial(3)).chart


def by_hand(task: oc.Task, domain: oc.Box, q: Numbers, rows: str = "frame") -> Numbers:
    """Relative singular values from NumPy's SVD and central differences, up to the scale, (N,).

    Differences of the task, or of positions and orientations of the tip: without a reference.
    """

    def change(after: Numbers, before: Numbers) -> Numbers:
        if task.turn is None or rows == "x":
            return np.asarray(task.batched(after)[0] - task.batched(before)[0])
        moved = task.robot.tip_position(after) - task.robot.tip_position(before)
        R, S = task.robot.tip_rotation(before), task.robot.tip_rotation(after)
        turned = R.transpose(0, 2, 1) @ S
        if task.turn.axis is not None:
            return np.hstack([moved, turned[:, :2, 2]])
        return np.hstack([moved, turned[:, [2, 0, 1], [1, 2, 0]]])

    def jacobians(points: Numbers) -> Numbers:
        steps = 1e-6 * np.eye(points.shape[1])
        return np.stack([change(points + e, points - e) / 2e-6 for e in steps], axis=2)

    u = np.random.default_rng(5).uniform(-1, 1, (20_000, len(domain.centre)))
    lengths = np.sqrt((jacobians(domain.centre + domain.half_width * u) ** 2).sum(axis=2).mean(axis=0))
    units = np.array(task.units)
    scale = np.array([np.sqrt((lengths[units == unit] ** 2).mean()) for unit in units])
    values: Numbers = np.linalg.svd(jacobians(q) / scale[:, None], compute_uv=False)[:, -1]
    return values


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["position:xy", "pose", "polar", "position+axis"])
def test_points_are_inside_just_where_the_smallest_singular_value_is_large_enough(kind: str) -> None:
    known = oc.problems.get("planar_3r_xy" if kind in ("position:xy", "polar") else "iiwa")
    task = oc.Task.named(known.robot, kind, known.domain.centre)
    box = oc.Box(known.domain.centre, 0.7)
    points = sample_uniform(box, 2000, 1)
    values = by_hand(task, box, points)
    clear = oc.ClearBox(box, task, 0.9 * float(np.minimum(np.median(values), by_hand(task, box, box.centre[None]))[0]))
    sure = np.abs(values / clear.least_singular_value - 1) > 0.03  # the scale is a mean of 256 samples
    assert sure.mean() > 0.8
    np.testing.assert_array_equal(clear.contains(points)[sure], values[sure] > clear.least_singular_value)
    np.testing.assert_allclose(clear.singular_values(points), values, rtol=0.03)
    exact = clear.singular_values(points) > clear.least_singular_value
    np.testing.assert_array_equal(clear.contains(points), exact)  # elimination agrees with the SVD
    assert clear.share == pytest.approx(exact.mean(), abs=0.03)
    assert not clear.contains(points[0] + 10.0)


def test_singular_values_do_not_depend_on_how_the_world_is_turned() -> None:
    arm = oc.problems.get("iiwa")
    clear = oc.ClearBox(arm.domain, arm.task, 0.1)
    points = sample_uniform(arm.domain, 50, 2)
    turned = points + np.eye(7)[0] * 1.3
    np.testing.assert_allclose(clear.singular_values(turned), clear.singular_values(points), rtol=1e-10)


@pytest.mark.parametrize("draw", [sample_uniform, sample_boundary_weighted, sample_evenly])
def test_samples_lie_inside_and_follow_the_seed(problem: oc.Problem, draw: object) -> None:
    assert callable(draw)
    points = draw(problem.domain, 5000, 3)
    assert points.shape == (5000, 3)
    assert problem.domain.contains(points).all()  # type: ignore[union-attr]
    np.testing.assert_array_equal(points, draw(problem.domain, 5000, 3))
    assert not np.array_equal(points, draw(problem.domain, 5000, 4))
    in_box = draw(WIDE, 20_000, 5)
    wanted = in_box[problem.domain.contains(in_box)].mean(axis=0)
    np.testing.assert_allclose(points.mean(axis=0), wanted, atol=0.05)  # standard error 0.01
    plain = draw(WIDE, 5000, 3)  # even and uniform samples are the first ones of the box that lie inside
    kept = plain[problem.domain.contains(plain)]
    assert draw is sample_boundary_weighted or np.array_equal(points[: len(kept)], kept)


def test_a_single_sample_is_drawn(problem: oc.Problem) -> None:
    for domain in (WIDE, problem.domain):
        assert [draw(domain, 1, 0).shape for draw in (sample_uniform, sample_boundary_weighted, sample_evenly)] == [
            (1, 3)
        ] * 3


def test_a_domain_of_which_nothing_is_left_is_refused_soon(problem: oc.Problem) -> None:
    best = problem.domain.singular_values(sample_uniform(WIDE, 20_000, 0)).max()  # type: ignore[attr-defined]
    with pytest.raises(DomainError, match=r"the centre of the domain has a relative singular value of 0\.\d+"):
        oc.Problem(problem.robot, problem.task, domain=WIDE, least_singular_value=2 * best)
    arm = oc.problems.get("iiwa")
    measured, points = oc.ClearBox(arm.domain, arm.task, 1e-6), sample_uniform(arm.domain, 20_000, 0)
    values = measured.singular_values(points)
    around_the_best = oc.Box(points[int(values.argmax())], 0.5)
    needle = oc.ClearBox(around_the_best, arm.task, 0.9999 * values.max(), measured.scale)
    with pytest.raises(DomainError, match=r"of \d+ points of its box lie in the domain, expected at least 0.1%"):
        sample_uniform(needle, 1000, 0)


def test_bad_bounds_are_refused(problem: oc.Problem) -> None:
    robot, task = problem.robot, problem.task
    for bound in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InvalidValueError, match=r"least_singular_value is .*, expected positive and finite"):
            oc.Problem(robot, task, domain=WIDE, least_singular_value=bound)
    with pytest.raises(
        InvalidValueError, match="least_singular_value is 0.1, expected no bound, because the domain is a torus"
    ):
        oc.Problem(robot, task, domain=oc.Torus(3), least_singular_value=0.1)
    with pytest.raises(InvalidValueError, match="scale is 0"):
        oc.ClearBox(WIDE, task, 0.1, [1.0, 0.0])


def test_a_clear_box_follows_the_task_of_its_problem(problem: oc.Problem) -> None:
    other = oc.Problem(problem.robot, oc.Task.position(problem.robot, "x"), domain=problem.domain)
    assert isinstance(other.domain, oc.ClearBox)
    assert other.domain.task is other.task
    assert other.domain.scale.shape == (1,)
    same = oc.Problem(problem.robot, problem.task, "inertia", problem.domain)
    assert same.domain is problem.domain


def test_a_missing_reference_is_taken_at_the_centre() -> None:
    arm = oc.problems.get("iiwa")
    pose = oc.Problem(arm.robot, oc.Task.pose(arm.robot), domain=arm.domain, least_singular_value=0.01)
    assert isinstance(pose.domain, oc.ClearBox)
    assert pose.domain.task is pose.task


def test_a_pose_is_judged_by_the_robot_and_not_by_its_reference(iiwa: oc.Problem) -> None:
    """The last joint only turns the tool: s does not depend on it, while the rows of x lose rank at half a turn."""
    box = oc.Box(iiwa.domain.centre, [*[0.5] * 6, 3.0])
    task = oc.Task.pose(iiwa.robot, iiwa.robot.tip_rotation(box.centre))
    frame, of_x = oc.ClearBox(box, task, 0.05), oc.ClearBox(box, task, 0.05, rows="x")
    points = sample_uniform(box, 500, 3)
    turned = points * [1, 1, 1, 1, 1, 1, 0] + np.eye(7)[6] * np.pi
    np.testing.assert_allclose(frame.singular_values(turned), frame.singular_values(points), rtol=1e-9)
    np.testing.assert_allclose(by_hand(task, box, points, "x"), of_x.singular_values(points), rtol=0.03)
    half = box.centre + (np.pi - 1e-3) * np.eye(7)[6]
    assert of_x.singular_values(half) < 1e-3
    assert frame.singular_values(half) == pytest.approx(frame.singular_values(box.centre), rel=1e-9)
    metres, turns = frame.scale[[0, 5]]
    assert turns == pytest.approx(np.sqrt(7 / 3))  # seven unit axes
    assert f"(rows of the frame Jacobian over {metres:.3g} m, {turns:.3g} rad)" in frame.heading
    assert "rows of J_x over" in of_x.heading
    with pytest.raises(oc.errors.UnknownNameError, match="rows 'world'"):
        oc.ClearBox(box, task, 0.05, rows="world")


def test_files_that_do_not_name_the_rows_mean_those_of_x(iiwa: oc.Problem, tmp_path: Path) -> None:
    """And they keep their fingerprints, so their certificates stay."""
    box = oc.Box(iiwa.domain.centre, [*[0.5] * 6, 2.9])
    task = oc.Task.pose(iiwa.robot, iiwa.robot.tip_rotation(box.centre))
    points = sample_uniform(box, 300, 4)
    for rows in ("x", "frame"):
        clear = oc.ClearBox(box, task, 0.1, rows=rows)
        chart = oc.fit(oc.Problem(iiwa.robot, task, domain=clear), oc.Linear()).chart
        chart.save(tmp_path / rows)
        assert ("judged_rows" in header_of(tmp_path / rows)["problem"]) == (rows == "frame")  # type: ignore[operator]
        again = oc.load(tmp_path / rows).problem.domain
        assert isinstance(again, oc.ClearBox)
        assert again.rows == rows
        np.testing.assert_array_equal(again.contains(points), clear.contains(points))
    header = header_of(tmp_path / "frame")
    header["problem"] = {**header["problem"], "judged_rows": "wrist"}  # type: ignore[dict-item]
    with pytest.raises(ChartFileError, match="rows 'wrist'"):
        oc.load(resealed(tmp_path / "frame", header))


def test_laws_work_on_where_x_ends(iiwa: oc.Problem) -> None:
    box = oc.Box(iiwa.domain.centre, [*[0.3] * 6, 3.2])
    free = oc.Robot(dataclasses.replace(iiwa.robot.tree, lower=np.full(7, -9.0), upper=np.full(7, 9.0)))
    task = oc.Task.pose(free, free.tip_rotation(box.centre))
    chart = oc.fit(oc.Problem(free, task, domain=box, least_singular_value=0.02), oc.Linear()).chart
    law, zero = control.PDPlus(chart, 50.0), np.zeros(7)
    for turn in (0.0, 2.8, np.pi - 1e-3, np.pi, np.pi + 1e-3):
        q = box.centre + turn * np.eye(7)[6]
        assert chart.problem.domain.contains(q)
        _, status = law.function(q, zero, chart.phi(q), zero, zero, *law.gains.values())
        assert int(status) == ControlStatus.OK
    assert oc.check(chart.problem, 2000).half_turn_samples > 0


def test_cyclic_joints_keep_the_condition(problem: oc.Problem) -> None:
    wider = widen_over_cyclic_joints(problem, ("q1",)).domain
    assert isinstance(wider, oc.ClearBox)
    np.testing.assert_array_equal(wider.scale, problem.domain.scale)  # type: ignore[union-attr]
    assert wider.contains([50.0, 0.8, 0.8])
    assert not wider.contains([50.0, *STRAIGHT[1:]])


@pytest.mark.slow
def test_the_bound_takes_the_folds_out_of_a_box_with_singular_positions(problem: oc.Problem, chart: oc.Chart) -> None:
    whole = oc.fit(oc.Problem(problem.robot, problem.task, domain=WIDE), oc.Polynomial(3))
    assert whole.worst is not None
    assert whole.worst.least < 0
    points = sample_boundary_weighted(problem.domain, 100_000, (7, 7))
    volumes = np.linalg.det(chart.jacobian(points))
    assert np.sign(volumes).min() == np.sign(volumes).max()
    report = oc.evaluate(chart, 20_000)
    assert report.folded_samples == 0
    assert report.conditioning.min > 0.1
    assert report.worst is not None
    assert problem.domain.contains(report.worst.points).all()


def test_the_search_for_worst_points_stays_inside(problem: oc.Problem, chart: oc.Chart) -> None:
    found = worst_points(problem, chart.coordinates, seed=4)
    assert problem.domain.contains(found.points).all()
    values = problem.domain.singular_values(found.points)  # type: ignore[union-attr]
    assert values.min() < 1.1 * BOUND  # but it goes up to the boundary


@pytest.mark.slow
def test_fits_offer_the_bound_that_helps() -> None:
    arm = oc.problems.get("iiwa")
    box = oc.Box(arm.domain.centre, 1.0)
    fit = oc.fit(oc.Problem(arm.robot, arm.task, domain=box), oc.Polynomial(3), samples=800)
    assert fit.worst is not None
    assert fit.worst.least < 0.05
    offer = fit.clear_part
    assert offer is not None
    assert f"least singular value {offer.least_singular_value:g} stays clear" in repr(fit)
    failed = fit.worst.below(0.05)
    clear = oc.ClearBox(box, arm.task, offer.least_singular_value)
    assert clear.contains(failed).mean() <= 0.1
    assert offer.share == clear.share > 0.5
    healthy = oc.fit(oc.Problem(arm.robot, arm.task, domain=oc.Box(box.centre, 0.3)), oc.Polynomial(1), samples=100)
    assert healthy.clear_part is None


def test_nothing_is_offered_where_the_centre_is_singular() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    straight = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.5, 0.0, 0.0], 0.5))
    found = oc.check(straight)
    assert found.singular_samples > 0
    assert offer_clear_part(straight, found, None) is None


@pytest.mark.slow
def test_a_fit_says_which_option_helps(run: Run) -> None:
    task = ("--half-width", "0.8,1.2,1.2", "--metric", "euclidean")
    words = ("fit", "planar_3r_xy", *task, "--param", "polynomial:3")
    code, out, _ = run(*words, "--out", "whole.orthocas")
    assert code == 0
    assert "--least-singular-value" in out
    clear = "clear.orthocas"
    code, out, _ = run(*words, "--least-singular-value", "0.2", "--out", clear, "--json")
    assert code == 0
    assert json.loads(out)["folded_samples"] == 0
    code, out, _ = run("info", clear, "--json")
    told = json.loads(out)
    assert (told["domain"], told["least_singular_value"]) == ("clear box", 0.2)
    assert 0.5 < told["clear_share"] < 1
    assert len(told["row_scale"]) == 2
    code, _, error = run(*words, "--least-singular-value", "3", "--out", "no.orthocas")
    assert code == 2
    assert "expected one above least_singular_value = 3" in error
    code, _, error = run("fit", "planar_3r_xy", "--domain", "auto", "--least-singular-value", "0.1")
    assert code == 2
    assert "leave out --least-singular-value" in error


def test_files_keep_the_domain(chart: oc.Chart, tmp_path: Path) -> None:
    chart.save(tmp_path / "clear.orthocas")
    again = oc.load(tmp_path / "clear.orthocas").problem.domain
    here = chart.problem.domain
    assert isinstance(again, oc.ClearBox)
    assert isinstance(here, oc.ClearBox)
    assert again.least_singular_value == here.least_singular_value
    np.testing.assert_array_equal(again.scale, here.scale)
    points = sample_uniform(WIDE, 1000, 0)
    np.testing.assert_array_equal(again.contains(points), here.contains(points))


def test_a_box_with_a_singular_centre_has_its_home_elsewhere(problem: oc.Problem, tmp_path: Path) -> None:
    """Reference, signs, files, other boxes, starts and generated C use the home; one that is not clear is refused."""
    robot, home = problem.robot, np.array([0.6, 0.8, 0.8])
    task, box = oc.Task.position(robot, "xy"), oc.Box([0.6, 0.0, 0.0], [0.5, 1.2, 1.2])
    with pytest.raises(DomainError, match="the centre of the domain has a relative singular value"):
        oc.ClearBox(box, task, BOUND)
    domain = oc.ClearBox(box, task, BOUND, home=home)
    chart = oc.fit(oc.Problem(robot, task, domain=domain), oc.Polynomial(2), samples=500).chart
    np.testing.assert_array_equal(chart.domain.home, home)
    np.testing.assert_array_equal(chart.domain.centre, box.centre)
    assert chart.xi(home) == pytest.approx(0.0, abs=1e-12)
    # files, pickles, and boxes that have the home or not
    chart.save(tmp_path / "home.orthocas")
    for again in (oc.load(tmp_path / "home.orthocas").domain, pickle.loads(pickle.dumps(domain))):
        np.testing.assert_array_equal(again.home, home)
    np.testing.assert_array_equal(domain.apply_to(oc.Box([0.6, 0.2, 0.2], 1.0)).home, home)
    np.testing.assert_array_equal(domain.apply_to(oc.Box([0.6, -0.8, -0.8], 0.3)).home, [0.6, -0.8, -0.8])
    # ranges, laws and the check of generated C begin there
    assert chart.xi_range(chart.domain.home)["xi1"]
    law = control.PDPlus(chart, 50.0)
    zero = np.zeros(3)
    assert int(law.function(home, zero, chart.phi(home), zero, zero, *law.gains.values())[1]) == ControlStatus.OK
    assert chart.domain.contains(_compute_check(chart, law, DOUBLE)["q"])
    for place, message in (([0.6, 0.0, 0.0], "the home of the domain has a"), ([3.0, 0.8, 0.8], "outside its box")):
        with pytest.raises(DomainError, match=message):
            oc.ClearBox(box, task, BOUND, home=place)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"least_singular_value": 1e300}, "the centre of the domain has a relative singular value"),
        ({"least_singular_value": -1.0}, "expected positive and finite"),
        ({"least_singular_value": "0.1"}, "field 'least_singular_value'"),
        ({"least_singular_value": None}, "field 'least_singular_value'"),
        ({"scale": np.array([1.0])}, "scale has shape"),
        ({"scale": np.array([1e200, 1e200])}, "the centre of the domain has a relative singular value"),
        ({"scale": np.array([1e-200, 1e-200])}, "the centre of the domain has a relative singular value"),
        ({"scale": np.array([np.nan, 1.0])}, "scale"),
        ({"domain": "clear torus"}, "unknown domain 'clear torus'"),
    ],
)
def test_hostile_files_get_one_error(chart: oc.Chart, tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = tmp_path / "hostile.orthocas"
    chart.save(path)
    header = header_of(path)
    scale = change.pop("scale", None)
    header["problem"] = {**header["problem"], **change}  # type: ignore[dict-item]
    arrays = {} if scale is None else {"domain_row_scale": scale}
    with pytest.raises(ChartFileError, match=message) as caught:
        oc.load(resealed(path, header, **arrays))
    assert "\n" not in str(caught.value)


def test_guards_refuse_positions_that_are_not_clear(chart: oc.Chart) -> None:
    law = control.PDPlus(chart, 50.0)
    zero = np.zeros(3)
    for q in sample_uniform(WIDE, 200, 6):
        phi = chart.phi(q)
        _, status = law.function(q, zero, phi, zero, zero, *law.gains.values())
        wanted = ControlStatus.OK if chart.problem.domain.contains(q) else ControlStatus.OUTSIDE_DOMAIN
        assert int(status) == wanted


def test_references_into_the_singular_part_are_refused(chart: oc.Chart) -> None:
    start = chart.problem.domain.centre
    there = np.array(STRAIGHT)
    path = start + np.linspace(0, 1, 50)[:, None] * (there - start)
    reference = control.Reference.through(chart.labels, np.linspace(0, 1, 50), chart.phi(path))
    law = control.PDPlus(chart, 50.0)
    with pytest.raises(UnreachableReferenceError, match="the task has a relative singular value of 0.1"):
        law.require_reachable(reference, start)
    with pytest.raises(UnreachableReferenceError, match="the start lies outside the domain"):
        law.require_reachable(reference, there)
    with pytest.raises(UnreachableReferenceError):
        oc.simulate(law, reference, start)


def test_the_boundary_distance_is_not_positive_outside(chart: oc.Chart) -> None:
    quality = chart.quality([chart.problem.domain.centre, STRAIGHT])
    assert quality.boundary_distance[0] > 0
    assert quality.boundary_distance[1] <= 0


@pytest.mark.slow
@needs_c
def test_c_has_the_same_inside(chart: oc.Chart, tmp_path: Path) -> None:
    law = control.PDPlus(chart, 50.0, coupling="decoupled")
    generated = oc.generate_c(chart, tmp_path, law, "arm")
    proof = check_c(generated, chart, law, states=400)
    assert max(proof.differences.values()) < 1e-10
    header = (tmp_path / "arm.h").read_text()
    assert "the relative singular value of the task above 0.2" in header
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3)
    domain = chart.problem.domain
    points = sample_uniform(WIDE, 3000, 8)
    wanted = np.where(domain.contains(points), ControlStatus.OK, ControlStatus.OUTSIDE_DOMAIN)
    np.testing.assert_array_equal([library.chart(q)[2] for q in points], wanted)
    assert {ControlStatus.OK, ControlStatus.OUTSIDE_DOMAIN} <= set(wanted.tolist())
    q, status = library.inverse(chart.phi(STRAIGHT), np.array(STRAIGHT) + 1e-3)
    assert status == ControlStatus.OUTSIDE_DOMAIN
    np.testing.assert_allclose(q, STRAIGHT, atol=1e-6)


@pytest.mark.slow
@needs_c
def test_c_of_a_pose_task_has_the_same_inside(tmp_path: Path) -> None:
    arm = oc.problems.get("iiwa")
    base = oc.Problem(arm.robot, oc.Task.pose(arm.robot), domain=arm.domain)
    values = oc.ClearBox(base.domain, base.task, 1e-9).singular_values(sample_uniform(base.domain, 500, 0))  # type: ignore[arg-type]
    bound = float(min(np.median(values), 0.9 * values[0]))
    problem = oc.Problem(arm.robot, base.task, domain=arm.domain, least_singular_value=bound)
    chart = oc.fit(problem, oc.Linear()).chart
    assert check_c(oc.generate_c(chart, tmp_path), chart, states=200).differences["phi"] < 1e-12


@pytest.mark.slow
def test_certificates_cover_the_clear_part(problem: oc.Problem) -> None:
    wider = oc.Problem(problem.robot, problem.task, domain=WIDE, least_singular_value=0.25)  # at 0.2 some fits fold
    chart = oc.fit(wider, oc.Polynomial(3)).chart
    found = oc.certify(chart)
    assert found.proved
    assert found.least_singular_value == 0.25
    assert "relative singular value is at most 0.25" in repr(found)
    assert check_certificate(chart, found)
    whole = oc.Problem(chart.problem.robot, chart.problem.task, domain=WIDE)
    assert oc.certify(oc.Chart(whole, chart.coordinates)).fold  # the same coordinates fold in the part left out


def test_a_fold_in_the_clear_part_is_never_certified(problem: oc.Problem) -> None:
    parametrisation = oc.Given.from_function("fold", 3, lambda q: ca.vertcat((q[2] - 1.2) ** 2))  # turns back at 1.2
    chart = oc.fit(problem, parametrisation).chart
    found = oc.certify(chart, time_limit=20)
    assert not found.proved
    assert found.fold
    assert problem.domain.contains(np.array(found.fold)).all()


def test_a_certificate_is_void_for_another_bound(chart: oc.Chart) -> None:
    found = oc.certify(chart, time_limit=0)
    other = oc.Problem(chart.problem.robot, chart.problem.task, domain=WIDE, least_singular_value=0.3)
    with pytest.raises(oc.errors.CertifyError, match="void"):
        dataclasses.replace(chart, problem=other, certificate=found)


def test_threads_and_pickles_share_a_clear_box(problem: oc.Problem) -> None:
    points = sample_uniform(WIDE, 4000, 9)
    wanted = problem.domain.contains(points)
    fresh = pickle.loads(pickle.dumps(problem)).domain
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(fresh.contains, [points] * 8):
            np.testing.assert_array_equal(found, wanted)
