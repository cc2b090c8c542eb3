"""Views in a real browser: what a person sees and moves, by the page's own numbers."""

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from browser import PROGRAM, Page, browser
from PIL import Image
from programs import Run, python

import orthocas as oc
from orthocas.fitting.fit import Fit
from orthocas.problems import urdf_path
from orthocas.viewer import cyclic_motions, export_page

pytestmark = [
    pytest.mark.skipif(find_spec("viser") is None, reason="no viser: pip install 'orthocas[view]'"),
    pytest.mark.slow,
]
NUMBERS = "Object.fromEntries([...document.querySelectorAll('[data-oc]')].map(b => [b.dataset.oc, +b.dataset.value]))"
COARSE = "/?fixedDpr=0.15"  # a coarse picture takes seconds less without a graphics card
SLIDERS = "document.querySelectorAll('.mantine-Slider-root')"


SEEN = """point => {
  const {camera, canvas, nodeRefFromName} = window.__viserMutable, box = canvas.getBoundingClientRect();
  const spot = camera.position.clone().set(...point).applyMatrix4(nodeRefFromName[''].matrixWorld).project(camera);
  return document.elementFromPoint(box.x + (spot.x + 1) / 2 * box.width, box.y + (1 - spot.y) / 2 * box.height);
}"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The tab of a browser, which all tests of this file share."""
    if PROGRAM is None:
        pytest.skip("no chromium: apt-get install chromium")
    with browser(tmp_path_factory.mktemp("profile"), (1120, 560), smooth=False) as tab:
        yield tab


@pytest.fixture(scope="module")
def still_arm(iiwa_fit: Fit) -> Iterator[str]:
    """The address of a view of the 7-DoF arm that nobody moves."""
    with oc.view(iiwa_fit.chart, port=0) as view:
        yield view.url


def opened(page: Page, url: str) -> None:
    """Open the page of a server."""
    page.open(f"{url}{COARSE}")
    page.wait("!!document.querySelector('[data-oc]') && !!document.querySelector('canvas')")


def button(words: str) -> str:
    return f"[...document.querySelectorAll('button')].find(b => b.textContent.includes('{words}'))"


def to_the_end(page: Page, slider: int) -> None:
    """Move a slider to its highest value, by the keyboard."""
    page.value(f"{SLIDERS}[{slider}].querySelector('[role=slider]').focus()")
    page.press("End")


def joints(page: Page, chart: oc.Chart) -> np.ndarray:
    shown = page.value(NUMBERS)
    return np.array([shown[name] for name in chart.problem.robot.joint_names])


def flange(q: np.ndarray) -> np.ndarray:
    """Where Pinocchio has the flange."""
    with urdf_path() as path:
        model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.array(data.oMf[model.getFrameId("link_ee")].translation)


def drawn(page: Page, path: Path) -> bool:
    """Whether the middle of the page soon has more colours than a floor; writes a picture of the page."""
    end = time.monotonic() + 30
    while time.monotonic() < end:
        page.picture(path)
        with Image.open(path) as picture:
            wide, high = picture.size
            scene = picture.convert("RGB").crop((int(0.4 * wide), int(0.2 * high), int(0.6 * wide), int(0.8 * high)))
            if len(np.unique(np.asarray(scene).reshape(-1, 3), axis=0)) > 100:
                return True
        time.sleep(0.5)
    return False


def test_a_slider_moves_the_joints_and_the_flange_stays(page: Page, iiwa_fit: Fit, tmp_path: Path) -> None:
    chart = iiwa_fit.chart
    with oc.view(chart, port=0) as view:
        opened(page, view.url)
        before = joints(page, chart)
        start = float(before[1])
        np.testing.assert_allclose(before, chart.problem.domain.centre, atol=1e-12)
        # the range of x, which at the end of the coordinate is another one
        highest = f"+{SLIDERS}[4].querySelector('[role=slider]').getAttribute('aria-valuemax')"
        at_first = page.value(highest)
        to_the_end(page, 0)
        page.wait(f"Math.abs(({NUMBERS})['A2'] - {start!r}) > 0.02")
        page.wait(f"({button('Undo')}).disabled === false")
        page.wait(f"Math.abs({highest} - {at_first!r}) > 1e-9")
        at_end = page.value(highest)
        after, shown = joints(page, chart), page.value(NUMBERS)
        assert np.abs(after - before).max() > 0.05
        assert shown["drift"] <= 1e-6
        assert np.abs(flange(after) - flange(before)).max() <= 1e-6
        assert drawn(page, tmp_path / "chart.png")
        page.click(button("Home"))
        page.wait(f"Math.abs(({NUMBERS})['A2'] - {start!r}) < 1e-9")
        page.wait(f"{highest} != {at_end!r}")
        to_the_end(page, 4)  # the task: now the flange moves
        page.wait(f"Math.abs(({NUMBERS})['A2'] - {start!r}) > 1e-3")
        moved = joints(page, chart)
        assert np.abs(flange(moved) - flange(before)).max() > 1e-3
        np.testing.assert_allclose(chart.xi(moved), chart.xi(before), atol=1e-8)
        assert chart.problem.domain.contains(moved)


WIDTHS = (900, 1366, 390)


@pytest.mark.parametrize("wide", WIDTHS)
def test_the_arrows_at_the_tool_lie_beside_the_panels(page: Page, iiwa_fit: Fit, still_arm: str, wide: int) -> None:
    """At the tool, and a handle's length away in all directions, the topmost element is the picture."""
    high = 844 if wide < 480 else 700
    page.call("Emulation.setDeviceMetricsOverride", width=wide, height=high, deviceScaleFactor=1, mobile=wide < 480)
    page.open(f"{still_arm}{COARSE}")  # in narrow windows without readings
    page.wait("document.querySelectorAll('canvas').length > 1 && !!window.__viserMutable?.canvas")
    place = iiwa_fit.chart.problem.robot.tip_position(iiwa_fit.chart.problem.domain.centre)
    ends = [place + 0.2 * np.array(way) for way in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))]
    seen = [f"({SEEN})({point.tolist()})" for point in ends]
    page.wait(f"[{','.join(seen)}].every(e => e && e.tagName === 'CANVAS')")
    page.call("Emulation.clearDeviceMetricsOverride")


def test_pixels_follow_the_time_of_a_picture_and_a_still_one_is_sharp(page: Page, iiwa_fit: Fit) -> None:
    dpr = "window.__viserTestpoints?.devSettings.get().fixedDpr"
    with oc.view(iiwa_fit.chart, port=0) as view:
        page.open(view.url)
        page.wait("!!document.querySelector('[data-oc]') && !!document.querySelector('canvas')")
        page.wait(f"{dpr} >= 1")
        page.value(f"{button('Sweep')}.click()")
        page.wait(f"{dpr} < 1 && !!{button('Stop')}")
        page.value(f"{button('Stop')}.click()")
        page.wait(f"{dpr} >= 1")


def test_two_arms_on_a_closed_path(page: Page, iiwa_fit: Fit, tmp_path: Path) -> None:
    motions = cyclic_motions(iiwa_fit.chart, cycles=1)
    with oc.view(motions, robot=iiwa_fit.chart, port=0) as view:
        opened(page, view.url)
        to_the_end(page, 0)
        page.wait(f"({NUMBERS})['pseudo-inverse after 1'] > 0.1")
        shown = page.value(NUMBERS)
        assert shown["constant ξ after 1"] < 1e-6
        assert drawn(page, tmp_path / "arms.png")


def test_a_written_page_needs_no_server_and_no_network(page: Page, tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    chart = oc.fit(
        oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.6, 0.8, 0.8], 0.39)), oc.Linear()
    ).chart
    export_page(chart, tmp_path / "page.html")
    page.asked.clear()
    page.open((tmp_path / "page.html").as_uri() + COARSE.removeprefix("/"))
    page.wait("!!document.querySelector('canvas') && !!document.querySelector('.mantine-Slider-root')")  # of the player
    page.wait("+document.querySelector('input').value > 0.5")  # it plays
    assert drawn(page, tmp_path / "page.png")
    assert all(address.startswith(("file:", "data:", "blob:")) for address in page.asked)
    assert (tmp_path / "page.html").stat().st_size < 4 * 2**20


def test_the_command_line_serves_until_ctrl_c(page: Page, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "orthocas", "view", "iiwa", "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first, second = process.stdout.readline().split(), process.stdout.readline()
        assert "this machine only" in second
        opened(page, first[1])
        assert page.value(NUMBERS)["A1"] == 0.0
        process.send_signal(2)
        assert process.wait(20) == 130
        assert process.stderr is not None
        assert process.stderr.read() == "orthocas: interrupted\n"


def test_blocks_of_the_page_on_views_run(run: Run, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "how-to" / "view.md").read_text()
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL))
    printed = python(f"{code}\nfit.chart.save('arm.orthocas')", tmp_path).splitlines()
    assert printed == ["True"]
    assert (tmp_path / "motion.png").exists()
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL)).splitlines()
    (export,) = [line for line in lines if "--export" in line]
    code_, out, err = run(*export.split()[1:])
    assert (code_, err) == (0, "")
    assert out.startswith("page  page.html\nsize ")
