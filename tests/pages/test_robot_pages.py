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
from orthocas.control import Kinematic, PDPlus
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


def drive(library: GeneratedC, program: str, folder: Path) -> dict[str, str]:
    """What a program prints that runs the controller on stand-ins for ROS."""
    folders = [f"-I{folder}" for folder in (STUBS / "ros2", ROS / "include", library.folder)]
    output_of("gcc", "-std=c99", "-O1", "-c", library.folder / "arm.c", "-o", folder / "arm.o")
    sources = (ROS / "src" / "arm_controller.cpp", STUBS / "ros2" / f"{program}.cpp", folder / "arm.o")
    output_of(*CPP, "-O1", *folders, *sources, "-lm", "-o", folder / program)
    return dict(line.rsplit(" ", 1) for line in output_of(folder / program).splitlines())


def test_controller_for_ros2_control_holds_moves_and_resumes(library: GeneratedC, tmp_path: Path) -> None:
    """Around the library's own model; a missing measurement is 50 ticks long, and targets are refused for each reason.

    Efforts that are not those of the model, or none, are refused at the activation.
    """
    printed = drive(library, "drive", tmp_path)
    ok, caught, error = 0, 6, 2
    assert float(printed.pop("moved by")) == pytest.approx(0.1, abs=1e-4)
    assert float(printed.pop("still moved by")) == pytest.approx(0.1, abs=1e-4)
    assert float(printed.pop("now moved by")) == pytest.approx(0.05, abs=1e-4)
    assert float(printed.pop("risen by")) == pytest.approx(0.01, abs=1e-4)
    assert float(printed.pop("present off by")) < 1e-3
    refused = ("two joints", "torques as positions", "NaN", "unknown name", "double name", "too few", "other frame")
    refused += ("old target", "target without a controller")
    assert [name for name in refused if printed.pop(f"{name} refused") != "1"] == []
    assert printed == {
        "first command": "A1/effort",
        "last state": "A7/effort",
        "held by 100": "1",
        "held by nan": "1",
        "held": f"{ok}",
        "nothing to resume": "1",
        "target": "1",
        "moved": f"{ok}",
        "spoiled targets": f"{ok}",
        "old target now": "1",
        "two names": "1",
        "moved again": f"{ok}",
        "blind": "8",
        "seeing again": f"{caught}",
        "level": f"{error}",
        "diagnosis: the catcher holds the arm: ~/resume when the cause is gone": "0",
        "refused without a controller": "1",
        "held again": f"{ok}",
        "blind again": "8",
        "seeing once more": f"{caught}",
        "accepted": "1",
        "resumed": f"{ok}",
        "brakes closed": f"{caught}",
        "refused under brakes": "1",
        "brakes open": f"{caught}",
        "present base xi1": "0",
    }


def test_controller_for_ros2_control_leads_drives_that_take_positions(iiwa_fit: Fit, tmp_path: Path) -> None:
    """Drives that stand still for a second are caught, led by no more than the leash, and go on without a jump."""
    law = Kinematic.on_chart(iiwa_fit.chart)
    library = oc.generate_c(iiwa_fit.chart, tmp_path / "arm", law, "arm")
    printed = drive(library, "drive_positions", tmp_path)
    assert printed.pop("command") == "A1/position"
    assert float(printed.pop("moved by")) == pytest.approx(0.1, abs=1e-3)
    assert float(printed.pop("led by")) <= 0.1
    assert float(printed.pop("jump")) < 0.005  # [rad] in a tick: twice what the fastest joint may
    assert printed == {"blocked": "6", "status": "0"}


def test_parameters_of_the_stand_in_are_those_of_the_file() -> None:
    """Names and defaults that generate_parameter_library reads."""
    text = (ROS / "src" / "arm_controller_parameters.yaml").read_text()
    described = re.findall(r"^  (\w+):\n    type: (\w+)\n    default_value: (.*)$", text, flags=re.MULTILINE)
    stub = (STUBS / "ros2" / "arm_controller" / "arm_controller_parameters.hpp").read_text()
    fields = re.findall(r"^  ([\w:<>]+) (\w+) = (.*);$", stub, flags=re.MULTILINE)
    kinds = {"string_array": "std::vector<std::string>", "string": "std::string", "bool": "bool", "double": "double"}
    assert fields == [(kinds[kind], name, default.replace("[]", "{}")) for name, kind, default in described]
    sample = (ROS / "config" / "arm_controller.yaml").read_text()
    assert [name for name, *_ in described if f"    {name}: " not in sample] == []


def test_message_of_the_stand_in_is_that_of_the_file() -> None:
    """What rosidl makes of `string[] names`."""
    fields = re.findall(r"^([\w/\[\]]+) +(\w+)", (ROS / "msg" / "Target.msg").read_text(), flags=re.MULTILINE)
    stub = (STUBS / "ros2" / "arm_controller" / "msg" / "target.hpp").read_text()
    kinds = {
        "std_msgs/Header": "std_msgs::msg::Header",
        "string[]": "std::vector<std::string>",
        "float64[]": "std::vector<double>",
    }
    assert [f"  {kinds[kind]} {name};" in stub for kind, name in fields] == [True] * 3


def test_package_for_ros2_control_agrees_with_itself() -> None:
    """Names in package.xml, CMakeLists.txt, the plugin's description and the source."""
    package = ElementTree.parse(ROS / "package.xml").getroot()
    name = package.findtext("name")
    library = ElementTree.parse(ROS / "arm_controller_plugins.xml").getroot()
    (plugin,) = library
    cmake, source = (ROS / "CMakeLists.txt").read_text(), (ROS / "src" / "arm_controller.cpp").read_text()
    assert f"project({name} " in cmake
    assert f"PLUGINLIB_EXPORT_CLASS({plugin.get('type')}, {plugin.get('base_class_type')})" in source
    assert plugin.get("name") in (ROS / "config" / "arm_controller.yaml").read_text()
    assert f"{library.get('path')} SHARED" in cmake
    for dependency in package.findall("depend"):
        assert f"find_package({dependency.text} REQUIRED)" in cmake
