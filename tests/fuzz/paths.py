"""Campaigns of path files, postures and joint logs: finite numbers, or an error that names file and line."""

from functools import partial
from pathlib import Path

import numpy as np
import public_objects
from paper.joint_log import read_joint_log

from fuzz.child import Finding, run
from fuzz.mutants import TEXTS, Rng, flipped, pick
from fuzz.sealed_files import judged
from orthocas.paths.tool_path import read_path
from orthocas.tasks.corridor import read_postures

_CELLS = (
    "0",
    "1.5",
    "-2e-3",
    " 0.25 ",
    "nan",
    "inf",
    "-1e999",
    "1e7",
    "0x10",
    "1_000",
    "",
    " ",
    "a",
    '"1"',
    '"1',
    "1;2",
)
_NAMES = ("x", "xi1", "xi2", "xi3", "y", "X", "", " x ", '"x"', "x\ty")
_PATHS = (["x"], ["x", "xi1", "xi2"], ["xi2", "x", "xi1"])
_LOG_NAMES = ("time_s", "q1", "q2", "q3", "q4", "d_q1", "dd_q3", "desired_x", "desired_xi2", "desired_", "", "time")
_POSTURES = (["q1", "q2", "q3"], ["q3", "time_s", "q1", "q2"], ["q1", "q2", "q3", "d_q1"])
_LOGS = (["time_s", "q1", "q2", "q3"], ["time_s", "q3", "q1", "desired_x", "q2"], ["q1", "q2", "q3", "time_s", "d_q1"])


def paths(count: int) -> list[Finding]:
    """Judge so many mutants."""
    return run("paths", judge, range(count))


def logs(count: int) -> list[Finding]:
    """Judge so many mutants of joint logs."""
    return run("logs", judge_log, range(count))


def postures(count: int) -> list[Finding]:
    """Judge so many mutants of files of postures."""
    return run("postures", judge_postures, range(count))


def judge(seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return judged(partial(_mutant, headers=_PATHS, cells=_NAMES), use, seed)


def judge_log(seed: int) -> str | None:
    """What is wrong with the treatment of a mutant of a log."""
    return judged(partial(_mutant, headers=_LOGS, cells=_LOG_NAMES), use_log, seed)


def judge_postures(seed: int) -> str | None:
    """What is wrong with the treatment of a mutant of a file of postures."""
    return judged(partial(_mutant, headers=_POSTURES, cells=_LOG_NAMES), use_postures, seed)


def use(path: Path) -> None:
    """Read a path; its numbers have to be usable."""
    x, xi = read_path(path, public_objects.linear())
    assert x.shape[1] == 1
    assert xi is None or xi.shape == (len(x), 2)
    assert len(x) >= 2
    assert np.isfinite(x).all()
    assert xi is None or np.isfinite(xi).all()


def use_postures(path: Path) -> None:
    """Read postures, as the corridor of --corridor; its numbers have to be usable."""
    found = read_postures(path, public_objects.linear().problem.robot)
    assert found.shape[1] == 3
    assert len(found) >= 1
    assert np.isfinite(found).all()


def use_log(path: Path) -> None:
    """Read a log; its numbers have to be usable."""
    log = read_joint_log(path, public_objects.linear())
    assert len(log.times) == len(log.q) == len(log.desired) >= 2
    assert log.q.shape[1] == log.desired.shape[1] == 3
    assert np.isfinite(log.q).all()
    assert (np.diff(log.times) > 0).all()


def _mutant(rng: Rng, headers: tuple[list[str], ...], cells: tuple[str, ...]) -> bytes:
    header = pick(rng, headers)
    numbers = np.sort(rng.normal(size=(int(rng.integers(2, 8)), len(header))), axis=0)
    rows = [[f"{value:.6g}" for value in row] for row in numbers]
    table = [[*header], *rows]
    for _ in range(int(rng.integers(0, 3))):
        row = table[0] if rng.random() < 0.3 else table[int(rng.integers(len(table)))]
        _change(rng, row, cells if row is table[0] else (*_CELLS, *TEXTS))
    text = pick(rng, ("\n", "\r\n", "\r", "\n\n")).join(",".join(row) for row in table)
    content = text.encode(errors="surrogatepass")
    if rng.random() < 0.7:
        return content
    odd = (
        flipped(rng, content),
        content[: int(rng.integers(len(content)))],
        b"\xef\xbb\xbf" + content,
        text.encode("utf-16", errors="surrogatepass"),
        content.replace(b",", b";"),
        b"x\n" + b"1\n" * int(pick(rng, (1, 2, 99_999, 100_001, 10**6))),
        b"x\n1," + b"1" * int(pick(rng, (10**5, 10**6))) + b"\n2\n",
        b"x\n" + b"\n" * 10**6,
        bytes(10**5),
        b" " * 2**26,
        pick(rng, (b"", b"\0", b"x", b"x\n1", b"x\n1\n2", b'x\n"1\n2\n3')),
    )
    return bytes(odd[int(rng.integers(len(odd)))])


def _change(rng: Rng, row: list[str], cells: tuple[str, ...]) -> None:
    """Replace, add or remove a cell."""
    act, k = rng.integers(4), int(rng.integers(max(len(row), 1)))
    if act == 0 or not row:
        row.insert(k, pick(rng, cells))
    elif act == 1:
        del row[k]
    else:
        row[k] = pick(rng, cells)
