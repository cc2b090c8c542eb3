"""Atlases: images, search, files that grow, builds that go on, and charts that are what their numbers say."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from programs import Run

import orthocas as oc
from orthocas import problems
from orthocas.atlases.align import align
from orthocas.atlases.atlas_file import ATLAS, Stock, add_results, header_of, plan_terms, read_stock
from orthocas.atlases.cells import Cell
from orthocas.atlases.chart_of_box import moved
from orthocas.atlases.cube_basis import CubeBasis
from orthocas.atlases.follow import follow_in_atlas
from orthocas.atlases.jobs import Job, packed, run_job
from orthocas.atlases.outcomes import Outcome, Result
from orthocas.atlases.plan import make_plan
from orthocas.atlases.processes import Processes
from orthocas.atlases.regions import joint_range_of, read_postures
from orthocas.checks import Array
from orthocas.errors import AtlasFileError, InvalidValueError, PathFileError, ShapeError
from orthocas.files.blocks import create, owned

ASKED = oc.AtlasSettings(degree=2, leak_deg=14.0, half_width=0.8, splits=5)


def planar() -> oc.Problem:
    known = problems.get("planar_3r_xy")
    return oc.Problem(known.robot, known.task, domain=known.domain)


def built(path: Path, **options: Any) -> oc.Atlas:
    with ThreadPoolExecutor(1) as executor:
        return oc.build_atlas(planar(), path, ASKED, executor=executor, **options)


@pytest.fixture(scope="module")
def atlas(tmp_path_factory: pytest.TempPathFactory) -> oc.Atlas:
    return built(tmp_path_factory.mktemp("atlas") / "arm.orthocas-atlas")


@pytest.fixture(scope="module")
def points(atlas: oc.Atlas) -> Array:
    """Positions of the region that have a chart."""
    q = np.random.default_rng(7).uniform(-np.pi, np.pi, (500, 3))
    return np.asarray(q[atlas.chart_at(q) >= 0])


def cells_of(stock: Stock) -> list[tuple[Any, ...]]:
    """What a file says of each cell, in an order that does not depend on how it came."""
    names = ("tile", "outcome", "joint", "levels", "places", "leak_deg", "conditioning")
    return sorted(tuple(np.nan_to_num(np.ravel(record[name])).tolist() for name in names) for record in stock.records)


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


def test_chart_of_a_position_is_one_whose_box_holds_it(atlas: oc.Atlas) -> None:
    """Against a search through all boxes."""
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (300, 3))
    numbers = atlas.chart_at(q)
    for point, number in zip(q[::5], numbers[::5], strict=True):
        holding = [k for k in range(len(atlas)) if atlas.box(k, near=point).contains(point)]
        assert (number in holding) if number >= 0 else not holding
    assert (numbers >= 0).mean() > 0.9
    assert atlas.chart_at(q[0]) == numbers[0]


def test_current_chart_stays_while_its_box_holds_the_position(atlas: oc.Atlas, points: Array) -> None:
    number = atlas.chart_at(points[0])
    box = atlas.box(number)
    inside = box.centre + 0.999 * box.half_width * np.array([0.0, 1.0, 0.3])
    beyond = box.centre + 1.001 * box.half_width * np.array([0.0, 1.0, 0.3])
    assert atlas.chart_at(inside, current=number) == number != atlas.chart_at(inside)
    assert atlas.chart_at(beyond, current=number) == atlas.chart_at(beyond) != number


def test_values_are_those_of_the_single_charts(atlas: oc.Atlas, points: Array) -> None:
    numbers = atlas.chart_at(points)
    xi, J = atlas.xi(points), atlas.jacobian(points)
    for k in range(0, len(points), 25):
        chart = atlas.chart(int(numbers[k]), near=points[k])
        assert chart.problem.domain.contains(points[k])
        assert np.abs(chart.xi(points[k]) - xi[k]).max() < 1e-12
        assert np.abs(chart.jacobian(points[k])[chart.m :] - J[k]).max() < 1e-11


def test_jacobian_is_the_derivative_of_xi_in_the_same_chart(atlas: oc.Atlas, points: Array) -> None:
    numbers, h = atlas.chart_at(points), 1e-6
    steps = [(atlas.xi(points + h * e, numbers) - atlas.xi(points - h * e, numbers)) / (2 * h) for e in np.eye(3)]
    assert np.abs(np.stack(steps, axis=-1) - atlas.jacobian(points, numbers)).max() < 1e-8


def test_inverse_in_charts_finds_what_phi_came_from(atlas: oc.Atlas, points: Array) -> None:
    numbers = atlas.chart_at(points)
    x, xi = atlas.problem.task.batched(points)[0], atlas.xi(points)
    starts = points + np.random.default_rng(8).uniform(-0.02, 0.02, points.shape)
    found = atlas.inverse(x, xi, numbers, starts)
    assert np.isfinite(found).all(axis=1).mean() > 0.95  # the others leave the box of their chart on the way
    assert np.nanmax(np.abs(found - points)) < 1e-8
    assert np.isnan(atlas.inverse(x[0] + 9.0, xi[0], numbers[0], points[0])).all()
    assert np.isnan(atlas.inverse(x[0], xi[0], -1, points[0])).all()
    with pytest.raises(ShapeError, match="xi has shape"):
        atlas.inverse(x[0], xi[:2], numbers[0], points[0])


def test_charts_are_as_good_as_asked_for(atlas: oc.Atlas) -> None:
    """With the judge of single charts, at other samples."""
    for number in range(0, len(atlas), 12):
        report = oc.evaluate(atlas.chart(number), 2000, seed=5)
        assert report.leak.rms < 1.05 * ASKED.leak_deg
        assert report.conditioning.min > 0.9 * ASKED.conditioning


def test_neighbours_are_aligned(atlas: oc.Atlas) -> None:
    found = align(atlas.index)
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


def test_coverage_counts_what_has_a_chart(atlas: oc.Atlas) -> None:
    coverage = oc.evaluate_atlas(atlas, 3000)
    assert coverage.share > 0.95
    assert coverage.share + sum(coverage.holes.values()) == pytest.approx(1.0)
    rows = np.flatnonzero(coverage.chart >= 0)[:200:20]
    for k in rows:
        quality = atlas.chart(int(coverage.chart[k]), near=coverage.q[k]).quality(coverage.q[k])
        assert np.sqrt((quality.leak_deg**2).mean()) == pytest.approx(coverage.leak_deg[k], abs=1e-6)
        assert quality.conditioning == pytest.approx(coverage.conditioning[k])
    _, share = coverage.by_joint(0)
    assert share.min() > 0.8


def test_file_holds_the_same_atlas(atlas: oc.Atlas, points: Array) -> None:
    again = oc.Atlas.load(atlas.path)
    assert np.array_equal(again.xi(points), atlas.xi(points))
    assert again.as_dict() == atlas.as_dict()


def test_build_in_parts_gives_the_same_cells(atlas: oc.Atlas, tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    first = built(path, share=0.3)
    assert 0 < len(first) < len(atlas)
    again = built(path)
    assert cells_of(again.stock) == cells_of(atlas.stock)


def test_build_goes_on_after_a_process_died_while_it_wrote(atlas: oc.Atlas, tmp_path: Path) -> None:
    content = atlas.path.read_bytes()
    path = tmp_path / "arm.orthocas-atlas"
    for cut in (len(content) * 4 // 5, len(content) - 5):
        path.write_bytes(content[:cut])
        with pytest.raises(AtlasFileError, match="truncated"):
            oc.Atlas.load(path)
        assert cells_of(built(path).stock) == cells_of(atlas.stock)


def test_file_of_other_settings_is_not_gone_on_with(atlas: oc.Atlas) -> None:
    with pytest.raises(AtlasFileError, match="another problem, region or settings"):
        oc.build_atlas(planar(), atlas.path, oc.AtlasSettings())


def test_two_processes_never_build_one_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    built(path, share=0.3)
    before = path.read_bytes()
    with owned(path, ATLAS):
        for force in (False, True):
            with pytest.raises(AtlasFileError, match="another process is adding to it"):
                built(path, force=force)
    assert path.read_bytes() == before
    assert len(built(path)) > 0


def test_damaged_and_foreign_files_raise_one_error(atlas: oc.Atlas, tmp_path: Path) -> None:
    content = atlas.path.read_bytes()
    path = tmp_path / "mutant.orthocas-atlas"
    rng = np.random.default_rng(4)
    q = np.random.default_rng(7).uniform(-np.pi, np.pi, (50, 3))
    for _ in range(60):
        bent = bytearray(content)
        bent[int(rng.integers(len(bent)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(bent)
        with suppress(AtlasFileError):  # other errors, and values that are no numbers, are wrong
            assert np.isfinite(oc.Atlas.load(path).xi(q)).any()
    for other in (b"", b"PK\x03\x04", content[:40], content[:1000], os.urandom(500)):
        path.write_bytes(other)
        with pytest.raises(AtlasFileError, match="mutant"):
            oc.Atlas.load(path)
    with pytest.raises(AtlasFileError, match="does not exist"):
        oc.Atlas.load(tmp_path / "nothing")


def test_foreign_file_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("mine")
    with pytest.raises(AtlasFileError, match="did not write"):
        built(path)
    assert path.read_text() == "mine"


def test_opening_a_large_atlas_reads_no_charts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """20,000 charts of an arm."""
    plan = make_plan(planar(), oc.AtlasSettings(half_width=0.02, symmetric=False), 5.0)
    region = joint_range_of(plan.problem.domain, plan.joints)
    path = tmp_path / "large.orthocas-atlas"
    create(path, header_of(plan, region), ATLAS)
    numbers = np.zeros((plan.fitted, 1 + plan_terms(plan)))
    cells = [Cell.whole(tile, len(plan.joints)) for tile in region.tiles(plan.lattice)[:20_000].tolist()]
    add_results(path, plan, [(-1, False, Result(cell, Outcome.CHART, numbers=numbers)) for cell in cells], 0)
    monkeypatch.setattr(Stock, "numbers", None)
    found = oc.Atlas(read_stock(path))
    assert len(found) == 20_000
    assert found.chart_at(found.box(3).centre) == 3


class Deadly(Processes):
    """Processes of which some are killed while they work."""

    kills = 0

    def submit(self, *arguments: Any, **named: Any) -> Future[Any]:
        future = super().submit(*arguments, **named)
        if self.kills < 3:
            type(self).kills += 1
            (process,) = self._pools[0]._processes.values()
            os.kill(process.pid, signal.SIGKILL)
        return future


@pytest.mark.slow
def test_work_of_killed_processes_runs_again(atlas: oc.Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orthocas.atlases.build.Processes", Deadly)
    found = oc.build_atlas(planar(), tmp_path / "arm.orthocas-atlas", ASKED, jobs=1)
    assert Deadly.kills == 3
    assert cells_of(found.stock) == cells_of(atlas.stock)


@pytest.mark.slow
def test_build_goes_on_after_its_process_was_killed(atlas: oc.Atlas, tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import orthocas.atlases.build as build, test_atlases as tests, pathlib\n"
        f"build._FLUSH = 0.0; tests.built(pathlib.Path({str(path)!r}))"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    while process.poll() is None and not (path.exists() and path.stat().st_size > 9000):
        time.sleep(0.001)
    process.kill()
    process.wait()
    before = len(read_stock(path).records)
    assert 0 < before < len(atlas.stock.records)
    assert cells_of(built(path).stock) == cells_of(atlas.stock)


@pytest.mark.slow
def test_workers_of_dask_need_no_shared_disk(atlas: oc.Atlas, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None) as client,
        client.get_executor() as executor,
    ):
        found = oc.build_atlas(planar(), tmp_path / "arm.orthocas-atlas", ASKED, executor=executor)
    assert cells_of(found.stock) == cells_of(atlas.stock)


def test_posture_is_asked_for_without_a_jump_where_charts_change(atlas: oc.Atlas) -> None:
    start = np.array([0.3, 0.5, 1.4])
    number = atlas.chart_at(start)
    x = atlas.problem.task.batched(start[None])[0][0]
    turn = np.linspace(0, 2 * np.pi, 100)
    path = x + 0.4 * (np.outer(np.cos(turn) - 1, x) + np.outer(np.sin(turn), [-x[1], x[0]])) / np.linalg.norm(x)
    motion = follow_in_atlas(atlas, path, start)
    assert motion.hand_overs >= 2
    assert motion.charts[0] == number
    tool = atlas.problem.task.batched(motion.q)[0]
    assert np.abs(tool - path).max() < 1e-9
    changes = np.flatnonzero(np.diff(motion.charts))
    for k in changes:  # the posture found last is the one asked for in the next chart
        assert np.abs(atlas.xi(motion.q[k], motion.charts[k + 1]) - motion.xi[k + 1]).max() < 1e-12
    assert np.abs(np.diff(motion.q, axis=0)).max() < 0.2


def test_hand_over_maps_velocity_and_acceleration(atlas: oc.Atlas, points: Array) -> None:
    q, number, h = points[0], int(atlas.chart_at(points[0])), 1e-4
    dq, ddq = np.array([0.3, -0.2, 0.5]), np.array([1.0, 0.4, -2.0])
    phi, dphi, ddphi = atlas.handed_over(q, dq, ddq, number)
    chart = atlas.chart(number, near=q)
    before, after = (chart.phi(q + s * h * dq + 0.5 * h**2 * ddq) for s in (-1, 1))
    assert np.abs((after - before) / (2 * h) - dphi).max() < 1e-6
    assert np.abs((after - 2 * phi + before) / h**2 - ddphi).max() < 1e-5


def test_surroundings_of_postures_are_covered_and_little_else(tmp_path: Path) -> None:
    postures = np.linspace([0.0, 0.6, 0.8], [0.0, 1.8, 0.8], 20)
    found = built(tmp_path / "path.orthocas-atlas", region=postures, radius=0.1)
    assert (found.chart_at(postures) >= 0).all()
    assert found.chart_at([0.0, -2.0, -2.0]) == -1
    assert oc.evaluate_atlas(found, 2000).share == 1.0


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


def test_jobs_are_independent_of_each_other(atlas: oc.Atlas) -> None:
    plan = packed(atlas.plan)
    records = atlas.stock.records[:6]
    cells = [
        Cell(int(r["tile"]), tuple(r["levels"].tolist()), tuple(r["places"].tolist())) for r in reversed(list(records))
    ]
    for record, result in zip(reversed(list(records)), run_job(Job(plan, tuple(cells))), strict=True):
        assert result.outcome == record["outcome"]
        assert np.float32(result.leak_deg) == record["leak_deg"] or np.isnan(record["leak_deg"])
