"""Every measured number of README and docs has a record in docs/records, and comes from it (tools/figures.py)."""

import json
from pathlib import Path

import figures
import pytest
import ready_charts

RECORDS = figures.records()
CARDS = figures.Record("cards", "measured", tables=[["", *ready_charts.table()]])  # cards are records of their own
PAGES = figures.pages()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_every_measured_number_of_a_page_has_a_record(page: str) -> None:
    assert figures.unrecorded(PAGES[page], [*RECORDS.values(), CARDS]) == []


@pytest.mark.parametrize("name", RECORDS)
def test_what_a_record_prints_is_on_a_page(name: str) -> None:
    """So a number that a script has measured anew must be on the pages, and no record outlives its sentence."""
    missing = [phrase for phrase in RECORDS[name].phrases if not any(figures.places(p, phrase) for p in PAGES.values())]
    assert missing == []


@pytest.mark.parametrize("name", RECORDS)
def test_tables_of_a_record_are_on_a_page(name: str) -> None:
    """No record is kept for nobody."""
    rows = {figures.key(line[0]) for page in PAGES.values() for line in figures.LINE.finditer(page)}
    unused = [t[0] for t in RECORDS[name].tables if not any(figures.key(row) in rows for row in t[1:])]
    assert unused == []


@pytest.mark.parametrize("name", RECORDS)
def test_phrases_say_what_their_numbers_are(name: str) -> None:
    """A bare number would explain every other one like it."""
    assert [phrase for phrase in RECORDS[name].printed if figures.says_nothing(phrase)] == []


@pytest.mark.parametrize("name", RECORDS)
def test_records_say_how_they_were_measured(name: str) -> None:
    record = RECORDS[name]
    if name == "constants":
        assert (record.source, record.command, record.values) == ("constants", "", {})
        return
    assert record.source in {"measured", "transcribed"}
    words = record.command.split()
    assert words[0] in {"python", "orthocas", "make"}
    place = words[2].replace(".", "/") if words[1] == "-m" else words[1]
    assert words[0] != "python" or (figures.ROOT / place).exists()
    assert not record.script or "\ndef main(" in (figures.ROOT / record.script).read_text()
    if record.results:
        assert record.source == "measured"
        assert list((figures.ROOT / record.results).iterdir())
        return
    called = record.script or "--json" in words  # how the tool measures it
    assert record.source == "transcribed" or (called and record.cpu_seconds and record.tolerance)
    assert set(record.values) == record.used


PAGE = """# 3.5 is a heading

The arm takes 2.5 s, and `9.9` is code; see [0.3](results.md#0.4). It has 7 joints, 50 % of them at 1e-3.

| what | number |
| --- | --- |
| 3R arm | 12 |
| two | 3, 4 |
"""


def test_measured_numbers_are_those_with_a_point_an_exponent_or_a_unit_and_cells_of_numbers() -> None:
    found = [PAGE[slice(*span)] for span in figures.figures(PAGE)]
    assert found == ["2.5", "0.3", "50", "1e-3", "12", "3", "4"]


def test_a_number_without_a_record_and_a_stale_one_are_found() -> None:
    known = figures.Record(
        "a",
        "measured",
        values={"t": 2.51},
        tables=[["", "| two | 3, 4 |"]],
        printed=["takes {t|.1f} s", "[0.3]", "1e-3"],
    )
    assert [line.split(":")[0] for line in figures.unrecorded(PAGE, [known])] == ["line 3", "line 7"]
    stale = figures.replace(known, values={"t": 2.61}, tables=[["", "| two | 3, 5 |"]])
    assert len(figures.unrecorded(PAGE, [stale])) == 5  # 2.5, 50, 12, 3 and 4


def test_longer_numbers_do_not_count_as_the_phrase() -> None:
    assert figures.places("12.5 s, 2.55 s, 1,2.5 s", "2.5 s") == []
    assert len(figures.places("it takes\n  2.5 s", "takes 2.5 s")) == 1
    assert len(figures.places("it [takes](../a.md#b) 2.5 s, or [lasts](a.md) 2.5 s", "[takes](a.md) 2.5 s")) == 1


def test_phrases_take_cells_of_tables_by_row_and_column() -> None:
    table = ["| arm | task | time [s] |", "| iiwa | pose | 3.0 (1 of 2) |", "| iiwa | axis | 4.0 |"]
    assert dict(figures.cells([table])) == {
        "iiwa / pose ; time [s]": 3.0,
        "iiwa / pose ; time [s] ; 2": 1.0,
        "iiwa / pose ; time [s] ; 3": 2.0,
        "iiwa / axis ; time [s]": 4.0,
    }
    assert dict(figures.cells([["| arm | time |", "| a 1 | 3 |"]])) == {"a 1 ; arm": 1.0, "a 1 ; time": 3.0}


SCRIPT = """
def main(scale=1.0):
    print("| case | time [s] | angle |\\n| --- | --- | --- |\\n| a 1 | 3.0 | {:.2f} |".format(2 * scale))
    return {"arm": {"angle [deg]": 2.0 * scale, "other": 7}}
"""


def test_a_run_gives_values_and_tables_shows_what_moved_and_renews_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("docs/records", "examples"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "examples" / "case_of_figures.py").write_text(SCRIPT)
    page = tmp_path / "README.md"
    page.write_text("It is 2.0\ndegrees off.\n\n| A 1 | 3.0 | 2.00 |\n")
    record = {
        "source": "measured",
        "command": "python examples/case_of_figures.py",
        "script": "examples/case_of_figures.py",
        "cpu_seconds": 1.0,
        "tolerance": {"": 0.01, "time": 1.0},
        "values": {"arm, angle [deg]": 2.0},
        "tables": [["| case | time [s] | angle |", "| a 1 | 3.0 | 2.00 |"]],
        "printed": ["is {arm, angle [deg]|.1f} degrees off"],
    }
    path = tmp_path / "docs" / "records" / "case.json"
    path.write_text(json.dumps(record))
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "RECORDS", path.parent)
    assert figures.unrecorded(page.read_text(), list(figures.records().values())) == []
    assert figures.main([], keep=False) == 0  # nothing moved

    changed = record | {"arguments": {"scale": 1.1}}
    path.write_text(json.dumps(changed))
    assert figures.main([], keep=False) == 1
    assert page.read_text().startswith("It is 2.0\ndegrees")
    figures.main(["case"], keep=True)
    assert page.read_text() == "It is 2.2\ndegrees off.\n\n| A 1 | 3.0 | 2.20 |\n"
    assert json.loads(path.read_text())["values"] == {"arm, angle [deg]": 2.2}
    assert figures.main([], keep=False) == 0


def test_records_whose_packages_are_missing_are_left_out_but_no_missing_script(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "examples").mkdir()
    script = tmp_path / "examples" / "needs_of_figures.py"
    script.write_text('"""Far\nfrom home."""\nimport json\ndef main(): import_module("package_that_nobody_has.part")\n')
    record = figures.Record("needs", "measured", script="examples/needs_of_figures.py", cpu_seconds=1.0)
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "records", lambda: {"needs": record})
    assert figures.main([], keep=False) == 0
    assert "needs is left out: it needs the package package_that_nobody_has" in capsys.readouterr().out
    script.unlink()
    assert figures.main([], keep=False) == 1


def test_what_fails_is_named_and_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples" / "fails_of_figures.py").write_text("def main():\n    raise AssertionError('no such arm')\n")
    (tmp_path / "examples" / "works_of_figures.py").write_text("def main():\n    return {'a': 1.0}\n")
    found = {
        name: figures.Record(name, "measured", script=f"examples/{name}_of_figures.py", cpu_seconds=1.0)
        for name in ("fails", "works")
    }
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "records", lambda: found)
    assert figures.main([], keep=False) == 1
    captured = capsys.readouterr()
    assert captured.out.splitlines()[-1] == "1 failed: fails"
    assert "works: " in captured.out
    assert "no such arm" in captured.err


def test_rows_belong_together_by_their_labels_whatever_their_order() -> None:
    old = [("", "| a | 4 | 1 | 2 |"), ("", "| a | 5 | 3 | 4 |"), ("", "| b, c | x | 5 |"), ("", "| gone | 7 |")]
    new = [("", "| b, c | x | 6 |"), ("", "| new | 9 |"), ("", "| a | 4 | 1 | 3 |"), ("", "| a | 5 | 3 | 5 |")]
    assert figures.paired(old, new) == [
        ("| a | 4 | 1 | 2 |", "| a | 4 | 1 | 3 |"),
        ("| a | 5 | 3 | 4 |", "| a | 5 | 3 | 5 |"),
        ("| b, c | x | 5 |", "| b, c | x | 6 |"),
    ]


def test_rows_whose_labels_hold_numbers_that_moved_belong_together() -> None:
    old = [("", "| iiwa, 7 joints | side a, 12% | 5.7 |"), ("", "| panda, 7 joints | side b, 46% | 6.5 |")]
    new = [("", "| panda, 7 joints | side b, 47% | 6.4 |"), ("", "| iiwa, 7 joints | side a, 12% | 5.8 |")]
    assert figures.paired(old, new) == [(old[0][1], new[1][1]), (old[1][1], new[0][1])]
