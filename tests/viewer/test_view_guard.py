"""Who gets a page or a websocket of a view: forged headers and paths from raw clients, and pages in a real browser."""

import gzip
import http.client
import http.server
import socket
import threading
import urllib.request
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from browser import PROGRAM, browser
from fuzz.views import views

import orthocas as oc
from orthocas.errors import ViewError
from orthocas.viewer import View, window
from orthocas.viewer.window import Guard

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="no viser: pip install 'orthocas[view]'")
TOKEN = "/secret"
FOREIGN = (
    "http://evil.example",
    "https://evil.example",
    "null",
    "file://",
    "",
    "http://evil.example:8080",
    "http://127.0.0.1:3000",  # another server of this machine
    "http://localhost:8080",  # the same server by another name, which the page itself never uses
    "https://127.0.0.1:8080",
    "http://127.0.0.1:8080.evil.example",
    "http://127.0.0.1:8080@evil.example",
    "http://127.0.0.1",
    "http://user@127.0.0.1:8080",
    "chrome-extension://abcdefghijklmnop",
    "vscode-webview://abcdef",
    "data:",
    "about:blank",
    "ws://127.0.0.1:8080",
    "http://127.0.0.1:8080/",
    "HTTP://127.0.0.1:8080 http://evil.example",
)
FOREIGN_HOSTS = (
    *("evil.example", "evil.example:8080", "127.0.0.1.evil.example:8080", "localhost.evil.example", "localhost.", ""),
    *("192.0.2.7:8080", "0.0.0.0:8080", "[::]:8080", "127.0.0.1:8080@evil.example", "2130706433", "127.1", "[evil]"),
    *("localhost:8080, evil.example", "localhost evil.example", "localhost:99999999", "::1", "127.0.0.1:"),
)


@pytest.mark.parametrize("origin", FOREIGN)
def test_foreign_origins_are_refused(origin: str) -> None:
    assert Guard("127.0.0.1", TOKEN[1:]).admit(TOKEN, ["127.0.0.1:8080"], [origin]) is None


@pytest.mark.parametrize("host", FOREIGN_HOSTS)
def test_foreign_hosts_are_refused(host: str) -> None:
    for origins in ([], [f"http://{host}"]):
        assert Guard("127.0.0.1", TOKEN[1:]).admit(TOKEN, [host], origins) is None


@pytest.mark.parametrize("path", ["", "/", "/secre", "/secrets", "//secret", "/?/secret", "/%73ecret", "/\udcff", "/é"])
def test_paths_without_the_token_are_refused(path: str) -> None:
    assert Guard("127.0.0.1", TOKEN[1:]).admit(path, ["127.0.0.1:8080"], []) is None


def test_doubled_and_missing_headers_are_refused() -> None:
    guard, own = Guard("127.0.0.1", TOKEN[1:]), "127.0.0.1:8080"
    assert guard.admit(TOKEN, [], []) is None
    assert guard.admit(TOKEN, [own, own], []) is None
    assert guard.admit(TOKEN, [own], [f"http://{own}", "http://evil.example"]) is None


@pytest.mark.parametrize("host", ["localhost:8080", "LocalHost", "127.0.0.1:8080", "127.0.0.2", "[::1]:8080", "[::1]"])
def test_addresses_of_this_machine_are_let_in(host: str) -> None:
    guard = Guard("127.0.0.1", TOKEN[1:])
    assert guard.admit(TOKEN, [host], []) == "/"
    assert guard.admit(f"{TOKEN}/?fixedDpr=0.3", [host], [f"http://{host}"]) == "/?fixedDpr=0.3"
    assert guard.admit(f"{TOKEN}?websocket=ws://{host}{TOKEN}", [host], []) == f"/?websocket=ws://{host}{TOKEN}"


def test_a_server_that_others_reach_takes_its_addresses_but_no_foreign_name() -> None:
    guard = Guard("0.0.0.0", TOKEN[1:])  # the point
    for host in ("192.0.2.7:8080", "[2001:db8::7]:8080", "localhost:8080", f"{socket.gethostname()}:8080"):
        assert guard.admit(TOKEN, [host], [f"http://{host}"]) == "/"
    for host in ("evil.example:8080", "localhost.evil.example:8080", "192.0.2.7.evil.example"):
        assert guard.admit(TOKEN, [host], [f"http://{host}"]) is None
    assert guard.admit(TOKEN, ["192.0.2.7:8080"], ["http://192.0.2.8:8080"]) is None
    assert Guard("192.0.2.7", TOKEN[1:]).admit(TOKEN, ["192.0.2.7:8080"], []) == "/"


def test_tokens_differ_and_cannot_be_guessed() -> None:
    tokens = {Guard("127.0.0.1").token for _ in range(100)}
    assert len(tokens) == 100
    assert all(len(token) >= 22 for token in tokens)  # 128 bits, 6 in each character


@pytest.fixture(scope="module")
def view() -> Iterator[View]:
    with oc.view(oc.Robot.planar([1.0, 1.0], [1.0, 1.0]), port=0) as shown:
        yield shown


def status(url: str, path: str, **headers: str) -> int:
    """The status of a page that is asked for with these headers."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=20)
    connection.request("GET", path, headers=headers)
    found = connection.getresponse().status
    connection.close()
    return found


def title(url: str, packed: str) -> str:
    """The title of a page that is asked for plain, or compressed."""
    request = urllib.request.Request(url, headers={"Accept-Encoding": packed})
    with urllib.request.urlopen(request, timeout=20) as answer:
        assert answer.headers.get_all("Content-Encoding") == [packed]
        body = answer.read()
        assert answer.headers.get_all("Content-Length") == [str(len(body))]
    text = (gzip.decompress(body) if packed == "gzip" else body).decode()
    return text.partition("<title>")[2].partition("</title>")[0]


def connected(url: str, path: str, origin: str | None, host: str | None = None) -> Any:
    """A websocket of viser's protocol; raises InvalidStatus if the server refuses it."""
    viser = import_module("viser")
    parts = urlsplit(url)
    link = socket.create_connection((parts.hostname, parts.port), timeout=20)
    return import_module("websockets.sync.client").connect(
        f"ws://{host or parts.netloc}{path}",
        sock=link,
        subprotocols=[f"viser-v{viser.__version__}"],
        origin=origin,
        max_size=None,
    )


@needs_viser
def test_pages_are_served_to_those_with_the_address_only(view: View) -> None:
    parts = urlsplit(view.url)
    assert status(view.url, parts.path) == 200
    for packed in ("identity", "gzip"):
        assert title(view.url, packed) == "tip - orthocas"
    assert status(view.url, f"{parts.path}/?fixedDpr=0.3", Origin=f"http://{parts.netloc}") == 200
    assert status(view.url, parts.path, Host=f"localhost:{parts.port}") == 200
    assert status(view.url, "/") == 403
    assert status(view.url, f"/?websocket=ws://evil.example{parts.path}") == 403
    assert status(view.url, parts.path, Host="evil.example") == 403  # a name that leads here
    assert status(view.url, parts.path, Origin="http://evil.example") == 403
    assert status(view.url, f"{parts.path}/../../../etc/passwd") == 404


@needs_viser
def test_websockets_are_opened_to_own_pages_only(view: View) -> None:
    refused = import_module("websockets.exceptions").InvalidStatus
    parts = urlsplit(view.url)
    for origin in (None, f"http://{parts.netloc}"):
        with connected(view.url, parts.path, origin) as socket_:
            assert isinstance(socket_.recv(timeout=20), bytes)
    with connected(view.url, parts.path, f"http://localhost:{parts.port}", f"localhost:{parts.port}") as socket_:
        assert isinstance(socket_.recv(timeout=20), bytes)
    for origin in FOREIGN[:8]:
        with pytest.raises(refused, match="HTTP 403"):
            connected(view.url, parts.path, origin)
    with pytest.raises(refused, match="HTTP 403"):
        connected(view.url, parts.path, "http://evil.example:1", "evil.example:1")
    with pytest.raises(refused, match="HTTP 403"):
        connected(view.url, "/", f"http://{parts.netloc}")


@needs_viser
def test_huge_messages_end_the_connection(view: View) -> None:
    closed = import_module("websockets.exceptions").ConnectionClosedError
    with connected(view.url, urlsplit(view.url).path, None) as socket_:
        socket_.send(bytes(2**20 + 1))
        with pytest.raises(closed, match="1009"):
            list(socket_)


@needs_viser
def test_other_servers_are_not_guarded_and_an_unguarded_viser_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    server = import_module("websockets.asyncio.server")
    before = server.serve
    with oc.view(oc.Robot.planar([1.0, 1.0], [1.0, 1.0]), port=0):
        assert server.serve is before
    monkeypatch.setattr("orthocas.viewer.window._VISER", "another.module")
    closed = []
    monkeypatch.setattr(window, "close_window", lambda server: (closed.append(server), server.stop()))
    with pytest.raises(ViewError, match="cannot be guarded"):
        oc.view(oc.Robot.planar([1.0, 1.0], [1.0, 1.0]), port=0)
    assert len(closed) == 1


ATTACK = """new Promise(done => {
  const socket = new WebSocket(URL_HERE, ["viser-vVERSION"]);
  socket.onmessage = () => done("in");
  socket.onerror = () => done("out");
  setTimeout(() => done("nothing"), 20000);
})"""


@needs_viser
@pytest.mark.slow
def test_pages_of_others_in_a_real_browser_get_no_websocket(view: View, tmp_path: Path) -> None:
    """Even with the whole address: an origin of another port, a file, and a sandboxed frame, whose origin is null."""
    if PROGRAM is None:
        pytest.skip("no chromium: apt-get install chromium")
    code = ATTACK.replace("URL_HERE", repr(view.url.replace("http", "ws"))).replace(
        "VERSION", import_module("viser").__version__
    )
    (tmp_path / "evil.html").write_text("<html><body>evil</body></html>")
    serve = http.server.ThreadingHTTPServer  # browsers keep spare connections, for which others would wait
    handler = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *words: None})
    with (
        serve(("127.0.0.1", 0), lambda *words: handler(*words, directory=str(tmp_path))) as evil,
        browser(tmp_path / "profile", (400, 300), smooth=False) as page,
    ):
        threading.Thread(target=evil.serve_forever, daemon=True).start()
        for address in (f"http://127.0.0.1:{evil.server_port}/evil.html", (tmp_path / "evil.html").as_uri()):
            page.open(address)
            page.wait("document.body && document.body.textContent === 'evil'")
            assert page.value(code) == "out"
        sandboxed = f"""new Promise(done => {{
          onmessage = event => done(event.data);
          const frame = document.createElement('iframe');
          frame.sandbox = 'allow-scripts';
          frame.srcdoc = `<script>({code}).then(word => parent.postMessage(word, '*'))</` + `script>`;
          document.body.append(frame);
        }})"""
        assert page.value(sandboxed) == "out"
        page.open(view.url)  # the same script in the page's own origin, and the page itself
        page.wait("!!document.querySelector('canvas')")
        assert page.value(code) == "in"
        assert page.value("document.title").endswith(" - orthocas")
        page.open(page.value("location.href"))  # viser adds to the address; it stays one that can be opened
        page.wait("!!document.querySelector('canvas')")
        evil.shutdown()


@pytest.mark.slow
def test_spoiled_requests_are_refused_and_good_ones_served() -> None:
    assert views(300) == []
