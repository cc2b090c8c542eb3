"""Campaign of messages to the server of a view: viser can take what is let through, and all inputs still work."""

import asyncio
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from fuzz.child import Finding, run, verdict
from fuzz.mutants import NUMBERS, OTHERS, TEXTS, Rng, changed_data, pick
from orthocas.viewer.window import LOCAL, Inbox, open_window

_KINDS = (
    *("GuiUpdateMessage", "ViewerCameraMessage", "TransformControlsUpdateMessage", "FileTransferStartUpload"),
    *("FileTransferPart", "ShareUrlRequest", "GuiRemoveMessage", "GuiFormSubmitMessage", "ScenePointerMessage", ""),
)
_PROPERTIES = ("update_cb", "sync_cb", "removed", "is_button", "min", "_impl", "__class__", "props", "visible", "")


def messages(count: int) -> list[Finding]:
    """Judge so many messages."""
    return run("messages", judge, range(count))


def judge(seed: int) -> str | None:
    """What is wrong with the treatment of a message."""
    return verdict(lambda: _send(np.random.default_rng(seed)))


@cache
def page() -> tuple[Any, dict[str, Any], Inbox, list[Any]]:
    """A server with inputs of all kinds that pages have, and a handle; where that was moved."""
    server, _ = open_window(LOCAL, 0, "orthocas")
    gui, moved = server.gui, []
    inputs = {
        "slider": gui.add_slider("a", -1.0, 1.0, 0.001, 0.0),
        "dropdown": gui.add_dropdown("b", ("one", "two")),
        "checkbox": gui.add_checkbox("c", True),
        "button": gui.add_button("d"),
    }

    async def told(event: Any) -> None:
        moved.append(np.asarray(event.target.position))

    for handle in inputs.values():
        handle._impl.update_cb.append(told)
    server.scene.add_transform_controls("/tool").on_update(told)
    inbox = Inbox()
    inbox.input_of = gui._gui_input_handle_from_uuid.get
    return server, inputs, inbox, moved


def good(rng: Rng) -> dict[str, Any]:
    """A message that a browser sends."""
    inputs = page()[1]
    camera = {"wxyz": [1.0, 0, 0, 0], "position": [0.0, 1, 2], "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
    camera |= {"fov": 0.7, "near": 0.01, "far": 1000, "image_height": 600, "image_width": 900}
    values = {"slider": 0.25, "dropdown": "two", "checkbox": False, "button": True}
    name = pick(rng, list(values))
    handle = {"name": "/tool", "wxyz": [1, 0, 0, 0], "position": [0.1, 0.2, 0.3], "owner": ""}
    return pick(
        rng,
        (
            {"type": "ViewerCameraMessage", **camera},
            {"type": "TransformControlsUpdateMessage", **handle},
            {"type": "TransformControlsDragEndMessage", "name": "/tool", "owner": ""},
            {"type": "GuiUpdateMessage", "uuid": inputs[name]._impl.uuid, "updates": {"value": values[name]}},
        ),
    )


def _mutant(rng: Rng) -> object:
    message, act = good(rng), rng.integers(8)
    if act == 0:
        return {**message, "type": pick(rng, (*_KINDS, *TEXTS, *OTHERS))}
    if act < 3 and "updates" in message:
        value = pick(rng, (*NUMBERS, *TEXTS, *OTHERS, "one", "nan", 0.5))
        name = "value" if rng.integers(2) else pick(rng, _PROPERTIES)
        return {**message, "updates": {**({"value": 0.5} if rng.integers(4) == 0 else {}), name: value}}
    for _ in range(int(rng.integers(1, 3))):
        message = changed_data(rng, message)
    return message


def _send(rng: Rng) -> None:
    server, inputs, inbox, moved = page()
    encode = import_module("msgspec").msgpack.encode
    assert inbox.find_fault(encode(good(rng))) is None, "a good message is dropped"
    try:
        raw = encode(_mutant(rng))
    except (OverflowError, UnicodeEncodeError):  # no such message can be made
        return
    if rng.integers(8) == 0:
        raw = raw[: int(rng.integers(len(raw)))] + bytes(rng.integers(0, 256, 3).tolist())
    if inbox.find_fault(raw) is not None:
        return
    message = import_module("viser._messages").Message.deserialize(raw)
    asyncio.run(server._websock_server._handle_incoming_message(0, message))
    assert -3 <= inputs["slider"].value <= 3, "a slider has an odd value"
    assert inputs["dropdown"].value in ("one", "two"), "a choice that is not offered"
    assert isinstance(inputs["checkbox"].value, bool), "a mark that is neither"
    assert all(len(handle._impl.update_cb) == 1 for handle in inputs.values()), "an input lost its callback"
    assert all(place.shape == (3,) and np.isfinite(place).all() for place in moved), "a handle is nowhere"
    moved.clear()
