"""Ctrl-C while compiled code runs: noted there, raised where Python can handle it.

An exception cannot pass through CasADi's own code: it comes out as another one, or is lost. So SIGINT only leaves a
note while that code runs, and becomes KeyboardInterrupt when it has returned, or earlier where `check` is called.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_notes: list[threading.Event] = []  # one for every `deferred` of the main thread


@contextmanager
def deferred() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block. Other threads never get it, so nothing is done there."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    note = threading.Event()

    def take(number: int, frame: FrameType | None) -> None:
        note.set()

    before = signal.signal(signal.SIGINT, take)
    _notes.append(note)
    try:
        yield
    finally:
        _notes.remove(note)
        signal.signal(signal.SIGINT, before)
        if note.is_set():
            for outer in _notes:  # compiled code around this one may not pass the exception on
                outer.set()
            raise KeyboardInterrupt  # also instead of what compiled code made of it


def check() -> None:
    """Raise KeyboardInterrupt if Ctrl-C is being held back; for code that compiled code calls."""
    if threading.current_thread() is threading.main_thread() and any(note.is_set() for note in _notes):
        raise KeyboardInterrupt
