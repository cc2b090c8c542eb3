"""Files of atlases: builds that go on, processes and workers that die, damaged files, many charts."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planar_atlas import ASKED, built, cells_of, planar

import orthocas as oc
from orthocas.atlases.atlas_file import ATLAS, Stock, add_results, header_of, plan_terms, read_stock
from orthocas.atlases.cells import Cell
from orthocas.atlases.jobs import Job, packed, run_job
from orthocas.atlases.outcomes import Outcome, Result
from orthocas.atlases.plan import make_plan
from orthocas.atlases.processes import Processes
from orthocas.atlases.regions import joint_range_of
from orthocas.checks import Array
from orthocas.errors import AtlasFileError
from orthocas.files.blocks import create, owned


def test_file_holds_the_same_atlas(planar_atlas: oc.Atlas, covered: Array) -> None:
    again = oc.Atlas.load(planar_atlas.path)
    assert np.array_equal(again.xi(covered), planar_atlas.xi(covered))
    assert again.as_dict() == planar_atlas.as_dict()


def test_build_in_parts_gives_the_same_cells(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    first = built(path, share=0.3)
    assert 0 < len(first) < len(planar_atlas)
    again = built(path)
    assert cells_of(again.stock) == cells_of(planar_atlas.stock)


def test_build_goes_on_after_a_process_died_while_it_wrote(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    content = planar_atlas.path.read_bytes()
    path = tmp_path / "arm.orthocas-atlas"
    for cut in (len(content) * 4 // 5, len(content) - 5):
        path.write_bytes(content[:cut])
        with pytest.raises(AtlasFileError, match="truncated"):
            oc.Atlas.load(path)
        assert cells_of(built(path).stock) == cells_of(planar_atlas.stock)


def test_file_of_other_settings_is_not_gone_on_with(planar_atlas: oc.Atlas) -> None:
    with pytest.raises(AtlasFileError, match="another problem, region or settings"):
        oc.build_atlas(planar(), planar_atlas.path, oc.AtlasSettings())


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


def test_damaged_and_foreign_files_raise_one_error(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    content = planar_atlas.path.read_bytes()
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
def test_work_of_killed_processes_runs_again(
    planar_atlas: oc.Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orthocas.atlases.build.Processes", Deadly)
    found = oc.build_atlas(planar(), tmp_path / "arm.orthocas-atlas", ASKED, jobs=1)
    assert Deadly.kills == 3
    assert cells_of(found.stock) == cells_of(planar_atlas.stock)


@pytest.mark.slow
def test_build_goes_on_after_its_process_was_killed(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import orthocas.atlases.build as build, planar_atlas as tests, pathlib\n"
        f"build._FLUSH = 0.0; tests.built(pathlib.Path({str(path)!r}))"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    while process.poll() is None and not (path.exists() and path.stat().st_size > 9000):
        time.sleep(0.001)
    process.kill()
    process.wait()
    before = len(read_stock(path).records)
    assert 0 < before < len(planar_atlas.stock.records)
    assert cells_of(built(path).stock) == cells_of(planar_atlas.stock)


@pytest.mark.slow
def test_workers_of_dask_need_no_shared_disk(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None) as client,
        client.get_executor() as executor,
    ):
        found = oc.build_atlas(planar(), tmp_path / "arm.orthocas-atlas", ASKED, executor=executor)
    assert cells_of(found.stock) == cells_of(planar_atlas.stock)


def test_jobs_are_independent_of_each_other(planar_atlas: oc.Atlas) -> None:
    plan = packed(planar_atlas.plan)
    records = planar_atlas.stock.records[:6]
    cells = [
        Cell(int(r["tile"]), tuple(r["levels"].tolist()), tuple(r["places"].tolist())) for r in reversed(list(records))
    ]
    for record, result in zip(reversed(list(records)), run_job(Job(plan, tuple(cells))), strict=True):
        assert result.outcome == record["outcome"]
        assert np.float32(result.leak_deg) == record["leak_deg"] or np.isnan(record["leak_deg"])
