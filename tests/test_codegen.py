"""Generated C: equal to Python, told in its header, and refused where it cannot be right."""

import dataclasses
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from charts import linear_on_the_torus
from conftest import ROBOTS, arm, pinocchio_position
from programs import Run, needs_c, needs_cmake, output_of

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, check_c, compile_shared, gain_numbers
from orthocas.codegen.library import STRICT, compilers
from orthocas.control import Controller, Impedance, Kinematic, KinematicProjector, PDPlus, Projector
from orthocas.domains import sample_uniform
from orthocas.errors import CompileError, InvalidValueError, NoExpressionError, ProofError, one_line
from orthocas.fitting.fit import Fit

pytestmark = needs_c

Generated = tuple[GeneratedC, Controller]


def laws(chart: oc.Chart) -> list[Controller]:
    return [
        Impedance(chart, 50.0, limit=90.0),
        PDPlus(chart, np.linspace(20, 80, chart.n), 0.6, "decoupled", limit=90.0),
        PDPlus(chart, 50.0, damping="double_diagonal"),
        Kinematic(chart, 1.0, limit=2.0),
        Projector(chart.problem, 80.0, 10.0, limit=90.0),
        KinematicProjector(chart.problem, 1.0, 0.5),
    ]


@pytest.mark.slow
def test_every_controller_equals_its_python(planar_chart: oc.Chart, tmp_path: Path) -> None:
    """Also NaN, infinities and huge numbers: same status, same fallback."""
    for law in (*laws(planar_chart), None):
        generated = oc.generate_c(planar_chart, tmp_path / law.name if law else tmp_path / "none", law)
        proof = check_c(generated, planar_chart, law, states=300)
        assert set(proof.differences) >= {"phi", "jacobian", "mass_matrix", "bias", "gravity", "inverse"}
        assert ("control" in proof.differences) == (law is not None)
        assert proof.differences["jacobian"] < 1e-13
        assert generated.stack_bytes < 20_000


@needs_c
def test_law_of_a_weak_arm_is_compared_beyond_its_limits(planar_chart: oc.Chart, tmp_path: Path) -> None:
    """At random states and default gains its limit cuts every command."""
    law = PDPlus(planar_chart, 50.0, limit=[0.1, 0.1, 0.1])
    assert (
        check_c(oc.generate_c(planar_chart, tmp_path, law), planar_chart, law, states=100).differences["control"]
        < 1e-10
    )


@pytest.mark.parametrize("parametrisation", [oc.Linear(), oc.Fourier(2), oc.MLP((5, 4))], ids=lambda p: p.label)
def test_every_family_equals_its_python(planar_xy: oc.Problem, parametrisation: Any, tmp_path: Path) -> None:
    chart = oc.fit(planar_xy, parametrisation, samples=300).chart
    law = PDPlus(chart, 50.0)
    assert check_c(oc.generate_c(chart, tmp_path, law), chart, law, states=200).differences["control"] < 1e-10


@pytest.mark.slow
def test_seven_joints_with_an_idle_one(iiwa: oc.Problem, tmp_path: Path) -> None:
    chart = oc.fit(iiwa, oc.Polynomial(2)).chart
    law = PDPlus(chart, 50.0, coupling="decoupled")
    assert check_c(oc.generate_c(chart, tmp_path, law), chart, law, states=200).differences["control"] < 1e-10


def test_chart_on_the_torus_has_no_outside(tmp_path: Path) -> None:
    chart = linear_on_the_torus()
    generated = oc.generate_c(chart, tmp_path, None, "free_arm")
    check_c(generated, chart, None, states=200)
    library = CompiledLibrary(compile_shared(generated, tmp_path), "free_arm", 3)
    assert library.chart(np.array([40.0, 0.3, 0.2]))[2] == 0
    assert "all joint positions" in (tmp_path / "free_arm.h").read_text()


_CONSUMER = """
cmake_minimum_required(VERSION 3.16)
project(consumer LANGUAGES C)
find_package(arm 0.1 REQUIRED)
add_executable(consumer main.c)
target_link_libraries(consumer PRIVATE arm::shared)
"""
_MAIN = """
#include <arm.h>
int main(void) {
  double q[3] = {0.6, 0.8, 0.8}, phi[3], J[9];
  return (int)arm_chart(q, phi, J);
}
"""


@pytest.mark.slow
@needs_cmake
def test_installed_libraries_are_found_and_linked(pd_plus: Generated, tmp_path: Path) -> None:
    """By CMake and pkg-config, from a folder with a space, after it has been moved."""
    first, place, project = tmp_path / "first place", tmp_path / "second place", tmp_path / "consumer"
    output_of("cmake", "-S", pd_plus[0].folder, "-B", tmp_path / "build")
    output_of("cmake", "--build", tmp_path / "build")
    output_of("cmake", "--install", tmp_path / "build", "--prefix", first)
    first.rename(place)
    assert len(list(place.rglob("libarm.a"))) == 1
    assert (place / "include" / "arm.h").exists()
    project.mkdir()
    (project / "CMakeLists.txt").write_text(_CONSUMER)
    (project / "main.c").write_text(_MAIN)
    output_of("cmake", "-S", project, "-B", project / "build", f"-DCMAKE_PREFIX_PATH={place}")
    output_of("cmake", "--build", project / "build")
    output_of(project / "build" / "consumer")
    if shutil.which("pkg-config") is None:
        return
    (package,) = place.rglob("arm.pc")
    flags = output_of("env", f"PKG_CONFIG_PATH={package.parent}", "pkg-config", "--cflags", "--libs", "arm")
    program, library = project / "by_package", package.parent.parent
    output_of(compilers()[0], project / "main.c", "-o", program, *shlex.split(flags), f"-Wl,-rpath,{library}")
    output_of(program)


@pytest.mark.slow
@needs_cmake
def test_as_a_part_of_another_project_nothing_is_installed(pd_plus: Generated, tmp_path: Path) -> None:
    (tmp_path / "main.c").write_text(_MAIN)
    text = _CONSUMER.replace("find_package(arm 0.1 REQUIRED)", f'add_subdirectory("{pd_plus[0].folder}" arm)')
    (tmp_path / "CMakeLists.txt").write_text(text.replace("arm::shared", "arm::static"))
    output_of("cmake", "-S", tmp_path, "-B", tmp_path / "build")
    output_of("cmake", "--build", tmp_path / "build")
    output_of(tmp_path / "build" / "consumer")
    output_of("cmake", "--install", tmp_path / "build", "--prefix", tmp_path / "installed")
    assert not list((tmp_path / "installed").rglob("*arm*"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("gains->stiffness", "gains->damping_ratio", "control"),
        ("return inside(q)", "return 7 +", "failed"),
        ("return inside(q) ?", "return inside(q) + 1 ?", "the status of chart"),
        ("if (!(fabs(x[i]) <= bound)) return 0;", "(void)x, (void)bound;", "the status of chart is . at"),
        ("arm_domain_upper[N] = {", "arm_domain_upper[N] = {1e-3 + ", "the domain in C"),
        ("memcpy(q, now, sizeof now);", "", "inverse"),
        ("(error >= 0.0 && error <= SOLVED)", "(error < 1e300)", "in inverse"),
        ("arg[7] = gains->limit;", "arg[7] = arm_default_gains.limit;", "control"),
        ("arg[5] = gains->stiffness;", "arg[5] = arm_default_gains.stiffness;", "control"),
        ("res[1] = bias;", "res[1] = gravity;", "in (bias|gravity)"),
    ],
)
def test_check_finds_what_is_wrong(planar_chart: oc.Chart, tmp_path: Path, old: str, new: str, message: str) -> None:
    law = laws(planar_chart)[0]
    generated = oc.generate_c(planar_chart, tmp_path, law, "arm")
    source = tmp_path / "arm.c"
    text = source.read_text()
    assert old in text
    source.write_text(text.replace(old, new))
    with pytest.raises((ProofError, CompileError), match=message):
        check_c(generated, planar_chart, law, states=100)


def test_check_compares_with_the_gains_of_the_controller(planar_chart: oc.Chart, tmp_path: Path) -> None:
    generated = oc.generate_c(planar_chart, tmp_path, laws(planar_chart)[0], "arm")
    with pytest.raises(ProofError, match="default gains"):
        check_c(generated, planar_chart, Impedance(planar_chart, 51.0, limit=90.0), states=50)


@pytest.mark.slow
def test_coordinates_without_a_value_everywhere(planar_x: oc.Problem, tmp_path: Path) -> None:
    """NaN in Python is a status and zeros in C; branches with infinities are code like any other."""
    for k, expression in enumerate((lambda q: ca.sqrt(q[1] - 0.4), lambda q: ca.if_else(q[1] > 0.4, q[1], ca.inf))):
        given = oc.Given.from_function("partial", 3, lambda q, f=expression: ca.vertcat(f(q) + q[0], q[2] - q[0]))
        chart = oc.fit(planar_x, given).chart
        generated = oc.generate_c(chart, tmp_path / str(k), None, f"arm{k}")
        check_c(generated, chart, None, states=300)
        library = CompiledLibrary(compile_shared(generated, tmp_path), f"arm{k}", 3)
        phi, _, status = library.chart(np.array([0.6, 0.39, 0.8]))
        assert status == 2
        assert not phi.any()


def test_words_of_others_do_not_become_code(tmp_path: Path) -> None:
    evil = "a */ int evil; /* @x@ b /* ω"
    robot = oc.Robot.planar([1, 1, 1], [3, 3, 3])
    task = oc.Task.custom(robot, "custom", lambda q: ca.vertcat(ca.sin(q[0]) + q[1]), ["p*/"])
    problem = oc.Problem(robot, task, "inertia", oc.Box([0.5, 0.5, 0.5], 0.2), evil)
    chart = oc.fit(problem, oc.Linear()).chart
    generated = oc.generate_c(chart, tmp_path, None, "arm")
    check_c(generated, chart, None, states=100)
    assert "evil" not in output_of(compilers()[0], "-E", "-P", tmp_path / "arm.c").replace("evil_", "")
    assert re.fullmatch(r"[a-z]\w*", oc.generate_c(chart, tmp_path / "unnamed").name, flags=re.ASCII)


HOSTILE = (
    "int",
    'quo"te',
    "it's",
    "end\\",
    "??/",
    "a??/\nint evil;",
    "\u202egnp\u2066",
    "*/ int evil; /*",
    "//",
    "%s$n@N@",
    "\x1b[2J",
)


def test_names_from_robot_files_stay_in_comments(tmp_path: Path) -> None:
    """Keywords, quotes, trigraphs, bidi characters and backslashes at ends of lines, with trigraphs switched on too."""
    robot = oc.Robot.planar([0.5] * len(HOSTILE), [1.0] * len(HOSTILE))
    names = tuple(one_line(name) for name in HOSTILE)
    robot = oc.Robot(dataclasses.replace(robot.tree, joint_names=names))
    task = oc.Task.custom(robot, "x??/", lambda q: ca.sin(q[0]) + q[1], ["x\\"])
    chart = oc.fit(oc.Problem(robot, task, name="a??/\\"), oc.Linear(), samples=100).chart
    generated = oc.generate_c(chart, tmp_path, None, "arm")
    source = tmp_path / "arm.c"
    for path in (source, tmp_path / "arm.h"):
        text = path.read_text()
        assert not set(text) & {"\u202e", "\u2066", "\x1b"}
        assert "??" not in text
        comments = re.findall(r"/\*.*?\*/", text, flags=re.DOTALL)
        assert not any("\\" in comment for comment in comments)
        assert not any("evil" in part for part in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL).splitlines())
    for dialect in ("-std=c99", "-std=gnu17"):  # strict C99 reads trigraphs
        command = [compilers()[0], *STRICT, dialect, "-Wtrigraphs", "-Wcomment", "-c", str(source), "-o", "/dev/null"]
        assert subprocess.run(command, capture_output=True, text=True, check=False).stderr == ""
    assert check_c(generated, chart, None, states=20).differences["phi"] < 1e-10


@pytest.mark.slow
def test_check_is_fair_near_singularities(tmp_path: Path) -> None:
    """A good fit whose box holds postures where commands amplify rounding by a million, and its coupled laws."""
    robot = oc.Robot.planar([1, 1, 1], [1, 1, 1])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), "inertia", oc.Box([0.3] * 3, np.pi / 4))
    chart = oc.fit(problem, oc.Polynomial(3)).chart
    for law in (PDPlus(chart, 50.0), Kinematic(chart)):
        generated = oc.generate_c(chart, tmp_path / law.name, law, "arm")
        check_c(generated, chart, law)
        source = tmp_path / law.name / "arm.c"
        source.write_text(source.read_text().replace("arg[3] = reference->velocity", "arg[3] = reference->value"))
        with pytest.raises(ProofError, match="control"):
            check_c(generated, chart, law)


def test_files_of_the_user_stay(planar_chart: oc.Chart, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# My robot\n")
    with pytest.raises(InvalidValueError, match=r"a folder with a README\.md that orthocas did not write"):
        oc.generate_c(planar_chart, tmp_path, None, "arm")
    (tmp_path / "README.md").unlink()
    (tmp_path / "CMakeLists.txt").mkdir()
    with pytest.raises(InvalidValueError, match=r"CMakeLists\.txt that orthocas did not write"):
        oc.generate_c(planar_chart, tmp_path, None, "arm")
    assert [path.name for path in tmp_path.iterdir()] == ["CMakeLists.txt"]
    (tmp_path / "CMakeLists.txt").rmdir()
    oc.generate_c(planar_chart, tmp_path, None, "arm")
    oc.generate_c(planar_chart, tmp_path, None, "arm")
    with pytest.raises(InvalidValueError, match="a folder with a library of another name"):
        oc.generate_c(planar_chart, tmp_path, None, "leg")


def test_header_and_readme_tell_what_a_user_needs(pd_plus: Generated, planar_x: oc.Problem) -> None:
    generated, law = pd_plus
    header = (generated.folder / "arm.h").read_text()
    for name in planar_x.robot.joint_names:
        assert re.search(rf"\d {name} \[rad\]: ", header)
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
    q, phi = (np.array(json.loads(f"[{row}]")) for row in re.findall(r"    (?:q  |phi) = {(.*)}", readme))
    np.testing.assert_array_equal(law.chart.phi(q), phi)


def test_what_cannot_be_generated_is_refused(planar_x: oc.Problem, planar_chart: oc.Chart, tmp_path: Path) -> None:
    with pytest.raises(NoExpressionError, match="distil"):
        oc.generate_c(oc.grow(planar_x, leaf="linear"), tmp_path / "new")
    for name in ("2arm", "my arm", "", "größe", "math", "string", "a" * 300):
        with pytest.raises(InvalidValueError, match="a C identifier"):
            oc.generate_c(planar_chart, tmp_path / "new", None, name)
    other = oc.problems.get("planar_3r_x")
    with pytest.raises(InvalidValueError, match="of another chart"):
        oc.generate_c(planar_chart, tmp_path / "new", Projector(other, 1.0, 1.0))
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidValueError, match="expected a folder"):
        oc.generate_c(planar_chart, tmp_path / "file")
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_command_writes_checks_and_refuses(planar_fit: Fit, run: Run) -> None:
    planar_fit.chart.save("arm.orthocas")
    code, out, err = run("codegen", "arm.orthocas", "--controller", "kinematic", "--out", "c", "--check", "--json")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["checked_states"] == 1009
    assert max(report["relative_differences"].values()) < 1e-10
    assert Path(report["source"]).exists()
    code, out, _ = run("codegen", "arm.orthocas", "--controller", "none", "--out", "d", "--name", "arm")
    assert code == 0
    assert "lines of C99" in out
    for words, message in (
        (["--controller", "none", "--limit", "3"], "a controller, because a controller option was given"),
        (["--controller", "kinematic", "--stiffness", "3"], "no --stiffness with kinematic"),
        (["--controller", "spring"], "unknown controller 'spring'"),
        (["--controller", "pd_plus", "--name", "a b"], "a C identifier"),
    ):
        code, _, err = run("codegen", "arm.orthocas", *words, "--out", "other")
        assert code == 2
        assert message in err
        assert not Path("other").exists()


def test_command_chooses_the_model_at_run_time_and_prints_remarks(planar_xy: oc.Problem, run: Run) -> None:
    oc.fit(planar_xy, oc.Linear()).chart.save("arm.orthocas")
    words = ("codegen", "arm.orthocas", "--controller", "impedance", "--out", "c", "--name", "arm")
    code, _, err = run(*words, "--damping", "square_root", "--stiffness", "1,10000,1")
    assert code == 0
    assert "the damping matrix (29) is indefinite in" in err
    code, _, err = run(*words, "--inputs", "payload,wrench", "--stiffness", "100,0,50", "--damping-stiffness", "50")
    assert (code, err) == (0, "")
    header = Path("c/arm.h").read_text()
    assert "double payload[10];" in header
    assert "double damping_stiffness[3];" in header
    code, _, err = run(*words, "--model", "given", "--gravity", "robot")
    assert code == 0
    assert "pass mass matrix and torques in every tick" in err
    assert "its fallback is zero torque" in err
    header = Path("c/arm.h").read_text()
    assert "double mass_matrix[9];" in header
    assert "gravity_torque" not in header
    code, _, err = run(*words, "--model", "given", "--inputs", "payload")
    assert code == 2
    assert "the given model includes the load" in err


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_compiled_kinematics_and_dynamics_match_pinocchio(name: str, tmp_path: Path) -> None:
    """Nothing of ours between the compiled library and Pinocchio's numbers."""
    model, tip = arm(name)
    robot = oc.Robot.from_model(model, tip)
    rng, n = np.random.default_rng(7), robot.n
    lower, upper = np.maximum(robot.lower, -2), np.minimum(robot.upper, 2)
    base, box = rng.uniform(lower, upper), oc.Box((lower + upper) / 2, (upper - lower) / 2)
    task = oc.Task.position(robot, "zy" if n > 2 else "z")
    chart = oc.fit(oc.Problem(robot, task, "euclidean", box), oc.Linear(base=tuple(base))).chart
    generated = oc.generate_c(chart, tmp_path, None, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path, ("-O1",)), "arm", n)
    data, frame, rows = model.createData(), model.getFrameId(tip), [2, 1][: task.m]
    for q, dq in rng.uniform(-2, 2, (100, 2, n)):
        p = pinocchio_position(model, q)
        M, bias, gravity, _ = library.dynamics(q, dq)
        want = pin.crba(model, data, p)
        for got, wanted in (
            (M, np.triu(want) + np.triu(want, 1).T),
            (bias, pin.nonLinearEffects(model, data, p, dq)),
            (gravity, pin.computeGeneralizedGravity(model, data, p)),
        ):
            np.testing.assert_allclose(got, wanted, atol=1e-10 * max(1.0, np.abs(wanted).max()))
        phi, J, _ = library.chart(q)
        pin.framesForwardKinematics(model, data, p)
        np.testing.assert_allclose(phi[: task.m], data.oMf[frame].translation[rows], atol=1e-10)
        jacobian = pin.computeFrameJacobian(model, data, p, frame, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(J[: task.m], jacobian[rows], atol=1e-10)


def law_of_chain(n: int) -> PDPlus:
    """PD+ on linear coordinates of a planar arm with many joints."""
    robot = oc.Robot.planar([1.0 / n] * n, [1.0] * n)
    box = oc.Box(np.concatenate([[0.6], np.full(n - 1, 2.0 / n)]), 0.2)
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), "inertia", box)
    return PDPlus(oc.fit(problem, oc.Linear()).chart, 50.0, coupling="decoupled")


@needs_c
def test_c_of_robots_with_many_joints_is_short_and_right(tmp_path: Path) -> None:
    """Inverses of large matrices have code of their own."""
    lengths = []
    for n in (12, 24):
        law = law_of_chain(n)
        generated = oc.generate_c(law.chart, tmp_path / str(n), law, "arm")
        lengths.append((generated.folder / "arm.c").stat().st_size)
    assert lengths[1] < 3.5 * lengths[0]
    small = law_of_chain(12)
    generated = oc.generate_c(small.chart, tmp_path / "small", small, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path, ("-O1",)), "arm", 12)
    assert library.check() < 1e-12
    q = sample_uniform(small.problem.domain, 5, 3)
    for k, (point, dq) in enumerate(zip(q, np.random.default_rng(1).normal(size=q.shape), strict=True)):
        reference = [small.chart.phi(q[k - 1]), 0.1 * dq, dq]
        want = small.function(point, dq, *reference, *small.gains.values())[0].full().ravel()
        found, status = library.control(point, dq, np.concatenate(reference), gain_numbers(small))
        assert status == 0
        np.testing.assert_allclose(found, want, atol=1e-11 * np.abs(want).max())
