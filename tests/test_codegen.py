"""Generated C: equal to Python, told in its header, and refused where it cannot be right."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from conftest import ROBOTS, arm, pinocchio_position

import orthocas as oc
from orthocas.cli import main
from orthocas.codegen import CompiledLibrary, GeneratedC, check_c, compile_shared
from orthocas.control import Controller, Impedance, Kinematic, KinematicProjector, PDPlus, Projector
from orthocas.errors import CompileError, InvalidValueError, NoExpressionError, ProofError

pytestmark = pytest.mark.skipif(shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler")

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
    source.write_text(text.replace("gains->stiffness", "gains->damping_ratio"))
    with pytest.raises(ProofError, match="in control"):
        check_c(generated, planar_chart, law, states=50)
    source.write_text(text.replace("return inside(q)", "return 7 +"))
    with pytest.raises(CompileError, match="failed"):
        check_c(generated, planar_chart, law, states=50)


def test_header_and_readme_tell_what_a_user_needs(
    pd_plus: Generated, planar_chart: oc.Chart, planar_x: oc.Problem
) -> None:
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
    q, phi = (np.array(json.loads(f"[{row}]")) for row in re.findall(r"    (?:q  |phi) = {(.*)}", readme))
    np.testing.assert_array_equal(planar_chart.phi(q), phi)


def test_what_cannot_be_generated_is_refused(planar_x: oc.Problem, planar_chart: oc.Chart, tmp_path: Path) -> None:
    with pytest.raises(NoExpressionError, match="distil"):
        oc.generate_c(oc.grow(planar_x, leaf="linear"), tmp_path / "new")
    for name in ("2arm", "my arm", "", "größe", "math"):
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
    assert report["checked_states"] == 1009
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
