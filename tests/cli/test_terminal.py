"""What commands print to a terminal: tables as wide as it is, whole words, what to do next; elsewhere plain lines."""

import io
from contextlib import redirect_stdout

import pytest
from programs import Run
from public_objects import fitted, wide

from orthocas.charts.quality import evaluate
from orthocas.cli.output import format_reach_rows, format_report_rows, print_rows, print_table

ROWS = {
    "task angle": "mean 90.02, std 0.75, largest sampled deviation 15.5 deg (the paper's cosines) " * 2,
    "chart": "a",
}


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")  # no colours, which the test would have to take out
    monkeypatch.setenv("NO_COLOR", "1")
    return Terminal()


def test_rows_fit_the_terminal_and_words_stay_whole(terminal: Terminal) -> None:
    with redirect_stdout(terminal):
        print_rows(ROWS, "orthocas view a")
    lines = terminal.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert terminal.getvalue().split() == [word for pair in ROWS.items() for word in " ".join(pair).split()] + [
        *("next", "orthocas", "view", "a")
    ]


def test_tables_have_a_head_and_what_comes_next(terminal: Terminal) -> None:
    with redirect_stdout(terminal):
        print_table([("branch", "share"), ("elbow+", "47.2%")], "orthocas fit panda")
    head, row, last = terminal.getvalue().splitlines()
    assert head.split() == ["branch", "share"]
    assert row.split() == ["elbow+", "47.2%"]
    assert last.split() == ["next", "orthocas", "fit", "panda"]


def test_files_and_pipes_get_one_line_for_each_row(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows(ROWS, "orthocas view a")
    assert len(capsys.readouterr().out.splitlines()) == len(ROWS)


@pytest.mark.slow
def test_wide_charts_are_judged_as_such_and_name_their_unit() -> None:
    chart = wide().chart
    assert "leaks of tens of degrees are normal" in format_report_rows(evaluate(chart, 200), chart)["wide"]
    tight = fitted().chart
    assert "wide" not in format_report_rows(evaluate(tight, 200), tight)
    assert "[rad])" in format_reach_rows(wide().chart)["xi reach"] or not wide().meaning


@pytest.mark.slow
def test_branches_are_a_table(run: Run) -> None:
    code, out, _ = run("info", "planar_3r_xy", "--branches")
    assert code == 0
    assert [line.split()[:2] for line in out.splitlines() if line.startswith("branch")] == [["branch", "share"]]
