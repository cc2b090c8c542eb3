"""A killed fit goes on from its checkpoint; files of other fits, damaged or foreign ones, are refused."""

import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from programs import nightly, python

import orthocas as oc
from orthocas import solvers
from orthocas.errors import CheckpointError, Interrupted, OrthocasError
from orthocas.fitting import checkpoint
from orthocas.fitting.checkpoint import Checkpoint
from orthocas.solvers.protocol import Solver, Status
from orthocas.tools.progress import Progress


@pytest.fixture(autouse=True)
def write_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "_SECONDS", 0.0)


class Killed(BaseException):
    """Stands for a process that is gone: nothing catches it."""


def kill_in(stage: str, fraction: float) -> object:
    def monitor(progress: Progress) -> None:
        if progress.stage == stage and progress.fraction >= fraction:
            raise Killed

    return monitor


RESUMED = [
    (oc.Polynomial(4), solvers.GaussNewton(max_iterations=12, tolerance=0.0), "polynomial:4"),
    (oc.Polynomial(4), solvers.GaussNewton(), "polynomial:4"),
    (oc.Polynomial(4), solvers.GaussNewton(), "polynomial:3"),
    (oc.Polynomial(3), solvers.Adam(epochs=6, steps=10), "polynomial:3"),
    (oc.MLP((6, 5)), solvers.Adam(epochs=6, steps=10), "mlp:6x5"),
    (oc.Polynomial(3), solvers.GradientFlow(max_iterations=9), "polynomial:3"),
    (oc.MLP((6, 5)), solvers.GradientFlow(max_iterations=9), "mlp:6x5"),
    (oc.Polynomial(3), solvers.LBFGS(max_iterations=40), "polynomial:3"),
    (oc.Polynomial(3), solvers.QuasiNewton(tolerance=1e-9), "polynomial:3"),
    (oc.MLP((6, 5)), solvers.LBFGS(max_iterations=40), "mlp:6x5"),
]
NAMES = [f"{solver.name} in {stage} of {parametrisation.label}" for parametrisation, solver, stage in RESUMED]


@pytest.mark.parametrize(("parametrisation", "solver", "stage"), RESUMED, ids=NAMES)
def test_killed_fit_ends_as_the_whole_one(
    planar_x: oc.Problem, tmp_path: Path, parametrisation: object, solver: Solver, stage: str
) -> None:
    """Killed after a random and after the last iteration of a stage: the same stages, bit by bit; none is run twice."""
    settings = {"solver": solver, "samples": 300, "weights": (1000.0, 30.0), "seed": 0}
    told: list[Progress] = []
    whole = oc.fit(planar_x, parametrisation, **settings, monitor=told.append)
    iterations = [progress.fraction for progress in told if progress.stage == stage and progress.fraction > 0]
    some = np.random.default_rng(len(iterations)).choice(iterations)
    for number, fraction in enumerate((some, iterations[-1])):
        file = tmp_path / f"{number}.checkpoint"
        with pytest.raises(Killed):
            oc.fit(planar_x, parametrisation, **settings, checkpoint=file, monitor=kill_in(stage, fraction))
        told.clear()
        resumed = oc.fit(planar_x, parametrisation, **settings, checkpoint=file, monitor=told.append)
        assert told[0].stage == stage
        np.testing.assert_array_equal(resumed.chart.coordinates.theta, whole.chart.coordinates.theta)
        for found, expected in zip(resumed.stages, whole.stages, strict=True):
            assert found.result.iterations == expected.result.iterations
            assert found.result.evaluations == expected.result.evaluations
            assert (found.result.value, found.result.status) == (expected.result.value, expected.result.status)


@pytest.mark.slow
def test_finished_fit_is_not_run_again(planar_x: oc.Problem, tmp_path: Path) -> None:
    file = tmp_path / "run.checkpoint"
    first = oc.fit(planar_x, oc.Polynomial(3), checkpoint=file)
    told: list[Progress] = []
    again = oc.fit(planar_x, oc.Polynomial(3), checkpoint=file, monitor=told.append)
    assert {progress.detail for progress in told} <= {"searching for folds"}
    assert again.status is first.status
    np.testing.assert_array_equal(again.chart.coordinates.theta, first.chart.coordinates.theta)


@pytest.mark.slow
def test_interrupted_fit_can_go_on(planar_x: oc.Problem, tmp_path: Path) -> None:
    file = tmp_path / "run.checkpoint"

    def press(progress: Progress) -> None:
        if progress.stage == "polynomial:3" and progress.fraction > 0:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stop:
        oc.fit(planar_x, oc.Polynomial(4), checkpoint=file, monitor=press)
    assert stop.value.result.status is Status.INTERRUPTED
    resumed = oc.fit(planar_x, oc.Polynomial(4), checkpoint=file)
    assert resumed.status is Status.CONVERGED
    assert resumed.chart.coordinates.parametrisation.label == "polynomial:4"
    assert resumed.stages[-1].result.value <= oc.fit(planar_x, oc.Polynomial(4)).stages[-1].result.value * 1.01


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"seed": 1}, "seed"),
        ({"parametrisation": oc.Polynomial(3)}, "parametrisation"),
        ({"solver": solvers.LBFGS()}, "solver"),
        ({"weights": (1000.0, 1.0)}, "weights"),
    ],
)
def test_checkpoint_of_another_fit_is_refused(
    planar_x: oc.Problem, tmp_path: Path, change: dict[str, object], name: str
) -> None:
    file = tmp_path / "run.checkpoint"
    settings = {"parametrisation": oc.Polynomial(2), "samples": 100, "checkpoint": file}
    oc.fit(planar_x, **settings)
    before = file.read_bytes()
    with pytest.raises(CheckpointError, match=f"another fit: its {name} is"):
        oc.fit(planar_x, **{**settings, **change})
    assert file.read_bytes() == before


def test_checkpoint_of_another_problem_is_refused(planar_x: oc.Problem, planar_xy: oc.Problem, tmp_path: Path) -> None:
    oc.fit(planar_x, oc.Polynomial(2), samples=100, checkpoint=tmp_path / "run")
    with pytest.raises(CheckpointError, match="its problem is"):
        oc.fit(planar_xy, oc.Polynomial(2), samples=100, checkpoint=tmp_path / "run")


def test_bad_files_are_refused(planar_x: oc.Problem, planar_fit: object, tmp_path: Path) -> None:
    garbage, chart, cut = tmp_path / "garbage", tmp_path / "chart", tmp_path / "cut"
    garbage.write_bytes(b"not a zip")
    planar_fit.chart.save(chart)
    oc.fit(planar_x, oc.Polynomial(2), samples=100, checkpoint=cut)
    cut.write_bytes(cut.read_bytes()[:-40])
    for file, message in (
        (garbage, "not a checkpoint file"),
        (chart, "has format 'orthocas-chart', expected 'orthocas-checkpoint'"),
        (cut, "truncated, damaged or not a checkpoint"),
        (tmp_path / "missing" / "file", "folder .* does not exist"),
    ):
        with pytest.raises(CheckpointError, match=message):
            oc.fit(planar_x, oc.Polynomial(2), samples=100, checkpoint=file)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("theta", np.zeros(3), "theta has shape .*, expected .* with finite entries"),
        ("best_theta", np.full(18, np.inf), "best_theta has shape .*, expected .* with finite entries"),
        ("iterations", np.array(-1.0), r"iterations is \[-1.0\], expected one number >= 0"),
        ("seconds", np.zeros(2), r"seconds is \[0.0, 0.0\], expected one number"),
        ("gained_little", np.zeros(0), r"gained_little is \[\], expected one number"),
        ("place", np.zeros(2), "place has shape .*, expected .* with finite entries"),
        ("height", np.zeros(2), r"height has shape .*, expected one number"),
        ("best_value", np.array(np.nan), "state_best_value is NaN"),
        ("best_theta", np.array(["a"]), "state_best_theta is .*, expected an array of numbers"),
    ],
)
def test_states_that_do_not_fit_are_refused_with_file_and_field(
    planar_x: oc.Problem, tmp_path: Path, field: str, value: np.ndarray, message: str
) -> None:
    file, settings = tmp_path / "run", {"solver": solvers.Adam(epochs=4, steps=2), "samples": 60}
    with pytest.raises(Killed):
        oc.fit(planar_x, oc.MLP((2,)), **settings, checkpoint=file, monitor=kill_in("mlp:2", 0.3))
    header, arrays = checkpoint.read_archive(file, checkpoint.CHECKPOINT)
    checkpoint.write_archive(file, checkpoint.CHECKPOINT, header, {**arrays, f"state_{field}": value})
    with pytest.raises(CheckpointError, match=f"{file} is inconsistent: {message}"):
        oc.fit(planar_x, oc.MLP((2,)), **settings, checkpoint=file)


@pytest.mark.slow
def test_a_finished_stage_that_was_interrupted_is_refused(planar_x: oc.Problem, tmp_path: Path) -> None:
    file = tmp_path / "run"
    oc.fit(planar_x, oc.Polynomial(2), samples=60, checkpoint=file)
    header, arrays = checkpoint.read_archive(file, checkpoint.CHECKPOINT)
    header["stages"][0]["status"] = "interrupted"
    checkpoint.write_archive(file, checkpoint.CHECKPOINT, header, arrays)
    with pytest.raises(CheckpointError, match=f"{file} is inconsistent: status of stage 'polynomial:2' is interrupted"):
        oc.fit(planar_x, oc.Polynomial(2), samples=60, checkpoint=file)


def test_stages_of_another_size_are_refused(planar_x: oc.Problem, tmp_path: Path) -> None:
    file = tmp_path / "run"
    oc.fit(planar_x, oc.Polynomial(1), samples=60, checkpoint=file)
    header, arrays = checkpoint.read_archive(file, checkpoint.CHECKPOINT)
    header["stages"][0]["parameters"] = 7
    checkpoint.write_archive(file, checkpoint.CHECKPOINT, header, {**arrays, "stage_0": np.ones(7)})
    with pytest.raises(CheckpointError, match="stage 'polynomial:1' has 7 parameters, expected 6"):
        oc.fit(planar_x, oc.Polynomial(1), samples=60, checkpoint=file)


def test_without_a_path_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    keeper = Checkpoint(None, {}).keeper("stage")
    assert keeper.restored() is None
    keeper.keep(lambda: {"theta": np.zeros(1)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_killed_process_leaves_a_checkpoint_that_goes_on(tmp_path: Path) -> None:
    """The real thing: a process killed by the system, and a new one."""
    file = tmp_path / "run.checkpoint"
    code = (
        "import orthocas as oc; from orthocas import problems, solvers; from orthocas.fitting import checkpoint; "
        "checkpoint._SECONDS = 0.0; "
        "fit = oc.fit(problems.get('planar_3r_xy'), oc.MLP((8, 8)), solvers.Adam(epochs=50, steps=20), samples=200, "
        f"checkpoint={str(file)!r}); "
        "print(fit.stages[0].result.iterations, fit.stages[0].result.evaluations)"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.2)
    process.kill()
    process.wait()
    header, arrays = checkpoint.read_archive(file, checkpoint.CHECKPOINT)
    assert header["running"] == "mlp:8x8"
    assert 0 < arrays["state_iterations"] < 50
    assert python(code).split() == ["50", str(1 + 50 * 21)]  # one start, 20 steps and one judgement an epoch


CHILD = """
import os, signal, threading, time
import orthocas as oc
from orthocas import problems, solvers
from orthocas.fitting import checkpoint

def die(progress, armed=[]):
    if progress.fraction > 0 and not armed:
        armed.append(threading.Timer({delay}, os.kill, (os.getpid(), signal.SIGKILL)))
        armed[0].daemon = True
        armed[0].start()

checkpoint._SECONDS = 0.0
oc.fit(problems.get("planar_3r_x"), {fit}, samples=2000, checkpoint={file!r}, monitor=die)
"""
LONG = [
    "oc.Polynomial(8), solvers.GaussNewton(max_iterations=20, tolerance=0.0)",
    "oc.MLP((16, 16)), solvers.GradientFlow(max_iterations=8)",
]


@pytest.mark.slow
@pytest.mark.parametrize("fit", [LONG[0], *nightly(LONG[1])], ids=["gauss_newton", "gradient_flow"])
def test_process_killed_at_any_time_loses_nothing(planar_x: oc.Problem, tmp_path: Path, fit: str) -> None:
    """SIGKILL a random time after the first iteration, twice, in the middle of an iteration or of a write."""
    parametrisation, solver = eval(fit, {"oc": oc, "solvers": solvers})
    whole = oc.fit(planar_x, parametrisation, solver, samples=2000)
    file = tmp_path / "run.checkpoint"
    for delay in np.random.default_rng(len(fit)).uniform(0, 0.3 * whole.seconds, 2):
        code = CHILD.format(delay=delay, fit=fit, file=str(file))
        ended = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
        assert ended.returncode == -signal.SIGKILL, ended.stderr
    header, _ = checkpoint.read_archive(file, checkpoint.CHECKPOINT)
    assert header["running"] == parametrisation.label or len(header["stages"]) > 0
    resumed = oc.fit(planar_x, parametrisation, solver, samples=2000, checkpoint=file)
    theta = whole.chart.coordinates.theta
    np.testing.assert_allclose(resumed.chart.coordinates.theta, theta, rtol=0, atol=1e-10 * np.abs(theta).max())
    assert [s.result.iterations for s in resumed.stages] == [s.result.iterations for s in whole.stages]
    assert [s.result.evaluations for s in resumed.stages] == [s.result.evaluations for s in whole.stages]


@pytest.mark.slow
@pytest.mark.parametrize("solver", [solvers.GaussNewton(20), solvers.QuasiNewton(20)], ids=lambda solver: solver.name)
def test_parameters_that_lead_to_infinite_matrices_are_errors_of_ours(
    planar_x: oc.Problem, tmp_path: Path, solver: solvers.Solver
) -> None:
    file, settings = tmp_path / "run", {"solver": solver, "samples": 60}
    oc.fit(planar_x, oc.Polynomial(3), **settings, checkpoint=file)
    header, arrays = checkpoint.read_archive(file, checkpoint.CHECKPOINT)
    for name in ("stage_0", "stage_1"):
        for size in (1e31, 1e200, 1e300):
            huge = {**arrays, name: np.full_like(arrays[name], size)}
            checkpoint.write_archive(file, checkpoint.CHECKPOINT, header, huge)
            with np.errstate(all="ignore"), suppress(OrthocasError):  # other errors are wrong
                assert np.isfinite(
                    oc.fit(planar_x, oc.Polynomial(3), **settings, checkpoint=file).chart.xi([0.6] * 3)
                ).all()


@pytest.mark.slow
def test_a_state_without_a_gradient_gets_a_new_one(planar_x: oc.Problem, tmp_path: Path) -> None:
    file, settings = tmp_path / "run", {"solver": solvers.QuasiNewton(20), "samples": 60}
    with pytest.raises(Killed):
        oc.fit(planar_x, oc.Polynomial(2), **settings, checkpoint=file, monitor=kill_in("polynomial:2", 0.2))
    header, arrays = checkpoint.read_archive(file, checkpoint.CHECKPOINT)
    kept = {name: array for name, array in arrays.items() if name != "state_gradient"}
    assert len(kept) == len(arrays) - 1
    found = oc.fit(planar_x, oc.Polynomial(2), **settings, checkpoint=file)
    checkpoint.write_archive(file, checkpoint.CHECKPOINT, header, kept)
    again = oc.fit(planar_x, oc.Polynomial(2), **settings, checkpoint=file)
    np.testing.assert_allclose(again.chart.coordinates.theta, found.chart.coordinates.theta, rtol=1e-6)
