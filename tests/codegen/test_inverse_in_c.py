"""The inverse map in compiled C."""

import os
import pickle
import stat
from pathlib import Path

import numpy as np
import pytest
from charts import beyond_domain
from dense_search import STARTS, positions_at
from programs import needs_c
from public_objects import circle, clear, exact, wide

import orthocas as oc
from orthocas.errors import CompileError, NoExpressionError
from orthocas.fitting.fit import Fit
from orthocas.native import libraries
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.expressions import wrap_shortest

FOUND = oc.InverseStatus.FOUND


@pytest.mark.slow
@needs_c
def test_compiled_c_gives_the_same_solutions(iiwa_fit: Fit, tmp_path: Path) -> None:
    """Of all kinds: found, outside, out of reach and without numbers, with starts and without."""
    chart = iiwa_fit.chart
    compiled = oc.compile_inverse(chart, tmp_path / "cache")
    q = beyond_domain(chart, 600, 1.15)
    phi = chart.phi(q)
    phi[5, 0], phi[9, 2] = 9.0, np.nan
    for start, most in ((None, 0), (q + 0.05, 0), (chart.problem.domain.centre, 6)):  # the last one is far away
        mine, theirs = chart.solve(phi, start), compiled.solve(phi, start)
        assert {0, 2, 6, 7} <= set(mine.statuses)
        same = theirs.status == mine.status
        assert np.count_nonzero(~same) <= most
        if start is None:  # rows outside begin far away, and may end at another solution out there
            same &= mine.found
        np.testing.assert_allclose(theirs.q[same], mine.q[same], atol=1e-9)
        assert theirs.error[theirs.found].max() <= 1e-9


@pytest.mark.slow
@needs_c
def test_targets_may_have_any_order_in_memory(planar_arm: oc.Chart, tmp_path: Path) -> None:
    compiled = oc.compile_inverse(planar_arm, tmp_path / "cache")
    phi = planar_arm.phi(sample_uniform(planar_arm.problem.domain, 20, 0))
    x, xi = phi[:, : planar_arm.m], phi[:, planar_arm.m :]
    rows = compiled.solve(phi)
    for found in (compiled.solve(np.asfortranarray(phi)), compiled.solve(x=np.asfortranarray(x), xi=xi)):
        np.testing.assert_array_equal(found.q, rows.q)
    # one x, many xi
    assert compiled.solve(x=x[0], xi=xi).found[0]


@pytest.mark.slow
@needs_c
def test_a_library_is_compiled_once(planar_arm: oc.Chart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = oc.compile_inverse(planar_arm)
    (library,) = (tmp_path / "orthocas" / "libraries").glob("inverse-*.so")
    assert stat.S_IMODE(library.parent.stat().st_mode) == 0o700
    written = library.stat().st_mtime_ns
    again = oc.compile_inverse(planar_arm)
    assert (again.library, library.stat().st_mtime_ns) == (first.library, written)
    assert oc.compile_inverse(clear()).library != library
    copy = pickle.loads(pickle.dumps(first))
    phi = planar_arm.phi(planar_arm.problem.domain.centre)
    np.testing.assert_array_equal(copy.solve(phi).q, first.solve(phi).q)


@pytest.mark.slow
@needs_c
def test_singular_solutions_of_compiled_c_are_named(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "square", lambda q: q[0] ** 2)
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box([0.5, 0.0], 0.6)), oc.Polynomial(1)).chart
    phi = chart.phi([[0.0, 0.1], [0.5, 0.1]])
    solutions = oc.compile_inverse(chart, tmp_path).solve(phi, [[0.0, 0.1], [0.4, 0.1]])
    assert solutions.statuses == (oc.InverseStatus.SINGULAR, FOUND)


@pytest.mark.slow
@needs_c
def test_damaged_libraries_are_compiled_again_and_grown_charts_refused(planar_arm: oc.Chart, tmp_path: Path) -> None:
    """A library that is cut off would end the process with SIGBUS, in the middle of its first call."""
    phi = planar_arm.phi(planar_arm.problem.domain.centre)
    first = oc.compile_inverse(planar_arm, tmp_path)
    content = first.library.read_bytes()
    for damaged in (content[: len(content) // 2], None):
        first.library.unlink()  # it may be in use
        if damaged is not None:
            first.library.write_bytes(damaged)
        with pytest.raises(CompileError, match="does not match its checksum"):
            pickle.loads(pickle.dumps(first)).solve(phi)
        assert oc.compile_inverse(planar_arm, tmp_path).solve(phi).found.all()
    first.library.with_name(f"{first.library.name}.sha256").unlink()
    assert oc.compile_inverse(planar_arm, tmp_path).solve(phi).found.all()
    with pytest.raises(NoExpressionError):
        oc.compile_inverse(circle(), tmp_path)


@needs_c
@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="rights of POSIX")
@pytest.mark.parametrize("mode", [0o777, 0o770, 0o707])
def test_folders_that_others_may_write_to_are_refused(planar_arm: oc.Chart, tmp_path: Path, mode: int) -> None:
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(CompileError, match="open: others may write there"):
        oc.compile_inverse(planar_arm, folder)
    assert not list(folder.iterdir())


@needs_c
@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="rights of POSIX")
def test_folders_of_others_are_refused(planar_arm: oc.Chart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if somebody had made the folder before its user: root's own are trusted."""
    if os.geteuid() == 0:
        os.chown(tmp_path, 12345, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: 12345)
    with pytest.raises(CompileError, match="it belongs to user"):
        oc.compile_inverse(planar_arm, tmp_path)


@pytest.mark.slow
@needs_c
@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="rights of POSIX")
def test_libraries_that_others_may_write_to_are_refused(planar_arm: oc.Chart, tmp_path: Path) -> None:
    first = oc.compile_inverse(planar_arm, tmp_path)
    first.library.chmod(0o666)
    with pytest.raises(CompileError, match="others may write there"):
        first.solve(planar_arm.phi(planar_arm.problem.domain.centre))


def test_a_relative_cache_does_not_count(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Otherwise libraries would come from whatever folder a program runs in."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for given, wanted in (("cache", tmp_path / ".cache"), ("", tmp_path / ".cache"), ("/var/tmp", Path("/var/tmp"))):
        monkeypatch.setenv("XDG_CACHE_HOME", given)
        assert libraries._find_cache() == wanted / "orthocas" / "libraries"


@pytest.mark.slow
@needs_c
@pytest.mark.parametrize("name", ["panda-wide", "panda-pose", "a joint without boundaries", "an angle"])
def test_compiled_curves_are_as_near(name: str, tmp_path: Path) -> None:
    """Of wishes whose x is that of another posture: the same status and distance, each inside and with its x.

    gcc, with warnings as errors, refused the chart of a box.
    """
    others = {"a joint without boundaries": wide, "an angle": exact}
    chart = others[name]().chart if name in others else oc.charts.load(name)
    domain = chart.problem.domain
    wishes, x = sample_uniform(domain, 200, 5), chart.x(sample_uniform(domain, 200, 6))
    mine, theirs = chart.nearest_xi(wishes, x), oc.compile_inverse(chart, tmp_path).nearest_xi(wishes, x)
    assert {FOUND, oc.InverseStatus.NEAREST} <= set(theirs.statuses)
    np.testing.assert_array_equal(theirs.status, mine.status)
    np.testing.assert_allclose(theirs.distance, mine.distance, atol=1e-8)
    ended = theirs.status <= oc.InverseStatus.NEAREST
    assert domain.contains(theirs.q[ended]).all()
    np.testing.assert_allclose(chart.parts.relative.difference(x, chart.x(theirs.q))[ended], 0, atol=1e-8)
    away = np.abs(wrap_shortest(chart.xi(theirs.q) - chart.xi(wishes), chart.parts.turns[chart.m :]))[:, 0]
    np.testing.assert_allclose(away[ended], theirs.distance[ended], atol=1e-9)


@pytest.mark.slow
@needs_c
def test_compiled_c_finds_what_random_starts_find(tmp_path: Path) -> None:
    """The nearest xi of xarm7-wide, whose joints turn twice, against 4,000 starts of damped least squares a row."""
    chart = oc.charts.load("xarm7-wide")
    domain, count = chart.problem.domain, 4
    wishes, x = sample_uniform(domain, count, 1), chart.x(sample_uniform(domain, count, 2))
    near, pool = oc.compile_inverse(chart, tmp_path).nearest_xi(wishes, x), sample_uniform(domain, STARTS, 3)
    for k in range(count):
        others = positions_at(chart, x[k], pool)
        assert near.distance[k] <= np.abs(chart.xi(others)[:, 0] - chart.xi(wishes[k])[0]).min() + 1e-6


@pytest.mark.slow
@needs_c
def test_the_nearest_xi_may_lie_where_a_curve_begins(tmp_path: Path) -> None:
    """Newton's method ends where xi turns back, from where a closed curve inside the domain is traced.

    A planar arm has two postures with x for each q1: of 20,001 values, none has an xi nearer by 0.005.
    """
    robot = oc.Robot.planar(lengths=[1, 1, 1], masses=[3, 3, 3])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Torus(3))
    chart = oc.fit(problem, oc.Fourier(degree=2), samples=600).chart
    phi = chart.phi(problem.domain.sample(80, 3))
    phi[:, 2] = np.roll(phi[:, 2], 1)
    q1 = np.linspace(-np.pi, np.pi, 20_001)
    for found in (chart.solve(phi, inside=True), oc.compile_inverse(chart, tmp_path / "cache").solve(phi, inside=True)):
        rows = np.flatnonzero(found.status == oc.InverseStatus.NEAREST)
        assert len(rows) > 5
        for row in rows:
            away = phi[row, :2] - np.column_stack([np.cos(q1), np.sin(q1)])
            cosine = ((away**2).sum(axis=1) - 2) / 2
            reached = np.abs(cosine) <= 1
            for q3 in (np.arccos(cosine[reached]), -np.arccos(cosine[reached])):
                angle = np.arctan2(away[reached, 1], away[reached, 0]) - np.arctan2(np.sin(q3), 1 + np.cos(q3))
                q = np.column_stack([q1[reached], angle - q1[reached], q3])
                assert found.distance[row] < np.abs(chart.xi(q)[:, 0] - phi[row, 2]).min() + 5e-3
