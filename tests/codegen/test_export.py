"""Exported modules: the numbers of the chart, with one library alone."""

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import robot_of
from programs import Run
from public_objects import CHARTS, circle, fitted

import orthocas as oc
from orthocas import problems
from orthocas.bases import JointSpace
from orthocas.charts.coordinates import Coordinates
from orthocas.codegen.export import LIBRARIES, write_module
from orthocas.codegen.export_forms import write_function
from orthocas.errors import ArchiveError, InvalidValueError, NoExpressionError, UnknownNameError
from orthocas.robots.capsules import FittedCapsules
from orthocas.tasks.samples import sample_uniform
from orthocas.tasks.task import TASK_KINDS
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array
from orthocas.tools.expressions import BINARY, CODES, UNARY, write_tape

FITTED = [name for name in CHARTS if name not in ("circle chart", "disk chart", "linear leaf chart")]
AGREED = 1e-10


def module_of(chart: oc.Chart, library: str, folder: Path, capsules: FittedCapsules | None = None) -> ModuleType:
    path = oc.export(chart, library, folder / "arm.py", force=True, capsules=capsules)
    spec = importlib.util.spec_from_file_location("arm", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def points_of(chart: oc.Chart, count: int = 40) -> Array:
    return sample_uniform(chart.problem.domain, count, 2)


def random_chart(robot: oc.Robot, task: oc.Task, parametrisation: Any, idle: tuple[int, ...] = ()) -> oc.Chart:
    """A chart without a fit, with random parameters."""
    problem = oc.Problem(robot, task, domain=oc.Box(robot.tree.centre_posture, 0.1))
    space, rng, r = JointSpace.of(problem), np.random.default_rng(3), problem.r - len(idle)
    active = [k for k in range(robot.n) if k not in idle]
    size = parametrisation.family(space.restricted_to(active), r).size
    theta, offset, scale = rng.normal(size=size), rng.normal(size=r), rng.uniform(1, 2, r)
    return oc.Chart(problem, Coordinates(parametrisation, space, idle, theta, offset, scale))


def sliding(parametrisation: Any) -> oc.Chart:
    """A random chart of an arm with a prismatic joint, whose third joint is idle."""
    robot = robot_of("tiago with its prismatic torso")
    return random_chart(robot, oc.Task.position(robot), parametrisation, (2,))


OTHERS: dict[str, Callable[[], oc.Chart]] = {
    "network with a prismatic joint": lambda: sliding(oc.MLP((5, 7))),
    "network beside two other joints": lambda: sliding(
        oc.MLP((5, 7), cyclic=["torso_lift_joint"], without=["arm_6_joint"], activation="isru")
    ),
    "polynomial with a prismatic joint": lambda: sliding(oc.Polynomial(3)),
    "SEW angle": lambda: oc.fit(oc.Problem(*arm_with("pose")), oc.SEW()).chart,
    **{name: CHARTS[name] for name in FITTED},
}


def arm_with(kind: str) -> tuple[oc.Robot, oc.Task]:
    robot = problems.get("iiwa").robot
    if kind.startswith("relative_"):
        robot = oc.Robot(replace(robot.tree, tips=(robot.frame_names[3],)))
    return robot, oc.Task.named(robot, kind, problems.get("iiwa").domain.centre)


def require_agreement(module: ModuleType, chart: oc.Chart, points: Array) -> None:
    for name in ("task", "xi", "phi", "jacobian"):
        want, function = getattr(chart, name), getattr(module, name)
        np.testing.assert_allclose(function(points), want(points), rtol=0, atol=AGREED, err_msg=name)
        np.testing.assert_allclose(function(points[0]), want(points[0]), rtol=0, atol=AGREED)
        assert function(points[:0]).shape == want(points[:0]).shape


@pytest.mark.parametrize("name", OTHERS)
def test_module_has_the_numbers_of_the_chart(tmp_path: Path, name: str) -> None:
    chart = OTHERS[name]()
    module = module_of(chart, "numpy", tmp_path)
    require_agreement(module, chart, points_of(chart))
    assert chart.labels == module.LABELS
    assert chart.problem.robot.joint_names == module.JOINTS
    np.testing.assert_array_equal(module.CENTRE, chart.problem.domain.centre)
    np.testing.assert_array_equal(module.HALF_WIDTH, chart.problem.domain.half_width)


@pytest.mark.parametrize("kind", [kind for kind in TASK_KINDS if "AX" not in kind] + ["position:xz", "axis:x"])
def test_every_kind_of_task_is_written(tmp_path: Path, kind: str) -> None:
    chart = random_chart(*arm_with(kind), oc.Linear())
    require_agreement(module_of(chart, "numpy", tmp_path), chart, points_of(chart))


def test_module_differentiates_itself(tmp_path: Path) -> None:
    """Its Jacobian against central differences of its phi."""
    module, step = module_of(fitted().chart, "numpy", tmp_path), 1e-6
    points = points_of(fitted().chart)
    slopes = [(module.phi(points + step * e) - module.phi(points - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(module.jacobian(points), np.stack(slopes, axis=2), rtol=0, atol=1e-7)


def every_operation(q: ca.SX) -> ca.SX:
    """All operations of tapes, where they are defined, some with constants in either place."""
    a, b = 0.3 + 0.1 * ca.sin(q[0]), 0.6 + 0.1 * ca.cos(q[1])
    shift = {"acosh": 1.0}
    entries = [ca.SX.unary(CODES[name], a + shift.get(name, 0.0)) for name in UNARY]
    for name in BINARY:
        entries += [ca.SX.binary(CODES[name], *pair) for pair in ((a, b), (a, 0.25), (1.5, b))]
    return ca.vertcat(*(entry + 0.5 * q[2] for entry in entries), -3.0, ca.inf * q[0])


def array_of(library: str) -> Callable[[Array], Any]:
    """Turns NumPy arrays into those of a library, in double precision."""
    module = pytest.importorskip(library)
    if library == "jax":
        module.config.update("jax_enable_x64", True)
        return module.numpy.asarray
    return module.as_tensor if library == "torch" else np.asarray  # type: ignore[no-any-return]


@pytest.mark.parametrize("library", LIBRARIES)
def test_every_operation_is_written(library: str) -> None:
    """Against CasADi: also comparisons, choices, constants and infinity."""
    array, q = array_of(library), ca.SX.sym("q", 3)
    function = dense_function("f", [q], [every_operation(q)])
    code = write_function("f", "All operations.", function)
    scope: dict[str, Any] = {"_shared": lambda value, q: value}
    exec(f"{LIBRARIES[library].imports_for(code)}\n{LIBRARIES[library].translate(code)}", scope)
    points = np.random.default_rng(1).uniform(0.4, 0.6, (5, 3))
    found = np.asarray(scope["f"](array(np.ascontiguousarray(points.T))))
    np.testing.assert_allclose(found, Batched(function)(points)[0].T, rtol=1e-14, atol=1e-14)
    assert len({step[0] for step in write_tape(function)["steps"]}) > 40


@pytest.mark.slow
@pytest.mark.parametrize("name", ["polynomial chart", "network chart", "given chart", "Fourier chart"])
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_other_libraries_agree_and_differentiate(tmp_path: Path, library: str, name: str) -> None:
    """Values, explicit Jacobian and the library's own derivatives of phi and of a sum over a batch."""
    array, chart = array_of(library), CHARTS[name]()
    module, points = module_of(chart, library, tmp_path), points_of(chart)
    for function in ("task", "xi", "phi", "jacobian"):
        for q in (points, points[0]):
            found = np.asarray(getattr(module, function)(array(q)))
            np.testing.assert_allclose(found, getattr(chart, function)(q), rtol=0, atol=AGREED)
    own = sys.modules["torch"].func if library == "torch" else sys.modules["jax"]
    for derivative in (own.jacrev, own.jacfwd):
        found = np.asarray(own.vmap(derivative(module.phi))(array(points)))
        np.testing.assert_allclose(found, chart.jacobian(points), rtol=0, atol=AGREED)
    summed = np.asarray(own.grad(lambda q: (module.xi(q) ** 2).sum())(array(points)))
    want = 2 * np.einsum("sj,sjn->sn", chart.xi(points), chart.jacobian(points)[:, chart.m :])
    np.testing.assert_allclose(summed, want, rtol=0, atol=AGREED)


def test_precision_is_that_of_q(tmp_path: Path) -> None:
    module, chart = module_of(fitted().chart, "numpy", tmp_path), fitted().chart
    points = points_of(chart)
    single = module.jacobian(points.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, chart.jacobian(points), rtol=0, atol=1e-5)
    assert module.phi([1, 0, 2]).dtype == np.float64


def test_large_sets_are_evaluated_in_parts(tmp_path: Path) -> None:
    module, chart = module_of(fitted().chart, "numpy", tmp_path), fitted().chart
    points = points_of(chart, 2 * module.ROWS + 7)
    np.testing.assert_allclose(module.phi(points), chart.phi(points), rtol=0, atol=AGREED)


def test_module_needs_numpy_alone(tmp_path: Path) -> None:
    oc.export(fitted().chart, "numpy", tmp_path / "arm.py")
    code = "import sys, arm; arm.jacobian([0.1, 0.2, 0.3]); print({'orthocas', 'casadi', 'scipy'} & set(sys.modules))"
    told = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "set()"


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("name", ["polynomial chart", "network chart", "given chart", "linear chart"])
def test_modules_pass_a_linter(tmp_path: Path, library: str, name: str) -> None:
    path = oc.export(CHARTS[name](), library, tmp_path / "arm.py")
    rules = ["--isolated", "--select", "E,F,W,B,I,UP,N", "--ignore", "E501,N806,W505", "--target-version", "py311"]
    told = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "-q", *rules, path], capture_output=True, text=True, check=False
    )
    assert (told.stdout, told.stderr, told.returncode) == ("", "", 0)


def test_names_of_any_kind_stay_names(tmp_path: Path) -> None:
    """Names that would end a text, or change what is shown, come back unchanged from a file of plain ASCII."""
    known, name = fitted().chart, '"""\\ + exit() @labels@ {0} \u00e9'
    task = oc.Task.custom(known.problem.robot, name, lambda q: ca.sin(q[0]), labels=[name], units=[name])
    chart = oc.fit(oc.Problem(known.problem.robot, task, domain=oc.Box([0.5] * 3, 0.1), name=name), oc.Linear()).chart
    module = module_of(chart, "numpy", tmp_path)
    assert (module.PROBLEM, module.LABELS[0], module.UNITS) == (name, name, (name,))
    assert write_module(chart, "torch").isascii()


def test_what_cannot_be_exported_is_named(tmp_path: Path) -> None:
    chart = fitted().chart
    with pytest.raises(NoExpressionError, match="distil"):
        oc.export(circle(), "numpy", tmp_path / "arm.py")
    with pytest.raises(UnknownNameError, match=r"unknown library 'tensorflow', known: numpy, torch, jax"):
        oc.export(chart, "tensorflow", tmp_path / "arm.py")
    for name in ("arm", "arm.txt", "1.py", "torch.py", "a-b.py"):
        with pytest.raises(InvalidValueError, match=r"path is .* expected a module NAME.py"):
            oc.export(chart, "torch", tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_only_exported_modules_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "arm.py"
    path.write_text("print('mine')\n")
    with pytest.raises(ArchiveError, match="orthocas did not write the file that is there"):
        oc.export(fitted().chart, "numpy", path)
    assert path.read_text() == "print('mine')\n"
    for _ in range(2):  # the second time it is ours
        assert oc.export(fitted().chart, "numpy", path, force=True) == path
    oc.export(fitted().chart, "torch", path)
    assert "import torch" in path.read_text()
    (tmp_path / "link.py").symlink_to(path)
    with pytest.raises(ArchiveError, match="symbolic link"):
        oc.export(fitted().chart, "numpy", tmp_path / "link.py", force=True)


def test_command_writes_a_module(run: Run, tmp_path: Path) -> None:
    fitted().chart.save(tmp_path / "arm.orthocas")
    code, out, err = run("export", "arm.orthocas", "--to", "numpy", "--out", "arm.py")
    assert (code, err) == (0, "")
    assert "arm.py, with numpy alone" in out
    assert (tmp_path / "arm.py").read_text() == write_module(fitted().chart, "numpy")
    code, out, err = run("export", "arm.orthocas", "--to", "numpy", "--out", "arm.orthocas")
    assert (code, len(err.splitlines())) == (2, 1)
    assert json.loads(run("export", "arm.orthocas", "--to", "jax", "--out", "arm.py", "--json")[1])["joints"] == 3
