"""Generated C in single precision: near the double one, without any double, and as safe with hostile input."""

import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from baselines import Projector
from programs import Run, built, needs_c, nightly, output_of

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, Supervisor, check_c, compile_shared, gain_numbers
from orthocas.codegen.rendering import SINGLE
from orthocas.control import Controller, ControlStatus, Impedance, Kinematic, PDPlus, Safety
from orthocas.errors import AgreementError
from orthocas.fitting.fit import Fit
from orthocas.native.libraries import find_compilers
from orthocas.tools.checks import Array

pytestmark = needs_c

Generated = tuple[GeneratedC, Controller]
LARGEST = f"{np.float32(1e15)!s}f".replace("e+", "e")  # as this version of NumPy writes it
TICK = 1e-3


def compiled(generated: GeneratedC) -> CompiledLibrary:
    path = compile_shared(generated, generated.folder)
    joints = int(re.findall(r"_JOINTS (\d+)", (generated.folder / f"{generated.name}.h").read_text())[0])
    return CompiledLibrary(path, generated.name, joints, generated.single_precision)


@pytest.fixture(scope="module")
def law(planar_for_control: oc.Chart) -> Controller:
    return PDPlus.on_chart(planar_for_control, limit=120.0)


@pytest.fixture(scope="module")
def generated(law: Controller, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    return oc.generate_c(law.chart, tmp_path_factory.mktemp("single"), law, "arm", single_precision=True)


@pytest.fixture(scope="module")
def library(generated: GeneratedC) -> CompiledLibrary:
    return compiled(generated)


@pytest.fixture(scope="module")
def in_double(law: Controller, tmp_path_factory: pytest.TempPathFactory) -> CompiledLibrary:
    return compiled(oc.generate_c(law.chart, tmp_path_factory.mktemp("double"), law, "arm"))


@pytest.mark.parametrize(
    ("double", "single"),
    [
        ("double x = 1.0 / 3.0;", "float x = 1.0f / 3.0f;"),
        ("x=1.0000000000000000e+100; y = 1e100;", f"x={LARGEST}; y = {LARGEST};"),
        ("{0., 3.9033154796640301e-01, 1e-300}", "{0.0f, 0.39033154f, 0.0f}"),
        ("#if __STDC_VERSION__ < 199901L", "#if __STDC_VERSION__ < 199901L"),
        ("a12e5 = kernel_sin(w[10]) + sin(3);", "a12e5 = kernel_sin(w[10]) + sinf(3);"),
        ('/* a double of 1.5 and sin(x) */ "double 1.5"', '/* a double of 1.5 and sin(x) */ "double 1.5"'),
        ("#include <math.h>\n(double)*x++", "#include <math.h>\n(float)*x++"),
    ],
)
def test_code_is_translated_word_by_word(double: str, single: str) -> None:
    assert SINGLE.translate(double) == single


@pytest.mark.slow
def test_every_controller_is_near_its_python(planar_chart: oc.Chart, tmp_path: Path) -> None:
    for law in (
        Impedance(planar_chart, 50.0, limit=90.0),
        PDPlus(planar_chart, 50.0, coupling="decoupled"),
        Kinematic(planar_chart, 1.0, limit=2.0),
        Projector(planar_chart.problem, 80.0, 10.0, limit=90.0),
    ):
        generated = oc.generate_c(planar_chart, tmp_path / law.name, law, "arm", single_precision=True)
        proof = check_c(generated, planar_chart, law, states=300)
        assert max(proof.differences.values()) < 1e-4
        assert proof.differences["mass_matrix"] > 1e-9  # it is in single precision


@pytest.mark.slow
@pytest.mark.parametrize("parametrisation", [oc.Linear(), oc.Fourier(2), oc.MLP((5, 4))], ids=lambda p: p.label)
def test_every_family_is_near_its_python(planar_xy: oc.Problem, parametrisation: Any, tmp_path: Path) -> None:
    fitted = oc.fit(planar_xy, parametrisation, samples=300, seed=1).chart
    weights = np.random.default_rng(1).uniform(-0.5, 0.5, fitted.coordinates.size)  # a fit may have large ones, and
    chart = replace(fitted, coordinates=replace(fitted.coordinates, theta=weights))  # lose digits
    law = PDPlus(chart, 50.0)
    generated = oc.generate_c(chart, tmp_path, law, single_precision=True)
    assert max(check_c(generated, chart, law, states=200).differences.values()) < 1e-4


@pytest.mark.nightly
def test_seven_joints_and_a_pose(iiwa: oc.Problem, tmp_path: Path) -> None:
    box = oc.Box(iiwa.domain.centre, 0.4)  # far from half turns, where orientations lose digits
    pose = oc.Problem(iiwa.robot, oc.Task.pose(iiwa.robot), domain=box, least_singular_value=0.03)
    for k, problem in enumerate((iiwa, pose)):
        chart = oc.fit(problem, oc.Polynomial(2), samples=500).chart
        law = PDPlus.on_chart(chart)
        generated = oc.generate_c(chart, tmp_path / str(k), law, "arm", single_precision=True)
        assert max(check_c(generated, chart, law, states=200).differences.values()) < 1e-4


@pytest.mark.slow
def test_a_wrong_gain_is_found(law: Controller, tmp_path: Path) -> None:
    generated = oc.generate_c(law.chart, tmp_path, law, "arm", single_precision=True)
    source = tmp_path / "arm.c"
    source.write_text(source.read_text().replace("arg[3] = reference->velocity", "arg[3] = reference->value"))
    with pytest.raises(AgreementError, match="control"):
        check_c(generated, law.chart, law, states=100)


@pytest.mark.slow
def test_near_singularities_the_law_gives_up_earlier(tmp_path: Path) -> None:
    """Its errors grow with the inverse square of the volume of the gradients; what it still commands is right."""
    robot = oc.Robot.planar([1, 1, 1], [1, 1, 1])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), "inertia", oc.Box([0.3] * 3, np.pi / 4))
    chart = oc.fit(problem, oc.Polynomial(3)).chart
    law = PDPlus(chart, 50.0)
    generated = oc.generate_c(chart, tmp_path, law, "arm", single_precision=True)
    assert check_c(generated, chart, law).differences["control"] < 1e-3
    library, gains, rest = compiled(generated), gain_numbers(law), np.zeros(3)
    q = np.array([[0.3, angle, angle] for angle in np.geomspace(1e-4, 0.5, 60)])
    found = [library.control(row, rest, np.concatenate([chart.phi(row), np.zeros(6)]), gains)[1] for row in q]
    wanted = [int(law.function(row, rest, chart.phi(row), rest, rest, *law.gains.values())[1]) for row in q]
    singular = [statuses.count(ControlStatus.SINGULAR) for statuses in (found, wanted)]
    assert singular[0] > singular[1] + 3
    assert found[-1] == wanted[-1] == ControlStatus.OK
    assert found == sorted(found, reverse=True)


@pytest.mark.slow
def test_there_is_no_double_in_it(generated: GeneratedC, library: CompiledLibrary) -> None:
    """Neither in its text nor in what the compiler makes of it."""
    for path in generated.folder.glob("*.[hc]"):
        text = path.read_text()
        assert "double" not in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    assert "Numbers: float." in (generated.folder / "arm.h").read_text()
    if shutil.which("objdump") is None:
        pytest.skip("no objdump")
    assembly = output_of("objdump", "-d", library.path)
    assert not re.findall(r"cvtss2sd|cvtsd2ss|cvtsi2sd|(?:mul|add|sub|div)[sp]d\b", assembly)
    unknown = re.findall(r" U (\w+)", output_of("nm", "-D", library.path))
    assert {name.split("@")[0] for name in unknown} <= {"sinf", "cosf", "sincosf", "sqrtf", "powf", "cbrtf"} | {
        *("fmaxf", "fminf", "floorf", "logf", "expf", "sinhf", "coshf", "memset", "memcpy", "__stack_chk_fail"),
    }


@pytest.mark.slow
def test_a_processor_in_single_precision_emulates_nothing(generated: GeneratedC, tmp_path: Path) -> None:
    """For a Cortex-M4F, in assembly: none of the functions of the ARM ABI that emulate double precision."""
    pytest.importorskip("ziglang")
    (tmp_path / "double").mkdir()
    for path in generated.folder.glob("*.[hc]"):
        text = re.sub(r"\bfloat\b", "double", path.read_text())
        (tmp_path / "double" / path.name).write_text(text)
    double = tmp_path / "double" / "arm.c"
    emulated = []
    for source in (generated.folder / "arm.c", double):
        flags = ("-target", "thumb-linux-musleabihf", "-mcpu=cortex_m4+vfp4d16sp", "-std=c99", "-O1", "-S")
        cache = ("env", f"ZIG_GLOBAL_CACHE_DIR={tmp_path}", f"ZIG_LOCAL_CACHE_DIR={tmp_path}")
        output_of(*cache, sys.executable, "-m", "ziglang", "cc", *flags, source, "-o", tmp_path / "arm.s")
        emulated.append(set(re.findall(rb"__aeabi_d\w+|__aeabi_\w+2d", (tmp_path / "arm.s").read_bytes())))
    assert emulated[0] == set()
    assert b"__aeabi_dmul" in emulated[1]


@pytest.mark.slow
def test_bounds_belong_to_the_domain(library: CompiledLibrary, law: Controller) -> None:
    low, high = library.domain
    np.testing.assert_allclose(library.domain, law.problem.domain.bounds, rtol=3e-7)
    for corner in (low, high):
        assert law.problem.domain.contains(corner)
        assert library.chart(corner)[2] == ControlStatus.OK
    assert library.chart(high + 1e-5)[2] == ControlStatus.OUTSIDE_DOMAIN


def test_it_finds_joint_positions_again(library: CompiledLibrary, law: Controller) -> None:
    rng, domain = np.random.default_rng(1), law.problem.domain
    for q in domain.centre + 0.8 * domain.half_width * rng.uniform(-1, 1, (50, 3)):
        found, status = library.inverse(law.chart.phi(q), q + 0.05)
        assert status == ControlStatus.OK
        np.testing.assert_allclose(found, q, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("flags", [(), *nightly((("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),))])
def test_hostile_ticks_stay_bounded_with_the_right_status(
    generated: GeneratedC, pd_plus: tuple[GeneratedC, PDPlus], flags: tuple[str, ...], tmp_path: Path
) -> None:
    """The programs themselves check commands and statuses; by day, sanitizers run over the same code with doubles."""
    options = ("-DNUMBER=float", "-DLIMIT=120.0", "-DSINGULAR=0,0,0")
    gentle = oc.generate_c(pd_plus[1].chart, tmp_path, pd_plus[1], "arm", single_precision=True)
    stateless, supervised = (
        [int(word) for word in output_of(built(case, program, tmp_path, f"-DTICKS={ticks}L", *options, *flags)).split()]
        for case, program, ticks in ((gentle, "random_ticks.c", 50_000), (generated, "supervised_ticks.c", 300_000))
    )
    assert (sum(stateless), sum(supervised)) == (50_000, 300_000)
    for status in ("OK", "OUTSIDE_DOMAIN", "NOT_FINITE", "SATURATED"):
        assert stateless[ControlStatus[status]] > 500, (status, stateless)
    for status in ("OK", "SATURATED", "NEAR_BOUNDARY", "CAUGHT", "RETURNING", "BAD_INPUT"):
        assert supervised[ControlStatus[status]] > 50, (status, supervised)


def moved(supervisor: Supervisor, law: Controller, ticks: int) -> tuple[Array, list[ControlStatus]]:
    """Joint positions of the simulated arm while its reference goes away and comes back."""
    robot, q = law.problem.robot, law.problem.domain.centre.copy()
    home, dq = np.asarray(law.measured(q)).ravel(), np.zeros(3)
    supervisor.start(q)
    path, statuses = [], []
    for k in range(ticks):
        phase = 2 * np.pi * k / ticks
        value = home + 0.05 * (1 - np.cos(phase))
        speed = 0.05 * np.sin(phase) * 2 * np.pi / (ticks * TICK) * np.ones(3)
        command, status = supervisor.step(q, dq, np.concatenate([value, speed, np.zeros(3)]), TICK)
        for _ in range(2):
            dq = dq + TICK / 2 * robot.forward_dynamics(q, dq, command)
            q = q + TICK / 2 * dq
        path.append(q)
        statuses.append(status)
    return np.array(path), statuses


@pytest.mark.slow
def test_the_closed_loop_moves_like_the_double_one(
    library: CompiledLibrary, in_double: CompiledLibrary, law: Controller
) -> None:
    single, statuses = moved(Supervisor(library, law), law, 1500)
    double, wanted = moved(Supervisor(in_double, law), law, 1500)
    assert np.abs(double - double[0]).max() > 0.02
    assert np.abs(single - double).max() < 1e-5
    assert statuses == wanted


@pytest.mark.slow
def test_the_stream_comes_to_rest_and_is_never_stale(library: CompiledLibrary, law: Controller) -> None:
    q = law.problem.domain.centre
    supervisor = Supervisor(library, law, Safety.of(law, stale_ticks=10_000))  # measurements stand still here
    supervisor.start(q)
    reference = np.concatenate([law.chart.phi(q), np.zeros(6)])
    target = reference[:3] + np.array([1e-2, 0.0, -0.1])
    for _ in range(8_000):
        supervisor.stream(reference, target, 3.0, TICK)
        assert supervisor.step(q, np.zeros(3), reference, TICK)[1] is not ControlStatus.BAD_INPUT
    np.testing.assert_allclose(reference[:3], target, atol=1e-4)


@pytest.mark.slow
def test_stack_and_numbers_are_smaller(generated: GeneratedC, law: Controller, tmp_path: Path) -> None:
    double = oc.generate_c(law.chart, tmp_path, law, "arm")
    assert generated.stack_bytes < 0.9 * double.stack_bytes
    (tmp_path / "stack").mkdir()
    program = built(generated, "stack_use.c", tmp_path / "stack", "-DNUMBER=float", "-O2", compiler=find_compilers()[0])
    used = [int(word) for word in output_of(program).split()]
    assert 500 < max(used) <= generated.stack_bytes


def test_constants_of_any_size_compile(planar_x: oc.Problem, tmp_path: Path) -> None:
    given = oc.Given.from_function("odd", 3, lambda q: ca.vertcat(q[0] + 1e-60 * q[1], q[2] - 1e-7 * q[0]))
    chart = oc.fit(planar_x, given).chart
    generated = oc.generate_c(chart, tmp_path, None, "arm", single_precision=True)
    assert check_c(generated, chart, states=50).differences["phi"] < 1e-5


@pytest.mark.slow
def test_command_writes_and_checks_it(planar_fit: Fit, run: Run) -> None:
    planar_fit.chart.save("arm.orthocas")
    words = ("--controller", "pd_plus", "--out", "c", "--name", "arm", "--float", "--check")
    code, out, err = run("codegen", "arm.orthocas", *words)
    assert code == 0, err
    assert re.search(r"largest relative difference \d\.\de-0[567]", out)
    assert "float q[3]" in Path("c/arm.h").read_text()
    assert "float torque[ARM_JOINTS];" in Path("c/README.md").read_text()
