"""Signals from outside: nobody misses an interrupted result, and no process outlives its parent."""

import os
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from matplotlib.figure import Figure
from paper import Drawing, Recipe, registry
from programs import Run, nightly, python

import orthocas as oc
from orthocas.certificates.box_checks import BoxResults
from orthocas.certificates.search import Limits, Search
from orthocas.certificates.taylor import Variables
from orthocas.charts.certificate import Subdivision
from orthocas.cli import entry
from orthocas.errors import Interrupted
from orthocas.fitting.compare import run_cells
from orthocas.solvers.protocol import BestPoint, Status
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred, ended_in_order, remembered
from orthocas.tools.processes import run_program
from orthocas.tools.progress import Progress


def ctrl_c_in_the_solver(progress: Progress) -> None:
    """A monitor that sends a real Ctrl-C once there is something to lose."""
    if progress.fraction > 0 and progress.stage == "polynomial:2":
        signal.raise_signal(signal.SIGINT)


def test_loops_around_fit_end_with_ctrl_c(planar_x: oc.Problem) -> None:
    degrees = []

    def loop() -> None:
        for degree in (2, 3, 4):
            degrees.append(degree)
            oc.fit(planar_x, oc.Polynomial(degree), samples=300, monitor=ctrl_c_in_the_solver)

    with pytest.raises(KeyboardInterrupt) as stop:
        loop()
    assert degrees == [2]
    assert isinstance(stop.value, Interrupted)
    assert stop.value.result.status is Status.INTERRUPTED
    assert stop.value.result.chart.r == 2


@pytest.mark.slow
def test_what_needs_a_finished_minimisation_ends_with_ctrl_c(planar_x: oc.Problem) -> None:
    """Distilling into a network: the minimiser would return its best point."""
    grown = oc.grow(planar_x, leaf="linear")
    step = BestPoint.next_iteration

    def interrupted(self: BestPoint, limit: int) -> None:
        step(self, limit)
        signal.raise_signal(signal.SIGINT)

    with patch.object(BestPoint, "next_iteration", interrupted), pytest.raises(KeyboardInterrupt):
        oc.distil(grown, oc.MLP((4,)), samples=200)


def test_reproduce_does_not_draw_an_interrupted_fit(run_paper: Run, planar_x: oc.Problem) -> None:
    def draw(quick: bool) -> Drawing:
        return Drawing({"": Figure(figsize=(0.2, 0.2))}, {"one": 1.0})

    def draw_fit(quick: bool) -> Drawing:
        found = oc.fit(planar_x, oc.Polynomial(3), samples=300, monitor=ctrl_c_in_the_solver)
        return Drawing({"": Figure()}, {"seconds": found.seconds})

    recipes = {"fig06": Recipe("first", draw), "fig11": Recipe("second", draw_fit)}
    with patch.dict(registry.FIGURES, recipes, clear=True):
        code, out, err = run_paper("all", "--out", "figures")
    assert (code, out, err) == (130, "", "orthocas: interrupted\n")
    assert {path.stem for path in Path("figures").glob("fig*")} == {"fig06"}


def swallowed(quick: bool) -> Drawing:
    """As `except: pass` in a library would."""
    with suppress(BaseException):
        signal.raise_signal(signal.SIGINT)
    return Drawing({"": Figure(figsize=(0.2, 0.2))}, {"one": 1.0})


def turned_into_an_error(quick: bool) -> Drawing:
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise RuntimeError("a callback failed") from None
    raise AssertionError


def swallowed_in_compiled_code(quick: bool) -> Drawing:
    with suppress(BaseException), deferred():
        signal.raise_signal(signal.SIGINT)
    return swallowed(quick)


@pytest.mark.parametrize("draw", [swallowed, turned_into_an_error, swallowed_in_compiled_code])
def test_ctrl_c_that_a_library_swallows_is_not_lost(run_paper: Run, draw: Callable[[bool], Drawing]) -> None:
    before = signal.getsignal(signal.SIGINT)
    with patch.dict(registry.FIGURES, {"fig06": Recipe("first", draw)}, clear=True):
        code, _, err = run_paper("fig06", "--out", "figures")
    assert (code, err) == (130, "orthocas: interrupted\n")
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_other_signals_that_a_library_swallows_are_not_lost(run_paper: Run, name: str) -> None:
    number = getattr(signal, name)
    of_this_process = signal.signal(number, signal.SIG_DFL)

    def draw(quick: bool) -> Drawing:
        with suppress(BaseException):
            signal.raise_signal(number)
        return Drawing({"": Figure(figsize=(0.2, 0.2))}, {"one": 1.0})

    try:
        with patch.dict(registry.FIGURES, {"fig06": Recipe("first", draw)}, clear=True):
            code, _, err = run_paper("fig06", "--out", "figures")
    finally:
        signal.signal(number, of_this_process)
    assert (code, err) == (128 + number, "")


@dataclass
class Disturbed:
    """A judge that proves nothing; a library that swallows the signal's exception works for it."""

    number: int
    joints: Variables = (0, 1)
    boxes: int = 0

    def __call__(self, low: Array, high: Array) -> BoxResults:
        self.boxes += len(low)
        with suppress(BaseException):
            signal.raise_signal(self.number)
        no = np.zeros(len(low), dtype=bool)
        return BoxResults(no, no, np.zeros(len(low)), np.zeros(len(low)), np.zeros(len(low), dtype=int))


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_search_ends_soon_after_a_signal_that_a_library_swallowed(name: str) -> None:
    """Between two batches of boxes, whose states are kept."""
    number = getattr(signal, name)
    handler = signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL
    of_this_process = signal.signal(number, handler)
    box = Subdivision.whole(-np.ones(2), np.ones(2))
    judge = Disturbed(number)
    search = Search(judge, box, Limits(boxes=1000))
    try:
        with ended_in_order(), remembered(), pytest.raises((KeyboardInterrupt, SystemExit)):
            search.run(lambda _: None)
    finally:
        signal.signal(number, of_this_process)
    assert judge.boxes == 1


def test_ctrl_c_is_forgotten_with_the_block() -> None:
    with remembered() as pressed:
        assert not pressed()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert pressed()
        with remembered() as again:
            assert not again()


def test_ctrl_c_while_python_ends_needs_no_handler() -> None:
    before = signal.signal(signal.SIGINT, entry._leave)
    try:
        with patch.object(sys, "argv", ["orthocas", "--help"]), pytest.raises(SystemExit) as end:
            entry.main()
        assert end.value.code == 0
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_signal_that_python_loses_itself_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    """Python calls back when a weak reference dies, and only reports exceptions there."""

    class Thing:
        pass

    def interrupted(_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    def broken(_: object) -> None:
        raise ValueError("a defect")

    hook = sys.unraisablehook
    seen: list[type[BaseException]] = []
    sys.unraisablehook = lambda lost: seen.append(lost.exc_type)
    try:
        with ended_in_order(), remembered() as pressed:
            for callback in (interrupted, broken):
                thing = Thing()
                kept = weakref.ref(thing, callback)
                del thing
            assert pressed()
            assert kept() is None
    finally:
        sys.unraisablehook = hook
    assert seen == [ValueError]


def test_ctrl_c_ends_a_compiler_with_what_it_has_started(tmp_path: Path) -> None:
    """gcc starts cc1, which would go on."""
    mark = tmp_path / "started"
    code = f"(sleep 60 & echo $! > {mark}; wait)"

    def press() -> None:
        while not mark.exists() or not mark.read_text().strip():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        pressed = pool.submit(press)
        with pytest.raises(KeyboardInterrupt):
            run_program(["sh", "-c", code])
        pressed.result()
    status = Path(f"/proc/{mark.read_text().strip()}/stat")
    end = time.monotonic() + 10
    while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z" and time.monotonic() < end:
        time.sleep(0.01)
    assert time.monotonic() < end


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_other_signals_end_in_order_after_compiled_code(name: str, tmp_path: Path) -> None:
    """What compiled code would lose is raised behind it, and handlers are put back."""
    number = getattr(signal, name)
    of_this_process = signal.signal(number, signal.SIG_DFL)  # under nohup it would be ignored, and stay so
    done = []

    def work() -> None:
        with ended_in_order(), deferred():
            signal.raise_signal(number)
            done.append("the block goes on")

    try:
        with pytest.raises(SystemExit) as stop:
            work()
        assert (stop.value.code, done) == (128 + number, ["the block goes on"])
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, of_this_process)


def test_ignored_signals_stay_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ended_in_order():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_only_the_command_line_watches_its_imports() -> None:
    code = "import orthocas, orthocas.cli.entry, orthocas.cli.commands, signal, sys"
    assert python(f"{code}; print(signal.getsignal(signal.SIGINT).__name__, sys.excepthook.__name__)").split() == [
        "default_int_handler",
        "excepthook",
    ]


_CTRL_C_AT = """
import os, signal, sys
from importlib.abc import MetaPathFinder

class Finder(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "{module}":
            os.kill(os.getpid(), signal.SIGINT)
            for _ in range(100):
                pass  # Python looks for signals here

sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize("module", ["orthocas.cli.entry", "orthocas.version", "orthocas.cli.commands"])
@pytest.mark.parametrize("start", [("-m", "orthocas"), ("-c", "from orthocas.cli import main; main()")])
def test_ctrl_c_before_our_handlers_is_one_line(module: str, start: tuple[str, str], tmp_path: Path) -> None:
    """Sent at a moment that a campaign of random times meets once in three hundred kills; `-c` as the script does."""
    (tmp_path / "sitecustomize.py").write_text(_CTRL_C_AT.format(module=module))
    done = subprocess.run(
        [sys.executable, *start, "info", "planar_3r_x"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "orthocas: interrupted\n")


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, *nightly(0.2, 0.8)])
def test_ctrl_c_during_imports_is_one_line(share: float) -> None:
    command = [sys.executable, "-m", "orthocas", "info", "planar_3r_x"]
    start = time.monotonic()
    subprocess.run(command, capture_output=True, check=True)
    seconds = time.monotonic() - start
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(share * seconds)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    said = "orthocas: interrupted\n"
    # By the signal itself: without a word before Python begins the command or after its end, and with it if the
    # exception passed through code that a compiled library runs, because then Python remembers it until its exit.
    assert (process.returncode, err) in ((130, said), (0, ""), (-signal.SIGINT, ""), (-signal.SIGINT, said))


_GRID = """
import sys, orthocas as oc
from orthocas import solvers
if __name__ == "__main__":
    slow = solvers.Adam(epochs=10_000, steps=50)
    networks = [oc.MLP((8, 8)), oc.MLP((9, 9))]
    oc.compare(oc.problems.get("planar_3r_x"), networks, [slow], jobs=2, samples=200, held_out=200)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "grid.py").write_text(_GRID)
    (tmp_path / "tmp").mkdir()
    environment = os.environ | {"TMPDIR": str(tmp_path / "tmp")}
    process = subprocess.Popen(
        [sys.executable, "grid.py"], cwd=tmp_path, env=environment, start_new_session=True, stderr=subprocess.DEVNULL
    )
    wait_until(lambda: len(session_of(process.pid)) >= 3, 60)  # the parent, and workers at some point of their start
    time.sleep(2)
    process.kill()
    process.wait()
    wait_until(lambda: not session_of(process.pid), 5)
    assert list((tmp_path / "tmp").glob("orthocas-*"))  # nobody could remove it ...
    with patch("tempfile.tempdir", str(tmp_path / "tmp")):
        assert list(run_cells([])) == []
    assert not list((tmp_path / "tmp").glob("orthocas-*"))  # ... but the next comparison does


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.skipif(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN, reason="nohup is for children too")
def test_hang_up_ends_a_comparison_without_a_traceback(tmp_path: Path) -> None:
    """It reaches all processes of a terminal at once, that of multiprocessing which frees semaphores included."""
    (tmp_path / "tmp").mkdir()
    grid = ("--param", "mlp:8x8", "--param", "mlp:9x9", "--solver", "adam", "--jobs", "2", "--out", "out")
    process = subprocess.Popen(
        [sys.executable, "-m", "orthocas", "compare", "planar_3r_x", *grid],
        cwd=tmp_path,
        env=os.environ | {"TMPDIR": str(tmp_path / "tmp")},
        start_new_session=True,
        stderr=subprocess.PIPE,
    )
    wait_until(lambda: len(session_of(process.pid)) == 4, 60)
    time.sleep(2)
    os.killpg(process.pid, signal.SIGHUP)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (128 + signal.SIGHUP, b"")
    wait_until(lambda: not session_of(process.pid), 5)
    assert not list((tmp_path / "tmp").iterdir())


def wait_until(condition: Callable[[], bool], seconds: float) -> None:
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < seconds
        time.sleep(0.1)


def session_of(leader: int) -> list[int]:
    """Processes of a session that run."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, session = (path / "stat").read_text().rpartition(")")[2].split()[:4]
        except (OSError, ValueError):
            continue
        if int(session) == leader and state != "Z":
            found.append(int(path.name))
    return found
