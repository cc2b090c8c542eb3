"""Command lines of real commands and options with wrong values, run in this process."""

import contextlib
import io
import json
import os
import shutil
import sys
import warnings
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from public_objects import circle, fitted, joint_motion

from fuzz.child import Finding, run
from fuzz.robots import text_of, urdf_chain
from fuzz.words import NAMES, NUMBERS, Rng, pick
from orthocas.cli.entry import main

_EXIT_CODES = (0, 1, 2, 130)
_PROBLEMS = ("planar_2r", "planar_3r_x", "planar_3r_xy", "arm.urdf", "chart.orthocas", "grown.orthocas", "nothing.urdf")
_FILES = ("chart.orthocas", "grown.orthocas", "cut.orthocas", "arm.urdf", "steps.json", ".", "nowhere/x", "/dev/null")
_LISTS = ("0", "0.1,0.2,0.3", "1,2", "1,2,3,4,5", ",", "1,,2", "nan,0,0", "1e300,0,0", "0.1;0.2", "-1,-1,-1", "inf")
_WORDS = (
    "linear",
    "polynomial:1",
    "fourier:1",
    "mlp:2x2",
    "sew",
    "given",
    "polynomial:1:cyclic",
    "polynomial:1:cyclic=q1,q9",
    "polynomial:1:=",
    "polynomial:",
    "polynomial:-1",
    "mlp:0x9",
    "mlp:2x2:raw",
    "circle:fourier:1",
    "circle:linear",
    "circle:circle:mlp:2x2",
    ":",
)
_SOLVERS = (
    "gauss_newton",
    "quasi_newton",
    "lbfgs",
    "ipopt",
    "newton",
)  # Adam takes the paper's 10,000 steps, 20 s, for any fit
_OBSTACLES = ("sphere:0,0,5,0.1", "capsule:0,0,5,0,0,6,0.1", "plane:0,0,1,0,0,-5", "plane:0,0,5,0.1")
_LAWS = ("impedance", "pd_plus", "kinematic", "none", "pid")
_COUNTS = ("0", "1", "2", "-1", "20", "99999999999999999999", "1.5", "")
_VALUES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("--tip", "--home"), ("l1", "tip", "nowhere", *NAMES)),
    **dict.fromkeys(("--lock",), ("j1=0", "j1", "=", "j1=nan", "j1=x", "nowhere=1", "l1=0=1", "j1=1e300")),
    **dict.fromkeys(("--tool", "--payload", "--centre", "--half-width", "--weights", "--friction", "--noise"), _LISTS),
    **dict.fromkeys(("--stiffness", "--damping-ratio", "--feedback", "--limit"), _LISTS),
    "--model": ("own", "given", "", "x"),
    "--gravity-compensation": ("law", "robot", "", "9.81"),
    "--inputs": ("payload", "payload,wrench,extra_torque", "payload,payload", ",", "", "mass"),
    **dict.fromkeys(("--bound", "--seconds"), (*NUMBERS, "0.1")),
    "--workers": ("0", "-1", "1", "1.5", "", "tcp:/", "x://"),
    **dict.fromkeys(("--seed", "--seeds", "--samples", "--jobs"), _COUNTS),
    **dict.fromkeys(("--rate", "--mass-factor"), (*NUMBERS, "50", "10")),
    **dict.fromkeys(("--period", "--link-radius", "--clearance"), (*NUMBERS, "0.01")),
    "--collisions": ("arm.urdf", "nothing.urdf", "", "panda", "chart.orthocas"),
    "--srdf": ("arm.srdf", "", "arm.urdf"),
    **dict.fromkeys(("--start", "--velocity-limit"), _LISTS),
    "--obstacle": (
        "",
        "sphere:",
        "cube:1,2,3",
        *_OBSTACLES,
        *(f"sphere:{numbers}" for numbers in _LISTS),
    ),
    "--xi": ("hold", "schedule", "objective", "best", ""),
    **dict.fromkeys(("--leak-deg", "--conditioning"), (*NUMBERS, "5", "0.3")),
    "--domain": ("auto", "box", "branch", "branch:", "branch:whole", "branch:x", "auto:x", ""),
    "--like": ("swivel", "q1", "nothing", ""),
    **dict.fromkeys(("--share", "--margin-deg"), (*NUMBERS, "0.001")),
    **dict.fromkeys(("--splits", "--degree"), _COUNTS),
    "--out": ("out", "out/x/y", ".", "", "chart.orthocas", "/dev/null/x", "x" * 300),
    **dict.fromkeys(("--coupling", "--damping", "--animation"), ("coupled", "square_root", "none", "mp5", "")),
    "--task": ("position:x", "position", "polar", "axis:z", "axis:w", "pose:z", "position:xx", "position+axis", ""),
    "--metric": ("euclidean", "inertia", "identity"),
    "--param": _WORDS,
    **dict.fromkeys(("--corridor",), ("postures.csv", "path.csv", "nothing.csv", "steps.json", "")),
    "--log": ("path.csv", "nothing.csv", "steps.json", ""),
    "--chart": (*_FILES, "grown.orthocas", "cut.orthocas"),
    "--solver": _SOLVERS,
    "--controller": _LAWS,
    "--plant": ("mujoco", "cvodes", "MuJoCo", ""),
    "--steps": _FILES,
    **dict.fromkeys(("--export",), ("page.html", "", ".", "/dev/null/x", "chart.orthocas")),
    "--port": ("0", "-1", "99999", "1.5", "", "203.0.113.7:0", "nowhere:0", "[::2]:0", ":0", "a:b"),
    "--path": _FILES,
    "--robot": ("arm.urdf", "nothing.urdf", "chart.orthocas"),
    "--x": ("0.9", "0.9,0.1", "", "a", "nan", "1e400", "0.9,"),
    "--to": ("numpy", "torch", "jax", "", "tensorflow"),
    "--name": ("arm", "int", "1arm", "a b", "math", "é", "x" * 200, "main"),
}
_KEPT = ("--export",)  # without it, the command serves until Ctrl-C
_PROBLEM_OPTIONS = ("--tip", "--lock", "--tool", "--payload")
_DOMAIN_OPTIONS = ("--task", "--metric", "--centre", "--home", "--half-width")
_AUTO_OPTIONS = ("--domain", "--leak-deg", "--conditioning")
_LAW_OPTIONS = ("--stiffness", "--damping-ratio", "--coupling", "--damping", "--feedback", "--limit")
_RUN_OPTIONS = ("--rate", "--mass-factor", "--friction", "--noise", "--plant")
_SOLIDS = ("--collisions", "--srdf")
_COMMANDS: dict[str, tuple[tuple[str, ...], dict[str, str], tuple[str, ...]]] = {  # targets, options, other options
    "fit": (
        _PROBLEMS,
        {"--param": "polynomial:1", "--samples": "30", "--out": "new.orthocas"},
        (
            *(*_PROBLEM_OPTIONS, *_DOMAIN_OPTIONS, *_AUTO_OPTIONS),
            *("--solver", "--seed", "--weights"),
        ),
    ),
    "fit --domain auto": (
        ("planar_3r_xy", *_PROBLEMS),
        {"--param": "polynomial:1", "--samples": "30", "--out": "new.orthocas"},
        (*_PROBLEM_OPTIONS, "--task", "--metric", "--home", "--leak-deg", "--conditioning", "--seed"),
    ),
    "fit --corridor postures.csv": (
        ("planar_3r_xy", *_PROBLEMS),
        {"--param": "polynomial:1", "--samples": "30", "--out": "new.orthocas"},
        (*_PROBLEM_OPTIONS, *_DOMAIN_OPTIONS, *_AUTO_OPTIONS, "--corridor"),
    ),
    "fit --domain branch": (
        ("planar_3r_xy", *_PROBLEMS),
        {"--param": "polynomial:1", "--samples": "30", "--out": "new.orthocas"},
        (*_PROBLEM_OPTIONS, "--task", "--metric", "--home", "--like", "--weights", "--seed"),
    ),
    "fit --domain branch --like q3 --exact": (
        ("planar_3r_xy", *_PROBLEMS),
        {"--out": "new.orthocas"},
        (*_PROBLEM_OPTIONS, "--task", "--metric", "--home", "--param", "--weights", "--seed"),
    ),
    "info --branches": ((*_PROBLEMS, *_FILES), {}, (*_PROBLEM_OPTIONS, "--task")),
    "certify": (_FILES, {"--seconds": "0.5", "--out": "new.orthocas"}, ("--bound", "--workers")),
    "demo": (("", *_PROBLEMS), {"--out": "out"}, ()),  # takes no word, so this is refused before it fits
    "evaluate": (_FILES, {"--samples": "50"}, _SOLIDS),
    "info": ((*_PROBLEMS, *_FILES), {}, ("--tip", "--lock", *_SOLIDS)),
    "compare": (
        _PROBLEMS,
        {"--param": "polynomial:1", "--samples": "30", "--jobs": "0"},
        ("--solver", "--seeds", "--weights", "--domain", "--out"),
    ),
    "simulate": (
        _FILES,
        {"--controller": "impedance", "--steps": "steps.json", "--out": "out", "--animation": "none"},
        (*_LAW_OPTIONS, *_RUN_OPTIONS, *_SOLIDS),
    ),
    "doctor": (("", "chart.orthocas"), {}, ("--out",)),
    "charts": (("ur5-position", "ur5", "chart.orthocas", ""), {}, ("--out",)),
    "solve": (_FILES, {"--x": "0.9"}, ("--xi", "--start")),
    "export": (_FILES, {"--to": "numpy", "--out": "module.py"}, ()),
    "follow": (
        _FILES,
        {"--out": "q.csv", "--velocity-limit": "1", "--period": "0.05"},
        (
            *("--xi", "--obstacle"),
            *("--link-radius", "--clearance", *_SOLIDS),
        ),
    ),
    "view": (
        (*_FILES, "q.csv"),
        {"--export": "page.html"},
        ("--chart", "--path", "--robot", "--port", "--tip", "--lock", *_SOLIDS),
    ),
    "codegen": (
        _FILES,
        {"--controller": "pd_plus", "--out": "out"},
        (*_LAW_OPTIONS, "--name", "--model", "--gravity-compensation", "--inputs", *_SOLIDS),
    ),
}


def commands(count: int) -> list[Finding]:
    """The campaign."""
    return run("commands", judge, range(count))


def judge(seed: int) -> str | None:
    """Run the command line of a seed in an empty folder."""
    rng = np.random.default_rng(seed)
    words = line(rng)
    with TemporaryDirectory() as folder:
        for path in _files().iterdir():
            shutil.copy(path, folder)
        Path(folder, "arm.urdf").write_bytes(text_of(rng, urdf_chain(rng, 2)))
        os.chdir(folder)
        found = _verdict(words)
        os.chdir("/")
    return None if found is None else f"{words}: {found}"


def line(rng: Rng) -> list[str]:
    """A command with its options, of which up to three have other values, or are missing, or belong elsewhere."""
    command = pick(rng, sorted(_COMMANDS))
    targets, options, others = _COMMANDS[command]
    chosen = dict(options)
    for _ in range(int(rng.integers(4))):
        option = pick(rng, (*options, *others))
        if option in options and _VALUES[option] is not _COUNTS and option not in _KEPT and rng.random() < 0.1:
            chosen.pop(option, None)
        elif option not in ("--jobs",):
            chosen[option] = pick(rng, _VALUES[option])
    target = targets[0] if rng.integers(2) else pick(rng, targets)
    words = [*command.split(), *(word for pair in chosen.items() for word in pair), target]
    if command == "follow":
        words.append(pick(rng, ("path.csv", "path.csv", "steps.json", "chart.orthocas", "nothing.csv")))
    extras = ("--json", "--help", "--", "-x", "--nothing", *NAMES)
    if rng.random() < 0.3:
        words.insert(int(rng.integers(len(words) + 1)), pick(rng, extras))
    return words


@cache
def _files() -> Path:
    """A folder with charts and a plan, whole and damaged, for as long as this process lives."""
    _kept.append(TemporaryDirectory())
    folder = Path(_kept[0].name)
    chart = fitted().chart
    chart.save(folder / "chart.orthocas")
    circle().save(folder / "grown.orthocas")
    (folder / "cut.orthocas").write_bytes((folder / "chart.orthocas").read_bytes()[:500])
    start = [round(float(value), 3) for value in chart.problem.domain.centre]
    steps = [{"time": 0.1, "move": {"x": 0.01}}]
    plan = json.dumps({"start": start, "duration": 0.2, "steps": steps})
    (folder / "steps.json").write_text(plan)
    x = float(chart.x(chart.problem.domain.centre)[0])
    (folder / "postures.csv").write_text("q1,q2,q3\n0,0.6,0.8\n0.1,0.8,0.8\n")
    joint_motion().save_csv(folder / "q.csv")
    (folder / "path.csv").write_text(f"x\n{x}\n{x + 0.02}\n{x}\n")
    return folder


_kept: list[TemporaryDirectory[str]] = []


def _verdict(words: list[str]) -> str | None:
    """What is wrong with how a command line ends."""
    out, err, argv = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["orthocas", *words]
    try:
        closed = len(" ".join(words)) % 8 == 0  # standard output, as after >&-
        with (
            contextlib.redirect_stdout(None if closed else out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            main()
    except SystemExit as stop:
        code = stop.code or 0
    except Exception as error:
        if "daemonic processes" in str(error):  # as this one is: the command has got as far as its workers
            return None
        return f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        sys.argv = argv
    complaints = [row for row in err.getvalue().splitlines() if not row.startswith("note: ")]
    if code not in _EXIT_CODES:
        return f"exit code {code}"
    if len(complaints) != int(code not in (0, 1)):  # 1: all went well, but the proof failed or the run diverged
        return f"exit code {code} with {len(complaints)} lines: {complaints[:3]}"
    if code == 2 and any(name in complaints[0] for name in ("MemoryError", "LinAlgError")):
        return complaints[0][:300]
    shown = "".join((out.getvalue(), err.getvalue()))
    bad = {letter for letter in shown if not letter.isprintable() and letter not in "\n"}
    return f"prints {bad}" if bad else None
