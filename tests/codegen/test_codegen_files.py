"""Files of generated C: told in header and README, installed, and refused where they cannot be right."""

import dataclasses
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from baselines import Projector
from programs import Run, needs_c, needs_cmake, output_of

import orthocas as oc
from orthocas.codegen import GeneratedC, check_c
from orthocas.codegen.library import STRICT
from orthocas.control import PDPlus
from orthocas.errors import InvalidValueError, NoExpressionError, one_line
from orthocas.fitting.fit import Fit
from orthocas.native.libraries import find_compilers

pytestmark = needs_c


_FOUND = f"find_package(arm {'.'.join(oc.__version__.split('.')[:2])} REQUIRED)"
_CONSUMER = f"""
cmake_minimum_required(VERSION 3.16)
project(consumer LANGUAGES C)
{_FOUND}
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
@pytest.mark.usefixtures("unoptimised")
def test_installed_libraries_are_found_and_linked(pd_plus: tuple[GeneratedC, PDPlus], tmp_path: Path) -> None:
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
    output_of(find_compilers()[0], project / "main.c", "-o", program, *shlex.split(flags), f"-Wl,-rpath,{library}")
    output_of(program)


@pytest.mark.slow
@needs_cmake
@pytest.mark.usefixtures("unoptimised")
def test_as_a_part_of_another_project_nothing_is_installed(pd_plus: tuple[GeneratedC, PDPlus], tmp_path: Path) -> None:
    (tmp_path / "main.c").write_text(_MAIN)
    text = _CONSUMER.replace(_FOUND, f'add_subdirectory("{pd_plus[0].folder}" arm)')
    (tmp_path / "CMakeLists.txt").write_text(text.replace("arm::shared", "arm::static"))
    output_of("cmake", "-S", tmp_path, "-B", tmp_path / "build")
    output_of("cmake", "--build", tmp_path / "build")
    output_of(tmp_path / "build" / "consumer")
    output_of("cmake", "--install", tmp_path / "build", "--prefix", tmp_path / "installed")
    assert not list((tmp_path / "installed").rglob("*arm*"))


@pytest.mark.slow
def test_words_of_others_do_not_become_code(tmp_path: Path) -> None:
    evil = "a */ int evil; /* @x@ b /* ω"
    robot = oc.Robot.planar([1, 1, 1], [3, 3, 3])
    task = oc.Task.custom(robot, "custom", lambda q: ca.vertcat(ca.sin(q[0]) + q[1]), ["p*/"])
    problem = oc.Problem(robot, task, "inertia", oc.Box([0.5, 0.5, 0.5], 0.2), evil)
    chart = oc.fit(problem, oc.Linear()).chart
    generated = oc.generate_c(chart, tmp_path, None, "arm")
    check_c(generated, chart, None, states=100)
    assert "evil" not in output_of(find_compilers()[0], "-E", "-P", tmp_path / "arm.c").replace("evil_", "")
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


@pytest.mark.slow
def test_names_from_robot_files_stay_in_comments_and_strings(tmp_path: Path) -> None:
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
        code = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        assert "\\" not in "".join(re.findall(r'"[^"\n]*"', code))
        assert "evil" not in re.sub(r'"[^"\n]*"', "", code)
    for dialect in ("-std=c99", "-std=gnu17"):  # strict C99 reads trigraphs
        flags = (*STRICT, dialect, "-Wtrigraphs", "-Wcomment")
        command = [find_compilers()[0], *flags, "-c", str(source), "-o", "/dev/null"]
        assert subprocess.run(command, capture_output=True, text=True, check=False).stderr == ""
    assert check_c(generated, chart, None, states=20).differences["phi"] < 1e-10


@pytest.mark.slow
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


def test_header_and_readme_tell_what_a_user_needs(pd_plus: tuple[GeneratedC, PDPlus], planar_x: oc.Problem) -> None:
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
        (["--controller", "none", "--limit", "3"], "settings of a controller require a controller"),
        (["--controller", "kinematic", "--stiffness", "3"], "kinematic has no option --stiffness"),
        (["--controller", "spring"], "unknown controller 'spring'"),
        (["--controller", "pd_plus", "--name", "a b"], "a C identifier"),
    ):
        code, _, err = run("codegen", "arm.orthocas", *words, "--out", "other")
        assert code == 2
        assert message in err
        assert not Path("other").exists()


@pytest.mark.slow
def test_command_chooses_the_model_at_run_time_and_prints_remarks(planar_xy: oc.Problem, run: Run) -> None:
    oc.fit(planar_xy, oc.Linear()).chart.save("arm.orthocas")
    words = ("codegen", "arm.orthocas", "--controller", "impedance", "--out", "c", "--name", "arm")
    code, _, err = run(*words, "--damping", "square_root", "--stiffness", "1,10000,1")
    assert code == 0
    assert "the damping matrix (29) is indefinite in" in err
    code, _, err = run(*words, "--inputs", "payload,wrench", "--stiffness", "100,20,50")
    assert (code, err) == (0, "")
    header = Path("c/arm.h").read_text()
    assert "double payload[10];" in header
    code, _, err = run(*words, "--model", "given", "--gravity-compensation", "robot")
    assert code == 0
    assert "pass mass matrix and torques in every tick" in err
    assert "its fallback is zero torque" in err
    header = Path("c/arm.h").read_text()
    assert "double mass_matrix[9];" in header
    assert "gravity_torque" not in header
    code, _, err = run(*words, "--model", "given", "--inputs", "payload")
    assert code == 2
    assert "the given model includes the load" in err
