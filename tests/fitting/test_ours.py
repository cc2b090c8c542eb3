"""Files that orthocas did not write stay; drafts of killed processes go."""

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import orthocas as oc
from orthocas.errors import ArchiveError, ChartFileError
from orthocas.tools import files
from orthocas.tools.files import LIST, is_listed, open_draft_folder, open_output_folder, publish


def publish_number(folder: Path, text: str, force: bool = False) -> None:
    with publish(folder, listed=True, force=force) as place:
        (place / "numbers.csv").write_text(text)


def test_only_listed_files_are_replaced(tmp_path: Path) -> None:
    file = tmp_path / "numbers.csv"
    file.write_text("mine")
    with pytest.raises(ArchiveError, match=r"orthocas did not write the file that is there"):
        publish_number(tmp_path, "first")
    assert (file.read_text(), [*tmp_path.iterdir()]) == ("mine", [file])
    publish_number(tmp_path, "first", force=True)
    publish_number(tmp_path, "second")
    assert file.read_text() == "second"
    file.write_text("second, edited")
    with pytest.raises(ArchiveError):
        publish_number(tmp_path, "third")
    assert file.read_text() == "second, edited"


def test_empty_files_are_nobodys(tmp_path: Path) -> None:
    (tmp_path / "numbers.csv").touch()
    publish_number(tmp_path, "first")
    assert is_listed(tmp_path / "numbers.csv")


def test_links_are_neither_followed_nor_replaced(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("mine")
    (tmp_path / "numbers.csv").symlink_to(tmp_path / "elsewhere")
    for force in (False, True):
        with pytest.raises(ArchiveError, match="it is a symbolic link"):
            publish_number(tmp_path, "first", force)
    assert (tmp_path / "elsewhere").read_text() == "mine"


def test_a_kill_between_list_and_file_leaves_both_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish_number(tmp_path, "first")
    replace = os.replace

    def killed(source: Path, target: Path) -> None:
        if Path(target).name != LIST:
            raise OSError(errno.EIO, "as if killed")
        replace(source, target)

    for text in ("second", "third"):
        monkeypatch.setattr(os, "replace", killed)
        with pytest.raises(OSError, match="as if killed"):
            publish_number(tmp_path, text)
        monkeypatch.undo()
        assert is_listed(tmp_path / "numbers.csv")
    publish_number(tmp_path, "third")
    assert (tmp_path / "numbers.csv").read_text() == "third"


@pytest.mark.parametrize("text", ["", "[]", '{"files": [1]}', '{"files": {"numbers.csv": 3}}', "[" * 100_000])
def test_a_broken_list_knows_nothing(tmp_path: Path, text: str) -> None:
    publish_number(tmp_path, "first")
    (tmp_path / LIST).write_text(text)
    with pytest.raises(ArchiveError):
        publish_number(tmp_path, "second")


def test_drafts_of_dead_processes_are_swept_and_no_others(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    alive = tmp_path / f".orthocas-{files._HOST}-{os.getpid()}-abcd"
    elsewhere = tmp_path / f".orthocas-another-{dead.pid}-abcd"
    left = tmp_path / f".orthocas-{files._HOST}-{dead.pid}-abcd"
    mine = tmp_path / f".orthocas-{files._HOST}-{dead.pid}-file"
    for folder in (alive, elsewhere, left):
        folder.mkdir()
        (folder / "part").write_text("half")
    mine.write_text("a file is no draft folder")
    with open_draft_folder(tmp_path):
        assert not left.exists()
    assert {*tmp_path.iterdir()} == {alive, elsewhere, mine}


def test_folders_that_stay_empty_go_away(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    with open_output_folder("out", tmp_path / "old" / "new" / "deep") as folder:
        assert folder.is_dir()
    assert [*tmp_path.rglob("*")] == [tmp_path / "old"]


def test_a_full_disk_leaves_the_old_chart_and_no_drafts(planar_x: oc.Problem, tmp_path: Path) -> None:
    """Files of this process may not grow beyond 1 KiB for a while: writing fails as on a full disk."""
    chart = oc.fit(planar_x, oc.Linear()).chart
    path = tmp_path / "c.orthocas"
    chart.save(path)
    before, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, limits[1]))
    try:
        with pytest.raises(ChartFileError, match=r"cannot write .*: File too large"):
            chart.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert (path.read_bytes(), [*tmp_path.iterdir()]) == (before, [path])


def test_charts_replace_charts_only(planar_x: oc.Problem, tmp_path: Path) -> None:
    chart = oc.fit(planar_x, oc.Linear()).chart
    thesis = tmp_path / "thesis.pdf"
    thesis.write_bytes(b"%PDF-1.7")
    with pytest.raises(ChartFileError, match="orthocas did not write"):
        chart.save(thesis)
    assert thesis.read_bytes() == b"%PDF-1.7"
    chart.save(thesis, force=True)
    chart.save(thesis)
    assert oc.load(thesis).n == 3


@pytest.mark.slow
def test_a_readme_that_mentions_orthocas_stays(planar_chart: oc.Chart, tmp_path: Path) -> None:
    text = "# My robot\n\nIts C code was Generated by orthocas 0.9.\n"
    (tmp_path / "README.md").write_text(text)
    with pytest.raises(oc.errors.InvalidValueError, match=r"README\.md that orthocas did not write"):
        oc.generate_c(planar_chart, tmp_path, None, "arm")
    assert (tmp_path / "README.md").read_text() == text
    oc.generate_c(planar_chart, tmp_path, None, "arm", force=True)
    oc.generate_c(planar_chart, tmp_path, None, "arm")


def test_the_list_is_plain(tmp_path: Path) -> None:
    publish_number(tmp_path, "first")
    found = json.loads((tmp_path / LIST).read_text())
    assert found["format"] == "orthocas-list"
    assert [len(entry) for entry in found["files"]["numbers.csv"]] == [64]


@pytest.mark.parametrize(("begun", "named"), [(["a.png"], "a.png"), ([], "")])
def test_a_full_disk_names_the_file(tmp_path: Path, begun: list[str], named: str) -> None:
    """Libraries that draw and save raise errors without a file name."""

    def write() -> None:
        with publish(tmp_path / "out", listed=True) as place:
            for name in begun:
                (place / name).write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "out").mkdir()
    with pytest.raises(ArchiveError, match=rf"cannot write {tmp_path / 'out' / named}: No space left on device"):
        write()
    assert not list((tmp_path / "out").iterdir())


def test_ctrl_c_while_drafts_are_made_or_removed_leaves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes right after the folder is made, and in the middle of its removal."""
    make, remove = tempfile.mkdtemp, shutil.rmtree

    def interrupted_make(**settings: object) -> str:
        folder = make(**settings)  # type: ignore[call-overload]
        os.kill(os.getpid(), signal.SIGINT)
        return str(folder)

    def interrupted_remove(folder: str, ignore_errors: bool) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        remove(folder, ignore_errors=ignore_errors)

    for name, place, replacement in (
        ("mkdtemp", files.tempfile, interrupted_make),
        ("rmtree", files.shutil, interrupted_remove),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, replacement)
            with pytest.raises(KeyboardInterrupt), open_draft_folder(tmp_path) as folder:
                (folder / "half").write_text("a")
        assert not list(tmp_path.iterdir())
