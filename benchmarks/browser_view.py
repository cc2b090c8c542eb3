"""The page of a chart in chromium: time to the first picture, updates and pictures a second, and a screenshot.

The browser renders without a graphics card. What it draws is measured in a large window, in one of 1000 x 640, in that
without antialiasing, and in that with a coarse picture (`?fixedDpr=0.3`), which shows what is left when drawing takes
little. Times of the processor count all processes of the browser, so they tell more than rates on a busy machine.
`--robot` takes a URDF file with meshes.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
from browser import Page, browser

import orthocas as oc
from orthocas.charts.chart import Chart
from orthocas.viewer import View

SECONDS = 4.0  # of a sweep
SIZES = (
    ("1500 x 900", (1500, 900), 1.0, True),
    ("1000 x 640", (1000, 640), 1.0, True),
    ("1000 x 640, no antialiasing", (1000, 640), 1.0, False),
    ("1000 x 640, coarse", (1000, 640), 0.3, True),
)
_COUNTERS = """
window.drawn = 0;
const clear = WebGL2RenderingContext.prototype.clear;
WebGL2RenderingContext.prototype.clear = function(...masks) { drawn++; return clear.apply(this, masks); }
"""
_WATCH = """
window.seen = new Set();
new MutationObserver(() => seen.add([...document.querySelectorAll('.oc .row b')].map(b => b.dataset.value).join()))
    .observe(document.body, {childList: true, subtree: true})
"""
_SWEEP = "[...document.querySelectorAll('button')].find(b => /Sweep|Stop/.test(b.textContent))"


def main(out: Path, chart: Chart, robot: Path | None = None, patience: float = 20) -> dict[str, float]:
    """Open the page of a chart, sweep a coordinate in pictures of several sizes, and write `view.png`.

    Args:
        out: folder for `view.png`.
        chart: the chart.
        robot: robot file with meshes.
        patience: time before the screenshot [s].
    """
    out.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    with oc.view(chart, robot_file=robot, port=0) as view:
        found = {"page served after [s]": time.perf_counter() - begin, "solved, written and sent a second": _sent(view)}
        for name, size, detail, smooth in SIZES:
            with TemporaryDirectory() as folder, browser(Path(folder) / "profile", size, smooth) as page:
                page.call("Page.addScriptToEvaluateOnNewDocument", source=_COUNTERS)
                page.open(f"{view.url}/?fixedDpr={detail}")
                first = page.wait("!!document.querySelector('[data-oc]') && !!document.querySelector('canvas')")
                found[f"{name}: first picture after [s]"] = first
                if name == SIZES[0][0]:
                    _move(page)
                    time.sleep(patience)  # it fades in, picture by picture
                    page.picture(out / "view.png")
                found |= {f"{name}: {what}": value for what, value in _swept(page).items()}
    return found


def _sent(view: View) -> float:
    """How often a second the session is solved, and its page written and sent."""
    session = view._page.session
    begin = time.perf_counter()
    for k in range(50):
        session.wish({"xi1": 0.01 * (k % 3)})
        session.follow()
        view._page._show()
    rate = 50 / (time.perf_counter() - begin)
    session.go_home()
    return rate


def _move(page: Page) -> None:
    """Move the coordinate that the page has chosen for its ghosts to its end, and close what viser notes."""
    page.value("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
    chosen = page.value("[...document.querySelectorAll('input')].map(i => i.value).find(v => v.startsWith('xi'))")
    k = int(str(chosen).removeprefix("xi")) - 1
    page.value(f"document.querySelectorAll('.mantine-Slider-root')[{k}].querySelector('[role=slider]').focus()")
    page.press("End")


def _swept(page: Page) -> dict[str, float]:
    """Updates of the numbers of the page, pictures, and time of the processor, in a sweep."""
    page.value(_WATCH)
    page.value(f"{_SWEEP}.click()")
    time.sleep(1.0)
    page.value("drawn = 0; seen.clear()")
    begin, cpu = time.perf_counter(), _cpu_seconds(page)
    time.sleep(SECONDS)
    updates, pictures = page.value("[seen.size, drawn]")
    seconds, cpu = time.perf_counter() - begin, _cpu_seconds(page) - cpu
    page.value(f"{_SWEEP}.click()")
    return {
        "updates a second": updates / seconds,
        "pictures a second": pictures / seconds,
        "time of the processor for a picture [ms]": 1e3 * cpu / max(pictures, 1),
    }


def _cpu_seconds(page: Page) -> float:
    """Time of the processor that all processes of a browser have taken [s]."""
    process = psutil.Process(page.process)
    times = [part.cpu_times() for part in (process, *process.children(recursive=True))]
    return sum(part.user + part.system for part in times)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--robot", type=Path)
    parser.add_argument("--tip")
    parser.add_argument("--patience", type=float, default=20)
    arguments = parser.parse_args()
    if arguments.robot is None:
        problem = oc.problems.get("iiwa")
    else:
        arm = oc.Robot.from_urdf(arguments.robot, arguments.tip)
        problem = oc.Problem(arm, oc.Task.position(arm), name=arguments.robot.stem)
    fitted = oc.fit(problem, oc.Polynomial(4)).chart
    for key, number in main(arguments.out, fitted, arguments.robot, arguments.patience).items():
        print(f"{key:>62}: {number:.4g}")
