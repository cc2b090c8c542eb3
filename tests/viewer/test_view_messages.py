"""What browsers can do to a page through their websocket: move what it offers, and nothing else."""

import asyncio
import logging
import time
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from fuzz.messages import good, messages, page
from public_objects import fitted, trajectory
from test_view_guard import connected
from test_view_pages import wait

import orthocas as oc
from orthocas.viewer import View
from orthocas.viewer.view import RobotPage
from orthocas.viewer.window import _CAMERA_NUMBERS

pytestmark = pytest.mark.skipif(find_spec("viser") is None, reason="no viser: pip install 'orthocas[view]'")
CAMERA = {name: [0] * size if size else 1 for name, size in _CAMERA_NUMBERS.items()} | {"type": "ViewerCameraMessage"}


def encoded(message: object) -> bytes:
    found: bytes = import_module("msgspec").msgpack.encode(message)
    return found


@pytest.fixture
def view() -> Iterator[View]:
    with oc.view(oc.Robot.planar([1.0, 1.0], [1.0, 1.0]), port=0) as shown:
        yield shown


@pytest.fixture
def link(view: View) -> Iterator[Any]:
    """The websocket of a browser that shows the page."""
    with connected(view.url, urlsplit(view.url).path, None) as socket:
        socket.send(encoded(CAMERA))
        wait(lambda: bool(view._server.get_clients()))
        yield socket


def moved(view: View, link: Any, value: float) -> None:
    """Check that a slider still moves the arm."""
    slider = view._page._sliders[0]
    link.send(encoded({"type": "GuiUpdateMessage", "uuid": slider._impl.uuid, "updates": {"value": value}}))
    wait(lambda: bool(view._page._q[0] == value))


HOSTILE: tuple[tuple[object, str], ...] = (
    ({"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"update_cb": []}}, "it changes {'update_cb': []}"),
    ({"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": 0.1, "removed": True}}, "it changes"),
    ({"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": float("nan")}}, "a value is nan"),
    ({"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": 1e300}}, "a value is 1e+300"),
    ({"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": "0.1"}}, "a value is '0.1'"),
    ({"type": "GuiUpdateMessage", "uuid": [], "updates": {"value": 1}}, "uuid is []"),
    ({"type": "GuiUpdateMessage", "uuid": "UUID"}, "its fields are ['uuid'], expected updates, uuid"),
    ({"type": "TransformControlsUpdateMessage", "name": "/t", "wxyz": [1, 0, 0, 0], "position": [0, 0]}, "position is"),
    ({"type": "FileTransferStartUpload", "source_component_uuid": "UUID", "transfer_uuid": "a", "filename": "a",
      "mime_type": "a", "part_count": 10**6, "size_bytes": 10**9}, "pages send no 'FileTransferStartUpload'"),
    ({"type": "GuiRemoveMessage", "uuid": "UUID"}, "pages send no 'GuiRemoveMessage'"),
    ({"type": "Nothing"}, "pages send no 'Nothing'"),
    ([], "pages send no None"),
)  # fmt: skip


@pytest.mark.slow
def test_hostile_messages_are_dropped_with_one_line_each_and_the_page_goes_on(
    view: View, link: Any, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    uuid = view._page._sliders[0]._impl.uuid
    callbacks = list(view._page._sliders[0]._impl.update_cb)
    with caplog.at_level(logging.WARNING):
        for k, (message, wanted) in enumerate(HOSTILE):
            caplog.clear()
            link.send(encoded(message).replace(b"\xa4UUID", encoded(uuid)))
            wait(lambda: bool(caplog.records))
            moved(view, link, round(0.01 * k, 2))
            assert [record.levelname for record in caplog.records] == ["WARNING"]
            line = caplog.records[0].getMessage()
            assert line.startswith(f"view: a message from a browser was dropped: {wanted}"), line
            assert "\n" not in line
            assert len(line) < 300
        for raw in (b"", b"\xc1", b"\xde\xff\xff", b"\x91" * 10**5, "text"):
            link.send(raw)
            moved(view, link, 0.5)
            moved(view, link, 0.6)
    assert view._page._sliders[0]._impl.update_cb == callbacks
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.slow
def test_uploads_stay_out_of_memory(view: View, link: Any) -> None:
    """viser keeps what the parts of a file hold until all have come."""
    for k in range(100):
        part = {"type": "FileTransferPart", "source_component_uuid": None, "transfer_uuid": "a", "part": k}
        link.send(encoded({**part, "content": bytes(2**19)}))
    moved(view, link, 0.25)
    assert not view._server.gui._current_file_upload_states


def test_what_pages_send_is_let_through() -> None:
    inbox, rng = page()[2], np.random.default_rng(7)
    for _ in range(100):
        assert inbox.find_fault(encoded(good(rng))) is None


@pytest.mark.slow
def test_messages_that_are_let_through_harm_nothing() -> None:
    assert messages(2000) == []


@pytest.mark.slow
def test_garbage_in_place_of_a_request_leaves_one_line(
    view: View, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    socket = import_module("socket")
    parts = urlsplit(view.url)
    for garbage in (b"\x16\x03\x01 tls", b"GET\r\n\r\n", b"\xff" * 10**5):
        with socket.create_connection((parts.hostname, parts.port), timeout=20) as link:
            link.sendall(garbage)
            link.shutdown(socket.SHUT_WR)
            link.settimeout(20)
            while link.recv(4096):
                pass
    time.sleep(0.1)
    assert all(record.exc_info is None for record in caplog.records)
    assert "Traceback" not in capfd.readouterr().err


def slide(view: View, slider: Any, value: float) -> None:
    """What viser would do if a value came from a browser in spite of all."""
    slider._impl.value = value
    asyncio.run(slider._impl.update_cb[0](SimpleNamespace(client=object(), target=slider)))


def told(page: Any) -> list[Exception]:
    """The errors that a page shows, from now on."""
    errors: list[Exception] = []
    shown = page._loop._failed
    page._loop._failed = lambda error: (errors.append(error), shown(error))
    return errors


@pytest.mark.slow
def test_a_robot_page_shows_the_error_of_a_nan_and_goes_on(view: View) -> None:
    page: RobotPage = view._page
    errors = told(page)
    slide(view, page._sliders[0], 0.5)
    wait(lambda: bool(page._q[0] == 0.5))
    slide(view, page._sliders[0], np.nan)
    wait(lambda: bool(errors))
    assert "q1" in str(errors[0])
    assert "is nan, expected a finite joint position" in str(errors[0])
    wait(lambda: bool(page._sliders[0].value == 0.5))  # the slider is where the arm is
    slide(view, page._sliders[1], 0.25)
    wait(lambda: bool(page._q[1] == 0.25))
    np.testing.assert_array_equal(page._q, [0.5, 0.25])


@pytest.mark.slow
def test_a_player_shows_the_error_of_a_nan_and_plays_on() -> None:
    with oc.view(trajectory(), robot=fitted().chart, port=0) as view:
        page = view._page
        errors = told(page)
        slide(view, page._time, np.nan)
        wait(lambda: bool(errors))
        assert "time is nan" in str(errors[0])
        slide(view, page._time, 1e9)  # ends at the end
        wait(lambda: page._now == page._stage.duration)
        slide(view, page._time, 0.01)
        wait(lambda: page._now == 0.01)
        asyncio.run(page._play._impl.update_cb[0](SimpleNamespace(client=object(), target=page._play)))
        wait(lambda: page._now > 0.05)
        page._panel.format_html = lambda seconds: 1 / 0  # an error in a tick
        wait(lambda: any(isinstance(error, ZeroDivisionError) for error in errors))
        wait(lambda: page._play.label == "Play")
        count = len(errors)
        time.sleep(0.2)
        assert len(errors) == count  # it does not go on at 30 a second
