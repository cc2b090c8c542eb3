"""Which messages of browsers reach a page: what its inputs, its handle and its camera send, with values that fit.

viser itself takes any message from a browser, and any property of an input. One message could break a slider for
everybody, or fill the memory with files.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import MISSING, fields
from importlib import import_module
from math import isfinite
from typing import Any

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
_LONGEST = 80  # characters of a report
_log = logging.getLogger(__name__)
#: websockets' own log, in which an error takes one line
connections = logging.getLogger(f"{__name__}.connections")


class Inbox:
    """Lets messages through to viser, and reports each that it drops in one line of the log."""

    def __init__(self) -> None:
        self.input_of: Callable[[str], Any] = lambda uuid: None  #: the handle of an input, or None

    def fault(self, raw: object) -> str | None:
        """What is wrong with a message, in a few words; None if it may pass."""
        try:
            given = import_module("msgspec").msgpack.decode(raw)
        except Exception as error:  # text, or bytes of many kinds
            return f"it cannot be read ({type(error).__name__})"
        kind = given.pop("type", None) if isinstance(given, dict) else None
        if not isinstance(kind, str) or kind not in (_CAMERA, _INPUT, *_HANDLE):
            return f"pages send no {_shown(kind)}"
        return _fault_in_fields(given, kind) or self._fault_in_content(given, kind)

    def _fault_in_content(self, given: dict[str, Any], kind: str) -> str | None:
        if kind == _CAMERA:
            return _fault_in_numbers(given, _CAMERA_NUMBERS)
        if kind == _INPUT:
            return _fault_in_words(given, "uuid") or self._fault_in_updates(given["uuid"], given["updates"])
        return _fault_in_words(given, "name", "owner") or _fault_in_numbers(given, _HANDLE[kind])

    def _fault_in_updates(self, uuid: str, updates: Any) -> str | None:
        """Browsers change the value of an input, and nothing else about it."""
        if not isinstance(updates, dict) or set(updates) != {"value"}:
            return f"it changes {_shown(updates)}, expected a value"
        handle = self.input_of(uuid)
        return None if handle is None else _fault_in_value(handle, updates["value"])  # viser drops what is gone

    def sorted(self, receive: Callable[[], Awaitable[Any]]) -> Callable[[], Awaitable[Any]]:
        """`receive`, which passes over messages that have a fault."""

        async def receive_good() -> Any:
            while (fault := self.fault(raw := await receive())) is not None:
                _log.warning("view: a message from a browser was dropped: %s", fault)
            return raw

        return receive_good

    def guarded(self, handler: Callable[[Any], Awaitable[None]]) -> Callable[[Any], Awaitable[None]]:
        """viser's handler of a connection, with sorted messages, and with one line for what fails nevertheless."""

        async def handle(connection: Any) -> None:
            asyncio.get_running_loop().set_exception_handler(_report)
            connection.recv = self.sorted(connection.recv)
            await handler(connection)

        return handle


def _fault_in_fields(given: dict[Any, Any], kind: str) -> str | None:
    """viser ends a connection at fields that it does not know, and at those that are missing."""
    known = fields(getattr(import_module("viser._messages"), kind))
    needed = {field.name for field in known if field.default is MISSING}
    if needed <= set(given) <= {field.name for field in known}:
        return None
    return f"its fields are {_shown(list(given))}, expected {', '.join(sorted(needed))}"


def _fault_in_words(given: dict[str, Any], *names: str) -> str | None:
    wrong = next((name for name in names if not isinstance(given.get(name, ""), str)), None)
    return None if wrong is None else f"{wrong} is {_shown(given[wrong])}, expected text"


def _fault_in_numbers(given: dict[str, Any], sizes: dict[str, int]) -> str | None:
    """Size 0 stands for one number."""
    for name, size in sizes.items():
        numbers = given[name] if size else [given[name]]
        if not isinstance(numbers, list | tuple) or len(numbers) != (size or 1) or not all(map(_is_number, numbers)):
            return f"{name} is {_shown(given[name])}, expected {size or 1} finite numbers"
    return None


def _fault_in_value(handle: Any, value: Any) -> str | None:
    """A value is of the kind that the input has, and one that it offers."""
    if isinstance(handle.value, str):
        wanted = f"one of {', '.join(handle.options)}"
        good = isinstance(value, str) and value in handle.options
    elif isinstance(handle.value, bool):
        wanted, good = "true or false", isinstance(value, bool)
    else:
        slack = handle.max - handle.min  # limits move while somebody slides
        wanted = f"a number from {handle.min} to {handle.max}"
        good = _is_number(value) and handle.min - slack <= value <= handle.max + slack
    return None if good else f"a value is {_shown(value)}, expected {wanted}"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _shown(value: object) -> str:
    """A value in a line: escaped and short."""
    return ascii(value)[:_LONGEST]


def _report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """One line for an error in a task of the server."""
    error = context.get("exception")
    _log.warning("view: %s: %s", context["message"], _shown(error))
    _log.debug("in the server of the view", exc_info=error)


def _in_one_line(record: logging.LogRecord) -> bool:
    if record.exc_info:
        record.msg, record.args = f"view: {record.getMessage()}: {_shown(record.exc_info[1])}", ()
        record.exc_info = None
    return True


connections.addFilter(_in_one_line)
