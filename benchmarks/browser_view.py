"""The page of a chart in chromium without a graphics card: pictures and updates a second in a sweep, and a screenshot.

Pixels follow the time of a picture, as they do for everybody; the last row shows full resolution all the time. Times of
the processor count all processes of the browser, so they tell more than rates on a busy machine. `--robot` takes a URDF
file with meshes.
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

SETTLING, SECONDS = 4.0, 5.0  # of a sweep, before and while it is measured
WINDOWS = (
    ("1500 x 900", (1500, 900), ""),
    ("390 x 844", (390, 844), ""),
    ("1500 x 900, sharp", (1500, 900), "fixedDpr=1"),
)
HEADER = (
    "| window [px] | resolution, as a share of the screen's | pictures a second | processor, a picture [ms] |\n"
    "| --- | --- | --- | --- |"
)
_COUNTERS = """
window.drawn = 0;
const clear = WebGL2RenderingContext.prototype.clear;
WebGL2RenderingContext.prototype.clear = function(...masks) { drawn++; return clear.apply(this, masks); }
"""
_SWEEP = "[...document.querySelectorAll('button')].find(b => /Sweep|Stop/.test(b.textContent))"


def main(
    out: Path = Path("out"), chart: Chart | None = None, robot: Path | None = None, patience: float = 6
) -> dict[str, float]:
    """Open the page of a chart, sweep a coordinate in windows of several sizes, and write `view.png`.

    Args:
        out: folder for `view.png`.
        chart: the chart; default: degree 4 on the box of the iiwa.
        robot: robot file with meshes.
        patience: time before the screenshot and the sweeps [s].
    """
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, float] = {}
    print(HEADER)
    with oc.view(chart or oc.fit(oc.problems.get("iiwa"), oc.Polynomial(4)).chart, robot_file=robot, port=0) as view:
        found["wishes solved, written and sent a second"] = _sent(view)
        for name, (wide, high), query in WINDOWS:
            with (
                TemporaryDirectory(ignore_cleanup_errors=True) as folder,
                browser(Path(folder) / "profile", (wide, high)) as page,
            ):
                page.call(
                    "Emulation.setDeviceMetricsOverride", width=wide, height=high, deviceScaleFactor=1,
                    mobile=wide < high,
                )  # fmt: skip
                page.call("Page.addScriptToEvaluateOnNewDocument", source=_COUNTERS)
                page.open(f"{view.url}/?{query}")
                page.wait("!!document.querySelector('canvas') && document.querySelectorAll('button').length > 3")
                time.sleep(patience)
                if name == WINDOWS[0][0]:
                    _move(page)
                    time.sleep(patience)  # it fades in, picture by picture
                    page.picture(out / "view.png")
                swept = _swept(page)
                numbers = f"{swept['pixels']:.2f} | {swept['pictures']:.1f} | {swept['processor']:.0f}"
                print(f"| {name} | {numbers} |", flush=True)
                found |= {f"{name}: {what}": value for what, value in swept.items()}
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
    """Pictures a second, their resolution, and time of the processor for each [ms], in a sweep."""
    page.value(f"{_SWEEP}.click()")
    time.sleep(SETTLING)
    page.value("drawn = 0")
    begin, cpu = time.perf_counter(), _cpu_seconds(page)
    time.sleep(SECONDS)
    pictures, pixels = page.value("[drawn, window.__viserTestpoints.devSettings.get().fixedDpr ?? devicePixelRatio]")
    seconds, cpu = time.perf_counter() - begin, _cpu_seconds(page) - cpu
    page.value(f"{_SWEEP}.click()")
    return {"pixels": pixels, "pictures": pictures / seconds, "processor": 1e3 * cpu / max(pictures, 1)}


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
    parser.add_argument("--patience", type=float, default=6)
    arguments = parser.parse_args()
    fitted = None
    if arguments.robot is not None:
        arm = oc.Robot.from_urdf(arguments.robot, arguments.tip)
        problem = oc.Problem(arm, oc.Task.position(arm), name=arguments.robot.stem)
        fitted = oc.fit(problem, oc.Polynomial(4)).chart
    main(arguments.out, fitted, arguments.robot, arguments.patience)
