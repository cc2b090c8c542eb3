"""Grids of fits: every cell reported, failures apart, tables and pictures that hold what was measured."""

import csv
import json
import math
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import pytest
from programs import python

import orthocas as oc
from orthocas import solvers
from orthocas.bases import register_parametrisation
from orthocas.errors import ArchiveError, ChartFileError, Interrupted, InvalidValueError, UnknownNameError
from orthocas.fitting.compare import HELD_OUT_SEED, Cell, CellResult, Comparison, run_cell, run_cells
from orthocas.fitting.comparison_figures import convergence_figure, front_figure
from orthocas.fitting.terms import Weights
from orthocas.tools import batch, processes
from orthocas.tools.display import percent
from orthocas.tools.progress import Progress

QUICK: dict[str, Any] = {"samples": 150, "held_out": 500}


class Kills:
    """A parametrisation that ends its process, as running out of memory does."""

    label = "kills"
    linear = True
    closed_form = None

    def for_problem(self, problem: oc.Problem) -> Self:
        return self

    def family(self, space: object, outputs: int) -> object:
        os._exit(3)


@dataclass(frozen=True)
class Breaks:
    """A parametrisation with a defect of its own."""

    label: ClassVar[str] = "breaks"
    linear: ClassVar[bool] = True
    closed_form: ClassVar[None] = None

    def for_problem(self, problem: oc.Problem) -> Self:
        return self

    def family(self, space: object, outputs: int) -> object:
        raise KeyError("a defect")


register_parametrisation("breaks", Breaks)


class InThisThread(Executor):
    """The smallest executor there is."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.fixture(scope="module")
def grid(planar_x: oc.Problem, tmp_path_factory: pytest.TempPathFactory) -> tuple[Comparison, Path]:
    folder = tmp_path_factory.mktemp("charts")
    found = oc.compare(
        planar_x,
        [oc.Linear(), oc.Polynomial(2), oc.MLP((4,))],
        [solvers.GaussNewton(), solvers.LBFGS(max_iterations=20)],
        seeds=2,
        weights=(1000, 30, 150),  # without the fold term, which lifts the loss between stages
        executor=InThisThread(),
        charts=folder,
        **QUICK,
    )
    return found, folder


@pytest.mark.slow
def test_grid_holds_every_cell_once_and_in_order(grid: tuple[Comparison, Path]) -> None:
    found, _ = grid
    cells = [(r.parametrisation, r.solver, r.seed) for r in found.results]
    assert cells == [
        ("linear", "closed form", 0),
        *(("polynomial:2", name, seed) for name in ("gauss_newton", "lbfgs") for seed in (0, 1)),
        *(("mlp:4", name, seed) for name in ("gauss_newton", "lbfgs") for seed in (0, 1)),
    ]


@pytest.mark.slow
def test_failing_cells_are_reported_and_the_others_go_on(grid: tuple[Comparison, Path]) -> None:
    found, _ = grid
    failed = [r for r in found.results if r.failed]
    assert {(r.parametrisation, r.solver) for r in failed} == {("mlp:4", "gauss_newton")}
    assert all("expected lbfgs or adam" in r.error and math.isnan(r.task_std_deg) for r in failed)
    assert not found.interrupted


def test_results_are_those_of_the_saved_charts(grid: tuple[Comparison, Path]) -> None:
    found, folder = grid
    result = next(r for r in found.results if r.solver == "lbfgs" and r.seed == 1)
    chart = oc.load(folder / "polynomial-2_lbfgs_1.orthocas")
    report = oc.evaluate(chart, 500, HELD_OUT_SEED)
    assert result.task_std_deg == report.task_angle.std
    assert result.mutual_std_deg == report.mutual_angle.std
    assert result.leak_rms_deg == report.leak.rms
    assert result.conditioning_p01 == report.conditioning.p01
    assert result.parameters == chart.coordinates.theta.size
    assert len(list(folder.iterdir())) == 7


def test_history_falls_and_ends_before_the_fit_does(grid: tuple[Comparison, Path]) -> None:
    for result in grid[0].results:
        if result.solver == "lbfgs":
            seconds, losses = zip(*result.history, strict=True)
            assert list(seconds) == sorted(seconds)
            assert seconds[-1] <= result.seconds
            assert list(losses) == sorted(losses, reverse=True)
            assert len(losses) == result.iterations


def test_summaries_are_medians_and_spreads_over_seeds(grid: tuple[Comparison, Path]) -> None:
    found, _ = grid
    first, *_, last = found.summaries()
    own = [
        r.task_std_deg for r in found.results if (r.parametrisation, r.solver) == (first.parametrisation, first.solver)
    ]
    assert first.task_std_deg == pytest.approx(np.median(own))
    assert first.task_spread == pytest.approx((max(own) - min(own)) / np.median(own))
    assert first.task_std_deg == min(s.task_std_deg for s in found.summaries() if not s.failed)
    assert (last.failed, last.seeds) == (2, 2)
    rows = found.rows()
    assert rows[-1][2].startswith("failed: InvalidValueError")
    assert "±" in rows[1][3]


@pytest.mark.slow
def test_control_ticks_are_measured_once_a_parametrisation(planar_x: oc.Problem, tmp_path: Path) -> None:
    """Failed fits have none."""
    lbfgs = solvers.LBFGS(max_iterations=5)
    parametrisations = [oc.Linear(), oc.MLP((4,)), Breaks()]
    places: dict[str, Any] = {"executor": InThisThread(), "charts": tmp_path, "control_ticks": True}
    found = oc.compare(planar_x, parametrisations, [lbfgs], seeds=2, **places, **QUICK)
    with pytest.raises(InvalidValueError, match="a folder for charts"):
        oc.compare(planar_x, parametrisations, control_ticks=True)
    ticks = {r.parametrisation: r.control_tick_us for r in found.results}
    assert math.isnan(ticks.pop("breaks"))
    if shutil.which("cc") is None:
        assert all(math.isnan(tick) for tick in ticks.values())
        pytest.skip("no C compiler")
    assert all(tick > 0 for tick in ticks.values())
    for result in found.results:
        assert result.failed or result.control_tick_us == ticks[result.parametrisation]
    table = found.rows()
    assert table[0][-1] == "control tick"
    assert [row[-1].endswith(" us") for row in table[1:]] == [True, True, False]


@pytest.mark.slow
def test_ticks_are_left_out_without_a_compiler(
    planar_x: oc.Problem, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    places: dict[str, Any] = {"executor": InThisThread(), "charts": tmp_path, "control_ticks": True}
    found = oc.compare(planar_x, [oc.Linear()], **places, **QUICK)
    assert math.isnan(found.results[0].control_tick_us)
    assert found.rows()[1][-1] == "-"


def test_files_hold_the_same_numbers(grid: tuple[Comparison, Path], tmp_path: Path) -> None:
    found, _ = grid
    found.write(tmp_path)
    with (tmp_path / "comparison.csv").open() as file:
        lines = list(csv.DictReader(file))
    data = json.loads((tmp_path / "comparison.json").read_text())
    assert len(lines) == len(data["fits"]) == len(found.results)
    for line, entry, result in zip(lines, data["fits"], found.results, strict=True):
        assert line["solver"] == entry["solver"] == result.solver
        if not result.failed:
            assert float(line["task_std_deg"]) == entry["task_std_deg"] == result.task_std_deg
        else:
            assert entry["task_std_deg"] is None


def test_pictures_show_every_good_fit(grid: tuple[Comparison, Path]) -> None:
    found, _ = grid
    (axes,) = front_figure(found).axes
    drawn = np.array([collection.get_offsets()[0] for collection in axes.collections])
    good = [(r.task_std_deg, r.mutual_std_deg) for r in found.results if not r.failed]
    np.testing.assert_allclose(drawn, good)
    (axes,) = convergence_figure(found).axes
    curves = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) > 1]
    wanted = [r.history for r in found.results if len(r.history) > 1]
    assert len(curves) == len(wanted)


@pytest.mark.slow
def test_front_of_one_coordinate_shows_the_conditioning(planar_xy: oc.Problem) -> None:
    found = oc.compare(planar_xy, [oc.Linear(), oc.Polynomial(2)], executor=InThisThread(), **QUICK)
    (axes,) = front_figure(found).axes
    assert "conditioning" in axes.get_ylabel()
    heights = [collection.get_offsets()[0][1] for collection in axes.collections]
    np.testing.assert_allclose(heights, [r.conditioning_p01 for r in found.results])


@pytest.mark.slow
def test_several_weights_are_a_front(planar_x: oc.Problem, tmp_path: Path) -> None:
    """Of tight fits: a larger lambda2 buys mutual angles with task angles."""
    weights = [(1000.0, 1.0), oc.Weights(1000.0, 1000.0, 0.0, 0.0, 0.0)]
    families, places = [oc.Polynomial(2), oc.Linear()], {"charts": tmp_path, "executor": InThisThread()}
    found = oc.compare(planar_x, families, weights=weights, **places, **QUICK)
    assert [(r.parametrisation, r.weights) for r in found.results] == [
        ("polynomial:2", "1000,1"),
        ("polynomial:2", "1000,1000"),
        ("linear", "1000,1"),
    ]
    little, much, _ = found.results
    assert much.mutual_std_deg < little.mutual_std_deg
    assert much.task_std_deg > little.task_std_deg
    assert len(found.summaries()) == len(found.facts()) - 1 == 3
    for result, file in ((little, "1000-1"), (much, "1000-1000")):
        chart = oc.load(tmp_path / f"polynomial-2_gauss_newton_0_{file}.orthocas")
        assert result.task_std_deg == oc.evaluate(chart, 500, HELD_OUT_SEED).task_angle.std


@pytest.mark.slow
def test_front_of_wide_fits_trades_leak_for_the_rest() -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    task = oc.Task.position(robot, "xy")
    problem, settings = oc.Problem(robot, task), {"executor": InThisThread(), "samples": 1000, "held_out": 1000}
    weights = [(40.0, 0.0), (1e-6, 0.0)]
    found = oc.compare(problem, [oc.Polynomial(3)], branch="whole", weights=weights, **settings)
    aligned, leaning = found.results
    assert (aligned.weights, aligned.solver, leaning.weights) == ("40,0", "wide", "1e-06,0")
    assert aligned.leak_rms_deg < leaning.leak_rms_deg - 10.0
    direct = oc.fit_wide(
        robot, task, "whole", parametrisation=oc.Polynomial(3), weights=Weights.of((40, 0)), samples=1000
    )
    assert aligned.regular_share == direct.regular_share
    assert aligned.leak_rms_deg == oc.evaluate(direct.chart, 1000, HELD_OUT_SEED).leak.rms
    (near,) = oc.compare(problem, [oc.Polynomial(3)], branch="whole", like="q2", clearance=0.2, **settings).results
    follower = oc.fit_wide(
        robot, task, "whole", like="q2", exact=False, clearance=0.2, parametrisation=oc.Polynomial(3), samples=1000
    )
    assert near.leak_rms_deg == oc.evaluate(follower.chart, 1000, HELD_OUT_SEED).leak.rms
    assert near.regular_share == follower.regular_share
    head, best, worst = found.rows()
    assert [row[head.index("weights")] for row in (best, worst)] == ["40,0", "1e-06,0"]
    assert best[head.index("regular share")] == percent(aligned.regular_share, 3)
    upper, lower = front_figure(found).axes
    places = [(r.leak_rms_deg, 100 * (1 - r.regular_share)) for r in found.results]
    np.testing.assert_allclose(upper.lines[0].get_xydata(), places)
    np.testing.assert_allclose(lower.lines[0].get_ydata(), [r.conditioning_p01 for r in found.results])
    assert [text.get_text() for text in lower.texts] == ["40,0", "1e-06,0"]


@pytest.mark.slow
def test_process_that_dies_fails_alone(planar_x: oc.Problem) -> None:
    told: list[Progress] = []
    found = oc.compare(
        planar_x, [oc.Polynomial(1), Kills(), Breaks(), oc.Polynomial(2)], jobs=2, monitor=told.append, **QUICK
    )
    by_label = {r.parametrisation: r for r in found.results}
    assert by_label["kills"].error.startswith("its process died: out of memory, or")
    assert by_label["breaks"].error == "KeyError: 'a defect'"
    assert not by_label["polynomial:1"].failed
    assert not by_label["polynomial:2"].failed
    assert [round(p.fraction, 2) for p in told] == [0.25, 0.5, 0.75, 1.0]


def test_processes_use_one_thread_each_and_leave_the_environment_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with processes.starting_workers():
        assert os.environ["OMP_NUM_THREADS"] == "1"
        assert batch._count_cores() == 1
    assert os.environ["OMP_NUM_THREADS"] == "7"
    monkeypatch.delenv("OMP_NUM_THREADS")
    with processes.starting_workers():
        pass
    assert "OMP_NUM_THREADS" not in os.environ


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Linux sets the limit")
def test_full_disk_for_temporary_files_is_named() -> None:
    """A limit on the size of files stands for a full disk."""
    code = """
import resource, sys, orthocas as oc
sys.dont_write_bytecode = True  # truncated files would break later imports
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    oc.compare(oc.problems.get("planar_3r_x"), [oc.Linear()], samples=30, held_out=50)
except oc.errors.ArchiveError as error:
    print(error)
"""
    pattern = r"cannot write the temporary file \S+/orthocas-\S+/0\.pickle: File too large\n"
    assert re.fullmatch(pattern, python(code))


def test_full_shared_memory_is_named(planar_x: oc.Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("orthocas.tools.processes.ProcessPoolExecutor", full)
    with pytest.raises(ArchiveError, match=r"No space left on device, expected room in /dev/shm"):
        oc.compare(planar_x, [oc.Linear()], samples=30, held_out=50)


@pytest.mark.slow
def test_any_executor_does(planar_x: oc.Problem) -> None:
    with ThreadPoolExecutor(2) as pool:
        found = oc.compare(planar_x, [oc.Polynomial(1), oc.Polynomial(2)], executor=pool, **QUICK)
    assert [r.failed for r in found.results] == [False, False]


def test_executor_that_loses_a_cell_is_reported(planar_x: oc.Problem) -> None:
    class Loses(InThisThread):
        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_exception(ConnectionError("worker is gone"))
            return future

    (result,) = oc.compare(planar_x, [oc.Polynomial(1)], executor=Loses(), **QUICK).results
    assert result.error == "ConnectionError: worker is gone"


@pytest.mark.slow
def test_ctrl_c_raises_with_what_is_done(planar_x: oc.Problem) -> None:
    def press(progress: Progress) -> None:
        if progress.fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stop:
        oc.compare(planar_x, [oc.Linear(), oc.Polynomial(1)], executor=InThisThread(), monitor=press, **QUICK)
    found = stop.value.result
    assert found.interrupted
    assert len(found.results) == 1


@pytest.mark.slow
def test_same_cell_same_result(planar_x: oc.Problem) -> None:
    cell = Cell(planar_x, oc.Polynomial(2), solvers.GaussNewton(), 3, Weights.of((1000.0, 30.0)), 150, 500, None)
    first, second = (replace(r, seconds=0.0, history=()) for r in run_cells([cell, cell], InThisThread()))
    assert repr(first) == repr(second)  # NaN where nothing was measured, which equals nothing
    assert isinstance(run_cell(cell), CellResult)


@pytest.mark.slow
def test_ctrl_c_stops_running_processes_too(planar_x: oc.Problem) -> None:
    """Fits that would take minutes end at their next step, and none is started."""

    def press(progress: Progress) -> None:
        raise KeyboardInterrupt

    slow = solvers.Adam(epochs=2000, steps=50)
    start, others = time.monotonic(), set(multiprocessing.active_children())
    networks = [oc.MLP((8, 8)), oc.MLP((9, 9)), oc.MLP((10, 10)), oc.MLP((11, 11))]
    with pytest.raises(Interrupted):
        oc.compare(planar_x, [oc.Linear(), *networks], [slow], jobs=2, monitor=press, **QUICK)
    while set(multiprocessing.active_children()) - others and time.monotonic() - start < 60:
        time.sleep(0.1)
    assert time.monotonic() - start < 60  # a single network would take longer


def test_bad_settings_are_refused(planar_x: oc.Problem) -> None:
    for grid, message in (
        ({"parametrisations": []}, "parametrisations is empty"),
        ({"parametrisations": [3]}, "parametrisations is 3, expected objects such as"),
        ({"parametrisations": [oc.Linear(), oc.Linear((0.6, 0.8, 0.8))]}, "two called 'linear'"),
        ({"solvers": []}, "solvers is empty"),
        ({"solvers": [solvers.LBFGS(), solvers.LBFGS(memory=5)]}, "two called 'lbfgs'"),
        ({"weights": [(1.0, 0.5), oc.Weights(1.0, 0.5, 0.0, 0.0, 0.0)]}, "weights is a list with 1,0.5 twice"),
        ({"solvers": [solvers.LBFGS()], "branch": planar_x.domain}, "wide fits choose their own"),
        ({"clearance": 0.1}, "clearance is given without a branch"),
    ):
        with pytest.raises(InvalidValueError, match=message):
            oc.compare(planar_x, **{"parametrisations": [oc.Linear()], **grid})
    with pytest.raises(UnknownNameError, match="unknown branch 'up', known: whole"):
        oc.compare(planar_x, [oc.Polynomial(2)], branch="up")
    with pytest.raises(ChartFileError, match="folder missing does not exist"):
        oc.compare(planar_x, [oc.Linear()], charts="missing")
    for settings in ({"seeds": 0}, {"jobs": 0}, {"held_out": 0}, {"weights": (0.0, 1.0)}):
        with pytest.raises(InvalidValueError):
            oc.compare(planar_x, [oc.Linear()], **settings)


@pytest.mark.slow
def test_scripts_without_a_main_guard_get_one_line_from_each_process(tmp_path: Path) -> None:
    """Python prints twenty lines; and each process would start the whole script again."""
    script = tmp_path / "script.py"
    script.write_text(
        "import orthocas as oc\n"
        "found = oc.compare(oc.problems.get('planar_3r_xy'), [oc.Linear()], jobs=1, held_out=100)\n"
        "print(found.results[0].error)\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "a script that calls compare outside" in done.stdout
    lines = done.stderr.splitlines()
    assert 1 <= len(lines) <= 2
    wanted = "orthocas: a script that starts processes needs `if __name__ == '__main__':` around its calls"
    assert set(lines) == {wanted}


def test_words_of_the_command_line_are_families() -> None:
    problem = oc.problems.get("planar_3r_xy")
    with ThreadPoolExecutor(1) as executor:
        found = oc.compare(problem, ["linear", oc.Polynomial(2)], samples=200, held_out=500, executor=executor)
    assert [result.parametrisation for result in found.results] == ["linear", "polynomial:2"]
    for bad, expected in ((["bla"], "unknown parametrisation"), ("linear", "objects such as"), (3, "a Sequence")):
        with pytest.raises(oc.errors.OrthocasError, match=expected):
            oc.compare(problem, bad)  # type: ignore[arg-type]
