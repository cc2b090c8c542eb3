"""The page of a chart in chromium: time to the first picture, updates a second during a sweep, and a screenshot.

The browser renders without a graphics card, so its own rates are lower bounds. `--robot` takes a URDF file with meshes.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from browser import Page, browser

import orthocas as oc
from orthocas.chart import Chart

SECONDS = 4.0  # of a sweep
_SIZE = (1500, 900)
_WATCH = """
window.seen = new Set();
new MutationObserver(() => seen.add([...document.querySelectorAll('.oc .row b')].map(b => b.dataset.value).join()))
    .observe(document.body, {childList: true, subtree: true})
"""


def main(
    out: Path, chart: Chart, robot: Path | None = None, coarse: bool = False, patience: float = 20
) -> dict[str, float]:
    """Open the page of a chart, sweep a coordinate, and take pictures.

    Args:
        out: folder for `view.png`.
        chart: the chart.
        robot: robot file with meshes.
        coarse: render a small picture, which shows what the numbers alone take.
        patience: time before the screenshot [s].
    """
    out.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    with oc.view(chart, robot_file=robot, port=0) as view, TemporaryDirectory() as folder:
        served = time.perf_counter() - begin
        session = view._page.session
        begin = time.perf_counter()
        for k in range(50):
            session.wish({"xi1": 0.01 * (k % 3)})
            session.follow()
            view._page._show()
        shown = 50 / (time.perf_counter() - begin)
        session.go_home()
        with browser(Path(folder) / "profile", (700, 500) if coarse else _SIZE) as page:
            page.open(view.url + ("/?fixedDpr=0.2" if coarse else ""))
            first = page.wait("!!document.querySelector('[data-oc]') && !!document.querySelector('canvas')")
            _move(page)
            time.sleep(5 if coarse else patience)  # it fades in, picture by picture
            page.picture(out / "view.png")
            rate = _swept(page)
    return {
        "page served after [s]": served,
        "first picture after [s]": first,
        "solved, written and sent a second": shown,
        "updates of the page a second": rate,
    }


def _move(page: Page) -> None:
    """Move the coordinate that the page has chosen for its ghosts to its end, and close what viser notes."""
    page.value("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
    chosen = page.value("[...document.querySelectorAll('input')].map(i => i.value).find(v => v.startsWith('xi'))")
    k = int(str(chosen).removeprefix("xi")) - 1
    page.value(f"document.querySelectorAll('.mantine-Slider-root')[{k}].querySelector('[role=slider]').focus()")
    page.press("End")


def _swept(page: Page) -> float:
    """How often the numbers of the page change in a second of a sweep."""
    page.value(_WATCH)
    page.click("[...document.querySelectorAll('button')].find(b => b.textContent.includes('Sweep'))")
    time.sleep(1.0)
    page.value("seen.clear()")
    begin = time.perf_counter()
    time.sleep(SECONDS)
    return float(page.value("seen.size")) / (time.perf_counter() - begin)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--robot", type=Path)
    parser.add_argument("--tip")
    parser.add_argument("--coarse", action="store_true")
    parser.add_argument("--patience", type=float, default=20)
    arguments = parser.parse_args()
    if arguments.robot is None:
        problem = oc.problems.get("iiwa")
    else:
        arm = oc.Robot.from_urdf(arguments.robot, arguments.tip)
        problem = oc.Problem(arm, oc.Task.position(arm), name=arguments.robot.stem)
    fitted = oc.fit(problem, oc.Polynomial(4)).chart
    for key, number in main(arguments.out, fitted, arguments.robot, arguments.coarse, arguments.patience).items():
        print(f"{key:>40}: {number:.4g}")
