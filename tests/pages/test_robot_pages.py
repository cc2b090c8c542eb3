"""Programs of docs/how-to/robots.md and docs/how-to/c_code.md compile, and the controller for ros2_control runs.

Nothing here is a robot: headers of libfranka, FRI and ROS are replaced by stand-ins with the same signatures.
"""

import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest
from programs import needs_c, output_of

import orthocas as oc
from orthocas.codegen import GeneratedC
from orthocas.control import PDPlus
from orthocas.fitting.fit import Fit

ROOT = Path(__file__).parents[2]
STUBS = Path(__file__).parents[1] / "stubs"
ROS = ROOT / "examples" / "ros2_control"
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Werror")
CPP = ("g++", "-std=c++17", *STRICT)

pytestmark = [
    pytest.mark.slow,
    needs_c,
    pytest.mark.skipif(shutil.which("g++") is None, reason="no g++"),
]


@pytest.fixture(scope="module")
def library(iiwa_fit: Fit, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    """A law for a robot that compensates gravity itself."""
    law = PDPlus.on_chart(iiwa_fit.chart, gravity="robot")
    return oc.generate_c(iiwa_fit.chart, tmp_path_factory.mktemp("arm"), law, "arm")


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "docs" / page).read_text(), flags=re.DOTALL)


@pytest.mark.parametrize(("number", "stubs"), [(0, "libfranka"), (1, "fri")])
def test_programs_of_the_page_on_robots_compile(number: int, stubs: str, library: GeneratedC, tmp_path: Path) -> None:
    code = blocks("how-to/robots.md", "cpp")[number]
    (tmp_path / "page.cpp").write_text(code)
    output_of(*CPP, "-fsyntax-only", f"-I{STUBS / stubs}", f"-I{library.folder}", tmp_path / "page.cpp")


def test_loop_of_the_page_on_c_compiles(library: GeneratedC, tmp_path: Path) -> None:
    """With C99 and every warning an error."""
    (code,) = blocks("how-to/c_code.md", "c")
    yours = """
    void read_robot(double *q, double *dq);
    void write_robot(const double *torque);
    int at_rest(const double *dq);
    void run(const double target[7], long ticks);
    """
    (tmp_path / "page.c").write_text(yours + code)
    output_of("gcc", "-std=c99", *STRICT, "-fsyntax-only", f"-I{library.folder}", tmp_path / "page.c")


@pytest.mark.parametrize("page", ["interfaces", "joystick", "stops"])
def test_ticks_of_how_to_pages_compile(page: str, library: GeneratedC, tmp_path: Path) -> None:
    (code,) = blocks(f"how-to/{page}.md", "c")
    (tmp_path / "page.c").write_text(code)
    output_of("gcc", "-std=c99", *STRICT, "-fsyntax-only", f"-I{library.folder}", tmp_path / "page.c")


def test_controller_for_ros2_control_holds_moves_and_resumes(library: GeneratedC, tmp_path: Path) -> None:
    """On stand-ins for ROS, around the library's own model; a missing measurement is 50 ticks long, a target is NaN.

    Efforts that are not those of the model, or none, are refused at the activation.
    """
    folders = [f"-I{folder}" for folder in (STUBS / "ros2", ROS / "include", library.folder)]
    output_of("gcc", "-std=c99", "-O1", "-c", library.folder / "arm.c", "-o", tmp_path / "arm.o")
    sources = (ROS / "src" / "arm_controller.cpp", STUBS / "ros2" / "drive.cpp", tmp_path / "arm.o")
    output_of(*CPP, "-O1", *folders, *sources, "-lm", "-o", tmp_path / "drive")
    printed = dict(line.rsplit(" ", 1) for line in output_of(tmp_path / "drive").splitlines())
    ok, caught = 0, 6
    assert float(printed.pop("moved by")) == pytest.approx(0.1, abs=1e-4)
    assert float(printed.pop("still moved by")) == pytest.approx(0.1, abs=1e-4)
    assert float(printed.pop("now moved by")) == pytest.approx(0.05, abs=1e-4)
    assert float(printed.pop("present off by")) < 1e-3
    assert printed == {
        "without joints": "1",
        "first command": "A1/effort",
        "last state": "A7/effort",
        "held by 100": "1",
        "held by nan": "1",
        "held": f"{ok}",
        "nothing to resume": "1",
        "moved": f"{ok}",
        "spoiled target": f"{ok}",
        "moved again": f"{ok}",
        "blind": "8",
        "seeing again": f"{caught}",
        "refused without a controller": "1",
        "held again": f"{ok}",
        "blind again": "8",
        "seeing once more": f"{caught}",
        "accepted": "1",
        "resumed": f"{ok}",
        "brakes closed": f"{caught}",
        "refused under brakes": "1",
        "brakes open": f"{caught}",
    }


def test_package_for_ros2_control_agrees_with_itself() -> None:
    """Names in package.xml, CMakeLists.txt, the plugin's description and the source."""
    package = ElementTree.parse(ROS / "package.xml").getroot()
    name = package.findtext("name")
    (plugin,) = ElementTree.parse(ROS / "arm_controller_plugins.xml").getroot()
    cmake, source = (ROS / "CMakeLists.txt").read_text(), (ROS / "src" / "arm_controller.cpp").read_text()
    assert f"project({name} " in cmake
    assert f"PLUGINLIB_EXPORT_CLASS({plugin.get('type')}, {plugin.get('base_class_type')})" in source
    assert plugin.get("name") in (ROS / "config" / "arm_controller.yaml").read_text()
    for dependency in package.findall("depend"):
        assert f"find_package({dependency.text} REQUIRED)" in cmake
