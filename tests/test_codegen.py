"""Generated C: equal to Python, free of warnings, state, heap and traps, and refused where it cannot be right."""

import json
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import orthocas as oc
from orthocas.cli import main
from orthocas.codegen import CompiledLibrary, GeneratedC, check_c, compile_shared, gain_numbers
from orthocas.codegen.library import compiler
from orthocas.control import Controller, Impedance, Kinematic, KinematicProjector, PDPlus, Projector
from orthocas.errors import CompileError, InvalidValueError, NoExpressionError, ProofError

pytestmark = pytest.mark.skipif(shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler")

Generated = tuple[GeneratedC, Controller]
_FUZZ = r"""
/* Random ticks inside and outside the domain, with NaN, infinity and huge numbers among them. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include "NAME.h"

static uint64_t seed = 88172645463325252ULL;
static double uniform(void) { /* -1 to 1 */
  seed ^= seed << 13; seed ^= seed >> 7; seed ^= seed << 17;
  return (double)(seed >> 11) / 4503599627370496.0 - 1.0;
}
static void fill(double *x, int count, double centre, double width) {
  int i;
  for (i = 0; i < count; ++i) x[i] = centre + width * uniform();
}
static void spoil(double *x, int count) {
  static const double bad[] = {NAN, INFINITY, -INFINITY, 1e300, -1e150, 5e-324};
  if (uniform() > 0.9) x[(int)((uniform() + 1.0) * 0.4999 * count)] = bad[(int)((uniform() + 1.0) * 2.999)];
}
int main(void) {
  long k, counts[4] = {0, 0, 0, 0};
  double limit = LIMIT;
  for (k = 0; k < TICKS; ++k) {
    double q[N], dq[N], command[N], phi[N], jacobian[N * N], solution[N];
    NAME_reference reference;
    NAME_gains gains = NAME_default_gains;
    int i, status, finite = 1;
    for (i = 0; i < N; ++i) q[i] = 0.7 + 0.6 * uniform();
    fill(dq, N, 0.0, uniform() > 0.9 ? 1e6 : 2.0);
    fill((double *)&reference, 3 * KK, 0.3, 1.0);
    spoil(q, N); spoil(dq, N); spoil((double *)&reference, 3 * KK);
    if (uniform() > 0.95) spoil((double *)&gains, (int)(sizeof gains / sizeof(double)) - N);
    status = NAME_control(q, dq, &reference, &gains, command);
    if (status < 0 || status > 3) return 1;
    counts[status]++;
    for (i = 0; i < N; ++i)
      if (!isfinite(command[i]) || fabs(command[i]) > limit) return 2;
    if (k % 16 == 0) {
      NAME_chart(q, phi, jacobian);
      status = NAME_inverse(phi, q, solution);
      for (i = 0; i < N; ++i) finite = finite && isfinite(phi[i]) && isfinite(solution[i]);
      for (i = 0; i < N * N; ++i) finite = finite && isfinite(jacobian[i]);
      NAME_dynamics(q, dq, jacobian, phi, solution);
      for (i = 0; i < N; ++i) finite = finite && isfinite(phi[i]) && isfinite(solution[i]);
      if (!finite) return 3;
    }
  }
  printf("%ld %ld %ld %ld\n", counts[0], counts[1], counts[2], counts[3]);
  return 0;
}
"""


def laws(chart: oc.Chart) -> list[Controller]:
    return [
        Impedance(chart, 50.0, limit=90.0),
        PDPlus(chart, np.linspace(20, 80, chart.n), 0.6, "decoupled", limit=90.0),
        PDPlus(chart, 50.0, damping="double_diagonal"),
        Kinematic(chart, 1.0, limit=2.0),
        Projector(chart.problem, 80.0, 10.0, limit=90.0),
        KinematicProjector(chart.problem, 1.0, 0.5),
    ]


@pytest.fixture(scope="module")
def pd_plus(planar_chart: oc.Chart, tmp_path_factory: pytest.TempPathFactory) -> Generated:
    law = laws(planar_chart)[1]
    return oc.generate_c(planar_chart, tmp_path_factory.mktemp("c"), law, "arm"), law


def test_every_controller_equals_its_python(planar_chart: oc.Chart, tmp_path: Path) -> None:
    """Also NaN, infinities and huge numbers: same status, same fallback."""
    for law in (*laws(planar_chart), None):
        generated = oc.generate_c(planar_chart, tmp_path, law)
        proof = check_c(generated, planar_chart, law, states=300)
        assert set(proof.differences) >= {"phi", "jacobian", "mass_matrix", "bias", "gravity", "inverse"}
        assert ("control" in proof.differences) == (law is not None)
        assert proof.differences["jacobian"] < 1e-13
        assert generated.stack_bytes < 20_000


@pytest.mark.parametrize("parametrisation", [oc.Linear(), oc.Fourier(2), oc.MLP((5, 4))], ids=lambda p: p.label)
def test_every_family_equals_its_python(planar_xy: oc.Problem, parametrisation: Any, tmp_path: Path) -> None:
    chart = oc.fit(planar_xy, parametrisation, samples=300).chart
    law = PDPlus(chart, 50.0)
    assert check_c(oc.generate_c(chart, tmp_path, law), chart, law, states=200).differences["control"] < 1e-10


def test_seven_joints_with_an_idle_one(iiwa: oc.Problem, tmp_path: Path) -> None:
    chart = oc.fit(iiwa, oc.Polynomial(2)).chart
    law = PDPlus(chart, 50.0, coupling="decoupled")
    assert check_c(oc.generate_c(chart, tmp_path, law), chart, law, states=200).differences["control"] < 1e-10


def test_chart_on_the_torus_has_no_outside(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1, 1, 1], [3, 3, 3])
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), "inertia", oc.Torus(3))
    chart = oc.fit(problem, oc.Linear(base=(0.6, 0.8, 0.8))).chart
    generated = oc.generate_c(chart, tmp_path, None, "free_arm")
    check_c(generated, chart, None, states=200)
    library = CompiledLibrary(compile_shared(generated, tmp_path), "free_arm", 3)
    assert library.chart(np.array([40.0, 0.3, 0.2]))[2] == 0
    assert "all joint positions" in (tmp_path / "free_arm.h").read_text()


def test_object_holds_no_state_and_calls_only_mathematics(pd_plus: Generated, tmp_path: Path) -> None:
    """Symbols of the object file: functions and read-only data; undefined ones are of math.h, or copy memory."""
    generated, _ = pd_plus
    source = generated.folder / "arm.c"
    subprocess.run([compiler(), "-std=c99", "-O1", "-c", str(source), "-o", str(tmp_path / "arm.o")], check=True)
    if shutil.which("nm") is None:
        pytest.skip("no nm")
    symbols = subprocess.run(["nm", str(tmp_path / "arm.o")], capture_output=True, text=True, check=True).stdout
    rows = [line.split()[-2:] for line in symbols.splitlines()]
    assert {kind for kind, _ in rows} <= {"T", "t", "R", "r", "U"}
    public = {name for kind, name in rows if kind in "TR"}
    functions, tables = ("chart", "inverse", "dynamics", "control"), ("default_gains", "domain_lower", "domain_upper")
    assert public == {f"arm_{name}" for name in (*functions, *tables)}
    known = {"sin", "cos", "sincos", "sqrt", "pow", "cbrt", "fmax", "fmin", "memset", "memcpy"}
    assert {name for kind, name in rows if kind == "U"} <= known | {"_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}


def random_ticks(generated: GeneratedC, law: Controller, ticks: int, folder: Path, *flags: str) -> Path:
    """The program of `_FUZZ`, compiled."""
    text = _FUZZ
    words = {"NAME": "arm", "TICKS": f"{ticks}L", "LIMIT": "90.0", "KK": str(len(law.labels)), "N": str(law.problem.n)}
    for word, value in words.items():
        text = re.sub(rf"\b{word}(?=\b|_)", value, text)
    (folder / "fuzz.c").write_text(text)
    sources = [str(folder / "fuzz.c"), str(generated.folder / "arm.c")]
    command = [
        compiler(),
        "-std=c99",
        "-O1",
        "-g",
        *flags,
        f"-I{generated.folder}",
        "-o",
        str(folder / "fuzz"),
        *sources,
    ]
    built = subprocess.run([*command, "-lm"], capture_output=True, text=True, check=False)
    if built.returncode != 0 and "cannot find" in built.stderr:
        pytest.skip("no sanitizer libraries")
    assert built.returncode == 0, built.stderr
    return folder / "fuzz"


def test_a_million_random_ticks_under_sanitizers_never_trap(pd_plus: Generated, tmp_path: Path) -> None:
    """Address and undefined-behaviour sanitizers; the program itself checks statuses, finiteness and the limit."""
    program = random_ticks(*pd_plus, 1_000_000, tmp_path, "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    counts = [int(word) for word in done.stdout.split()]
    assert sum(counts) == 1_000_000
    assert counts[0] > 100_000  # within the domain
    assert counts[1] > 100_000  # outside
    assert counts[3] > 50_000  # not finite


def test_valgrind_finds_nothing(pd_plus: Generated, tmp_path: Path) -> None:
    if shutil.which("valgrind") is None:
        pytest.skip("no valgrind")
    program = random_ticks(*pd_plus, 20_000, tmp_path)
    command = ["valgrind", "--error-exitcode=9", "--leak-check=full", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


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


def test_cmake_builds_and_installs_both_libraries(pd_plus: Generated, tmp_path: Path) -> None:
    if shutil.which("cmake") is None:
        pytest.skip("no cmake")
    generated, _ = pd_plus
    build, place = tmp_path / "build", tmp_path / "installed"
    steps = (
        ["cmake", "-S", str(generated.folder), "-B", str(build), f"-DCMAKE_INSTALL_PREFIX={place}"],
        ["cmake", "--build", str(build)],
        ["cmake", "--install", str(build)],
    )
    for step in steps:
        done = subprocess.run(step, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert (place / "include" / "arm.h").exists()
    assert len(list(place.rglob("libarm.a"))) == 1
    assert list(place.rglob("libarm.so")) or list(place.rglob("libarm.dylib"))
    (package,) = place.rglob("arm.pc")
    assert f"prefix={place}" in package.read_text()
    assert "-larm" in package.read_text()


def test_check_finds_what_is_wrong(planar_chart: oc.Chart, tmp_path: Path) -> None:
    law = laws(planar_chart)[0]
    generated = oc.generate_c(planar_chart, tmp_path, law, "arm")
    with pytest.raises(ProofError, match="default gains"):
        check_c(generated, planar_chart, Impedance(planar_chart, 51.0, limit=90.0), states=50)
    source = tmp_path / "arm.c"
    text = source.read_text()
    source.write_text(text.replace("reference->value", "reference->velocity"))
    with pytest.raises(ProofError, match="C differs from Python by control"):
        check_c(generated, planar_chart, law, states=50)
    source.write_text(text.replace("return inside(q)", "return 7 +"))
    with pytest.raises(CompileError, match="failed"):
        check_c(generated, planar_chart, law, states=50)


def test_header_tells_what_a_user_needs(pd_plus: Generated, planar_x: oc.Problem) -> None:
    generated, law = pd_plus
    header = (generated.folder / "arm.h").read_text()
    for name in planar_x.robot.joint_names:
        assert re.search(rf"\d {name}\n", header)
    assert "x, xi1, xi2" in header
    assert f"{generated.stack_bytes} bytes" in header
    assert "#define ARM_JOINTS 3" in header
    assert "arm_status arm_control(const double q[3]" in header
    assert "double stiffness[3];" in header
    assert "$" not in header
    readme = (generated.folder / "README.md").read_text()
    assert "arm_control" in readme
    assert "| `stiffness` | 20.0, 50.0, 80.0 |" in readme
    assert law.name in readme


def test_what_cannot_be_generated_is_refused(planar_x: oc.Problem, planar_chart: oc.Chart, tmp_path: Path) -> None:
    with pytest.raises(NoExpressionError, match="distil"):
        oc.generate_c(oc.grow(planar_x, leaf="linear"), tmp_path / "new")
    for name in ("2arm", "my arm", "", "größe"):
        with pytest.raises(InvalidValueError, match="a C identifier"):
            oc.generate_c(planar_chart, tmp_path / "new", None, name)
    other = oc.problems.get("planar_3r_x")
    with pytest.raises(InvalidValueError, match="one of another robot"):
        oc.generate_c(planar_chart, tmp_path / "new", Projector(other, 1.0, 1.0))
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidValueError, match="expected a folder"):
        oc.generate_c(planar_chart, tmp_path / "file")
    assert not (tmp_path / "new").exists()


def test_command_writes_checks_and_refuses(
    planar_chart: oc.Chart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    planar_chart.save(tmp_path / "arm.orthocas")

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["orthocas", "codegen", str(tmp_path / "arm.orthocas"), *words])
        with pytest.raises(SystemExit) as stopped:
            main()
        return int(stopped.value.code or 0), *capsys.readouterr()

    code, out, err = run("--controller", "kinematic", "--out", str(tmp_path / "c"), "--check", "--json")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["checked_states"] == 1000
    assert max(report["relative_differences"].values()) < 1e-10
    assert Path(report["source"]).exists()
    code, out, _ = run("--controller", "none", "--out", str(tmp_path / "c"), "--name", "arm")
    assert code == 0
    assert "lines of C99" in out
    for words, message in (
        (["--controller", "none", "--limit", "3"], "a controller, for options that belong to one"),
        (["--controller", "kinematic", "--stiffness", "3"], "no such option with kinematic"),
        (["--controller", "spring"], "unknown controller 'spring'"),
        (["--controller", "pd_plus", "--name", "a b"], "a C identifier"),
    ):
        code, _, err = run(*words, "--out", str(tmp_path / "other"))
        assert code == 2
        assert message in err
        assert not (tmp_path / "other").exists()
