"""`orthocas follow`: the motion of `oc.follow` in a CSV file, refusals, and nothing written on bad input."""

import csv
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from programs import Run
from public_objects import clear

import orthocas as oc
from orthocas.errors import PathFileError
from orthocas.paths.tool_path import read_path

LIMITS = ("--velocity-limit", "1,1.5,2")


def waypoints(chart: oc.Chart) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 20)
    return chart.x(chart.problem.domain.centre) + 0.05 * np.column_stack([np.cos(angle) - 1, np.sin(angle)])


@pytest.fixture
def chart(run: Run) -> oc.Chart:
    """A chart file a.orthocas and a path file p.csv in an empty folder."""
    clear().save("a.orthocas")
    rows = ["x,y", *(f"{x!r},{y!r}" for x, y in waypoints(clear()).tolist())]
    Path("p.csv").write_text("\n".join(rows) + "\n")
    return clear()


@pytest.mark.slow
def test_motion_is_that_of_python(run: Run, chart: oc.Chart) -> None:
    code, out, err = run("follow", "a.orthocas", "p.csv", *LIMITS, "--out", "q.csv", "--json")
    assert (code, err) == (0, "")
    report, expected = (
        json.loads(out),
        oc.follow(chart, waypoints(chart), velocity_limits=[1, 1.5, 2]),
    )
    with Path("q.csv").open(newline="") as stream:
        table = np.array(list(csv.reader(stream))[1:], dtype=float)
    np.testing.assert_allclose(table[:, 1:4], expected.q, atol=1e-12)
    assert report["closed"]
    assert report["time_stamps"] == len(table)
    assert report["duration"] == pytest.approx(expected.duration)
    assert report["margins"]["boundary"] == pytest.approx(expected.margins.boundary)
    assert report["margins"]["distance"] is None
    assert run("follow", "a.orthocas", "p.csv", *LIMITS, "--out", "q.csv")[1].splitlines()[-1].startswith("file ")


@pytest.mark.slow
def test_schedules_objectives_and_obstacles(run: Run, chart: oc.Chart) -> None:
    xi = float(chart.xi(chart.problem.domain.centre)[0])
    rows = [f"{xi + 0.02 * np.sin(k)},{y!r},{x!r}" for k, (x, y) in enumerate(waypoints(chart).tolist())]
    Path("s.csv").write_text("xi1,y,x\n" + "\n".join(rows))
    report = json.loads(run("follow", "a.orthocas", "s.csv", *LIMITS, "--out", "q.csv", "--json")[1])
    assert report["xi"]["xi1"] == pytest.approx([xi - 0.02, xi + 0.02], abs=2e-3)
    obstacles = ("sphere:0,3,0,0.1", "capsule:0,3,0,1,3,0,0.1", "plane:0,1,0,0,-1,0")
    words = ("--xi", "objective", *(word for text in obstacles for word in ("--obstacle", text)))
    code, out, err = run(
        "follow", "a.orthocas", "p.csv", *LIMITS, *words, "--out", "q.csv", "--link-radius", "0.05", "--json"
    )
    assert (code, err) == (0, "")
    assert 0 < json.loads(out)["margins"]["distance"] < 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--xi", "best"], "unknown choice of --xi 'best', known: hold, schedule, objective"),
        (["--xi", "schedule"], "--xi is schedule, expected columns xi1 in p.csv with schedule"),
        (["--obstacle", "sphere:1,2"], "--obstacle sphere is '1,2', expected 4 numbers"),
        (["--obstacle", "cone:1,2"], "unknown kind of --obstacle 'cone', known: sphere, capsule, plane"),
        (["--sphere", "1,2,3,1"], "no such option: --sphere; use --obstacle sphere:X,Y,Z,RADIUS"),
        (["--obstacle", "plane:0,0,0,0,0,0"], "normal is [0.0, 0.0, 0.0], expected a vector longer"),
        (["--link-radius", "0.1"], "--link-radius requires --obstacle"),
        (["--start", "1,2"], "no such option: --start; the start of a motion is set in Python"),
        (["--period", "often"], "received 'often', expected a number"),
        (["--velocity-limit", "-1"], "velocity_limits of joint 'q1' is -1.0"),
        (["--out", "no/q.csv"], "folder no does not exist"),
        (["--out", "a.orthocas"], "orthocas did not write the file"),
        (["--obstacle", "sphere:1,1.5,0,0.1"], "--obstacle requires --collisions FILE.urdf, or --link-radius"),
        (["--obstacle", "sphere:1,1.5,0,3", "--link-radius", "0.1"], "cannot be followed at waypoint 0"),
    ],
)
def test_refusals(run: Run, chart: oc.Chart, words: list[str], message: str) -> None:
    code, out, err = run("follow", "a.orthocas", "p.csv", "--velocity-limit", "1", "--out", "q.csv", *words)
    assert (code, out) == (2, "")
    assert err.startswith("orthocas: ")
    assert message in err
    assert err.count("\n") == 1
    assert not Path("q.csv").exists()


BROKEN = {
    "": "it has 0 waypoints after the header, expected 2 to 100000",
    "x,y\n1,2\n": "it has 1 waypoints",
    "x,y\n1,2\n1,two\n": "line 3: y is 'two', expected a number from -1e+06 to 1e+06",
    "x,y\n1,2\nnan,2\n": "line 3: x is 'nan'",
    "x,y\n1,2\n1,1e7\n": "line 3: y is '1e7'",
    "x,y\n1,2\n1_0,2\n": "line 3: x is '1_0'",
    "x,y\n1,2\n1\n": "line 3: 1 numbers, expected 2 as in the header",
    "1,2\n1,2\n1,3\n": "line 1: unknown column '1', expected x, y, and if the path has a schedule xi1",
    "x\n1\n2\n": "line 1: column 'y' is missing, expected x, y",
    "x,x\n1,2\n1,2\n": "line 1: column 'x' comes twice",
    "x,xi1\n1,2\n1,2\n": "line 1: column 'y' is missing, expected x, y, xi1",
    'x,y\n1,2\n1,"2\n': "not CSV text",
}


@pytest.mark.parametrize("text", BROKEN)
def test_broken_path_files_name_the_line(text: str, tmp_path: Path) -> None:
    file = tmp_path / "p.csv"
    file.write_text(text)
    with pytest.raises(PathFileError) as caught:
        read_path(file, clear())
    assert str(caught.value).startswith(f"path file {file}: ")
    assert BROKEN[text] in str(caught.value)


def test_path_files_with_a_byte_order_mark_spaces_and_empty_lines(tmp_path: Path) -> None:
    file = tmp_path / "p.csv"
    file.write_bytes(b"\xef\xbb\xbfy, x\r\n1, 2\r\n\r\n 3,4\r\n")
    x, xi = read_path(file, clear())
    assert x.tolist() == [[2, 1], [4, 3]]
    assert xi is None
    with pytest.raises(PathFileError, match="cannot be read, No such file"):
        read_path(tmp_path / "none.csv", clear())


def test_ctrl_c_leaves_nothing_half_written(run: Run, chart: oc.Chart, monkeypatch: pytest.MonkeyPatch) -> None:
    def press(file: Path, text: str, **how: object) -> int:
        file.write_bytes(text[: len(text) // 2].encode())
        os.kill(os.getpid(), signal.SIGINT)
        return 0

    monkeypatch.setattr(Path, "write_text", press)
    code, _, err = run("follow", "a.orthocas", "p.csv", *LIMITS, "--out", "q.csv")
    assert (code, err) == (130, "orthocas: interrupted\n")
    assert sorted(file.name for file in Path().iterdir()) == ["a.orthocas", "p.csv"]
