"""The web server of views: viser, bound to one address, guarded, with one worker thread."""

import asyncio
import contextlib
import errno
import gzip
import hmac
import io
import ipaddress
import logging
import re
import secrets
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import lru_cache
from html import escape
from http import HTTPStatus
from importlib import import_module
from math import isfinite
from pathlib import Path
from threading import Lock
from types import ModuleType
from typing import Any

import numpy as np

from orthocas.errors import InvalidValueError, OrthocasError, ViewError
from orthocas.robots.robot import Robot
from orthocas.robots.spatial import rotate_z_to
from orthocas.tools.checks import Array, import_extra, require_count
from orthocas.viewer.looks import RULES, compute_chain_length

_INPUT, _CAMERA = "GuiUpdateMessage", "ViewerCameraMessage"
_HANDLE = {
    "TransformControlsUpdateMessage": {"wxyz": 4, "position": 3},
    "TransformControlsDragStartMessage": {},
    "TransformControlsDragEndMessage": {},
}
_CAMERA_NUMBERS = {
    "wxyz": 4,
    "position": 3,
    "look_at": 3,
    "up_direction": 3,
    "fov": 0,
    "near": 0,
    "far": 0,
    "image_height": 0,
    "image_width": 0,
}
_log = logging.getLogger(__name__)
#: log for websockets, which reports an error in one line
connections = logging.getLogger(f"{__name__}.connections")
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[0-9a-z._-]+)(?::\d{1,5})?")
LOCAL = "127.0.0.1"
TITLES = ("<title>Viser</title>", "<title>{} - orthocas</title>")  #: title of viser's page, and its replacement
_SCRIPT = Path(__file__).with_name("page.js")
Job = Callable[[], None]
Tick = Callable[[float], bool]  #: seconds since the start of an animation -> whether it continues
_starting = Lock()


class Inbox:
    """Passes valid messages to viser, and logs each rejected message in one line."""

    def __init__(self) -> None:
        self.input_of: Callable[[str], Any] = lambda uuid: None  #: uuid -> handle of an input, or None

    def find_fault(self, raw: object) -> str | None:
        """What is wrong with a message, in a few words; None if it is valid."""
        try:
            message = import_module("msgspec").msgpack.decode(raw)
        except Exception as error:
            # Messages are text or bytes, and may be malformed.
            return f"it cannot be read ({type(error).__name__})"
        kind = message.pop("type", None) if isinstance(message, dict) else None
        if not isinstance(kind, str) or kind not in (_CAMERA, _INPUT, *_HANDLE):
            return f"pages send no {_shorten(kind)}"
        # viser closes a connection if a field is unknown or missing.
        known = fields(getattr(import_module("viser._messages"), kind))
        needed = {field.name for field in known if field.default is MISSING}
        if not needed <= set(message) <= {field.name for field in known}:
            return f"its fields are {_shorten(list(message))}, expected {', '.join(sorted(needed))}"

        if kind == _CAMERA:
            return _check_numbers(message, _CAMERA_NUMBERS)
        if kind == _INPUT:
            return _check_words(message, "uuid") or self._check_updates(message["uuid"], message["updates"])
        return _check_words(message, "name", "owner") or _check_numbers(message, _HANDLE[kind])

    def _check_updates(self, uuid: str, updates: Any) -> str | None:
        """Check that a browser changes only the value of an input."""
        if not isinstance(updates, dict) or set(updates) != {"value"}:
            return f"it changes {_shorten(updates)}, expected a value"
        handle = self.input_of(uuid)
        # viser ignores inputs that no longer exist.
        return None if handle is None else _check_value(handle, updates["value"])

    def guard_handler(self, handler: Callable[[Any], Awaitable[None]]) -> Callable[[Any], Awaitable[None]]:
        """viser's connection handler without faulty messages; errors that occur nevertheless give one line."""

        async def handle(connection: Any) -> None:
            asyncio.get_running_loop().set_exception_handler(_report)
            receive = connection.recv

            async def receive_good() -> Any:
                while (fault := self.find_fault(raw := await receive())) is not None:
                    _log.warning("view: a message from a browser was dropped: %s", fault)
                return raw

            connection.recv = receive_good
            await handler(connection)

        return handle


def _check_words(message: dict[str, Any], *names: str) -> str | None:
    wrong = next((name for name in names if not isinstance(message.get(name, ""), str)), None)
    return None if wrong is None else f"{wrong} is {_shorten(message[wrong])}, expected text"


def _check_numbers(message: dict[str, Any], sizes: dict[str, int]) -> str | None:
    """Check the counts of numbers in the fields of a message; size 0 stands for a single number."""
    for name, size in sizes.items():
        numbers = message[name] if size else [message[name]]
        if not isinstance(numbers, list | tuple) or len(numbers) != (size or 1) or not all(map(_is_number, numbers)):
            return f"{name} is {_shorten(message[name])}, expected {size or 1} finite numbers"
    return None


def _check_value(handle: Any, value: Any) -> str | None:
    """Check that a value has the type of an input, and lies among the offered values."""
    if isinstance(handle.value, str):
        expected = f"one of {', '.join(handle.options)}"
        good = isinstance(value, str) and value in handle.options
    elif isinstance(handle.value, bool):
        expected, good = "true or false", isinstance(value, bool)
    else:
        # Limits may move while the user slides.
        slack = handle.max - handle.min
        expected = f"a number from {handle.min} to {handle.max}"
        good = _is_number(value) and handle.min - slack <= value <= handle.max + slack
    return None if good else f"a value is {_shorten(value)}, expected {expected}"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _shorten(value: object) -> str:
    """A value as short, escaped text on one line."""
    return ascii(value)[: RULES.message_length]


def _report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error in a task of the server in one line."""
    error = context.get("exception")
    _log.warning("view: %s: %s", context["message"], _shorten(error))
    _log.debug("in the server of the view", exc_info=error)


def _shorten_record(record: logging.LogRecord) -> bool:
    if record.exc_info:
        record.msg, record.args = f"view: {record.getMessage()}: {_shorten(record.exc_info[1])}", ()
        record.exc_info = None
    return True


connections.addFilter(_shorten_record)


# Module that starts viser's server.
_VISER = "viser.infra._infra"


class Loop:
    """Runs jobs and animation ticks in one thread, and calls `settle` once after a pause without jobs.

    Args:
        settle: called after a quarter of a second without jobs.
        failed: called with the error of a job.
    """

    def __init__(self, settle: Job, failed: Callable[[Exception], None]) -> None:
        self._settle, self._failed = settle, failed
        self._jobs: dict[str, Job] = {}
        self._tick: Tick | None = None
        self._begun = 0.0
        self._wake = threading.Condition()
        self._running = False
        self._thread = threading.Thread(target=self._run, name="orthocas view", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._running = True
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread after the current job."""
        with self._wake:
            self._running = False
            self._wake.notify()
        if self._thread is not threading.current_thread() and self._thread.is_alive():
            self._thread.join(timeout=2.0)

    def ask(self, what: str, job: Job) -> None:
        """Queue a job. It replaces a waiting job of the same name."""
        with self._wake:
            self._jobs.pop(what, None)
            self._jobs[what] = job
            self._wake.notify()

    def animate(self, tick: Tick | None) -> None:
        """Call a function up to 30 times per second until it returns False; None stops an animation."""
        with self._wake:
            self._tick, self._begun = tick, time.monotonic()
            self._wake.notify()

    def build_handler(self, what: str, job: Job) -> Callable[[Any], Awaitable[None]]:
        """A viser callback that queues a job."""

        async def handle(event: Any) -> None:
            self.ask(what, job)

        return handle

    def _run(self) -> None:
        settled = True
        while self._running:
            # Wait for a job, a tick, or the end.
            with self._wake:
                if not self._jobs and self._running:
                    self._wake.wait(RULES.tick if self._tick else None if settled else RULES.quiet)
                jobs, self._jobs, tick = list(self._jobs.values()), {}, self._tick
            # Settle once after a pause without jobs.
            if not jobs and tick is None and not settled:
                jobs, settled = [self._settle], True
            elif jobs or tick is not None:
                settled = False
            for job in jobs:
                self._do(job)
            if tick is not None:
                self._do(lambda tick=tick: self._advance(tick))  # type: ignore[misc]

    def _advance(self, tick: Tick) -> None:
        """Run one tick of an animation."""
        # An error also ends the animation.
        goes_on = False
        try:
            goes_on = tick(time.monotonic() - self._begun)
        finally:
            with self._wake:
                self._tick = None if self._tick is tick and not goes_on else self._tick

    def _do(self, job: Job) -> None:
        try:
            job()
        except Exception as error:
            # Show the error on the page and continue.
            _log.debug("a job of the view failed", exc_info=True)
            self._failed(error)


@dataclass(frozen=True)
class Guard:
    """Admits or refuses requests for pages and websockets by their path and their headers `Host` and `Origin`.

    A browser sets both headers, and pages cannot change them. `Host` is the address that the browser requested. A
    foreign name there means that this name was made to resolve to this server (DNS rebinding). `Origin` is the page
    that sends the request; it must be a page of this server. The path begins with a random token. So nobody without the
    address gets any content, not even viser's own page, which could be made to connect to another server.
    """

    host: str  #: address that the server listens at
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    seen: list[bool] = field(default_factory=list)  #: not empty after a server was guarded
    inbox: Inbox = field(default_factory=Inbox)  #: checks messages of websockets
    title: str = "view"  #: title of the page

    def admit(self, path: str, hosts: list[str], origins: list[str]) -> str | None:
        """The path of a request after the token; None if the request is refused.

        Args:
            path: path and query of the request.
            hosts: all headers `Host`.
            origins: all headers `Origin`; programs other than browsers send none, and browsers send none when they open
                a page.
        """
        # The token must be right, and the requesting page must belong to this server.
        place, mark, query = path.partition("?")
        first, _, rest = place.removeprefix("/").partition("/")
        right_token = hmac.compare_digest(first.encode(errors="replace"), self.token.encode())
        own = len(hosts) == 1 and self._is_own(hosts[0]) and origins in ([], [f"http://{hosts[0]}"])
        return f"/{rest}{mark}{query}" if right_token and own else None

    def _is_own(self, host: str) -> bool:
        """Whether a header `Host` can refer to this server. Any port is accepted, because tunnels change it.

        A server that other machines can reach does not know all its addresses, behind routers and in containers. So it
        accepts all numeric addresses, because DNS rebinding always sends a name in `Host`.
        """
        match = _HOST.fullmatch(host.lower())
        if match is None:
            return False
        name = match["name"].strip("[]")
        own = is_local(self.host)
        # A name must be localhost or the configured host.
        if name in ("localhost", self.host.lower()):
            return True
        # A number must be this machine's, or any if others may reach the server.
        try:
            return ipaddress.ip_address(name).is_loopback or not own
        except ValueError:
            return not own and name == socket.gethostname().lower()


def is_local(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@contextmanager
def guard_server(host: str, title: str) -> Iterator[Guard]:
    """Guard the server that viser starts within this context.

    viser has no option for this. It looks up the function `serve` of the package websockets when it starts, so this
    context replaces the function by one that calls the guard before viser's own handlers.

    If a later version of viser starts its server differently, `Guard.seen` stays empty.
    """
    guard, module = Guard(host, title=title), _import_server()
    with _starting:
        serve = module.serve
        module.serve = _add_guard(serve, guard)
        try:
            yield guard
        finally:
            module.serve = serve


def _import_server() -> Any:
    """The module in which viser looks up `serve`."""
    return import_module("websockets.asyncio.server")


def _add_guard(serve: Callable[..., Any], guard: Guard) -> Callable[..., Any]:
    """A `serve` that calls the guard first for viser's servers, and leaves other servers unchanged."""
    answer_of = import_module("websockets.http11").Response
    headers_of = import_module("websockets.datastructures").Headers

    class Attentive(_import_server().ServerConnection):  # type: ignore[misc]
        """A connection that closes if it sends no request: browsers keep idle ones, and closing them took 6 s."""

        async def handshake(self, *arguments: Any, **options: Any) -> None:
            events = [self.request_rcvd, self.connection_lost_waiter]
            await asyncio.wait(events, timeout=RULES.silence, return_when=asyncio.FIRST_COMPLETED)
            if any(future.done() for future in events):
                await super().handshake(*arguments, **options)

    # Guard viser's server and limit its messages.
    def serve_guarded(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        if getattr(handler, "__module__", None) != _VISER:
            return serve(handler, *arguments, process_request=process_request, **options)
        guard.seen.append(True)

        def judge(connection: Any, request: Any) -> Any:
            headers = request.headers
            path = guard.admit(request.path, headers.get_all("Host"), headers.get_all("Origin"))
            if path is None:
                text = b"Open the whole address that orthocas printed.\n"
                fields = headers_of({"Content-Type": "text/plain", "Content-Length": str(len(text))})
                return answer_of(HTTPStatus.FORBIDDEN, "Forbidden", fields, text)
            return rename_page(process_request(connection, replace(request, path=path)), guard.title)

        limits = {"max_size": RULES.largest_message, "logger": connections, "create_connection": Attentive}
        return serve(guard.inbox.guard_handler(handler), *arguments, process_request=judge, **{**options, **limits})

    return serve_guarded


def rename_page(answer: Any, title: str) -> Any:
    """Replace the title in an answer with viser's page; other answers stay unchanged."""
    if answer is None or "html" not in answer.headers.get("Content-Type", ""):
        return answer
    body = build_page(answer.body, title, answer.headers.get("Content-Encoding") == "gzip")
    headers = answer.headers.copy()
    # Delete the header first, because assignment would add a second one.
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(body))
    return replace(answer, headers=headers, body=body)


@lru_cache(maxsize=2)
def build_page(body: bytes, title: str, packed: bool = False) -> bytes:
    """viser's page with another title, and with our script before its own."""
    page = gzip.decompress(body) if packed else body
    page = page.replace(TITLES[0].encode(), TITLES[1].format(escape(title)).encode(), 1)
    page = page.replace(b"<head>", b"<head><script>" + _SCRIPT.read_bytes() + b"</script>", 1)
    return gzip.compress(page) if packed else page


def viser() -> ModuleType:
    """Import the package `viser`, which only views need.

    Raises:
        MissingExtraError: if it is not installed.
    """
    return import_extra("viser", "a view in the browser", "view")


def open_window(host: str, port: int, title: str) -> tuple[Any, str]:
    """A `viser.ViserServer`, and its address for a browser; port 0 takes any free port.

    Raises:
        MissingExtraError: if viser is not installed.
        ViewError: if the port is taken, the host is not an address of this machine, or viser cannot be guarded.
    """
    package = viser()
    require_free(host, port)
    # Start viser's server with the guard, and suppress its announcement.
    with guard_server(host, title) as guard, contextlib.redirect_stdout(io.StringIO()):
        server = package.ViserServer(host=host, port=port, label=title, verbose=False)
    inputs = getattr(server.gui, "_gui_input_handle_from_uuid", None)
    if not guard.seen or inputs is None:
        close_window(server)
        raise ViewError(
            "this version of viser starts its server differently and cannot be guarded, expected a supported version"
        )
    # Another program has taken the port meanwhile.
    if port not in (0, server.get_port()):
        close_window(server)
        raise _build_taken_error(host, port)
    # Disable sharing through an external server, which any page in the browser could request.
    guard.inbox.input_of = inputs.get
    server.request_share_url = lambda verbose=True: None
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=RULES.brand)
    server.scene.configure_environment_map(None)
    # Shadows are off; `place_lights` adds lights without them.
    server.scene.configure_default_lights(False)
    return server, f"{build_url(host, server.get_port())}/{guard.token}"


def show_error(server: Any, error: Exception) -> None:
    """Show an error on the page."""
    text = str(error) if isinstance(error, OrthocasError) else f"{type(error).__name__}: {error}"
    for client in server.get_clients().values():
        client.add_notification("This did not work", text, color="red", auto_close_seconds=8.0)


def close_window(server: Any) -> None:
    """Stop a server; open pages then report a lost connection."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def require_free(host: str, port: int) -> None:
    """Check that a server can listen on a port, because viser would wait forever or take another one.

    Raises:
        InvalidValueError: if the port is not a number from 0 to 65535.
        ViewError: if the port is taken, or the host is not an address of this machine.
    """
    require_count("port", port, least=0, most=65535)
    if not isinstance(host, str) or not host:
        raise InvalidValueError("host", repr(host)[:80], "an address of this machine, such as 127.0.0.1")
    try:
        # Avoid name look-ups over the network.
        numeric = 0 if host == "localhost" else socket.AI_NUMERICHOST
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=numeric)[0]
    except (OSError, UnicodeError):
        raise ViewError(f"host is {host[:80]!r}, expected an address of this machine, such as {LOCAL}") from None
    with socket.socket(family, kind, protocol) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(address)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise _build_taken_error(host, port) from None
            if error.errno == errno.EACCES:
                raise ViewError(f"port is {port}, which this user may not open; expected one from 1024 on") from None
            raise ViewError(f"host is {host[:80]!r}, expected an address of this machine, such as {LOCAL}") from None


def build_url(host: str, port: int) -> str:
    """The address for a browser, without its token."""
    shown = LOCAL if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{shown}:{port}"


def place_scene(server: Any, robot: Robot, q: Array, shift: Array | None = None) -> None:
    """Place floor, lights and camera; see `place_camera`."""
    place_floor(server, robot)
    place_lights(server, robot)
    place_camera(server, robot, q, shift)


def place_camera(server: Any, robot: Robot, q: Array, shift: Array | None = None) -> None:
    """Place the camera in front of an arm and slightly above, or perpendicular to the plane of a planar arm.

    Args:
        server: the viser server.
        robot: the arm.
        q: joint positions (N, n) that the picture should show.
        shift: positions of further arms, (k, 3) [m].
    """
    # A sphere around all arms in all these positions.
    points = robot.joint_points(q).reshape(-1, 3)
    points = np.concatenate([points, *(points + other for other in ([] if shift is None else shift))])
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.4 * compute_chain_length(robot.tree))
    # Choose the distance from the sphere, and adapt it to the shape of the picture.
    up = compute_up(robot)
    server.scene.set_up_direction(tuple(up))
    frame = Framing(centre, compute_camera_direction(robot), RULES.room * radius / np.sin(RULES.view_angle / 2))
    camera = server.initial_camera
    camera.fov = RULES.view_angle
    position, look_at = frame.compute_view(1, 1)
    camera.position, camera.look_at = tuple(position), tuple(look_at)
    server.on_client_connect(frame.keep)


@dataclass(frozen=True, eq=False)
class Framing:
    """Keeps arms inside pictures of any shape, until a user turns the scene."""

    centre: Array  #: centre of the arms (3,) [m]
    direction: Array  #: unit vector to the camera (3,)
    distance: float  #: camera distance for a picture at least as wide as high [m]

    def compute_view(self, width: float, height: float) -> tuple[Array, Array]:
        """Camera position and its target point (3,) [m] for a picture size in pixels."""
        return self.centre + self.distance * height / min(width, height) * self.direction, self.centre

    def keep(self, client: Any) -> None:
        """Move a browser's camera when its picture changes shape."""
        size, places, elsewhere = (0, 0), [np.array(client.camera.position)], float("inf")

        def changed(camera: Any) -> None:
            nonlocal size, elsewhere
            if min(camera.image_width, camera.image_height) < 1 or np.allclose(camera.look_at, camera.position):
                # There is no picture.
                return
            if not any(
                np.allclose(camera.position, place, atol=RULES.camera_slack * self.distance) for place in places
            ):
                elsewhere = min(elsewhere, time.monotonic())
                if time.monotonic() - elsewhere > RULES.camera_pause:
                    # A user has turned the scene.
                    places.clear()
                return
            elsewhere = float("inf")
            if size != (camera.image_width, camera.image_height):
                size = camera.image_width, camera.image_height
                position, look_at = self.compute_view(*size)
                places.append(position)
                with client.atomic():
                    camera.position = position
                    camera.look_at = look_at

        client.camera.on_update(changed)
        changed(client.camera)


def place_panels(server: Any) -> Any:
    """Place sliders on the right and readings on the left of the scene; returns the HTML handle of the readings."""
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(RULES.panel_widths[1])
    panel = server.gui.add_panel()
    with panel.add_tab("Readings", "gauge"):
        html = server.gui.add_html("")
    panel.dock_left()
    panel.set_width(RULES.panel_widths[0])
    return html


def place_floor(server: Any, robot: Robot) -> None:
    """A round grid under an arm, or behind a planar arm, that fades into the background.

    It consists of lines, because viser's own grid computes every point of the floor, which is slow without a graphics
    card.
    """
    size = compute_chain_length(robot.tree)
    radius = RULES.floor * size
    decade = 10.0 ** np.floor(np.log10(size / 5))
    cell = decade * max(part for part in (1, 2, 5) if part * decade <= size / 5)
    numbers = np.arange(-int(radius / cell), int(radius / cell) + 1)
    half = np.sqrt(radius**2 - (cell * numbers) ** 2)
    # Equally spaced lines, cut off by the circle, with four points each for fading towards both ends.
    along = np.outer(half, [-1.0, -RULES.fade, RULES.fade, 1.0])  # (lines, 4)
    across = np.repeat(cell * numbers[:, None], 4, axis=1)
    points = np.stack([along, across, 0 * along], axis=2)
    shade = np.where((numbers % 5 == 0)[:, None], *RULES.grid)
    # Fade into the white background.
    fade = np.stack([0 * shade + 255, shade, shade, 0 * shade + 255], axis=1)
    lines, colours = np.concatenate([points, points[..., [1, 0, 2]]]), np.concatenate([fade, fade])
    lines = lines - [0.0, 0.0, 0.15 * size] if is_planar(robot) else lines @ rotate_z_to(compute_up(robot)).T
    ends, tones = (np.stack([rows[:, :-1], rows[:, 1:]], axis=2).reshape(-1, 2, 3) for rows in (lines, colours))
    server.scene.add_line_segments("/floor", ends, tones.astype(np.uint8), thickness=RULES.line * size)


def place_lights(server: Any, robot: Robot) -> None:
    """Light from the sky, from the left of the camera, and weaker light from its right.

    Shadows and an environment map are off, because they take most of the drawing time without a graphics card.
    """
    scene, up, ahead = server.scene, compute_up(robot), compute_camera_direction(robot)
    left = np.cross(ahead, up)
    scene.add_light_hemisphere(
        "/lights/sky", sky_color=(255, 255, 255), ground_color=(150, 156, 166), intensity=2.1, position=tuple(up)
    )
    for name, intensity, place in (("key", 1.8, left + 1.5 * up + ahead), ("fill", 0.5, ahead - left)):
        scene.add_light_directional(f"/lights/{name}", intensity=intensity, position=tuple(map(float, place)))


def is_planar(robot: Robot) -> bool:
    """Whether all joints move in the x-y plane."""
    tree = robot.tree
    return bool(
        np.abs(tree.rotations[:, 2] - [0, 0, 1]).max() < RULES.flat
        and np.abs(tree.translations[:, 2]).max() < RULES.flat
    )


def compute_camera_direction(robot: Robot) -> Array:
    """Unit vector to the camera: oblique from the front and above, or perpendicular to the plane of a planar arm."""
    if is_planar(robot):
        return np.array([0.0, 0.0, 1.0])
    up = compute_up(robot)
    ahead = np.eye(3)[int(np.argmin(np.abs(up)))]
    ahead = ahead - (ahead @ up) * up
    direction = ahead / np.linalg.norm(ahead) - 1.25 * np.cross(up, ahead) + 0.55 * up
    return np.asarray(direction / np.linalg.norm(direction))


def compute_up(robot: Robot) -> Array:
    """Unit vector against gravity; z without gravity."""
    gravity = robot.tree.gravity
    strength = float(np.linalg.norm(gravity))
    return np.array([0.0, 0.0, 1.0]) if strength < RULES.flat else -gravity / strength


def _build_taken_error(host: str, port: int) -> ViewError:
    return ViewError(f"port {port} of {host} is taken, expected a free one; 0 finds one")
