"""Files of atlases: builds that go on, processes and workers that die, damaged files, many charts."""

import os
import signal
import subprocess
import sys
import time
import zlib
from base64 import b64decode, b64encode
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planar_atlas import ASKED, built, cells_of, planar
from public_objects import atlas as around_a_posture

import orthocas as oc
from orthocas.atlas.atlas_file import (
    ATLAS,
    Stock,
    add_results,
    chart_type,
    header_of,
    plan_terms,
    read_stock,
    record_type,
)
from orthocas.atlas.build import Job, opened, packed, run_job
from orthocas.atlas.lattice import Cell, Outcome, Result
from orthocas.atlas.plan import make_plan
from orthocas.atlas.regions import joint_range_of
from orthocas.errors import AtlasFileError
from orthocas.tools.archive import from_npy, to_npy
from orthocas.tools.block_file import append, create, owned, sealed
from orthocas.tools.checks import Array
from orthocas.tools.processes import Processes


@pytest.mark.slow
def test_file_holds_the_same_atlas(planar_atlas: oc.Atlas, covered: Array) -> None:
    again = oc.Atlas.load(planar_atlas.path)
    assert np.array_equal(again.xi(covered), planar_atlas.xi(covered))
    assert again.as_dict() == planar_atlas.as_dict()


@pytest.mark.slow
def test_build_in_parts_gives_the_same_cells(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    first = built(path, share=0.3)
    assert 0 < len(first) < len(planar_atlas)
    again = built(path)
    assert cells_of(again.stock) == cells_of(planar_atlas.stock)


@pytest.mark.slow
def test_build_goes_on_after_a_process_died_while_it_wrote(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    content = planar_atlas.path.read_bytes()
    path = tmp_path / "arm.orthocas-atlas"
    for cut in (len(content) * 4 // 5, len(content) - 5):
        path.write_bytes(content[:cut])
        with pytest.raises(AtlasFileError, match="truncated"):
            oc.Atlas.load(path)
        assert cells_of(built(path).stock) == cells_of(planar_atlas.stock)


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> Stock:
    """A file of several blocks of cells, and one of turns after each build."""
    path = tmp_path_factory.mktemp("grown") / "arm.orthocas-atlas"
    for share in (0.1, 0.2, 0.3):
        built(path, share=share)
    return read_stock(path)


def of_version_1(content: bytes, stock: Stock) -> bytes:
    """The file as the first version wrote it: without checksums of the headers of blocks."""
    ends = [block.body - len(block.head) for block in stock.contents.blocks]
    parts = [content[: len(ATLAS.magic)], b"\1", content[len(ATLAS.magic) + 1 : ends[0] - 4]]
    for end, after in zip(ends, [end - 4 for end in ends[1:]] + [len(content)], strict=True):
        parts.append(content[end:after])
    return b"".join(parts)


def turned(content: bytes, byte: int, bit: int) -> bytes:
    return content[:byte] + bytes([content[byte] ^ 1 << bit]) + content[byte + 1 :]


@pytest.mark.slow
def test_every_bit_of_every_header_is_guarded(grown: Stock, tmp_path: Path) -> None:
    content, blocks = grown.path.read_bytes(), grown.contents.blocks
    headers = [range(block.body - len(block.head) - 28, block.body - len(block.head)) for block in blocks]
    assert len(headers) == 6
    places = [(byte, bit) for part in (range(56), *headers) for byte in part for bit in range(8)]
    places += [(byte, byte % 8) for byte in range(56, headers[0][0], 31)]  # under a SHA-256
    path = tmp_path / "arm.orthocas-atlas"
    for byte, bit in places:
        path.write_bytes(turned(content, byte, bit))
        with pytest.raises(AtlasFileError), opened(path, grown.plan, grown.region, False):
            pass
        assert [file.name for file in tmp_path.iterdir()] == [path.name]
        assert path.read_bytes() == turned(content, byte, bit)


@pytest.mark.slow
def test_nothing_is_lost_of_a_file_of_version_1_with_a_turned_bit(grown: Stock, tmp_path: Path) -> None:
    content = of_version_1(grown.path.read_bytes(), grown)
    path, rest = tmp_path / "arm.orthocas-atlas", tmp_path / "arm.orthocas-atlas.rest"
    path.write_bytes(content)
    blocks = read_stock(path).contents.blocks
    for block in (blocks[0], blocks[-1]):
        for byte in range(block.body - len(block.head) - 24, block.body - len(block.head)):
            for bit in range(8):
                bent = turned(content, byte, bit)
                path.write_bytes(bent)
                with suppress(AtlasFileError), opened(path, grown.plan, grown.region, False) as stock:
                    assert stock.contents.blocks == blocks[:-1]  # damaged lengths of the last block look cut off
                assert path.read_bytes() + (rest.read_bytes() if rest.exists() else b"") == bent
                assert block is blocks[-1] or not rest.exists()
                rest.unlink(missing_ok=True)


@pytest.mark.slow
def test_file_of_version_1_goes_on_as_such(planar_atlas: oc.Atlas, grown: Stock, tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    path.write_bytes(of_version_1(grown.path.read_bytes(), grown))
    assert cells_of(built(path).stock) == cells_of(planar_atlas.stock)
    assert path.read_bytes()[len(ATLAS.magic)] == 1


def test_what_a_dying_process_left_is_set_aside(grown: Stock, tmp_path: Path) -> None:
    content, last = grown.path.read_bytes(), grown.contents.blocks[-1]
    begin = last.body - len(last.head) - 28
    path = tmp_path / "arm.orthocas-atlas"
    for number in ("", "2", "3"):  # what an earlier one left stays
        path.write_bytes(content[:-3])
        with opened(path, grown.plan, grown.region, False) as stock:
            assert stock.contents.blocks == grown.contents.blocks[:-1]
        assert path.read_bytes() == content[:begin]
        assert (tmp_path / f"{path.name}.rest{number}").read_bytes() == content[begin:-3]


def test_whole_blocks_after_one_that_was_cut_are_not_removed(grown: Stock, tmp_path: Path) -> None:
    """As two computers may leave that write one file on a network disk without locks."""
    content, block = grown.path.read_bytes(), grown.contents.blocks[2]
    begin, end = block.body - len(block.head) - 28, block.body + block.length
    path = tmp_path / "arm.orthocas-atlas"
    bent = content[: begin + 40] + content[end:]
    assert block.length + len(block.head) > len(content) - end  # so the file seems to end within this block
    path.write_bytes(bent)
    with pytest.raises(AtlasFileError, match=f"block at byte {begin}"), opened(path, grown.plan, grown.region, False):
        pass
    assert path.read_bytes() == bent


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("scale", value) for value in (0.0, -1.0, 1e-320, 1e308, np.inf, np.nan)],
        *[("lattice_low", value) for value in (1e300, -40.0, np.nan)],
        *[("lattice_width", value) for value in (1e-320, 0.0, -1.0, 1e300)],
        ("lattice_counts", 10**6),
        ("map_signs", 0.5),
        ("map_shifts", 1.0),
    ],
)
def test_values_of_the_header_are_checked(grown: Stock, tmp_path: Path, name: str, value: float) -> None:
    path, header = tmp_path / "forged.orthocas-atlas", grown.contents.header
    array = from_npy(b64decode(header["arrays"][name]))
    array.flat[0] = value
    arrays = {**header["arrays"], name: b64encode(to_npy(array)).decode()}
    path.write_bytes(sealed({**header, "arrays": arrays}, ATLAS))
    with pytest.raises(AtlasFileError, match=rf"forged.*{name if name[:4] != 'map_' else 'maps'}"):
        oc.Atlas.load(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e308])
def test_numbers_of_charts_are_checked(grown: Stock, tmp_path: Path, value: float) -> None:
    content, kind = bytearray(grown.path.read_bytes()), chart_type(grown.plan)
    place = int(grown.places[0])
    record = np.frombuffer(content, kind, 1, place).copy()
    record["numbers"][0, 0, 1] = value
    record["crc"] = zlib.crc32(record.tobytes()[4:])
    content[place : place + kind.itemsize] = record.tobytes()
    path = tmp_path / "forged.orthocas-atlas"
    path.write_bytes(content)
    with pytest.raises(AtlasFileError, match=r"forged.*numbers of chart 0"):
        read_stock(path).numbers(np.array([0]))


@pytest.mark.parametrize("forged", ["a tile that is not fitted", "a tile twice"])
def test_cells_without_use_are_refused(tmp_path: Path, forged: str) -> None:
    """Their charts would be in the file, but no position would ever be in them."""
    stock = around_a_posture().stock
    block, kind = stock.contents.blocks[0], record_type(stock.plan)
    records = np.frombuffer(block.head, kind).copy()
    other = np.setdiff1d(np.arange(stock.plan.lattice.size), stock.orbits.fitted)[0]
    records["tile"][0] = records["tile"][1] if forged == "a tile twice" else other
    path = tmp_path / "forged.orthocas-atlas"
    create(path, stock.contents.header, ATLAS)
    body = stock.path.read_bytes()[block.body : block.body + block.length]
    append(path, block.tag, records.tobytes(), body, ATLAS)
    with pytest.raises(AtlasFileError, match=r"forged.*twice, or of tiles outside"):
        oc.Atlas.load(path)


def test_file_of_other_settings_is_not_gone_on_with(planar_atlas: oc.Atlas) -> None:
    with pytest.raises(AtlasFileError, match="another problem, region or settings"):
        oc.build_atlas(planar(), planar_atlas.path, oc.AtlasSettings())


@pytest.mark.slow
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


@pytest.mark.slow
def test_opening_a_large_atlas_reads_no_charts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """20,000 charts of an arm."""
    plan = make_plan(planar(), oc.AtlasSettings(half_width=0.02, symmetric=False), 5.0)
    region = joint_range_of(plan.problem.domain, plan.joints)
    path = tmp_path / "large.orthocas-atlas"
    create(path, header_of(plan, region), ATLAS)
    numbers = np.zeros((plan.fitted, 1 + plan_terms(plan)))
    cells = [Cell.whole(tile, len(plan.joints)) for tile in region.tiles(plan.lattice)[:20_000].tolist()]
    results = [Result(cell, Outcome.CHART, numbers=numbers, leak_deg=0.0, conditioning=1.0) for cell in cells]
    add_results(path, plan, [(-1, False, result) for result in results], 0)
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
    monkeypatch.setattr("orthocas.atlas.build.Processes", Deadly)
    found = oc.build_atlas(planar(), tmp_path / "arm.orthocas-atlas", ASKED, jobs=1)
    assert Deadly.kills == 3
    assert cells_of(found.stock) == cells_of(planar_atlas.stock)


class DeadlyOver(Processes):
    """Processes that are killed while they work at one tile."""

    tile = -1

    def submit(self, *arguments: Any, **named: Any) -> Future[Any]:
        future = super().submit(*arguments, **named)
        if any(cell.tile == self.tile for cell in arguments[1].cells):
            (process,) = self._pools[0]._processes.values()
            os.kill(process.pid, signal.SIGKILL)
        return future


@pytest.mark.slow
def test_boxes_over_which_workers_die_are_left_to_the_next_build(
    planar_atlas: oc.Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wanted, path = cells_of(planar_atlas.stock), tmp_path / "arm.orthocas-atlas"
    DeadlyOver.tile = int(planar_atlas.stock.records["tile"][3])
    with monkeypatch.context() as patch:
        patch.setattr("orthocas.atlas.build.Processes", DeadlyOver)
        found = oc.build_atlas(planar(), path, ASKED, jobs=1)
    assert cells_of(found.stock) == [cell for cell in wanted if cell[0] != [DeadlyOver.tile]]
    assert "left for the next build" in caplog.text
    assert cells_of(built(path).stock) == wanted


@pytest.mark.slow
def test_build_goes_on_after_its_process_was_killed(planar_atlas: oc.Atlas, tmp_path: Path) -> None:
    path = tmp_path / "arm.orthocas-atlas"
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import orthocas.atlas.build as build, planar_atlas as tests, pathlib\n"
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
