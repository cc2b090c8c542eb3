"""Shared problems, charts and real robot descriptions; one thread for linear algebra."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy: threads of BLAS that spin take other processes' cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # or every Python that tests start compiles orthocas again

import gc
import json
import pickle
import signal
import sys
import threading
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pinocchio as pin
import pytest
from charts import with_metric
from matplotlib.figure import Figure
from paper import FIGURES, Drawing
from paper.__main__ import main as draw_paper
from programs import Run
from simulate_command import SHORT

import orthocas as oc
from orthocas import problems
from orthocas.arms import kernel as arm_kernel
from orthocas.charts import curve_tracer, point_quality, quality
from orthocas.cli import simulate
from orthocas.cli.entry import main
from orthocas.codegen import CompiledLibrary, GeneratedC, Supervisor, compile_shared, compiled, compiled_inverse
from orthocas.codegen.library import STRICT
from orthocas.control import PDPlus, Reference, gains, operational_space
from orthocas.fitting.fit import Fit
from orthocas.robots import pinocchio_model, urdf
from orthocas.tasks import branches
from orthocas.tools.checks import Array

compile_shared.__defaults__ = (("-O0",), None)  # users' -O2 takes gcc three times as long, and computes the same
compiled._FLAGS, compiled_inverse._FLAGS = ("-O1",), (*STRICT, "-O1")  # as their -O2 and -O3; here it runs for longer
arm_kernel._FLAGS = (*STRICT, "-O2")
curve_tracer._FLAGS = (*STRICT, "-O1")


def _search_briefly(value: point_quality.Value, domain: oc.Domain, seed: int = 0) -> Array:
    """As users' search for the fastest and slowest mode of a law, from a twentieth of the candidates."""
    fewer = replace(point_quality.WORST, candidates=300, descents=12, kept=4, most_pairs=40)
    with patch.object(point_quality, "WORST", fewer):
        return point_quality.least_in_domain(value, domain, seed)


operational_space.least_in_domain = gains.least_in_domain = _search_briefly  # type: ignore[attr-defined]

_find_cuts = branches._Arm.find_cuts
_CUTS: dict[Any, list[branches.Cut]] = {}


def _remember_cuts(arm: branches._Arm, k: int) -> list[branches.Cut]:
    """The cuts of a joint, found once for robots of the same content: many tests fit the same arms."""
    key = pickle.dumps((arm.robot, arm.task.recipe, arm.joints, k)), branches._Arm._measure_slice
    if key not in _CUTS:
        _CUTS[key] = _find_cuts(arm, k)
    return list(_CUTS[key])


branches._Arm.find_cuts = _remember_cuts  # type: ignore[method-assign]
sys.dont_write_bytecode = False  # for the test files, which come after this one
quality.RULES = replace(
    quality.RULES, samples=20_000
)  # users' 100,000 take five times as long, and angles differ by some thousandths

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job starts with SIGINT ignored


def pytest_collection() -> None:
    """Collect no garbage now: to look through all that tests are made of takes a fifth of the time."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Collect garbage from now on, without what is there."""
    gc.freeze()
    gc.enable()


def pytest_sessionfinish() -> None:
    gc.unfreeze()
    gc.enable()


ROBOTS = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link_eef"),
    "kinova": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "tiago with its prismatic torso": ("tiago_description/robots/tiago.urdf", "arm_tool_link"),
    "talos left arm": ("talos_data/robots/talos_left_arm.urdf", "gripper_left_base_link"),
    "double pendulum, continuous": ("double_pendulum_description/urdf/double_pendulum_continuous.urdf", "link2"),
    "z1": ("z1_description/urdf/z1.urdf", "link06"),
    "talos, both arms and the torso": ("talos_data/robots/talos_reduced.urdf", "gripper_right_base_link"),
}


def robot_data(relative: str) -> Path:
    """A file of the example-robot-data package."""
    for entry in metadata.files("example-robot-data") or []:
        if str(entry).endswith(f"robots/{relative}"):
            return Path(str(entry.locate())).resolve()
    raise FileNotFoundError(relative)


def arm(name: str) -> tuple[pin.Model, str]:
    """Model and tip of one of ROBOTS, without the joints off the chain."""
    file, tip = ROBOTS[name]
    full = urdf.read_urdf(robot_data(file))[0]
    return full if "both arms" in name else pinocchio_model.lock_off_chain(full, tip), tip


def robot_of(name: str) -> oc.Robot:
    """The robot of one of ROBOTS."""
    file, tip = ROBOTS[name]
    return oc.Robot.from_urdf(robot_data(file), tip)


def pinocchio_position(model: pin.Model, q: np.ndarray) -> np.ndarray:
    """Pinocchio's configuration: cos and sin for continuous joints."""
    position = pin.neutral(model)
    for i, joint in enumerate(model.joints[1:]):
        position[joint.idx_q : joint.idx_q + joint.nq] = q[i] if joint.nq == 1 else (np.cos(q[i]), np.sin(q[i]))
    return position


@pytest.fixture(scope="session")
def iiwa() -> oc.Problem:
    return problems.get("iiwa")


@pytest.fixture(scope="session")
def planar_x() -> oc.Problem:
    return problems.get("planar_3r_x")


@pytest.fixture(scope="session")
def planar_xy() -> oc.Problem:
    return problems.get("planar_3r_xy")


@pytest.fixture(scope="session")
def iiwa_fit(iiwa: oc.Problem) -> Fit:
    return oc.fit(iiwa, oc.Polynomial(degree=3))


@pytest.fixture(scope="session")
def planar_fit(planar_x: oc.Problem) -> Fit:
    return oc.fit(planar_x, oc.Polynomial(degree=4))


@pytest.fixture(scope="session")
def planar_chart(planar_x: oc.Problem) -> oc.Chart:
    """Task x, A = M, orthogonal to 0.2 degrees, with gradients of even lengths: for controllers."""
    return oc.fit(planar_x, oc.Polynomial(degree=8), weights=(1000, 30, 150, 0.1)).chart


@pytest.fixture(scope="session")
def planar_for_control(planar_x: oc.Problem) -> oc.Chart:
    """Cubic coordinates that keep away from folds, for laws at the boundary of the domain."""
    return oc.fit(planar_x, oc.Polynomial(3), weights=(1000, 30, 150, 0.1, 1000), samples=1500).chart


@pytest.fixture(scope="session")
def planar_arm() -> oc.Chart:
    """A planar arm with one coordinate, quickly fitted: for the inverse map."""
    return oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(3), samples=300).chart


@pytest.fixture(scope="session")
def arm_chart() -> oc.Chart:
    """The 7-DoF arm with A = M, roughly fitted: laws have to be right for any regular chart."""
    problem = oc.problems.get("iiwa")
    inertial = with_metric(problem, "inertia")
    return oc.fit(inertial, oc.Polynomial(2), samples=1000).chart


@pytest.fixture(scope="session")
def pd_plus(planar_fit: Fit, tmp_path_factory: pytest.TempPathFactory) -> tuple[GeneratedC, PDPlus]:
    """A law on a box of the planar arm, and its C."""
    law = PDPlus(planar_fit.chart, np.linspace(20, 80, 3), 0.6, "decoupled", limit=90.0)
    return oc.generate_c(law.chart, tmp_path_factory.mktemp("pd_plus"), law, "arm"), law


@pytest.fixture(scope="session")
def planar_q0(planar_x: oc.Problem) -> Array:
    """The middle of the domain of the planar arm."""
    return planar_x.domain.centre


@pytest.fixture(scope="session")
def planar_steps(planar_chart: oc.Chart, planar_q0: Array) -> Reference:
    """Interleaved steps in x and xi1, as in Sec. 8.1."""
    phi = planar_chart.phi(planar_q0)
    changes = [(0.3, {"x": phi[0] + 0.1}), (2.0, {"xi1": 0.05}), (4.0, {"x": phi[0]}), (6.0, {"xi1": 0.0})]
    return Reference.steps(planar_chart.labels, phi, changes, 8.0)


@pytest.fixture(scope="session")
def supervised_law(planar_for_control: oc.Chart) -> PDPlus:
    """A law on a box of the planar arm, to be supervised."""
    return PDPlus.on_chart(planar_for_control, limit=120.0)


@pytest.fixture(scope="session")
def supervised_c(supervised_law: PDPlus, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    """Its C."""
    return oc.generate_c(supervised_law.chart, tmp_path_factory.mktemp("supervised"), supervised_law, "arm")


@pytest.fixture(scope="session")
def supervised_library(supervised_c: GeneratedC) -> CompiledLibrary:
    """Its C, compiled."""
    return CompiledLibrary(compile_shared(supervised_c, supervised_c.folder), "arm", 3)


@pytest.fixture
def supervisor(supervised_library: CompiledLibrary, supervised_law: PDPlus) -> Supervisor:
    """Its state in C."""
    return Supervisor(supervised_library, supervised_law)


@pytest.fixture(scope="module")
def drawings(request: pytest.FixtureRequest) -> dict[str, Drawing]:
    """The figures of the paper that a test file names, in quick mode."""
    return {name: FIGURES[name].draw(True) for name in request.module.NAMES}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command of orthocas in an empty folder, in this process, without lines of progress on a busy machine."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("orthocas.cli.output.PAUSE", threading.TIMEOUT_MAX)

    def call(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["orthocas", *words])
        with pytest.raises(SystemExit) as stop:
            main()
        out, err = capsys.readouterr()
        return int(stop.value.code or 0), out, err

    return call


@pytest.fixture
def run_paper(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run `python -m examples.paper` in an empty folder, in this process."""
    monkeypatch.chdir(tmp_path)

    def call(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["examples.paper", *words])
        with pytest.raises(SystemExit) as stop:
            draw_paper()
        out, err = capsys.readouterr()
        return int(stop.value.code or 0), out, err

    return call


@pytest.fixture
def run_simulate(run: Run, planar_fit: Fit) -> Run:
    """Run `orthocas simulate` in a folder with a.orthocas and short.json."""
    planar_fit.chart.save("a.orthocas")
    Path("short.json").write_text(json.dumps(SHORT))

    def call(
        controller: str, *words: str, steps: str = "short.json", chart: str = "a.orthocas"
    ) -> tuple[int, str, str]:
        return run("simulate", chart, "--controller", controller, "--steps", steps, "--out", "out", *words)

    return call


@pytest.fixture
def unoptimised(monkeypatch: pytest.MonkeyPatch) -> None:
    """CMake builds in half the time, for tests of what hardly runs."""
    monkeypatch.setenv("CMAKE_BUILD_TYPE", "Debug")


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """No curves in pictures of `orthocas simulate`, for tests of numbers: drawing takes longer than the runs."""
    monkeypatch.setattr(simulate, "trajectory_figure", lambda run, units: Figure())


_ONE_JOINT = """<robot name="r"><link name="base"/>
<link name="a"><inertial><mass value="{mass}"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="{joint}" type="{kind}"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="{lower}" upper="1" effort="1" velocity="1"/></joint></robot>"""


def one_joint(folder: Path, mass: str = "1", joint: str = "j", kind: str = "revolute", lower: str = "-1") -> Path:
    """The URDF of an arm of one joint."""
    path = folder / "arm.urdf"
    path.write_text(_ONE_JOINT.format(mass=mass, joint=joint, kind=kind, lower=lower))
    return path


@pytest.fixture
def saved(planar_fit: Fit, tmp_path: Path) -> Path:
    path = tmp_path / "chart.orthocas"
    planar_fit.chart.save(path)
    return path
