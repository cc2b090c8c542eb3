"""Generated C on a robot: no traps, no state, no heap, bounded stack, free of warnings in every dialect."""

import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from charts import in_a_corridor, linear_on_the_torus
from programs import built, needs_c, path_flags

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, check_c, compile_shared, gain_numbers
from orthocas.codegen.library import STRICT
from orthocas.control import Controller, ControlStatus, PDPlus
from orthocas.errors import CompileError
from orthocas.native.libraries import find_compilers
from orthocas.tasks.corridor import Corridor

pytestmark = [needs_c, pytest.mark.slow]

Generated = tuple[GeneratedC, Controller]


@pytest.fixture(scope="module")
def on_the_torus(tmp_path_factory: pytest.TempPathFactory) -> Generated:
    law = PDPlus(linear_on_the_torus(), 50.0, limit=90.0)
    return oc.generate_c(law.chart, tmp_path_factory.mktemp("torus"), law, "arm"), law


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Generated:
    law = PDPlus(in_a_corridor(), 50.0, limit=90.0)
    return oc.generate_c(law.chart, tmp_path_factory.mktemp("corridor"), law, "arm"), law


#: clang of the package ziglang compiles, and gcc links: linking, zig first builds a C library of its own for 40 s
CLANG = """#!{python}
import subprocess, sys

clang = [sys.executable, "-m", "ziglang", "cc", "-fno-sanitize=undefined", "-Wno-unused-command-line-argument"]
words = sys.argv[1:]
if "-o" not in words:
    sys.exit(subprocess.call([*clang, *words]))
out = words.pop(words.index("-o") + 1)
sources = [word for word in words if word.endswith(".c")]
links = [word for word in words if word == "-shared" or word.startswith("-l")]
options = [word for word in words if word not in [*sources, *links, "-o"]]
objects = [f"{{out}}.{{k}}.o" for k in range(len(sources))]
for source, made in zip(sources, objects):
    if code := subprocess.call([*clang, *options, "-c", source, "-o", made]):
        sys.exit(code)
sys.exit(subprocess.call(["{linker}", *objects, *links, "-pthread", "-o", out]))
"""


@pytest.fixture
def clang(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Clang on the path: the machine's own, or the one that the package ziglang carries."""
    cache = tmp_path_factory.getbasetemp().parent / "zig"  # that other workers use as well
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache))
    monkeypatch.setenv("ZIG_LOCAL_CACHE_DIR", str(cache))
    if shutil.which("clang") is None:
        script = tmp_path / "bin" / "clang"
        script.parent.mkdir()
        script.write_text(CLANG.format(python=sys.executable, linker=find_compilers()[0]))
        script.chmod(0o755)
        monkeypatch.setenv("PATH", str(script.parent), prepend=":")
    return str(shutil.which("clang"))


def random_ticks(case: Generated, ticks: int, out: Path, *flags: str) -> Path:
    generated, law = case
    limit, domain = law.gains["limit"].max(), law.problem.domain
    if isinstance(domain, Corridor):
        flags = (*flags, *path_flags(domain))
    return built(generated, "random_ticks.c", out, f"-DTICKS={ticks}L", f"-DLIMIT={limit}", "-DSINGULAR=0,0,0", *flags)


@pytest.mark.parametrize(("case", "ticks"), [("pd_plus", 100_000), ("on_the_torus", 50_000), ("corridor", 50_000)])
def test_random_ticks_under_sanitizers_never_trap(
    case: str, ticks: int, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Address and undefined-behaviour sanitizers; the program itself checks statuses, finiteness and the limit."""
    flags = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = random_ticks(request.getfixturevalue(case), ticks, tmp_path, *flags)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.returncode}: {done.stderr}"
    well, outside, singular, not_finite, cut = (int(word) for word in done.stdout.split())
    assert well + outside + singular + not_finite + cut == ticks
    assert cut > 0.01 * ticks
    assert not_finite > 0.05 * ticks
    assert well + cut > 0.1 * ticks
    if case == "on_the_torus":
        assert outside == 0
        assert singular > 0.05 * ticks
    else:
        assert outside > 0.1 * ticks


def test_inverse_may_write_on_its_inputs(pd_plus: Generated, tmp_path: Path) -> None:
    program = built(pd_plus[0], "in_place.c", tmp_path, "-O2")
    assert subprocess.run([str(program)], check=False).returncode == 0


def test_compilers_that_remove_tests_for_nan_are_refused(pd_plus: Generated, tmp_path: Path) -> None:
    for flag in ("-ffast-math", "-Ofast", "-ffinite-math-only"):
        with pytest.raises(CompileError, match="which remove the tests for NaN"):
            compile_shared(pd_plus[0], tmp_path, (flag,))


def test_speeds_that_overflow_give_zeros(tmp_path: Path) -> None:
    """inf - inf in q q dq^2 of crossed slides."""
    axes, zero = ("RZ", "PX", "PY"), pin.SE3.Identity()
    model, joint = pin.Model(), 0
    for axis in axes:
        joint = model.addJoint(joint, getattr(pin, f"JointModel{axis}")(), zero, axis)
        model.appendBodyToJoint(joint, pin.Inertia(2.0, np.array([0.1, 0.2, 0.3]), np.eye(3)), zero)
    model.addFrame(pin.Frame("tip", joint, pin.SE3(np.eye(3), np.array([0.3, 0.1, 0])), pin.FrameType.OP_FRAME))
    robot = oc.Robot.from_model(model, "tip")
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), "inertia", oc.Box([0.5, 0.5, 0.5], 0.2))
    generated = oc.generate_c(oc.fit(problem, oc.Linear()).chart, tmp_path, None, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3)
    with np.errstate(all="ignore"):
        assert not np.isfinite(robot.bias(np.full(3, 1e90), np.full(3, 1e90))).all()
    *values, status = library.dynamics(np.full(3, 1e90), np.full(3, 1e90))
    assert status == ControlStatus.NOT_FINITE
    assert not any(value.any() for value in values)
    assert "1 PX [m]: " in (tmp_path / "arm.h").read_text()


def test_valgrind_finds_nothing(pd_plus: Generated, tmp_path: Path) -> None:
    if shutil.which("valgrind") is None:
        pytest.skip("no valgrind")
    program = random_ticks(pd_plus, 5_000, tmp_path)
    command = ["valgrind", "--error-exitcode=9", "--leak-check=full", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.nightly
def test_calls_take_no_more_stack_than_the_header_says(arm_chart: oc.Chart, clang: str, tmp_path: Path) -> None:
    """Measured on a painted stack, for what needs most, by gcc without optimisation and clang with it."""
    solver = oc.solvers.LBFGS(max_iterations=1)
    network = oc.fit(arm_chart.problem, oc.MLP((16, 12)), samples=50, solver=solver).chart
    gcc, clang_2 = (find_compilers()[0], "-O0"), (clang, "-O2")
    for law, ways in ((PDPlus(arm_chart, 50.0), (gcc, clang_2)), (PDPlus(network, 50.0), (gcc,))):
        generated = oc.generate_c(law.chart, tmp_path, law, "arm")
        for compiler, flag in ways:
            program = built(generated, "stack_use.c", tmp_path, flag, compiler=compiler)
            printed = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
            used = [int(word) for word in printed.split()]
            assert len(used) == 5
            assert 1000 < max(used) <= generated.stack_bytes


def test_object_holds_no_state_and_calls_only_mathematics(pd_plus: Generated, tmp_path: Path) -> None:
    """Symbols of the object file: functions and read-only data; undefined ones are of math.h, or copy memory."""
    generated, _ = pd_plus
    source = generated.folder / "arm.c"
    # With independent positions, loaders write addresses into constants, and nm counts these as data.
    command = [find_compilers()[0], "-std=c99", "-O1", "-fno-pie", "-c", str(source), "-o", str(tmp_path / "arm.o")]
    subprocess.run(command, check=True)
    if shutil.which("nm") is None:
        pytest.skip("no nm")
    symbols = subprocess.run(["nm", str(tmp_path / "arm.o")], capture_output=True, text=True, check=True).stdout
    rows = [line.split()[-2:] for line in symbols.splitlines()]
    assert {kind for kind, _ in rows} <= {"T", "t", "R", "r", "U"}
    public = {name for kind, name in rows if kind in "TR"}
    functions, tables = (
        ["chart", "chart_curvature", "check", "inverse", "nearest", "dynamics", "link_positions", "control"],
        ["default_gains", "domain_lower", "domain_upper"],
    )
    functions += ["check_start", "start", "take_over", "resume", "step", "hold", "release"]
    functions += [f"reference_{name}" for name in ("at", "stream", "spline", "pace")]
    tables += ["default_safety"]
    assert public == {f"arm_{name}" for name in (*functions, *tables)}
    known = {"sin", "cos", "sincos", "sqrt", "cbrt", "fmax", "fmin", "memset", "memcpy"}
    known |= {"floor", "exp", "log"}
    assert {name for kind, name in rows if kind == "U"} <= known | {"_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}


def test_two_threads_get_what_one_gets(pd_plus: Generated, tmp_path: Path) -> None:
    generated, law = pd_plus
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3)
    rng, gains = np.random.default_rng(4), gain_numbers(law)
    states = [
        (law.problem.domain.centre + 0.3 * rng.normal(size=3), *rng.normal(size=(1, 3)), rng.normal(size=9))
        for _ in range(2000)
    ]
    alone = [library.control(*state, gains) for state in states]
    together: list[list[tuple[np.ndarray, int]]] = [[], []]

    def work(k: int) -> None:
        together[k] += [library.control(*state, gains) for state in states]

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for results in together:
        for (command, status), (want, want_status) in zip(results, alone, strict=True):
            assert status == want_status
            np.testing.assert_array_equal(command, want)


def test_clang_accepts_it_and_computes_the_same(planar_chart: oc.Chart, clang: str, tmp_path: Path) -> None:
    law = PDPlus(planar_chart, 50.0, coupling="decoupled")
    proof = check_c(oc.generate_c(planar_chart, tmp_path, law, "arm"), planar_chart, law)
    assert "clang" in proof.compilers
    assert len(proof.compilers) == len(find_compilers())
    done = subprocess.run([clang, "--version"], capture_output=True, text=True, check=True)
    assert "clang version" in done.stdout


def test_every_dialect_accepts_it(pd_plus: Generated, tmp_path: Path) -> None:
    """C99 and later, GNU's too; with more warnings than promised; the header in C++."""
    generated, _ = pd_plus
    source, compiler = generated.folder / "arm.c", find_compilers()[0]
    more = ["-Wshadow", "-Wconversion", "-Wcast-qual", "-Wstrict-prototypes"]
    whole = ["-O2", "-c", "-o", str(tmp_path / "arm.o")]
    for dialect in ("c99", "gnu99", "c11", "gnu17"):
        target = whole if dialect == "c99" else ["-fsyntax-only"]  # a dialect matters to the parser only
        command = [compiler, *STRICT, f"-std={dialect}", *more, *target, str(source)]
        assert subprocess.run(command, capture_output=True, text=True, check=False).stderr == "", dialect
    if shutil.which("c++") is None:
        pytest.skip("no C++ compiler")
    program = tmp_path / "main.cpp"
    program.write_text(
        '#include "arm.h"\nint main() { double q[3] = {0}, phi[3], J[9]; return arm_chart(q, phi, J); }\n'
    )
    command = ["c++", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{generated.folder}", str(program)]
    done = subprocess.run([*command, str(tmp_path / "arm.o"), "-o", str(tmp_path / "a"), "-lm"], check=False)
    assert done.returncode == 0
    assert subprocess.run([str(tmp_path / "a")], check=False).returncode == 1  # q = 0 lies outside the domain
