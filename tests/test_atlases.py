"""Atlases: symmetries, search, coverage, quality, and charts that are what their numbers say."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from planar_atlas import ASKED, built, planar
from programs import Run

import orthocas as oc
from orthocas.atlas.box_fit import CubeBasis, moved
from orthocas.atlas.building import align
from orthocas.atlas.lattice import Outcome
from orthocas.atlas.plan import make_plan
from orthocas.errors import InvalidValueError, PathFileError
from orthocas.robots.homes import read_postures
from orthocas.tools.checks import Array


def test_seven_joint_arm_has_the_symmetries_of_its_spherical_joints(iiwa: oc.Problem) -> None:
    plan = make_plan(iiwa, oc.AtlasSettings(), 5.0)
    names = iiwa.robot.joint_names
    assert [names[i] for i in plan.cyclic] == ["A1"]
    assert [names[i] for i in plan.idle] == ["A7"]
    assert len(plan.maps) == 32  # mirror, shoulder upside down, and two postures each for A2, A4 and A6
    q = np.random.default_rng(1).uniform(-1, 1, (20, 7))
    J = iiwa.task.batched_jacobian(q)[0]
    for s, t in zip(plan.maps.signs, plan.maps.shifts, strict=True):
        image = q.copy()
        image[:, :6] = s * q[:, :6] + t
        K = iiwa.task.batched_jacobian(image)[0] * np.append(s, 1.0)
        here, there = (np.linalg.pinv(M) @ M for M in (J, K))  # the projector on the span of the gradients
        assert np.abs(here - there).max() < 1e-9


def test_arm_without_symmetries_has_the_identity_only(planar_x: oc.Problem) -> None:
    task = oc.Task.custom(
        planar_x.robot, "bent", lambda q: q[0] + 0.3 * q[1] ** 2 * q[2] + q[2] ** 3 + q[1] + 0.2 * q[2] ** 2
    )
    plan = make_plan(oc.Problem(planar_x.robot, task, domain=planar_x.domain), ASKED, 5.0)
    assert (plan.maps.signs.tolist(), plan.maps.shifts.tolist()) == ([[1.0] * 3], [[0.0] * 3])


@pytest.mark.slow
def test_chart_of_a_position_is_one_whose_box_holds_it(planar_atlas: oc.Atlas) -> None:
    """Against a search through all boxes."""
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (300, 3))
    numbers = planar_atlas.chart_at(q)
    for point, number in zip(q[::5], numbers[::5], strict=True):
        holding = [k for k in range(len(planar_atlas)) if planar_atlas.box(k, near=point).contains(point)]
        assert (number in holding) if number >= 0 else not holding
    assert (numbers >= 0).mean() > 0.9
    assert planar_atlas.chart_at(q[0]) == numbers[0]


def test_current_chart_stays_while_its_box_holds_the_position(planar_atlas: oc.Atlas, covered: Array) -> None:
    number = planar_atlas.chart_at(covered[0])
    box = planar_atlas.box(number)
    inside = box.centre + 0.999 * box.half_width * np.array([0.0, 1.0, 0.3])
    beyond = box.centre + 1.001 * box.half_width * np.array([0.0, 1.0, 0.3])
    assert planar_atlas.chart_at(inside, current=number) == number != planar_atlas.chart_at(inside)
    assert planar_atlas.chart_at(beyond, current=number) == planar_atlas.chart_at(beyond) != number


def test_values_are_those_of_the_single_charts(planar_atlas: oc.Atlas, covered: Array) -> None:
    numbers = planar_atlas.chart_at(covered)
    xi, J = planar_atlas.xi(covered), planar_atlas.jacobian(covered)
    for k in range(0, len(covered), 25):
        chart = planar_atlas.chart(int(numbers[k]), near=covered[k])
        assert chart.problem.domain.contains(covered[k])
        assert np.abs(chart.xi(covered[k]) - xi[k]).max() < 1e-12
        assert np.abs(chart.jacobian(covered[k])[chart.m :] - J[k]).max() < 1e-11


def test_jacobian_is_the_derivative_of_xi_in_the_same_chart(planar_atlas: oc.Atlas, covered: Array) -> None:
    numbers, h = planar_atlas.chart_at(covered), 1e-6
    steps = [
        (planar_atlas.xi(covered + h * e, numbers) - planar_atlas.xi(covered - h * e, numbers)) / (2 * h)
        for e in np.eye(3)
    ]
    assert np.abs(np.stack(steps, axis=-1) - planar_atlas.jacobian(covered, numbers)).max() < 1e-8


@pytest.mark.slow
def test_charts_are_as_good_as_asked_for(planar_atlas: oc.Atlas) -> None:
    """With the judge of single charts, at other samples."""
    for number in range(0, len(planar_atlas), 12):
        report = oc.evaluate(planar_atlas.chart(number), 2000, seed=5)
        assert report.leak.rms < 1.05 * ASKED.leak_deg
        assert report.conditioning.min > 0.9 * ASKED.conditioning


def test_neighbours_are_aligned(planar_atlas: oc.Atlas) -> None:
    found = align(planar_atlas.index)
    assert found.meetings > 20
    assert found.consistent > 0.9
    assert found.left <= 1.3 * found.jump


def test_polynomials_stay_the_same_on_another_box() -> None:
    basis = CubeBasis(3, ("a", "b", "c"), ("a",), 2)
    rng = np.random.default_rng(2)
    numbers = rng.normal(size=(2, 1 + basis.width))
    shift, scale = np.array([0.0, 0.3, -0.2]), np.array([1.0, 0.5, 0.7])
    v = rng.uniform(-1, 1, (50, 3))
    other = moved(numbers, basis.exponents.astype(int), shift, scale)

    def values(table: Array, u: Array) -> Array:
        return np.asarray(table[:, 0] + basis.values(u) @ table[:, 1:].T)

    assert np.abs(values(numbers, shift + scale * v) - values(other, v)).max() < 1e-12


def test_coverage_counts_what_has_a_chart(planar_atlas: oc.Atlas) -> None:
    coverage = oc.evaluate_atlas(planar_atlas, 3000)
    assert coverage.share > 0.95
    assert coverage.share + sum(coverage.holes.values()) == pytest.approx(1.0)
    rows = np.flatnonzero(coverage.chart >= 0)[:200:20]
    for k in rows:
        quality = planar_atlas.chart(int(coverage.chart[k]), near=coverage.q[k]).quality(coverage.q[k])
        assert np.sqrt((quality.leak_deg**2).mean()) == pytest.approx(coverage.leak_deg[k], abs=1e-6)
        assert quality.conditioning == pytest.approx(coverage.conditioning[k])
    _, share = coverage.by_joint(0)
    assert share.min() > 0.8


def test_surroundings_of_postures_are_covered_and_little_else(tmp_path: Path) -> None:
    postures = np.linspace([0.0, 0.6, 0.8], [0.0, 1.8, 0.8], 20)
    found = built(tmp_path / "path.orthocas-atlas", region=postures, radius=0.1)
    assert (found.chart_at(postures) >= 0).all()
    assert found.chart_at([0.0, -2.0, -2.0]) == -1
    assert oc.evaluate_atlas(found, 2000).share == 1.0


@pytest.mark.slow
def test_charts_are_certified_if_asked_for(tmp_path: Path) -> None:
    asked = oc.AtlasSettings(degree=2, leak_deg=14.0, half_width=0.2, certify_seconds=20.0)
    with ThreadPoolExecutor(1) as executor:
        region = [[0.0, 0.9, 0.9]]
        found = oc.build_atlas(planar(), tmp_path / "a", asked, region=region, radius=0.01, executor=executor)
    assert found.as_dict()["certified"] == found.fitted > 0
    assert oc.certify(found.chart(found.chart_at(region[0]))).proved
    assert oc.evaluate_atlas(found, 200).certified.all()


def test_boxes_without_a_proof_are_halved(tmp_path: Path) -> None:
    """No proof is found in a microsecond, so every box is halved as often as it may be."""
    asked = oc.AtlasSettings(degree=2, leak_deg=14.0, half_width=0.2, splits=1, certify_seconds=1e-6)
    with ThreadPoolExecutor(1) as executor:
        region = [[0.0, 0.9, 0.9]]
        found = oc.build_atlas(planar(), tmp_path / "a", asked, region=region, radius=0.01, executor=executor)
    assert found.as_dict()["certified"] == 0
    assert found.fitted > 0
    records = found.stock.records
    assert (records["outcome"][records["levels"].sum(axis=1) == 0] == Outcome.SPLIT).all()
    assert (records["outcome"][records["levels"].sum(axis=1) == 1] == Outcome.CHART).all()


def test_bad_arguments_are_named(tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    with pytest.raises(InvalidValueError, match="share"):
        built(path, share=0.0)
    with pytest.raises(InvalidValueError, match="leak_deg"):
        oc.AtlasSettings(leak_deg=-1.0)
    with pytest.raises(InvalidValueError, match="radius"):
        built(path, region=[[0.0, 1.0, 1.0]], radius=-1.0)
    assert not path.exists()


@pytest.mark.slow
def test_command_line_builds_shows_and_evaluates(run: Run) -> None:
    Path("path.csv").write_text("time,q3,q2,q1\n0,0.8,0.9,0\n1,0.8,1.1,0\n")
    words = ("--region", "path.csv", "--radius", "0.1", "--workers", "1", "--half-width", "0.8", "--degree", "2")
    code, out, err = run("atlas", "build", "planar_3r_xy", *words, "--out", "a.orthocas-atlas", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["charts"] > 0
    code, out, err = run("atlas", "evaluate", "a.orthocas-atlas", "--samples", "500", "--json", "--pictures", "out")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert list(found) == ["charts", "bytes", "coverage", "leak_deg", "conditioning"]
    assert (list(found["leak_deg"]), list(found["conditioning"])) == (["rms", "p99"], ["min", "p01", "mean"])
    assert found["coverage"] == 1.0
    assert found["bytes"] == Path("a.orthocas-atlas").stat().st_size
    assert Path("out/workspace.png").exists()
    assert Path("out/coverage_by_joint.png").exists()
    code, out, _ = run("atlas", "info", "a.orthocas-atlas")
    assert code == 0
    assert "cyclic q1" in out
    code, out, err = run("atlas", "evaluate", "a.orthocas-atlas", "--samples", "9" * 20)
    assert (code, out) == (2, "")
    assert "samples of an atlas" in err


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("q1,q2\n0,0\n", "q3"),
        ("q1,q2,q3\n", "0 postures"),
        ("q1,q2,q3\n0,x,0\n", "line 2"),
        ("q1,q2,q3\n0,0\n", "2 numbers"),
    ],
)
def test_bad_files_of_postures_are_named(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "path.csv"
    path.write_text(text)
    with pytest.raises(PathFileError, match=word):
        read_postures(path, planar().robot)
