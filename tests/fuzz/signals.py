"""Kills and Ctrl-C of every command at random times, imports included.

A round takes one command and one folder: some runs are stopped there by a signal, and a last one goes to its end.
"""

import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

import orthocas as oc
from fuzz.child import Finding, run
from orthocas.simulation import Trajectory
from orthocas.tools.json import clean

KILLS = 5  #: of one round
_ROOT = Path(__file__).parent.parent.parent
_SECONDS = 300.0  # for one round, on a busy machine
_PATIENCE = 20.0  # seconds from a signal to the end of the process
_LATE = 1.0  # seconds that a run may go on after a signal and end well
_AFTERWARDS = 5.0  # seconds until the last process of a command has gone
WHOM = ("it", "all its processes", "a worker")  #: who gets a signal; a command without workers gets it itself
_SIGNALS = (signal.SIGINT, signal.SIGINT, signal.SIGINT, signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)
_LOOP = """
import orthocas as oc
problem = oc.problems.get("planar_3r_x")
charts = []
for degree in (2, 3, 4):
    charts.append(oc.fit(problem, oc.Polynomial(degree), samples=600).chart)
    oc.fit(problem, oc.Polynomial(degree), samples=600)
print([float(oc.evaluate(chart, 500).task_angle.std) for chart in charts])
"""
_STEPS = {"duration": 1.0, "steps": [{"time": 0.1, "move": {"x": 0.05}}]}
_CONTROLLED = ("--controller", "pd_plus", "--out", "out")
_PATH = "x\n0.85\n0.9\n0.95\n0.9\n0.85\n"
_CHOSEN = ("--xi", "objective", "--velocity-limit", "0.2", "--period", "0.002")
_SMALL_GRID = ("--param", "linear", "--param", "polynomial:2", "--jobs", "2", "--samples", "200")
COMMANDS: dict[str, tuple[str, ...]] = {  #: words after `orthocas`; the loop is a program of a user
    "info": ("info", "planar_3r_x"),
    "fit": ("fit", "planar_3r_x", "--param", "polynomial:4", "--samples", "2000", "--out", "out/c.orthocas", "--json"),
    "evaluate": ("evaluate", "chart.orthocas", "--samples", "20000", "--json"),
    "certify": ("certify", "chart.orthocas", "--out", "out/c.orthocas", "--json"),
    "certify in processes": ("certify", "chart.orthocas", "--out", "out/c.orthocas", "--workers", "2", "--json"),
    "compare": ("compare", "planar_3r_x", *_SMALL_GRID, "--out", "out"),
    "simulate": ("simulate", "chart.orthocas", *_CONTROLLED, "--steps", "steps.json"),
    "follow": ("follow", "chart.orthocas", "path.csv", *_CHOSEN, "--out", "out/q.csv", "--json"),
    "codegen": ("codegen", "chart.orthocas", *_CONTROLLED, "--check"),
    "export": ("export", "chart.orthocas", "--to", "numpy", "--out", "out/arm.py"),
    "solve": ("solve", "chart.orthocas", "--x", "0.9", "--json"),
    "charts": ("charts", "ur5-position", "--out", "out/ur5.orthocas"),
    "doctor": ("doctor", "--json"),
    "demo": ("demo", "--out", "out"),
    "view": ("view", "chart.orthocas", "--export", "out/page.html"),
    "loop": ("-c", _LOOP),
}
_PYTHON_BEGINS = (  # what Python says of Ctrl-C before it reads a line of ours
    "Fatal Python error: init_",
    "Could not import runpy module",
    "Error processing line 1 of",
    "Exception ignored in: <function _get_module_lock",
)
_MEASURED = ("seconds", "fit_seconds", "control_tick_us", "history", "bytes")  # keys of what differs


def campaign(count: int) -> list[Finding]:
    """Stop commands `count` times."""
    return run("signals", judge, range(max(1, count // KILLS)), _SECONDS)


def judge(seed: int) -> str | None:
    """One round: what was wrong first."""
    rng = np.random.default_rng(seed)
    name = list(COMMANDS)[seed % len(COMMANDS)]
    whole, wanted = reference(name)
    with place() as folder:
        for _ in range(KILLS):
            number = _SIGNALS[rng.integers(len(_SIGNALS))]
            moment, whom = rng.uniform(0.02, 1.1) * whole, WHOM[rng.integers(len(WHOM))]
            what = _stopped(folder, name, number, moment, whom, wanted)
            if what is not None:
                return f"{name}, {signal.Signals(number).name} to {whom} after {moment:.2f} of {whole:.2f} s: {what}"
        process = _start(folder, name)
        out, err = process.communicate()
        if process.returncode != 0:
            return f"{name}: the next run gave exit code {process.returncode}: {err.strip()[-200:]}"
        left, found = _drafts(folder), numbers(folder, out)
        return f"{name}: leftovers {left}" if left else _difference(found, wanted)


def _stopped(folder: Path, name: str, number: int, moment: float, whom: str, wanted: dict[str, Any]) -> str | None:
    """Run a command, stop it or one of its workers, and look at what it leaves."""
    process, worker = _start(folder, name), None
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        workers = _workers(process.pid) if whom == "a worker" else []
        worker = workers[0] if workers else None
        together = number in (signal.SIGINT, signal.SIGHUP) and whom == "all its processes"
        with suppress(ProcessLookupError):  # it ended meanwhile
            (os.killpg if together else os.kill)(worker or process.pid, number)
    start = time.monotonic()
    try:
        out, err = process.communicate(timeout=_PATIENCE if worker is None else _SECONDS)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return f"still running {_PATIENCE:g} s later"
    late = time.monotonic() - start
    while (left := _processes(process.pid)) and time.monotonic() - start < _AFTERWARDS + late:
        time.sleep(0.1)
    if left:
        os.killpg(process.pid, signal.SIGKILL)
        return f"processes {left} still run"
    if process.returncode == 0 and (what := _difference(numbers(folder, out), wanted)):
        return f"exit code 0 with {what}"
    if worker is not None:
        return _complaint_of_worker(process.returncode, err) or torn(folder)
    said = None if name == "loop" else _complaint(process.returncode, number, late, err)
    drafts = [] if number == signal.SIGKILL else [name for name in _drafts(folder) if f"-{process.pid}-" in name]
    return said or (f"drafts {drafts} are left" if drafts else torn(folder))


def _complaint(code: int, number: int, late: float, err: str) -> str | None:
    """What is wrong with exit code or words; before and after our handlers the signal, or Python, ends the process."""
    frames = re.findall(r'^  File "(.*?)"', err, flags=re.MULTILINE)
    if err.startswith(_PYTHON_BEGINS) or (frames and all(frame.startswith("<frozen ") for frame in frames)):
        return None
    codes = {0, -number, 128 + number}
    if code not in codes:
        return f"exit code {code}, expected one of {codes}: {err[-300:]}"
    if "Traceback" in err or "Exception ignored" in err or "Error" in err:
        return f"a traceback: {err[-600:]}"
    return f"the signal was lost: the run went on for {late:.1f} s" if code == 0 and late > _LATE else None


def _complaint_of_worker(code: int, err: str) -> str | None:
    """What is wrong with a command of which one worker was stopped: it goes on, and says so in one line at most."""
    lines = [line for line in err.splitlines() if not line.startswith("note: ")]
    return f"exit code {code} with {lines[:5]}" if code != 0 or len(lines) > 1 else None


def _difference(found: dict[str, Any], wanted: dict[str, Any]) -> str | None:
    for key in found.keys() | wanted.keys():
        if found.get(key) != wanted.get(key):
            return f"other numbers in {key}: {str(found.get(key))[:400]}, expected {str(wanted.get(key))[:400]}"
    return None


def _drafts(folder: Path) -> list[str]:
    return [str(path.relative_to(folder)) for path in folder.rglob("*") if path.name.lstrip(".")[:9] == "orthocas-"]


@cache
def reference(name: str) -> tuple[float, dict[str, Any]]:
    """How long a command takes if nobody stops it, and the numbers it gives."""
    with place() as folder:
        for _ in range(2):  # the first run loads libraries from the disk
            start = time.monotonic()
            process = _start(folder, name)
            out, err = process.communicate()
            assert process.returncode == 0, err
        return time.monotonic() - start, numbers(folder, out)


@contextmanager
def place() -> Iterator[Path]:
    """A folder with inputs, an output folder, and one for temporary files."""
    with tempfile.TemporaryDirectory(prefix="signals-") as name:
        folder = Path(name)
        for part in ("out", "tmp"):
            (folder / part).mkdir()
        (folder / "steps.json").write_text(json.dumps(_STEPS))
        (folder / "path.csv").write_text(_PATH)
        shutil.copy(_chart(), folder / "chart.orthocas")
        yield folder


@cache
def _chart() -> Path:
    """A chart of the planar arm, in a folder of the system's that stays until this process ends."""
    keep = tempfile.TemporaryDirectory(prefix="signals-")
    _kept.append(keep)
    path = Path(keep.name) / "chart.orthocas"
    oc.fit(oc.problems.get("planar_3r_x"), oc.Polynomial(4)).chart.save(path)
    return path


_kept: list[tempfile.TemporaryDirectory[str]] = []


def _start(folder: Path, name: str) -> subprocess.Popen[str]:
    """Start a command in a session of its own."""
    _attend_signals()
    environment = os.environ | {"OMP_NUM_THREADS": "1", "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(_ROOT)}
    words = COMMANDS[name] if name == "loop" else ("-m", "orthocas", *COMMANDS[name])
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env=environment,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _attend_signals() -> None:
    """What this process ignores, its children would ignore too."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


def _workers(session: int) -> list[int]:
    """The processes of a session that multiprocessing started to work."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            of_session = (path / "stat").read_text().rpartition(")")[2].split()[3]
            if int(of_session) == session and b"spawn_main" in (path / "cmdline").read_bytes():
                found.append(int(path.name))
        except (OSError, ValueError):
            continue  # it ended meanwhile
    return found


def _processes(session: int) -> list[str]:
    """What still runs in a session, zombies apart."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            command, _, rest = (path / "stat").read_text().rpartition(")")
            state, _, _, of_session = rest.split()[:4]
        except (OSError, ValueError):
            continue  # it ended meanwhile
        if int(of_session) == session and state != "Z":
            found.append(command)
    return found


def numbers(folder: Path, out: str) -> dict[str, Any]:
    """All that a run says and writes as numbers, apart from times."""
    found: dict[str, Any] = {path.name: json.loads(path.read_text()) for path in sorted(folder.glob("out/[!.]*.json"))}
    for path in sorted(folder.glob("out/*.csv")):
        found[path.name] = list(csv.DictReader(io.StringIO(path.read_text())))
    for path in sorted(folder.glob("out/*.[ch]")):
        found[path.name] = path.read_text()
    found["files"] = sorted(path.name for path in folder.glob("out/*"))
    if out.startswith(("{", "[")):
        found["out"] = json.loads(out)
    return dict(clean(_without_times(found)))


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_times(item) for key, item in value.items() if key not in _MEASURED}
    return [_without_times(item) for item in value] if isinstance(value, list) else value


def torn(folder: Path) -> str | None:
    """An output file that cannot be read."""
    for path in folder.rglob("out/**/*"):
        if path.is_file() and "orthocas-" not in str(path.parent.relative_to(folder)):
            try:
                _READERS.get(path.suffix, Path.read_bytes)(path)
            except Exception as error:
                return f"{path.name} is torn: {type(error).__name__}: {str(error)[:200]}"
    return None


def _read_picture(path: Path) -> None:
    with Image.open(path) as picture:
        for k in range(getattr(picture, "n_frames", 1)):
            picture.seek(k)
            picture.load()


def _read_pdf(path: Path) -> None:
    content = path.read_bytes()
    if not (content.startswith(b"%PDF") and content.rstrip().endswith(b"%%EOF")):
        raise ValueError("no whole PDF")


def _read_page(path: Path) -> None:
    if "</html>" not in path.read_text()[-100:]:
        raise ValueError("no whole page")


_READERS: dict[str, Callable[[Path], object]] = {
    ".orthocas": oc.load,
    ".html": _read_page,
    ".npz": Trajectory.load,
    ".json": lambda path: json.loads(path.read_text()),
    ".png": _read_picture,
    ".gif": _read_picture,
    ".pdf": _read_pdf,
    ".stl": trimesh.load_mesh,
}
