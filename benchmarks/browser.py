"""A real browser for tests and benchmarks: chromium without a window, driven by its DevTools protocol."""

import base64
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_OPTIONS = (
    *("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--disable-gpu-compositing"),
    *("--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--no-first-run", "--hide-scrollbars"),
    *("--disable-extensions", "--disable-background-networking", "--disable-component-update"),
)
_PLAIN = ("--webgl-antialias-mode=none", "--webgl-msaa-sample-count=0")


class Page:
    """One tab."""

    def __init__(self, address: str, process: int) -> None:
        self.process = process  #: number of the browser's process
        self._socket = import_module("websockets.sync.client").connect(address, max_size=None)
        self._numbers = itertools.count(1)
        self.call("Page.enable")
        self.call("Runtime.enable")
        self.call("Network.enable")
        self.asked: list[str] = []  #: addresses that the page has asked for

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol, and wait for its answer."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("method") == "Network.requestWillBeSent":
                self.asked.append(message["params"]["request"]["url"])
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def open(self, url: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=url)

    def value(self, code: str) -> Any:
        """What an expression of JavaScript is in the page; promises are awaited."""
        found = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, code: str, seconds: float = 60.0) -> float:
        """Wait until an expression is true; how long that took [s]."""
        begin = time.monotonic()
        while not self.value(code):
            assert time.monotonic() - begin < seconds, f"{code} did not come true in {seconds} s"
            time.sleep(0.02)
        return time.monotonic() - begin

    def press(self, key: str) -> None:
        """Press a key, such as "End"."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def click(self, code: str) -> None:
        """Click the middle of an element that an expression gives."""
        middle = f"(b => [b.x + b.width / 2, b.y + b.height / 2])(({code}).getBoundingClientRect())"
        x, y = self.value(middle)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def picture(self, path: Path) -> None:
        """Write a screenshot."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))


@contextmanager
def browser(folder: Path, size: tuple[int, int] = (1000, 640), smooth: bool = True) -> Iterator[Page]:
    """A browser with an empty profile in a folder, and its tab.

    It renders without a graphics card, so small windows are faster, and pictures without antialiasing (`smooth`).
    """
    assert PROGRAM is not None
    options = (*_OPTIONS, *(() if smooth else _PLAIN), f"--window-size={size[0]},{size[1]}")
    words = [PROGRAM, *options, f"--user-data-dir={folder}", "about:blank"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port = _port(folder / "DevToolsActivePort", process)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
        yield Page(tabs[0]["webSocketDebuggerUrl"], process.pid)
    finally:
        process.terminate()
        process.wait(10)


def _port(path: Path, process: subprocess.Popen[bytes]) -> int:
    """The port that the browser writes to a file once it listens."""
    for _ in range(600):
        assert process.poll() is None, "the browser ended"
        if path.exists() and (lines := path.read_text().splitlines()):
            return int(lines[0])
        time.sleep(0.05)
    raise AssertionError("the browser does not start")
